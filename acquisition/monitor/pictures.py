"""Previews of frames: where they are, and their bytes if they are what they should be."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from experiment.session.records import preview_path

MOST_PICTURE_BYTES = 4 << 20
"""Bytes of a preview that is shown: many times what one of 640 pixels has."""

_JPEG = b"\xff\xd8\xff"


def preview_version(folder: Path, file: str) -> int | None:
    """Return a number that is another for another preview, or None if there is none."""
    try:
        return preview_path(folder, file).stat().st_mtime_ns // 1_000_000
    except OSError:
        return None


def read_picture(path: Path) -> bytes:
    """Return a preview's bytes; none if it is not there, is a link or no regular file, is no JPEG, or too large."""
    with suppress(OSError):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return b""
        data = path.read_bytes()
        return data if data.startswith(_JPEG) else b""
    return b""
