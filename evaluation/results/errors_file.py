"""The errors of each image as a results folder keeps them in `errors.csv`, read back.

A line has the columns `image`, `method`, the estimate, the truth (`truth_r`, `truth_g`, `truth_b`), `recovery` and
`reproduction` in degrees, and `guessed`. Columns are found by their names, so others may stand between them. A file
without the truth's columns, or without `guessed`, is read too: its truths are not known, and no image is guessed.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind
from foundation.errors import FormatError, InputError

ERRORS_FILE = "errors.csv"
"""Its name in a results folder."""

_KINDS: tuple[ErrorKind, ...] = ("recovery", "reproduction")
_TRUTH = ("truth_r", "truth_g", "truth_b")
_ESTIMATE = ("r", "g", "b")
_GUESSED = {"": False, "0": False, "no": False, "false": False, "1": True, "yes": True, "true": True}


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """The errors of one method on the images of a data set.

    - `method`: the method's name.
    - `images`: the images' names, N of them, each once.
    - `truths`: (N, 3) float64, linear camera RGB of any length; None where the file does not hold them.
    - `errors`: kind of error to (N,) float64, degrees.
    - `guessed`: (N,) bool, True where no pixel was usable and the estimate is therefore grey.
    - `estimates`: (N, 3) float64, linear camera RGB of any length; None where the file does not hold them all.
    """

    method: str
    images: tuple[str, ...]
    truths: npt.NDArray[np.float64] | None
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    estimates: npt.NDArray[np.float64] | None = None


def read_errors(place: Path | str) -> dict[str, MethodErrors]:
    """Return the errors of every method of a results folder, by the methods' names and in the file's order."""
    path = Path(place)
    if path.is_dir():
        path = path / ERRORS_FILE
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror or error}; name a results folder of evaluate run, or the "
            f"{ERRORS_FILE} in it"
        ) from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no CSV text in UTF-8: {error}") from error
    rows = csv.DictReader(text.splitlines())
    columns = rows.fieldnames or []
    missing = [name for name in ("image", "method", *_KINDS) if name not in columns]
    if missing:
        raise FormatError(
            f"{path} has the columns {', '.join(columns) or 'of an empty file'}; expected {', '.join(missing)} too, as "
            "evaluate run writes them"
        )
    known = all(name in columns for name in _TRUTH)
    found: dict[str, dict[str, tuple[list[float], bool, list[float]]]] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        wanted = (*_KINDS, *(_TRUTH if known else ()))
        numbers = [_number(row[name], name, where) for name in wanted]
        if min(numbers) < 0 or (known and not any(numbers[2:])):
            raise FormatError(f"{where}: {row['image']} has {dict(zip(wanted, numbers, strict=True))}; none is below 0")
        guessed = (row.get("guessed") or "").strip().lower()
        if guessed not in _GUESSED:
            raise FormatError(f"{where}: guessed is {guessed!r}; expected 0 or 1")
        images = found.setdefault(row["method"] or "", {})
        if row["image"] in images:
            raise FormatError(f"{where}: {row['method']} on {row['image']} stands there a second time; remove one")
        images[row["image"]] = numbers, _GUESSED[guessed], [_estimate(row.get(name)) for name in _ESTIMATE]
    if not found:
        raise FormatError(f"{path} has no line of errors below its head; run the methods again")
    return {method: _errors_of(method, images, known) for method, images in found.items()}


def _errors_of(method: str, images: Mapping[str, tuple[list[float], bool, list[float]]], known: bool) -> MethodErrors:
    numbers = np.array([line for line, _, _ in images.values()])
    estimates = np.array([estimate for _, _, estimate in images.values()])
    return MethodErrors(
        method=method,
        images=tuple(images),
        truths=numbers[:, 2:] if known else None,
        errors={kind: numbers[:, place] for place, kind in enumerate(_KINDS)},
        guessed=np.array([guessed for _, guessed, _ in images.values()]),
        estimates=estimates if np.isfinite(estimates).all() else None,
    )


def _estimate(text: str | None) -> float:
    """Return a part of an estimate; NaN where there is none: nothing here is computed from it."""
    try:
        return float(text or "")
    except ValueError:
        return math.nan


def _number(text: str | None, name: str, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{where}: {name} is {text!r}, expected a finite number")
    return value
