"""The files of a results folder that other programs read, and their estimates: `errors.csv`, `run.json`.

A line of `errors.csv` has the columns `image`, `method`, the estimate, the truth (`truth_r`, `truth_g`, `truth_b`),
`recovery` and `reproduction` in degrees, `guessed`, and, where images belong together, `group`. Columns are found by
their names, so others may stand between them.

Estimates that another program has made are `image,r,g,b`, one line an image of the data set, below these heads; commas,
semicolons or tabs separate. An image is named as the data set names it, or without its extension. Every image
of the data set has one line and no other image has any: a file of another part of the data set is refused rather than
judged on what both happen to have.
"""

from __future__ import annotations

import csv
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind
from evaluation.results.result import Result
from evaluation.scene import Scene
from foundation.errors import FormatError, InputError, counted, first_few
from foundation.files import csv_text, file_sha256, read_text

ERRORS_FILE = "errors.csv"  # Its name in a results folder

_KINDS: tuple[ErrorKind, ...] = ("recovery", "reproduction")
_TRUTH = ("truth_r", "truth_g", "truth_b")
_ESTIMATE = ("r", "g", "b")
_NUMBERS = (*_KINDS, *_TRUTH)


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """The errors of one method on the images of a data set.

    - `method`: the method's name.
    - `images`: the images' names, N of them, each once.
    - `truths`: (N, 3) float64, linear camera RGB of any length.
    - `errors`: kind of error to (N,) float64, degrees.
    - `guessed`: (N,) bool, True where no pixel was usable and the estimate is therefore grey.
    - `groups`: what each image shares with others, such as the picture that it was made from; None where the file does
      not hold them all.
    """

    method: str
    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    groups: tuple[str, ...] | None = None


def read_errors(place: Path | str) -> dict[str, MethodErrors]:
    """Return the errors of every method of a results folder, by the methods' names and in the file's order."""
    path = Path(place)
    if path.is_dir():
        path = path / ERRORS_FILE
    text = read_text(path, f"name a results folder of evaluate run, or the {ERRORS_FILE} in it")
    rows = csv.DictReader(text.splitlines())
    columns = rows.fieldnames or []
    missing = [name for name in ("image", "method", *_NUMBERS, "guessed") if name not in columns]
    if missing:
        raise FormatError(
            f"{path} has the columns {', '.join(columns) or 'of an empty file'}; expected {', '.join(missing)} too, as "
            "evaluate run writes them"
        )
    if len(set(columns)) < len(columns):
        raise FormatError(f"{path} has columns of the same name: {', '.join(columns)}; expected each once")
    found: dict[str, dict[str, _Line]] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        if rows.restkey in row:
            raise FormatError(f"{where} has more fields than the {len(columns)} of its head; correct it")
        numbers = [_number(row[name], name, where) for name in _NUMBERS]
        if min(numbers) < 0 or not any(numbers[2:]):
            raise FormatError(
                f"{where}: {row['image']} has {dict(zip(_NUMBERS, numbers, strict=True))}; none is below 0"
            )
        if row["guessed"] not in ("0", "1"):
            raise FormatError(f"{where}: guessed is {row['guessed']!r}; expected 0 or 1")
        images = found.setdefault(row["method"] or "", {})
        if row["image"] in images:
            raise FormatError(f"{where}: {row['method']} on {row['image']} stands there a second time; remove one")
        images[row["image"]] = numbers, row["guessed"] == "1", row.get("group") or ""
    if not found:
        raise FormatError(f"{path} has no line of errors below its head; run the methods again")
    return {method: _errors_of(method, images) for method, images in found.items()}


_Line = tuple[list[float], bool, str]  # Of an image: errors and truth, whether it was guessed, and its group


def _errors_of(method: str, images: Mapping[str, _Line]) -> MethodErrors:
    numbers = np.array([line[0] for line in images.values()])
    groups = tuple(line[2] for line in images.values())
    return MethodErrors(
        method=method,
        images=tuple(images),
        truths=numbers[:, 2:],
        errors={kind: numbers[:, place] for place, kind in enumerate(_KINDS)},
        guessed=np.array([line[1] for line in images.values()]),
        groups=groups if all(groups) else None,
    )


def _number(text: str | None, name: str, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{where}: {name} is {text!r}, expected a finite number")
    return value


RUN_FORMAT = "crop.run"  # What `run.json` says of itself


def errors_csv(
    images: Sequence[str],
    truths: npt.NDArray[np.float64],
    results: Sequence[Result],
    groups: Sequence[str] | None = None,
) -> str:
    """Return every estimate, truth and error as CSV text: `errors.csv`.

    The columns are image, method, r, g, b, truth_r, truth_g, truth_b, recovery, reproduction, guessed, cause, and group
    where images belong together. Lights have the sum 1, errors are degrees; `guessed` is 1 where the method gave no
    light and grey stands in for it, `cause` says why.

    `truths`: (N, 3) float64, camera RGB of any length. `groups`: what each of the N images shares with others; None if
    every image is one of its own.
    """
    shares = truths / truths.sum(axis=1, keepdims=True)
    given = [result.estimates / result.estimates.sum(axis=1, keepdims=True) for result in results]
    shared = [] if groups is None else ["group"]
    rows: list[tuple[object, ...]] = [("image", "method", *_ESTIMATE, *_TRUTH, *_KINDS, "guessed", "cause", *shared)]
    for place, image in enumerate(images):
        for result, estimates in zip(results, given, strict=True):
            numbers = (*estimates[place], *shares[place])
            errors = (result.errors[kind][place] for kind in _KINDS)
            cause = (result.causes or {}).get(place, "")
            rows.append(
                (
                    *(image, result.method),
                    *(f"{part:.9f}" for part in numbers),
                    *(f"{error:.6f}" for error in errors),
                    *(int(result.guessed[place]), cause),
                    *([] if groups is None else [groups[place]]),
                )
            )
    return csv_text(rows)


def several_lights_csv(images: Sequence[str], results: Sequence[Result]) -> tuple[str, str]:
    """Return the errors of images under several lights by pixel and by region as CSV text: `pixels.csv`, `regions.csv`.

    The columns of the first are image, method, pixel_recovery (LSMI's MAE_illum), pixel_reproduction, pixel_rgb (its
    MAE_rgb); of the second image, method, light (its number from 0), share (of the image's judged pixels), recovery,
    reproduction. Degrees; empty where no pixel of an image is judged.
    """
    pixels: list[tuple[object, ...]] = [("image", "method", "pixel_recovery", "pixel_reproduction", "pixel_rgb")]
    regions: list[tuple[object, ...]] = [("image", "method", "light", "share", "recovery", "reproduction")]
    for result in results:
        for number, error in (result.maps or {}).items():
            head = (images[number], result.method)
            pixels.append((*head, *map(_degrees, (error.recovery, error.reproduction, error.rgb))))
            for region in error.regions:
                errors = (_degrees(region.recovery), _degrees(region.reproduction))
                regions.append((*head, region.light, f"{region.share:.6f}", *errors))
    return csv_text(pixels), csv_text(regions)


def run_json(content: Mapping[str, Any]) -> str:
    """Return the text of `run.json`."""
    return json.dumps({"format": RUN_FORMAT, "version": 1, **content}, indent=2, ensure_ascii=False) + "\n"


def _degrees(error: float) -> str:
    return f"{error:.6f}" if np.isfinite(error) else ""


_COLUMNS = ("image", *_ESTIMATE)


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
    text = read_text(path, f"name a CSV file of estimates, {','.join(_COLUMNS)}")
    by_stem = _by_stem(images)
    known = set(images)
    found: dict[str, npt.NDArray[np.float64]] = {}
    unknown: list[str] = []
    twice: dict[str, None] = {}
    for given, light in _rows(path, text):
        image = given if given in known else by_stem.get(given, by_stem.get(_stem(given)))
        if image is None:
            unknown.append(given)
        elif image in found:
            twice[image] = None
        else:
            found[image] = light
    missing = [image for image in images if image not in found]
    faults = [
        f"{counted(len(those), one, several)} ({first_few(those)})"
        for those, one, several in (
            (missing, "image of the data set is missing", "images of the data set are missing"),
            (unknown, "line is of no image of the data set", "lines are of no image of the data set"),
            (list(twice), "image stands there more than once", "images stand there more than once"),
        )
        if those
    ]
    if faults:
        raise InputError(f"{path}: {'; '.join(faults)}; expected one line for each of {counted(len(images), 'image')}")
    return GivenEstimates(path.stem if name is None else name, path.name, file_sha256(path), found)


def _by_stem(images: Sequence[str]) -> dict[str, str]:
    stems: defaultdict[str, list[str]] = defaultdict(list)
    for image in images:
        stems[_stem(image)].append(image)
    return {stem: found[0] for stem, found in stems.items() if len(found) == 1}


def _stem(image: str) -> str:
    path = PurePosixPath(image)
    return str(path.with_suffix("")) if path.name else image


def _rows(path: Path, text: str) -> list[tuple[str, npt.NDArray[np.float64]]]:
    lines = text.splitlines()
    separator = max(",;\t", key=lines[0].count) if lines else ","
    try:
        heads, *rows = list(csv.reader(lines, delimiter=separator, strict=True)) or [[]]
    except csv.Error as error:
        raise FormatError(f"{path} is no CSV text: {error}; expected {','.join(_COLUMNS)}") from error
    heads = [head.strip().lower() for head in heads]
    if any(heads.count(column) != 1 for column in _COLUMNS):
        raise FormatError(
            f"{path} begins with {separator.join(heads)[:60]!r}; expected {','.join(_COLUMNS)}, each once"
        )
    places = [heads.index(column) for column in _COLUMNS]
    found: list[tuple[str, npt.NDArray[np.float64]]] = []
    for number, row in enumerate(rows, start=2):
        if not any(field.strip() for field in row):
            continue
        try:
            if len(row) != len(heads):
                raise ValueError(f"{len(row)} fields, the head has {len(heads)}")
            image, *light = (row[place].strip() for place in places)
            found.append((image, np.array([float(part) for part in light])))
        except ValueError as error:
            raise FormatError(f"{path}, line {number}: {error}; expected a name and three numbers") from error
    return found
