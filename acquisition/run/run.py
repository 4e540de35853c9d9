"""Take a session as set in LAB.toml: create or resume it, open the rig, take all missing frames, and send notices.

Notices go to the terminal, a command, a URL, systemd and a monitoring service (docs/how-to/notifications.md). A
separate thread delivers them, so that frames do not wait. A notice that cannot be delivered is reported once.
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
from acquisition.run.pipeline import Job, Pipeline, StepQueue, Taken, link_runs, missing_references, step_name
from acquisition.run.plan import nothing_to_retake, planned_steps, require_plan, require_same
from acquisition.run.rig.opening import open_rig
from calibration.figures.light import DARK_DRIFT, LEAK_SHARE, OFF_CODES_DEG, STRAY_SHARE, WHITE_DRIFT
from drivers.camera import keep_awake
from drivers.presenter import BLACK, WHITE
from experiment.chart.model import load_chart
from experiment.config import LabSettings
from experiment.lights import load_illuminants
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

LIMIT_S: Final = 20.0  # Longest time for a receiver to accept a notice, s
ENDING_S: Final = 2.0  # Additional time at the end of a run, s, so that the failure of the last notice is reported
# Shortest interval between two notices of pauses with the same cause, s.
QUIET_S: Final = 3600.0
QUEUED: Final = 100  # Largest number of notices that wait for a slow receiver; more are dropped


class Notices:
    """Sends events to a target; `close` waits for the delivery of all events.

    `target`: a URL or a command line; empty for none.
    """

    def __init__(self, target: str, session: str, warn: Callable[[str], object] = lambda sentence: None) -> None:
        self._target = target
        self._session = session
        self._warn = warn
        self._waiting: queue.Queue[tuple[str, str, bytes] | None] = queue.Queue(QUEUED)
        self._failed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reported: set[str] = set()
        self._closed = False
        self._thread = threading.Thread(target=self._deliver_all, name="notices", daemon=True)
        if target:
            self._thread.start()

    def send(self, event: str, message: str, at: datetime) -> None:
        """Put an event into the queue of the sending thread."""
        if not self._target:
            return
        text = f"{self._session}: {event}: {message}"
        # Slack, Mattermost and similar services show `text`, Discord shows `content`.
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
        self.report_failures()

    def close(self) -> None:
        """Wait until all notices are delivered, at most for `LIMIT_S` plus `ENDING_S`; a second call does nothing."""
        if self._thread.is_alive() and not self._closed:
            until = time.monotonic() + LIMIT_S + ENDING_S
            with suppress(queue.Full):
                self._waiting.put(None, timeout=LIMIT_S)
            self._thread.join(max(until - time.monotonic(), 0))
            if self._thread.is_alive():
                self._failed.put(
                    f"{target_label(self._target)} did not receive all notices in time; check the receiver"
                )
        self._closed = True
        self.report_failures()

    def report_failures(self) -> None:
        """Report notices that could not be delivered; called by the thread of the run."""
        while not self._failed.empty():
            sentence = self._failed.get()
            # Each failure is reported only once, because it usually repeats with every notice.
            if sentence not in self._reported:
                self._reported.add(sentence)
                self._warn(sentence)

    def _deliver_all(self) -> None:
        while (notice := self._waiting.get()) is not None:
            failure = self._post_notice(*notice) if is_webhook(self._target) else self._run_command(*notice)
            if failure:
                # The message contains only scheme and host, or the program. The rest of the target may be secret.
                label = target_label(self._target)
                self._failed.put(f"{label} did not receive a notice: {failure}; the run continues; check the receiver")

    def _run_command(self, event: str, message: str, body: bytes) -> str:
        variables = {"CROP_EVENT": event, "CROP_MESSAGE": message, "CROP_SESSION": self._session}
        try:
            # In its own process group, the command is not reached by Ctrl-C, and its child processes can be ended.
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
                return f"it has not ended within {LIMIT_S:g} s"
        return f"it ended with {process.returncode}, expected 0" if process.returncode else ""

    def _post_notice(self, event: str, message: str, body: bytes) -> str:
        url = urlsplit(self._target)
        headers = {"Content-Type": "application/json; charset=utf-8", "User-Agent": "CroP"}
        if event.isascii():
            headers["Title"] = f"CroP: {event}"
        if url.username is not None:
            credentials = f"{unquote(url.username)}:{unquote(url.password or '')}".encode()
            headers["Authorization"] = f"Basic {base64.b64encode(credentials).decode()}"
        bare_url = urlunsplit(url._replace(netloc=url.netloc.rpartition("@")[2], fragment=""))
        return _post(bare_url, body, headers)


def _post(url: str, body: bytes, headers: Mapping[str, str]) -> str:

    class Unredirected(urllib.request.HTTPRedirectHandler):
        """Follows no redirection, because a redirected request would lose its body and still succeed."""

        def redirect_request(self, req: object, fp: object, code: int, msg: str, headers: object, newurl: str) -> None:
            return None

    request = urllib.request.Request(url, body, dict(headers))
    try:
        with urllib.request.build_opener(Unredirected).open(request, timeout=LIMIT_S):
            return ""
    # Error messages of libraries may contain the secret address, so only the code or the kind of an error is reported.
    except urllib.error.HTTPError as error:
        error.close()
        return f"it answered {error.code}"
    except urllib.error.URLError as error:
        return getattr(error.reason, "strerror", None) or type(error.reason).__name__
    except (OSError, ValueError, http.client.HTTPException) as error:
        return getattr(error, "strerror", None) or type(error).__name__


class PauseNotices:
    """Sends notices of pauses and of their ends, but at most one notice per cause in `QUIET_S`.

    `send`: receives an event and a sentence.
    """

    def __init__(self, send: Callable[[str, str], object], clock: Clock) -> None:
        self._send, self._clock = send, clock
        self._sent_at_s: dict[str, float] = {}
        self._is_reported = False

    def paused(self, sentence: str) -> None:
        """Report a pause. This is called repeatedly, so a notice that comes too early for `QUIET_S` is sent later."""
        if self._is_reported:
            return
        cause, now_s = pause_cause(sentence), self._clock.monotonic()
        if now_s - self._sent_at_s.get(cause, -math.inf) >= QUIET_S:
            self._sent_at_s[cause] = now_s
            self._is_reported = True
            self._send("paused", sentence)

    def resumed(self, sentence: str) -> None:
        """Report the end of the pause, if its start was reported."""
        if self._is_reported:
            self._is_reported = False
            self._send("resumed", sentence)


# Names of the checks whose values are shown for the last frame, in this order.
SHOWN = (
    OFF_CODES_DEG.name, "movement", "blur", WHITE_DRIFT.name,
    LEAK_SHARE.name, STRAY_SHARE.name, DARK_DRIFT.name, "exposure",
)  # fmt: skip


def verdict_line(frame: Taken) -> str:
    """Return verdict and measured values of a frame in one line."""
    checks = [check for check in frame.judgement.checks if check.name in SHOWN and check.value is not None]
    numbers = map(_number_text, sorted(checks, key=lambda check: SHOWN.index(check.name)))
    verdict = "accepted" if frame.judgement.accepted else "refused"
    return ", ".join([f"{step_name(frame.step)} {verdict}", *numbers])


def _number_text(check: Check) -> str:
    unit = "" if not check.unit else check.unit if check.unit.startswith("°") else f" {check.unit}"
    return f"{check.name} {check.value:.3g}{unit}{' (beyond its limit)' if check.is_beyond else ''}"


# Interval between two lines of progress if the output is not a terminal, s.
PLAIN_S: Final = 30.0


class Terminal:
    """Shows the progress of a run as a bar on a terminal, otherwise as lines; use it in a `with` block.

    `clock`: returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._clock = clock
        self._since: float | None = None
        self._attempts: deque[TimedAttempt] = deque(maxlen=RECENT)
        self._reported = ""
        self._plain = shows_progress() and not console.is_terminal
        self._plain_due = -math.inf
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[remaining]}"),
            TextColumn("{task.fields[status]}"),
            console=console,
            redirect_stdout=sys.stdout.isatty(),
            disable=not shows_progress() or self._plain,
        )
        self._task = self._bar.add_task("frames", total=None, remaining="", status="")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:
            self._bar.update(self._task, remaining="", status="")
            self._bar.stop()

    def progress(self, done_count: int, total: int) -> None:
        """Show the number of accepted frames."""
        # The bar is not started earlier, so that a run that is refused shows no bar.
        if not self._bar.live.is_started:
            self._bar.start()
        left_s = time_left(self._attempts, total - done_count)
        left_text = "" if left_s is None or done_count == total else f"left {duration_text(left_s)}"
        self._bar.update(self._task, completed=done_count, total=total, remaining=left_text)
        line = ", ".join(filter(None, [f"{done_count} of {total} frames", left_text, self._reported]))
        self._print_line(line, is_last=done_count == total)

    def show_frame(self, frame: Taken) -> None:
        """Show the verdict of a frame, and update the estimate of the remaining time."""
        now_s = self._clock()
        seconds = None if self._since is None else now_s - self._since
        self._attempts.append(TimedAttempt(seconds, frame.judgement.accepted))
        self._since = now_s
        self._reported = verdict_line(frame)
        self._bar.update(self._task, status=self._reported)

    def announce(self, sentence: str) -> None:
        """Print a permanent line."""
        _print(sentence)

    def state(self, sentence: str) -> None:
        """Show the reason of a wait; the duration of the wait is not included in the time per frame."""
        self._since = None
        self._bar.update(self._task, status=sentence, remaining="")
        self._print_line(sentence)

    def _print_line(self, line: str, is_last: bool = False) -> None:
        """Print a line with the time of day if there is no bar, at most every `PLAIN_S`."""
        now_s = self._clock()
        if self._plain and (is_last or now_s >= self._plain_due):
            self._plain_due = now_s + PLAIN_S
            _print(f"{datetime.now().astimezone():%H:%M:%S} {line}")


def _print(line: str) -> None:
    # Errors of a log file must not end the run, because the journal has all important events.
    with suppress(OSError):
        print(line, file=sys.stderr)


ALIVE_S: Final = 60.0  # Interval between two signs of life to a monitoring service, s

# Interval between two signs of life to the watchdog of systemd, as a fraction of its time limit. sd_watchdog_enabled(3)
# recommends at most half.
WATCHDOG_SHARE: Final = 0.25


class Life:
    """Sends signs of life to a monitoring service and to systemd; close it at the end.

    The steps of a run call it, so a run that hangs sends no signs. `target`: the service, a URL or a command; empty for
    none. `environment`: variables set by a service manager.
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
        self._signed_s = self._watchdog_fed_s = -math.inf

    def ready(self) -> None:
        """Report that devices and session are open."""
        self._to_manager("READY=1")
        self.sign("running")

    def sign(self, activity: str) -> None:
        """Report the current activity. This may be called often, because signs are sent only at intervals."""
        now_s = self._clock.monotonic()
        if now_s - self._watchdog_fed_s >= self._watchdog_s * WATCHDOG_SHARE:
            self._watchdog_fed_s = now_s
            self._to_manager(f"WATCHDOG=1\nSTATUS={' '.join(activity.split())}")
        if now_s - self._signed_s >= ALIVE_S:
            self._signed_s = now_s
            self._notices.send("alive", activity, datetime.now(UTC))
        self._notices.report_failures()

    def end(self, event: str, sentence: str) -> None:
        """Report the end of the run."""
        self._to_manager(f"STOPPING=1\nSTATUS={event}: {' '.join(sentence.split())}")
        self._notices.send(event, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Wait for the delivery of notices."""
        self._notices.close()

    def _to_manager(self, text: str) -> None:
        # A datagram as in sd_notify(3); errors are ignored.
        if self._manager[:1] in ("/", "@"):
            address = self._manager.replace("@", "\0", 1) if self._manager.startswith("@") else self._manager
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
                link.setblocking(False)
                link.sendto(text.encode(), address)


def _watchdog_s(environment: Mapping[str, str]) -> float:
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return int(environment.get("WATCHDOG_USEC", "0")) / 1e6
    except ValueError:
        return 0.0


# Expected time for a camera to accept its settings, s.
CONFIGURE_S = 10.0


def run_session(
    settings: LabSettings,
    folder: Path,
    observe: Callable[[int, int], object],
    announce: Callable[[str], object] = lambda sentence: None,
    retake: str | None = None,
    ending: EndRequest | None = None,
    on_frame: Callable[[Taken], object] = lambda frame: None,
    state: Callable[[str], object] = lambda sentence: None,
) -> RunOutcome:
    """Take a new or interrupted session in `folder` with the rig of the settings.

    `retake`: frames to repeat (`Session.retake`); None for none.
    """
    # Damaged files are detected before a device is opened. Their frames are repeated.
    with ExitStack() as at_last, ExitStack() as opened:
        session = opened.enter_context(_resumed(settings, folder, announce)) if session_exists(folder) else None
        if session is None and retake is not None:
            raise nothing_to_retake(folder)
        alive = None if session is None else opened.enter_context(_signs_of_session(session))
        if session is not None and alive is not None:
            if retake is not None:
                session.retake(retake)

            def report_check(checked: int, total: int) -> None:
                state(f"checking frame {checked} of {total}")
                alive(f"{STARTING}; frame {checked} of {total}")

            if session.journal.accepted_files() and (damaged := session.verify(report_check)):
                announce(f"voided: {first_few(damaged, 5)}")
            total = len(session.steps)
            if len(session.done_steps()) == total:
                observe(total, total)
                return RunOutcome(total, 0, (), tuple(doubts_of(session.journal.events())))
        chart = load_chart(settings.chart) if session is None else session.chart
        devices = opened.enter_context(open_rig(settings, chart, session))
        require_plan(settings, folder, session, devices)
        if session is None:
            session = opened.enter_context(_created(settings, folder))
            session.journal.retry_locked(settings.sequence.patience_s, announce)
        require_same_devices(session, devices, settings)
        if note := clock_note(session, devices.clock):
            announce(note)
        connecting_steps = link_runs(session, devices.clock.now())
        total = len(session.steps)
        observe(len(session.done_steps()), total)
        # The report is written after the screen is dark and the journal is closed.
        at_last.callback(_report, session, announce)
        sign = alive or opened.enter_context(_signs_of_session(session))
        sign("")

        def count(frame: Taken) -> None:
            sign("")
            on_frame(frame)
            # The plan may have become longer by a white or dark frame.
            total = len(session.steps)
            observe(total - frame.remaining, total)

        judge = LiveJudge(settings, session.chart, session.illuminations)
        return take_session(session, devices, settings, judge, count, announce, state, ending, connecting_steps)


@contextmanager
def _signs_of_session(session: Session) -> Generator[SignOfLife]:
    """Send signs of life of this run. If the previous run was killed, first record this in the journal."""
    journal = session.journal
    if note := killed_note(session):
        # The clock of the laboratory is not open yet, and it may differ from the clock of the computer.
        journal.note(last_frame_time(journal.attempts()) or datetime.now(UTC), "killed", note)
    with signs_of_life(journal.beat, journal.run_state, TRY_S) as alive:
        yield alive


def _report(session: Session, announce: Callable[[str], object]) -> None:
    # An error of the report must not change the result of the run, because the report can be written again.
    try:
        write_session_report(session.folder)
    except CropError as error:
        announce(f"report: {error}; then write it with acquire report {session.folder}")


def _resumed(settings: LabSettings, folder: Path, announce: Callable[[str], object]) -> Session:
    session = Session.open_for_run(folder, settings.sequence.patience_s, announce)
    try:
        require_same(session, settings)
    except BaseException:
        session.close()
        raise
    return session


def _created(settings: LabSettings, folder: Path) -> Session:
    chart = load_chart(settings.chart)
    lights = load_illuminants(settings.illuminations)
    try:
        return Session.create(folder, settings.to_toml(), chart, lights, planned_steps(settings, lights))
    except InputError:
        # Another run has created the folder since this one started.
        if session_exists(folder):
            raise InputError(busy_message(folder)) from None
        raise


def require_same_devices(session: Session, devices: Devices, settings: LabSettings) -> None:
    """Raise an error unless camera and projector are those recorded in the session; record them if it is new."""
    # A LUT from two cameras, even of the same model, would be wrong, and the frames would not show it.
    recorded = session.journal.records()
    body = devices.camera.identity()
    # Firmware versions and the user's name of a projector are not compared, because they may change.
    names = {"camera": f"{body.name}, serial number {body.serial}"}
    if devices.projector is not None:
        projector = devices.projector.identity()
        names["projector"] = f"{projector.maker} {projector.model}".strip() or "of an unknown maker"
    if settings.rig == "lab":
        display = settings.lab.light.display
        names["screen"] = "display" if display is None else f"display {display}"
    for device, name in names.items():
        expected = recorded.get(device, name)
        if expected != name:
            raise DeviceRefused(
                f"the {device} is {name}, but {session.folder} was started with {expected}; frames of both cannot be "
                "combined",
                remedy=f"connect the {device} of the session, or start a new session",
                value=name,
                expected=expected,
            )
    for key, name in {**names, "software": software()}.items():
        if recorded.get(key) != name:
            session.journal.record(key, name)


def clock_note(session: Session, clock: Clock) -> str:
    """Return a warning if the clock of the computer is behind the last frame of the session; else ""."""
    if not isinstance(clock, SteadyClock) or not clock.behind_s:
        return ""
    return (
        f"clock: the computer's clock is {duration_text(clock.behind_s)} behind the last frame of {session.folder}; "
        "one of the times is wrong. The session continues from the time of this frame, "
        "so that frames keep their order; set the clock"
    )


def killed_note(session: Session) -> str:
    """Return a sentence about the previous run if it did not end normally; else ""."""
    beat = session.journal.heartbeat()
    if beat is None or beat.state == "ended" or beat.belongs_to(SessionPlace.of(session.journal.path)) is False:
        return ""
    time = f"{beat.at.astimezone():%Y-%m-%d %H:%M:%S}"
    return f"the previous run gave its last sign of life at {time}, then it was killed, or power was lost"


@dataclass(frozen=True)
class RunOutcome:
    """Result of a run.

    - `total`, `remaining`: number of planned steps, and of steps without an accepted frame.
    - `refused`: a sentence with the reason for each step that was given up.
    - `doubts`: warnings of this run and of earlier runs of the session.
    """

    total: int
    remaining: int
    refused: tuple[str, ...]
    doubts: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every step has an accepted frame."""
        return self.remaining == 0


def take_session(
    session: Session,
    devices: Devices,
    settings: LabSettings,
    judge: FrameJudge | None = None,
    observe: Callable[[Taken], object] = lambda frame: None,
    announce: Callable[[str], object] = lambda sentence: None,
    state: Callable[[str], object] = lambda sentence: None,
    ending: EndRequest | None = None,
    first: Sequence[int] = (),
) -> RunOutcome:
    """Take every step of the session's plan that has no accepted frame yet.

    - `judge`: judges every frame; None to judge only its exposure.
    - `observe`: receives every frame.
    - `announce`: receives the sentences of events.
    - `state`: receives every few seconds the reason and the duration of a wait.
    - `ending`: request to end after the current frame; None if nobody can request it.
    - `first`: numbers of steps to take before all others.
    """
    sequence = settings.sequence
    reports = _Reports(session, devices.clock, announce, state, settings)
    end_request = ending or EndRequest()
    retry = RetryPolicy(
        devices.clock,
        sequence.patience_s,
        reports.report,
        lambda: keep_awake(devices.camera),
        reports.sign_of_life,
        end_request.at_once,
    )

    def count(frame: Taken) -> None:
        reports.working(f"{len(session.steps) - frame.remaining} of {len(session.steps)} frames")
        observe(frame)

    reports.ready()
    try:
        for stray in session.set_aside_strays():
            reports.report("stray", f"{stray.name}: a complete file, but not in the journal; it is not used")
        with RunWatch(reports.late) as watch:
            queue = _open_steps(session, settings, first)
            job = Job(session, devices, settings, queue, judge or ExposureJudge(settings), retry, watch)
            if len(job.queue):
                _make_ready(job)
                with ThreadPoolExecutor(1, "saving") as saving:
                    Pipeline(job, saving, count, end_request).run()
        session.journal.require_whole()
        doubts = tuple(doubts_of(session.journal.events()))
        outcome = RunOutcome(len(session.steps), len(job.queue), job.queue.given_up, doubts)
        if end_request.is_requested and not outcome.complete:
            raise KeyboardInterrupt
        leave_lab(devices, RunEnd.COMPLETE if outcome.complete else RunEnd.UNFINISHED, sequence, reports.report)
    except BaseException as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        leave_lab(devices, RunEnd.INTERRUPTED if interrupted else RunEnd.UNFINISHED, sequence, reports.report)
        # Errors of frames.csv must not hide this error. The file is written again by the next run.
        with suppress(StorageError):
            session.write_frames_csv()
        reports.end("interrupted" if interrupted else "ended", str(error) or "by the operator")
        raise
    else:
        session.write_frames_csv()
        left_text = f"{outcome.remaining} of {outcome.total} frames left"
        reports.end("complete" if outcome.complete else "incomplete", "; ".join([left_text, *outcome.refused]))
    finally:
        reports.close()
    return outcome


def _open_steps(session: Session, settings: LabSettings, first: Sequence[int]) -> StepQueue:

    def append(kind: FrameKind) -> SessionStep:
        step = SessionStep(session.steps[-1].number + 1, kind, None, WHITE if kind == "white" else BLACK)
        session.add_steps([step])
        return step

    accepted_kinds = [attempt.kind for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    sequence = settings.sequence
    return StepQueue(
        session.steps,
        session.done_steps(),
        sequence.attempts,
        append,
        first,
        missing_references(accepted_kinds),
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


STARTING = "the run starts: it checks its frames and opens its devices"  # Sign of life of a run before its first frame


# Reports that a run is alive; its argument is the reason of a wait, or "" if frames are taken.
SignOfLife = Callable[[str], None]


@contextmanager
def signs_of_life(
    beat: Callable[[RunState, str, datetime], None], newest: Callable[[], RunState | None], within_s: float
) -> Generator[SignOfLife]:
    """Send signs of life while the block runs, and finally the reason of its end.

    `beat`: sends a sign, with the time at which the next sign is overdue (after `within_s`). `newest`: returns the
    state of the last sign.
    """
    last_s, reported_state = -math.inf, ""

    def send(state: RunState, sentence: str) -> None:
        with suppress(CropError):
            beat(state, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def is_new(state: RunState) -> bool:
        with suppress(CropError):
            return newest() not in (None, state)
        return False

    def alive(waits_for: str) -> None:
        nonlocal last_s, reported_state
        state: RunState = "waiting" if waits_for else "running"
        if time.monotonic() - last_s >= BEAT_S or state != reported_state or is_new(state):
            last_s, reported_state = time.monotonic(), state
            send(state, waits_for or "frames are taken")

    cause = f"ended by an error in the program; {AGAIN}"
    try:
        alive(STARTING)
        yield alive
        cause = ""
    except KeyboardInterrupt:
        cause = f"interrupted; {AGAIN}"
        raise
    except CropError as error:
        cause = str(error)
        raise
    finally:
        send("ended", cause)


class _Reports:
    """Sends events of a run to terminal, journal and the target of notices."""

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
        self._notices = Notices(settings.sequence.notify, name, lambda text: self.doubt(f"sequence.notify: {text}"))
        self._life = Life(settings.notify.alive, name, lambda failure: self.doubt(f"notify.alive: {failure}"), clock)
        self._pauses = PauseNotices(self._notify, clock)

    def ready(self) -> None:
        """Report that devices and session are open."""
        self._life.ready()

    def working(self, activity: str) -> None:
        """Send a sign of life with the current activity, and report notices that could not be delivered."""
        self._life.sign(activity)
        self._notices.report_failures()

    def doubt(self, sentence: str) -> None:
        """Report a problem that does not stop the run; errors of the disk are ignored here."""
        self._announce(f"{DOUBT}: {sentence}")
        with suppress(StorageError):
            self._journal.note(self._clock.now(), DOUBT, sentence)

    def report(self, event: str, sentence: str, /) -> None:
        self._announce(f"{event}: {sentence}")
        if event == "paused":
            self._pauses.paused(sentence)
        elif event == "resumed":
            self._pauses.resumed(sentence)
        if event != VOIDED:  # the journal notes this event together with the changed rows
            self._journal.note(self._clock.now(), event, sentence)

    def sign_of_life(self, state: str, sentence: str, within_s: float, /) -> None:
        """Report that the run waits, with the reason."""
        run_state: RunState = "paused" if state == "paused" else "waiting"
        if run_state == "paused":
            self._pauses.paused(sentence)
        self._state(sentence)
        self.working(f"{run_state}: {sentence}")
        self._journal.beat(run_state, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def late(self, sentence: str, started: datetime) -> None:
        """Report a late step from another thread, while the thread of the run waits for it."""
        thread_beat(self._journal.path, "late", sentence, started + timedelta(seconds=TRY_S))

    def end(self, event: str, sentence: str) -> None:
        """Report why the run ended; errors of the disk are ignored here."""
        self._notify(event, sentence)
        self._life.end(event, sentence)
        with suppress(StorageError):
            self._journal.note(self._clock.now(), event, sentence)

    def _notify(self, event: str, sentence: str) -> None:
        self._notices.send(event, sentence, datetime.now(UTC))

    def close(self) -> None:
        """Wait for the delivery of notices."""
        self._notices.close()
        self._life.close()
