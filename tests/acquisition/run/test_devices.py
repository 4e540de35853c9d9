"""The lamp in simulated time, pauses of a run, late steps, and the end of a run."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from acquisition.judge.measure import ExposureJudge
from acquisition.monitor.view import Head, read_session
from acquisition.run import devices, run
from acquisition.run.devices import (
    PAUSE_S,
    REPORTED_LATE,
    RETRY_S,
    Devices,
    HealthWatch,
    RetryPolicy,
    RunEnd,
    RunWatch,
    ask_all,
    await_health,
    health_fault,
    leave_lab,
    make_ready,
    pause_cause,
    settle_lamp,
)
from acquisition.run.rig.opening import open_rig
from acquisition.run.run import take_session
from drivers.camera import keep_awake
from drivers.pjlink import NoResolution
from drivers.presenter import BLACK, WHITE, Colour
from drivers.projector import Power
from drivers.raw.rawfile import read_raw
from experiment.chart.layout import design_chart
from experiment.config import LabSettings, SequenceSettings
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.opening import BusyJournalError
from experiment.session.records import plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import (
    ConfigurationError,
    CropError,
    DeviceError,
    DeviceFault,
    DeviceRefused,
    InputError,
    LinkClosed,
    LinkTimeout,
    StorageError,
)
from sim.projectors.projector import SimulatedProjector
from tests.acquisition.run.scripted import SETTINGS, Beamer, Lab, Screen, ScriptedCamera

ON, OFF = Power.ON, Power.COOLING


@pytest.mark.parametrize(
    ("end", "settings", "power"),
    [
        (RunEnd.COMPLETE, SequenceSettings(), OFF),
        (RunEnd.COMPLETE, SequenceSettings(switch_off=False), ON),
        (RunEnd.COMPLETE, SequenceSettings(lamp_if_unfinished="on"), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(switch_off=False), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(lamp_if_unfinished="on"), ON),
        (RunEnd.INTERRUPTED, SequenceSettings(), ON),
        (RunEnd.INTERRUPTED, SequenceSettings(switch_off=False, lamp_if_unfinished="on"), ON),
    ],
)
def test_leaves_lamp_as_configured_and_reports_it(end: RunEnd, settings: SequenceSettings, power: Power) -> None:
    clock = SimulatedClock()
    projector, screen = SimulatedProjector(clock, power=ON), Screen()
    reports: list[tuple[str, str]] = []
    devices = Devices(ScriptedCamera(screen, clock, {}), screen, projector, clock)
    leave_lab(devices, end, settings, lambda event, sentence: reports.append((event, sentence)))
    assert projector.power() is power
    assert screen.shown == [BLACK]
    ((event, sentence),) = reports
    assert event == "lamp"
    assert ("was switched off" in sentence) == (power is OFF)
    assert ("stays on" in sentence) == (power is ON and end is not RunEnd.INTERRUPTED)
    assert ("left as it is" in sentence) == (end is RunEnd.INTERRUPTED)


@pytest.mark.parametrize(("lost", "said"), [(2, "it was switched off"), (3, "it could not be switched off: no answer")])
def test_switches_lamp_off_despite_lost_answer(lost: int, said: str) -> None:
    class Deaf(SimulatedProjector):
        asked = 0

        def power(self) -> Power:
            type(self).asked += 1
            if type(self).asked <= lost:
                raise DeviceError("no answer")
            return super().power()

    clock = SimulatedClock()
    sentence = settle_lamp(Deaf(clock, power=ON), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert sentence.startswith(said)


def test_leaves_lamp_that_is_off() -> None:
    class Untouched(SimulatedProjector):
        def switch_off(self) -> None:
            raise AssertionError

    clock = SimulatedClock()
    sentence = settle_lamp(Untouched(clock), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert sentence == "it is already off: the projector is in standby"


def test_reports_lamp_that_stays_on() -> None:
    class Deaf(SimulatedProjector):
        def switch_off(self) -> None: ...

    clock = SimulatedClock()
    sentence = settle_lamp(Deaf(clock, power=ON), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert "still on" in sentence
    assert "by hand" in sentence
    assert clock.monotonic() == 5


def test_end_raises_no_device_or_disk_error() -> None:
    class Broken(Screen):
        def show(self, colour: Colour) -> None:
            raise DeviceError("the display is gone")

    clock, screen = SimulatedClock(), Broken()
    projector = SimulatedProjector(clock, power=ON)
    reports: list[str] = []

    def report(event: str, sentence: str) -> None:
        reports.append(f"{event}: {sentence}")
        raise StorageError("the disk is full")

    leave_lab(
        Devices(ScriptedCamera(screen, clock, {}), screen, projector, clock),
        RunEnd.COMPLETE,
        SequenceSettings(),
        report,
    )
    assert reports == ["screen: it could not be set to black: the display is gone", "lamp: it was switched off"]
    assert projector.power() is OFF


SEQUENCE = SequenceSettings(warm_up_s=600)


class Timed(SimulatedClock):
    """A clock with events at given times, which happen during waits."""

    def __init__(self) -> None:
        super().__init__()
        self.due: list[tuple[float, Callable[[], object]]] = []

    def sleep(self, seconds: float) -> None:
        end = self.monotonic() + seconds
        while self.due and min(self.due, key=lambda one: one[0])[0] <= end:
            first = min(self.due, key=lambda one: one[0])
            self.due.remove(first)
            super().sleep(max(first[0] - self.monotonic(), 0))
            first[1]()
        super().sleep(max(end - self.monotonic(), 0))


@dataclass
class PausedRoom:
    """A RetryPolicy with its reports, and a device that is broken until a given time."""

    limit_s: float = 600.0
    clock: Timed = field(default_factory=Timed)
    said: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    beats: list[tuple[float, str, str, float]] = field(default_factory=list[tuple[float, str, str, float]])
    idled: list[float] = field(default_factory=list[float])
    tries: list[float] = field(default_factory=list[float])

    @property
    def retry(self) -> RetryPolicy:
        return RetryPolicy(
            self.clock,
            self.limit_s,
            lambda event, sentence: self.said.append((event, sentence)),
            lambda: self.idled.append(self.clock.monotonic()),
            lambda state, sentence, within_s: self.beats.append((self.clock.monotonic(), state, sentence, within_s)),
        )

    @property
    def words(self) -> list[str]:
        return [event for event, _ in self.said]

    def broken(self, fault: Callable[[float], CropError | None], takes_s: float = 0.0) -> Callable[[], str]:
        """Return an action that fails with `fault` of the time, s."""

        def action() -> str:
            now_s = self.clock.monotonic()
            self.tries.append(now_s)
            self.clock.sleep(takes_s)
            current = fault(now_s)
            if current is not None:
                raise current
            return "done"

        return action


@dataclass
class Room(PausedRoom):
    """A projector behind PJLink, with all reports about it."""

    power: Power = Power.ON

    def __post_init__(self) -> None:
        self.beamer = Beamer(self.clock, self.power)

    def at(self, seconds: float, action: Callable[[], object]) -> None:
        self.clock.due.append((seconds, action))


def no_time(clock: SimulatedClock) -> RetryPolicy:
    return RetryPolicy(clock, 0)


@pytest.mark.parametrize(("fault", "said"), [("frozen", "frozen"), ("unplugged", "no signal")])
def test_reports_unhealthy_projector(fault: str, said: str) -> None:
    beamer = Beamer(SimulatedClock())
    assert health_fault(beamer.projector) is None
    if fault == "frozen":
        beamer.device.set_frozen(True)
    else:
        beamer.device.signal = NoResolution.NO_SIGNAL
    assert said in str(health_fault(beamer.projector))


def test_lights_and_warms_cold_lamp() -> None:
    clock = SimulatedClock()
    projector = SimulatedProjector(clock)
    make_ready(projector, SEQUENCE, no_time(clock))
    assert projector.power() is Power.ON
    assert clock.monotonic() >= 600 + projector.traits.warm_up_s


def test_does_not_wait_for_warm_lamp() -> None:
    class Slow(SimulatedProjector):
        def power(self) -> Power:
            self.clock.sleep(0.1)
            return super().power()

    clock = SimulatedClock()
    make_ready(Slow(clock, power=Power.ON), SEQUENCE, no_time(clock))
    assert clock.monotonic() < 1


def test_waits_for_projector_that_is_silent_while_lighting() -> None:
    class Deaf(SimulatedProjector):
        def power(self) -> Power:
            if (power := super().power()) is Power.WARMING:
                raise LinkTimeout("the projector has not answered within 5 s")
            return power

    clock = SimulatedClock()
    projector = Deaf(clock)
    make_ready(projector, SEQUENCE, no_time(clock))
    assert clock.monotonic() >= 600 + projector.traits.warm_up_s


@pytest.mark.slow
def test_repeats_warm_up_after_lamp_went_out() -> None:
    room = Room(power=Power.STANDBY)
    lit_again = 600.0

    def relit() -> None:
        room.beamer.device = SimulatedProjector(room.clock, power=Power.ON)
        room.beamer.pull(False)

    room.at(400, room.beamer.pull)
    room.at(lit_again, relit)
    make_ready(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["warming up", "retry", "paused", "resumed", "warming up"]
    assert room.clock.monotonic() >= lit_again + SEQUENCE.warm_up_s


def test_mute_does_not_extend_warm_up() -> None:
    room = Room(power=Power.STANDBY)
    room.at(200, lambda: room.beamer.device.set_muted(True))
    room.at(300, lambda: room.beamer.device.set_muted(False))
    make_ready(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["warming up", "retry", "paused", "resumed"]
    assert room.clock.monotonic() <= 600 + room.beamer.device.traits.warm_up_s + 2 * PAUSE_S


def test_relights_after_power_cut() -> None:
    room = Room()
    switched: list[float] = []

    def power_back() -> None:
        room.beamer.device = SimulatedProjector(room.clock)
        lit = room.beamer.device.switch_on
        room.beamer.device.switch_on = lambda: (switched.append(room.clock.monotonic()), lit())  # pyrefly: ignore[bad-assignment, method-assign]
        room.beamer.pull(False)

    room.at(0, room.beamer.pull)
    room.at(60, power_back)
    room.clock.sleep(0)
    await_health(room.beamer.projector, SEQUENCE.model_copy(update={"relight": True}), room.retry)
    assert len(switched) == 1
    assert room.words == ["retry", "paused", "relit", "still paused", "still paused", "warming up", "resumed"]
    assert room.beamer.device.power() is Power.ON
    assert room.clock.monotonic() >= switched[0] + SEQUENCE.warm_up_s


def test_relights_once_per_pause() -> None:
    room = Room()
    tries: list[float] = []
    room.beamer.device.switch_off()
    room.beamer.device.switch_on = lambda: tries.append(room.clock.monotonic())  # pyrefly: ignore[method-assign]
    with pytest.raises(DeviceFault):
        await_health(room.beamer.projector, SEQUENCE.model_copy(update={"relight": True}), room.retry)
    assert len(tries) == 1


def test_reports_standby_after_power_cut() -> None:
    room = Room()

    def power_back() -> None:
        room.beamer.device = SimulatedProjector(room.clock)
        room.beamer.pull(False)

    room.at(0, room.beamer.pull)
    room.at(60, power_back)
    room.at(200, lambda: room.beamer.device.switch_on())
    room.clock.sleep(0)
    await_health(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["retry", "paused", "still paused", "still paused", "warming up", "resumed"]
    assert "nothing listens" in room.said[1][1]
    assert "standby" in room.said[2][1]
    assert "warm-up" in room.said[3][1]
    # Each message has the current cause.
    for at, _, sentence, _ in room.beats:
        if 70 < at < 195:
            assert "standby" in sentence
            assert "listens" not in sentence
    assert room.clock.monotonic() >= 200 + SEQUENCE.warm_up_s


ALL = ["faults", "power", "muted", "picture_fault"]


@pytest.mark.parametrize(("answer_s", "asked"), [(0.004, ALL), (0.02, ["faults"])])
def test_asks_slow_projector_one_question_per_frame(answer_s: float, asked: list[str]) -> None:
    clock, projector, seen = SimulatedClock(), Mock(), list[str]()

    def answers(what: str, value: object) -> object:
        clock.sleep(answer_s)
        seen.append(what)
        return value

    for what, value in (("power", Power.ON), ("muted", False), ("faults", ()), ("picture_fault", None)):
        getattr(projector, what).side_effect = partial(answers, what, value)
    watch = HealthWatch(projector, clock)
    assert watch.fault(thorough=False) is None
    assert seen == ALL, "what it costs is not known before"
    seen.clear()
    clock.sleep(2.3)
    assert watch.fault(thorough=False) is None
    assert seen == asked
    seen.clear()
    assert watch.fault(thorough=True) is None
    assert seen == ALL


def until(end_s: float, fault: CropError) -> Callable[[float], CropError | None]:
    return lambda now: fault if now < end_s else None


@pytest.mark.parametrize("limit_s", [0.1, 0.3, 1.0, 600.0, 601.7])
def test_ends_after_patience_with_first_cause(limit_s: float) -> None:
    room = PausedRoom(limit_s)

    def causes(now: float) -> CropError:
        return LinkClosed("cable pulled at 12 s") if now == 0 else DeviceError("no camera on USB")

    with pytest.raises(LinkClosed) as caught:
        room.retry.attempt(room.broken(causes), "the camera")
    message = str(caught.value)
    assert message.startswith("the camera: cable pulled at 12 s; last fault: no camera on USB; the run waited")
    assert message.endswith("run the same command again")
    assert isinstance(caught.value.__cause__, DeviceError)
    assert room.clock.monotonic() == pytest.approx(limit_s, abs=1e-5)
    assert len(room.tries) >= 2


def test_raises_incurable_faults_at_once() -> None:
    room = PausedRoom()
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


def test_interruption_ends_pause() -> None:
    room = PausedRoom()

    def stop(state: str, sentence: str, within_s: float) -> None:
        if room.clock.monotonic() > 60:
            raise KeyboardInterrupt

    retry = RetryPolicy(room.clock, math.inf, on_wait=stop)
    with pytest.raises(KeyboardInterrupt):
        retry.attempt(room.broken(lambda now: DeviceError("covered")), "the screen")
    assert room.clock.monotonic() < 60 + 2 * PAUSE_S


def test_stores_notes_after_full_disk() -> None:
    room = PausedRoom()
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
    late = [sentence for _, sentence in room.said if REPORTED_LATE in sentence]
    assert len(late) == 2, "that it was retried and paused, two minutes ago"
    assert pause_cause(late[1]) == "the disk is full"


def outlast(room: PausedRoom, retry: RetryPolicy, name: str = "the screen") -> None:
    begun = room.clock.monotonic()
    assert retry.attempt(room.broken(until(begun + 50, DeviceError("covered"))), name) == "done"


def test_separate_pauses_have_separate_patience() -> None:
    room = PausedRoom(60.0)
    retry = room.retry
    for _ in range(3):
        outlast(room, retry)
        for _ in range(10):
            retry.accepted()
    assert room.words == ["retry", "paused", "resumed"] * 3


def test_recurring_fault_shares_patience() -> None:
    room = PausedRoom(60.0)
    retry = room.retry
    outlast(room, retry)
    for _ in range(9):
        retry.accepted()
    outlast(room, retry, "the camera")
    begun = room.clock.monotonic()
    with pytest.raises(DeviceError, match="in 2 pauses"):
        outlast(room, retry)
    assert room.clock.monotonic() - begun == pytest.approx(10, abs=PAUSE_S + RETRY_S), "fifty of sixty are spent"


def test_back_off_continues_across_pauses() -> None:
    """Tried again after 0, 5, 10, 20 … 300 s (docs/how-to/events.md), once more after one second."""
    room = PausedRoom(math.inf)
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
def test_full_disk_keeps_frame_in_camera(tmp_path: Path) -> None:
    """The real driver, with a kernel that refuses larger files: the download is repeated when there is space again."""
    resource = pytest.importorskip("resource")
    chart, light = design_chart(1), Illuminant(0, "uniform", None, WHITE)
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
    assert "the file is too large there" in said[1]
    assert received.captured.released_at == released_at
    assert read_raw(received.path).counts.size > 0
    assert [path.name for path in session.frames_folder.iterdir()] == [received.path.name]


def test_does_not_wait_again_for_locked_journal() -> None:
    def held() -> None:
        raise BusyJournalError("cannot write journal.sqlite: database is locked")

    clock = SimulatedClock()
    begun = clock.monotonic()
    with pytest.raises(StorageError):
        RetryPolicy(clock, 600).attempt(held, "the disk")
    assert clock.monotonic() == begun


def test_only_waits_can_be_interrupted() -> None:
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


class Time:
    """Stands still, except for jumps."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    one = Time()
    monkeypatch.setattr(devices, "elapsed_s", one)
    return one


def events(lab: Lab) -> list[str]:
    return [event.detail for event in lab.session.journal.events() if event.what == "gap"]


def test_repeats_frame_exposed_during_gap(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")

    def stopped() -> None:
        time.now += 343

    lab.camera.after[3] = stopped
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    refused = [frame.verdict for frame in lab.session.frames() if not frame.accepted]
    assert len(refused) == 1
    assert "5 min 43 s" in refused[0]
    assert len(events(lab)) == 1


def test_records_gap_between_frames(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")
    show = lab.screen.show

    def stopped(colour: Colour) -> None:
        show(colour)
        time.now += 60 * (len(lab.screen.shown) == 3)

    lab.screen.show = stopped  # type: ignore[method-assign]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["accepted"] * 6
    assert len(events(lab)) == 1


def test_reports_late_step_once() -> None:
    time, caught = Time(), list[str]()
    watch = RunWatch(lambda sentence, begun: caught.append(sentence), time)

    def pass_s(seconds: float) -> None:
        """Let time pass in steps that are shorter than a gap."""
        for _ in range(round(seconds)):
            time.now += 1
            watch.check_time()

    with watch.step("the camera", "exposes light 3", 4.0, "expose"):
        pass_s(3 * 4 + 10)
        assert not caught
        pass_s(1)
        assert len(caught) == 1
        pass_s(300)
        assert len(caught) == 1
    assert "the camera exposes light 3, expected duration 4 s" in caught[0]
    pass_s(300)
    with watch.step("the camera", "exposes light 4", 4.0, "expose"):
        pass_s(3 * 4 + 10 + 1)
    assert len(caught) == 2, "what was late tells nothing of how long it takes"
    with watch.step("the camera", "sends light 4", 4.0, "download"):
        pass_s(20)
    with watch.step("the camera", "sends light 5", 4.0, "download"):
        pass_s(3 * 20 + 10)
    assert len(caught) == 2, "a slow cable stays slow"
    with watch.step("the screen", "shows light 6", 0.5, "show"):
        pass_s(12)
    assert "expected duration 0.5 s" in caught[2]


@pytest.mark.slow
@pytest.mark.parametrize(("hangs", "cause"), [("expose", "the camera"), ("show", "the screen"), ("judge", "the disk")])
def test_reports_hanging_device(
    tmp_path: Path, time: Time, hangs: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, heads = Lab(tmp_path / "session"), list[Head]()
    owner = ExposureJudge if hangs == "judge" else type(lab.camera) if hangs == "expose" else type(lab.screen)
    real, calls = getattr(owner, hangs), [0]
    watches, kinds, entered, expected = list[RunWatch](), list[str](), threading.Condition(), dict[str, float]()

    class Watched(RunWatch):
        def __init__(self, on_late: Callable[[str, datetime], object]) -> None:
            super().__init__(on_late, time)
            watches.append(self)

        @contextmanager
        def step(self, device: str, doing: str, expected_s: float, step_kind: str) -> Generator[None]:
            expected[step_kind] = expected_s
            with super().step(device, doing, expected_s, step_kind):
                with entered:
                    kinds[:] = [step_kind]
                    entered.notify_all()
                try:
                    yield
                finally:
                    kinds.clear()

    def hanging(*given: object) -> object:
        calls[0] += 1
        if calls[0] == 4:
            # Frames are judged in another thread, and the run waits for the verdict.
            with entered:
                assert entered.wait_for(lambda: kinds == [hangs], timeout=60)
            for _ in range(60):
                time.now += 1
                watches[0].check_time()
            heads.append(read_session(lab.session.folder).head(datetime.now(UTC)))
        return real(*given)

    monkeypatch.setattr(owner, hangs, hanging)
    monkeypatch.setattr(run, "RunWatch", Watched)
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    (head,) = heads
    assert (head.state, head.cause) == ("late", cause)
    assert head.sentence.startswith("late since")
    assert not events(lab)
    # After 0.5 s the camera's own dark frame takes the same time again.
    assert SETTINGS.camera.shutter_s == 0.5
    assert expected.items() >= {"expose": 1 + 3.0, "download": 10.0, "judge": 5.0, "show": 2.0}.items()


@pytest.mark.parametrize("fault", [InputError("no such file"), ConfigurationError("line.baud is missing")])
def test_reports_all_faults_with_exit_code(fault: CropError) -> None:
    def fails(error: CropError) -> Callable[[], object]:
        def ask() -> None:
            raise error

        return ask

    unplugged, nowhere = LinkClosed("no camera on USB"), ConfigurationError("lab.camera.host is missing")
    for camera, exit_code in ((unplugged, 3), (nowhere, 2)):
        with pytest.raises(CropError) as caught:
            ask_all({"camera": fails(camera), "projector": fails(fault), "display": lambda: None})
        assert caught.value.exit_code == exit_code
        assert str(camera) in str(caught.value)
        assert str(fault) in str(caught.value)
