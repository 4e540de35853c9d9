"""Which bytes of source a compiled function was made from: its own file, and all of ours that this imports from."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).parents[2]
_IMPORT: Final = re.compile(r"^from ([a-z_][.\w]*) import (\([^)]*\)|.*)", re.MULTILINE)


@cache
def digest_of(file: Path) -> str:
    """Return the SHA-256, hexadecimal, of `file` and of the files of this software that it imports from, and so on."""
    digest = hashlib.sha256()
    for behind in sorted(_files_behind(file, set())):
        digest.update(_source(behind)[0])
    return digest.hexdigest()


def _files_behind(file: Path, found: set[Path]) -> set[Path]:
    """Return `file` and the files of this software that it imports from, and so on."""
    if file in found or not file.is_file():
        return found
    found.add(file)
    for behind in _source(file)[1]:
        _files_behind(behind, found)
    return found


@cache
def _source(file: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return a file's bytes, and those files of this software that it imports from: many functions share them."""
    data = file.read_bytes()
    behind: list[Path] = []
    for module, names in _IMPORT.findall(data.decode("utf-8")):
        folder = _ROOT.joinpath(*module.split("."))
        named = (folder / f"{name}.py" for name in re.findall(r"\w+", names))
        behind += [path for path in (folder.with_suffix(".py"), *named) if path.is_file()]
    return data, tuple(behind)
