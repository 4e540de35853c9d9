"""Machine code on the disk: one file for each function and kinds of its arguments, and what it was made from.

A file is a line of JSON and an object file. It is used for the very sources, processor and libraries that it was made
with only, and where its bytes are those that were written.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

from foundation.errors import CropError
from foundation.files import cache_folder, whole_file
from foundation.machine_code.loading import processor

_VERSION: Final = 3
"""Of the files, and of how functions in them are called; rises with every change of either."""


@dataclass(frozen=True)
class Origin:
    """What a function was made from.

    - `module`, `name`: where it stands, and what it is called there.
    - `digest`: of all sources behind it; see `sources.digest_of`.
    - `kinds`: of its arguments; see `arguments.kind_of`.
    """

    module: str
    name: str
    file: Path
    digest: str
    kinds: tuple[str, ...]

    def key(self) -> dict[str, Any]:
        """Return all that the code depends on, as JSON has it."""
        numba = {name: value for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_")}
        numba.pop("NUMBA_CACHE_DIR", None)
        at_hand = {**asdict(processor()), "numba": _numba_version(), "settings": numba}
        named = {"version": _VERSION, "function": f"{self.module}.{self.name}", "digest": self.digest}
        return {**named, "kinds": list(self.kinds), "for": at_hand}


@dataclass(frozen=True)
class Code:
    """A function's machine code.

    - `bytes`: an object file; None where the function needs numba to be called.
    - `symbol`: its name in that file.
    - `returned`: what it returns; see `arguments.caller`.
    """

    bytes: bytes | None
    symbol: str = ""
    returned: str | Sequence[str] | None = None


@cache
def _numba_version() -> str:
    return importlib.metadata.version("numba")


def load_code(origin: Origin) -> Code | None:
    """Return the code that is kept, or None if there is none."""
    key = origin.key()
    for path in _places(origin):
        try:
            data = path.read_bytes()
        except OSError:
            continue
        head, _, code = data.partition(b"\n")
        try:
            known = json.loads(head)
        except ValueError:
            continue
        if not isinstance(known, dict):
            continue
        described = cast("dict[str, Any]", known)
        if described.get("key") == key and described.get("sha256") == hashlib.sha256(code).hexdigest():
            return Code(code or None, described["symbol"], described["returned"])
    return None


def keep_code(origin: Origin, code: Code) -> None:
    """Keep code where a folder can be written; where none can, each start makes it anew."""
    data = code.bytes or b""
    head = {"key": origin.key(), "symbol": code.symbol, "returned": code.returned}
    head["sha256"] = hashlib.sha256(data).hexdigest()
    for path in _places(origin):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as file:
                file.write(json.dumps(head).encode() + b"\n" + data)
        except (CropError, OSError):
            continue
        return


def _places(origin: Origin) -> Iterator[Path]:
    """Yield where the code may lie, best first: beside the source as compiled Python, else in the user's folder."""
    told = hashlib.sha256("|".join((origin.module, *origin.kinds, processor().name)).encode()).hexdigest()[:12]
    name = f"{origin.file.stem}.{origin.name}-{told}.code"
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given) / name
        return
    yield origin.file.parent / "__pycache__" / name
    folder = cache_folder()
    if folder is not None:
        yield folder / "code" / name
