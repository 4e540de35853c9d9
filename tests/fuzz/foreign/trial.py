"""One trial: a folder is written and read by all its readers, while file access is watched.

Requirements for every folder: errors are `CropError`, reading ends within `LIMIT_S`, no file outside is opened, and
files are written only in the given folder.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from acquisition.monitor.view import read_session
from acquisition.status import status_json, status_lines
from calibration.table.lut import open_lut
from calibration.table.verification import describe, find_faults
from calibration.table.zarr_store import fetch
from experiment.session.folder import Session
from experiment.session.repair import damaged_files
from foundation.errors import CropError
from generator.dataset.reader import file_faults, open_dataset
from tests.fuzz.foreign.mutations import CANARY, mutate
from tests.fuzz.foreign.seeds import Seed

# Time limit, s: no folder of some kilobytes takes so long, even on a busy machine.
LIMIT_S = 20


class Hang(BaseException):
    """The time limit was exceeded; no `except Exception` may catch it."""


class Trespass(BaseException):
    """A file outside was accessed."""


class Watch:
    """Watches the files opened by the process, by audit events of Python (PEP 578)."""

    def __init__(self, work: Path) -> None:
        self._outside = os.path.realpath(work / "outside")
        self._work = os.path.realpath(work)
        self._armed = False
        sys.addaudithook(self._on_event)

    def _on_event(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._armed:
            return
        if event in (
            "open",
            "sqlite3.connect",
            "os.remove",
            "os.rename",
            "os.mkdir",
            "os.truncate",
            "os.listdir",
            "os.scandir",
        ):
            self._armed = False
            try:
                self._judge(event, arguments)
            finally:
                self._armed = True

    def _judge(self, event: str, arguments: tuple[Any, ...]) -> None:
        path = arguments[0]
        if not isinstance(path, str | bytes):
            return
        text = os.fsdecode(path)
        if event in ("os.remove", "os.mkdir") and arguments[-1] != -1:
            return  # Relative to an open folder, whose path was checked.
        if text.startswith("file:"):
            text = text[5:].partition("?")[0]
        real = os.path.realpath(text)
        if real.startswith((self._outside, "/dev/zero", "/dev/tty")) or real == "/etc/passwd":
            raise Trespass(f"{event} {text} -> {real}")
        changes = event in ("os.remove", "os.rename", "os.mkdir", "os.truncate") or (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        )
        if changes and not real.startswith((self._work, "/tmp", "/dev/null", "/dev/shm")):
            raise Trespass(f"{event} {text} -> {real} changes a file outside")

    @contextmanager
    def armed(self) -> Generator[None]:
        self._armed = True
        try:
            yield
        finally:
            self._armed = False


def read_dataset(folder: Path, spare: Path) -> None:
    del spare
    with suppress(CropError):
        list(file_faults(folder))
    dataset = open_dataset(folder)
    for reading in (lambda: dataset.sources, lambda: dataset.details):
        with suppress(CropError):
            reading()
    for entry in dataset.entries[:6]:
        readers: list[Callable[[], object]] = [
            lambda e=entry: dataset.read_image(e),
            lambda e=entry: dataset.read_preview(e),
        ]
        if len(entry.lights) > 1:
            readers += [lambda e=entry: dataset.read_weights(e), lambda e=entry: dataset.read_ground_truth_map(e)]
        for read in readers:
            with suppress(CropError):
                read()


def read_table(folder: Path, spare: Path) -> None:
    del spare
    with suppress(CropError):
        find_faults(open_lut(folder, check=False))
    lut = open_lut(folder)
    describe(lut)
    lut.ground_truth.sum()
    for light in range(len(lut.samples)):
        lut.light_samples(light).sum()
    _ = lut.frames


def read_session_folder(folder: Path, spare: Path) -> None:
    del spare
    with suppress(CropError):
        view = read_session(folder)
        now = datetime(2026, 1, 2, tzinfo=UTC)
        "\n".join(status_lines(view, now)).encode("utf-8", "surrogatepass")
        status_json(view, now)
    with closing(Session.open(folder)) as session:
        session.frames()
        session.done_steps()
        with suppress(CropError):
            session.settings_text()
        list(session.journal.measurements())
        session.journal.heartbeat()
        session.journal.details()
        session.journal.records()
        damaged_files(folder, session.journal.accepted_files(), lambda count, total: None)


def read_published(folder: Path, spare: Path) -> None:
    fetch(str(folder), spare / "fetched")


READERS: dict[str, Callable[[Path, Path], None]] = {
    "dataset": read_dataset,
    "table": read_table,
    "session": read_session_folder,
    "published": read_published,
}


class Trials:
    """A place for trials, in memory if possible."""

    def __init__(self, work: Path) -> None:
        self._work = work
        self.watch = Watch(work)

    def judge(self, kind: str, seed: Seed, number: int) -> str | None:
        """Return the fault in reading a mutated folder, or None."""
        rng = random.Random(f"{kind} {number}")
        files, change = mutate(rng, seed)
        folder, spare, outside = self._work / "in", self._work / "spare", self._work / "outside"
        for path in (folder, spare, outside):
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
        (outside / CANARY).write_bytes(b"canary")
        for name, data in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        change(folder)
        signal.signal(signal.SIGALRM, _hang)
        signal.alarm(LIMIT_S)
        fault = None
        try:
            with self.watch.armed():
                READERS[kind.split()[0]](folder, spare)
        except CropError as error:
            if len(str(error)) > 20000 or not str(error):
                fault = f"a message of {len(str(error))} characters"
        except BaseException:
            fault = traceback.format_exc(limit=-12)
        finally:
            signal.alarm(0)
        if fault is None and sorted(path.name for path in outside.iterdir()) != [CANARY]:
            fault = "a file was written outside"
        if fault is None and (outside / CANARY).read_bytes() != b"canary":
            fault = "a file outside was changed"
        return fault


def _hang(number: int, frame: object) -> None:
    raise Hang(f"more than {LIMIT_S} s")
