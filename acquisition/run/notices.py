"""Who is told of a run: the terminal, a command, a URL, systemd, a dead man's switch; nothing waits for them.

Rules that hold inside:

- Telling takes no time: a thread of its own delivers, one notice after another, each within `LIMIT_S`.
- A notice that cannot be delivered hurts nobody: what failed is said once, by the thread that tells.
- Of the target nothing is said but a URL's scheme and host, or a program's name: the rest may be a secret. Errors of
  libraries, whose text may hold it, are told by their number or kind.
- Signs of life (`Life`) come from the steps of the run itself, a frame, a try in a pause: a run that hangs gives none,
  and its silence tells that it hangs.

What a receiver gets, on its standard input or as the body of a POST (`application/json`)::

    {"event": "paused", "message": "the screen: covered by a window …", "text": "night: paused: the screen …",
     "content": "night: paused: the screen …", "session": "night", "host": "lab", "at": "2026-01-01T03:12:45+00:00"}

``text`` is what Slack, Mattermost and their likes show, ``content`` what Discord does. A command finds event, message
and session in its environment, too: ``CROP_EVENT``, ``CROP_MESSAGE``, ``CROP_SESSION``.
"""

from __future__ import annotations

import base64
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
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from types import TracebackType
from typing import Final, Self
from urllib.parse import unquote, urlsplit, urlunsplit

from acquisition.run.devices import pause_cause
from acquisition.run.pipeline import Taken, step_name
from experiment.session.records import RECENT, Check, Judgement, TimedAttempt, duration_text, time_left
from foundation.clock import Clock
from foundation.console import shows_progress
from foundation.secret_texts import is_webhook, target_label

LIMIT_S: Final = 20.0
"""How long a receiver may take; a message to a telephone takes seconds."""
ENDING_S: Final = 2.0
"""How much longer the end waits for the last one, so that a receiver that is too slow is named."""
QUIET_S: Final = 3600.0
"""Between two notices of a pause for the same cause: whoever was told once in the hour, and did not come, is not woken
by each time that it comes and goes."""
QUEUED: Final = 100
"""Notices that may wait for a slow receiver; more are dropped."""


class Notices:
    """Tells a target what happens; close it at the end, which waits for what was told, for `LIMIT_S` at most.

    `target`: A URL or a command line; empty: nobody is told.
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
    import http.client
    import urllib.error
    import urllib.request

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


SHOWN = ("light", "movement", "blur", "white drift", "dark", "ambient", "exposure")
"""Checks that the line about the last frame has, as far as they have a number."""


class TimeLeft:
    """Tells the time left by the machine's clock as the page and `acquire status` tell it by the journal's.

    `clock`: returns seconds; the machine's own unless a test has another.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since: float | None = None
        self._attempts: deque[TimedAttempt] = deque(maxlen=RECENT)

    def taken(self, accepted: bool = True) -> None:
        """Note that a frame was taken now, and whether it counts."""
        now = self._clock()
        self._attempts.append(TimedAttempt(None if self._since is None else now - self._since, accepted))
        self._since = now

    def paused(self) -> None:
        """Note that the run waits: the time until the next frame is no frame's."""
        self._since = None

    def left_s(self, frames: int) -> float | None:
        """Return seconds that so many frames will take, retaken ones included; None before the second frame."""
        return time_left(self._attempts, frames)


def verdict_line(taken: Taken) -> str:
    """Return what is said of the last frame in a line: its verdict, and numbers with their units."""
    judgement = taken.judgement
    numbers = [_number_text(check) for name in SHOWN for check in _of_name(judgement, name)]
    said = "accepted" if judgement.accepted else "refused"
    return ", ".join([f"{step_name(taken.step)} {said}", *numbers])


def _number_text(check: Check) -> str:
    """Return a check's name and number, as in ``light 0.21°``."""
    unit = "" if not check.unit else check.unit if check.unit.startswith("°") else f" {check.unit}"
    return f"{check.name} {check.value:.3g}{unit}{' (beyond its limit)' if check.is_beyond else ''}"


def _of_name(judgement: Judgement, name: str) -> list[Check]:
    return [check for check in judgement.checks if check.name == name and check.value is not None]


PLAIN_S: Final = 30.0
"""Between two lines on how far a run is, where they go into a file: enough to see that it lives, and a night's thousand
lines can still be read."""


class Terminal:
    """Shows a run: as a bar on a terminal, else as a line now and then; use it in a `with` block.

    `clock`: returns seconds; the machine's own unless a test has another.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._clock = clock
        self._time = TimeLeft(clock)
        self._left = self._total = 0
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
        self._left, self._total = total - done, total
        left_s = self._time.left_s(self._left)
        left = "" if left_s is None or not self._left else f"left {duration_text(left_s)}"
        self._bar.update(self._task, completed=done, total=total, left=left)
        self._say_plainly(", ".join(filter(None, [f"{done} of {total} frames", left, self._said])), done == total)

    def taken(self, taken: Taken) -> None:
        """Show the verdict of a frame, and take its time for that of those to come."""
        self._time.taken(taken.judgement.accepted)
        self._said = verdict_line(taken)
        self._bar.update(self._task, said=self._said)

    def announce(self, sentence: str) -> None:
        """Print a line that stays."""
        _print(sentence)

    def state(self, sentence: str) -> None:
        """Show what the run waits for, until the next frame."""
        self._time.paused()
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


ALIVE_S: Final = 60.0
"""Between two signs to a dead man's switch: services of that kind count minutes."""

WATCHDOG_SHARE: Final = 0.25
"""Of the watchdog's time, between two signs at least: sd_watchdog_enabled(3) recommends half of it at most."""


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
