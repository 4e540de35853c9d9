"""The journal's facts a second time: `ledger.jsonl`, from which a journal that was lost is made anew.

Rules that hold inside:

- A line is a transaction: the rows that it put or changed, by table, as a JSON object. It is on the disk before the
  journal commits the same, so that the lines hold all that the journal holds, and at most one transaction more.
- A later row of the same key changes the columns that it names. Signs of life, and where the session lies, are no facts
  and are not kept.
- What a crash cut off is the last line alone, and is no fact.
"""

from __future__ import annotations

import base64
import json
import os
import shlex
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, cast

from experiment.session.records import VOIDED
from foundation.errors import FormatError, StorageError, counted
from foundation.files import is_inside_name, open_inside, reading_error, storage_error, write_whole

LEDGER_FILE: Final = "ledger.jsonl"
"""Its name in a session's folder."""

MOST_BYTES: Final = 1 << 30
"""Of a ledger that is read: twenty times what 707 lights have, so that a stranger's fills no memory."""

PLACE: Final = "place"
"""Key of the record that says for which folder signs of life are given."""

_KEYS: Final = {
    "plan": ("step",),
    "attempts": ("id",),
    "events": ("id",),
    "checks": ("attempt", "position"),
    "measurements": ("attempt",),
    "timings": ("attempt", "name"),
    "records": ("key",),
}
"""What tells the rows of a table apart."""

_BEGUN: Final = dict.fromkeys(("ended_at", "taken_at", "exposure_s", "size", "sha256", "verdict")) | {"reason": ""}
"""Columns of an attempt that are not known when it begins, as the journal has them then."""

Row = dict[str, Any]
Rows = dict[str, dict[tuple[Any, ...], Row]]
"""Rows by table and key, columns by name."""


def ledger_path(folder: Path) -> Path:
    """Return the path of a session's ledger."""
    return folder / LEDGER_FILE


def rows_of(connection: sqlite3.Connection) -> Rows:
    """Return the facts that a journal of this version holds."""
    rows: Rows = {}
    for table in _KEYS:
        cursor = connection.execute(f"SELECT * FROM {table} ORDER BY rowid")
        names = [column[0] for column in cursor.description]
        for values in cursor.fetchall():
            _put(rows, table, dict(zip(names, values, strict=True)))
    rows.get("records", {}).pop((PLACE,), None)
    return {table: of_table for table, of_table in rows.items() if of_table}


def insert_rows(connection: sqlite3.Connection, rows: Rows) -> None:
    """Write facts into a journal that has its tables and nothing in them."""
    for table, of_table in rows.items():
        for row in of_table.values():
            marks = ", ".join("?" * len(row))
            connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))


def read_ledger(path: Path) -> Rows:
    """Return the facts that a ledger holds."""
    return _gathered(_read(path))


def _read(path: Path, size: int = MOST_BYTES + 1) -> list[Mapping[str, Sequence[Row]]]:
    """Return the transactions in the first `size` bytes of a ledger."""
    try:
        with open_inside(path.parent, path.name) as stream:
            content = stream.read(size)
    except OSError as error:
        raise reading_error(path, error, "restore the session from a copy") from error
    if len(content) > MOST_BYTES:
        raise FormatError(f"{path} has more than {MOST_BYTES} bytes; restore it from a copy")
    return list(_transactions(path, content.split(b"\n")))


def _gathered(transactions: Sequence[Mapping[str, Sequence[Row]]]) -> Rows:
    """Return the facts that transactions left."""
    rows: Rows = {}
    for transaction in transactions:
        for table, changes in transaction.items():
            for row in changes:
                _put(rows, table, row)
    return rows


def _transactions(path: Path, lines: Sequence[bytes]) -> Iterator[Mapping[str, Sequence[Row]]]:
    """Yield what each line says; what stands behind the last line break was cut off."""
    for number, line in enumerate(lines[:-1], 1):
        try:
            yield {table: [_checked_row(table, row) for row in rows] for table, rows in json.loads(line).items()}
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            if number == len(lines) - 1 and not line.endswith(b"}"):
                return
            raise FormatError(f"{path}, line {number}, is damaged: {error}; restore it from a copy") from error


def _checked_row(table: str, row: Row) -> Row:
    """Return a row as the journal has it; the names in it become part of statements."""
    if any(key not in row for key in _KEYS[table]) or not all(name.isidentifier() for name in row):
        raise ValueError(f"a row of {table} without its key")
    if not all(value is None or isinstance(value, str | int | float) for value in row.values()):
        raise ValueError(f"a row of {table} with what is no number and no text")
    if not is_inside_name(row.get("file", "frames")):
        raise ValueError(f"the file {row['file']!r}, which is none of the session")
    return row if "data" not in row else {**row, "data": base64.b64decode(row["data"], validate=True)}


def _put(rows: Rows, table: str, row: Row) -> None:
    key = tuple(row[name] for name in _KEYS[table])
    rows.setdefault(table, {}).setdefault(key, dict(_BEGUN) if table == "attempts" else {}).update(row)


def _line(rows: Mapping[str, Sequence[Row]]) -> bytes:
    """Return a transaction as a line."""

    def plain(value: object) -> str:
        return base64.b64encode(cast("bytes", value)).decode()

    return json.dumps(rows, default=plain, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"


def _lines(rows: Rows) -> bytes:
    """Return facts as lines: the plan and the records, each attempt with what is known of it, and the events."""
    alone = [{table: list(rows[table].values())} for table in ("plan", "records") if table in rows]
    attempts: dict[int, dict[str, list[Row]]] = {}
    for table, column in (
        ("attempts", "id"),
        ("checks", "attempt"),
        ("measurements", "attempt"),
        ("timings", "attempt"),
    ):
        for row in rows.get(table, {}).values():
            attempts.setdefault(row[column], {}).setdefault(table, []).append(row)
    events = [{"events": list(rows["events"].values())}] if "events" in rows else []
    return b"".join(_line(one) for one in [*alone, *attempts.values(), *events])


class Ledger:
    """A ledger that a run writes; close it after use.

    `rows`: what the journal holds. Where the file says something else it is written anew; a journal that lacks
    frames which the file has is refused by a FormatError.
    """

    def __init__(self, path: Path, rows: Rows) -> None:
        self._path = path
        try:
            is_there = path.is_file()
        except OSError as error:
            raise storage_error(path, error, "look at") from error
        if not is_there or not self._is_of(rows):
            self._write_anew(rows)
        self._handle, self._end = self._opened()
        self._next = self._end

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            with suppress(OSError):  # All that it was given is on the disk.
                os.close(handle)

    def append(self, changes: Mapping[str, Sequence[Row]]) -> None:
        """Put a transaction down, in place of one that was never kept; it is on the disk when this returns."""
        line = _line(changes)
        try:
            os.pwrite(self._handle, line, self._end)
            os.ftruncate(self._handle, self._end + len(line))
            os.fsync(self._handle)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._handle, self._end)
            raise storage_error(self._path, error) from error
        self._next = self._end + len(line)

    def keep(self) -> None:
        """Let the last transaction stay: the journal has it, too, or is lost."""
        self._end = self._next

    def is_there(self) -> bool:
        """Return whether the file that is written is the one on the disk, in full size."""
        try:
            found, own = self._path.stat(), os.fstat(self._handle)
        except OSError:
            return False
        return (found.st_dev, found.st_ino, found.st_size) == (own.st_dev, own.st_ino, self._next)

    def restore(self, rows: Rows) -> None:
        """Write the file anew, which was removed or changed while it was open."""
        self.close()
        self._write_anew(rows)
        self._handle, self._end = self._opened()
        self._next = self._end

    def rows(self) -> Rows:
        """Return the facts in the file, without a transaction that the journal does not have yet."""
        return _gathered(_read(self._path, self._end))

    def _is_of(self, rows: Rows) -> bool:
        """Return whether the file holds these facts; refuse where it knows of frames that are not among them."""
        try:
            transactions = _read(self._path)
        except FormatError:
            return False
        if _gathered(transactions) == rows:
            return True
        require_none_lacking(self._path, lacking_frames(_frames(_gathered(transactions[:-1])), _frames(rows)))
        return False

    def _write_anew(self, rows: Rows) -> None:
        write_whole(self._path, _lines(rows))

    def _opened(self) -> tuple[int, int]:
        """Return a handle of the file, and its size."""
        try:
            handle = os.open(self._path, os.O_RDWR)
            return handle, os.fstat(handle).st_size
        except OSError as error:
            raise storage_error(self._path, error) from error


Frames = set[tuple[int, str, str | None]]
"""Frames by attempt and hash, with their verdicts."""


def settled_frames(path: Path) -> Frames:
    """Return the frames that a journal must hold that is opened after this: all but those of the last transaction.

    None where there is no ledger, or a damaged one, which says nothing against a journal that is whole.
    """
    with suppress(FormatError, StorageError):
        if os.path.isfile(path):  # noqa: PTH113 - it never raises
            return _frames(_gathered(_read(path)[:-1]))
    return set()


def lacking_frames(settled: Frames, known: Frames) -> Frames:
    """Return the settled frames that are not among those known, or have another verdict there.

    A frame that is known to be voided is no older state of it, since no verdict follows that one.
    """
    voided = {(attempt, sha256) for attempt, sha256, verdict in known if verdict == VOIDED}
    return {frame for frame in settled - known if frame[:2] not in voided}


def require_none_lacking(path: Path, lacking: Frames) -> None:
    """Refuse a journal that lacks frames of the ledger `path`, or verdicts on them."""
    if lacking:
        raise FormatError(
            f"the journal of {path.parent} lacks {counted(len(lacking), 'frame')} that {path} has, or what was said of "
            "them: it is an older one, or was damaged",
            remedy=f"acquire rebuild {shlex.quote(str(path.parent))} makes it anew",
        )


def _frames(rows: Rows) -> Frames:
    return {
        (row["id"], row["sha256"], row["verdict"]) for row in rows.get("attempts", {}).values() if row.get("sha256")
    }
