"""Numbers of known runs, held against the numbers that are kept of them.

`pinned(name, found)`, a fixture, compares the numbers in `found` with those in `tests/pinned/PATH.json`, where PATH is
the path of the test module. The file holds one flat mapping of names to numbers for each pin. Words, dates and paths
are not kept. A missing or changed number is a failure, a new one is not. A pin is no evidence that a number is right.

`python -m pytest --renew-pinned TESTS` writes what moved. To drop pins of removed tests, delete the file first.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

FOLDER = Path(__file__).parent
TESTS = FOLDER.parent

SAME = 1e-6  # relative difference that another processor or library may cause
NOTHING = 1e-9  # absolute difference, in the unit of the number
LISTED = 6  # longer arrays are kept by shape, minimum, maximum and a weighted sum
SHOWN = 20  # differences in one message

Array = npt.NDArray[np.float64]
Kept = int | float | str | list[int | float]


class Pinned:
    """Compares the numbers of one test module with its file."""

    def __init__(self, module: Path, renew: bool) -> None:
        """Take the path of the test module below `tests/`."""
        self._path = (FOLDER / module).with_suffix(".json")
        self._renew = renew

    def __call__(self, name: str, found: Any, same: float = SAME, nothing: float = NOTHING) -> None:
        """Fail if a number of the pin `name` is missing in `found` or has changed.

        `same`, `nothing`: relative and absolute difference of two numbers that count as equal.
        """
        __tracebackhide__ = True
        now = numbers(found, same)
        assert now, f"{name}: there is no number to pin"
        if self._renew:
            self._write(name, now, same, nothing)
        pins = json.loads(self._path.read_text(encoding="utf-8")) if self._path.exists() else {}
        assert name in pins, f"{self._path.name} has no pin {name!r}: run pytest --renew-pinned on this test"
        moved = list(differences(pins[name], now, same, nothing))
        more = f"\nand {len(moved) - SHOWN} more" if len(moved) > SHOWN else ""
        assert not moved, f"{name}, was and is:\n" + "\n".join(moved[:SHOWN]) + more

    def _write(self, name: str, now: dict[str, Kept], same: float, nothing: float) -> None:
        import fcntl  # which Windows does not have

        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a+", encoding="utf-8") as file:
            # Tests of one module may run in several processes.
            fcntl.flock(file, fcntl.LOCK_EX)
            file.seek(0)
            pins: dict[str, dict[str, Kept]] = json.loads(file.read() or "{}")
            before = pins.get(name, {})
            pins[name] = {
                key: before[key] if key in before and _is_same(before[key], value, same, nothing) else value
                for key, value in now.items()
            }
            file.truncate(0)
            file.write(written(pins))


def written(pins: Mapping[str, Mapping[str, Kept]]) -> str:
    """Return pins as JSON, one number a line."""
    parts = [
        f"{json.dumps(name, ensure_ascii=False)}: {{\n"
        + ",\n".join(f" {json.dumps(key, ensure_ascii=False)}: {json.dumps(value)}" for key, value in kept.items())
        + "\n}"
        for name, kept in sorted(pins.items())
    ]
    return "{\n" + ",\n".join(parts) + "\n}\n"


def differences(kept: Mapping[str, Kept], now: Mapping[str, Kept], same: float, nothing: float) -> Iterator[str]:
    """Yield name, kept value and present value of each number that is missing or has changed."""
    for name, was in kept.items():
        if name not in now:
            yield f"{name}: {was} missing"
        elif not _is_same(was, now[name], same, nothing):
            yield f"{name}: {was} {now[name]}"


def _is_same(was: Kept, now: Kept, same: float, nothing: float) -> bool:
    if isinstance(was, list):
        return (
            isinstance(now, list)
            and len(was) == len(now)
            and all(_is_same(one, other, same, nothing) for one, other in zip(was, now, strict=True))
        )
    if isinstance(was, float) and isinstance(now, int | float) and math.isfinite(was):
        return math.isclose(was, now, rel_tol=same, abs_tol=nothing)
    return was == now or (was != was and now != now)  # NaN


def numbers(value: Any, same: float = SAME) -> dict[str, Kept]:
    """Return the numbers in a value by their dotted names, two digits beyond `same`."""
    digits = math.ceil(-math.log10(same)) + 2
    return {name or "value": _kept(leaf, digits) for name, leaf in _leaves(value, by_place=True)}


def _kept(leaf: Any, digits: int) -> Kept:
    """Return a number, few numbers, or shape, minimum, maximum and weighted sum of many."""
    match leaf:
        case str():
            return leaf
        case int() | float():
            return _rounded(leaf, digits)
        case list() if len(leaf) <= LISTED:
            return [_rounded(one, digits) for one in leaf]
        case _:
            array = np.asarray(leaf)
            values = array.astype(np.float64, casting="unsafe").ravel()
            if array.size <= LISTED:
                return [_rounded(one, digits) for one in values.tolist()]
            finite = values[np.isfinite(values)]
            weights = np.random.default_rng(values.size).normal(size=finite.size) / max(finite.size, 1) ** 0.5
            summary = [finite.min(initial=np.inf), finite.max(initial=-np.inf), weights @ finite]
            return [*array.shape, *(_rounded(float(one), digits) for one in summary)]


def _rounded(number: float, digits: int) -> int | float:
    return number if isinstance(number, int) else float(f"{number:.{digits}g}")


def _leaves(value: Any, name: str = "", by_place: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield numbers, arrays, lists of numbers and hashes of bytes by their dotted names."""
    match value:
        case None | str() | Enum() | Path():
            return
        case bool() | int() | float():
            yield name, int(value) if isinstance(value, bool) else value
        case np.generic():
            yield from _leaves(value.item(), name)
        case bytes() | bytearray() | memoryview():
            yield _joined(name, "bytes"), len(value)
            yield _joined(name, "sha256"), hashlib.sha256(value).hexdigest()[:12]
        case np.ndarray() if value.dtype.kind in "biufc":
            yield name, value
        case Mapping():
            for key, one in value.items():
                yield from _leaves(one, _joined(name, key))
        case BaseModel():
            yield from _leaves({key: getattr(value, key) for key in type(value).model_fields}, name)
        case _ if is_dataclass(value):
            yield from _leaves({one.name: getattr(value, one.name) for one in fields(value)}, name)
        case _ if hasattr(value, "__iter__"):
            items = sorted(value) if isinstance(value, Set) else list(value)
            yield from _leaves_of_list(items, name, by_place)
        case _:
            return


def _leaves_of_list(items: list[Any], name: str, by_place: bool) -> Iterator[tuple[str, Any]]:
    simple = [one for one in items if not isinstance(one, str | Enum | Path)]
    if all(one is None or isinstance(one, bool | int | float | np.number | np.bool_) for one in simple):
        if any(one is not None for one in simple):
            yield name, [math.nan if one is None else one + 0 for one in simple]
        return
    keys = _keys(items)
    if keys is not None:
        yield from _leaves(dict(zip(keys, items, strict=True)), name)
    elif by_place or len(simple) < 2 or any(isinstance(one, np.ndarray | bytes) for one in simple):
        yield from _leaves(dict(enumerate(items)), name)
    else:
        # Records without a name: one column for each of their fields.
        columns: dict[str, list[Any]] = {}
        for one in simple:
            for key, leaf in _leaves(one):
                columns.setdefault(key, []).append(leaf)
        for key, column in columns.items():
            if isinstance(column[0], str):
                yield _joined(name, key), hashlib.sha256("".join(map(str, column)).encode()).hexdigest()[:12]
            else:
                yield _joined(name, key), [one for leaf in column for one in np.ravel(leaf).tolist()]


def _keys(items: Sequence[Any]) -> list[str | int] | None:
    """Return the names of records that have different names."""
    keys: list[Any] = []
    for one in items:
        record = one if isinstance(one, Mapping) else getattr(one, "__dict__", {}) if is_dataclass(one) else {}
        keys.append(next((record[key] for key in ("name", "key", "index") if key in record), None))
    usable = all(isinstance(key, str | int) for key in keys) and len(set(keys)) == len(keys)
    return keys if len(keys) > 1 and usable else None


def _joined(name: str, key: object) -> str:
    key = key.name if isinstance(key, Enum) else key
    return ".".join(str(one) for one in (name, key) if one != "")
