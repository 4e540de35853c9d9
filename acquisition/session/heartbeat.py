"""The sign of life that a run leaves in its journal, and what a reader makes of it.

A run says from time to time that it is there, what it does, and until when it will be heard of again. On the machine on
which it runs a reader asks the system whether the process is still that process; elsewhere, or where processes cannot
be seen, it waits for `LATE_S` after the next sign of life was due. Times are those of the machine's wall clock, also
in a simulated lab, whose own time passes otherwise.
"""

from __future__ import annotations

import math
import os
import socket
import subprocess
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

from foundation.errors import CropError

RunState = Literal["running", "waiting", "paused", "ended"]
"""What a run does: takes frames, waits for something that comes by itself, waits for somebody, or is over."""

LATE_S = 30.0
"""Seconds after which a sign of life that is due is missing: chosen; clocks of two machines that keep their time over
a network differ by less than one, and a disk may stall for seconds."""

BEAT_S = 5.0
"""Seconds between two signs of life of a run that takes frames: each is a write to the disk, and "5 s ago" frightens
nobody."""

AGAIN = "run the same command again"
"""What helps after a run was killed."""


@dataclass(frozen=True)
class Process:
    """A process, so that another one that bears its number later is not taken for it.

    Attributes
    ----------
    pid
        Its number.
    started
        When it began, as its system counts; empty if that cannot be told.
    host
        The machine's name.
    boot
        The machine's present boot, and the process space in it (containers number processes anew); empty if unknown.
    """

    pid: int
    started: str
    host: str
    boot: str

    @classmethod
    def own(cls) -> Process:
        """Return the calling process."""
        pid = os.getpid()
        return cls(pid, _start_of(pid) or "", socket.gethostname(), _boot())

    def is_alive(self) -> bool | None:
        """Return whether the process is there; None if that cannot be told from here."""
        if not self.boot or (self.host, self.boot) != (socket.gethostname(), _boot()):
            return None
        return self.started != "" and _start_of(self.pid) == self.started


@dataclass(frozen=True)
class Heartbeat:
    """A run's newest sign of life.

    Attributes
    ----------
    at
        When it was given.
    process
        Who gave it.
    state
        What the run does.
    sentence
        The same in words, for people.
    until
        When the next sign of life is due at the latest.
    """

    at: datetime
    process: Process
    state: RunState
    sentence: str
    until: datetime

    def is_dead(self, now: datetime, alive: bool | None) -> bool:
        """Return whether the run was killed: it has not ended, and is no more.

        Parameters
        ----------
        now
            Wall clock of this machine.
        alive
            `Process.is_alive` of `process`, asked now.
        """
        if self.state == "ended":
            return False
        if alive is not None:
            return not alive
        return now > self.until + timedelta(seconds=LATE_S)

    def sentence_for(self, now: datetime, alive: bool | None) -> str:
        """Return what to tell a reader: the run's own sentence, or that it was killed and what helps. See `is_dead`."""
        if not self.is_dead(now, alive):
            return self.sentence
        return f"stopped at {self.at.astimezone():%Y-%m-%d %H:%M:%S}, killed or power lost: {AGAIN}"


@contextmanager
def signs_of_life(
    beat: Callable[[RunState, str, datetime], None], newest: Callable[[], Heartbeat | None], within_s: float
) -> Generator[Callable[[], None]]:
    """Say that a run is at work while the block runs, and in the end that it is over, and why.

    Parameters
    ----------
    beat
        `Journal.beat`. A disk that does not take a sign does not end the run: the frames will tell.
    newest
        `Journal.heartbeat`.
    within_s
        Seconds within which the next sign comes at the latest.

    Yields
    ------
    callable
        To be called after each frame; gives a sign every `BEAT_S`, and at once where the run is said to wait.
    """
    last = -math.inf

    def say(state: RunState, sentence: str) -> None:
        with suppress(CropError):
            beat(state, sentence, datetime.now(UTC) + timedelta(seconds=within_s))

    def waits() -> bool:
        with suppress(CropError):
            told = newest()
            return told is not None and told.state != "running"
        return False

    def alive() -> None:
        nonlocal last
        if time.monotonic() - last >= BEAT_S or waits():
            last = time.monotonic()
            say("running", "frames are taken")

    cause = f"ended by a mistake of the program; {AGAIN}"
    try:
        alive()
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


def _boot() -> str:
    """Return the present boot and process space; empty where the system does not say."""
    with suppress(OSError):
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    return _listed_start(1) or ""


def _start_of(pid: int) -> str | None:
    """Return when a process began, in ticks since boot where /proc has it; None if there is none, or its remains."""
    try:
        # proc(5): the name stands in brackets and may hold any character; state is the third field, start the 22nd.
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return None if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        return None if Path("/proc/self/stat").exists() else _listed_start(pid)


def _listed_start(pid: int) -> str | None:
    """Return when a process began, as ps(1) says it; for systems without /proc."""
    try:
        listed = subprocess.run(
            ["ps", "-o", "state=,lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout.split()
    except OSError:
        return None
    return " ".join(listed[1:]) if len(listed) > 1 and not listed[0].startswith("Z") else None
