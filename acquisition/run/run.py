"""From LAB.toml to a session on disk: creates it or takes it up, opens the rig, and takes every frame that is open.

The first part tells others of a run: the terminal, a command, a URL, systemd, a dead man's switch. No frame waits for
them; docs/how-to/night-run.md says what they get.

Rules that hold inside for a session that is taken up:

- Files are held against their hashes before a device is opened: what is damaged is taken again.
- A session has one camera and one projector: a table of two sensors, even of the same model, is a table of none, and
  nothing in the frames says so. There is no option to go on with another one.

For telling:

- Telling takes no time: a thread of its own delivers, one notice after another, each within `LIMIT_S`.
- A notice that cannot be delivered hurts nobody: what failed is said once, by the thread that tells.
- Of the target nothing is said but a URL's scheme and host, or a program's name: the rest may be a secret. Errors of
  libraries, whose text may hold it, are told by their number or kind.
- Signs of life (`Life`) come from the steps of the run itself, a frame, a try in a pause: a run that hangs gives none,
  and its silence tells that it hangs.
"""

from __future__ import annotations

import base64
import http.client
import json
import math
import os
import queue
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Final, Self
from urllib.parse import unquote, urlsplit, urlunsplit

from acquisition.judge.judge import LiveJudge
from acquisition.judge.measure import ExposureJudge
from acquisition.monitor.view import write_session_report
from acquisition.run.devices import TRY_S, Devices, RetryPolicy, RunEnd, RunWatch, leave_lab, make_ready, pause_cause
from acquisition.run.pipeline import Job, Pipeline, StepQueue, Taken, link_runs, step_name, unclosed_kinds
from acquisition.run.plan import nothing_to_retake, planned_steps, require_plan, require_same
from acquisition.run.rig.opening import open_rig
from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, STRAY_SHARE, WHITE_DRIFT
from drivers.camera import keep_awake
from drivers.presenter import BLACK, WHITE
from experiment.chart.model import load_chart
from experiment.config import LabSettings
from experiment.lights import load_illuminations
from experiment.session.folder import Session, busy_message, session_exists
from experiment.session.heartbeat import AGAIN, BEAT_S, RunState, SessionPlace
from experiment.session.journal import thread_beat
from experiment.session.records import (
    ACCEPTED,
    DOUBT,
    RECENT,
    VOIDED,
    Check,
    FrameJudge,
    FrameKind,
    SessionStep,
    TimedAttempt,
    doubts_of,
    duration_text,
    last_frame_time,
    time_left,
)
from foundation.clock import Clock, SteadyClock
from foundation.console import EndRequest, shows_progress
from foundation.errors import CropError, DeviceRefused, InputError, StorageError, first_few
from foundation.secret_texts import is_webhook, target_label
from foundation.version import software

LIMIT_S: Final = 20.0  # How long a receiver may take; a message to a telephone takes seconds
ENDING_S: Final = 2.0  # How much longer the end waits for the last one, so that a receiver that is too slow is named
# Between two notices of a pause for the same cause: whoever was told once in the hour, and did not come, is not woken
# by each time that it comes and goes.
QUIET_S: Final = 3600.0
QUEUED: Final = 100  # Notices that may wait for a slow receiver; more are dropped


class Notices:
    """Tells a target what happens; close it at the end, which waits for what was told, for `LIMIT_S` at most.

    `target`: a URL or a command line; empty: nobody is told.
    """

    def __init__(self, target: str, session: str, warn: Callable[[str], object] = lambda sentence: None) -> None:
        self._target = target
        self._session = session
        self._warn = warn
        self._waiting: queue.Queue[tuple[str, str, bytes] | None] = queue.Queue(QUEUED)
        self._failed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._said: set[str] = set()
        self._closed = False
        self._thread = threading.Thread(target=self._deliver_all, name="notices", daemon=True)
        if target:
            self._thread.start()

    def tell(self, event: str, message: str, at: datetime) -> None:
        """Tell what happens; returns at once."""
        if not self._target:
            return
        text = f"{self._session}: {event}: {message}"
        # Slack, Mattermost and their likes show `text`, Discord `content`.
        body = {
            "event": event,
            "message": message,
            "text": text,
            "content": text,
            "session": self._session,
            "host": socket.gethostname(),
            "at": at.isoformat(timespec="seconds"),
        }
        with suppress(queue.Full):
            self._waiting.put_nowait((event, message, json.dumps(body, ensure_ascii=False).encode()))
        self.say_failures()

    def close(self) -> None:
        """Wait until all was delivered, or for `LIMIT_S` and a little; a second call does nothing."""
        if self._thread.is_alive() and not self._closed:
            until = time.monotonic() + LIMIT_S + ENDING_S
            with suppress(queue.Full):
                self._waiting.put(None, timeout=LIMIT_S)
            self._thread.join(max(until - time.monotonic(), 0))
            if self._thread.is_alive():
                self._failed.put(f"{target_label(self._target)} was not told all before the end")
        self._closed = True
        self.say_failures()

    def say_failures(self) -> None:
        """Say what could not be delivered meanwhile; from the thread that tells, as often as it likes."""
        while not self._failed.empty():
            sentence = self._failed.get()
            # A receiver that is gone stays gone for the night: once is enough.
            if sentence not in self._said:
                self._said.add(sentence)
                self._warn(sentence)

    def _deliver_all(self) -> None:
        while (notice := self._waiting.get()) is not None:
            why = self._posted(*notice) if is_webhook(self._target) else self._run(*notice)
            if why:
                self._failed.put(f"{target_label(self._target)} could not be told: {why}; the run goes on without")

    def _run(self, event: str, message: str, body: bytes) -> str:
        """Run the command; return why it failed, empty if it did not."""
        variables = {"CROP_EVENT": event, "CROP_MESSAGE": message, "CROP_SESSION": self._session}
        try:
            # In a group of its own: Ctrl-C is not for it, and what it starts ends with it.
            process = subprocess.Popen(
                shlex.split(self._target),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **variables},
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            return getattr(error, "strerror", None) or type(error).__name__
        with process:
            try:
                process.communicate(body, LIMIT_S)
            except subprocess.TimeoutExpired:
                with suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                return f"it did not end within {LIMIT_S:g} s"
        return f"it ended with {process.returncode}, 0 expected" if process.returncode else ""

    def _posted(self, event: str, message: str, body: bytes) -> str:
        """Post to the URL; return why it failed, empty if it did not."""
        parts = urlsplit(self._target)
        headers = {"Content-Type": "application/json; charset=utf-8", "User-Agent": "CroP"}
        if event.isascii():
            headers["Title"] = f"CroP: {event}"
        if parts.username is not None:
            word = f"{unquote(parts.username)}:{unquote(parts.password or '')}".encode()
            headers["Authorization"] = f"Basic {base64.b64encode(word).decode()}"
        bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment=""))
        return _post(bare, body, headers)


def _post(url: str, body: bytes, headers: Mapping[str, str]) -> str:
    """Post to a URL without user name; return why it failed, empty if it did not."""
    # They cost a thirtieth of a second, which every command would pay.

    class Unredirected(urllib.request.HTTPRedirectHandler):
        """Follows no redirection: the body would be lost on the way, and the answer be a success."""

        def redirect_request(self, req: object, fp: object, code: int, msg: str, headers: object, newurl: str) -> None:
            return None

    request = urllib.request.Request(url, body, dict(headers))
    try:
        with urllib.request.build_opener(Unredirected).open(request, timeout=LIMIT_S):
            return ""
    except urllib.error.HTTPError as error:
        error.close()
        return f"it answered {error.code}"
    except urllib.error.URLError as error:
        return getattr(error.reason, "strerror", None) or type(error.reason).__name__
    except (OSError, ValueError, http.client.HTTPException) as error:
        return getattr(error, "strerror", None) or type(error).__name__


class PauseNotices:
    """Tells of pauses: of one for the same cause once in `QUIET_S`, of the end of one that was told.

    `tell`: takes an event and its sentence.
    """

    def __init__(self, tell: Callable[[str, str], object], clock: Clock) -> None:
        self._tell, self._clock = tell, clock
        self._told_at: dict[str, float] = {}
        self._is_told = False

    def paused(self, sentence: str) -> None:
        """Note a pause as it begins, or as it lasts: one that began too early to be told is told later."""
        if self._is_told:
            return
        cause, now = pause_cause(sentence), self._clock.monotonic()
        if now - self._told_at.get(cause, -math.inf) >= QUIET_S:
            self._told_at[cause] = now
            self._is_told = True
            self._tell("paused", sentence)

    def resumed(self, sentence: str) -> None:
        """Note that the pause is over."""
        if self._is_told:
            self._is_told = False
            self._tell("resumed", sentence)


# Checks that the line about the last frame has, as far as they have a number.
SHOWN = (
    OFF_CODES_DEG.name, "movement", "blur", WHITE_DRIFT.name,
    LEAK_SHARE.name, STRAY_SHARE.name, DARK_DRIFT.name, "exposure",
)  # fmt: skip


def verdict_line(taken: Taken) -> str:
    """Return what is said of the last frame in a line: its verdict, and numbers with their units."""
    checks = [check for check in taken.judgement.checks if check.name in SHOWN and check.value is not None]
    numbers = map(_number_text, sorted(checks, key=lambda check: SHOWN.index(check.name)))
    said = "accepted" if taken.judgement.accepted else "refused"
    return ", ".join([f"{step_name(taken.step)} {said}", *numbers])


def _number_text(check: Check) -> str:
    """Return a check's name and number, as in ``off_codes_deg 0.21°``."""
    unit = "" if not check.unit else check.unit if check.unit.startswith("°") else f" {check.unit}"
    return f"{check.name} {check.value:.3g}{unit}{' (beyond its limit)' if check.is_beyond else ''}"


# Between two lines on how far a run is, where they go into a file: enough to see that it lives, and a night's
# thousand lines can still be read.
PLAIN_S: Final = 30.0


class Terminal:
    """Shows a run: as a bar on a terminal, else as a line now and then; use it in a `with` block.

    `clock`: returns seconds; the machine's own unless a test has another.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._clock = clock
        self._since: float | None = None
        self._attempts: deque[TimedAttempt] = deque(maxlen=RECENT)
        self._said = ""
        self._plain = shows_progress() and not console.is_terminal
        self._plain_due = -math.inf
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[said]}"),
            console=console,
            redirect_stdout=sys.stdout.isatty(),
            disable=not shows_progress() or self._plain,
        )
        self._task = self._bar.add_task("frames", total=None, left="", said="")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:
            self._bar.update(self._task, left="", said="")
            self._bar.stop()

    def progress(self, done: int, total: int) -> None:
        """Show how many frames are done."""
        # What is refused before there is anything to count gets no bar.
        if not self._bar.live.is_started:
            self._bar.start()
        left_s = time_left(self._attempts, total - done)
        left = "" if left_s is None or done == total else f"left {duration_text(left_s)}"
        self._bar.update(self._task, completed=done, total=total, left=left)
        self._say_plainly(", ".join(filter(None, [f"{done} of {total} frames", left, self._said])), done == total)

    def taken(self, taken: Taken) -> None:
        """Show the verdict of a frame, and take its time for that of those to come."""
        now = self._clock()
        seconds = None if self._since is None else now - self._since
        self._attempts.append(TimedAttempt(seconds, taken.judgement.accepted))
        self._since = now
        self._said = verdict_line(taken)
        self._bar.update(self._task, said=self._said)

    def announce(self, sentence: str) -> None:
        """Print a line that stays."""
        _print(sentence)

    def state(self, sentence: str) -> None:
        """Show what the run waits for until the next frame; the time until then is no frame's."""
        self._since = None
        self._bar.update(self._task, said=sentence, left="")
        self._say_plainly(sentence)

    def _say_plainly(self, line: str, at_once: bool = False) -> None:
        """Print a line with the time of day where there is no bar, not more often than each `PLAIN_S`."""
        now = self._clock()
        if self._plain and (at_once or now >= self._plain_due):
            self._plain_due = now + PLAIN_S
            _print(f"{datetime.now().astimezone():%H:%M:%S} {line}")


def _print(line: str) -> None:
    # A log on a disk that is full for a while ends no run: the journal has what counts.
    with suppress(OSError):
        print(line, file=sys.stderr)


ALIVE_S: Final = 60.0  # Between two signs to a dead man's switch: services of that kind count minutes

# Of the watchdog's time, between two signs at least: sd_watchdog_enabled(3) recommends half of it at most.
WATCHDOG_SHARE: Final = 0.25


class Life:
    """Gives signs of life of a run; close it at the end.

    `target`: the dead man's switch, a URL or a command; empty: none. `environment`: what a service manager has set.
    """

    def __init__(
        self,
        target: str,
        session: str,
        warn: Callable[[str], object],
        clock: Clock,
        environment: Mapping[str, str] = os.environ,
    ) -> None:
        self._notices = Notices(target, session, warn)
        self._clock = clock
        self._manager = environment.get("NOTIFY_SOCKET", "")
        self._watchdog_s = _watchdog_s(environment)
        self._told = self._fed = -math.inf

    def ready(self) -> None:
        """Tell that devices and session are open, and the run is at work."""
        self._to_manager("READY=1")
        self.sign("at work")

    def sign(self, doing: str) -> None:
        """Tell what the run does now, as often as is wanted."""
        now = self._clock.monotonic()
        if now - self._fed >= self._watchdog_s * WATCHDOG_SHARE:
            self._fed = now
            self._to_manager(f"WATCHDOG=1\nSTATUS={' '.join(doing.split())}")
        if now - self._told >= ALIVE_S:
            self._told = now
            self._notices.tell("alive", doing, datetime.now(UTC))
        self._notices.say_failures()

    def end(self, how: str, sentence: str) -> None:
        """Tell how the run ended; nothing follows."""
        self._to_manager(f"STOPPING=1\nSTATUS={how}: {' '.join(sentence.split())}")
        self._notices.tell(how, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Let what was told be delivered."""
        self._notices.close()

    def _to_manager(self, text: str) -> None:
        """Send a datagram as sd_notify(3) describes; a manager that does not take it hurts nobody."""
        if self._manager[:1] in ("/", "@"):
            address = self._manager.replace("@", "\0", 1) if self._manager.startswith("@") else self._manager
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
                link.setblocking(False)
                link.sendto(text.encode(), address)


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """Return after how many seconds of silence this process is ended; 0 where nobody does."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return int(environment.get("WATCHDOG_USEC", "0")) / 1e6
    except ValueError:
        return 0.0


# How long a camera is expected to take for its settings: a dozen messages, each with an answer that is waited for.
CONFIGURE_S = 10.0


def run_session(
    settings: LabSettings,
    folder: Path,
    observe: Callable[[int, int], object],
    announce: Callable[[str], object] = lambda sentence: None,
    retake: str | None = None,
    ending: EndRequest | None = None,
    taken: Callable[[Taken], object] = lambda taken: None,
    state: Callable[[str], object] = lambda sentence: None,
) -> RunOutcome:
    """Take the session `folder`, new or interrupted, with the rig that the settings name.

    `retake`: what to take again (`Session.retake`); nothing if None.
    """
    with ExitStack() as at_last, ExitStack() as opened:
        session = opened.enter_context(_taken_up(settings, folder, announce)) if session_exists(folder) else None
        if session is None and retake is not None:
            raise nothing_to_retake(folder)
        alive = None if session is None else opened.enter_context(_signs_of(session))
        if session is not None and alive is not None:
            if retake is not None:
                session.retake(retake)

            def checking(done: int, total: int) -> None:
                state(f"checking frame {done} of {total}")
                alive(f"{BEGINS}; frame {done} of {total}")

            if session.journal.accepted_files() and (damaged := session.verify(checking)):
                announce(f"voided: {first_few(damaged, 5)}")
            total = len(session.steps)
            if len(session.done_steps()) == total:
                observe(total, total)
                return RunOutcome(total, 0, (), tuple(doubts_of(session.journal.events())))
        chart = load_chart(settings.chart) if session is None else session.chart
        devices = opened.enter_context(open_rig(settings, chart, session))
        require_plan(settings, folder, session, devices)
        if session is None:
            session = opened.enter_context(_begun(settings, folder))
            session.journal.retry_locked(settings.sequence.patience_s, announce)
        require_same_devices(session, devices, settings)
        if note := clock_note(session, devices.clock):
            announce(note)
        first = link_runs(session, devices.clock.now())
        total = len(session.steps)
        observe(len(session.done_steps()), total)
        # When the screen is dark and the journal at rest.
        at_last.callback(_report, session, announce)
        sign = alive or opened.enter_context(_signs_of(session))
        sign("")

        def count(frame: Taken) -> None:
            sign("")
            taken(frame)
            # A reference may have been put behind the plan.
            total = len(session.steps)
            observe(total - frame.left, total)

        judge = LiveJudge(settings, session.chart, session.illuminations)
        return take_session(session, devices, settings, judge, count, announce, state, ending, first)


@contextmanager
def _signs_of(session: Session) -> Generator[SignOfLife]:
    """Note how the run before ended, if it was killed, and say from now on that this one is there."""
    journal = session.journal
    if note := killed_note(session):
        # The lab's clock is not open yet, and may be another than the wall's.
        journal.note(last_frame_time(journal.attempts()) or datetime.now(UTC), "killed", note)
    with signs_of_life(journal.beat, journal.run_state, TRY_S) as alive:
        yield alive


def _report(session: Session, announce: Callable[[str], object]) -> None:
    """Write the session's report; it is derived, so that a disk that does not take it leaves the run as it ended."""
    try:
        write_session_report(session.folder)
    except CropError as error:
        announce(f"report: {error}; when that is mended, acquire report {session.folder} makes it")


def _taken_up(settings: LabSettings, folder: Path, announce: Callable[[str], object]) -> Session:
    session = Session.open_for_run(folder, settings.sequence.patience_s, announce)
    try:
        require_same(session, settings)
    except BaseException:
        session.close()
        raise
    return session


def _begun(settings: LabSettings, folder: Path) -> Session:
    chart = load_chart(settings.chart)
    lights = load_illuminations(settings.illuminations)
    try:
        return Session.create(folder, settings.to_toml(), chart, lights, planned_steps(settings, lights))
    except InputError:
        # It was not there when this run began: another one has made it since, and frames come into it.
        if session_exists(folder):
            raise InputError(busy_message(folder)) from None
        raise


def require_same_devices(session: Session, devices: Devices, settings: LabSettings) -> None:
    """Require that camera and projector are those that the session was begun with; note those of a new one."""
    known = session.journal.records()
    body = devices.camera.identity()
    # Its firmware may be brought up to date between two runs, and the name in a projector's menu may change.
    names = {"camera": f"{body.maker} {body.model}, serial number {body.serial}"}
    if devices.projector is not None:
        projector = devices.projector.identity()
        names["projector"] = f"{projector.maker} {projector.model}".strip() or "of an unknown maker"
    if settings.rig == "lab":
        display = settings.lab.light.display
        names["screen"] = "display" if display is None else f"display {display}"
    for what, name in names.items():
        before = known.get(what, name)
        if before != name:
            raise DeviceRefused(
                f"{session.folder} was begun with the {what} {before}, and now there is {name}: frames of both would "
                "not make one table",
                remedy=f"connect the {what} of before, or begin a new session",
                value=name,
                expected=before,
            )
    for what, name in {**names, "software": software()}.items():
        if known.get(what) != name:
            session.journal.record(what, name)


def clock_note(session: Session, clock: Clock) -> str:
    """Return what to say where the machine's clock is behind the session's last frame, with the remedy.

    Else nothing.
    """
    if not isinstance(clock, SteadyClock) or not clock.behind_s:
        return ""
    return (
        f"clock: it is {duration_text(clock.behind_s)} behind the last frame of {session.folder}, or was ahead when "
        "that was taken; the session's time goes on from there, so that its frames stay in their order; set the "
        "machine's clock right"
    )


def killed_note(session: Session) -> str:
    """Return what the journal is to say of the run before, if that did not end in order; else nothing."""
    beat = session.journal.heartbeat()
    if beat is None or beat.state == "ended" or beat.belongs_to(SessionPlace.of(session.journal.path)) is False:
        return ""
    at = f"{beat.at.astimezone():%Y-%m-%d %H:%M:%S}"
    return f"the run before gave its last sign of life at {at}, and was killed, or power was lost"


@dataclass(frozen=True)
class RunOutcome:
    """Why a run ended.

    - `total`, `left`: steps of the plan, and those without an accepted frame.
    - `refused`: why steps were left for the next run, a sentence each.
    - `doubts`: what stopped nothing in this run and those before, and is to be seen.
    """

    total: int
    left: int
    refused: tuple[str, ...]
    doubts: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every step has its frame."""
        return self.left == 0


def take_session(
    session: Session,
    devices: Devices,
    settings: LabSettings,
    judge: FrameJudge | None = None,
    observe: Callable[[Taken], object] = lambda taken: None,
    announce: Callable[[str], object] = lambda sentence: None,
    state: Callable[[str], object] = lambda sentence: None,
    ending: EndRequest | None = None,
    first: Sequence[int] = (),
) -> RunOutcome:
    """Take every step of the session's plan that has no accepted frame yet.

    `judge`: looks at every frame; None looks at its exposure alone. `state`: called every few seconds of a wait with
    what is waited for and how long; the newest holds. `ending`: by which the run learns that it is to end after the
    running frame; None for a run that nobody asks. `first`: numbers of steps that are taken before all others.
    """
    sequence = settings.sequence
    reports = _Reports(session, devices.clock, announce, state, settings)
    asked = ending or EndRequest()
    retry = RetryPolicy(
        devices.clock,
        sequence.patience_s,
        reports.tell,
        lambda: keep_awake(devices.camera),
        reports.sign_of_life,
        asked.at_once,
    )

    def count(frame: Taken) -> None:
        reports.working(f"{len(session.steps) - frame.left} of {len(session.steps)} frames")
        observe(frame)

    reports.ready()
    try:
        for stray in session.set_aside_strays():
            reports.tell("stray", f"{stray.name}: complete, but not in the journal; kept, not used")
        with RunWatch(reports.late) as watch:
            queue = _open_steps(session, settings, first)
            job = Job(session, devices, settings, queue, judge or ExposureJudge(settings), retry, watch)
            if len(job.queue):
                _make_ready(job)
                with ThreadPoolExecutor(1, "saving") as saving:
                    Pipeline(job, saving, count, asked).run()
        session.journal.require_whole()
        doubts = tuple(doubts_of(session.journal.events()))
        outcome = RunOutcome(len(session.steps), len(job.queue), job.queue.given_up, doubts)
        if asked.is_requested and not outcome.complete:
            raise KeyboardInterrupt
        leave_lab(devices, RunEnd.COMPLETE if outcome.complete else RunEnd.UNFINISHED, sequence, reports.tell)
    except BaseException as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        leave_lab(devices, RunEnd.INTERRUPTED if interrupted else RunEnd.UNFINISHED, sequence, reports.tell)
        # It is derived, and made anew at the next opening: the fault that is there counts.
        with suppress(StorageError):
            session.write_frames_csv()
        reports.end("interrupted" if interrupted else "ended", str(error) or "by the operator")
        raise
    else:
        session.write_frames_csv()
        left = f"{outcome.left} of {outcome.total} frames left"
        reports.end("complete" if outcome.complete else "incomplete", "; ".join([left, *outcome.refused]))
    finally:
        reports.close()
    return outcome


def _open_steps(session: Session, settings: LabSettings, first: Sequence[int]) -> StepQueue:

    def append(kind: FrameKind) -> SessionStep:
        step = SessionStep(session.steps[-1].number + 1, kind, None, WHITE if kind == "white" else BLACK)
        session.add_steps([step])
        return step

    taken = [attempt.kind for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    sequence = settings.sequence
    return StepQueue(
        session.steps,
        session.done_steps(),
        sequence.attempts,
        append,
        first,
        unclosed_kinds(taken),
        sequence.reference_every,
    )


def _make_ready(job: Job) -> None:
    devices, settings, journal = job.devices, job.settings, job.session.journal
    journal.note(devices.clock.now(), "start", f"{len(job.queue)} of {len(job.session.steps)} frames to take")
    with job.watch.step("the camera", "takes its settings", CONFIGURE_S, "configure"):
        devices.camera.configure(settings.camera.exposure)
    for step, _, measurement, accepted in journal.measurements():
        job.judge.recall(step, measurement, accepted)
    if devices.projector is not None:
        make_ready(devices.projector, settings.sequence, job.retry)


BEGINS = "a run begins: it looks at its frames and opens its devices"  # What a run says before it takes frames


# A run's way to say that it is there, and what is waited for; with nothing, that frames are taken.
SignOfLife = Callable[[str], None]


@contextmanager
def signs_of_life(
    beat: Callable[[RunState, str, datetime], None], newest: Callable[[], RunState | None], within_s: float
) -> Generator[SignOfLife]:
    """Say that a run is there while the block runs, and in the end that it is over, and why."""
    last, said = -math.inf, ""

    def say(state: RunState, sentence: str) -> None:
        with suppress(CropError):
            beat(state, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def changes(state: RunState) -> bool:
        with suppress(CropError):
            return newest() not in (None, state)
        return False

    def alive(waits_for: str) -> None:
        nonlocal last, said
        state: RunState = "waiting" if waits_for else "running"
        if time.monotonic() - last >= BEAT_S or state != said or changes(state):
            last, said = time.monotonic(), state
            say(state, waits_for or "frames are taken")

    cause = f"ended by a mistake of the program; {AGAIN}"
    try:
        alive(BEGINS)
        yield alive
        cause = ""
    except KeyboardInterrupt:
        cause = f"interrupted; {AGAIN}"
        raise
    except CropError as error:
        cause = str(error)
        raise
    finally:
        say("ended", cause)


class _Reports:
    """Where words of a run go: terminal, journal, whoever is notified."""

    def __init__(
        self,
        session: Session,
        clock: Clock,
        announce: Callable[[str], object],
        state: Callable[[str], object],
        settings: LabSettings,
    ) -> None:
        self._journal = session.journal
        self._clock = clock
        self._announce = announce
        self._state = state
        name = session.folder.name
        self._notices = Notices(settings.sequence.notify, name, lambda why: self.doubt(f"sequence.notify: {why}"))
        self._life = Life(settings.notify.alive, name, lambda why: self.doubt(f"notify.alive: {why}"), clock)
        self._pauses = PauseNotices(self._notify, clock)

    def ready(self) -> None:
        """Say that devices and session are open."""
        self._life.ready()

    def working(self, doing: str) -> None:
        """Say what the run does now, and what could not be told of it to others."""
        self._life.sign(doing)
        self._notices.say_failures()

    def doubt(self, sentence: str) -> None:
        """Tell what stops nothing and is to be seen in the morning; a disk that cannot take it is told of already."""
        self._announce(f"{DOUBT}: {sentence}")
        with suppress(StorageError):
            self._journal.note(self._clock.now(), DOUBT, sentence)

    def tell(self, what: str, sentence: str, /) -> None:
        """Tell what happens."""
        self._announce(f"{what}: {sentence}")
        if what == "paused":
            self._pauses.paused(sentence)
        elif what == "resumed":
            self._pauses.resumed(sentence)
        if what != VOIDED:  # the journal notes that with the rows that it changes
            self._journal.note(self._clock.now(), what, sentence)

    def sign_of_life(self, what: str, sentence: str, within_s: float, /) -> None:
        """Say that the run waits, and for what."""
        doing: RunState = "paused" if what == "paused" else "waiting"
        if doing == "paused":
            self._pauses.paused(sentence)
        self._state(sentence)
        self.working(f"{doing}: {sentence}")
        self._journal.beat(doing, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def late(self, sentence: str, begun: datetime) -> None:
        """Say, from another thread, that a step takes longer than it should: the run's own thread waits for it."""
        thread_beat(self._journal.path, "late", sentence, begun + timedelta(seconds=TRY_S))

    def end(self, how: str, sentence: str) -> None:
        """Note why the run is over; a disk that cannot take that is told of already."""
        self._notify(how, sentence)
        self._life.end(how, sentence)
        with suppress(StorageError):
            self._journal.note(self._clock.now(), how, sentence)

    def _notify(self, event: str, sentence: str) -> None:
        self._notices.tell(event, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Let the last notices be delivered."""
        self._notices.close()
        self._life.close()
