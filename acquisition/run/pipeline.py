"""A frame's way: while one is downloaded the next light settles, while one is exposed the last is judged.

docs/explanation/steps.md has the order of its steps. `StepQueue` says which frame is next, `Pipeline` moves the
devices, `Verdicts` lets frames count and draws what follows for others, `LastingCause` waits for what would refuse
every frame. Rules that hold inside, of time and order:

- Settling counts from when the light was shown, so that it passes during the download and while verdicts are awaited.
- The saving thread touches no device and no journal: rows are committed on the devices' thread, in the order of taking.
- An attempt's row gets `started_at` when its light was shown and `ended_at` when the exposure was over and the light
  could change: what they enclose are parts of the run's time that do not overlap, though the work on the frames does.
- A light that is shown and not taken, because a refused one came first, leaves no row.
- What fails is waited for (`RetryPolicy`) when no frame waits in the camera that could be saved first.

And of what is taken next:

- Open steps are taken in the plan's order, so that a refused one comes before those behind it.
- A reference that voids other frames is taken again before them: it shows whether the cause is still there.
- Lights are followed by a white and a dark frame. Where lights that are taken again would have none behind them,
  another pair is put behind the plan before they are, so that a run that is killed meanwhile is not complete.
- A refused reference may void all lights since the last good one. Where more lights than usual are taken again in a
  row, a pair comes between them, too.
- What a run that is taken up shows first is put into the session's plan by `link_runs`.
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
    Judgement,
    OutlastsPauses,
    SessionStep,
    duration_text,
    link_steps,
    preview_path,
)
from foundation.clock import SteadyClock
from foundation.console import EndRequest
from foundation.errors import CropError, DeviceError, QualityError, StorageError, counted, first_few
from foundation.files import write_atomic

# Frames whose verdict is not known when the next is exposed. A frame is judged while the next is exposed and
# downloaded, which takes several times as long; with more frames ahead, more would be lost where one is refused.
AHEAD = 1

# Tries at fetching a frame before it is exposed again: a driver has renewed its connection several times by then.
DOWNLOADS = 2

# What steps are expected to take, seconds, until they took longer: a write to the journal, a picture that is shown or
# read back, release and readout beside the shutter's time and as much again for the camera's own dark frame, the
# verdict of a large frame, its download over a slow cable.
COMMIT_S, SHOW_S, RELEASE_S, JUDGE_S, DOWNLOAD_S = 1.0, 2.0, 3.0, 5.0, 10.0

PROMISE = "ending after this frame; press Ctrl-C again to end at once"  # What somebody is told who asks a run to end

_CAMERA, _SCREEN, _DISK = "the camera", "the screen", "the disk"

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Job:
    """What a run has from its first frame to its last."""

    session: Session
    devices: Devices
    settings: LabSettings
    queue: StepQueue
    judge: FrameJudge
    retry: RetryPolicy
    watch: RunWatch

    def on_disk(self, action: Callable[[], _Result]) -> _Result:
        """Return what `action` returns; while the disk is full or gone, it is waited for."""

        def watched() -> _Result:
            with self.watch.step(_DISK, "takes what the journal says", COMMIT_S, "commit"):
                return action()

        return self.retry.attempt(watched, _DISK)


@dataclass(frozen=True)
class Taken:
    """A frame that was taken and judged; `left` steps of the plan are without an accepted frame now."""

    step: SessionStep
    judgement: Judgement
    left: int


@dataclass(frozen=True)
class ShownLight:
    """A step whose light is on the screen since `since`, seconds of the clock; to show it took `show_s`.

    `replaced`: the colour that was shown before; None for the first.
    """

    step: SessionStep
    shown_at: datetime
    since: float
    show_s: float
    replaced: Colour | None


@dataclass(frozen=True)
class Exposed:
    """A frame that is in the camera or beyond it; `checks` are what the devices say of it.

    `number` is that of its attempt in the journal, `stem` its file's name without suffix. `changed`: whether another
    colour was shown, and exposed, before it, so that a picture that is late or stands still would be seen.
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
    """A raw file that is complete on the disk, and what was seen in it.

    - `save_s`, `judge_s`: seconds of this machine's time that hashing, flushing and renaming took, and judging.
    - `preview_fault`: why its preview could not be written; empty where it was, or there is none.
    """

    received: ReceivedFile
    judgement: Judgement
    save_s: float
    judge_s: float
    preview_fault: str = ""


class Pipeline:
    """Moves the devices; `saving` is the thread that completes files and judges them, one after another."""

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
        """Take frames until the queue is empty or the end was asked for.

        Whatever ends it, frames that the camera has given are completed, judged and journalled first.
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
        """Show the next light; wait for verdicts where it depends on them; None where nothing more is to be taken."""
        while not self._ending.is_requested:
            if self._verdicts.is_spent:
                self._collect(0)
                self._verdicts.require_budget()
            if self._lasting.is_found:
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
        """Take the frame of the light that is on the screen; return the next one that is."""
        settling_s = self._settle(light)
        if self._ending.is_requested:
            return self._next_light()
        frame = self._expose(light, settling_s)
        if frame is None:
            return self._next_light()
        # While it is doubtful whether frames can be had at all, one is taken at a time.
        ahead = 0 if self._lasting.is_probed else AHEAD
        following = self._show_following() if ahead else None
        frame = replace(frame, checks=(*frame.checks, *self._projector_check(frame.step)))
        self._hand_over(frame)
        self._collect(ahead)
        if not all(check.passed for check in frame.checks):
            # What ails a device now decides whether the next frame makes sense.
            self._collect(0)
            if self._job.devices.projector is not None:
                with self._ending.at_once():
                    await_health(self._job.devices.projector, self._job.settings.sequence, self._job.retry)
        elif following is not None and not self._lasting.is_found and self._job.queue.next() == following.step:
            return following
        return self._next_light()

    def _show(self, step: SessionStep) -> ShownLight:
        clock = self._job.devices.clock
        shown_at, begun = clock.now(), clock.monotonic()
        with self._job.watch.step(_SCREEN, f"shows {step_name(step)}", SHOW_S, "show"):
            self._job.devices.presenter.show(step.colour)
        since = clock.monotonic()
        replaced, self._shown = self._shown, step.colour
        return ShownLight(step, shown_at, since, since - begun, replaced)

    def _show_following(self) -> ShownLight | None:
        """Show the next light if it is known; a presenter that fails is met when no frame waits in the camera."""
        step = None if self._ending.is_requested else self._job.queue.next()
        if step is None:
            return None
        try:
            return self._show(step)
        except DeviceError:
            return None

    def _settle(self, light: ShownLight) -> float:
        """Let the rest of the settling pass; return how long that took."""
        clock = self._job.devices.clock
        rest = self._job.settings.sequence.settle_s - (clock.monotonic() - light.since)
        if rest > 0:
            clock.sleep(rest)
        return max(rest, 0.0)

    def _expose(self, light: ShownLight, settling_s: float) -> Exposed | None:
        """Release the shutter; None where the camera failed, and was waited for."""
        clock, step, journal = self._job.devices.clock, light.step, self._job.session.journal
        shutter_s = self._job.settings.camera.shutter_s
        kept = journal.kept_files(step)
        stem = step.stem if kept == 0 else f"{step.stem}_try{kept + 1}"
        number = self._job.on_disk(lambda: journal.begin(step, f"frames/{stem}", light.shown_at))
        self._job.queue.begin(step)
        self._note_gap()
        begun = clock.monotonic()
        changed = step.colour not in (light.replaced, self._exposed)
        self._exposed = step.colour
        try:
            with self._job.watch.step(_CAMERA, f"exposes {step_name(step)}", 2 * shutter_s + RELEASE_S, "expose"):
                self._job.devices.camera.expose()
        except DeviceError as error:
            self._give_up(step, number, error)
            self._pause_for(_CAMERA, error)
            return None
        timings = {"show": light.show_s, "settle": settling_s, "expose": clock.monotonic() - begun}
        checks = (*self._screen_check(step), *self._gap_check())
        return Exposed(step, number, stem, clock.now(), checks, timings, changed)

    def _note_gap(self) -> float:
        """Tell of a time in which the program stood still; return how long that was, seconds.

        A date that was set meanwhile is told, too.
        """
        clock = self._job.devices.clock
        if isinstance(clock, SteadyClock) and (set_by_s := clock.step_s()):
            way = "ahead" if set_by_s > 0 else "back"
            by = f"{way} by {duration_text(abs(set_by_s))}"
            self._job.retry.report("clock", f"the machine's clock was set {by}; the session's time goes on as before")
        if gap_s := self._job.watch.gap_s():
            sentence = f"the run stood still for {duration_text(gap_s)}: the machine slept, or the process was stopped"
            self._job.retry.report("gap", sentence)
        return gap_s

    def _gap_check(self) -> tuple[Check, ...]:
        """Refuse a frame during which the program stood still: nobody knows what the screen showed meanwhile."""
        if not (gap_s := self._note_gap()):
            return ()
        reason = (
            f"the run stood still for {duration_text(gap_s)} while the frame was exposed; keep the machine from "
            "sleeping; the frame is taken again"
        )
        return (Check("gap", gap_s, None, GAP_S, "s", reason),)

    def _screen_check(self, step: SessionStep) -> tuple[Check, ...]:
        presenter = self._job.devices.presenter
        if not isinstance(presenter, ReadsBack):
            return ()
        try:
            with self._job.watch.step(_SCREEN, f"is asked whether it shows {step_name(step)}", SHOW_S, "verify"):
                presenter.verify(step.colour)
        except DeviceError as error:
            return (Check("screen", reason=str(error)),)
        return (Check("screen"),)

    def _projector_check(self, step: SessionStep) -> tuple[Check, ...]:
        """Ask the projector for its health; it answers while the next light settles."""
        if self._health is None:
            return ()
        with self._job.watch.step("the projector", "is asked for its health", SHOW_S, "health"):
            fault = self._health.fault(thorough=step.kind == "dark")
        return (Check("projector", reason="" if fault is None else str(fault)),)

    def _hand_over(self, frame: Exposed) -> None:
        """Fetch the frame from the camera and hand it to the saving thread; a frame that is lost is exposed again."""
        clock = self._job.devices.clock
        begun = clock.monotonic()
        try:
            complete = self._fetch(frame)
        except DeviceError as error:
            self._give_up(frame.step, frame.number, error)
            self._pause_for(_CAMERA, error)
            return
        self._clear_pause(_CAMERA)
        frame = replace(frame, timings={**frame.timings, "download": clock.monotonic() - begun})
        self._under_way.append((frame, self._saving.submit(_save, self._job, complete, frame)))

    def _fetch(self, frame: Exposed) -> Callable[[], ReceivedFile]:
        """Let the camera write the frame under a hidden name; return what completes the file.

        What a full disk cannot take stays in the camera.
        """
        download = partial(_download, self._job, frame)
        for _ in range(DOWNLOADS - 1):
            try:
                return self._job.retry.attempt(download, _DISK, curable=_is_of_disk)
            except DeviceError as error:
                self._job.retry.report("retry", f"{step_name(frame.step)}: {error}")
        return self._job.retry.attempt(download, _DISK, curable=_is_of_disk)

    def _collect(self, keep: int) -> None:
        """Journal the frames whose verdicts are due, oldest first, until `keep` are left to wait for."""
        while len(self._under_way) > keep:
            frame, awaited = self._under_way.popleft()
            begun = time.perf_counter()
            try:
                with self._job.watch.step(_DISK, f"takes {step_name(frame.step)}, which is judged", JUDGE_S, "judge"):
                    saved = awaited.result()
            except (DeviceError, StorageError) as error:
                self._give_up(frame.step, frame.number, error)
                self._pause_for(_DISK, error)
                continue
            self._clear_pause(_DISK)
            timings = {"save": saved.save_s, "judge": saved.judge_s, "waited": time.perf_counter() - begun}
            frame = replace(frame, timings={**frame.timings, **timings})
            if self._health is not None and not saved.judgement.accepted:
                self._health.suspect()
            self._verdicts.take_in(frame, saved, [later for later, _ in self._under_way])
            self._observe(Taken(frame.step, saved.judgement, len(self._job.queue)))

    def _give_up(self, step: SessionStep, number: int, error: CropError) -> None:
        """Note an attempt that gave no frame, by no fault of what was to be photographed."""
        self._job.queue.withdraw(step)
        self._collect(0)
        now = self._job.devices.clock.now()
        self._job.on_disk(lambda: self._job.session.journal.fail(number, now, str(error)))

    def _pause_for(self, name: str, fault: CropError) -> None:
        """Wait for a camera or disk that lost a frame; the pause lasts until a frame came through."""
        self._pauses.setdefault(name, self._job.retry.pause(name, idle=name != _CAMERA)).wait(fault)

    def _clear_pause(self, name: str) -> None:
        if (pause := self._pauses.pop(name, None)) is not None:
            pause.over()

    def _salvage(self, error: BaseException) -> None:
        """Journal what the camera has given, whatever ended the run; a further fault does not hide the first."""
        while self._under_way:
            try:
                self._collect(0)
            except CropError as further:
                if str(further) == str(error):
                    continue
                error.add_note(f"then: {further}")


def _is_of_disk(fault: CropError) -> bool:
    return isinstance(fault, StorageError) and is_curable(fault)


def _download(job: Job, frame: Exposed) -> Callable[[], ReceivedFile]:
    """Let the camera write the frame exposed last into `frames/`, under a hidden name; return what completes it."""
    incoming = IncomingFile(job.session.frames_folder / frame.stem)
    try:
        with job.watch.step(_CAMERA, f"sends {step_name(frame.step)} to the disk", DOWNLOAD_S, "download"):
            captured = job.devices.camera.download(incoming.stream)
        size = incoming.stream.seek(0, 2)
        if size != captured.size or size == 0:
            # Found here and not when the file is completed: the body may hold the frame still.
            raise DeviceError(f"{captured.name}: the camera says {captured.size} bytes, {size} arrived")
    except BaseException:
        with incoming:
            raise
    return partial(incoming.complete, captured)


def _save(job: Job, complete: Callable[[], ReceivedFile], frame: Exposed) -> Saved:
    """Make a frame's file whole and judge it; what the saving thread does."""
    begun = time.perf_counter()
    received = complete()
    saved = time.perf_counter()
    judgement, preview_fault = Judgement(frame.checks), ""
    if judgement.accepted:
        seen = job.judge.judge(received.path, frame.step)
        judgement = replace(seen, checks=(*frame.checks, *seen.checks), preview=b"")
        if seen.preview:
            # It is derived and may be lost; flushing it would cost the devices' thread as much as a row.
            try:
                write_atomic(preview_path(job.session.folder, received.path.name), seen.preview)
            except CropError as error:
                preview_fault = str(error)
    return Saved(received, judgement, saved - begun, time.perf_counter() - saved, preview_fault)


class Verdicts:
    """Lets frames count or not, in the order of taking, and draws what follows for those before and behind them."""

    def __init__(self, job: Job, lasting: LastingCause) -> None:
        self._job, self._lasting = job, lasting
        self._voided_ahead: dict[int, str] = {}
        self._lacks_previews = False
        self._last_before = lasting.last_before
        self._unused_bytes = 0
        self._budget_gb = job.settings.sequence.refused_gb

    @property
    def is_spent(self) -> bool:
        """Whether this run has filled the disk with more frames that are not used than it may."""
        return self._unused_bytes > self._budget_gb * 1e9

    def require_budget(self) -> None:
        """Raise if `is_spent`: what refuses so many frames is not chance, and fills the disk."""
        if self.is_spent:
            raise QualityError(
                f"refused and voided frames of this run take {self._unused_bytes / 1e9:.3g} GB of the disk, "
                f"{self._budget_gb:g} allowed (sequence.refused_gb); acquire status names the causes: mend "
                "them, then run the same command again; it has the same budget anew"
            )

    def take_in(self, frame: Exposed, saved: Saved, under_way: Sequence[Exposed]) -> None:
        """Journal a verdict; `under_way`: the frames behind it, whose verdicts are not known."""
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
            job.retry.report("preview", f"{saved.preview_fault}; frames count without, and more is not said of it")
        voided = self._voided_ahead.pop(frame.number, "")
        if judgement.accepted and voided:
            job.queue.withdraw(step)
            self._void((frame.number,), voided)
        elif judgement.accepted:
            job.queue.accept(step)
            for what, sentence in _followed_changes(step, judgement, job.session.steps, job.settings.judge):
                job.retry.report(what, sentence)
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
        """Open the steps again whose files are gone or cut since they were taken; return whether there are any."""
        queue, found = self._job.queue, self._job.on_disk(self._job.session.lost_files)
        lost = [frame for frame in found if not queue.is_open(frame.step)]
        if lost:
            reason = f"{first_few([frame.file for frame in lost])}: gone or cut while the run was at work"
            queue.void([frame.step for frame in lost], reason)
            self._void([frame.attempt for frame in lost], reason)
        return bool(lost)

    def _refuse(self, step: SessionStep, judgement: Judgement) -> None:
        queue = self._job.queue
        first = judgement.lasting or (judgement.voids and step.kind in REFERENCES)
        again = queue.refuse(step, judgement.reason, before_others=first)
        # What would be taken again without a good reference would be voided again, all night.
        in_vain = judgement.voids and not again
        pauses = judgement.lasting or queue.is_stuck or self._lasting.is_probed or in_vain
        after = "it is tried again after a pause" if pauses else "it is left for the next run"
        then = "it is taken again" if again else after
        sentence = f"{step_name(step)}: {judgement.reason}"
        self._job.retry.report("refused", f"{sentence} ({then})")
        if pauses:
            self._lasting.found(sentence, step)

    def _void_since_reference(self, refused: Exposed, why: str, under_way: Sequence[Exposed]) -> None:
        """Void what was taken since the last good reference of the refused one's kind, frames under way included.

        A reference of another kind stays that was taken beside the good one, before any light.
        """
        queue, kind = self._job.queue, refused.step.kind
        reason = f"taken between a good reference and {step_name(refused.step)}, which was refused: {why}"
        since: dict[int, int] = {}
        for attempt in self._job.session.journal.attempts():
            if attempt.verdict == ACCEPTED and attempt.id < refused.number:
                if attempt.kind == kind:
                    since.clear()
                elif since or attempt.kind not in REFERENCES:
                    since[attempt.id] = attempt.step
        queue.void(since.values(), reason)
        if queue.is_stuck:
            self._lasting.found(reason, None)
        self._void(since, reason)
        self._void_ahead(under_way, reason)

    def _void_first_frames(self, refused: Exposed, why: str, under_way: Sequence[Exposed]) -> None:
        """Void what this run has taken, since its last pause for something lasting: by that others are judged."""
        reason = f"the first frames contradict {step_name(refused.step)}: {why}"
        since = {
            attempt.id: attempt.step
            for attempt in self._job.session.journal.attempts()
            if attempt.verdict == ACCEPTED and self._lasting.last_before < attempt.id < refused.number
        }
        self._void(since, reason)
        # The refused one, and what is under way, are taken again in their places among them.
        again = {refused.step.number, *since.values(), *(frame.step.number for frame in under_way)}
        self._job.queue.begin_with(step for step in self._job.session.steps if step.number in again)
        self._void_ahead(under_way, reason)

    def _void_ahead(self, under_way: Sequence[Exposed], reason: str) -> None:
        self._voided_ahead.update({frame.number: reason for frame in under_way})

    def _void(self, attempts: Collection[int], reason: str) -> None:
        if not attempts:
            return
        now = self._job.devices.clock.now()
        self._job.on_disk(lambda: self._job.session.journal.void(tuple(attempts), now, reason))
        self._job.retry.report("voided", f"{counted(len(attempts), 'frame')}, to be taken again: {reason}")


class LastingCause:
    """What would refuse every frame: waited for, and tried again at growing intervals until it is seen to be over.

    A picture that is always late shows the right light where a frame is taken twice in a row. So that it is over is
    shown by a light that follows another one, or by all frames that were taken to find out, of which one follows
    another light.

    - `last_before`: the newest attempt from before the run, or from before its last pause for something lasting.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self.last_before = max((attempt.id for attempt in job.session.journal.attempts()), default=0)
        self._sentence = ""
        self._step: SessionStep | None = None
        self._probing: Pause | None = None
        self._to_show: set[int] = set()
        self._is_changing = False

    @property
    def is_found(self) -> bool:
        """Whether the run must wait before its next frame."""
        return bool(self._sentence)

    @property
    def is_probed(self) -> bool:
        """Whether it was waited for, and the frames have not shown yet that it is over."""
        return self._probing is not None

    def found(self, sentence: str, step: SessionStep | None) -> None:
        """Note the cause, and the step whose frame it refused; None where it voided those of others."""
        self._sentence, self._step = sentence, step

    def wait(self) -> None:
        """Let time pass for somebody to remove the cause, then let the frames be tried again."""
        fault, self._sentence = QualityError(self._sentence), ""
        self._probing = self._probing or self._job.retry.pause(FRAMES)
        self._probing.back_off(fault)
        self._job.queue.retry()
        self._to_show, self._is_changing = set(), False
        if self._step is not None:
            self._to_show.add(self._step.number)
            if self._step.kind != "dark":
                self._link()

    def accepted(self, step: SessionStep, changed: bool) -> None:
        """Note an accepted frame, which may show that the cause is gone; `changed`: see `Exposed`.

        A dark frame is accepted where no light reaches the chart, too.
        """
        self._to_show.discard(step.number)
        self._is_changing |= changed and step.kind != "dark"
        if self._is_changing and (step.kind == "light" or not self._to_show):
            self.over()

    def over(self) -> None:
        """Let the run go on as before the cause was found."""
        if self._probing is not None:
            self._probing.over()
            self._probing = None

    def _link(self) -> None:
        """Take the frames first that link what follows to what was taken: what lasted may have changed for good."""
        job = self._job
        attempts = job.on_disk(job.session.journal.attempts)
        if any(attempt.kind == "light" and attempt.verdict == ACCEPTED for attempt in attempts):
            numbers = job.on_disk(lambda: link_runs(job.session, job.devices.clock.now()))
            job.queue.begin_with(step for step in job.session.steps if step.number in numbers)
            self._to_show.update(numbers)
        self.last_before = attempts[-1].id
        # Every file that was handed over is judged: a wait begins with that.
        if isinstance(job.judge, OutlastsPauses):
            job.judge.after_pause()


def _followed_changes(
    step: SessionStep, judgement: Judgement, steps: Sequence[SessionStep], judge: JudgeSettings
) -> list[tuple[str, str]]:
    """Return what is said of changes that a run follows, and of light that every frame has: words, and sentences."""
    values = {check.name: check.value for check in judgement.checks if check.value is not None}
    said: list[tuple[str, str]] = []
    moved_px = values.get("movement", 0.0)
    if moved_px > judge.moved_px:
        sentence = (
            f"{step_name(step)}: the chart lies {moved_px:.2f} px from where it was; the run goes on with its new "
            "place, and build-lut follows it with a remark. Fix camera and print; to have all lights of one place, "
            "begin a new session"
        )
        said.append(("moved", sentence))
    percent = values.get(OFF_BRIGHTNESS.name, 0.0)
    # A step of the lamp that was shown twice is beyond its limit. Frames that link runs have wide limits.
    stepped = any(check.name == OFF_BRIGHTNESS.name and check.is_beyond for check in judgement.checks)
    links = step.kind == "response" and any(one.kind == "light" and one.number < step.number for one in steps)
    if stepped or (links and abs(percent) > judge.drift_percent):
        more = "stronger" if percent > 0 else "weaker"
        sentence = (
            f"{step_name(step)}: the light is {abs(percent):.1f} % {more} than in the frames before; the run goes "
            "on at the new level, and build-lut follows it by the white frames"
        )
        said.append(("level", sentence))
    room_percent = values.get(LEAK_SHARE.name, 0.0)
    if room_percent > ROOM_LIGHT_PERCENT and step.number == min(one.number for one in steps if one.kind == step.kind):
        sentence = (
            f"{step_name(step)}: black has {room_percent:.1f} % of white, {ROOM_LIGHT_PERCENT:g} % expected; every "
            "light has it. Switch off what shines in the room; build-lut remarks on it, --subtract-dark takes it out"
        )
        said.append((DOUBT, sentence))
    return said


# Steps given up one after another after which going on makes no sense: something lasting is wrong. One may be chance,
# and two neighbours may share a cause that passes.
GIVEN_UP_IN_A_ROW = 3


class StepQueue:
    """The steps of a session that are still to be taken in this run.

    `append`: given a reference's kind, puts one behind the plan and returns it.
    `reference_every`: lights that are taken in a row without references between them; None: as many as the plan has.
    """

    def __init__(
        self,
        steps: Sequence[SessionStep],
        done: Collection[int],
        attempts: int,
        append: Callable[[FrameKind], SessionStep],
        first: Iterable[int] = (),
        unclosed: Collection[str] = (),
        reference_every: int | None = None,
    ) -> None:
        self._steps = {step.number: step for step in steps}
        self._first = list(first)
        self._probes: list[int] = []
        self._open = {step.number for step in steps if step.number not in done} | set(self._first)
        self._attempts = attempts
        self._tries: Counter[int] = Counter()
        self._under_way: set[int] = set()
        self._given_up: dict[int, str] = {}
        self._in_a_row = 0
        self._unclosed: set[str] = set(unclosed)
        self._append = append
        planned = {step.kind for step in steps}
        self._closing: list[FrameKind] = [kind for kind in REFERENCES if kind in planned]
        self._reference_every = reference_every
        self._lights_since = dict.fromkeys(self._closing, 0)

    def __len__(self) -> int:
        """Return how many steps are without an accepted frame, given up or under way included."""
        return len(self._open)

    @property
    def given_up(self) -> tuple[str, ...]:
        """Why steps were left for the next run, a sentence each, in the order in which they were."""
        return tuple(f"{step_name(self._steps[number])}: {reason}" for number, reason in self._given_up.items())

    @property
    def is_stuck(self) -> bool:
        """Whether so many steps were given up in a row that something lasting is wrong."""
        return self._in_a_row >= GIVEN_UP_IN_A_ROW

    def next(self) -> SessionStep | None:
        """Return the step to take next; None while nothing is to be taken that is not under way."""
        ready = self._open - self._under_way - self._given_up.keys()
        number = next((number for number in self._first if number in ready), min(ready, default=None))
        if number is None and not self._under_way:
            number = self._closed()
        if number is not None and self._steps[number].kind == "light":
            number = self._between(number)
        return None if number is None else self._steps[number]

    def is_open(self, number: int) -> bool:
        """Return whether a step is without an accepted frame."""
        return number in self._open

    def begin(self, step: SessionStep) -> None:
        """Note that an attempt at `step` begins."""
        self._under_way.add(step.number)
        self._tries[step.number] += 1

    def withdraw(self, step: SessionStep) -> None:
        """Note that the attempt under way came to nothing by no fault of the frame: it is no try."""
        self._under_way.discard(step.number)
        self._tries[step.number] -= 1

    def retry(self) -> None:
        """Give the steps that were given up their tries again: somebody has had time to remove the cause.

        Those that came before all others do so again: they show whether it is removed.
        """
        for number in self._given_up:
            self._tries[number] = 0
        self._given_up.clear()
        self._first = [*self._probes, *self._first]
        self._probes = []
        self._in_a_row = 0

    def accept(self, step: SessionStep) -> None:
        """Note that the attempt under way gave an accepted frame."""
        self._under_way.discard(step.number)
        self._open.discard(step.number)
        self._forget_first(step.number)
        if step.kind == "light":
            self._unclosed.update(REFERENCES)
            self._lights_since = {kind: count + 1 for kind, count in self._lights_since.items()}
        elif step.kind in self._lights_since:
            self._lights_since[step.kind] = 0
        self._unclosed.discard(step.kind)
        # A dark frame is accepted where no light reaches the chart, too.
        if step.kind != "dark":
            self._in_a_row = 0

    def refuse(self, step: SessionStep, reason: str, *, before_others: bool = False) -> bool:
        """Note that the attempt under way gave no frame that can be used; return whether the step is tried again."""
        self._under_way.discard(step.number)
        self._open.add(step.number)
        if before_others and step.number not in self._first:
            self._first.append(step.number)
        if self._tries[step.number] >= self._attempts:
            self._give_up(step.number, reason)
            return False
        return True

    def void(self, numbers: Iterable[int], reason: str) -> None:
        """Open steps again whose frames cannot be trusted any more; those without a try left are given up."""
        for number in sorted(numbers):
            self._open.add(number)
            if self._tries[number] >= self._attempts:
                self._give_up(number, reason)

    def begin_with(self, steps: Iterable[SessionStep]) -> None:
        """Take steps, old or new, before all others in the order of the plan, with all their tries."""
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
            self._probes.append(number)
        self._forget_first(number)

    def _forget_first(self, number: int) -> None:
        if number in self._first:
            self._first.remove(number)

    def _closed(self) -> int | None:
        """Put a reference behind the plan that closes the last lights; None where none is needed."""
        for kind in self._closing:
            if kind in self._unclosed:
                self._unclosed.discard(kind)
                return self._appended(kind)
        return None

    def _between(self, light: int) -> int:
        """Return what is taken now where a light is next: a reference, where too many lights were taken since the last.

        References that will follow are in the plan when this returns.
        """
        for kind in self._closing:
            if not any(number > light and self._steps[number].kind == kind for number in self._open):
                self._appended(kind)
            coming = any(self._steps[number].kind == kind for number in self._under_way)
            if self._reference_every and self._lights_since[kind] >= self._reference_every and not coming:
                self._lights_since[kind] = 0
                return self._appended(kind)
        return light

    def _appended(self, kind: FrameKind) -> int:
        step = self._append(kind)
        self._steps[step.number] = step
        self._open.add(step.number)
        return step.number


def unclosed_kinds(taken: Iterable[str]) -> frozenset[str]:
    """Return the kinds of references that are missing behind the last light of accepted frames in taking order."""
    unclosed: set[str] = set()
    for kind in taken:
        if kind == "light":
            unclosed.update(REFERENCES)
        unclosed.discard(kind)
    return frozenset(unclosed)


def step_name(step: SessionStep) -> str:
    """Return what a sentence calls a step."""
    return f"light {step.illumination}" if step.illumination is not None else f"{step.kind} frame {step.number}"


def link_runs(session: Session, at: datetime) -> tuple[int, ...]:
    """Put the frames that link this run to those before into the plan, `at` a moment; return their steps' numbers.

    They are some by which the projector is known, so that a chart, a camera or a lamp that changed between the runs is
    seen before the first light is taken.

    A set that an earlier run left unfinished is voided and taken again: the chart may have been moved since. Nothing is
    added where nothing was taken yet, or the session does not know its projector by frames of its primaries.
    """
    taken = [attempt for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    if not taken or all(step.kind != "response" for step in session.steps):
        return ()
    links = link_steps(session.steps[-1].number + 1)
    unfinished = _unfinished(session.steps[-len(links) :], links, taken)
    if not unfinished:
        return _added(session, links)
    numbers = tuple(step.number for step in unfinished)
    again = [attempt.id for attempt in taken if attempt.step in numbers]
    session.journal.void(again, at, "the frames that link runs are taken again, all of them")
    return numbers


def _added(session: Session, steps: Sequence[SessionStep]) -> tuple[int, ...]:
    session.add_steps(steps)
    return tuple(step.number for step in steps)


def _unfinished(
    tail: Sequence[SessionStep], links: Sequence[SessionStep], taken: Sequence[Attempt]
) -> Sequence[SessionStep]:
    """Return the last steps of the plan where they are links behind which nothing was taken; else nothing."""
    if [(step.kind, step.colour) for step in tail] != [(step.kind, step.colour) for step in links]:
        return ()
    numbers = {step.number for step in tail}
    done = {attempt.step for attempt in taken if attempt.step in numbers}
    return tail if not done or taken[-1].step in numbers else ()
