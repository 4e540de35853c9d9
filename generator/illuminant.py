"""Which lights fall on which source picture.

Three ways: every picture under the same listed lights, each under some drawn at random, or each under the one nearest
to a ground truth of another dataset (paper, section 4.3). A choice depends on the picture's position in the list of
sources and on nothing else.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from drivers.errors import FormatError, InputError
from generator import philox

if TYPE_CHECKING:
    from calibration.lut import Lut


@runtime_checkable
class LightChoice(Protocol):
    """Which of the table's lights fall on each source picture."""

    @property
    def lights_each(self) -> int:
        """Lights, hence images, for each picture."""
        ...

    def lights_of(self, position: int) -> tuple[int, ...]:
        """Return the numbers of the lights for the picture at `position` (from 0) in the list of sources."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`."""
        ...


@dataclass(frozen=True)
class ListedLights:
    """The same lights for every picture."""

    lights: tuple[int, ...]

    @property
    def lights_each(self) -> int:
        """Lights for each picture."""
        return len(self.lights)

    def lights_of(self, position: int) -> tuple[int, ...]:
        """Return the lights; `position` does not matter."""
        del position
        return self.lights

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "listed", "lights": list(self.lights)}


@dataclass(frozen=True)
class RandomLights:
    """`count` distinct lights of `total` for each picture, every set equally likely; purpose 1 of `philox`."""

    count: int
    total: int
    seed: int

    def __post_init__(self) -> None:
        if not 1 <= self.count <= self.total:
            raise InputError(
                f"{self.count} random lights a picture were asked for; the table has {self.total}, expected 1 to that"
            )

    @property
    def lights_each(self) -> int:
        """Lights for each picture."""
        return self.count

    def lights_of(self, position: int) -> tuple[int, ...]:
        """Return the lights of the picture at `position`."""
        return philox.distinct(self.seed, self.count, self.total, position, philox.LIGHTS)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "random", "count": self.count}


@dataclass(frozen=True)
class NearestLights:
    """For the picture at position i the light nearest to ground truth i, starting over when the list ends.

    `lights` holds the nearest light of each ground truth, `angles` how far it is, in degrees.
    """

    lights: tuple[int, ...]
    angles: tuple[float, ...]
    file: str

    @property
    def lights_each(self) -> int:
        """Lights for each picture."""
        return 1

    def lights_of(self, position: int) -> tuple[int, ...]:
        """Return the light of the picture at `position`."""
        return (self.lights[position % len(self.lights)],)

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "nearest", "file": self.file, "lights": list(self.lights)}


def parse_lights(text: str, total: int) -> ListedLights:
    """Return the lights of a list such as `0,5,12-20`, or `all`; each once, in the order written.

    Raises
    ------
    InputError
        An entry is no number or range, or the table has no such light.
    """
    if text.strip().lower() == "all":
        return ListedLights(tuple(range(total)))
    lights: dict[int, None] = {}
    for entry in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", entry, re.ASCII)
        if not match:
            raise InputError(f"{entry.strip()!r} is no light; write numbers and ranges as in 0,5,12-20, or all")
        first = int(match[1])
        last = int(match[2]) if match[2] else first
        if max(first, last) >= total:
            raise InputError(f"there is no light {max(first, last)}; the table has lights 0 to {total - 1}")
        if last < first:
            raise InputError(f"{entry.strip()!r} runs backwards; write {last}-{first}")
        lights.update(dict.fromkeys(range(first, last + 1)))
    return ListedLights(tuple(lights))


def nearest_lights(lut: Lut, truths: npt.NDArray[np.float64], file: str = "") -> NearestLights:
    """Return for each ground truth the table's light at the smallest angle; of several the lowest number.

    Parameters
    ----------
    lut
        The table.
    truths
        (N, 3) float64 ≥ 0, linear RGB of the table's camera, of any length.
    file
        What to call their origin.
    """
    table = lut.ground_truth / np.linalg.norm(lut.ground_truth, axis=1, keepdims=True)
    wanted = truths / np.linalg.norm(truths, axis=1, keepdims=True)
    cosine = np.clip(wanted @ table.T, -1.0, 1.0)
    lights = cosine.argmax(axis=1)
    angles = np.degrees(np.arccos(cosine[np.arange(len(lights)), lights]))
    return NearestLights(tuple(int(light) for light in lights), tuple(float(angle) for angle in angles), file)


_TRIPLES = (("gt_r", "gt_g", "gt_b"), ("r", "g", "b"), ("red", "green", "blue"), ("white_r", "white_g", "white_b"))


def load_ground_truths(path: Path) -> npt.NDArray[np.float64]:
    """Return the ground truths of a file.

    Either a CSV file whose head names the columns `GT_R,GT_G,GT_B` or `r,g,b` (others are ignored), or lines of three
    numbers between blanks or commas, as in `gt.txt` and Cube+.

    Returns
    -------
    ndarray
        (N, 3) float64 ≥ 0, linear camera RGB, not normalised.

    Raises
    ------
    FormatError
        The file cannot be read, is empty, or a line is not three numbers ≥ 0 with a sum above 0.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"cannot read ground truths {path}: {error}; name a text file") from error
    numbered = [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]
    if not numbered:
        raise FormatError(f"{path} is empty; expected three numbers a line")
    columns: Sequence[int] = (0, 1, 2)
    head = [field.strip().lower() for field in next(csv.reader([numbered[0][1]]))]
    named = not any(_is_number(token) for token in re.split(r"[\s,;]+", numbered[0][1]))
    if named:
        triple = next((names for names in _TRIPLES if all(name in head for name in names)), None)
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
        if not np.isfinite(truth).all() or min(truth) < 0 or sum(truth) <= 0:
            raise FormatError(
                f"{path}, line {number}: {line!r} is no ground truth: expected numbers from 0, sum above 0"
            )
        truths.append(truth)
    if not truths:
        raise FormatError(f"{path} holds no ground truth below its head line")
    return np.array(truths)


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True
