"""Take the frames of a run in overlapping steps.

While a frame is downloaded, the next illuminant settles on the screen. While a frame is judged, the next frame is
exposed (docs/explanation/steps.md). `StepQueue` selects the next frame, and `Pipeline` operates the devices. `Verdicts`
records verdicts and their consequences for other frames. A refused reference (white or dark frame) may void other
frames. `LastingCause` waits if every frame would be refused. A second
thread saves and judges files. It uses neither the devices nor the journal, so rows are committed in the order of
exposure.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from typing import TypeVar

from acquisition.judge.limits import ROOM_LIGHT_PERCENT
from acquisition.run.devices import (
    FRAMES,
    GAP_S,
    Devices,
    HealthWatch,
    Pause,
    RetryPolicy,
    RunWatch,
    await_health,
    is_curable,
)
from calibration.figures.light import LEAK_SHARE, OFF_BRIGHTNESS
from drivers.presenter import Colour, ReadsBack
from experiment.config import JudgeSettings, LabSettings
from experiment.session.folder import Session
from experiment.session.journal import IncomingFile, ReceivedFile
from experiment.session.records import (
    ACCEPTED,
    DOUBT,
    REFERENCES,
    Attempt,
    Check,
    FrameJudge,
    FrameKind,
    HandlesPauses,
    Judgement,
    SessionStep,
    duration_text,
    link_steps,
    preview_path,
)
from foundation.clock import SteadyClock
from foundation.console import EndRequest
from foundation.errors import RUN_AGAIN, CropError, DeviceError, QualityError, StorageError, counted, first_few
from foundation.files import write_atomic

# Number of frames that may wait for their verdicts when the next frame is exposed. One is enough, because a verdict
# takes less time than an exposure. After a refusal, more frames would have to be repeated.
AHEAD = 1

# Number of tries to download a frame before it is exposed again.
DOWNLOADS = 2

# Expected durations of steps before they are measured, s. An exposure lasts `RELEASE_S` and twice the shutter time.
COMMIT_S, SHOW_S, RELEASE_S, JUDGE_S, DOWNLOAD_S = 1.0, 2.0, 3.0, 5.0, 10.0

PROMISE = "ending after this frame; press Ctrl-C again to end at once"  # Answer to a request to end the run

_CAMERA, _SCREEN, _DISK = "the camera", "the screen", "the disk"

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Job:
    """Objects that a run needs for its frames."""

    session: Session
    devices: Devices
    settings: LabSettings
    queue: StepQueue
    judge: FrameJudge
    retry: RetryPolicy
    watch: RunWatch

    def on_disk(self, action: Callable[[], _Result]) -> _Result:
        """Return the result of `action`; wait while the disk is full or missing."""

        def watched() -> _Result:
            with self.watch.step(_DISK, "stores a row of the journal", COMMIT_S, "commit"):
                return action()

        return self.retry.attempt(watched, _DISK)


@dataclass(frozen=True)
class Taken:
    """A judged frame. `remaining`: number of steps of the plan without an accepted frame."""

    step: SessionStep
    judgement: Judgement
    remaining: int


@dataclass(frozen=True)
class ShownLight:
    """A step whose colour is on the screen since `since` (clock, s). Showing it took `show_s`.

    `replaced`: colour that was shown before; None if there was none.
    """

    step: SessionStep
    shown_at: datetime
    since: float
    show_s: float
    replaced: Colour | None


@dataclass(frozen=True)
class Exposed:
    """An exposed frame, with the checks of the devices.

    `number`: number of the attempt in the journal. `stem`: name of its file without suffix. `changed`: whether the
    colour differs from the colours that were shown and exposed before. Only then is a late or frozen picture detected.
    """

    step: SessionStep
    number: int
    stem: str
    over_at: datetime
    checks: tuple[Check, ...]
    timings: Mapping[str, float]
    changed: bool


@dataclass(frozen=True)
class Saved:
    """A complete raw file and its verdict.

    - `save_s`, `judge_s`: durations of saving and of judging the file, s, by the clock of the computer.
    - `preview_fault`: the reason for a missing preview; "" if there was no fault.
    """

    received: ReceivedFile
    judgement: Judgement
    save_s: float
    judge_s: float
    preview_fault: str = ""


class Pipeline:
    """Operates the devices. `saving`: thread that saves and judges files, one after another."""

    def __init__(
        self, job: Job, saving: ThreadPoolExecutor, observe: Callable[[Taken], object], ending: EndRequest
    ) -> None:
        self._job, self._saving, self._observe, self._ending = job, saving, observe, ending
        self._lasting = LastingCause(job)
        self._verdicts = Verdicts(job, self._lasting)
        projector = job.devices.projector
        self._health = None if projector is None else HealthWatch(projector, job.devices.clock)
        self._under_way: deque[tuple[Exposed, Future[Saved]]] = deque()
        self._pauses: dict[str, Pause] = {}
        self._shown: Colour | None = None
        self._exposed: Colour | None = None

    def run(self) -> None:
        """Take frames until the queue is empty or the end is requested.

        Frames that the camera has delivered are always saved, judged and recorded, also after an error.
        """
        try:
            with self._ending.postponed(PROMISE):
                light = self._next_light()
                while light is not None:
                    light = self._take(light)
        except BaseException as error:
            self._salvage(error)
            raise

    def _next_light(self) -> ShownLight | None:
        """Show the next illuminant; None if no frame is left. If necessary, wait for verdicts first."""
        while not self._ending.is_requested:
            if self._verdicts.is_budget_spent:
                self._collect(0)
                self._verdicts.require_budget()
            if self._lasting.must_wait:
                self._collect(0)
                self._lasting.wait()
            step = self._job.queue.next()
            if step is not None:
                return self._job.retry.attempt(partial(self._show, step), _SCREEN)
            if not self._under_way and not self._verdicts.void_lost():
                self._lasting.over()
                return None
            self._collect(0)
        self._collect(0)
        return None

    def _take(self, light: ShownLight) -> ShownLight | None:
        settling_s = self._settle(light)
        if self._ending.is_requested:
            return self._next_light()
        frame = self._expose(light, settling_s)
        if frame is None:
            return self._next_light()
        # Take one frame at a time while frames test whether a lasting cause has been removed.
        ahead = 0 if self._lasting.is_testing else AHEAD
        following = self._show_following() if ahead else None
        frame = replace(frame, checks=(*frame.checks, *self._projector_check(frame.step)))
        self._hand_over(frame)
        self._collect(ahead)
        if not all(check.passed for check in frame.checks):
            # The projector must be healthy before the next frame.
            self._collect(0)
            if self._job.devices.projector is not None:
                with self._ending.at_once():
                    await_health(self._job.devices.projector, self._job.settings.sequence, self._job.retry)
        elif following is not None and not self._lasting.must_wait and self._job.queue.next() == following.step:
            return following
        return self._next_light()

    def _show(self, step: SessionStep) -> ShownLight:
        clock = self._job.devices.clock
        shown_at, start_s = clock.now(), clock.monotonic()
        with self._job.watch.step(_SCREEN, f"shows {step_name(step)}", SHOW_S, "show"):
            self._job.devices.presenter.show(step.colour)
        since = clock.monotonic()
        replaced, self._shown = self._shown, step.colour
        return ShownLight(step, shown_at, since, since - start_s, replaced)

    def _show_following(self) -> ShownLight | None:
        # A fault of the screen is handled later, when no frame is left in the camera.
        step = None if self._ending.is_requested else self._job.queue.next()
        if step is None:
            return None
        try:
            return self._show(step)
        except DeviceError:
            return None

    def _settle(self, light: ShownLight) -> float:
        # The settling time starts when the colour is shown, so it includes downloads and verdicts.
        clock = self._job.devices.clock
        rest = self._job.settings.sequence.settle_s - (clock.monotonic() - light.since)
        if rest > 0:
            clock.sleep(rest)
        return max(rest, 0.0)

    def _expose(self, light: ShownLight, settling_s: float) -> Exposed | None:
        """Expose a frame. If the camera fails, wait for it and return None."""
        clock, step, journal = self._job.devices.clock, light.step, self._job.session.journal
        shutter_s = self._job.settings.camera.shutter_s
        kept_count = journal.kept_files(step)
        stem = step.stem if kept_count == 0 else f"{step.stem}_try{kept_count + 1}"
        # An attempt starts when its colour is shown and ends with its exposure, so attempts do not overlap.
        number = self._job.on_disk(lambda: journal.begin(step, f"frames/{stem}", light.shown_at))
        self._job.queue.begin(step)
        self._note_gap()
        start_s = clock.monotonic()
        changed = step.colour not in (light.replaced, self._exposed)
        self._exposed = step.colour
        try:
            with self._job.watch.step(_CAMERA, f"exposes {step_name(step)}", 2 * shutter_s + RELEASE_S, "expose"):
                self._job.devices.camera.expose()
        except DeviceError as error:
            self._fail_attempt(step, number, error)
            self._pause_for(_CAMERA, error)
            return None
        timings = {"show": light.show_s, "settle": settling_s, "expose": clock.monotonic() - start_s}
        checks = (*self._screen_check(step), *self._gap_check())
        return Exposed(step, number, stem, clock.now(), checks, timings, changed)

    def _note_gap(self) -> float:
        """Report if the program was stopped or the clock was set; return how long the program was stopped, s."""
        clock = self._job.devices.clock
        if isinstance(clock, SteadyClock) and (set_by_s := clock.step_s()):
            change = f"{'ahead' if set_by_s > 0 else 'back'} by {duration_text(abs(set_by_s))}"
            sentence = f"the computer's clock was set {change}; the time of the session continues unchanged"
            self._job.retry.report("clock", sentence)
        if gap_s := self._job.watch.gap_s():
            sentence = f"the run was stopped for {duration_text(gap_s)}: the computer slept, or the process was stopped"
            self._job.retry.report("gap", sentence)
        return gap_s

    def _gap_check(self) -> tuple[Check, ...]:
        # The screen may have shown anything while the program was stopped.
        if not (gap_s := self._note_gap()):
            return ()
        reason = (
            f"the run was stopped for {duration_text(gap_s)} during the exposure, at most {GAP_S:g} s allowed; switch "
            "off sleep mode. The frame is repeated"
        )
        return (Check("gap", gap_s, None, GAP_S, "s", reason),)

    def _screen_check(self, step: SessionStep) -> tuple[Check, ...]:
        presenter = self._job.devices.presenter
        if not isinstance(presenter, ReadsBack):
            return ()
        try:
            with self._job.watch.step(_SCREEN, f"reads back {step_name(step)}", SHOW_S, "verify"):
                presenter.verify(step.colour)
        except DeviceError as error:
            return (Check("screen", reason=str(error)),)
        return (Check("screen"),)

    def _projector_check(self, step: SessionStep) -> tuple[Check, ...]:
        if self._health is None:
            return ()
        with self._job.watch.step("the projector", "is queried for its health", SHOW_S, "health"):
            fault = self._health.fault(thorough=step.kind == "dark")
        return (Check("projector", reason="" if fault is None else str(fault)),)

    def _hand_over(self, frame: Exposed) -> None:
        clock = self._job.devices.clock
        start_s = clock.monotonic()
        try:
            complete = self._fetch(frame)
        except DeviceError as error:
            self._fail_attempt(frame.step, frame.number, error)
            self._pause_for(_CAMERA, error)
            return
        self._clear_pause(_CAMERA)
        frame = replace(frame, timings={**frame.timings, "download": clock.monotonic() - start_s})
        self._under_way.append((frame, self._saving.submit(_save, self._job, complete, frame)))

    def _fetch(self, frame: Exposed) -> Callable[[], ReceivedFile]:
        """Download the frame under a hidden name, if necessary again; return the function that completes the file.

        While the disk is full, the frame stays in the camera.
        """
        download = partial(_download, self._job, frame)
        for _ in range(DOWNLOADS - 1):
            try:
                return self._job.retry.attempt(download, _DISK, curable=_is_disk_fault)
            except DeviceError as error:
                self._job.retry.report("retry", f"{step_name(frame.step)}: {error}")
        return self._job.retry.attempt(download, _DISK, curable=_is_disk_fault)

    def _collect(self, keep: int) -> None:
        """Record the oldest frames with their verdicts until only `keep` frames wait for a verdict."""
        while len(self._under_way) > keep:
            frame, awaited = self._under_way.popleft()
            start_s = time.perf_counter()
            try:
                with self._job.watch.step(_DISK, f"stores {step_name(frame.step)}, which is judged", JUDGE_S, "judge"):
                    saved = awaited.result()
            except (DeviceError, StorageError) as error:
                self._fail_attempt(frame.step, frame.number, error)
                self._pause_for(_DISK, error)
                continue
            self._clear_pause(_DISK)
            timings = {"save": saved.save_s, "judge": saved.judge_s, "waited": time.perf_counter() - start_s}
            frame = replace(frame, timings={**frame.timings, **timings})
            if self._health is not None and not saved.judgement.accepted:
                self._health.suspect()
            self._verdicts.record_verdict(frame, saved, [exposed for exposed, _ in self._under_way])
            self._observe(Taken(frame.step, saved.judgement, len(self._job.queue)))

    def _fail_attempt(self, step: SessionStep, number: int, error: CropError) -> None:
        # The attempt failed because of a device or the disk, so it does not count as a try.
        self._job.queue.withdraw(step)
        self._collect(0)
        moment = self._job.devices.clock.now()
        self._job.on_disk(lambda: self._job.session.journal.fail(number, moment, str(error)))

    def _pause_for(self, name: str, fault: CropError) -> None:
        """Wait for the camera or the disk after a frame was lost. The pause ends when a frame succeeds."""
        self._pauses.setdefault(name, self._job.retry.pause(name, idle=name != _CAMERA)).wait(fault)

    def _clear_pause(self, name: str) -> None:
        if (pause := self._pauses.pop(name, None)) is not None:
            pause.over()

    def _salvage(self, error: BaseException) -> None:
        while self._under_way:
            try:
                self._collect(0)
            except CropError as second_error:
                # The second error must not hide the first error, which ended the run.
                if str(second_error) == str(error):
                    continue
                error.add_note(f"then: {second_error}")


def _is_disk_fault(fault: CropError) -> bool:
    return isinstance(fault, StorageError) and is_curable(fault)


def _download(job: Job, frame: Exposed) -> Callable[[], ReceivedFile]:
    incoming = IncomingFile(job.session.frames_folder / frame.stem)
    try:
        with job.watch.step(_CAMERA, f"sends {step_name(frame.step)} to the disk", DOWNLOAD_S, "download"):
            captured = job.devices.camera.download(incoming.stream)
        size = incoming.stream.seek(0, 2)
        if size != captured.size or size == 0:
            # Check this before the file is completed, because the camera may still have the frame.
            raise DeviceError(
                f"{captured.name}: {size} bytes arrived, expected {captured.size} as announced by the camera"
            )
    except BaseException:
        with incoming:
            raise
    return partial(incoming.complete, captured)


def _save(job: Job, complete: Callable[[], ReceivedFile], frame: Exposed) -> Saved:
    start_s = time.perf_counter()
    received = complete()
    saved = time.perf_counter()
    judgement, preview_fault = Judgement(frame.checks), ""
    if judgement.accepted:
        verdict = job.judge.judge(received.path, frame.step)
        judgement = replace(verdict, checks=(*frame.checks, *verdict.checks), preview=b"")
        if verdict.preview:
            # A missing preview is no reason to refuse a frame.
            try:
                write_atomic(preview_path(job.session.folder, received.path.name), verdict.preview)
            except CropError as error:
                preview_fault = str(error)
    return Saved(received, judgement, saved - start_s, time.perf_counter() - saved, preview_fault)


class Verdicts:
    """Records verdicts in the order of exposure, and their consequences for earlier and later frames."""

    def __init__(self, job: Job, lasting: LastingCause) -> None:
        self._job, self._lasting = job, lasting
        self._voided_ahead: dict[int, str] = {}
        self._lacks_previews = False
        self._last_before = lasting.last_before
        self._unused_bytes = 0
        self._budget_gb = job.settings.sequence.refused_gb

    @property
    def is_budget_spent(self) -> bool:
        """Whether refused and voided frames of this run take more space than allowed."""
        return self._unused_bytes > self._budget_gb * 1e9

    def require_budget(self) -> None:
        """Raise an error if `is_budget_spent`, because so many refused frames have a systematic cause."""
        if self.is_budget_spent:
            raise QualityError(
                f"refused and voided frames of this run take {self._unused_bytes / 1e9:.3g} GB of the disk, at most "
                f"{self._budget_gb:g} GB allowed (sequence.refused_gb); remove the causes, which acquire status lists, "
                f"{RUN_AGAIN}, with a new budget"
            )

    def record_verdict(self, frame: Exposed, saved: Saved, under_way: Sequence[Exposed]) -> None:
        """Record a verdict; `under_way`: later frames without a verdict."""
        job, step, judgement = self._job, frame.step, saved.judgement
        job.on_disk(
            lambda: job.session.journal.commit(
                frame.number,
                saved.received,
                judgement,
                frame.timings,
                exposure_s=job.settings.camera.shutter_s,
                ended_at=frame.over_at,
            )
        )
        if saved.preview_fault and not self._lacks_previews:
            self._lacks_previews = True
            job.retry.report(
                "preview",
                f"{saved.preview_fault}; frames are accepted without previews, and later faults of this kind are not "
                "reported",
            )
        voided = self._voided_ahead.pop(frame.number, "")
        if judgement.accepted and voided:
            job.queue.withdraw(step)
            self._void((frame.number,), voided)
        elif judgement.accepted:
            job.queue.accept(step)
            for event, sentence in _accepted_changes(step, judgement, job.session.steps, job.settings.judge):
                job.retry.report(event, sentence)
            job.retry.accepted()
            self._lasting.accepted(step, frame.changed)
        else:
            self._refuse(step, judgement)
        if judgement.accepted and step.kind == "white":
            self.void_lost()
        if judgement.voids and step.kind in REFERENCES:
            self._void_since_reference(frame, judgement.reason, under_way)
        elif judgement.voids:
            self._void_first_frames(frame, judgement.reason, under_way)
        if voided or not judgement.accepted:
            self._unused_bytes = job.on_disk(lambda: job.session.journal.unused_bytes(self._last_before))

    def void_lost(self) -> bool:
        """Void and repeat accepted frames with deleted or truncated files; return whether there are any."""
        queue, files = self._job.queue, self._job.on_disk(self._job.session.lost_files)
        lost = [frame for frame in files if not queue.is_open(frame.step)]
        if lost:
            reason = f"{first_few([frame.file for frame in lost])}: deleted or truncated during the run"
            queue.void([frame.step for frame in lost], reason)
            self._void([frame.attempt for frame in lost], reason)
        return bool(lost)

    def _refuse(self, step: SessionStep, judgement: Judgement) -> None:
        queue = self._job.queue
        # If a reference voids other frames, it is repeated before them. This shows whether the cause has been removed.
        is_first = judgement.lasting or (judgement.voids and step.kind in REFERENCES)
        is_repeated = queue.refuse(step, judgement.reason, before_others=is_first)
        # Without a good reference, repeated frames would be voided again and again.
        lacks_reference = judgement.voids and not is_repeated
        pauses = judgement.lasting or queue.is_stuck or self._lasting.is_testing or lacks_reference
        follow_up = "repeated after a pause" if pauses else "left for the next run"
        sentence = f"{step_name(step)}: {judgement.reason}"
        self._job.retry.report("refused", f"{sentence} ({'repeated now' if is_repeated else follow_up})")
        if pauses:
            self._lasting.note(sentence, step)

    def _void_since_reference(self, refused: Exposed, cause: str, under_way: Sequence[Exposed]) -> None:
        """Void all frames since the last good reference of this kind, including frames without a verdict.

        References of the other kind that directly follow the good reference stay valid.
        """
        queue, reference_kind = self._job.queue, refused.step.kind
        reason = f"taken between a good reference and {step_name(refused.step)}, which was refused: {cause}"
        since: dict[int, int] = {}
        for attempt in self._job.session.journal.attempts():
            if attempt.verdict == ACCEPTED and attempt.id < refused.number:
                if attempt.kind == reference_kind:
                    since.clear()
                elif since or attempt.kind not in REFERENCES:
                    since[attempt.id] = attempt.step
        queue.void(since.values(), reason)
        if queue.is_stuck:
            self._lasting.note(reason, None)
        self._void(since, reason)
        self._void_ahead(under_way, reason)

    def _void_first_frames(self, refused: Exposed, cause: str, under_way: Sequence[Exposed]) -> None:
        """Void all frames of this run since its last pause for a lasting cause. The judge's model depends on them."""
        reason = f"the first frames contradict {step_name(refused.step)}: {cause}"
        since = {
            attempt.id: attempt.step
            for attempt in self._job.session.journal.attempts()
            if attempt.verdict == ACCEPTED and self._lasting.last_before < attempt.id < refused.number
        }
        self._void(since, reason)
        # The refused frame and frames without a verdict are repeated with them, in the order of the plan.
        numbers = {refused.step.number, *since.values(), *(frame.step.number for frame in under_way)}
        self._job.queue.begin_with(step for step in self._job.session.steps if step.number in numbers)
        self._void_ahead(under_way, reason)

    def _void_ahead(self, under_way: Sequence[Exposed], reason: str) -> None:
        self._voided_ahead.update({frame.number: reason for frame in under_way})

    def _void(self, attempts: Collection[int], reason: str) -> None:
        if not attempts:
            return
        moment = self._job.devices.clock.now()
        self._job.on_disk(lambda: self._job.session.journal.void(tuple(attempts), moment, reason))
        self._job.retry.report("voided", f"{counted(len(attempts), 'frame')} voided and repeated: {reason}")


class LastingCause:
    """A cause for which every frame would be refused. The run waits, and tests at growing intervals if it still exists.

    A late picture has the right colour if the same colour is shown twice in a row. A test therefore needs an accepted
    frame with a changed colour. After this frame, the test ends when an illuminant or all test frames are accepted.

    - `last_before`: newest attempt before the run, or before its last pause for a lasting cause.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self.last_before = max((attempt.id for attempt in job.session.journal.attempts()), default=0)
        self._sentence = ""
        self._step: SessionStep | None = None
        self._testing: Pause | None = None
        self._test_steps: set[int] = set()
        self._has_changed = False

    @property
    def must_wait(self) -> bool:
        """Whether the run must wait before its next frame."""
        return bool(self._sentence)

    @property
    def is_testing(self) -> bool:
        """Whether the next frames test, after a wait, if the cause has been removed."""
        return self._testing is not None

    def note(self, sentence: str, step: SessionStep | None) -> None:
        """Note the cause, and the refused step; None if the cause voided other frames."""
        self._sentence, self._step = sentence, step

    def wait(self) -> None:
        """Wait, so that somebody can remove the cause, then open the steps again."""
        fault, self._sentence = QualityError(self._sentence), ""
        self._testing = self._testing or self._job.retry.pause(FRAMES)
        self._testing.back_off(fault)
        self._job.queue.retry()
        self._test_steps, self._has_changed = set(), False
        if self._step is not None:
            self._test_steps.add(self._step.number)
            if self._step.kind != "dark":
                self._add_linking_frames()

    def accepted(self, step: SessionStep, changed: bool) -> None:
        """Note an accepted frame, which may show that the cause has been removed; `changed`: see `Exposed`.

        A dark frame does not show this, because it is also accepted if no light reaches the chart.
        """
        self._test_steps.discard(step.number)
        self._has_changed |= changed and step.kind != "dark"
        if self._has_changed and (step.kind == "light" or not self._test_steps):
            self.over()

    def over(self) -> None:
        """End the pause."""
        if self._testing is not None:
            self._testing.over()
            self._testing = None

    def _add_linking_frames(self) -> None:
        # Chart, camera or lamp may have changed during the wait, so frames that compare before and after are taken.
        job = self._job
        attempts = job.on_disk(job.session.journal.attempts)
        if any(attempt.kind == "light" and attempt.verdict == ACCEPTED for attempt in attempts):
            numbers = job.on_disk(lambda: link_runs(job.session, job.devices.clock.now()))
            job.queue.begin_with(step for step in job.session.steps if step.number in numbers)
            self._test_steps.update(numbers)
        self.last_before = attempts[-1].id
        # This call is allowed here, because all files were judged before the wait.
        if isinstance(job.judge, HandlesPauses):
            job.judge.after_pause()


def _accepted_changes(
    step: SessionStep, judgement: Judgement, steps: Sequence[SessionStep], judge: JudgeSettings
) -> list[tuple[str, str]]:
    """Return events with sentences about accepted changes of position and brightness, and about stray light."""
    values = {check.name: check.value for check in judgement.checks if check.value is not None}
    events: list[tuple[str, str]] = []
    moved_px = values.get("movement", 0.0)
    if moved_px > judge.moved_px:
        sentence = (
            f"{step_name(step)}: the chart has moved by {moved_px:.2f} px, at most {judge.moved_px:g} px allowed; the "
            "run continues at the new position, and build-lut shifts its grid with a remark. Fasten camera and chart; "
            "for one position in all frames, start a new session"
        )
        events.append(("moved", sentence))
    percent = values.get(OFF_BRIGHTNESS.name, 0.0)
    # A step of the lamp may be accepted beyond its limit. Frames that connect runs have wide limits, so their value is
    # compared with the usual limit.
    stepped = any(check.name == OFF_BRIGHTNESS.name and check.is_beyond for check in judgement.checks)
    connects_runs = step.kind == "response" and any(lit.kind == "light" and lit.number < step.number for lit in steps)
    if stepped or (connects_runs and abs(percent) > judge.drift_percent):
        sign = "stronger" if percent > 0 else "weaker"
        sentence = (
            f"{step_name(step)}: the light is {abs(percent):.1f} % {sign} than in the previous frames; the run "
            "continues at the new level, which build-lut takes from the white frames"
        )
        events.append(("level", sentence))
    room_percent = values.get(LEAK_SHARE.name, 0.0)
    if room_percent > ROOM_LIGHT_PERCENT and step.number == min(row.number for row in steps if row.kind == step.kind):
        sentence = (
            f"{step_name(step)}: black has {room_percent:.1f} % of white, at most {ROOM_LIGHT_PERCENT:g} % allowed; "
            "switch off other lamps. If it stays, build-lut adds a remark; its option --subtract-dark subtracts it"
        )
        events.append((DOUBT, sentence))
    return events


# If this number of consecutive steps is given up, there must be a lasting cause. Fewer may have a temporary cause.
GIVEN_UP_IN_A_ROW = 3


class StepQueue:
    """The steps of a session that this run has to take, in the order of the plan.

    A refused step is therefore repeated before later steps.

    `append`: adds a reference of a kind to the end of the plan and returns it. `reference_every`: largest number of
    illuminants between two references; None for no limit.
    """

    def __init__(
        self,
        steps: Sequence[SessionStep],
        done_numbers: Collection[int],
        attempts: int,
        append: Callable[[FrameKind], SessionStep],
        first: Iterable[int] = (),
        unclosed: Collection[str] = (),
        reference_every: int | None = None,
    ) -> None:
        self._steps = {step.number: step for step in steps}
        self._first = list(first)
        self._given_up_first: list[int] = []
        self._open = {step.number for step in steps if step.number not in done_numbers} | set(self._first)
        self._attempts = attempts
        self._tries: Counter[int] = Counter()
        self._under_way: set[int] = set()
        self._given_up: dict[int, str] = {}
        self._in_a_row = 0
        self._unclosed: set[str] = set(unclosed)
        self._append = append
        planned_kinds = {step.kind for step in steps}
        self._closing: list[FrameKind] = [reference for reference in REFERENCES if reference in planned_kinds]
        self._reference_every = reference_every
        self._lights_since = dict.fromkeys(self._closing, 0)

    def __len__(self) -> int:
        """Return the number of steps without an accepted frame, in any state."""
        return len(self._open)

    @property
    def given_up(self) -> tuple[str, ...]:
        """A sentence with the reason for each step that is left for the next run."""
        return tuple(f"{step_name(self._steps[number])}: {reason}" for number, reason in self._given_up.items())

    @property
    def is_stuck(self) -> bool:
        """Whether so many steps in a row were given up that there must be a lasting cause."""
        return self._in_a_row >= GIVEN_UP_IN_A_ROW

    def next(self) -> SessionStep | None:
        """Return the next step; None if no step is open now."""
        ready = self._open - self._under_way - self._given_up.keys()
        number = next((number for number in self._first if number in ready), min(ready, default=None))
        if number is None and not self._under_way:
            number = self._add_closing()
        if number is not None and self._steps[number].kind == "light":
            number = self._light_or_reference(number)
        return None if number is None else self._steps[number]

    def is_open(self, number: int) -> bool:
        """Return whether a step has no accepted frame."""
        return number in self._open

    def begin(self, step: SessionStep) -> None:
        """Note the start of an attempt."""
        self._under_way.add(step.number)
        self._tries[step.number] += 1

    def withdraw(self, step: SessionStep) -> None:
        """Note that an attempt failed for another reason than its image; it does not count as a try."""
        self._under_way.discard(step.number)
        self._tries[step.number] -= 1

    def retry(self) -> None:
        """Open the given-up steps again, with all their tries.

        Steps that had priority have it again, because they show whether the cause has been removed.
        """
        for number in self._given_up:
            self._tries[number] = 0
        self._given_up.clear()
        self._first = [*self._given_up_first, *self._first]
        self._given_up_first = []
        self._in_a_row = 0

    def accept(self, step: SessionStep) -> None:
        """Note an accepted frame."""
        self._under_way.discard(step.number)
        self._open.discard(step.number)
        self._forget_first(step.number)
        if step.kind == "light":
            self._unclosed.update(REFERENCES)
            self._lights_since = {reference: count + 1 for reference, count in self._lights_since.items()}
        elif step.kind in self._lights_since:
            self._lights_since[step.kind] = 0
        self._unclosed.discard(step.kind)
        # A dark frame does not show progress, because it is also accepted if no light reaches the chart.
        if step.kind != "dark":
            self._in_a_row = 0

    def refuse(self, step: SessionStep, reason: str, *, before_others: bool = False) -> bool:
        """Note a refused frame; return whether the step is tried again."""
        self._under_way.discard(step.number)
        self._open.add(step.number)
        if before_others and step.number not in self._first:
            self._first.append(step.number)
        if self._tries[step.number] >= self._attempts:
            self._give_up(step.number, reason)
            return False
        return True

    def void(self, numbers: Iterable[int], reason: str) -> None:
        """Open steps with voided frames again; steps without remaining tries are given up."""
        for number in sorted(numbers):
            self._open.add(number)
            if self._tries[number] >= self._attempts:
                self._give_up(number, reason)

    def begin_with(self, steps: Iterable[SessionStep]) -> None:
        """Take the given steps before all other steps, in the order of the plan, with all their tries."""
        steps = sorted(steps, key=lambda step: step.number)
        numbers = [step.number for step in steps]
        self._steps |= {step.number: step for step in steps}
        self._open |= set(numbers)
        self._first = [*numbers, *(number for number in self._first if number not in numbers)]
        for number in numbers:
            self._tries[number] = 0
            self._given_up.pop(number, None)

    def _give_up(self, number: int, reason: str) -> None:
        if number not in self._given_up:
            self._in_a_row += 1
        self._given_up[number] = reason
        if number in self._first:
            self._given_up_first.append(number)
        self._forget_first(number)

    def _forget_first(self, number: int) -> None:
        if number in self._first:
            self._first.remove(number)

    def _add_closing(self) -> int | None:
        for reference in self._closing:
            if reference in self._unclosed:
                self._unclosed.discard(reference)
                return self._append_reference(reference)
        return None

    def _light_or_reference(self, light: int) -> int:
        """Return the step of an illuminant, or of a reference if too many illuminants were taken since the last one.

        If no references follow the illuminant in the plan, they are added first. So a killed run never looks complete.
        """
        for reference in self._closing:
            if not any(number > light and self._steps[number].kind == reference for number in self._open):
                self._append_reference(reference)
            is_coming = any(self._steps[number].kind == reference for number in self._under_way)
            if self._reference_every and self._lights_since[reference] >= self._reference_every and not is_coming:
                self._lights_since[reference] = 0
                return self._append_reference(reference)
        return light

    def _append_reference(self, reference: FrameKind) -> int:
        step = self._append(reference)
        self._steps[step.number] = step
        self._open.add(step.number)
        return step.number


def missing_references(kinds: Iterable[str]) -> frozenset[str]:
    """Return the kinds of references (white, dark) not accepted after the last illuminant; `kinds`: accepted frames."""
    unclosed: set[str] = set()
    for name in kinds:
        if name == "light":
            unclosed.update(REFERENCES)
        unclosed.discard(name)
    return frozenset(unclosed)


def step_name(step: SessionStep) -> str:
    """Return the name of a step in messages."""
    return f"illuminant {step.illumination}" if step.illumination is not None else f"{step.kind} frame {step.number}"


def link_runs(session: Session, moment: datetime) -> tuple[int, ...]:
    """Add the frames to the plan that connect this run to earlier runs; return the numbers of their steps.

    They show changes of chart, camera or lamp before the next illuminant. If an earlier run did not finish its set of
    these frames, the set is voided and repeated. Nothing is added to a session without accepted frames, or without
    response frames.
    """
    accepted = [attempt for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    if not accepted or all(step.kind != "response" for step in session.steps):
        return ()
    links = link_steps(session.steps[-1].number + 1)
    unfinished = _unfinished(session.steps[-len(links) :], links, accepted)
    if not unfinished:
        return _add_steps(session, links)
    numbers = tuple(step.number for step in unfinished)
    unfinished_attempts = [attempt.id for attempt in accepted if attempt.step in numbers]
    session.journal.void(unfinished_attempts, moment, "all frames that connect two runs are repeated")
    return numbers


def _add_steps(session: Session, steps: Sequence[SessionStep]) -> tuple[int, ...]:
    session.add_steps(steps)
    return tuple(step.number for step in steps)


def _unfinished(
    tail: Sequence[SessionStep], links: Sequence[SessionStep], accepted: Sequence[Attempt]
) -> Sequence[SessionStep]:
    """Return the last steps of the plan if they connect runs and no other frame was accepted later; else none."""
    if [(step.kind, step.colour) for step in tail] != [(step.kind, step.colour) for step in links]:
        return ()
    numbers = {step.number for step in tail}
    accepted_steps = {attempt.step for attempt in accepted if attempt.step in numbers}
    return tail if not accepted_steps or accepted[-1].step in numbers else ()
