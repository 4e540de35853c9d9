"""Estimates that another program has made, as a CSV file: `image,r,g,b`, one line an image of the data set.

The columns are found by their names, others may stand between them; a file without a head has those four. Commas,
semicolons or tabs separate. An image is named as the data set names it, or without its extension. Every image of the
data set has one line and no other image has any: a file of another part of the data set is refused rather than judged
on what both happen to have.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from evaluation.scene import Scene
from foundation.errors import FormatError, InputError, counted, first_of
from foundation.hashing import sha256_of
from generator.named_numbers import is_number

_COLUMNS = ("image", "r", "g", "b")


@dataclass(frozen=True, eq=False)
class GivenEstimates:
    """Estimates from a file, in place of a method.

    - `name`: what stands in the tables.
    - `file`: the file's name.
    - `sha256`: of its bytes.
    - `lights`: (3,) float64 of each image by its name, as the file has them: not checked to be lights.
    """

    name: str
    file: str
    sha256: str
    lights: Mapping[str, npt.NDArray[np.float64]]

    def estimate_scene(self, scene: Scene) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64 that the file has for a scene, camera RGB of any length."""
        return self.lights[scene.name]


def read_estimates(path: Path, images: Sequence[str], name: str | None = None) -> GivenEstimates:
    """Return the estimates of a file for the images of a data set."""
    try:
        content = path.read_bytes()
        text = content.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}; name a CSV file of estimates") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no CSV text in UTF-8: {error}; expected {','.join(_COLUMNS)}") from error
    by_stem = _by_stem(images)
    known = set(images)
    found: dict[str, npt.NDArray[np.float64]] = {}
    unknown: list[str] = []
    twice: list[str] = []
    for given, light in _rows(path, text):
        image = given if given in known else by_stem.get(given, by_stem.get(_stem(given)))
        if image is None:
            unknown.append(given)
        elif image in found:
            twice.append(given)
        else:
            found[image] = light
    missing = [image for image in images if image not in found]
    faults = [
        f"{counted(len(those), one, several)} ({first_of(those)})"
        for those, one, several in (
            (missing, "image of the data set is missing", "images of the data set are missing"),
            (unknown, "line is of no image of the data set", "lines are of no image of the data set"),
            (twice, "image stands there twice", "images stand there twice"),
        )
        if those
    ]
    if faults:
        raise InputError(f"{path}: {'; '.join(faults)}; expected one line for each of {counted(len(images), 'image')}")
    return GivenEstimates(path.stem if name is None else name, path.name, sha256_of(content), found)


def _by_stem(images: Sequence[str]) -> dict[str, str]:
    """Return images by their names without extension, those left out of which two have the same."""
    stems: defaultdict[str, list[str]] = defaultdict(list)
    for image in images:
        stems[_stem(image)].append(image)
    return {stem: found[0] for stem, found in stems.items() if len(found) == 1}


def _stem(image: str) -> str:
    path = PurePosixPath(image)
    return str(path.with_suffix("")) if path.name else image


def _rows(path: Path, text: str) -> list[tuple[str, npt.NDArray[np.float64]]]:
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    separator = max(",;\t", key=lines[0].count)
    try:
        rows = list(csv.reader(lines, delimiter=separator, strict=True))
    except csv.Error as error:
        raise FormatError(f"{path} is no CSV text: {error}; expected {','.join(_COLUMNS)}") from error
    heads = [head.strip().lower() for head in rows[0]] if rows else []
    headed = all(column in heads for column in _COLUMNS)
    if not headed and not (len(heads) == len(_COLUMNS) and all(map(is_number, heads[1:]))):
        raise FormatError(
            f"{path} begins with {lines[0][:80].strip()!r}; expected the columns {','.join(_COLUMNS)}, with or without "
            "a head"
        )
    if headed and len(set(heads)) < len(heads):
        raise FormatError(f"{path} has columns of the same name: {separator.join(rows[0])}; expected each once")
    places = [heads.index(column) if headed else number for number, column in enumerate(_COLUMNS)]
    found: list[tuple[str, npt.NDArray[np.float64]]] = []
    for number, row in enumerate(rows, start=1):
        if (headed and number == 1) or not any(field.strip() for field in row):
            continue
        if len(row) != len(heads):
            raise FormatError(
                f"{path}, line {number}: {len(row)} fields where the first line has {len(heads)}; expected as many, "
                "and a point, not a comma, in numbers"
            )
        try:
            image, *light = (row[place].strip() for place in places)
            found.append((image, np.array([float(part) for part in light])))
        except (IndexError, ValueError) as error:
            raise FormatError(
                f"{path}, line {number}: {separator.join(row)[:80]!r}; expected a name and three numbers"
            ) from error
    return found
