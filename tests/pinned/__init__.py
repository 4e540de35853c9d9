"""Numbers of known runs as they were: a change of the code that should change nothing is seen to change nothing.

`pinned(name, found)`, a fixture, holds what a run gave against the file `NAME.json` of this folder. A file says nothing
of whether its numbers are right, which other tests hold against the simulator's truth, standards and published figures:
it says which numbers a change moved, however many there are. Who means to change them renews the files by
`python -m pytest --renew-pinned TESTS`, and reads their difference before committing it.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

FOLDER = Path(__file__).parent

SAME = 1e-6
"""Part of a number by which another processor or library may move it: sums in another order, fits that end earlier."""

NOTHING = 1e-9
"""What is as good as 0, in the unit of the number."""

WHOLE = 64
"""Values up to which an array is written out."""

SHORT = 400
"""Characters up to which a value is written on one line."""

SHOWN = 20
"""Differences that are told."""


class Pinned:
    """What a run gave, held against what is kept of it."""

    def __init__(self, renew: bool) -> None:
        self._renew = renew

    def __call__(self, name: str, found: Any, same: float = SAME, nothing: float = NOTHING) -> None:
        """Fail where `found` is not what the file of this name holds.

        `found`: numbers, words, bytes, arrays, records and whatever holds these. `same`, `nothing`: relative
        and absolute difference of two numbers that are the same.
        """
        path = FOLDER / f"{name}.json"
        now = plain(found)
        if self._renew:
            known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
            path.write_text(written(renewed(known, now, same, nothing)) + "\n", encoding="utf-8")
        kept = json.loads(path.read_text(encoding="utf-8"))
        moved = list(differences(kept, now, same, nothing))
        more = f"\nand {len(moved) - SHOWN} more" if len(moved) > SHOWN else ""
        assert not moved, f"{path.name}, was and is:\n" + "\n".join(moved[:SHOWN]) + more


def written(value: Any, indent: str = "") -> str:
    """Return a plain value as JSON: on one line where it is short, or a list or record of numbers and words alone."""
    inner: list[Any] = list(value.values()) if isinstance(value, dict) else value
    line = json.dumps(value, ensure_ascii=False)
    if (
        len(line) <= SHORT
        or not isinstance(value, (dict, list))
        or not any(isinstance(one, (dict, list)) for one in inner)
    ):
        return line
    names = (
        [f"{json.dumps(name, ensure_ascii=False)}: " for name in value]
        if isinstance(value, dict)
        else [""] * len(inner)
    )
    parts = [f"{indent} {name}{written(one, f'{indent} ')}" for name, one in zip(names, inner, strict=True)]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return "\n".join([first, ",\n".join(parts), f"{indent}{last}"])


def differences(kept: Any, now: Any, same: float, nothing: float, place: str = "") -> Iterator[str]:
    """Yield the places at which two plain values differ, with both values."""
    match kept, now:
        case (dict(), dict()) if list(kept) == list(now):
            for key in kept:
                yield from differences(kept[key], now[key], same, nothing, f"{place}.{key}")
        case (list(), list()) if len(kept) == len(now):
            for at, (one, other) in enumerate(zip(kept, now, strict=True)):
                yield from differences(one, other, same, nothing, f"{place}[{at}]")
        case (float(), float() | int()) | (int(), float()):
            if not math.isclose(kept, now, rel_tol=same, abs_tol=nothing):
                yield f"{place}: {kept} {now}"
        case _ if kept != now or isinstance(kept, bool) is not isinstance(now, bool):
            yield f"{place}: {kept!r:.200} {now!r:.200}"
        case _:
            pass


def renewed(kept: Any, now: Any, same: float, nothing: float) -> Any:
    """Return a plain value with the numbers as they are kept that did not move, so that a difference shows what did."""
    match kept, now:
        case dict(), dict():
            return {key: renewed(kept.get(key), one, same, nothing) for key, one in now.items()}
        case (list(), list()) if len(kept) == len(now):
            return [renewed(one, other, same, nothing) for one, other in zip(kept, now, strict=True)]
        case _:
            return now if any(differences(kept, now, same, nothing)) else kept


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: numbers to ten digits, long arrays by what any change of them would change."""
    match value:
        case bool() | int() | str() | None:
            return value
        case float():
            return float(f"{value:.10g}") if math.isfinite(value) else str(value)
        case bytes() | bytearray() | memoryview():
            return {"bytes": len(value), "sha256": hashlib.sha256(value).hexdigest()}
        case np.generic():
            return plain(value.item())
        case np.ndarray():
            return plain(value.tolist() if value.size <= WHOLE else _summary(value))
        case Enum():
            return value.name
        case datetime():
            return value.isoformat()
        case Path():
            return value.name
        case BaseModel():
            return {name: plain(getattr(value, name)) for name in type(value).model_fields}
        case Mapping():
            return {str(key): plain(one) for key, one in value.items()}
        case Set():
            return [plain(one) for one in sorted(value)]
        case _ if is_dataclass(value):
            return {one.name: plain(getattr(value, one.name)) for one in fields(value)}
        case _:
            return [plain(one) for one in value]


def _summary(array: np.ndarray) -> dict[str, Any]:
    """Return shape, kind, how many values are finite, and of these least, largest and four sums by chance weights."""
    numbers = np.asarray(array).astype(np.float64, casting="unsafe").ravel()
    finite = np.isfinite(numbers)
    known = numbers[finite]
    weights = np.random.default_rng(array.size).normal(size=(4, known.size)) / max(known.size, 1) ** 0.5
    return {
        "shape": array.shape,
        "dtype": array.dtype.name,
        "finite": int(finite.sum()),
        "least": known.min(initial=np.inf),
        "largest": known.max(initial=-np.inf),
        "root mean square": float(np.sqrt((known**2).mean())) if known.size else 0.0,
        "sums": weights @ known,
    }
