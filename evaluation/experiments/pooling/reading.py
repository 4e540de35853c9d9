"""A results folder of `evaluate transfer`, read back."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import numpy.typing as npt

from evaluation.experiments.transfer.rows import Kind, TransferRow
from evaluation.metrics import ErrorKind
from evaluation.results.errors_file import MethodErrors, read_errors
from evaluation.results.result import Result
from foundation.errors import FormatError, InputError, first_of

_KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class TransferResults:
    """A results folder of `evaluate transfer`, read back.

    - `place`: the folder as it was named.
    - `test`: name of the test set.
    - `images`: the names of the N test images.
    - `truths`: (N, 3) float64, linear camera RGB of their lights.
    - `rows`: its rows, the images in that order.
    - `error`: the kind of error that it was summed up by.
    - `conditions`: what of its settings would make its rows other ones, each as JSON text by its name.
    - `generated`: whether the test images were generated.
    """

    place: str
    test: str
    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    rows: tuple[TransferRow, ...]
    error: ErrorKind
    conditions: Mapping[str, str] = field(default_factory=dict[str, str])
    generated: bool = False


def read_transfer(place: Path | str) -> TransferResults:
    """Return what a results folder of `evaluate transfer` holds."""
    folder = Path(place)
    about = _about(folder)
    errors = read_errors(folder)
    rows: list[TransferRow] = []
    first: MethodErrors | None = None
    for row, seeds in _listed(folder / "results.csv"):
        found = [errors.get(name) for name in row.labels(seeds)]
        whole = [one for one in found if one is not None]
        if len(whole) < len(found):
            raise FormatError(
                f"{folder / 'errors.csv'} lacks {first_of(row.labels(seeds))}, which results.csv has; the files of a "
                "results folder belong together: run the transfer again"
            )
        first = first or whole[0]
        for one in whole:
            if one.images != first.images or one.truths is None or one.estimates is None:
                raise FormatError(
                    f"{folder / 'errors.csv'}: {one.method} has other images than {first.method}, or lights are "
                    "missing; run the transfer again"
                )
        results = tuple(Result(row.method, _lights(one.estimates), one.errors, one.guessed) for one in whole)
        rows.append(replace(row, results=results))
    if first is None:
        raise FormatError(f"{folder / 'results.csv'} has no row; run the transfer again")
    try:
        test, error = str(about["test"]["name"]), about["settings"]["error"]
        generated = about["test"].get("generated") is not None
        conditions = _conditions(about["settings"])
    except (AttributeError, KeyError, TypeError) as fault:
        raise FormatError(f"{folder / 'run.json'} does not say the {fault} of the transfer; run it again") from fault
    return TransferResults(
        str(place), test, first.images, _lights(first.truths), tuple(rows), error, conditions, generated
    )


def _conditions(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return what of a transfer's settings is to be the same in those that are pooled.

    Not the colour matrix, which each camera has of its own, nor which images were tested.
    """
    found = {f"--{name}": settings.get(name) for name in ("folds", "images", "side", "shared")}
    for method in (*settings.get("methods", ()), *settings.get("statistics", ())):
        found[f"the settings of {method['name']}"] = method.get("settings")
    return {name: json.dumps(value, sort_keys=True) for name, value in found.items()}


def _about(folder: Path) -> dict[str, Any]:
    expected = "name a folder that evaluate transfer --out has written"
    try:
        found = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {folder / 'run.json'}: {error.strerror or error}; {expected}") from error
    except ValueError as error:
        raise FormatError(f"{folder / 'run.json'} is no JSON: {error}; {expected}") from error
    about = cast("dict[str, Any]", found) if isinstance(found, dict) else {}
    if about.get("format") != "crop.transfer":
        raise InputError(
            f"{folder} holds results of the format {about.get('format')!r}, expected 'crop.transfer'; {expected}"
        )
    return about


def _listed(path: Path) -> list[tuple[TransferRow, int]]:
    """Return the rows that a results file lists, without results, and the number of their seeds."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            lines = list(csv.DictReader(stream))
        found = {
            (line["method"], line["training"], line["data"]): (int(line["images"]), int(line["seeds"]))
            for line in lines
        }
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror or error}; name a folder that evaluate transfer --out has written"
        ) from error
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise FormatError(f"{path} is no table of a transfer: {error}; run the transfer again") from error
    strange = [kind for _, kind, _ in found if kind not in _KINDS]
    if strange:
        raise FormatError(f"{path} has the training {first_of(strange)}; expected one of {', '.join(_KINDS)}")
    return [
        (TransferRow(method, cast("Kind", kind), data, images, ()), seeds)
        for (method, kind, data), (images, seeds) in found.items()
    ]


def _lights(given: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64]:
    """Return lights that were found to be there."""
    if given is None:
        raise TypeError("lights are checked before they are taken")
    return given
