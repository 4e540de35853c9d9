"""Write and read files of a results folder (`errors.csv`, `run.json`), and read estimates of other programs.

A line of `errors.csv` has the columns `image`, `method`, the estimate, the ground truth (`truth_r`, `truth_g`,
`truth_b`), `recovery` and `reproduction` in degrees, `guessed`, `cause`, and `group` if images are grouped. Columns
are identified by name; additional columns are ignored.

A file of estimates from another program has the columns `image,r,g,b` and one line for each image of the data set.
Separators are commas, semicolons or tabs. The file extension of an image may be omitted.
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
from foundation.names import comparable

ERRORS_FILE = "errors.csv"  # Name of the file with all errors in a results folder

_ERROR_KINDS: tuple[ErrorKind, ...] = ("recovery", "reproduction")
_TRUTH_KEYS = ("truth_r", "truth_g", "truth_b")
_ESTIMATE_KEYS = ("r", "g", "b")
_NUMBER_COLUMNS = (*_ERROR_KINDS, *_TRUTH_KEYS)


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """Errors of one method on the images of a data set.

    - `method`: name of the method.
    - `images`: names of the N images, each once.
    - `truths`: (N, 3) float64, linear camera RGB of any scale.
    - `errors`: (N,) float64, degrees, by kind of error.
    - `guessed`: (N,) bool, True if the method returned no illuminant and grey replaces it.
    - `groups`: for each image, the group of related images; None if any line of the file has no group.
    """

    method: str
    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    groups: tuple[str, ...] | None = None


def read_errors(location: Path | str) -> dict[str, MethodErrors]:
    """Return the errors of all methods of a results folder, by name and in the order of the file."""
    path = Path(location)
    if path.is_dir():
        path = path / ERRORS_FILE
    text = read_text(path, f"give a results folder of evaluate run, or the {ERRORS_FILE} in it")
    rows = csv.DictReader(text.splitlines())
    columns = rows.fieldnames or []
    missing = [name for name in ("image", "method", *_NUMBER_COLUMNS, "guessed") if name not in columns]
    if missing:
        raise FormatError(
            f"{path} has the columns {', '.join(columns) or '(none)'}, expected also {', '.join(missing)}; run "
            "evaluate run again"
        )
    if len(set(columns)) < len(columns):
        raise FormatError(f"{path} has the columns {', '.join(columns)}, expected each once; remove the repeated ones")
    lines_by_method: dict[str, dict[str, _Line]] = {}
    for row in rows:
        line_name = f"{path}, line {rows.line_num}"
        if rows.restkey in row:
            raise FormatError(
                f"{line_name} has more than {len(columns)} fields, expected one for each column; correct it"
            )
        numbers = [_finite_number(row[name], name, line_name) for name in _NUMBER_COLUMNS]
        if min(numbers) < 0 or not any(numbers[2:]):
            raise FormatError(
                f"{line_name}: {row['image']} has {dict(zip(_NUMBER_COLUMNS, numbers, strict=True))}, expected no "
                "value below 0, and a ground truth above 0; correct it"
            )
        if row["guessed"] not in ("0", "1"):
            raise FormatError(f"{line_name}: guessed is {row['guessed']!r}, expected 0 or 1; correct it")
        images = lines_by_method.setdefault(row["method"] or "", {})
        if row["image"] in images:
            raise FormatError(
                f"{line_name} has {row['method']} on {row['image']} twice, expected once; remove this line"
            )
        images[row["image"]] = numbers, row["guessed"] == "1", row.get("group") or ""
    if not lines_by_method:
        raise FormatError(f"{path} has no errors, expected a line for each image and method; run the methods again")
    return {method: _method_errors(method, images) for method, images in lines_by_method.items()}


_Line = tuple[list[float], bool, str]  # Of one image: its errors and ground truth, `guessed`, `group`


def _method_errors(method: str, images: Mapping[str, _Line]) -> MethodErrors:
    numbers = np.array([line[0] for line in images.values()])
    groups = tuple(line[2] for line in images.values())
    return MethodErrors(
        method=method,
        images=tuple(images),
        truths=numbers[:, 2:],
        errors={metric: numbers[:, column] for column, metric in enumerate(_ERROR_KINDS)},
        guessed=np.array([line[1] for line in images.values()]),
        groups=groups if all(groups) else None,
    )


def _finite_number(text: str | None, column: str, line_name: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{line_name}: {column} is {text!r}, expected a finite number; correct it")
    return value


RUN_FORMAT = "crop.run"  # Value of `format` in `run.json`


def errors_csv(
    images: Sequence[str],
    truths: npt.NDArray[np.float64],
    results: Sequence[Result],
    groups: Sequence[str] | None = None,
) -> str:
    """Return the text of `errors.csv`: all estimates, ground truths and errors.

    The columns are image, method, r, g, b, truth_r, truth_g, truth_b, recovery, reproduction, guessed, cause, and group
    if images are grouped. Illuminants have the sum 1; errors are degrees. `guessed` is 1 if the method returned no
    illuminant, so that grey is recorded; `cause` is the reason.

    `truths`: (N, 3) float64, camera RGB of any scale. `groups`: group of each image; None if images are not grouped.
    """
    chromaticities = truths / truths.sum(axis=1, keepdims=True)
    estimated = [result.estimates / result.estimates.sum(axis=1, keepdims=True) for result in results]
    group_head = [] if groups is None else ["group"]
    head = ("image", "method", *_ESTIMATE_KEYS, *_TRUTH_KEYS, *_ERROR_KINDS, "guessed", "cause", *group_head)
    rows: list[tuple[object, ...]] = [head]
    for index, image in enumerate(images):
        for result, estimates in zip(results, estimated, strict=True):
            numbers = (*estimates[index], *chromaticities[index])
            errors = (result.errors[metric][index] for metric in _ERROR_KINDS)
            cause = (result.causes or {}).get(index, "")
            rows.append(
                (
                    *(image, result.method),
                    *(f"{value:.9f}" for value in numbers),
                    *(f"{error:.6f}" for error in errors),
                    *(int(result.guessed[index]), cause),
                    *([] if groups is None else [groups[index]]),
                )
            )
    return csv_text(rows)


def several_lights_csv(images: Sequence[str], results: Sequence[Result]) -> tuple[str, str]:
    """Return the text of `pixels.csv` and `regions.csv`: errors by pixel and by region under several illuminants.

    Columns of `pixels.csv`: image, method, pixel_recovery (LSMI's MAE_illum), pixel_reproduction, pixel_rgb (MAE_rgb).
    Columns of `regions.csv`: image, method, light (index from 0), share (fraction of the evaluated pixels), recovery,
    reproduction. Errors are degrees, or empty fields if no pixel is evaluated.
    """
    pixels: list[tuple[object, ...]] = [("image", "method", "pixel_recovery", "pixel_reproduction", "pixel_rgb")]
    regions: list[tuple[object, ...]] = [("image", "method", "light", "share", "recovery", "reproduction")]
    for result in results:
        for index, error in (result.maps or {}).items():
            row_start = (images[index], result.method)
            pixels.append((*row_start, *map(_degrees, (error.recovery, error.reproduction, error.rgb))))
            for region in error.regions:
                errors = (_degrees(region.recovery), _degrees(region.reproduction))
                regions.append((*row_start, region.light, f"{region.share:.6f}", *errors))
    return csv_text(pixels), csv_text(regions)


def run_json(content: Mapping[str, Any]) -> str:
    """Return the text of `run.json`."""
    return json.dumps({"format": RUN_FORMAT, "version": 1, **content}, indent=2, ensure_ascii=False) + "\n"


def _degrees(error: float) -> str:
    return f"{error:.6f}" if np.isfinite(error) else ""


_ESTIMATES_COLUMNS = ("image", *_ESTIMATE_KEYS)
_ESTIMATES_TEXT = ",".join(_ESTIMATES_COLUMNS)


@dataclass(frozen=True, eq=False)
class GivenEstimates:
    """Estimates from a file, used like a method."""

    name: str  # Name in the tables
    file: str  # Name of the file
    sha256: str  # Hash of its bytes
    # Estimate (3,) float64 by name of the image, as written in the file; values are not checked
    lights: Mapping[str, npt.NDArray[np.float64]]

    def estimate_scene(self, scene: Scene) -> npt.NDArray[np.float64]:
        """Return the estimate (3,) float64 for a scene, camera RGB of any scale."""
        return self.lights[scene.name]


def read_estimates(path: Path, images: Sequence[str], name: str | None = None) -> GivenEstimates:
    """Return the estimates of a file for the images of a data set; every image needs exactly one line."""
    text = read_text(path, f"give a CSV file of estimates, {_ESTIMATES_TEXT}", is_table=True)
    by_stem = _by_stem(images)
    image_names = {comparable(image): image for image in images}
    lights: dict[str, npt.NDArray[np.float64]] = {}
    unknown: list[str] = []
    repeated: dict[str, None] = {}
    for image_name, light in _parse_estimates(path, text):
        name_in_file = comparable(image_name)
        image = image_names.get(name_in_file) or by_stem.get(name_in_file, by_stem.get(_stem(name_in_file)))
        if image is None:
            unknown.append(image_name)
        elif image in lights:
            repeated[image] = None
        else:
            lights[image] = light
    missing = [image for image in images if image not in lights]
    # A file that lacks images of the data set is refused, because errors of the other images alone would mislead.
    faults = [
        f"{counted(len(faulty_images), singular, plural)} ({first_few(faulty_images)})"
        for faulty_images, singular, plural in (
            (missing, "image of the data set has no line", "images of the data set have no line"),
            (unknown, "line has an unknown image", "lines have unknown images"),
            (list(repeated), "image has more than one line", "images have more than one line"),
        )
        if faulty_images
    ]
    if faults:
        raise InputError(f"{path}: {' and '.join(faults)}, expected one line for each image; correct it")
    return GivenEstimates(path.stem if name is None else name, path.name, file_sha256(path), lights)


def _by_stem(images: Sequence[str]) -> dict[str, str]:
    stems: defaultdict[str, list[str]] = defaultdict(list)
    for image in images:
        stems[_stem(comparable(image))].append(image)
    return {stem: stem_images[0] for stem, stem_images in stems.items() if len(stem_images) == 1}


def _stem(image: str) -> str:
    path = PurePosixPath(image)
    return str(path.with_suffix("")) if path.name else image


def _parse_estimates(path: Path, text: str) -> list[tuple[str, npt.NDArray[np.float64]]]:
    lines = text.splitlines()
    separator = max(",;\t", key=lines[0].count) if lines else ","
    try:
        heads, *rows = list(csv.reader(lines, delimiter=separator, strict=True)) or [[]]
    except csv.Error as error:
        raise FormatError(f"{path} is not CSV text: {error}, expected {_ESTIMATES_TEXT}; correct it") from error
    heads = [head.strip().lower() for head in heads]
    if any(heads.count(column) != 1 for column in _ESTIMATES_COLUMNS):
        raise FormatError(
            f"{path} starts with {separator.join(heads)[:60]!r}, expected {_ESTIMATES_TEXT}, each once; "
            "correct its first line"
        )
    column_indices = [heads.index(column) for column in _ESTIMATES_COLUMNS]
    estimates: list[tuple[str, npt.NDArray[np.float64]]] = []
    for line_number, row in enumerate(rows, start=2):
        if not any(field.strip() for field in row):
            continue
        try:
            if len(row) != len(heads):
                raise ValueError(f"{len(row)} fields, the first line has {len(heads)}")
            image, *light = (row[field_index].strip() for field_index in column_indices)
            estimates.append((image, np.array([float(channel) for channel in light])))
        except ValueError as error:
            line = f"{path}, line {line_number}"
            raise FormatError(f"{line}: {error}, expected a name and three numbers; correct it") from error
    return estimates
