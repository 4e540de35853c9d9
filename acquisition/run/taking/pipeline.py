"""Frames one behind another: while one is downloaded the next light settles, while one is exposed the last is judged.

Order of a frame n, on one thread for the devices and one for the disk (`acquisition.run.taking.saving`)::

    devices   settle n | begin n | expose n | screen? | show n+1 | projector? | download n | collect n-1 | settle …
    saving             |        judge n-1                                     | hash, flush, rename, judge n …

Rules that hold inside:

- Settling counts from when the light was shown, so that it passes during the download and while verdicts are awaited.
- The verdict of n is collected after the download of n+1, never earlier, and so before n+2 is exposed. The rule does
  not depend on how fast anything is: a session in simulated time is the same each time.
- A frame counts when its row is committed; that happens on the devices' thread, in the order of taking.
- An attempt's row gets `started_at` when its light was shown and `ended_at` when the exposure was over and the light
  could change: what they enclose are parts of the run's time that do not overlap, though the work on the frames does.
- A light that is shown and not taken, because a refused one came first, leaves no row.
- What fails is waited for (`acquisition.run.patience`) when no frame waits in the camera that could be saved first.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import datetime

from acquisition.run.devices import Devices
from acquisition.run.lamp import HealthWatch, await_health
from acquisition.run.patience import Patience, Pause, is_curable
from acquisition.run.taking.agenda import Agenda, step_name
from acquisition.run.taking.following import followed_changes
from acquisition.run.taking.resuming import tie
from acquisition.run.taking.saving import FilledFile, Saved, Saver, download
from drivers.presenter import ReadsBack
from experiment.config import LabSettings
from experiment.session.folder import Session
from experiment.session.plan import REFERENCES, SessionStep
from experiment.session.records import ACCEPTED, Check, Judgement
from foundation.console import Ending
from foundation.errors import CropError, DeviceError, QualityError, StorageError, counted

AHEAD = 1
"""Frames whose verdict is not known when the next is exposed: that of the one before has an exposure and a download to
come in, several times what judging takes; more would only be lost where one is refused."""

DOWNLOADS = 2
"""Tries at fetching a frame before it is exposed again: a driver has renewed its connection several times by then."""

PROBE_S = 5.0
"""Between the second and the third try at a frame that is refused for something lasting; the second comes at once, each
later pause is twice the one before."""

LONGEST_PROBE_S = 300.0
"""Between two such tries at most: each leaves a refused file of 25 MB, and an operator can wait for five minutes."""

PROMISE = "ending after this frame; press Ctrl-C again to end at once"
"""What somebody is told who asks a run to end."""

_CAMERA, _SCREEN, _DISK = "the camera", "the screen", "the disk"


@dataclass(frozen=True)
class Taken:
    """A frame that was taken and judged; `left` steps of the plan are without an accepted frame now."""

    step: SessionStep
    judgement: Judgement
    left: int


@dataclass(frozen=True)
class _Lit:
    """A step whose light is on the screen since `since`, seconds of the clock."""

    step: SessionStep
    shown_at: datetime
    since: float
    show_s: float


@dataclass(frozen=True)
class _Attempt:
    """A frame that is in the camera or beyond it; `checks` are what the devices say of it."""

    step: SessionStep
    number: int
    stem: str
    over_at: datetime
    checks: tuple[Check, ...]
    timings: dict[str, float]

    @property
    def device_fault(self) -> bool:
        return any(not check.passed for check in self.checks)


@dataclass(frozen=True)
class _Pending:
    """A frame that was handed to the saving thread."""

    attempt: _Attempt
    saved: Future[Saved]


class Pipeline:
    """Takes what an agenda lists, and journals it."""

    def __init__(
        self,
        session: Session,
        devices: Devices,
        settings: LabSettings,
        agenda: Agenda,
        saver: Saver,
        patience: Patience,
        observe: Callable[[Taken], object],
        ending: Ending,
    ) -> None:
        self._session = session
        self._devices = devices
        self._settings = settings
        self._agenda = agenda
        self._saver = saver
        self._patience = patience
        self._observe = observe
        self._ending = ending
        self._pending: deque[_Pending] = deque()
        self._void_ahead: dict[int, str] = {}
        self._pauses: dict[str, Pause] = {}
        self._begun_after = max((attempt.id for attempt in session.journal.attempts()), default=0)
        self._health = HealthWatch(devices.projector, devices.clock)
        self._doubtful = False
        self._lacks_previews = False
        self._lasting = ""
        self._lasts_for: SessionStep | None = None
        self._probing: tuple[Pause, float] | None = None

    def run(self) -> None:
        """Take frames until the agenda is empty or the end was asked for.

        Whatever ends it, frames that the camera has given are completed, judged and journalled first.
        """
        try:
            with self._ending.finishing(PROMISE):
                lit = self._next_light()
                while lit is not None:
                    lit = self._take(lit)
        except BaseException as error:
            self._salvage(error)
            raise

    def _next_light(self) -> _Lit | None:
        """Show the next light; wait for verdicts where it depends on them; None where nothing more is to be taken."""
        while not self._ending.asked:
            if self._lasting:
                self._collect(0)
                self._wait_for_cause()
            step = self._agenda.next()
            if step is not None:
                return self._patience.attempt(lambda step=step: self._show(step), _SCREEN)
            if not self._pending:
                return None
            self._collect(0)
        self._collect(0)
        return None

    def _take(self, lit: _Lit) -> _Lit | None:
        """Take the frame of the light that is on the screen; return the next one that is."""
        settling_s = self._settle(lit)
        if self._ending.asked:
            return self._next_light()
        attempt = self._expose(lit, settling_s)
        if attempt is None:
            return self._next_light()
        # While it is doubtful whether frames can be had at all, one is taken at a time.
        ahead = 0 if self._probing else AHEAD
        following = self._show_following() if ahead else None
        attempt = replace(attempt, checks=(*attempt.checks, *self._projector_check(attempt.step)))
        self._hand_over(attempt)
        self._collect(ahead)
        if attempt.device_fault:
            # What ails a device now decides whether the next frame makes sense.
            self._collect(0)
            if self._devices.projector is not None:
                with self._ending.at_once():
                    await_health(self._devices.projector, self._settings.sequence, self._patience)
        elif following is not None and not self._lasting and self._agenda.next() == following.step:
            return following
        return self._next_light()

    def _show(self, step: SessionStep) -> _Lit:
        clock = self._devices.clock
        shown_at, begun = clock.now(), clock.monotonic()
        self._devices.presenter.show(step.colour)
        since = clock.monotonic()
        return _Lit(step, shown_at, since, since - begun)

    def _show_following(self) -> _Lit | None:
        """Show the next light if it is known; a presenter that fails is met when no frame waits in the camera."""
        step = None if self._ending.asked else self._agenda.next()
        if step is None:
            return None
        try:
            return self._show(step)
        except DeviceError:
            return None

    def _settle(self, lit: _Lit) -> float:
        """Let the rest of the settling pass; return how long that took."""
        clock = self._devices.clock
        rest = self._settings.sequence.settle_s - (clock.monotonic() - lit.since)
        if rest > 0:
            clock.sleep(rest)
        return max(rest, 0.0)

    def _expose(self, lit: _Lit, settling_s: float) -> _Attempt | None:
        """Release the shutter; None where the camera failed, and was waited for."""
        clock, step = self._devices.clock, lit.step
        kept = self._session.journal.kept_files(step)
        stem = step.stem if kept == 0 else f"{step.stem}_try{kept + 1}"
        number = self._patience.attempt(
            lambda: self._session.journal.begin(step, f"frames/{stem}", lit.shown_at), _DISK
        )
        self._agenda.begin(step)
        begun = clock.monotonic()
        try:
            self._devices.camera.expose()
        except DeviceError as error:
            self._give_up(step, number, error)
            self._wait_for(_CAMERA, error)
            return None
        timings = {"show": lit.show_s, "settle": settling_s, "expose": clock.monotonic() - begun}
        return _Attempt(step, number, stem, clock.now(), self._screen_check(step), timings)

    def _screen_check(self, step: SessionStep) -> tuple[Check, ...]:
        """Ask the screen whether it still shows the light, before it may change."""
        presenter = self._devices.presenter
        if not isinstance(presenter, ReadsBack):
            return ()
        try:
            presenter.verify(step.colour)
        except DeviceError as error:
            return (Check("screen", reason=str(error)),)
        return (Check("screen"),)

    def _projector_check(self, step: SessionStep) -> tuple[Check, ...]:
        """Ask the projector for its health; it answers while the next light settles."""
        if self._devices.projector is None:
            return ()
        fault = self._health.fault(thorough=step.kind == "dark" or self._doubtful)
        self._doubtful = False
        return (Check("projector", reason="" if fault is None else str(fault)),)

    def _hand_over(self, attempt: _Attempt) -> None:
        """Fetch the frame from the camera and hand it to the saving thread; a frame that is lost is exposed again."""
        clock, step = self._devices.clock, attempt.step
        begun = clock.monotonic()
        try:
            filled = self._fetch(attempt)
        except DeviceError as error:
            self._give_up(step, attempt.number, error)
            self._wait_for(_CAMERA, error)
            return
        self._is_back(_CAMERA)
        attempt.timings["download"] = clock.monotonic() - begun
        self._pending.append(_Pending(attempt, self._saver.submit(filled, step, attempt.checks)))

    def _fetch(self, attempt: _Attempt) -> FilledFile:
        """Return the frame's file as the camera wrote it; what a full disk cannot take stays in the camera."""

        def fetch() -> FilledFile:
            return download(self._session, attempt.stem, self._devices.camera)

        for _ in range(DOWNLOADS - 1):
            try:
                return self._patience.attempt(fetch, _DISK, curable=of_disk)
            except DeviceError as error:
                self._patience.report("retry", f"{step_name(attempt.step)}: {error}")
        return self._patience.attempt(fetch, _DISK, curable=of_disk)

    def _give_up(self, step: SessionStep, number: int, error: CropError) -> None:
        """Note an attempt that gave no frame, by no fault of what was to be photographed."""
        self._agenda.withdraw(step)
        self._collect(0)
        now = self._devices.clock.now()
        self._patience.attempt(lambda: self._session.journal.fail(number, now, str(error)), _DISK)

    def _wait_for(self, name: str, fault: CropError) -> None:
        """Wait for a camera or disk that lost a frame; the pause lasts until a frame came through."""
        self._pauses.setdefault(name, self._patience.pause(name, idle=name != _CAMERA)).wait(fault)

    def _is_back(self, name: str) -> None:
        if (pause := self._pauses.pop(name, None)) is not None:
            pause.over()

    def _wait_for_cause(self) -> None:
        """Let time pass for somebody to remove what refuses every frame, then let the frames be tried again."""
        fault, self._lasting = QualityError(self._lasting), ""
        pause, pause_s = self._probing or (self._patience.pause("the frames"), 0.0)
        clock = self._devices.clock
        until = clock.monotonic() + pause_s
        pause.wait(fault)
        while clock.monotonic() < until:
            pause.wait(fault)
        self._probing = pause, min(max(2 * pause_s, PROBE_S), LONGEST_PROBE_S)
        self._agenda.retry()
        if self._lasts_for is not None and self._lasts_for.kind != "dark":
            self._tie()

    def _tie(self) -> None:
        """Take the frames first that tie what follows to what was taken: what lasted may have changed for good."""
        journal = self._session.journal
        attempts = self._patience.attempt(journal.attempts, _DISK)
        if any(attempt.kind == "light" and attempt.verdict == ACCEPTED for attempt in attempts):
            numbers = self._patience.attempt(lambda: tie(self._session), _DISK)
            self._agenda.begin_with(step for step in self._session.steps if step.number in numbers)
        self._begun_after = attempts[-1].id
        self._saver.after_pause()

    def _collect(self, keep: int) -> None:
        """Journal the frames whose verdicts are due, oldest first, until `keep` are left to wait for."""
        while len(self._pending) > keep:
            pending = self._pending.popleft()
            begun = time.perf_counter()
            try:
                saved = pending.saved.result()
            except (DeviceError, StorageError) as error:
                attempt = pending.attempt
                self._give_up(attempt.step, attempt.number, error)
                self._wait_for(_DISK, error)
                continue
            self._is_back(_DISK)
            self._commit(pending.attempt, saved, time.perf_counter() - begun)

    def _commit(self, attempt: _Attempt, saved: Saved, waited_s: float) -> None:
        """Let a frame count, or not, and draw what follows for those to come."""
        step, judgement = attempt.step, saved.judgement
        timings = {**attempt.timings, "save": saved.save_s, "judge": saved.judge_s, "waited": waited_s}
        self._patience.attempt(
            lambda: self._session.commit(
                attempt.number,
                saved.received,
                judgement,
                timings,
                exposure_s=self._settings.camera.shutter_s,
                ended_at=attempt.over_at,
            ),
            _DISK,
        )
        if saved.preview_fault and not self._lacks_previews:
            self._lacks_previews = True
            self._patience.report("preview", f"{saved.preview_fault}; frames count without, and more is not said of it")
        void = self._void_ahead.pop(attempt.number, "")
        if judgement.accepted and void:
            self._agenda.withdraw(step)
            self._void_rows((attempt.number,), void)
        elif judgement.accepted:
            self._agenda.accept(step)
            for what, sentence in followed_changes(step, judgement, self._session.steps, self._settings.judge):
                self._patience.report(what, sentence)
            if self._probing and self._shows_mended(step):
                self._probing[0].over()
                self._probing = None
        else:
            self._refuse(step, judgement)
        if judgement.voids and step.kind in REFERENCES:
            self._void_since_reference(attempt, judgement.reason)
        elif judgement.voids:
            self._void_first_frames(attempt, judgement.reason)
        self._observe(Taken(step, judgement, len(self._agenda)))

    def _shows_mended(self, step: SessionStep) -> bool:
        """Return whether an accepted frame of a step shows that what lasted is over.

        What ties halves is accepted at another level of the lamp, and a dark frame where no light reaches the chart.
        """
        if self._lasts_for is None:
            return step.kind != "dark"
        return step.kind == "light" or step.number == self._lasts_for.number

    def _refuse(self, step: SessionStep, judgement: Judgement) -> None:
        self._doubtful = True
        first = judgement.lasting or (judgement.voids and step.kind in REFERENCES)
        again = self._agenda.refuse(step, judgement.reason, before_others=first)
        # What would be taken again without a good reference would be voided again, all night.
        in_vain = judgement.voids and not again
        pauses = bool(judgement.lasting or self._agenda.is_stuck or self._probing or in_vain)
        after = "it is tried again after a pause" if pauses else "it is left for the next run"
        then = "it is taken again" if again else after
        sentence = f"{step_name(step)}: {judgement.reason}"
        self._patience.report("refused", f"{sentence} ({then})")
        if pauses:
            self._lasting, self._lasts_for = sentence, step

    def _void_since_reference(self, refused: _Attempt, why: str) -> None:
        """Void what was taken since the last good reference of the refused one's kind, frames under way included.

        A reference of another kind stays that was taken beside the good one, before any light.
        """
        kind = refused.step.kind if refused.step.kind in REFERENCES else "white"
        reason = f"taken between a good reference and {step_name(refused.step)}, which was refused: {why}"
        since: dict[int, int] = {}
        for attempt in self._session.journal.attempts():
            if attempt.verdict == ACCEPTED and attempt.id < refused.number:
                if attempt.kind == kind:
                    since.clear()
                elif since or attempt.kind not in REFERENCES:
                    since[attempt.id] = attempt.step
        self._void(since, reason)
        # Their frames have left the camera; whether they are accepted is known only later.
        self._void_ahead.update({pending.attempt.number: reason for pending in self._pending})

    def _void_first_frames(self, refused: _Attempt, why: str) -> None:
        """Void what this run has taken, since its last pause for something lasting: by that others are judged."""
        reason = f"the first frames contradict {step_name(refused.step)}: {why}"
        since = {
            attempt.id: attempt.step
            for attempt in self._session.journal.attempts()
            if attempt.verdict == ACCEPTED and self._begun_after < attempt.id < refused.number
        }
        self._void_rows(since, reason)
        # The refused one, and what is under way, are taken again in their places among them.
        again = {refused.step.number, *since.values(), *(pending.attempt.step.number for pending in self._pending)}
        self._agenda.begin_with(step for step in self._session.steps if step.number in again)
        self._void_ahead.update({pending.attempt.number: reason for pending in self._pending})

    def _void(self, attempts: Mapping[int, int], reason: str) -> None:
        """Void accepted attempts, given with the numbers of their steps, and have the steps taken again."""
        self._agenda.void(attempts.values(), reason)
        if self._agenda.is_stuck:
            self._lasting, self._lasts_for = reason, None
        self._void_rows(attempts, reason)

    def _void_rows(self, attempts: Collection[int], reason: str) -> None:
        if not attempts:
            return
        now = self._devices.clock.now()
        self._patience.attempt(lambda: self._session.journal.void(tuple(attempts), now, reason), _DISK)
        self._patience.report("voided", f"{counted(len(attempts), 'frame')}, to be taken again: {reason}")

    def _salvage(self, error: BaseException) -> None:
        """Journal what the camera has given, whatever ended the run; a further fault does not hide the first."""
        while self._pending:
            try:
                self._collect(0)
            except CropError as further:
                error.add_note(f"then: {further}")


def of_disk(fault: CropError) -> bool:
    """Return whether a fault is one of the disk."""
    return isinstance(fault, StorageError) and is_curable(fault)
