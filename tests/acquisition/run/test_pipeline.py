"""Order of frames with scripted devices: timing, refusals, voids, faults, and the end."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from acquisition.run.devices import PAUSE_S
from acquisition.run.pipeline import StepQueue, Taken, missing_references
from acquisition.run.run import RunOutcome, take_session
from drivers.presenter import BLACK, WHITE, Colour
from drivers.projector import Power
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.journal import IncomingFile, Journal
from experiment.session.records import Check, FrameKind, Judgement, SessionStep, link_steps, plan_steps
from foundation.console import EndRequest
from foundation.errors import DeviceError, DeviceFault, LinkTimeout, QualityError, StorageError
from tests.acquisition.run.scripted import DOWNLOAD_S, EXPOSE_S, GLARE, LIGHTS, NIGHT, SETTINGS, TURNED, WELL, Lab

SETTLE_S = SETTINGS.sequence.settle_s
# Each try in a pause costs rows on a disk; a minute has enough of them.
PATIENT = SETTINGS.model_copy(update={"sequence": SETTINGS.sequence.model_copy(update={"patience_s": 60.0})})
FOUR = tuple(Illuminant(n, "uniform", None, Colour(255, 40 * n, 0)) for n in range(4))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


class ScriptedJudge:
    """Accepts every frame but those that the script lists by their number, from 0, in the order of judging."""

    def __init__(self, script: dict[int, Judgement] | None = None) -> None:
        self.script = script or {}
        self.judged: list[SessionStep] = []
        self.recalled: list[tuple[int, bytes, bool]] = []

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        assert file.is_file(), "a frame is judged when it is whole on the disk"
        self.judged.append(step)
        number = len(self.judged) - 1
        return self.script.get(number, Judgement((Check("light", 1.0, 0.0, 2.0, "°"),), measurement=b"%d" % number))

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        self.recalled.append((step.number, measurement, accepted))


def refused(reason: str, *, voids: bool = False, lasting: bool = False) -> Judgement:
    return Judgement((Check("light", 9.0, 0.0, 2.0, "°", reason),), measurement=b"bad", voids=voids, lasting=lasting)


@pytest.mark.slow
@pytest.mark.parametrize(("percent", "doubted"), [(0.4, False), (0.6, True)])
def test_doubts_room_light_once(folder: Path, percent: float, doubted: bool) -> None:
    class Lit(ScriptedJudge):
        def judge(self, file: Path, step: SessionStep) -> Judgement:
            known = super().judge(file, step)
            return Judgement((Check("leak_share", percent, None, 2.5, "%"),)) if step.kind == "dark" else known

    lab = Lab(folder, lights=FOUR, reference_every=2)
    judge = Lit()
    outcome = run(lab, judge)
    assert outcome.complete
    assert sum(step.kind == "dark" for step in judge.judged) > 1
    assert len(outcome.doubts) == doubted
    assert all(f"{percent} % of white" in doubt for doubt in outcome.doubts)


def run(lab: Lab, judge: ScriptedJudge | None = None, **more: Any) -> RunOutcome:
    return take_session(lab.session, lab.devices, PATIENT, judge, **more)


class TestTime:
    def test_shows_every_illuminant_once(self, folder: Path) -> None:
        lab = Lab(folder)
        assert run(lab).complete
        assert lab.camera.exposed == [WHITE, BLACK, LIGHTS[0].colour, LIGHTS[1].colour, WHITE, BLACK]
        assert lab.screen.shown == [*lab.camera.exposed, BLACK], "and black in the end"
        assert lab.projector.power() is Power.COOLING, "a complete session switches the lamp off"
        assert lab.verdicts() == ["accepted"] * 6

    def test_leaves_lamp_as_configured_after_incomplete_run(self, folder: Path) -> None:
        class NotThatLight(ScriptedJudge):
            def judge(self, file: Path, step: SessionStep) -> Judgement:
                return refused("somebody passes each time") if step.number == 3 else super().judge(file, step)

        lab = Lab(folder)
        sequence = PATIENT.sequence.model_copy(update={"lamp_if_unfinished": "on"})
        left_on = PATIENT.model_copy(update={"sequence": sequence})
        assert not take_session(lab.session, lab.devices, left_on, NotThatLight()).complete
        assert lab.projector.power() is Power.ON

    def test_exposes_after_settling(self, folder: Path) -> None:
        lab = Lab(folder, {1: NIGHT, 3: NIGHT})
        shown: list[float] = []
        show = lab.screen.show
        expose = lab.camera.expose
        settled: list[float] = []

        def showing(colour: Colour) -> None:
            show(colour)
            shown.append(lab.clock.monotonic())

        def exposing() -> Any:
            settled.append(lab.clock.monotonic() - shown[-1])
            return expose()

        lab.screen.show = showing  # type: ignore[method-assign]
        lab.camera.expose = exposing  # type: ignore[method-assign]
        assert run(lab).complete
        assert min(settled) >= SETTLE_S - 1e-9

    def test_records_timings(self, folder: Path) -> None:
        lab = Lab(folder)
        run(lab)
        timings = {number: known.timings for number, known in lab.session.journal.details().items()}
        assert len(timings) == 6
        for attempt in timings.values():
            assert set(attempt) == {"show", "settle", "expose", "download", "save", "judge", "waited"}
            assert attempt["expose"] == pytest.approx(EXPOSE_S)
            assert attempt["download"] == pytest.approx(DOWNLOAD_S)
        second = timings[min(timings) + 1]
        assert second["settle"] == pytest.approx(SETTLE_S - DOWNLOAD_S), "what is left of it after the download"


class TestRefusals:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("bad", "reason"),
        [(NIGHT, "the projector is on"), (GLARE, "clipped"), (TURNED, "0.4 instead of 0.5"), (b"garbage", "raw")],
    )
    def test_repeats_refused_frame(self, folder: Path, bad: bytes, reason: str) -> None:
        lab = Lab(folder, {2: bad})
        assert run(lab).complete
        frames = [frame for frame in lab.session.frames() if not frame.accepted]
        assert len(frames) == 1
        assert reason in frames[0].verdict
        assert (folder / frames[0].file).read_bytes() == bad
        assert len(lab.session.frames()) == 7

    @pytest.mark.slow
    def test_looks_for_lost_files(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        look = Mock(return_value=[])
        monkeypatch.setattr(Session, "lost_files", look)
        assert run(Lab(folder, lights=FOUR, reference_every=2)).complete
        assert look.call_count == 3 + 1

    def test_refuses_covered_screen_without_judging(self, folder: Path) -> None:
        lab = Lab(folder)
        lab.screen.covered = {0}
        judge = ScriptedJudge()
        assert run(lab, judge).complete
        first, *rest = lab.session.frames()
        assert first.verdict == "refused: a window of Notes covers the picture; close it"
        assert all(frame.accepted for frame in rest)
        assert len(judge.judged) == len(rest)

    def test_voids_frames_since_good_reference(self, folder: Path) -> None:
        lab = Lab(folder, lights=FOUR, reference_every=2)
        # w0 d1 l2 l3 w4: the picture has been stuck since light 2.
        judge = ScriptedJudge({4: refused("the picture is stuck", voids=True)})
        left: list[int] = []

        def count(taken: Taken) -> None:
            left.append(taken.remaining)

        assert run(lab, judge, observe=count).complete
        assert left[:5] == [9, 8, 7, 6, 8], "what was voided is left again"
        assert left[-1] == 0
        assert [step for step, _ in lab.taken()] == [
            *("w0", "d1", "l2", "l3", "w4", "d5"),
            *("w4", "l2", "l3", "d5", "l6", "l7", "w8", "d9"),
        ]
        voided = [step for step, verdict in lab.taken() if verdict == "voided"]
        assert voided == ["l2", "l3", "d5"], "and what was under way, but not the dark frame beside the good white"
        accepted = [attempt.step for attempt in lab.session.journal.attempts() if attempt.verdict == "accepted"]
        assert sorted(accepted) == list(range(10)), "each step once"

    @pytest.mark.slow
    def test_ends_after_patience_with_bad_reference(self, folder: Path) -> None:
        class NoWhite(ScriptedJudge):
            def judge(self, file: Path, step: SessionStep) -> Judgement:
                seen = super().judge(file, step)
                return refused("white is 21 % weaker", voids=True) if step.number in (4, 8) else seen

        lab = Lab(folder, lights=FOUR, reference_every=2)
        with pytest.raises(QualityError, match="21 % weaker"):
            run(lab, NoWhite())
        assert len(lab.taken()) < 40, "lights are not taken again and again meanwhile"
        assert run(lab, ScriptedJudge()).complete

    @pytest.mark.slow
    def test_response_frame_voids_frames_of_run(self, folder: Path) -> None:
        lab = Lab(folder, lights=FOUR, reference_every=2)
        ending = EndRequest(lambda sentence: None)

        def end_after(frames: int) -> Callable[[object], None]:
            left = iter(range(frames - 1))
            return lambda taken: None if next(left, None) is not None else ending.request()

        with pytest.raises(KeyboardInterrupt):
            run(lab, ScriptedJudge(), ending=ending, observe=end_after(3))
        before = len(lab.taken())
        ties = link_steps(lab.session.steps[-1].number + 1)
        lab.session.add_steps(ties)
        judge = ScriptedJudge({3: refused("somebody passed", voids=True)})
        assert run(lab, judge, first=tuple(step.number for step in ties)).complete
        names = [f"{step.kind[0]}{step.number}" for step in ties]
        taken = [step for step, _ in lab.taken()][before:]
        assert taken[:4] == names[:4]
        assert taken[5:11] == names, "before the lights, behind the one that was under way"
        accepted = [attempt.step for attempt in lab.session.journal.attempts() if attempt.verdict == "accepted"]
        assert sorted(accepted) == list(range(16)), "each step once, and no light of the earlier run is voided"
        assert lab.verdicts()[:before] == ["accepted"] * before

    @pytest.mark.slow
    def test_ends_after_patience_with_lasting_cause(self, folder: Path) -> None:
        lab = Lab(folder, dict.fromkeys(range(1000), NIGHT))
        start_next = lab.clock.monotonic()
        with pytest.raises(QualityError):
            run(lab)
        assert lab.clock.monotonic() - start_next >= PATIENT.sequence.patience_s
        assert len(lab.session.frames()) < 40, "a pause does not fill the disk"
        lab.camera.script = {}
        assert run(lab).complete


class TestFaults:
    def test_repeats_download(self, folder: Path) -> None:
        lab = Lab(folder)
        lab.camera.downloads = {2: LinkTimeout("the cable")}
        assert run(lab).complete
        assert lab.verdicts() == ["accepted"] * 6
        assert lab.camera.captures == 6

    def test_exposes_lost_frame_again(self, folder: Path) -> None:
        lab = Lab(folder)
        download, calls = lab.camera.download, 0

        def lost(into: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == 3:
                lab.camera.held = None
            return download(into)

        lab.camera.download = lost  # type: ignore[method-assign]
        assert run(lab).complete
        assert lab.verdicts().count("failed") == 1
        assert "holds no frame" in next(a.reason for a in lab.session.journal.attempts() if a.verdict == "failed")

    def test_detects_truncated_transfer(self, folder: Path) -> None:
        lab = Lab(folder)
        lab.camera.claims = len(WELL) + 1
        said: list[str] = []
        assert run(lab, announce=said.append).complete
        assert "bytes" in said[0]
        assert all(len(path.read_bytes()) in (len(WELL), len(NIGHT)) for path in (folder / "frames").iterdir())

    def test_ends_if_camera_never_delivers(self, folder: Path) -> None:
        lab = Lab(folder)

        def never(into: Any) -> Any:
            lab.camera.held = None
            raise DeviceError("the card cannot be read")

        lab.camera.download = never  # type: ignore[method-assign]
        with pytest.raises(DeviceError):
            run(lab)
        assert lab.clock.monotonic() < 2 * PATIENT.sequence.patience_s

    def test_waits_for_screen_without_losing_frames(self, folder: Path) -> None:
        lab = Lab(folder)
        lab.screen.fails = dict.fromkeys(range(2, 6), DeviceError("a screen saver covers the picture"))
        said: list[str] = []
        assert run(lab, announce=said.append).complete
        assert [sentence.split(":")[0] for sentence in said] == ["retry", "paused", "resumed", "lamp"]
        assert lab.verdicts() == ["accepted"] * 6

    @pytest.mark.slow
    @pytest.mark.parametrize("place", ["download", "save", "commit", "begin", "fail"])
    def test_waits_for_full_disk(self, folder: Path, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
        lab = Lab(folder, {3: DeviceError("lost")})
        full = failing(StorageError("No space left on device"), calls=range(2, 5))
        if place == "download":
            monkeypatch.setattr("acquisition.run.pipeline.IncomingFile", full(IncomingFile))
        elif place == "save":
            monkeypatch.setattr(IncomingFile, "complete", full(IncomingFile.complete, IncomingFile.abandon))
        else:
            if place == "fail":
                full = failing(StorageError("No space left on device"), calls=range(3))
            monkeypatch.setattr(Journal, place, full(getattr(Journal, place)))
        said: list[str] = []
        assert run(lab, announce=said.append).complete
        assert any("No space left" in sentence for sentence in said)
        accepted = [attempt.step for attempt in lab.session.journal.attempts() if attempt.verdict == "accepted"]
        assert sorted(accepted) == list(range(6)), "each step once"
        if place in ("download", "commit", "begin", "fail"):
            assert lab.camera.captures == 7, "the frame in the camera was not lost"

    def test_keeps_first_of_two_faults(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        lab = Lab(folder)
        commits = 0

        def broken(*given: Any, **named: Any) -> None:
            nonlocal commits
            commits += 1
            raise (RuntimeError if commits == 1 else StorageError)(f"fault {commits}")

        monkeypatch.setattr(Journal, "commit", broken)
        quick = SETTINGS.model_copy(update={"sequence": SETTINGS.sequence.model_copy(update={"patience_s": 0.0})})
        with pytest.raises(RuntimeError, match="fault 1") as raised:
            take_session(lab.session, lab.devices, quick)
        assert raised.value.__notes__ == ["then: fault 2"]

    @pytest.mark.slow
    def test_ends_after_patience_with_failed_lamp(self, folder: Path) -> None:
        from drivers.projector import Severity

        lab = Lab(folder)
        lab.camera.after[3] = lambda: lab.projector.break_part("lamp", Severity.ERROR)
        with pytest.raises(DeviceFault):
            run(lab)
        assert lab.clock.monotonic() >= PATIENT.sequence.patience_s
        lab.projector.repair()
        lab.projector.switch_on()
        assert run(lab).complete


def failing(error: Exception, calls: Iterable[int]) -> Callable[..., Callable[..., Any]]:
    """Return a decorator that raises `error` in the calls with these numbers, from 0, after a clearing up."""
    bad = set(calls)
    count = 0

    def decorate(real: Callable[..., Any], clear: Callable[..., Any] | None = None) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            nonlocal count
            count += 1
            if count - 1 in bad:
                if clear is not None:
                    clear(given[0])
                raise error
            return real(*given, **named)

        return call

    return decorate


class TestEnding:
    def test_first_request_ends_after_current_frame(self, folder: Path) -> None:
        lab = Lab(folder)
        said: list[str] = []
        ending = EndRequest(said.append)
        lab.camera.after[3] = ending.request
        with pytest.raises(KeyboardInterrupt):
            run(lab, ending=ending)
        assert said == ["ending after this frame; press Ctrl-C again to end at once"]
        assert lab.verdicts() == ["accepted"] * 3, "what was exposed is downloaded, saved, judged, in the journal"
        assert (folder / "frames.csv").read_text().count("accepted") == 3
        assert lab.projector.power() is Power.ON, "somebody is there, and may go on at once"
        assert run(lab).complete
        assert lab.verdicts() == ["accepted"] * 6

    def test_request_during_settling_exposes_no_frame(self, folder: Path) -> None:
        lab = Lab(folder)
        ending = EndRequest(lambda sentence: None)
        sleep = lab.clock.sleep

        def sleeping(seconds: float) -> None:
            sleep(seconds)
            if lab.camera.captures == 2 and seconds < SETTLE_S - DOWNLOAD_S + 1e-6 and not ending.is_requested:
                ending.request()

        lab.clock.sleep = sleeping  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            run(lab, ending=ending)
        assert lab.camera.captures == 2
        assert lab.verdicts() == ["accepted"] * 2

    def test_second_request_ends_at_once_without_loss(self, folder: Path) -> None:
        lab = Lab(folder)
        ending = EndRequest(lambda sentence: None)
        download = lab.camera.download

        def asked(into: Any) -> Any:
            captured = download(into)
            if lab.camera.captures == 3:
                ending.request()
                ending.request()
            return captured

        lab.camera.download = asked  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            run(lab, ending=ending)
        assert lab.verdicts() == ["accepted", "accepted", None]
        assert [event.what for event in lab.session.journal.events()][-1] == "interrupted"
        assert not [path for path in (folder / "frames").iterdir() if path.name.startswith(".")]
        assert run(lab).complete

    def test_request_ends_pause(self, folder: Path) -> None:
        lab = Lab(folder, dict.fromkeys(range(2, 1000), LinkTimeout("no answer")))
        ending = EndRequest(lambda sentence: None)
        sleep = lab.clock.sleep

        def sleeping(seconds: float) -> None:
            if seconds == PAUSE_S:
                ending.request()
            sleep(seconds)

        lab.clock.sleep = sleeping  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            run(lab, ending=ending)
        assert lab.clock.monotonic() < 60


STEPS = plan_steps([Illuminant(n, "uniform", None, Colour(255, n, 0)) for n in range(4)], 2)
"""white 0, dark 1, light 2, 3, white 4, dark 5, light 6, 7, white 8, dark 9."""


def queue_of(done_numbers: Collection[int], attempts: int = 3, **options: Any) -> StepQueue:
    """Return a queue of `STEPS` that appends closing references from number 10 on."""
    appended: list[SessionStep] = []

    def append(kind: FrameKind) -> SessionStep:
        appended.append(SessionStep(len(STEPS) + len(appended), kind, None, WHITE if kind == "white" else BLACK))
        return appended[-1]

    return StepQueue(STEPS, done_numbers, attempts, append=append, **options)


def take(queue: StepQueue, refused: dict[int, int] | None = None) -> list[int]:
    """Take all steps in order and return their numbers; `refused` maps steps to their numbers of refusals."""
    refusals, numbers = dict(refused or {}), list[int]()
    while (step := queue.next()) is not None:
        queue.begin(step)
        numbers.append(step.number)
        if refusals.get(step.number, 0):
            refusals[step.number] -= 1
            queue.refuse(step, "dark")
        else:
            queue.accept(step)
    return numbers


def start_next(queue: StepQueue) -> SessionStep:
    """Start the next step and return it."""
    step = queue.next()
    assert step is not None
    queue.begin(step)
    return step


def test_closes_illuminants_of_earlier_run() -> None:
    assert missing_references(["white", "dark", "light", "white", "dark"]) == frozenset()
    unclosed = missing_references(["white", "dark", "white", "dark", "light"])
    queue = queue_of({step.number for step in STEPS} - {1}, unclosed=unclosed)
    assert take(queue) == [1, 10], "the dark frame that is open closes them as well"


def test_kill_leaves_closing_references_open() -> None:
    queue = queue_of({step.number for step in STEPS} - {6})
    queue.accept(start_next(queue))
    assert len(queue) == 2, "the white and the dark frame are in the plan before the light is accepted"


def test_adds_references_between_repeated_illuminants() -> None:
    queue = queue_of({0, 1, 4, 5, 8, 9}, reference_every=2)
    assert take(queue) == [2, 3, 12, 13, 6, 7, 10, 11], "a refused one voids two of them at most"
    whole = queue_of(set(), reference_every=2)
    assert take(whole) == list(range(10)), "the plan has its own"
    ahead = queue_of(set(), reference_every=2)
    before, order = start_next(ahead), [0]
    while (step := ahead.next()) is not None or len(ahead):
        if step is not None:
            ahead.begin(step)
            order.append(step.number)
        ahead.accept(before)
        before = step or before
    assert order == list(range(10)), "also while the verdict on one of them is awaited"


@pytest.mark.parametrize(("kind", "stuck"), [("dark", True), ("white", False)])
def test_dark_frame_is_no_evidence(kind: str, stuck: bool) -> None:
    queue = queue_of({0, 1, 2, 3, 6, 7, 8, 9}, 1)
    steps = {step.kind: step for step in (start_next(queue), start_next(queue))}
    for step in STEPS[2:4]:
        queue.void([step.number], "")
        queue.begin(step)
        queue.refuse(step, "dark")
    good, other = (steps["dark"], steps["white"]) if kind == "dark" else (steps["white"], steps["dark"])
    queue.accept(good)
    queue.refuse(other, "dark")
    assert queue.is_stuck == stuck
