"""The raw files that a table was made from, as `frames.csv` lists them, and the hash over them that names a session."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from foundation.errors import FormatError

COLUMNS: Final = ("kind", "illumination", "file", "sha256")
"""Columns of a table's `frames.csv` (docs/formats.md)."""


@dataclass(frozen=True)
class SourceFrame:
    """A raw file that a table was made from.

    - `kind`: ``light``, ``white`` or ``dark``.
    - `illumination`: number of the light; None for white and dark frames.
    - `file`: path relative to the session's folder.
    - `sha256`: of the file.
    """

    kind: str
    illumination: int | None
    file: str
    sha256: str


def frames_sha256(frames: Sequence[SourceFrame]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    lines = [f"{frame.kind},{frame.illumination},{frame.sha256}\n" for frame in frames]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def frames_csv(frames: Sequence[SourceFrame]) -> str:
    """Return the text of `frames.csv`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for frame in frames:
        illumination = "" if frame.illumination is None else frame.illumination
        writer.writerow([frame.kind, illumination, frame.file, frame.sha256])
    return text.getvalue()


def load_frames(path: Path) -> tuple[SourceFrame, ...]:
    """Return the frames that a `frames.csv` lists, in the order taken; none where the file does not exist."""
    if not path.is_file():
        return ()
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        return tuple(
            SourceFrame(
                row["kind"], int(row["illumination"]) if row["illumination"] else None, row["file"], row["sha256"]
            )
            for row in rows
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is damaged: columns {','.join(COLUMNS)} expected; build the table again") from error
