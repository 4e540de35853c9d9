"""Secrets in the settings of sessions that older software took: found, told of, and taken out.

Sessions are copied, shown and published. Until version 2 of the journal `session.toml` held the projector's password
and the whole of `sequence.notify`, readable by everybody.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Final, cast

import tomli_w

from foundation.errors import FormatError
from foundation.files import reading_error, write_whole
from foundation.foreign_folders import read_inside
from foundation.secret_texts import MASK, target_label

SETTINGS_FILE: Final = "session.toml"
"""Name of the settings of a session."""

_MOST_BYTES: Final = 1 << 20
"""Settings are a few kilobytes; what is larger was not written by a session, and is not read."""


def held_secrets(folder: Path) -> tuple[str, ...]:
    """Return the keys of a session's settings that hold a secret; none where the settings cannot be read."""
    try:
        return tuple(_secrets_of(_settings(folder / SETTINGS_FILE)))
    except FormatError:
        return ()


def secrets_warning(folder: Path) -> str:
    """Return what to say of the secrets that a session's settings hold, with the remedy; empty where there are none."""
    keys = held_secrets(folder)
    if not keys:
        return ""
    return (
        f"{folder / SETTINGS_FILE} holds a secret in clear text ({', '.join(keys)}), as older software left it; take "
        f"it out with acquire redact {folder}, and change it where copies of the session are about"
    )


def redact(folder: Path) -> tuple[str, ...]:
    """Take the secrets out of a session's settings; return the keys that held one."""
    path = folder / SETTINGS_FILE
    settings = _settings(path)
    found = _secrets_of(settings)
    if found:
        for key, shown in found.items():
            holder, _, last = key.rpartition(".")
            table = _table(settings, holder)
            if shown is None:
                del table[last]
            else:
                table[last] = shown
        write_whole(path, tomli_w.dumps(settings))
    return tuple(found)


def _settings(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_inside(path.parent, path.name, _MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise reading_error(path, error, "restore it from a copy", "the session's settings") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path} is damaged: {error}; restore it from a copy") from error


def _secrets_of(settings: dict[str, Any]) -> dict[str, str | None]:
    """Return what may stand for each secret, by its key; None where nothing may."""
    found: dict[str, str | None] = {}
    if _table(settings, "lab.projector").get("password"):
        found["lab.projector.password"] = None
    notify = _table(settings, "sequence").get("notify")
    # What this software writes ends so, unless nothing had to be masked.
    if isinstance(notify, str) and not notify.endswith(MASK):
        try:
            label = target_label(notify)
        except ValueError:
            label = ""
        if label != notify:
            found["sequence.notify"] = label
    return found


def _table(settings: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the table of that name, empty where there is none."""
    table: Any = settings
    for part in name.split("."):
        table = cast("dict[str, Any]", table).get(part) if isinstance(table, dict) else None
    return cast("dict[str, Any]", table) if isinstance(table, dict) else {}
