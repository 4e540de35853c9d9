"""RetryPolicy in simulated time: what fails is waited for, told as it is now, and never waited for too long."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest

from acquisition.run.devices import PAUSE_S, RETRY_S, TOLD_LATER, RetryPolicy, pause_cause
from acquisition.run.rig.opening import open_rig
from drivers.camera import keep_awake
from drivers.presenter import WHITE
from drivers.raw.rawfile import read_raw
from experiment.chart.layout import design_chart
from experiment.config import LabSettings
from experiment.lights import Illumination
from experiment.session.folder import Session
from experiment.session.opening import HeldJournalError
from experiment.session.records import plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import (
    ConfigurationError,
    CropError,
    DeviceError,
    DeviceFault,
    DeviceRefused,
    LinkClosed,
    StorageError,
)


@dataclass
class Room:
    """RetryPolicy with everything that it tells, and something that is broken until a time."""

    limit_s: float = 600.0
    clock: SimulatedClock = field(default_factory=SimulatedClock)
    said: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    beats: list[tuple[float, str, str, float]] = field(default_factory=list[tuple[float, str, str, float]])
    idled: list[float] = field(default_factory=list[float])
    tries: list[float] = field(default_factory=list[float])

    @property
    def retry(self) -> RetryPolicy:
        return RetryPolicy(
            self.clock,
            self.limit_s,
            lambda what, sentence: self.said.append((what, sentence)),
            lambda: self.idled.append(self.clock.monotonic()),
            lambda state, sentence, within_s: self.beats.append((self.clock.monotonic(), state, sentence, within_s)),
        )

    @property
    def words(self) -> list[str]:
        return [what for what, _ in self.said]

    def broken(self, fault: Callable[[float], CropError | None], takes_s: float = 0.0) -> Callable[[], str]:
        """Return an action that fails as `fault` says of the time, in seconds."""

        def action() -> str:
            now = self.clock.monotonic()
            self.tries.append(now)
            self.clock.sleep(takes_s)
            found = fault(now)
            if found is not None:
                raise found
            return "done"

        return action


def until(end_s: float, fault: CropError) -> Callable[[float], CropError | None]:
    return lambda now: fault if now < end_s else None


def test_other_devices_are_kept_awake_meanwhile() -> None:
    room = Room()
    room.retry.attempt(room.broken(until(100, DeviceError("covered"))), "the screen")
    assert max(after - before for before, after in pairwise(room.idled)) <= 10
    room = Room()
    room.retry.attempt(room.broken(until(100, DeviceError("gone"))), "the camera", idle=False)
    assert room.idled == []


def test_a_pause_gives_one_order_and_says_nothing_twice() -> None:
    room = Room(600.0)
    full = StorageError("cannot write session: No space left on device; free space, then run the same command again")
    gone = LinkClosed("EOS at usb 1 is gone; check its cable")
    given_up = DeviceError("EOS at usb 1 is gone; no connection for 60 s; at last: no camera on USB; check its cable")
    with pytest.raises(StorageError) as ended:
        room.retry.attempt(room.broken(lambda now: full), "the disk")
    assert str(ended.value).count("run the same command again") == 1
    sentences = [sentence for _, sentence in room.said] + [sentence for _, _, sentence, _ in room.beats]
    assert not [sentence for sentence in sentences if "again" in sentence]
    assert any("free space (the run waits up to" in sentence for sentence in sentences)
    room = Room(600.0)
    with pytest.raises(LinkClosed) as lost:
        room.retry.attempt(room.broken(lambda now: gone if now == 0 else given_up), "the camera")
    assert str(lost.value).count("is gone") == 1


@pytest.mark.parametrize("limit_s", [0.1, 0.3, 1.0, 600.0, 601.7])
def test_patience_ends_in_time_with_the_first_cause(limit_s: float) -> None:
    room = Room(limit_s)

    def causes(now: float) -> CropError:
        return LinkClosed("cable pulled at 12 s") if now == 0 else DeviceError("no camera on USB")

    with pytest.raises(LinkClosed) as caught:
        room.retry.attempt(room.broken(causes), "the camera")
    message = str(caught.value)
    assert message.startswith("the camera: cable pulled at 12 s; at last: no camera on USB; the run waited")
    assert message.endswith("run the same command again")
    assert isinstance(caught.value.__cause__, DeviceError)
    assert room.clock.monotonic() == pytest.approx(limit_s, abs=1e-5)
    assert len(room.tries) >= 2


def test_what_waiting_does_not_cure_is_raised_at_once() -> None:
    room = Room()
    fault = ConfigurationError("no such display")
    with pytest.raises(ConfigurationError) as caught:
        room.retry.attempt(room.broken(lambda now: fault), "the screen")
    assert caught.value is fault
    with pytest.raises(DeviceRefused):
        room.retry.attempt(
            room.broken(lambda now: DeviceRefused("ISO 42 is not offered")),
            "the camera",
            curable=lambda fault: not isinstance(fault, DeviceRefused),
        )
    assert room.said == []


def test_an_interruption_ends_a_pause_at_once() -> None:
    room = Room()

    def stop(state: str, sentence: str, within_s: float) -> None:
        if room.clock.monotonic() > 60:
            raise KeyboardInterrupt

    retry = RetryPolicy(room.clock, math.inf, on_wait=stop)
    with pytest.raises(KeyboardInterrupt):
        retry.attempt(room.broken(lambda now: DeviceError("covered")), "the screen")
    assert room.clock.monotonic() < 60 + 2 * PAUSE_S


def test_a_full_disk_takes_the_notes_of_its_pause_when_there_is_space() -> None:
    room = Room()
    full = until(120, StorageError("the disk is full"))

    def report(what: str, sentence: str) -> None:
        if (fault := full(room.clock.monotonic())) is not None:
            raise fault
        room.said.append((what, sentence))

    def beat(state: str, sentence: str, within_s: float) -> None:
        raise StorageError("the disk is full")

    retry = RetryPolicy(room.clock, 600, report, on_wait=beat)
    assert retry.attempt(room.broken(full), "the disk") == "done"
    assert room.words == ["retry", "paused", "resumed"]
    late = [sentence for _, sentence in room.said if TOLD_LATER in sentence]
    assert len(late) == 2, "that it was retried and paused, two minutes ago"
    assert pause_cause(late[1]) == "the disk is full"


def outlast(room: Room, retry: RetryPolicy, name: str = "the screen") -> None:
    begun = room.clock.monotonic()
    assert retry.attempt(room.broken(until(begun + 50, DeviceError("covered"))), name) == "done"


def test_pauses_with_many_frames_between_them_have_each_their_time() -> None:
    room = Room(60.0)
    retry = room.retry
    for _ in range(3):
        outlast(room, retry)
        for _ in range(10):
            retry.accepted()
    assert room.words == ["retry", "paused", "resumed"] * 3


def test_what_fails_again_after_a_few_frames_has_one_patience() -> None:
    room = Room(60.0)
    retry = room.retry
    outlast(room, retry)
    for _ in range(9):
        retry.accepted()
    outlast(room, retry, "the camera")
    begun = room.clock.monotonic()
    with pytest.raises(DeviceError, match="in 2 pauses"):
        outlast(room, retry)
    assert room.clock.monotonic() - begun == pytest.approx(10, abs=PAUSE_S + RETRY_S), "fifty of sixty are spent"


def test_one_back_off_holds_across_pauses() -> None:
    """Tried again after 0, 5, 10, 20 … 300 s (docs/how-to/night-run.md), once more after one second."""
    room = Room(math.inf)
    retry = room.retry
    waited: list[float] = []
    for _ in range(9):
        pause = retry.pause("the frames")
        begun = room.clock.monotonic()
        pause.back_off(DeviceError("refused"))
        waited.append(room.clock.monotonic() - begun)
        pause.wait(DeviceError("refused"))
        pause.over()
        retry.accepted()
    assert waited == pytest.approx([1, 6, 11, 21, 41, 81, 161, 301, 301], abs=1)


@pytest.mark.slow
def test_a_full_disk_never_loses_the_frame_in_the_camera(tmp_path: Path) -> None:
    """The real driver, and a kernel that lets no file grow: the download is repeated when there is space again."""
    resource = pytest.importorskip("resource")
    chart, light = design_chart(1), Illumination(0, "uniform", None, WHITE)
    document = {"rig": "simulated", "chart": "c", "illuminations": "i", "simulated": {"body": "Test"}}
    settings = LabSettings.model_validate(document)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    said: list[str] = []
    with (
        Session.create(tmp_path / "night", settings.to_toml(), chart, [light], plan_steps([light], 25)) as session,
        open_rig(settings, chart) as devices,
    ):
        clock, camera = devices.clock, devices.camera
        camera.configure(settings.camera.exposure)
        devices.presenter.show(WHITE)
        released_at = camera.expose()

        def idle() -> None:
            keep_awake(camera)
            if clock.monotonic() > 300:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)

        retry = RetryPolicy(clock, 600, lambda what, sentence: said.append(f"{what}: {sentence}"), idle)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
            received = retry.attempt(lambda: session.receive("0000_white", camera.download), "the disk")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, handler)
    assert [sentence.split(":")[0] for sentence in said] == ["retry", "paused", "resumed"]
    assert "no file may be so large there" in said[1]
    assert received.captured.released_at == released_at
    assert read_raw(received.path).counts.size > 0
    assert [path.name for path in session.frames_folder.iterdir()] == [received.path.name]


def test_a_journal_that_another_program_held_for_the_whole_patience_is_not_waited_for_again() -> None:
    def held() -> None:
        raise HeldJournalError("cannot write journal.sqlite: database is locked")

    clock = SimulatedClock()
    begun = clock.monotonic()
    with pytest.raises(StorageError):
        RetryPolicy(clock, 600).attempt(held, "the disk")
    assert clock.monotonic() == begun


def test_a_wait_can_be_broken_off_and_a_try_cannot() -> None:
    clock, inside, seen = SimulatedClock(), [0], list[tuple[str, int]]()

    @contextmanager
    def breakable() -> Generator[None]:
        inside[0] += 1
        yield
        inside[0] -= 1

    def idle() -> None:
        seen.append(("waits", inside[0]))
        if clock.monotonic() > 60:
            raise KeyboardInterrupt

    def action() -> None:
        seen.append(("tries", inside[0]))
        raise DeviceFault("it is off; switch it on")

    with pytest.raises(KeyboardInterrupt):
        RetryPolicy(clock, 600, idle=idle, breakable=breakable).attempt(action, "the screen")
    assert set(seen) == {("tries", 0), ("waits", 1)}
