"""Whether a journal holds what a journal may hold: plain tables, and values of the kinds that its readers expect.

A session may be a stranger's, and an SQLite file can hold more than rows: views that never end, triggers that delete,
columns that are computed, text where a number is meant, names of files outside. All that is refused when the journal is
opened, so that nothing behind this has to expect it.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Final

from foundation.errors import FormatError
from foundation.foreign_folders import is_inside_name

MOST_VALUE_BYTES: Final = 64 << 20
"""Longest text, blob or row that SQLite makes of a journal: what the judge keeps of a frame is some 100 kilobytes."""

MOST_BYTES: Final = {"chart.json": 256 << 20, "illuminations.csv": 16 << 20, "session.toml": 1 << 20}
"""Largest sizes of what is read whole beside a journal: forty times those of 707 lights and 32 768 colours."""

_DAMAGED: Final = "it is damaged, or not to be trusted; restore it from a copy"

_WHOLE = "typeof({0}) = 'integer' AND {0} BETWEEN 0 AND 1000000000"
_MAYBE_WHOLE = "({0} IS NULL OR " + _WHOLE + ")"
_CODE = "typeof({0}) = 'integer' AND {0} BETWEEN 0 AND 255"
_SIZE = "({0} IS NULL OR (typeof({0}) = 'integer' AND {0} >= 0))"
_TEXT = "typeof({0}) = 'text' AND length({0}) < 100000"
_MAYBE_TEXT = "({0} IS NULL OR " + _TEXT + ")"
_REAL = "typeof({0}) IN ('real', 'integer') AND abs({0}) < 9e300"
_MAYBE_REAL = "({0} IS NULL OR typeof({0}) IN ('real', 'integer'))"
_MOMENT = "[0-9][0-9][0-9][0-9]-[01][0-9]-[0-3][0-9]T[0-2][0-9]:[0-5][0-9]:[0-5][0-9]"
_ZONE = "[+-][0-9][0-9]:[0-9][0-9]"
_FORMS = f"{{0}} GLOB '{_MOMENT}.{6 * '[0-9]'}{_ZONE}' OR {{0}} GLOB '{_MOMENT}{_ZONE}'"
# SQLite ends a text at a zero byte, takes 30 February for 2 March, and knows the zones that there are.
_TIME = (
    f"typeof({{0}}) = 'text' AND ({_FORMS}) AND length(CAST({{0}} AS BLOB)) = length({{0}}) "
    "AND {0} BETWEEN '1970' AND '9999' AND datetime({0}) IS NOT NULL "
    "AND strftime('%Y-%m-%dT%H:%M:%S', substr({0}, 1, 19), '+0 seconds') = substr({0}, 1, 19)"
)
_MAYBE_TIME = "({0} IS NULL OR {0} = '' OR (" + _TIME + "))"
_SHA256 = "({0} IS NULL OR (typeof({0}) = 'text' AND length({0}) <= 64 AND {0} NOT GLOB '*[^0-9a-f]*'))"

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
"""What a row must fulfil, by table and column; times as `datetime.fromisoformat` reads them."""

_TOGETHER: Final = {
    # A frame that has a hash was taken at a time with an exposure (0 where nobody knows), and has a verdict.
    "attempts": "(sha256 IS NULL OR (taken_at <> '' AND exposure_s BETWEEN 0 AND 1e9 AND size IS NOT NULL "
    "AND verdict IS NOT NULL))",
    "measurements": "(red IS NULL OR (green IS NOT NULL AND blue IS NOT NULL))",
}


def limit_values(connection: sqlite3.Connection) -> None:
    """Bound what SQLite makes of a journal, and let nothing in its schema do more than hold rows."""
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE_BYTES)
    connection.execute("PRAGMA trusted_schema = OFF")


def require_plain_schema(path: Path, connection: sqlite3.Connection) -> None:
    """Refuse a journal with views, triggers, virtual tables or computed columns; a FormatError names it."""
    for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
        plain = kind == "table" and not str(sql or "").lstrip().upper().startswith("CREATE VIRTUAL")
        # SQLite makes an index of each primary key, without a text.
        if not (plain or (kind == "index" and sql is None)):
            raise FormatError(f"{path} holds the {kind} {str(name)[:80]!r}, which no journal has; {_DAMAGED}")


def require_sound_rows(path: Path, connection: sqlite3.Connection, version: int) -> None:
    """Refuse a journal with values that no run writes; costs milliseconds."""
    for table in list(_COLUMNS)[: 3 if version == 1 else None]:
        columns = {row[1]: row[6] for row in connection.execute(f"PRAGMA table_xinfo({table})")}
        lacking = _COLUMNS[table].keys() - columns.keys()
        if lacking or any(columns.values()):
            raise FormatError(f"{path}: the columns of {table} are not those of a journal; {_DAMAGED}")
        sound = " AND ".join([f"({form.format(column)})" for column, form in _COLUMNS[table].items()])
        together = _TOGETHER.get(table, "1")
        query = f"SELECT COUNT(*) FROM {table} WHERE ({sound} AND {together}) IS NOT TRUE"
        if found := connection.execute(query).fetchone()[0]:
            raise FormatError(f"{path}: {found} rows of {table} hold values that no run writes; {_DAMAGED}")
    for (file,) in connection.execute("SELECT DISTINCT file FROM attempts"):
        if not is_inside_name(file):
            raise FormatError(f"{path} names the file {file[:200]!r}, which is none of the session; {_DAMAGED}")
