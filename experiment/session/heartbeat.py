"""Signs of life that a run leaves in its journal, and how a reader interprets them.

A run regularly writes its state, its session, and the time of the next sign of life. A reader on the same computer asks
the system whether the process is still alive. Elsewhere, or if processes are not visible, it waits `LATE_S` after the
next sign of life was due. A copy of the folder contains the same sign without a run; it is recognised by the numbers of
its files. Times are of the wall clock of the computer, also in a simulated laboratory, which has its own time.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import socket
import struct
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

# State of a run: taking frames, late in a step, waiting for something that happens automatically, paused until somebody
# acts, or ended.
RunState = Literal["running", "late", "waiting", "paused", "ended"]

# Seconds after which a due sign of life counts as missing (judgement): clocks synchronised over a network differ by
# less than 1 s, and a disk may block for seconds.
LATE_S = 30.0

# Seconds between two signs of life of a run that takes frames: each is a write to the disk, and "5 s ago" does not
# alarm anybody.
BEAT_S = 5.0


AGAIN = "run the same command again"  # Remedy after a run was killed


@dataclass(frozen=True)
class Process:
    """Identity of a process, which distinguishes it from a later one with the same number."""

    pid: int
    started: str  # start time in the units of the system; empty if unknown
    host: str  # name of the computer
    boot: str  # boot of the computer and process namespace (containers have their own numbers); empty if unknown

    @classmethod
    def own(cls) -> Process:
        """Return the calling process."""
        pid = os.getpid()
        return cls(pid, _process_start(pid) or "", socket.gethostname(), _boot())

    def is_alive(self) -> bool | None:
        """Return whether the process is alive; None if that cannot be determined here."""
        if not self.boot or (self.host, self.boot) != (socket.gethostname(), _boot()):
            return None
        return self.started != "" and _process_start(self.pid) == self.started

    def is_stopped(self) -> bool:
        """Return whether the process is alive and stopped by a signal; False if that cannot be determined."""
        return bool(self.is_alive()) and _proc_fields(self.pid)[:1] in (["T"], ["t"])


# File systems, as in /proc/self/mounts, that may invent numbers of files, which then identify nothing.
INVENTED_NUMBERS = ("fuse", "cifs", "smb3", "smbfs", "virtiofs")


def file_system_of(path: Path) -> str:
    """Return the type of the file system of a file, as in /proc/self/mounts; empty if unknown."""
    try:
        mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    except OSError:
        return ""
    resolved = path.resolve()
    above = [
        (len(mount), kind) for _, mount, kind, *_ in mounts if resolved.is_relative_to(mount.replace("\\040", " "))
    ]
    return max(above, default=(0, ""))[1]


# `FS_IOC_GETVERSION` of linux/fs.h, `_IOR('v', 1, long)`; other systems refuse it.
_GETVERSION = 0x80007601 | struct.calcsize("l") << 16


@dataclass(frozen=True)
class SessionPlace:
    """Path of a session, and numbers of its files, which differ in a copy.

    A renamed folder keeps its numbers, and NFS shows the numbers of the server. A restored journal may get the number
    of the previous one; then the process decides.
    """

    folder: str  # path of the folder, without links
    device: int  # number of the file system on this computer; may change with a boot
    inode: int  # number of the folder; 0 if the file system invents numbers
    journal: int  # number of the journal; 0 if the file system invents numbers
    generation: int  # distinguishes the folder from an earlier one with the same number; 0 if unknown

    @classmethod
    def of(cls, journal: Path) -> SessionPlace | None:
        """Return the place of a journal; None if the journal is missing."""
        try:
            folder, file = journal.parent.stat(), journal.stat()
            path = str(journal.parent.resolve())
        except OSError:
            return None
        if file_system_of(journal).startswith(INVENTED_NUMBERS):
            return cls(path, 0, 0, 0, 0)
        return cls(path, folder.st_dev, folder.st_ino, file.st_ino, _generation(journal.parent))

    @classmethod
    def from_text(cls, text: str) -> SessionPlace | None:
        """Return the place from a text by `to_text`; None for any other text."""
        try:
            folder, *numbers = json.loads(text)
            device, inode, journal, generation = map(int, numbers)
        except (ValueError, TypeError):
            return None
        return cls(str(folder), device, inode, journal, generation)

    def to_text(self) -> str:
        """Return the place as a text for the journal."""
        return json.dumps([self.folder, self.device, self.inode, self.journal, self.generation])


@dataclass(frozen=True)
class Heartbeat:
    """The newest sign of life of a run."""

    at: datetime  # time of the sign
    process: Process  # process of the run
    state: RunState
    sentence: str  # the state in words, for users
    until: datetime  # latest time of the next sign of life
    place: SessionPlace | None = None  # session of the run; None if unknown

    def belongs_to(self, here: SessionPlace | None) -> bool | None:
        """Return whether the sign was given for the session at `here` and not for its original; None if unknown."""
        session_place = self.place
        if session_place is None or here is None or not (session_place.inode and here.inode):
            return None
        if (self.process.host, self.process.boot) == (
            socket.gethostname(),
            _boot(),
        ) and session_place.device != here.device:
            return False
        if session_place.generation and here.generation and session_place.generation != here.generation:
            return False
        return (session_place.inode, session_place.journal) == (here.inode, here.journal)

    def is_dead(self, now: datetime, alive: bool | None) -> bool:
        """Return whether the run was killed: it has no end, and its process is gone or its sign overdue.

        `alive`: result of `Process.is_alive`.
        """
        if self.state == "ended":
            return False
        if alive is not None:
            return not alive
        return now > self.until + timedelta(seconds=LATE_S)

    def sentence_for(self, now: datetime, alive: bool | None) -> str:
        """Return the sentence of the run, or after a kill that it was killed and the remedy."""
        if not self.is_dead(now, alive):
            return self.sentence
        return f"stopped at {_moment(self.at)}, killed or power lost: {AGAIN}"

    def sentence_of_copy(self, here: SessionPlace, alive: bool | None) -> str:
        """Return the state of a session that is a copy and is located at `here`."""
        assert self.place is not None
        origin, moment = self.place.folder, _moment(self.at)
        if origin == here.folder and self.process.host == socket.gethostname():
            return f"restored from a copy of {moment} or later, made during a run; {AGAIN}"
        if alive is None:
            return (
                f"copied from {self.process.host}:{origin} at {moment} or later; the state of the run there is unknown "
                "on this computer; run acquire status there"
            )
        if alive:
            return (
                f"copied from {origin} at {moment} or later, and the run there continues; use that folder, because "
                "this copy gets no new frames"
            )
        return (
            f"copied from {origin} at {moment} or later, during a run that has ended; acquire status "
            f"{shlex.quote(origin)} shows its end, if the folder still exists"
        )


def _generation(folder: Path) -> int:
    # ioctl_iflags(2), on ext4, XFS and Btrfs; 0 elsewhere.
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return 0
    try:
        return int.from_bytes(fcntl.ioctl(handle, _GETVERSION, bytes(8)), sys.byteorder)
    except OSError:
        return 0
    finally:
        os.close(handle)


def _moment(at: datetime) -> str:
    return f"{at.astimezone():%Y-%m-%d %H:%M:%S}"


def _boot() -> str:
    with suppress(OSError):
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    return _start_by_ps(1) or ""


def _process_start(pid: int) -> str | None:
    """Return the start of a process, in ticks since boot or as text of ps(1); None if it is gone or a zombie."""
    fields = _proc_fields(pid)
    if len(fields) < 20:
        return None if Path("/proc/self/stat").exists() else _start_by_ps(pid)
    return None if fields[0] in "ZX" else fields[19]


def _proc_fields(pid: int) -> list[str]:
    # proc(5): the name is in brackets and may contain any character; state is the third field, start the 22nd. So the
    # result has state first and start as twentieth.
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _start_by_ps(pid: int) -> str | None:
    # For systems without /proc: start time by ps(1).
    try:
        columns = subprocess.run(
            ["ps", "-o", "state=,lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout.split()
    except OSError:
        return None
    return " ".join(columns[1:]) if len(columns) > 1 and not columns[0].startswith("Z") else None
