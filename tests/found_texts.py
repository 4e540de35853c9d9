"""Where a text stands in what a program has written: in any file, name or archive, in the usual encodings."""

from __future__ import annotations

import base64
import gzip
import zlib
from pathlib import Path
from urllib.parse import quote


def files_with(folder: Path, *texts: str) -> list[str]:
    """Return the files below a folder, hidden ones included, whose name or content has a text, plain or encoded."""
    wanted = [form for text in texts for form in _forms(text)]
    found: list[str] = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        data = path.read_bytes() if path.is_file() else b""
        contents = data, _unpacked(data)
        if any(text in name for text in texts) or any(form in content for form in wanted for content in contents):
            found.append(name)
    return found


def _forms(text: str) -> tuple[bytes, ...]:
    return (
        text.encode("utf-8"),
        text.encode("utf-16-le"),
        base64.b64encode(text.encode()).rstrip(b"=")[:-1],
        quote(text, safe="").encode(),
    )


def _unpacked(data: bytes) -> bytes:
    """Return what a gzip or zlib file holds; nothing of others."""
    try:
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else zlib.decompress(data)
    except (OSError, EOFError, zlib.error):
        return b""
