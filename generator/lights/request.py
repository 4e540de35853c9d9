"""The options of light, as they are written on a command line, and the choice of lights that they ask for.

A file may give lights to pictures by their names: a data set that says what light fell on each of its scenes can be
made again with the scenes' own lights, in whatever order its pictures are found. By place in the list of sources,
`SequentialLights` does it.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError, first_of
from foundation.files import read_text
from generator.lights.choices import (
    DrawnLights,
    SimultaneousLights,
    matched_lights,
    nearest_lights,
    parse_light,
    parse_lights,
)
from generator.lights.distributions import TRIPLES, is_ground_truth, load_ground_truths, parse_distribution
from generator.lights.gamut import Gamut, Match, OutsideGamut, OutsideGamutError
from generator.lights.lighting import LightChoice, Lighting, ListedLights, RandomLights
from generator.masks.making import parse_masks

if TYPE_CHECKING:
    from calibration.table.lut import Lut


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


MASKS: Final = "smooth"
"""The masks of several lights where none are named."""


@dataclass(frozen=True)
class LightRequest:
    """The options of light, each None or empty where it was not given; named as on the command line.

    - `illuminations`: lights of the table for every picture: ``0,5,12-20`` or ``all``.
    - `light`: lights for every picture, each as `choices.parse_light` reads it.
    - `random`: images of each picture under lights of its own: of the table, or of `distribution`. One if None.
    - `distribution`: where those lights are drawn from; see `lights.distributions.parse_distribution`.
    - `nearest`, `match`: files of ground truths, for which the table's nearest lights are taken, or mixtures that match
      them.
    - `lights_by_name`: file of ground truths of each picture by its name, which mixtures match.
    - `outside`: what to do about chromaticities that the table cannot make.
    - `lights_per_image`: lights that fall on one image: that many, in the order of the lists, share each image.
    - `masks`: where each falls; see `masks.request.parse_masks`.
    """

    illuminations: str | None = None
    light: tuple[str, ...] = ()
    random: int | None = None
    distribution: str | None = None
    nearest: Path | None = None
    match: Path | None = None
    lights_by_name: Path | None = None
    outside: OutsideGamut = "refuse"
    lights_per_image: int | None = None
    masks: str | None = None

    def choose(self, lut: Lut, seed: int, names: Sequence[str] = (), crops: int = 1) -> LightChoice:
        """Return the choice of lights."""
        together = self.lights_per_image or (1 if self.masks is None else 2)
        if self.lights_per_image is not None and self.lights_per_image < 1:
            raise InputError(f"{self.lights_per_image} lights an image were asked for, expected 1 or more")
        if self.masks is not None and together == 1:
            raise InputError(
                f"--masks {self.masks} says where several lights fall, but each image has one; ask for more with "
                "--lights-per-image"
            )
        choice = self._lights(lut, seed, together, names, crops)
        if together == 1:
            return choice
        return SimultaneousLights(choice, together, parse_masks(self.masks or MASKS, together, seed))

    def _lights(self, lut: Lut, seed: int, together: int, names: Sequence[str], crops: int) -> LightChoice:
        """Return the choice of lights with as many for each picture as its images have together."""
        choices = {
            "--illuminations": self.illuminations is not None,
            "--light": bool(self.light),
            "--nearest": self.nearest is not None,
            "--match": self.match is not None,
            "--lights-by-name": self.lights_by_name is not None,
            "--distribution": self.distribution is not None,
            "--random": self.random is not None and self.distribution is None,
        }
        given = [name for name, is_given in choices.items() if is_given]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} were both given; give one of them (only --random may go with --distribution)"
            )
        count = together * (1 if self.random is None else self.random)
        if self.illuminations is not None:
            return parse_lights(self.illuminations, len(lut.white))
        if self.light:
            gamut = Gamut.of(lut)
            return ListedLights(tuple(parse_light(text, lut, gamut, self.outside) for text in self.light))
        if self.nearest is not None:
            return nearest_lights(lut, load_ground_truths(self.nearest), self.nearest.name, together)
        if self.match is not None:
            truths = load_ground_truths(self.match)
            return matched_lights(Gamut.of(lut), truths, self.match.name, together, self.outside)
        if self.lights_by_name is not None:
            truths_by_name, file = load_named_truths(self.lights_by_name), self.lights_by_name.name
            return named_lights(Gamut.of(lut), truths_by_name, names, file, self.outside, crops)
        if self.distribution is not None:
            return DrawnLights(Gamut.of(lut), parse_distribution(self.distribution), count, seed)
        return RandomLights(count, len(lut.white), seed)
