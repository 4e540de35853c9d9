"""Search for a text in all files, names and archives of a folder, in the usual encodings."""

from __future__ import annotations

import base64
import gzip
import zlib
from pathlib import Path
from urllib.parse import quote


def files_with(folder: Path, *texts: str) -> list[str]:
    """Return the files below a folder, also hidden ones, that contain a text in name or content, plain or encoded."""
    encoded_texts = [form for text in texts for form in _forms(text)]
    names: list[str] = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        data = path.read_bytes() if path.is_file() else b""
        contents = data, _unpacked(data)
        if any(text in name for text in texts) or any(
            form in content for form in encoded_texts for content in contents
        ):
            names.append(name)
    return names


def _forms(text: str) -> tuple[bytes, ...]:
    return (
        text.encode("utf-8"),
        text.encode("utf-16-le"),
        base64.b64encode(text.encode()).rstrip(b"=")[:-1],
        quote(text, safe="").encode(),
    )


def _unpacked(data: bytes) -> bytes:
    """Return the content of a gzip or zlib file; empty for others."""
    try:
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else zlib.decompress(data)
    except (OSError, EOFError, zlib.error):
        return b""
