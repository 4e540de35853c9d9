"""Write and interpret the signs of life of a run.

A run regularly writes its state, its session, and the time of its next sign of life into the journal. A reader on the
same computer asks the operating system whether the process is alive. On another computer, a run counts as dead if its
next sign of life is late by more than `LATE_S`. A copy of the folder contains the same sign of life, although no run
uses the copy. It is recognised by the inode numbers of its files. Times are read from the clock of the computer, also
if a simulated laboratory has its own clock.
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

# State of a run. "running": it takes frames. "late": a step takes longer than expected. "waiting": it waits for
# something that happens automatically. "paused": it waits until somebody acts.
RunState = Literal["running", "late", "waiting", "paused", "ended"]

# Delay after which a sign of life counts as missing, seconds. Chosen by judgement, because a disk may block for
# seconds.
LATE_S = 30.0

# Interval between two signs of life while frames are taken, seconds. Each sign is written to the disk.
BEAT_S = 5.0


AGAIN = "run the same command again"  # Remedy after a run was killed


@dataclass(frozen=True)
class Process:
    """Identity of a process, which distinguishes it from a later process with the same number."""

    pid: int
    started: str  # start time in the units of the system; empty if unknown
    host: str  # name of the computer
    boot: str  # id of the boot and of the process namespace (containers number their processes); empty if unknown

    @classmethod
    def own(cls) -> Process:
        """Return the identity of the calling process."""
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


# File systems that may invent inode numbers, which then do not identify a file; names as in /proc/self/mounts.
INVENTED_NUMBERS = ("fuse", "cifs", "smb3", "smbfs", "virtiofs")


def file_system_of(path: Path) -> str:
    """Return the type of the file system of a file, as in /proc/self/mounts; empty if unknown."""
    try:
        mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    except OSError:
        return ""
    resolved = path.resolve()
    containing = [
        (len(mount), kind) for _, mount, kind, *_ in mounts if resolved.is_relative_to(mount.replace("\\040", " "))
    ]
    return max(containing, default=(0, ""))[1]


# Request `FS_IOC_GETVERSION` of linux/fs.h, `_IOR('v', 1, long)`; other systems refuse it.
_GETVERSION = 0x80007601 | struct.calcsize("l") << 16


@dataclass(frozen=True)
class SessionPlace:
    """Path of a session, and the inode numbers of its files, which differ in a copy.

    A renamed folder keeps its numbers, and NFS shows the numbers of the server. A restored journal may get the number
    of the previous journal. In this case, the state of the process shows whether there is a run.
    """

    folder: str  # path of the folder, without links
    device: int  # number of the file system on this computer; may change after a restart
    inode: int  # inode number of the folder; 0 if the file system invents numbers
    journal: int  # inode number of the journal; 0 if the file system invents numbers
    generation: int  # distinguishes the folder from an earlier folder with the same number; 0 if unknown

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
        """Return whether the run uses the session at `here`; False if that session is a copy, None if unknown."""
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
        """Return whether the run was killed: it did not end, but its process is gone or its sign of life is overdue.

        `alive`: result of `Process.is_alive`.
        """
        if self.state == "ended":
            return False
        if alive is not None:
            return not alive
        return now > self.until + timedelta(seconds=LATE_S)

    def sentence_for(self, now: datetime, alive: bool | None) -> str:
        """Return the sentence of the run; if it was killed, a sentence with the remedy."""
        if not self.is_dead(now, alive):
            return self.sentence
        return f"stopped at {_moment(self.at)}, killed or power lost: {AGAIN}"

    def sentence_of_copy(self, here: SessionPlace, alive: bool | None) -> str:
        """Return a sentence on the state of a session that is a copy, located at `here`."""
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
                f"copied from {origin} at {moment} or later, and the run continues there; use that folder, because "
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
    """Return the start time of a process, in ticks since boot or as printed by ps(1); None if it has ended."""
    fields = _proc_fields(pid)
    if len(fields) < 20:
        return None if Path("/proc/self/stat").exists() else _start_by_ps(pid)
    return None if fields[0] in "ZX" else fields[19]


def _proc_fields(pid: int) -> list[str]:
    # The second field is the name of the process in brackets, which may contain any character (proc(5)). Only the
    # fields after it are returned: the state is the first, and the start time is the twentieth.
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _start_by_ps(pid: int) -> str | None:
    # This is for systems without /proc.
    try:
        columns = subprocess.run(
            ["ps", "-o", "state=,lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout.split()
    except OSError:
        return None
    return " ".join(columns[1:]) if len(columns) > 1 and not columns[0].startswith("Z") else None
