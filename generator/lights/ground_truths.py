"""Ground truths of other data sets, read from their files of text."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from generator.named_numbers import is_number
from generator.statistics import read_lights

TRIPLES: Final = (
    ("gt_r", "gt_g", "gt_b"),
    ("r", "g", "b"),
    ("red", "green", "blue"),
    ("white_r", "white_g", "white_b"),
)
"""Columns of a ground truth, as data sets and tables name them."""


def load_ground_truths(path: Path) -> npt.NDArray[np.float64]:
    """Return the ground truths of a file.

    Either a CSV file whose head names the columns `GT_R,GT_G,GT_B` or `r,g,b` (others are ignored), or lines of three
    numbers between blanks or commas, as in `gt.txt` and Cube+; or the lights of a `STATS.json` of `evaluate describe`.

    Returns (N, 3) float64 ≥ 0, linear camera RGB, not normalised.
    """
    if is_statistics(path):
        return read_lights(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot read ground truths {path}: {error}; name a text file") from error
    numbered = [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]
    if not numbered:
        raise FormatError(f"{path} is empty; expected three numbers a line")
    columns: Sequence[int] = (0, 1, 2)
    head = [field.strip().lower() for field in next(csv.reader([numbered[0][1]]))]
    named = not any(is_number(token) for token in re.split(r"[\s,;]+", numbered[0][1]))
    if named:
        triple = next((names for names in TRIPLES if all(name in head for name in names)), None)
        if triple is None:
            raise FormatError(f"{path}, line 1: no columns GT_R,GT_G,GT_B or r,g,b; found {','.join(head)}")
        columns = [head.index(name) for name in triple]
    truths: list[list[float]] = []
    for number, line in numbered[named:]:
        fields = next(csv.reader([line])) if named else re.split(r"[\s,;]+", line.strip(",; "))
        try:
            if not named and len(fields) != 3:
                raise ValueError(f"expected 3 numbers, found {len(fields)}")
            truth = [float(fields[column]) for column in columns]
        except (ValueError, IndexError) as error:
            raise FormatError(f"{path}, line {number}: {line!r} is no ground truth: {error}") from error
        if not is_ground_truth(truth):
            raise FormatError(
                f"{path}, line {number}: {line!r} is no ground truth: expected numbers from 0, sum above 0"
            )
        truths.append(truth)
    if not truths:
        raise FormatError(f"{path} holds no ground truth below its head line")
    return np.array(truths)


def is_ground_truth(numbers: Sequence[float]) -> bool:
    """Return whether numbers are a light's linear RGB: three that are finite and from 0, with a sum above 0.

    Examples
    --------
    >>> is_ground_truth([0.3, 0.4, 0.3]), is_ground_truth([0.0, 0.0, 0.0])
    (True, False)
    """
    return len(numbers) == 3 and bool(np.isfinite(numbers).all()) and min(numbers) >= 0 and sum(numbers) > 0


def is_statistics(path: Path) -> bool:
    """Return whether a file is a `STATS.json` by its name."""
    return path.suffix.lower() == ".json"
