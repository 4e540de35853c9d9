"""Resumed sessions, notices, signs of life and the terminal."""

from __future__ import annotations

import base64
import contextlib
import errno
import http.server
import io
import json
import os
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.monitor.view import read_session
from acquisition.run import run
from acquisition.run.devices import PAUSE_S, Devices
from acquisition.run.pipeline import Taken, link_runs
from acquisition.run.rig.lab import session_clock
from acquisition.run.run import (
    ALIVE_S,
    PLAIN_S,
    QUIET_S,
    STARTING,
    Life,
    Notices,
    PauseNotices,
    RunOutcome,
    SignOfLife,
    Terminal,
    clock_note,
    require_same_devices,
    run_session,
    signs_of_life,
    take_session,
)
from drivers.camera import CameraIdentity, CapturedFrame
from drivers.presenter import Colour
from drivers.projector import Power, ProjectorIdentity
from experiment.config import LabSettings, NotifySettings
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import ACCEPTED, REFUSED, Check, Judgement, SessionStep, link_steps, plan_steps
from foundation.clock import SimulatedClock
from foundation.console import EndRequest
from foundation.errors import DeviceError, DeviceRefused, QualityError
from sim.projectors.projector import SimulatedProjector
from tests.acquisition.run.scripted import EXPOSE_S, LIGHTS, SETTINGS, WELL, Hurried, Lab, ScriptedCamera

RESPONSE = (Colour(250, 0, 0), Colour(0, 250, 0))
TIES = [step.colour for step in link_steps(0)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


def lab_with_response(folder: Path) -> Lab:
    """Return a lab whose session starts with white, dark, red, green."""
    lab = Lab(folder)
    lab.session.close()
    (folder / "journal.sqlite").unlink()
    Journal.create(folder / "journal.sqlite", plan_steps(LIGHTS, 25, response=RESPONSE))
    lab.session = Session.open_for_run(folder)
    return lab


def interrupt_after(lab: Lab, frames: int, first: tuple[int, ...] = ()) -> None:
    """Take some frames and end the run."""
    ending = EndRequest(lambda sentence: None)
    lab.camera.after[lab.camera.captures + frames] = ending.request
    with pytest.raises(KeyboardInterrupt):
        take_session(lab.session, lab.devices, SETTINGS, ending=ending, first=first)


def test_new_session_needs_no_links(folder: Path) -> None:
    lab = lab_with_response(folder)
    assert link_runs(lab.session, lab.clock.now()) == ()
    assert take_session(lab.session, lab.devices, SETTINGS).complete


def test_session_without_primaries_needs_no_links(folder: Path) -> None:
    lab = Lab(folder)
    interrupt_after(lab, 3)
    assert link_runs(lab.session, lab.clock.now()) == ()


@pytest.mark.slow
def test_resumed_run_starts_with_links(folder: Path) -> None:
    lab = lab_with_response(folder)
    interrupt_after(lab, 5)
    first = link_runs(lab.session, lab.clock.now())
    assert first == (8, 9, 10, 11, 12, 13)
    lab.camera.exposed.clear()
    assert take_session(lab.session, lab.devices, SETTINGS, first=first).complete
    assert lab.camera.exposed[:6] == TIES
    assert len(lab.session.steps) == 14


@pytest.mark.slow
def test_repeats_interrupted_links(folder: Path) -> None:
    lab = lab_with_response(folder)
    interrupt_after(lab, 5)
    interrupt_after(lab, 2, link_runs(lab.session, lab.clock.now()))
    again = link_runs(lab.session, lab.clock.now())
    assert again == (8, 9, 10, 11, 12, 13), "no further steps"
    assert not lab.session.done_steps() & set(again), "no step ever has two frames that count"
    lab.camera.exposed.clear()
    interrupt_after(lab, 7, again)
    assert lab.camera.exposed[:6] == TIES, "those that were taken are taken again: the chart may have moved since"
    assert link_runs(lab.session, lab.clock.now()) == (14, 15, 16, 17, 18, 19), "behind another light they are new"


def test_resumed_run_reports_before_opening_devices(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(folder)
    lab.session.journal.beat("running", "frames are taken", datetime.now(UTC) + timedelta(seconds=60))
    lab.session.close()
    seen: list[str] = []

    def opening(*given: object) -> Devices:
        seen.append(read_session(folder).head(datetime.now(UTC)).sentence)
        raise DeviceError("no camera on USB; plug it in")

    def same(session: Session, settings: LabSettings) -> None:
        """Accept any settings."""

    monkeypatch.setattr(run, "open_rig", opening)
    monkeypatch.setattr(run, "require_same", same)
    with pytest.raises(DeviceError):
        run_session(SETTINGS, folder, lambda done, total: None)
    assert seen == [STARTING]
    view = read_session(folder)
    assert view.head(datetime.now(UTC)).sentence == "no camera on USB; plug it in"
    assert [event.what for event in view.events].count("killed") == 1


def test_refuses_other_camera_or_projector(folder: Path) -> None:
    lab = Lab(folder)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    assert lab.session.journal.records()["camera"] == "Canon Test, serial number 1"
    lab.projector.identity = lambda: ProjectorIdentity("Epson", "EB", "hall")  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, SETTINGS)
    lab.projector = None  # type: ignore[assignment]
    lab.camera.identity = lambda: CameraIdentity("Canon", "Test", "2")  # type: ignore[method-assign]
    assert caught.value.value == "Epson EB"
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, SETTINGS)
    assert caught.value.expected == "Canon Test, serial number 1"
    assert caught.value.value == "Canon Test, serial number 2"
    assert "new session" in caught.value.remedy


def test_accepts_changed_firmware_and_name(folder: Path) -> None:
    lab = Lab(folder)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    body, beamer = lab.camera.identity(), lab.projector.identity()
    lab.camera.identity = lambda: replace(body, firmware="1.1.0")  # type: ignore[method-assign]
    lab.projector.identity = lambda: replace(beamer, name="another")  # type: ignore[method-assign]
    require_same_devices(lab.session, lab.devices, SETTINGS)


def test_refuses_other_screen(folder: Path) -> None:
    lab = Lab(folder)
    one = LabSettings(rig="lab", chart=Path("c"), illuminations=Path("i"))
    require_same_devices(lab.session, lab.devices, one)
    light = one.lab.light.model_copy(update={"display": "HDMI-2"})
    other = one.model_copy(update={"lab": one.lab.model_copy(update={"light": light})})
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, other)
    assert (caught.value.expected, caught.value.value) == ("display", "display HDMI-2")


@pytest.mark.slow
def test_closes_repeated_illuminants(folder: Path) -> None:
    lab = Lab(folder, lights=(*LIGHTS, Illuminant(2, "uniform", None, Colour(9, 255, 3))))
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    lab.session.retake("1")
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert [step for step, _ in lab.taken()][-3:] == ["l3", "w7", "d8"]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert len(lab.taken()) == 10, "and only once"


def test_reports_clock_set_back(folder: Path) -> None:
    lab = Lab(folder)
    ahead = datetime.now(UTC) + timedelta(hours=5)
    assert clock_note(lab.session, session_clock(lab.session)) == ""
    attempt = lab.session.journal.begin(lab.session.steps[0], "frames/a", ahead)
    received = lab.session.receive("a", lambda into: CapturedFrame("a.cr2", into.write(b"a"), ahead))
    lab.session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=ahead)
    clock = session_clock(lab.session)
    assert clock.now() >= ahead, "what is taken now lies behind it"
    said = clock_note(lab.session, clock)
    assert f"behind the last frame of {folder}" in said
    assert "set the clock" in said
    assert session_clock(None).behind_s == 0


ONE_AGAIN = ["accepted", "accepted", "refused", "accepted", "accepted", "accepted", "accepted"]
"""The light that is on the screen when something happens is taken again: its frame cannot be trusted."""


@pytest.mark.slow
def test_pauses_while_muted(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    clock.calls[PAUSE_S] = lambda: lab.projector.set_muted(False)

    def mute(taken: Taken) -> None:
        if lab.camera.captures == 2:
            lab.projector.set_muted(True)

    said: list[str] = []
    assert take_session(lab.session, lab.devices, SETTINGS, observe=mute, announce=said.append).complete
    assert [sentence.split(":")[0] for sentence in said] == ["refused", "retry", "paused", "resumed", "lamp"]
    events = [event.what for event in lab.session.journal.events()]
    assert events == ["start", "refused", "retry", "paused", "resumed", "lamp", "complete"]
    assert "mute" in lab.session.journal.events()[1].detail
    assert lab.verdicts() == ONE_AGAIN


@pytest.mark.slow
def test_repeats_frame_taken_during_mute(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    # The picture is muted during the first exposure, while the scripted camera sleeps.
    clock.calls = {EXPOSE_S: lambda: lab.projector.set_muted(True), PAUSE_S: lambda: lab.projector.set_muted(False)}
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["refused"] + ["accepted"] * 6
    assert "muted" in lab.session.frames()[0].verdict


@pytest.mark.slow
def test_keeps_camera_awake_during_warm_up(folder: Path) -> None:
    lab = Lab(folder)
    lab.projector = SimulatedProjector(lab.clock)
    spoken: list[float] = []

    class PatientCamera(ScriptedCamera):
        def idle(self) -> None:
            spoken.append(self.clock.monotonic())

    lab.camera = PatientCamera(lab.screen, lab.clock, {})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert spoken[-1] >= SETTINGS.sequence.warm_up_s
    assert max(np.diff(spoken)) <= 10


@pytest.mark.slow
def test_runs_without_lamp_control(folder: Path) -> None:
    lab = Lab(folder)
    devices = Devices(lab.camera, lab.screen, None, lab.clock)
    assert take_session(lab.session, devices, SETTINGS).complete


FORTY_LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 6 * n, 0)) for n in range(40))
PATIENCE_S = 120.0


def settings(**changes: object) -> LabSettings:
    sequence = {"patience_s": PATIENCE_S, **changes}
    return SETTINGS.model_copy(update={"sequence": SETTINGS.sequence.model_copy(update=sequence)})


@dataclass
class LatePictureJudge:
    """Judges the colours that the camera exposed; those of `late` exposures are one exposure late.

    Like the live judge, it reports a cause as lasting after three frames, and a wrong white frame voids others.
    """

    lab: Lab
    late: range = range(0)
    judged: int = 0
    in_a_row: int = 0

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        number, self.judged = self.judged, self.judged + 1
        exposed = self.lab.camera.exposed
        seen = exposed[number - (number in self.late)] if number else exposed[0]
        assert exposed[number] == step.colour
        good = seen == step.colour
        self.in_a_row = 0 if good else self.in_a_row + 1
        reason = "" if good else f"{seen} is seen, {step.colour} was ordered"
        voids = not good and step.kind == "white"
        return Judgement((Check("light", reason=reason),), voids=voids, lasting=self.in_a_row >= 3)

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None: ...


@dataclass
class Night:
    """A session of 40 illuminants, and its reports."""

    lab: Lab
    said: list[str] = field(default_factory=list[str])

    def run(self, judge: LatePictureJudge, **changes: object) -> RunOutcome:
        return take_session(self.lab.session, self.lab.devices, settings(**changes), judge, announce=self.said.append)

    def of(self, word: str) -> list[str]:
        return [sentence for sentence in self.said if sentence.startswith(f"{word}: ")]

    def require_each_step_once(self) -> None:
        accepted = [attempt.step for attempt in self.lab.session.journal.attempts() if attempt.verdict == ACCEPTED]
        assert sorted(accepted) == [step.number for step in self.lab.session.steps]


@pytest.fixture
def night(tmp_path: Path) -> Night:
    return Night(Lab(tmp_path / "session", lights=FORTY_LIGHTS, reference_every=10))


@pytest.mark.slow
def test_ends_with_permanently_late_picture(night: Night) -> None:
    with pytest.raises(QualityError):
        night.run(LatePictureJudge(night.lab, range(8, 10_000)))
    clock = night.lab.clock
    assert clock.monotonic() < 2 * PATIENCE_S
    assert night.lab.verdicts().count(REFUSED) < 15
    assert len(night.of("paused")) == 1
    assert not night.of("resumed"), "a frame that follows itself shows nothing"
    assert night.run(LatePictureJudge(night.lab, judged=len(night.lab.camera.exposed))).complete
    night.require_each_step_once()


@pytest.mark.slow
@pytest.mark.parametrize("until", [12, 13, 14, 15])
def test_resumes_after_late_pictures(night: Night, until: int) -> None:
    assert night.run(LatePictureJudge(night.lab, range(8, until))).complete
    assert len(night.of("paused")) == len(night.of("resumed"))
    night.require_each_step_once()


@pytest.mark.slow
def test_limits_space_of_refused_frames(night: Night) -> None:
    class EachSecond(LatePictureJudge):
        def judge(self, file: Path, step: SessionStep) -> Judgement:
            self.judged += 1
            return Judgement((Check("light", reason="dust" if self.judged % 2 else ""),))

    with pytest.raises(QualityError, match="refused_gb"):
        night.run(EachSecond(night.lab), refused_gb=5.5 * len(WELL) / 1e9)
    assert night.lab.verdicts().count(REFUSED) in (6, 7), "and the one that was under way"
    assert night.lab.session.journal.events()[-1].what == "ended"
    assert night.run(LatePictureJudge(night.lab, judged=len(night.lab.camera.exposed)), refused_gb=1e-9).complete
    night.require_each_step_once()


@pytest.mark.slow
class TestNotices:
    def test_notifies_recurring_cause_once_per_hour(self) -> None:
        clock, sent = SimulatedClock(), list[tuple[str, str]]()
        notices = PauseNotices(lambda event, sentence: sent.append((event, sentence)), clock)
        for minute in range(0, 180, 2):
            sentence = f"the camera: USB {minute} is gone (the run waits up to 9 min {minute % 60:02d} s)"
            notices.paused(sentence)
            notices.resumed("the camera is ready again")
            clock.sleep(120)
        assert [event for event, _ in sent] == ["paused", "resumed"] * 3

    def test_notifies_new_cause_at_once(self) -> None:
        clock, sent = SimulatedClock(), list[str]()
        notices = PauseNotices(lambda event, sentence: sent.append(sentence), clock)
        for sentence in (
            "the camera: its battery is empty (the run waits up to 10 min 00 s)",
            "the camera: its card is full (the run waits up to 10 min 00 s)",
            "the frames: illuminant 3: the frame shows another illuminant (the run waits up to 10 min 00 s)",
            "the frames: dark frame 4: the dark frame has 80 % of white (the run waits up to 10 min 00 s)",
        ):
            notices.paused(sentence)
            notices.resumed("")
        assert [sentence for sentence in sent if sentence] == [
            sentence for sentence in sent if sentence and "dark frame" not in sentence
        ]
        assert len(sent) == 6

    def test_notifies_long_pause_later(self) -> None:
        clock, sent = SimulatedClock(), list[str]()
        notices = PauseNotices(lambda event, sentence: sent.append(event), clock)
        sentence = "the camera: gone (paused for 3 s; resumes automatically, waits without limit)"
        notices.paused(sentence)
        notices.resumed("")
        clock.sleep(60)
        notices.paused(sentence)
        assert sent == ["paused", "resumed"]
        clock.sleep(QUIET_S - 61)
        notices.paused(sentence)
        assert sent == ["paused", "resumed"]
        clock.sleep(1)
        notices.paused(sentence)
        notices.paused(sentence)
        assert sent == ["paused", "resumed", "paused"]


AT = datetime(2026, 1, 1, 3, 12, 45, tzinfo=UTC)


@dataclass
class Receiver:
    """Requests that a server on this computer received, and its answers."""

    code: int = 200
    headers: dict[str, str] = field(default_factory=dict[str, str])
    hangs: threading.Event | None = None
    port: int = 0
    got: list[tuple[str, dict[str, str], dict[str, Any]]] = field(
        default_factory=list[tuple[str, dict[str, str], dict[str, Any]]]
    )


@contextmanager
def served(receiver: Receiver) -> Generator[Receiver]:
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            receiver.got.append((self.path, dict(self.headers), json.loads(body)))
            if receiver.hangs is not None:
                receiver.hangs.wait(10)
            self.send_response(receiver.code)
            for name, value in receiver.headers.items():
                self.send_header(name, value)
            self.end_headers()

        do_GET = do_POST  # noqa: N815

        def log_message(self, format: str, *args: object) -> None: ...

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        receiver.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield receiver
        finally:
            if receiver.hangs is not None:
                receiver.hangs.set()
            server.shutdown()
            thread.join()


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")


def notices(target: str, *events: str) -> list[str]:
    """Send events to a target; return the warnings."""
    warnings: list[str] = []
    told_by = Notices(target, "night", warnings.append)
    for event in events or ("paused",):
        told_by.send(event, "the screen is covered – 3 °C", AT)
    told_by.close()
    told_by.close()
    return warnings


class TestWebhook:
    def test_posts_json(self) -> None:
        with served(Receiver()) as receiver:
            assert notices(f"http://127.0.0.1:{receiver.port}/lab?token=t", "paused", "resumed") == []
        (path, headers, body), (_, _, second) = receiver.got
        assert path == "/lab?token=t"
        assert headers["Content-Type"] == "application/json; charset=utf-8"
        assert headers["Title"] == "CroP: paused"
        assert body == {
            "event": "paused",
            "message": "the screen is covered – 3 °C",
            "text": "night: paused: the screen is covered – 3 °C",
            "content": "night: paused: the screen is covered – 3 °C",
            "session": "night",
            "host": socket.gethostname(),
            "at": "2026-01-01T03:12:45+00:00",
        }
        assert second["event"] == "resumed"

    def test_sends_credentials_in_header(self) -> None:
        with served(Receiver()) as receiver:
            assert notices(f"http://u%40x:p%3Aw@127.0.0.1:{receiver.port}/lab") == []
        ((path, headers, _),) = receiver.got
        assert path == "/lab"
        assert "u%40x" not in headers["Host"]
        assert base64.b64decode(headers["Authorization"].removeprefix("Basic ")) == b"u@x:p:w"

    @pytest.mark.parametrize(
        ("receiver", "why"),
        [
            (Receiver(403), "it answered 403"),
            (Receiver(500), "it answered 500"),
            (Receiver(302, {"Location": "/elsewhere"}), "it answered 302"),
        ],
    )
    def test_reports_refusal_once_without_secret(self, receiver: Receiver, why: str) -> None:
        with served(receiver):
            warnings = notices(f"http://u:s3cret@127.0.0.1:{receiver.port}/s3cret?s3cret", "paused", "resumed")
        failure = f"did not receive a notice: {why}; the run continues; check the receiver"
        assert warnings == [f"http://127.0.0.1:{receiver.port}/… {failure}"]
        assert len(receiver.got) == 2

    def test_reports_missing_server(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as unused:
            port = unused.getsockname()[1]
        (warning,) = notices(f"http://127.0.0.1:{port}/s3cret")
        assert "Connection refused" in warning
        assert "s3cret" not in warning

    @pytest.mark.slow
    def test_does_not_wait_for_hanging_server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run, "LIMIT_S", 0.1)
        monkeypatch.setattr(run, "ENDING_S", 0.1)
        with served(Receiver(hangs=threading.Event())) as receiver:
            warnings = notices(f"http://127.0.0.1:{receiver.port}/s3cret", "paused", "resumed", "complete")
        assert warnings
        assert all("s3cret" not in warning for warning in warnings)


class TestCommand:
    @pytest.mark.slow
    def test_passes_json_and_variables(self, tmp_path: Path) -> None:
        out = tmp_path / "got"
        program = (
            "import json, os, sys; body = json.load(sys.stdin);open(sys.argv[1], 'a').write(repr((body['message'], "
            "os.environ['CROP_EVENT'], os.environ['CROP_MESSAGE'],os.environ['CROP_SESSION'])) + '\\n')"
        )
        assert notices(shlex.join([sys.executable, "-c", program, str(out)]), "paused", "resumed") == []
        said = "the screen is covered – 3 °C"
        lines = [repr((said, event, said, "night")) for event in ("paused", "resumed")]
        assert out.read_text().splitlines() == lines

    @pytest.mark.parametrize(
        ("target", "label", "why"),
        [
            ("false s3cret", "false …", "it ended with 1, expected 0"),
            ("/nowhere/notify s3cret", "/nowhere/notify …", "No such file or directory"),
            ("true s3cret", "", ""),
        ],
    )
    def test_reports_failed_command(self, target: str, label: str, why: str) -> None:
        expected = [f"{label} did not receive a notice: {why}; the run continues; check the receiver"] if why else []
        assert notices(target, "paused", "resumed") == expected

    @pytest.mark.slow
    def test_kills_hanging_command_with_children(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run, "LIMIT_S", 0.5)
        numbers = tmp_path / "pids"
        (warning,) = notices(f"sh -c 'sleep 600 & echo $$ $! > {numbers}; wait'")
        assert "within 0.5 s" in warning
        for number in numbers.read_text().split():
            # The process is gone, or a zombie.
            stat, until = Path(f"/proc/{number}/stat"), time.monotonic() + 10
            while stat.exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX":
                assert time.monotonic() < until


@pytest.mark.slow
def test_notices_never_block() -> None:
    with served(Receiver(hangs=threading.Event())) as receiver:
        told_by = Notices(f"http://127.0.0.1:{receiver.port}/", "night")
        for number in range(3 * run.QUEUED):
            told_by.send(f"event {number}", "", AT)
        assert len(receiver.got) <= 1
        assert receiver.hangs is not None
        receiver.hangs.set()
        told_by.close()
        assert len(receiver.got) <= run.QUEUED + 2


class Manager:
    """Receives datagrams as systemd does."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address.replace("@", "\0", 1) if address.startswith("@") else address)
        self.socket.setblocking(False)

    def got(self) -> list[str]:
        texts: list[str] = []
        while True:
            try:
                texts.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return texts


@pytest.fixture(params=["path", "abstract"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "notify") if request.param == "path" else f"@crop-test-{os.getpid()}"


@pytest.fixture
def manager(address: str) -> Generator[Manager]:
    one = Manager(address)
    with one.socket:
        yield one


def life(address: str, clock: SimulatedClock, **more: str) -> Life:
    return Life("", "night", lambda sentence: None, clock, {"NOTIFY_SOCKET": address, **more})


def test_feeds_watchdog_in_time(manager: Manager, address: str) -> None:
    clock = SimulatedClock()
    one = life(address, clock, WATCHDOG_USEC="60000000")
    one.ready()
    assert manager.got() == ["READY=1", "WATCHDOG=1\nSTATUS=running"]
    fed: list[float] = [0.0]
    for _ in range(60):
        clock.sleep(5)
        one.sign("frame\n3")
        fed += [clock.monotonic()] * len(manager.got())
    assert max(later - earlier for earlier, later in pairwise(fed)) <= 30
    assert len(fed) <= 21
    one.end("complete", "0 of 6 frames left")
    assert manager.got() == ["STOPPING=1\nSTATUS=complete: 0 of 6 frames left"]


def test_notifies_service_manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = Manager(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    lab = Lab(tmp_path / "session")
    with manager.socket:
        assert take_session(lab.session, lab.devices, SETTINGS).complete
        got = manager.got()
    assert got[0] == "READY=1"
    assert len([text for text in got if text.startswith("WATCHDOG=1")]) >= 6, "each frame is a sign"
    assert got[-1].startswith("STOPPING=1\nSTATUS=complete")


def covered_lab(folder: Path) -> Lab:
    """Return a lab whose run pauses once."""
    lab = Lab(folder)
    lab.screen.fails = dict.fromkeys(range(2, 40), DeviceError("a screen saver covers the picture"))
    return lab


@pytest.mark.slow
def test_notes_unreachable_target(tmp_path: Path) -> None:
    gone = str(tmp_path / "gone")
    sequence = SETTINGS.sequence.model_copy(update={"notify": f"{gone} s3cret"})
    settings = SETTINGS.model_copy(update={"sequence": sequence, "notify": NotifySettings(alive=f"{gone} s3cret")})
    lab = covered_lab(tmp_path / "session")
    assert take_session(lab.session, lab.devices, settings).complete
    events = lab.session.journal.events()
    doubts = [event.detail for event in events if event.what == "doubt"]
    assert sorted(doubt.partition(":")[0] for doubt in doubts) == ["notify.alive", "sequence.notify"], "once a cause"
    assert all(gone in doubt and "s3cret" not in doubt for doubt in doubts)


@pytest.mark.slow
def test_signals_dead_mans_switch(tmp_path: Path) -> None:
    heard = tmp_path / "heard"
    program = f"import sys; open({str(heard)!r}, 'a').write(sys.stdin.read() + chr(10))"
    target = shlex.join([sys.executable, "-S", "-c", program])
    settings = SETTINGS.model_copy(update={"notify": NotifySettings(alive=target)})
    lab = covered_lab(tmp_path / "session")
    assert take_session(lab.session, lab.devices, settings).complete
    notices: list[dict[str, Any]] = [json.loads(line) for line in heard.read_text().splitlines()]
    assert [one["event"] for one in notices] == ["alive"] * (len(notices) - 1) + ["complete"]
    assert 2 <= len(notices) - 1 <= lab.clock.monotonic() / ALIVE_S + 1
    assert any("screen saver" in one["message"] for one in notices), "a run that waits is alive"


NOW = datetime(2026, 1, 1, 23, 30, tzinfo=UTC)


def last_words(block: Callable[[SignOfLife], None]) -> list[tuple[str, str]]:
    said: list[tuple[str, str]] = []
    signs = signs_of_life(lambda state, sentence, until: said.append((state, sentence)), lambda: None, 60.0)
    with contextlib.suppress(BaseException), signs as alive:
        block(alive)
    return said


def test_complete_run_gives_no_cause() -> None:
    assert last_words(lambda alive: alive("")) == [
        ("waiting", STARTING),
        ("running", "frames are taken"),
        ("ended", ""),
    ]


def test_reports_cause_of_end() -> None:
    def interrupted(alive: SignOfLife) -> None:
        raise KeyboardInterrupt

    def unplugged(alive: SignOfLife) -> None:
        raise DeviceError("the camera is gone; find it")

    def mistaken(alive: SignOfLife) -> None:
        raise ZeroDivisionError

    assert last_words(interrupted)[-1] == ("ended", "interrupted; run the same command again")
    assert last_words(unplugged)[-1] == ("ended", "the camera is gone; find it")
    assert last_words(mistaken)[-1][0] == "ended"
    assert "error in the program" in last_words(mistaken)[-1][1]


def test_first_frame_ends_wait(tmp_path: Path) -> None:
    Journal.create(tmp_path / "journal.sqlite", ())
    with closing(Journal.open_for_run(tmp_path / "journal.sqlite")) as journal:
        with signs_of_life(journal.beat, journal.run_state, 60.0) as alive:
            journal.beat("waiting", "the lamp warms up", NOW)
            alive("")
            last = journal.heartbeat()
            assert last is not None
            assert last.state == "running"
        last = journal.heartbeat()
        assert last is not None
        assert last.state == "ended"


STEP = SessionStep(7, "light", 5, Colour(1, 2, 3))


def test_estimates_time_without_pauses(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(run, "PLAIN_S", 0.0)
    now = [0.0]
    with Terminal(lambda: now[0]) as terminal:

        def left(*frames_s: float, reason: str = "") -> str:
            """Return the text for ten remaining frames after frames of the given durations."""
            for seconds in frames_s:
                now[0] += seconds
                terminal.show_frame(Taken(STEP, Judgement((Check("file", reason=reason),)), 10))
            terminal.progress(0, 10)
            return capsys.readouterr().err

        assert "left" not in left(0)
        assert "left 20 s" in left(2, 2, 3)
        terminal.state("paused")
        assert "left 20 s" in left(600, 2)
        # Each frame has recently needed two attempts, as on the page.
        assert "left 40 s" in left(*[2] * 6, reason="too dark")


def test_prints_lines_into_file(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with Terminal(lambda: now[0]) as terminal:
        terminal.progress(0, 200)
        for done in range(1, 201):
            now[0] += 2.0
            checks = Check("movement", 0.031, None, 0.2, "px"), Check("off_codes_deg", 0.7, None, 0.5, "°")
            terminal.show_frame(Taken(STEP, Judgement(checks), 200 - done))
            terminal.progress(done, 200)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 + int(400 // PLAIN_S) + 1
    assert "0 of 200 frames" in lines[0]
    numbers = "off_codes_deg 0.7° (beyond its limit), movement 0.031 px"
    assert f"90 of 200 frames, left 3 min 40 s, illuminant 5 accepted, {numbers}" in lines[6]
    assert "200 of 200 frames, illuminant 5 accepted" in lines[-1]
    assert "━" not in "".join(lines)


class FullOutput(io.StringIO):
    """An output whose disk is full."""

    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_survives_full_disk_of_log(monkeypatch: pytest.MonkeyPatch) -> None:
    with Terminal() as terminal:
        monkeypatch.setattr("sys.stderr", FullOutput())
        terminal.announce("refused: light 5: too dark")
        terminal.progress(0, 2)
