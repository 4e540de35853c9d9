"""Ground truths of a data set, for lights like its own: from a file of text, or from the data set itself."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.datasets import open_scenes
from foundation.errors import FormatError, InputError
from generator.lights.distributions import load_ground_truths

_TEXTS = (".csv", ".txt")
"""Endings of files of text."""


@dataclass(frozen=True, eq=False)
class Truths:
    """Ground truths with a name for tables and legends.

    - `name`: where they come from.
    - `lights`: (N, 3) float64 ≥ 0, linear camera RGB of any length.
    - `images`: the names of their N images; empty where they have none.
    """

    name: str
    lights: npt.NDArray[np.float64]
    images: tuple[str, ...] = ()


def read_truths(place: str) -> Truths:
    """Return the ground truths at a place."""
    file, _, start = place.partition("#")
    if not file.lower().endswith(_TEXTS):
        data = open_scenes(place)
        return Truths(
            data.name, np.stack([scene.truth for scene in data.scenes]), tuple(scene.name for scene in data.scenes)
        )
    lights = load_ground_truths(Path(file))
    names = _first_column(Path(file))
    if not start:
        return Truths(Path(file).stem, lights, tuple(names) if len(names) == len(lights) else ())
    if len(names) != len(lights):
        raise FormatError(f"{file} has {len(lights)} ground truths and {len(names)} names; {start!r} cannot choose")
    chosen = np.array([name.startswith(start) for name in names])
    if not chosen.any():
        raise InputError(f"no row of {file} begins with {start!r}; the first begins with {names[0]!r}")
    return Truths(start.strip("/_"), lights[chosen], tuple(name for name in names if name.startswith(start)))


def _first_column(path: Path) -> list[str]:
    """Return the first field of every row below the head."""
    rows = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
    return [row[0] for row in rows if row and any(field.strip() for field in row)][1:]
