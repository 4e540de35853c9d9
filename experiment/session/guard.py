"""Whether the journal on the disk is the one that a run has open, and whole.

Files are deleted, replaced and cut, and nobody says so: a program goes on writing a file that has no name any
more, and SQLite does not look twice at pages that it has read.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from experiment.session.heartbeat import INVENTED_NUMBERS
from experiment.session.journal_file import LostJournalError, beside, connect_to_read, file_system_of, reading_error
from experiment.session.ledger import Ledger, rows_of
from foundation.errors import StorageError
from foundation.files import storage_error


@dataclass(frozen=True)
class _Look:
    """A file as it is now: its numbers, its size, and when it was written last, ns."""

    numbers: tuple[int, int]
    size: int
    written: int


class JournalGuard:
    """Watches the journal that a run has open; `ledger` holds the same facts."""

    def __init__(self, path: Path, ledger: Ledger) -> None:
        self._path, self._ledger = path, ledger
        self._files = (path, beside(path, "-wal"))
        self._folders = {folder: self._look(folder) for folder in (path.parent, path.parent / "frames")}
        self._trusts_numbers = not file_system_of(path).startswith(INVENTED_NUMBERS)
        self._known: dict[Path, _Look] = {}
        self.wrote()

    def wrote(self) -> None:
        """Note that the run itself has written the journal."""
        self._known = {file: look for file in self._files if (look := self._look(file)) is not None}

    def require_same(self) -> None:
        """Raise `LostJournalError` where the journal is not as the run left it."""
        for folder, before in self._folders.items():
            now = self._look(folder)
            if now is None or before is None or (self._trusts_numbers and now.numbers != before.numbers):
                raise StorageError(f"{folder} is gone, or another one", remedy="see that its disk is mounted")
        is_written = False
        for file, before in self._known.items():
            now = self._look(file)
            if now is None:
                self._lost(file, "was deleted")
            elif self._trusts_numbers and now.numbers != before.numbers:
                self._lost(file, "was replaced by another file")
            elif now.size < before.size:
                self._lost(file, f"was cut from {before.size} to {now.size} bytes")
            is_written |= now != before
        if is_written:
            self.require_whole()
            self.wrote()

    def require_whole(self) -> None:
        """Raise `LostJournalError` where the journal, as everybody else reads it, does not hold what the run wrote."""
        try:
            with closing(connect_to_read(self._path)) as connection:
                sound = connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
                same = sound and rows_of(connection) == self._ledger.rows()
        except sqlite3.DatabaseError as error:
            fault = reading_error(self._path, error)
            if isinstance(fault, StorageError):
                raise fault from error
            same = False
        if not same:
            self._lost(self._path, "was written to by another program, and does not hold what the run wrote")

    def _look(self, path: Path) -> _Look | None:
        try:
            found = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise storage_error(path, error, "look at") from error
        return _Look((found.st_dev, found.st_ino), found.st_size, found.st_mtime_ns)

    def _lost(self, file: Path, how: str) -> None:
        raise LostJournalError(
            f"{file} {how} while the run had it open; every frame and verdict stands in ledger.jsonl, too",
            remedy=f"acquire rebuild {self._path.parent} makes the journal anew; then run the same command again",
        )
