"""Lights given to pictures by their names, in a file.

A data set that says what light fell on each of its scenes can be made again with the scenes' own lights, in whatever
order its pictures are found. By place in the list of sources, `generator.lights.choices.SequentialLights` does it.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError, first_of
from foundation.files import read_text
from generator.lights.distributions import TRIPLES, is_ground_truth
from generator.lights.gamut import Gamut, Match, OutsideGamut, OutsideGamutError
from generator.lights.lighting import Lighting

_NAMES: Final = ("source", "name", "picture", "image", "file", "filename")
"""Columns that name a picture, the first that is there; `ground_truth.csv` of a dataset has source and image."""

Truths = Mapping[str, npt.NDArray[np.float64]]
"""Ground truths (K, 3) float64 ≥ 0 of each picture by its name, linear camera RGB, not normalised."""


@dataclass(frozen=True)
class NamedLights:
    """Each picture under the lights that a file has for its name.

    - `matches`: for each picture, by its place in the list of sources, the mixtures that have its ground truths, as
      many for each, and their angles to them.
    - `file`: name of the file that they come from.
    - `crops`: crops of each picture: all of them are under the picture's lights.
    """

    matches: tuple[tuple[Match, ...], ...]
    file: str
    crops: int = 1

    @property
    def lights_each(self) -> int:
        """Images for each scene."""
        return len(self.matches[0])

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of scene `position`, crop by crop of picture by picture."""
        return tuple(Lighting((match.mixture,)) for match in self.matches[position // self.crops])

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {
            "choice": "by name",
            "file": self.file,
            "each": self.lights_each,
            "lights": [[match.mixture.label for match in its] for its in self.matches],
        }


def load_named_truths(path: Path) -> dict[str, npt.NDArray[np.float64]]:
    """Return the ground truths of a CSV file by the pictures' names.

    The head names a column `source`, `name`, `picture`, `image`, `file` or `filename`, and `r,g,b` or another triple of
    `ground_truths.load_ground_truths`; other columns are ignored. Several rows of one name are several lights.

    Returns for each name (K, 3) float64 ≥ 0, linear camera RGB, not normalised, K ≥ 1.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, "name a CSV file", "lights")))
    head = {field.strip().lower(): field for field in reader.fieldnames or ()}
    name = next((column for column in _NAMES if column in head), None)
    triple = next((names for names in TRIPLES if all(part in head for part in names)), None)
    if name is None or triple is None:
        raise FormatError(
            f"{path}, line 1: expected a column source or name, and r,g,b or GT_R,GT_G,GT_B; found "
            f"{','.join(reader.fieldnames or ()) or 'nothing'}"
        )
    found: dict[str, list[list[float]]] = {}
    try:
        for row in reader:
            named = (row[head[name]] or "").strip()
            try:
                truth = [float(row[head[part]]) for part in triple]
            except (TypeError, ValueError):
                truth = []
            if not named or not is_ground_truth(truth):
                shown = ",".join(str(field) for field in row.values())
                raise FormatError(
                    f"{path}, line {reader.line_num}: {shown!r} is no light of a picture: expected its name and three "
                    "numbers from 0, sum above 0"
                )
            found.setdefault(named, []).append(truth)
    except csv.Error as error:
        raise FormatError(f"{path}, line {reader.line_num} is no CSV: {error}; write it anew") from error
    if not found:
        raise FormatError(f"{path} holds no light below its head line")
    return {named: np.array(truths) for named, truths in found.items()}


def named_lights(
    gamut: Gamut,
    truths: Truths,
    names: Sequence[str],
    file: str = "",
    outside: OutsideGamut = "refuse",
    crops: int = 1,
) -> NamedLights:
    """Return for each picture the mixtures of the table's lights that have its ground truths; see `gamut.Gamut.match`.

    A picture's row is that of its name, path below its folder included, else the only one of its name without folders
    and suffix, so that `scene7.png` finds the light of `raw/scene7.cr2`; not where two pictures would share it.

    `truths`: by name (K, 3) float64 ≥ 0, linear RGB of the table's camera.
    """
    stems: dict[str, list[str]] = {}
    for named in truths:
        stems.setdefault(PurePosixPath(named).stem, []).append(named)
    pictures = Counter(PurePosixPath(name).stem for name in names)
    rows: list[str] = []
    missing: list[str] = []
    for name in names:
        alike = stems.get(PurePosixPath(name).stem, [])
        if name in truths:
            rows.append(name)
        elif len(alike) == 1 and pictures[PurePosixPath(name).stem] == 1:
            rows.append(alike[0])
        else:
            missing.append(name)
    of = f" in {file}" if file else ""
    if missing:
        raise InputError(
            f"{len(missing)} of {len(names)} pictures have no light of their own{of}: {first_of(missing)}; add rows "
            "with their names, or leave the pictures out"
        )
    counts = {len(truths[row]): row for row in reversed(rows)}
    if len(counts) > 1:
        (one, some), (other, more) = sorted(counts.items())[:2]
        raise InputError(f"{some} has {one} and {more} {other} lights{of}; give every picture as many")
    made: dict[str, tuple[Match, ...]] = {}
    outside_gamut: list[tuple[str, OutsideGamutError]] = []
    for row in dict.fromkeys(rows):
        try:
            made[row] = tuple(gamut.match(truth, outside) for truth in truths[row])
        except OutsideGamutError as error:
            outside_gamut.append((row, error))
    if outside_gamut:
        row, worst = max(outside_gamut, key=lambda item: item[1].angle)
        raise InputError(
            f"the lights of {len(outside_gamut)} of {len(set(rows))} pictures{of} cannot be made; the farthest is that "
            f"of {row}: {worst}"
        ) from worst
    return NamedLights(tuple(made[row] for row in rows), file, crops)
