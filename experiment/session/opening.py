"""How a journal's SQLite file is opened, on whatever disk it lies, what it may hold, and what its faults mean.

A reader never writes; a run brings the file up to date and into write-ahead mode. What both trust has been checked: the
schema holds tables alone, for views, triggers and generated columns run SQL of others, and each row what its column is
meant to hold: no text for a number, and no path that leads outside the session.

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
from foundation.errors import RUN_AGAIN, FormatError, InputError, StorageError
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

_DAMAGED: Final = "it is damaged, or not to be trusted"

JOURNAL_VERSION = 2  # `PRAGMA user_version` of the journals that this software writes and reads (docs/formats.md)

# How long SQLite itself waits for another program before it gives the control back: as long as Ctrl-C may wait.
TRY_S = 1.0

# How long a reader waits where the journal is not in write-ahead mode: a commit takes milliseconds, a disk may stall
# for seconds.
READING_LIMIT_S = 10.0

# Longest text, blob or row that SQLite makes of a journal: what the judge keeps of a frame is some 100 kilobytes.
_MOST_VALUE_BYTES: Final = 64 << 20

# Largest sizes of what is read whole beside a journal: forty times those of 707 lights and 32 768 colours.
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

# What SQLite answers where it would have to write in order to read.
_CANNOT_IN_PLACE = {sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY}

# What a file system answers that has no locks (fcntl(2); Lustre, FUSE, NFS without its lock service).
_NO_LOCKS = {errno.ENOLCK, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EBADF}

# Faults of a disk that can be read all the same.
_READABLE_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

_SIDE_FILES = ("-wal", "-shm", "-journal")  # What SQLite keeps beside a journal, by suffix

_PROBE_BYTES = 65536  # As much as a commit writes, with the pages of its log

# File systems on which several machines work and share no memory, as /proc/self/mounts names them.
_NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "fuse.sshfs", "9p", "afs", "ceph", "fuse.glusterfs", "lustre"}


def restoring(path: Path) -> str:
    """Return what helps where a journal is damaged or gone."""
    # A disk that does not tell has a fault of its own, which is said before this.
    if os.path.isfile(path.with_name("ledger.jsonl")):  # noqa: PTH113 - it never raises
        return f"acquire rebuild {shlex.quote(str(path.parent))} makes it anew from ledger.jsonl"
    return "restore it from a copy"


class HeldJournalError(StorageError):
    """Another program held the journal for as long as a write waits: waiting once more would only double that."""


class Retry(Protocol):
    """Tries again what another program's hold on the journal hinders."""

    def run(self, attempt: Callable[[], _T], /) -> _T:
        """Return what `attempt` returns, in the end."""
        ...


def is_busy(error: sqlite3.DatabaseError) -> bool:
    """Return whether another program holds the journal, so that waiting helps."""
    return _primary_code(error) == sqlite3.SQLITE_BUSY


def create_file(path: Path) -> sqlite3.Connection:
    """Return a connection to a new journal with its tables and nothing in them."""
    try:
        connection = connect(path, "rwc")
        _make_tables(connection)
    except sqlite3.DatabaseError as error:
        raise StorageError(f"cannot write {path}: {error}; free space or choose another disk") from error
    return connection


def open_to_read(path: Path) -> sqlite3.Connection:
    """Return a connection that cannot write."""
    require_plain_folder(path.parent, MOST_BYTES)
    try:
        # A run has all three; without the third nobody is at work, and reading in place would make it.
        if _is_write_ahead(path) and not beside(path, "-shm").exists():
            connection = _copied(path)
        else:
            connection = _opened_or_copied(path)
        _require_journal(path, connection)
    except (OSError, sqlite3.DatabaseError) as error:
        raise reading_fault(path, error) from error
    return connection


def open_for_run(path: Path, retry: Retry) -> sqlite3.Connection:
    """Return a connection that writes, after bringing the journal into write-ahead mode.

    The caller holds the session's folder, so that no other run is at work. Who else writes is waited for.
    """
    require_plain_folder(path.parent, MOST_BYTES)
    try:
        connection = retry.run(lambda: connect(path, "rw"))
        retry.run(lambda: _require_journal(path, connection))
    except (OSError, sqlite3.DatabaseError) as error:
        raise reading_fault(path, error) from error
    try:
        with suppress(OSError):  # Left by a run that was killed while it made a copy.
            partial_path(path).unlink(missing_ok=True)
        if not _on_network(path):
            connection = _in_write_ahead(path, connection, retry)
    except OSError as error:
        connection.close()
        raise storage_error(path, error) from error
    except sqlite3.DatabaseError as error:
        connection.close()
        raise writing_error(path, error) from error
    return connection


def close_after_run(connection: sqlite3.Connection) -> None:
    """Put the journal back to one file unless somebody reads it, and close it; a second call does nothing."""
    try:
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    except sqlite3.Error:
        pass  # Somebody reads it, the disk is gone, or it is closed: the next run or reader copes with what is there.
    finally:
        connection.close()


def set_aside(path: Path) -> None:
    """Give a journal that is not to be used any more, and what SQLite keeps beside it, names that nothing reads."""
    number = 1
    while any(beside(path, f"{suffix}.{number}.lost").exists() for suffix in ("", *_SIDE_FILES)):
        number += 1
    for suffix in ("", *_SIDE_FILES):
        with suppress(FileNotFoundError):
            beside(path, suffix).rename(beside(path, f"{suffix}.{number}.lost"))


def connect(path: Path, mode: Literal["ro", "rw", "rwc"]) -> sqlite3.Connection:
    """Return a connection in a mode of SQLite's URIs, nothing checked; without locks where the file system has none."""
    try:
        return _connect_with(path, mode)
    except sqlite3.OperationalError:
        if not _is_lockless(path):
            raise
    _log.warning("%s: this file system has no locks; see to it that no other program writes it", path)
    return _connect_with(path, f"{mode}&nolock=1")


def _connect_with(path: Path, parameters: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"file:{quote(os.fsencode(path.absolute()))}?mode={parameters}",
        uri=True,
        timeout=READING_LIMIT_S if parameters.startswith("ro") else TRY_S,
        isolation_level=None,
    )
    try:
        # A committed row must survive a power cut: it is what makes a frame count.
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchall()
    except sqlite3.DatabaseError:
        connection.close()
        raise
    except UnicodeDecodeError as error:
        # The message of SQLite quotes the damaged schema byte by byte.
        connection.close()
        raise sqlite3.DatabaseError(f"malformed database schema, which is no text: {error.reason}") from error
    return connection


def _is_lockless(path: Path) -> bool:
    """Return whether the file system refuses locks altogether.

    Only asked where no connection could be opened: closing a file gives up all locks that the process has on it.
    """
    try:
        with path.open("rb") as stream:
            fcntl.lockf(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _NO_LOCKS
    return False


def _opened_or_copied(path: Path) -> sqlite3.Connection:
    """Return a reader of the file in its place, or of a copy where SQLite would have to write in order to read."""
    try:
        return connect(path, "ro")
    except sqlite3.OperationalError as error:
        if _primary_code(error) not in _CANNOT_IN_PLACE:
            raise
        return _copied(path)


def _copied(path: Path) -> sqlite3.Connection:
    memory = sqlite3.connect(":memory:", isolation_level=None)
    with tempfile.TemporaryDirectory(prefix="crop-") as scratch:
        copy = Path(scratch) / path.name
        for suffix in ("", "-wal", "-journal"):
            if (source := beside(path, suffix)).exists() or not suffix:
                shutil.copyfile(source, beside(copy, suffix))
        with closing(connect(copy, "rw")) as connection:
            connection.backup(memory)
    memory.execute("PRAGMA query_only = ON")
    return memory


def _is_write_ahead(path: Path) -> bool:
    """Return whether the file's header says write-ahead mode (sqlite.org/fileformat.html, 1.3.3: offset 18 is 2).

    Only asked while no `-shm` is there: closing a file gives up all locks that the process has on it.
    """
    if beside(path, "-shm").exists():
        return True
    with path.open("rb") as stream:
        return stream.read(20)[18:] == b"\x02\x02"


def _in_write_ahead(path: Path, connection: sqlite3.Connection, retry: Retry) -> sqlite3.Connection:
    """Return a connection in write-ahead mode, where the file system allows it.

    The mode cannot be changed while somebody reads. A reader who will not end keeps the file that he has, under no
    name; the run goes on with a copy.
    """
    try:
        connection.execute("PRAGMA journal_mode = WAL").fetchall()
    except sqlite3.OperationalError as error:
        if not is_busy(error):
            raise
        copy = partial_path(path)
        # No other writer may be at work meanwhile.
        retry.run(lambda: connection.execute("BEGIN IMMEDIATE"))
        with closing(connect(path, "ro")) as source, closing(connect(copy, "rwc")) as target:
            source.backup(target)
        connection.execute("ROLLBACK")
        connection.close()
        copy.replace(path)
        sync_folder(path.parent)
        renewed = connect(path, "rw")
        renewed.execute("PRAGMA journal_mode = WAL").fetchall()
        return renewed
    return connection


def _on_network(path: Path) -> bool:
    """Return whether the file lies on a file system that several machines work on; False where that is not known."""
    return file_system_of(path) in _NETWORK


def beside(path: Path, suffix: str) -> Path:
    """Return the file that SQLite keeps beside a journal under a suffix."""
    return path.with_name(path.name + suffix)


def _make_tables(connection: sqlite3.Connection) -> None:
    connection.execute("BEGIN IMMEDIATE")
    for statement in _TABLES.split(";"):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {JOURNAL_VERSION}")
    connection.execute("COMMIT")


def _require_journal(path: Path, connection: sqlite3.Connection) -> None:
    """Close the connection and refuse a file that is of another version, lacks a table, or holds what no run writes."""
    try:
        # Bounds what SQLite makes of a stranger's file, and lets nothing in its schema do more than hold rows.
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_VALUE_BYTES)
        connection.execute("PRAGMA trusted_schema = OFF")
        _require_plain_schema(path, connection)
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not version and not tables:
            raise FormatError(f"{path} is damaged: it is empty; {restoring(path)}")
        if version != JOURNAL_VERSION:
            raise FormatError(
                f"{path} is of version {version}, this software reads version {JOURNAL_VERSION}; use the software that "
                "wrote it"
            )
        if lacking := _COLUMNS.keys() - tables:
            raise FormatError(
                f"{path} is damaged: it lacks its table {' and '.join(sorted(lacking))}; {restoring(path)}"
            )
        require_sound_rows(path, connection)
    except BaseException:
        connection.close()
        raise


def reading_fault(path: Path, error: OSError | sqlite3.DatabaseError) -> FormatError | StorageError:
    """Return why a journal cannot be read, and what helps.

    SQLite calls a file damaged whose disk does not read it, and a copy must not take the place of a sound journal: so
    the disk is tried, and the file checked again.
    """
    if isinstance(error, OSError):
        gone = isinstance(error, FileNotFoundError)
        return reading_error(path, error, restoring(path) if gone else "check its permissions")
    if is_busy(error):
        return FormatError(f"cannot read {path}: {error}; see that no other program holds it")
    code = _primary_code(error)
    fault = _disk_fault(path)
    # Where permissions are in the way, the disk is not.
    openable = os.access(path, os.R_OK) or (fault is not None and disk_remedy(fault) is not None)
    failed = code == sqlite3.SQLITE_IOERR or (code == sqlite3.SQLITE_CANTOPEN and openable)
    if fault is not None and (failed or fault.errno not in _READABLE_FAULTS):
        return reading_error(path, fault, "check the permissions of its folder")
    if failed or (_is_damage(error) and _is_sound(path)):
        return StorageError(
            f"cannot read {path}: {error}, and its disk did not say why; check the disk and its cable, {RUN_AGAIN}"
        )
    if not _is_damage(error):
        return FormatError(f"cannot read {path}: {error}; check its permissions and the disk")
    return FormatError(f"{path} is damaged: {error}; {restoring(path)}")


def writing_error(path: Path, error: sqlite3.DatabaseError) -> FormatError | InputError | StorageError:
    """Return why a journal cannot be written, and what helps; the disk itself is asked what ails it."""
    if is_busy(error):
        return HeldJournalError(
            f"cannot write {path}: {error}; end the other program that holds the session, then run the same command "
            "again"
        )
    if (fault := _disk_fault(path)) is not None:
        return storage_error(path, fault)
    if _primary_code(error) == sqlite3.SQLITE_FULL:
        remedy = "free space"
    elif _primary_code(error) in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN):
        remedy = "see that the folder may be written and the disk is there"
    elif _is_damage(error) and not _is_sound(path):
        return FormatError(f"{path} is damaged: {error}; {restoring(path)}")
    else:
        remedy = "check the disk and its cable"
    return StorageError(f"cannot write {path}: {error}; {remedy}, {RUN_AGAIN}")


def _disk_fault(path: Path) -> OSError | None:
    """Return what the disk answers when something is written beside the journal; None if it does not mind."""
    try:
        # Without a name, so that nothing is left behind.
        with tempfile.TemporaryFile(dir=path.parent, buffering=0) as stream:
            stream.write(bytes(_PROBE_BYTES))
            os.fsync(stream.fileno())
    except OSError as error:
        return error
    return None


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    return _primary_code(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _is_sound(path: Path) -> bool:
    """Return whether a journal that was called damaged is whole, read once more."""
    try:
        with closing(connect(path, "ro")) as connection:
            return connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
    except sqlite3.DatabaseError:
        return False


def _primary_code(error: sqlite3.DatabaseError) -> int:
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


# What a row may hold, in SQL; {0} is the column.
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

_FORMS = f"{{0}} GLOB '{_MOMENT}.{6 * '[0-9]'}{_ZONE}' OR {{0}} GLOB '{_MOMENT}{_ZONE}'"


# SQLite asks for digits in all but parts of a second, and knows the zones that there are; but it ends a text at a zero
# byte, takes 30 February for 2 March, and 24:00 for the next day. Cheapest first, for a page asks every two seconds.
_TIME = (
    f"typeof({{0}}) = 'text' AND ({_FORMS}) AND length(CAST({{0}} AS BLOB)) = length({{0}}) "
    "AND {0} BETWEEN '1970' AND '9999' AND julianday({0}) IS NOT NULL AND substr({0}, 12, 2) < '24' "
    "AND (substr({0}, 9, 2) < '29' OR date(substr({0}, 1, 10), '+0 days') = substr({0}, 1, 10))"
)


_MAYBE_TIME = "({0} IS NULL OR {0} = '' OR (" + _TIME + "))"

_SHA256 = "({0} IS NULL OR (typeof({0}) = 'text' AND length({0}) <= 64 AND trim({0}, '0123456789abcdef') = ''))"

# What a row must fulfil, by table and column; times as `datetime.fromisoformat` reads them.
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

_TOGETHER: Final = {
    # A frame that has a hash was taken at a time with an exposure (0 where nobody knows), and has a verdict.
    "attempts": "(sha256 IS NULL OR (taken_at <> '' AND exposure_s BETWEEN 0 AND 1e9 AND size IS NOT NULL "
    "AND verdict IS NOT NULL))",
    "measurements": "(red IS NULL OR (green IS NOT NULL AND blue IS NOT NULL))",
}


def _require_plain_schema(path: Path, connection: sqlite3.Connection) -> None:
    """Refuse a journal with views, triggers, virtual tables or computed columns; a FormatError names it."""
    for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
        plain = kind == "table" and not str(sql or "").lstrip().upper().startswith("CREATE VIRTUAL")
        # SQLite makes an index of each primary key, without a text.
        if not (plain or (kind == "index" and sql is None)):
            raise FormatError(
                f"{path} holds the {kind} {str(name)[:80]!r}, which no journal has; {_DAMAGED}; {restoring(path)}"
            )


def require_sound_rows(path: Path, connection: sqlite3.Connection) -> None:
    """Refuse a journal with values that no run writes; costs milliseconds."""
    for table in _COLUMNS:
        columns = {row[1]: row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")}
        lacking = _COLUMNS[table].keys() - columns.keys()
        if lacking or any(columns.values()):
            raise FormatError(
                f"{path}: the columns of {table} are not those of a journal; {_DAMAGED}; {restoring(path)}"
            )
        sound = " AND ".join([f"({form.format(column)})" for column, form in _COLUMNS[table].items()])
        together = _TOGETHER.get(table, "1")
        query = f"SELECT COUNT(*) FROM {table} WHERE ({sound} AND {together}) IS NOT TRUE"
        if found := connection.execute(query).fetchone()[0]:
            raise FormatError(
                f"{path}: {found} rows of {table} hold values that no run writes; {_DAMAGED}; {restoring(path)}"
            )
    for (file,) in connection.execute("SELECT file FROM attempts"):
        if not is_inside_name(file):
            raise FormatError(
                f"{path} names the file {file[:200]!r}, which is none of the session; {_DAMAGED}; {restoring(path)}"
            )
