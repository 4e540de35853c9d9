"""Open the SQLite file of a journal on any disk, check its contents, and explain errors.

A reader never changes the file. A run switches the file to write-ahead mode. Both check the contents first. The schema
may contain only tables, because views, triggers and generated columns could run foreign SQL. All values must have valid
types, and no path may lead out of the session.

Sources: sqlite.org/wal.html, sqlite.org/lockingv3.html, sqlite.org/fileformat.html.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shlex
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Final, Literal, Protocol, TypeVar
from urllib.parse import quote

from experiment.session.heartbeat import file_system_of
from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError, counted
from foundation.files import (
    disk_remedy,
    is_inside_name,
    partial_path,
    reading_error,
    require_plain_folder,
    storage_error,
    sync_folder,
)

_T = TypeVar("_T")

_log = logging.getLogger(__name__)

_DAMAGED: Final = "it is damaged or was manipulated"

JOURNAL_VERSION = 2  # Value of `PRAGMA user_version` in a journal (docs/formats.md)

# Longest time that one call of SQLite waits for another program, seconds. Ctrl-C may be delayed by this time.
TRY_S = 1.0

# Longest time that a reader waits for the end of a commit, seconds. In write-ahead mode a reader never waits.
READING_LIMIT_S = 10.0

# Largest text, blob or row that SQLite reads, bytes. The measurement of a frame has about 100 kilobytes.
_MOST_VALUE_BYTES: Final = 64 << 20

# Largest accepted sizes of files, bytes: forty times the sizes for 707 illuminants and 32 768 colours.
MOST_BYTES: Final = {"chart.json": 256 << 20, "illuminations.csv": 16 << 20, "session.toml": 1 << 20}

_TABLES = """
CREATE TABLE attempts (
    id INTEGER PRIMARY KEY,
    step INTEGER NOT NULL,
    kind TEXT NOT NULL,
    illumination INTEGER,
    file TEXT NOT NULL,
    started_at TEXT NOT NULL,
    ended_at TEXT,
    taken_at TEXT,
    exposure_s REAL,
    size INTEGER,
    sha256 TEXT,
    verdict TEXT,
    reason TEXT NOT NULL DEFAULT ''
);
CREATE TABLE plan (
    step INTEGER PRIMARY KEY, kind TEXT NOT NULL, illumination INTEGER,
    red INTEGER NOT NULL, green INTEGER NOT NULL, blue INTEGER NOT NULL
);
CREATE TABLE events (id INTEGER PRIMARY KEY, at TEXT NOT NULL, what TEXT NOT NULL, detail TEXT NOT NULL);
CREATE TABLE checks (
    attempt INTEGER NOT NULL, position INTEGER NOT NULL, name TEXT NOT NULL,
    value REAL, low REAL, high REAL, unit TEXT NOT NULL, reason TEXT NOT NULL,
    PRIMARY KEY (attempt, position)
);
CREATE TABLE measurements (
    attempt INTEGER PRIMARY KEY, red REAL, green REAL, blue REAL, data BLOB NOT NULL,
    voids INTEGER NOT NULL, lasting INTEGER NOT NULL
);
CREATE TABLE timings (
    attempt INTEGER NOT NULL, name TEXT NOT NULL, seconds REAL NOT NULL, PRIMARY KEY (attempt, name)
);
CREATE TABLE heartbeat (
    id INTEGER PRIMARY KEY CHECK (id = 1), at TEXT NOT NULL, pid INTEGER NOT NULL, started TEXT NOT NULL,
    host TEXT NOT NULL, boot TEXT NOT NULL, state TEXT NOT NULL, sentence TEXT NOT NULL, until TEXT NOT NULL
);
CREATE TABLE records (key TEXT PRIMARY KEY, text TEXT NOT NULL);
"""

# Error codes of SQLite for a file that cannot be read without writing next to it.
_NEEDS_WRITING = {sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY}

# Errors of a file system without locks (fcntl(2); Lustre, FUSE, NFS without its lock service).
_NO_LOCKS = {errno.ENOLCK, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EBADF}

# Errors of a test write on a disk that can still be read.
_READABLE_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

_SIDE_FILES = ("-wal", "-shm", "-journal")  # Suffixes of SQLite's files next to a journal

_PROBE_BYTES = 65536  # Size of a test write, bytes; about the size of a commit

# Network file systems, as named in /proc/self/mounts. They have no shared memory, which write-ahead mode needs.
_NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "fuse.sshfs", "9p", "afs", "ceph", "fuse.glusterfs", "lustre"}


def restore_remedy(path: Path) -> str:
    """Return the remedy for a damaged or missing journal."""
    # Errors of the disk can be ignored here, because callers report them first.
    if os.path.isfile(path.with_name("ledger.jsonl")):  # noqa: PTH113 - it never raises
        return f"restore it from ledger.jsonl with acquire rebuild {shlex.quote(str(path.parent))}"
    return "restore it from a copy"


class BusyJournalError(StorageError):
    """Another program held the journal for the whole waiting time of a write; waiting again does not help."""


class Retry(Protocol):
    """Repeats an operation while another program holds the journal."""

    def run(self, attempt: Callable[[], _T], /) -> _T:
        """Return the result of `attempt`."""
        ...


def is_busy(error: sqlite3.DatabaseError) -> bool:
    """Return whether another program holds the journal, so that waiting helps."""
    return _primary_code(error) == sqlite3.SQLITE_BUSY


def create_file(path: Path) -> sqlite3.Connection:
    """Create a journal with empty tables and return a connection to it."""
    try:
        connection = connect(path, "rwc")
        _make_tables(connection)
    except sqlite3.DatabaseError as error:
        raise StorageError(f"cannot write {path}: {error}; free space or choose another disk") from error
    return connection


def open_to_read(path: Path) -> sqlite3.Connection:
    """Return a read-only connection."""
    require_plain_folder(path.parent, MOST_BYTES)
    try:
        # During a run, the file `-shm` exists. If it does not exist, reading the journal in place would create it.
        if _is_write_ahead(path) and not side_file(path, "-shm").exists():
            connection = _copy_to_memory(path)
        else:
            connection = _open_or_copy(path)
        _require_journal(path, connection)
    except (OSError, sqlite3.DatabaseError) as error:
        raise reading_fault(path, error) from error
    return connection


def open_for_run(path: Path, retry: Retry) -> sqlite3.Connection:
    """Switch the journal to write-ahead mode, and return a connection for writing.

    The caller must have locked the folder of the session against other runs. `retry` waits for other writers.
    """
    require_plain_folder(path.parent, MOST_BYTES)
    try:
        connection = retry.run(lambda: connect(path, "rw"))
        retry.run(lambda: _require_journal(path, connection))
    except (OSError, sqlite3.DatabaseError) as error:
        raise reading_fault(path, error) from error
    try:
        with suppress(OSError):  # Delete the file that a run leaves if it is killed during a copy.
            partial_path(path).unlink(missing_ok=True)
        if not _on_network(path):
            connection = _switch_to_write_ahead(path, connection, retry)
    except OSError as error:
        connection.close()
        raise storage_error(path, error) from error
    except sqlite3.DatabaseError as error:
        connection.close()
        raise writing_error(path, error) from error
    return connection


def close_after_run(connection: sqlite3.Connection) -> None:
    """Close a journal; a second call does nothing. Unless it is being read, it becomes a single file."""
    try:
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    except sqlite3.Error:
        pass  # The journal is being read or already closed, or its disk is missing. The next run handles this.
    finally:
        connection.close()


def set_aside(path: Path) -> None:
    """Rename a journal that is not used any more, and the files that SQLite keeps next to it."""
    number = 1
    while any(side_file(path, f"{suffix}.{number}.lost").exists() for suffix in ("", *_SIDE_FILES)):
        number += 1
    for suffix in ("", *_SIDE_FILES):
        with suppress(FileNotFoundError):
            side_file(path, suffix).rename(side_file(path, f"{suffix}.{number}.lost"))


def connect(path: Path, mode: Literal["ro", "rw", "rwc"]) -> sqlite3.Connection:
    """Connect to a file without checking its contents. If its file system has no locks, none are used."""
    try:
        return _connect_with(path, mode)
    except sqlite3.OperationalError:
        if not _is_lockless(path):
            raise
    _log.warning("%s: this file system has no locks; make sure that no other program writes the file", path)
    return _connect_with(path, f"{mode}&nolock=1")


def _connect_with(path: Path, parameters: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"file:{quote(os.fsencode(path.absolute()))}?mode={parameters}",
        uri=True,
        timeout=READING_LIMIT_S if parameters.startswith("ro") else TRY_S,
        isolation_level=None,
    )
    try:
        # A committed row must survive a power cut, because a frame without it is not accepted.
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchall()
    except sqlite3.DatabaseError:
        connection.close()
        raise
    except UnicodeDecodeError as error:
        # The message of SQLite contains bytes of the damaged schema that are not text.
        connection.close()
        raise sqlite3.DatabaseError(f"malformed database schema, not a text: {error.reason}") from error
    return connection


def _is_lockless(path: Path) -> bool:
    # Do not call this while a connection is open, because closing a file releases all locks of the process on it.
    try:
        with path.open("rb") as stream:
            fcntl.lockf(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _NO_LOCKS
    return False


def _open_or_copy(path: Path) -> sqlite3.Connection:
    # If SQLite cannot read the file without writing next to it, a copy is read.
    try:
        return connect(path, "ro")
    except sqlite3.OperationalError as error:
        if _primary_code(error) not in _NEEDS_WRITING:
            raise
        return _copy_to_memory(path)


def _copy_to_memory(path: Path) -> sqlite3.Connection:
    memory = sqlite3.connect(":memory:", isolation_level=None)
    with tempfile.TemporaryDirectory(prefix="crop-") as scratch:
        copy = Path(scratch) / path.name
        for suffix in ("", "-wal", "-journal"):
            if (source := side_file(path, suffix)).exists() or not suffix:
                shutil.copyfile(source, side_file(copy, suffix))
        with closing(connect(copy, "rw")) as connection:
            connection.backup(memory)
    memory.execute("PRAGMA query_only = ON")
    return memory


def _is_write_ahead(path: Path) -> bool:
    # In write-ahead mode, bytes 18 and 19 of the header are 2 (sqlite.org/fileformat.html, 1.3.3). During a run, the
    # file is not opened here, because closing it would release all locks of the process on it.
    if side_file(path, "-shm").exists():
        return True
    with path.open("rb") as stream:
        return stream.read(20)[18:] == b"\x02\x02"


def _switch_to_write_ahead(path: Path, connection: sqlite3.Connection, retry: Retry) -> sqlite3.Connection:
    # The mode cannot be changed while another program reads. If a reader does not end, a copy replaces the file, and
    # the run uses this copy. The reader keeps the old file, which no longer has a name.
    try:
        connection.execute("PRAGMA journal_mode = WAL").fetchall()
    except sqlite3.OperationalError as error:
        if not is_busy(error):
            raise
        copy = partial_path(path)
        # No other program may write during the copy.
        retry.run(lambda: connection.execute("BEGIN IMMEDIATE"))
        with closing(connect(path, "ro")) as source, closing(connect(copy, "rwc")) as target:
            source.backup(target)
        connection.execute("ROLLBACK")
        connection.close()
        copy.replace(path)
        sync_folder(path.parent)
        new_connection = connect(path, "rw")
        new_connection.execute("PRAGMA journal_mode = WAL").fetchall()
        return new_connection
    return connection


def _on_network(path: Path) -> bool:
    return file_system_of(path) in _NETWORK


def side_file(path: Path, suffix: str) -> Path:
    """Return a file that SQLite keeps next to a journal."""
    return path.with_name(path.name + suffix)


def _make_tables(connection: sqlite3.Connection) -> None:
    connection.execute("BEGIN IMMEDIATE")
    for statement in _TABLES.split(";"):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {JOURNAL_VERSION}")
    connection.execute("COMMIT")


def _require_journal(path: Path, connection: sqlite3.Connection) -> None:
    """Refuse a file with another version, missing tables or invalid rows, and close its connection."""
    try:
        # Limit the memory for a foreign file, and forbid unsafe SQL functions in its schema.
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_VALUE_BYTES)
        connection.execute("PRAGMA trusted_schema = OFF")
        _require_plain_schema(path, connection)
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not version and not tables:
            raise FormatError(f"{path} is damaged: it is empty; {restore_remedy(path)}")
        if version != JOURNAL_VERSION:
            raise FormatError(
                f"{path} has version {version}, expected {JOURNAL_VERSION}; use the software that wrote the file"
            )
        if missing := _COLUMNS.keys() - tables:
            raise FormatError(
                f"{path} is damaged: the table {' and '.join(sorted(missing))} is missing; {restore_remedy(path)}"
            )
        require_sound_rows(path, connection)
    except BaseException:
        connection.close()
        raise


def reading_fault(path: Path, error: OSError | sqlite3.DatabaseError) -> FormatError | StorageError:
    """Return the error for a journal that cannot be read, with a remedy."""
    # If the disk fails, SQLite may report an intact journal as damaged. So the disk is tested, and the file is checked
    # again.
    if isinstance(error, OSError):
        is_missing = isinstance(error, FileNotFoundError)
        return reading_error(path, error, restore_remedy(path) if is_missing else "check its permissions")
    if is_busy(error):
        return FormatError(f"cannot read {path}: {error}; end the other program that is using it")
    code = _primary_code(error)
    fault = _disk_fault(path)
    # If permissions are missing, the disk is not at fault.
    is_openable = os.access(path, os.R_OK) or (fault is not None and disk_remedy(fault) is not None)
    has_failed = code == sqlite3.SQLITE_IOERR or (code == sqlite3.SQLITE_CANTOPEN and is_openable)
    if fault is not None and (has_failed or fault.errno not in _READABLE_FAULTS):
        return reading_error(path, fault, "check the permissions of its folder")
    if has_failed or (_is_damage(error) and _is_sound(path)):
        return StorageError(
            f"cannot read {path}: {error}, and the disk reports no reason; check the disk and its cable, {RUN_AGAIN}"
        )
    if not _is_damage(error):
        return FormatError(f"cannot read {path}: {error}; check its permissions and the disk")
    return FormatError(f"{path} is damaged: {error}; {restore_remedy(path)}")


def writing_error(path: Path, error: sqlite3.DatabaseError) -> FormatError | InputError | StorageError:
    """Return the error for a journal that cannot be written, with a remedy; the disk is tested."""
    if is_busy(error):
        return BusyJournalError(
            f"cannot write {path}: {error}; end the other program that is using the session, {RUN_AGAIN}"
        )
    if (fault := _disk_fault(path)) is not None:
        return storage_error(path, fault)
    if _primary_code(error) == sqlite3.SQLITE_FULL:
        remedy = "free space or choose another disk"
    elif _primary_code(error) in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN):
        remedy = "check that the folder is writable and the disk is connected"
    elif _is_damage(error) and not _is_sound(path):
        return FormatError(f"{path} is damaged: {error}; {restore_remedy(path)}")
    else:
        remedy = "check the disk and its cable"
    return StorageError(f"cannot write {path}: {error}; {remedy}, {RUN_AGAIN}")


def _disk_fault(path: Path) -> OSError | None:
    try:
        # The file has no name, so nothing remains.
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as stream:
            stream.write(bytes(_PROBE_BYTES))
            os.fsync(stream.fileno())
    except OSError as error:
        return error
    return None


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    return _primary_code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _is_sound(path: Path) -> bool:
    try:
        with closing(connect(path, "ro")) as connection:
            return connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
    except sqlite3.DatabaseError:
        return False


def _primary_code(error: sqlite3.DatabaseError) -> int:
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


# SQL conditions of valid values; {0} is the name of the column.
_WHOLE = "typeof({0}) = 'integer' AND {0} BETWEEN 0 AND 1000000000"

_MAYBE_WHOLE = "({0} IS NULL OR " + _WHOLE + ")"

_CODE = "typeof({0}) = 'integer' AND {0} BETWEEN 0 AND 255"

_SIZE = "({0} IS NULL OR (typeof({0}) = 'integer' AND {0} >= 0))"

_TEXT = "typeof({0}) = 'text' AND length({0}) < 100000"

_MAYBE_TEXT = "({0} IS NULL OR " + _TEXT + ")"

_REAL = "typeof({0}) IN ('real', 'integer') AND abs({0}) < 9e300"

_MAYBE_REAL = "({0} IS NULL OR typeof({0}) IN ('real', 'integer'))"

_MOMENT = "????-??-??T??:??:??"

_ZONE = "[+-]??:??"

_TIME_FORMS = f"{{0}} GLOB '{_MOMENT}.{6 * '[0-9]'}{_ZONE}' OR {{0}} GLOB '{_MOMENT}{_ZONE}'"


# `julianday` checks the zone and all digits except fractions of a second. It ignores text after a zero byte, reads
# 30 February as 2 March, and accepts 24:00, so these cases have conditions of their own. The fastest condition is
# first, because monitoring reads the journal every two seconds.
_TIME = (
    f"typeof({{0}}) = 'text' AND ({_TIME_FORMS}) AND length(CAST({{0}} AS BLOB)) = length({{0}}) "
    "AND {0} BETWEEN '1970' AND '9999' AND julianday({0}) IS NOT NULL AND substr({0}, 12, 2) < '24' "
    "AND (substr({0}, 9, 2) < '29' OR date(substr({0}, 1, 10), '+0 days') = substr({0}, 1, 10))"
)


_MAYBE_TIME = "({0} IS NULL OR {0} = '' OR (" + _TIME + "))"

_SHA256 = "({0} IS NULL OR (typeof({0}) = 'text' AND length({0}) <= 64 AND trim({0}, '0123456789abcdef') = ''))"

# Conditions by table and column. Times must be readable by `datetime.fromisoformat`.
_COLUMNS: Final = {
    "plan": {
        "step": _WHOLE,
        "kind": _TEXT,
        "illumination": _MAYBE_WHOLE,
        "red": _CODE,
        "green": _CODE,
        "blue": _CODE,
    },
    "attempts": {
        "id": _WHOLE,
        "step": _WHOLE,
        "kind": _TEXT,
        "illumination": _MAYBE_WHOLE,
        "file": _TEXT,
        "started_at": _TIME,
        "ended_at": _MAYBE_TIME,
        "taken_at": _MAYBE_TIME,
        "exposure_s": _MAYBE_REAL,
        "size": _SIZE,
        "sha256": _SHA256,
        "verdict": _MAYBE_TEXT,
        "reason": _TEXT,
    },
    "events": {"id": _WHOLE, "at": _TIME, "what": _TEXT, "detail": _TEXT},
    "checks": {
        "attempt": _WHOLE,
        "position": _WHOLE,
        "name": _TEXT,
        "value": _MAYBE_REAL,
        "low": _MAYBE_REAL,
        "high": _MAYBE_REAL,
        "unit": _TEXT,
        "reason": _TEXT,
    },
    "measurements": {
        "attempt": _WHOLE,
        "red": _MAYBE_REAL,
        "green": _MAYBE_REAL,
        "blue": _MAYBE_REAL,
        "data": "typeof({0}) = 'blob'",
        "voids": _WHOLE,
        "lasting": _WHOLE,
    },
    "timings": {"attempt": _WHOLE, "name": _TEXT, "seconds": _REAL},
    "heartbeat": {
        "id": _WHOLE,
        "at": _TIME,
        "pid": "typeof({0}) = 'integer'",
        "started": _TEXT,
        "host": _TEXT,
        "boot": _TEXT,
        "state": _TEXT,
        "sentence": _TEXT,
        "until": _TIME,
    },
    "records": {"key": _TEXT, "text": _TEXT},
}

_JOINT_CONDITIONS: Final = {
    # A frame with a hash has a time, an exposure (0 if unknown), a size and a verdict.
    "attempts": "(sha256 IS NULL OR (taken_at <> '' AND exposure_s BETWEEN 0 AND 1e9 AND size IS NOT NULL "
    "AND verdict IS NOT NULL))",
    "measurements": "(red IS NULL OR (green IS NOT NULL AND blue IS NOT NULL))",
}


def _require_plain_schema(path: Path, connection: sqlite3.Connection) -> None:
    for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
        is_plain = kind == "table" and not str(sql or "").lstrip().upper().startswith("CREATE VIRTUAL")
        # SQLite itself creates an index for each primary key; its `sql` is NULL.
        if not (is_plain or (kind == "index" and sql is None)):
            raise FormatError(
                f"{path} has the {kind} {str(name)[:80]!r}, which is not part of a journal: {_DAMAGED}; "
                f"{restore_remedy(path)}"
            )


def require_sound_rows(path: Path, connection: sqlite3.Connection) -> None:
    """Refuse a journal with values that no run writes."""
    for table in _COLUMNS:
        columns = {row[1]: row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")}
        missing = _COLUMNS[table].keys() - columns.keys()
        if missing or any(columns.values()):
            raise FormatError(
                f"{path}: the table {table} has other columns than a journal: {_DAMAGED}; {restore_remedy(path)}"
            )
        row_condition = " AND ".join([f"({condition.format(column)})" for column, condition in _COLUMNS[table].items()])
        joint_condition = _JOINT_CONDITIONS.get(table, "1")
        query = f"SELECT COUNT(*) FROM {table} WHERE ({row_condition} AND {joint_condition}) IS NOT TRUE"
        if bad_rows := connection.execute(query).fetchone()[0]:
            raise FormatError(
                f"{path}: {counted(bad_rows, 'row')} of {table} with values that no run writes: {_DAMAGED}; "
                f"{restore_remedy(path)}"
            )
    for (file,) in connection.execute("SELECT file FROM attempts"):
        if not is_inside_name(file):
            raise FormatError(
                f"{path} has the file {file[:200]!r}, which is outside the session: {_DAMAGED}; {restore_remedy(path)}"
            )
