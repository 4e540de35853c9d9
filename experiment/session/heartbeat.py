"""The sign of life that a run leaves in its journal, and what a reader makes of it.

A run says from time to time that it is there, what it does, for which folder, and until when it will be heard of again.
On the machine on which it runs a reader asks the system whether the process is still that process; elsewhere, or where
processes cannot be seen, it waits for `LATE_S` after the next sign of life was due. A copy of the folder holds the same
sign, and nobody is at work in it: it is known by its files, which are others. Times are those of the machine's wall
clock, also in a simulated lab, whose own time passes otherwise.
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

# What a run does: takes frames, hangs at a step, waits for something that comes by itself, waits for somebody, or is
# over.
RunState = Literal["running", "late", "waiting", "paused", "ended"]

# Seconds after which a sign of life that is due is missing: chosen; clocks of two machines that keep their time over
# a network differ by less than one, and a disk may stall for seconds.
LATE_S = 30.0

# Seconds between two signs of life of a run that takes frames: each is a write to the disk, and "5 s ago" frightens
# nobody.
BEAT_S = 5.0


AGAIN = "run the same command again"  # What helps after a run was killed


@dataclass(frozen=True)
class Process:
    """A process, so that another one that bears its number later is not taken for it.

    - `started`: when it began, as its system counts; empty if that cannot be told.
    - `host`: the machine's name.
    - `boot`: the machine's present boot, and the process space in it (containers number processes anew); empty if
      unknown.
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

    def is_stopped(self) -> bool:
        """Return whether the process is there and was stopped by a signal; False where that cannot be told."""
        return bool(self.is_alive()) and _fields_of(self.pid)[:1] in (["T"], ["t"])


# File systems, as /proc/self/mounts names them, that may make up the numbers of their files: those say nothing.
INVENTED_NUMBERS = ("fuse", "cifs", "smb3", "smbfs", "virtiofs")


def file_system_of(path: Path) -> str:
    """Return the kind of file system that a file lies on, as /proc/self/mounts names it; empty where nobody says."""
    try:
        mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    except OSError:
        return ""
    place = path.resolve()
    holding = [(len(at), kind) for _, at, kind, *_ in mounts if place.is_relative_to(at.replace("\\040", " "))]
    return max(holding, default=(0, ""))[1]


# `FS_IOC_GETVERSION` of linux/fs.h, `_IOR('v', 1, long)`; what is no Linux refuses it.
_GETVERSION = 0x80007601 | struct.calcsize("l") << 16


@dataclass(frozen=True)
class SessionPlace:
    """Where a session lies: its name, and the numbers of its files, which a copy does not have.

    A folder that is renamed keeps its numbers, and one that is looked at over NFS has those of the server. A journal
    that is restored alone may get the number of the one before; the process then decides.

    - `folder`: path of its folder, without links.
    - `device`: number of the file system on that machine; it may be another after the next boot.
    - `inode`, `journal`: numbers of the folder and of the journal in it; 0 where the file system makes them up.
    - `generation`: tells the folder from one that had its number before; 0 where the file system does not say.
    """

    folder: str
    device: int
    inode: int
    journal: int
    generation: int

    @classmethod
    def of(cls, journal: Path) -> SessionPlace | None:
        """Return the place of a journal; None where it is not there any more."""
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
        """Return the place that `to_text` wrote; None for anything else."""
        try:
            folder, *numbers = json.loads(text)
            device, inode, journal, generation = map(int, numbers)
        except (ValueError, TypeError):
            return None
        return cls(str(folder), device, inode, journal, generation)

    def to_text(self) -> str:
        """Return the place as a journal keeps it."""
        return json.dumps([self.folder, self.device, self.inode, self.journal, self.generation])


@dataclass(frozen=True)
class Heartbeat:
    """A run's newest sign of life.

    - `at`: when it was given.
    - `process`: who gave it.
    - `state`: what the run does.
    - `sentence`: the same in words, for people.
    - `until`: when the next sign of life is due at the latest.
    - `place`: the session for which it was given; None where the run could not tell.
    """

    at: datetime
    process: Process
    state: RunState
    sentence: str
    until: datetime
    place: SessionPlace | None = None

    def is_of(self, here: SessionPlace | None) -> bool | None:
        """Return whether it was given for the session that lies `here`, and not for one that this is a copy of.

        None where that cannot be told.
        """
        said = self.place
        if said is None or here is None or not (said.inode and here.inode):
            return None
        if (self.process.host, self.process.boot) == (socket.gethostname(), _boot()) and said.device != here.device:
            return False
        if said.generation and here.generation and said.generation != here.generation:
            return False
        return (said.inode, said.journal) == (here.inode, here.journal)

    def is_dead(self, now: datetime, alive: bool | None) -> bool:
        """Return whether the run was killed: it has not ended, and is no more."""
        if self.state == "ended":
            return False
        if alive is not None:
            return not alive
        return now > self.until + timedelta(seconds=LATE_S)

    def sentence_for(self, now: datetime, alive: bool | None) -> str:
        """Return what to tell a reader: the run's own sentence, or that it was killed and what helps. See `is_dead`."""
        if not self.is_dead(now, alive):
            return self.sentence
        return f"stopped at {_moment(self.at)}, killed or power lost: {AGAIN}"

    def sentence_of_copy(self, here: SessionPlace, alive: bool | None) -> str:
        """Return what to tell a reader of a copy, which lies `here`; see `is_of` and `is_dead`."""
        assert self.place is not None
        there, moment = self.place.folder, _moment(self.at)
        if there == here.folder and self.process.host == socket.gethostname():
            return f"restored from a copy of {moment} or later, made while a run was at work; {AGAIN}"
        if alive is None:
            return (
                f"copied from {self.process.host}:{there} at {moment} or later, and it is not known from here whether "
                "the run there goes on; ask acquire status there"
            )
        if alive:
            return (
                f"copied from {there} at {moment} or later, and the run there goes on; look there, this copy gets none "
                "of its frames"
            )
        return (
            f"copied from {there} at {moment} or later, while a run was at work there, which is over now; acquire "
            f"status {shlex.quote(there)} says how it ended, if it is still there"
        )


def _generation(folder: Path) -> int:
    """Return what tells a folder from an earlier one of its number (ioctl_iflags(2), ext4, XFS, Btrfs); 0 elsewhere."""
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
    """Return the present boot and process space; empty where the system does not say."""
    with suppress(OSError):
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    return _listed_start(1) or ""


def _start_of(pid: int) -> str | None:
    """Return when a process began, in ticks since boot where /proc has it; None if there is none, or its remains."""
    fields = _fields_of(pid)
    if len(fields) < 20:
        return None if Path("/proc/self/stat").exists() else _listed_start(pid)
    return None if fields[0] in "ZX" else fields[19]


def _fields_of(pid: int) -> list[str]:
    """Return what /proc says of a process behind its name, state first, start the twentieth; nothing where it does not.

    proc(5): the name stands in brackets and may hold any character; state is the third field, start the 22nd.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return []


def _listed_start(pid: int) -> str | None:
    """Return when a process began, as ps(1) says it; for systems without /proc."""
    try:
        listed = subprocess.run(
            ["ps", "-o", "state=,lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout.split()
    except OSError:
        return None
    return " ".join(listed[1:]) if len(listed) > 1 and not listed[0].startswith("Z") else None
