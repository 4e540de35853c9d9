"""Power cuts during a run: flushed data survive, and the session ends with the frames of an undisturbed session.

`python -m benchmarks.power_cuts [CUTS [SEED]]` prints one JSON object per line. It needs Linux, root, `mkfs.ext4`,
libfuse 2 and `pip install fusepy`. If one is missing, it reports that and measures nothing.

A session is taken on a simulated disk: an ext4 file system on a loop device, whose file this program serves by FUSE.
The program records the sectors written since the last flush. At a random operation (see `benchmarks.session_kills`) the
run is killed. Each sector that was not flushed survives with a probability of one half, as in a drive with a cache.
Then the disk is mounted again, which recovers the journal of ext4. The session is completed on this disk and compared
with an undisturbed session: bytes, hashes, times, rows.

A control follows, with a tenth of the number of cuts. In the control, raw files are never flushed. If its sessions do
not differ from undisturbed ones, the simulated disk loses nothing in a cut, and the other results are meaningless.

Simplifications: files are small, sectors are never torn, and the disk reports flushes truthfully.
"""

from __future__ import annotations

import errno
import importlib
import json
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.session_kills import LIGHTS, SETTINGS, STEPS, contents, in_child, killed_at_operation, take
from experiment.chart.layout import design_chart
from experiment.session.folder import Session
from experiment.session.journal import Journal, ReceivedFile
from experiment.session.records import Judgement

# Default number of cuts: a few minutes on an idle machine.
CUTS = 200
# Minimum number of control cuts: about every second one hits a file that was not flushed.
LEAST_CONTROL = 10

DISK_BYTES = 24 << 20
SECTOR = 512
# Name of the served file.
NAME = "/disk"


class CachedDisk:
    """A disk with a cache. Reads return all data; after a power cut only flushed and some other sectors remain."""

    def __init__(self, content: bytes) -> None:
        self._flushed = bytearray(content)
        self._cached: dict[int, bytes] = {}
        self._guard = threading.Lock()
        self.flushes = 0

    def read(self, size: int, offset: int) -> bytes:
        """Return the bytes as last written."""
        with self._guard:
            first, last = offset // SECTOR, -(-(offset + size) // SECTOR)
            sectors = [self._cached.get(number) or self._sector(number) for number in range(first, last)]
        return b"".join(sectors)[offset - first * SECTOR :][:size]

    def write(self, data: bytes, offset: int) -> int:
        """Write whole sectors to the cache."""
        assert offset % SECTOR == 0, offset
        assert len(data) % SECTOR == 0, len(data)
        with self._guard:
            for start in range(0, len(data), SECTOR):
                self._cached[(offset + start) // SECTOR] = bytes(data[start : start + SECTOR])
        return len(data)

    def flush(self) -> None:
        with self._guard:
            self._keep(self._cached)
            self._cached = {}
            self.flushes += 1

    def cut(self, chance: random.Random) -> bytes:
        """Return the disk after a power cut."""
        with self._guard:
            surviving = {number: data for number, data in sorted(self._cached.items()) if chance.random() < 0.5}
            self._keep(surviving)
            return bytes(self._flushed)

    def _sector(self, number: int) -> bytes:
        return bytes(self._flushed[number * SECTOR : (number + 1) * SECTOR])

    def _keep(self, sectors: dict[int, bytes]) -> None:
        for number, data in sectors.items():
            self._flushed[number * SECTOR : (number + 1) * SECTOR] = data


def serve(disk: CachedDisk, folder: Path, at_cut: Callable[[], object]) -> None:
    """Serve the disk as the file `NAME` in `folder` until it is unmounted; SIGUSR1 calls `at_cut`."""
    fuse: Any = importlib.import_module("fuse")

    class Served(fuse.Operations):
        def getattr(self, path: str, fh: int | None = None) -> dict[str, Any]:
            if path == "/":
                return {"st_mode": stat.S_IFDIR | 0o755, "st_nlink": 2}
            if path != NAME:
                raise fuse.FuseOSError(errno.ENOENT)
            return {"st_mode": stat.S_IFREG | 0o600, "st_nlink": 1, "st_size": DISK_BYTES}

        def read(self, path: str, size: int, offset: int, fh: int) -> bytes:
            """Return the bytes as last written."""
            return disk.read(size, offset)

        def write(self, path: str, data: bytes, offset: int, fh: int) -> int:
            """Write whole sectors to the cache."""
            return disk.write(data, offset)

        def fsync(self, path: str, datasync: int, fh: int) -> int:
            disk.flush()
            return 0

    def wait() -> None:
        while True:
            signal.sigwait({signal.SIGUSR1})
            at_cut()

    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    threading.Thread(target=wait, daemon=True).start()
    fuse.FUSE(Served(), str(folder), foreground=True, nothreads=True, big_writes=True)


class CutSessions:
    """Sessions with random power cuts that are then completed.

    `differing` counts sessions that differ from the undisturbed one. `lost` counts frames that had a journal row before
    a cut but not after it.
    """

    def __init__(self, scratch: Path, seed: int, flushing: bool = True) -> None:
        scratch.mkdir()
        self.flushing = flushing
        self.scratch, self.chance = scratch, random.Random(seed)
        self.cuts = self.differing = self.lost = self.flushes = 0
        self.served, self.mounted = scratch / "served", scratch / "mounted"
        for folder in (self.served, self.mounted):
            folder.mkdir()
        undisturbed = scratch / "undisturbed"
        Session.create(undisturbed, SETTINGS.to_toml(), design_chart(bits=1), LIGHTS, STEPS).close()
        self.blank = self._blank_disk(undisturbed)
        count_file = scratch / "told"

        def work() -> None:
            from benchmarks.session_kills import count_operations

            operation_count = [0]
            count_operations(lambda number: operation_count.__setitem__(0, number))
            take(undisturbed)
            count_file.write_text(str(operation_count[0]))

        assert in_child(work) == 0
        self.operations = int(count_file.read_text())
        self.expected = contents(undisturbed)

    def _blank_disk(self, session: Path) -> bytes:
        image = self.scratch / "blank.img"
        image.write_bytes(b"")
        os.truncate(image, DISK_BYTES)
        _run("mkfs.ext4", "-q", str(image))
        _run("mount", "-o", "loop", str(image), str(self.mounted))
        shutil.copytree(session, self.mounted / "session")
        _run("umount", str(self.mounted))
        return image.read_bytes()

    def session(self) -> None:
        """Cut the power during a run one to three times, complete the session and compare it."""
        image, ready = self.scratch / "after.img", self.scratch / "ready"
        content = self.blank
        for _ in range(self.chance.randint(1, 3)):
            content, committed = self._cut(content, image, ready)
            self.cuts += 1
            _run("mount", "-o", "loop", str(image), str(self.mounted))
            try:
                with Session.open(self.mounted / "session") as session:
                    surviving = {frame.sha256 for frame in session.journal.accepted_files()}
                self.lost += len(committed - surviving)
            finally:
                _run("umount", str(self.mounted))
            content = image.read_bytes()
        _run("mount", "-o", "loop", str(image), str(self.mounted))
        try:
            folder = self.mounted / "session"
            assert in_child(lambda: take(folder)) == 0
            self.differing += contents(folder) != self.expected
        finally:
            _run("umount", str(self.mounted))

    def _cut(self, content: bytes, image: Path, ready: Path) -> tuple[bytes, set[str]]:
        """Run until the power fails; leave the disk in `image` and return the hashes of the frames committed before."""
        disk, chance = CachedDisk(content), random.Random(self.chance.random())
        operation = self.chance.randrange(1, self.operations)
        ready.unlink(missing_ok=True)

        def at_cut() -> None:
            image.write_bytes(disk.cut(chance))
            # Rename the file when it is complete, so that the waiting process never reads an empty file.
            partial = ready.with_suffix(".partial")
            partial.write_text(str(disk.flushes))
            partial.replace(ready)

        image.unlink(missing_ok=True)
        server = os.fork()
        if server == 0:
            serve(disk, self.served, at_cut)
            os._exit(0)
        file = self.served / NAME[1:]
        log = self.scratch / "committed"
        log.unlink(missing_ok=True)
        # Unmount in any case: no file system may stay on a disk that is gone.
        with ExitStack() as cleanup:
            cleanup.callback(os.waitpid, server, 0)
            cleanup.callback(_wait_until, lambda: _succeeds("umount", str(self.served)))
            _wait_until(file.exists)
            device = _run("losetup", "--find", "--show", str(file)).strip()
            cleanup.callback(_run, "losetup", "--detach", device)
            _run("mount", device, str(self.mounted))
            cleanup.callback(_run, "umount", str(self.mounted))
            with _LoggedCommits(log), _Flushing(self.flushing):
                exit_code = killed_at_operation(self.mounted / "session", operation)
            assert exit_code in (0, -signal.SIGKILL), exit_code
            os.kill(server, signal.SIGUSR1)
            _wait_until(ready.exists)
            self.flushes += int(ready.read_text())
        committed = set(log.read_text().split()) if log.exists() else set[str]()
        return image.read_bytes(), committed


class _Flushing:
    """Enable flushing, or disable it for the control; SQLite still flushes the journal."""

    def __init__(self, flushing: bool) -> None:
        self._flushing, self._real = flushing, os.fsync

    def __enter__(self) -> None:
        if not self._flushing:
            os.fsync = lambda fd: None

    def __exit__(self, *_: object) -> None:
        os.fsync = self._real


class _LoggedCommits:
    """Log the hash of every committed frame outside the failing disk."""

    def __init__(self, log: Path) -> None:
        self._log, self._real = log, Journal.commit

    def __enter__(self) -> None:
        real, log = self._real, self._log

        def commit(
            journal: Journal,
            attempt: int,
            received: ReceivedFile,
            judgement: Judgement,
            *arguments: Any,
            **options: Any,
        ) -> None:
            real(journal, attempt, received, judgement, *arguments, **options)
            if judgement.accepted:
                with log.open("a") as stream:
                    stream.write(f"{received.sha256}\n")

        setattr(Journal, "commit", commit)  # noqa: B010  # another signature, for this process alone

    def __exit__(self, *_: object) -> None:
        setattr(Journal, "commit", self._real)  # noqa: B010


def _run(*words: str) -> str:
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


def _succeeds(*words: str) -> bool:
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the served disk did not answer within 30 s; look for an error of fusepy above")
        time.sleep(0.01)


def _missing() -> str:
    """Return a message about a missing requirement; empty if nothing is missing."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "Linux and root are needed, to mount file systems"
    if shutil.which("mkfs.ext4") is None:
        return "mkfs.ext4 is needed (package e2fsprogs)"
    try:
        importlib.import_module("fuse")
    except (ImportError, OSError) as error:
        return f"libfuse 2 and fusepy are needed (apt install libfuse2; pip install fusepy): {error}"
    return ""


def main(argv: list[str]) -> int:
    if missing := _missing():
        print(f"power cuts: not measured: {missing}", file=sys.stderr)
        return 0
    cut_count, seed = int(argv[0]) if argv else CUTS, int(argv[1]) if argv[1:] else 20190601
    start_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        sessions = CutSessions(Path(scratch) / "flushed", seed)
        session_count = 0
        while sessions.cuts < cut_count:
            sessions.session()
            session_count += 1
        control = CutSessions(Path(scratch) / "control", seed, flushing=False)
        while control.cuts < max(cut_count // 10, LEAST_CONTROL):
            control.session()
    for name, value, unit in (
        ("power cuts: cuts", sessions.cuts, "cuts"),
        ("power cuts: sessions", session_count, "sessions"),
        ("power cuts: flushes of the disk before the cuts", sessions.flushes, "flushes"),
        ("power cuts: frames lost from the journal", sessions.lost, "frames"),
        ("power cuts: sessions that differ from an undisturbed one", sessions.differing, "sessions"),
        ("power cuts: control without flushing: cuts", control.cuts, "cuts"),
        ("power cuts: control without flushing: frames lost", control.lost, "frames"),
        ("power cuts: control without flushing: sessions that differ", control.differing, "sessions"),
        ("power cuts: time", round(time.perf_counter() - start_s, 1), "s"),
    ):
        print(json.dumps({"name": name, "value": value, "unit": unit, "against": ""}), flush=True)
    return int(sessions.differing > 0 or sessions.lost > 0 or control.differing == 0)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
