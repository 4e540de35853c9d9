"""Results folders of several transfers, such as one for each of several cameras, pooled into one.

A ratio of medians is known to some 15 % from two hundred images: what is to be told apart by less needs the images of
several cameras together. Each folder's rows are those of `evaluate transfer`; a row of the pool has the errors of the
same method, trained in the same way, on all folders' test images, every image once and with the same weight. Its
intervals are of images drawn from all of them, and ratios stay paired by image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.experiments.pooling.reading import TransferResults
from evaluation.experiments.transfer.rows import Kind, TransferRow
from evaluation.results.result import Result
from foundation.errors import InputError, first_of


@dataclass(frozen=True, eq=False)
class Pool:
    """Several results as one.

    - `images`: folder and name of each of the N images, `folder/image`.
    - `truths`: (N, 3) float64.
    - `tests`: (N,) str, the test set of each image.
    - `rows`: the rows that all folders have.
    - `notes`: sentences for the reader: rows left out, conditions that differ.
    """

    images: tuple[str, ...]
    truths: npt.NDArray[np.float64]
    tests: tuple[str, ...]
    rows: tuple[TransferRow, ...]
    notes: tuple[str, ...]


def pool_transfers(parts: Sequence[TransferResults]) -> Pool:
    """Return the rows of several results with the errors of all their images.

    A row is found again by its method, by how it was trained, and by the name of its training set; where each of the
    folders has a single training set, whatever its name. Seed k of the pool is seed k of each. A row's training images
    are those of the folder with the fewest.
    """
    if not parts:
        raise InputError("no results to pool: name folders that evaluate transfer --out has written")
    _require_apart(parts)
    single = all(len({row.data for row in part.rows if row.data}) == 1 for part in parts)
    keyed = [{_key(row, single): row for row in part.rows} for part in parts]
    common = [key for key in keyed[0] if all(key in rows for rows in keyed)]
    missing = sorted({", ".join(word for word in key if word) for rows in keyed for key in rows if key not in common})
    if not common:
        raise InputError(
            f"{parts[0].place} and the others have no row in common: they have {first_of(missing, 4)}; pool transfers "
            "of the same methods, whose training sets have the same names"
        )
    notes = [f"Left out, since not all of the results have them: {'; '.join(missing)}"] if missing else []
    notes += _differences(parts)
    labels = _short_names([part.place for part in parts])
    rows = [_joined([rows[key] for rows in keyed], [part.place for part in parts], single) for key in common]
    return Pool(
        images=tuple(f"{label}/{image}" for label, part in zip(labels, parts, strict=True) for image in part.images),
        truths=np.concatenate([part.truths for part in parts]),
        tests=tuple(part.test for part in parts for _ in part.images),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _differences(parts: Sequence[TransferResults]) -> list[str]:
    """Return sentences on conditions that are not the same in all folders, and on test images that are not real."""
    notes: list[str] = []
    for name in dict.fromkeys(name for part in parts for name in part.conditions):
        places: dict[str, list[str]] = {}
        for part in parts:
            if name in part.conditions:
                places.setdefault(part.conditions[name], []).append(part.place)
        if len(places) > 1:
            told = "; ".join(f"{value} in {', '.join(named)}" for value, named in places.items())
            notes.append(f"The results do not have the same conditions: {name} is {told}")
    made = list(dict.fromkeys(part.test for part in parts if part.generated))
    if made:
        notes.append(f"Made by generate, so that they say nothing of real images: the test sets {', '.join(made)}")
    return notes


def _joined(rows: Sequence[TransferRow], places: Sequence[str], single: bool) -> TransferRow:
    """Return one row of those of all folders, which are of one method and training."""
    counts = [len(row.results) for row in rows]
    if len(set(counts)) > 1:
        told = ", ".join(f"{count} in {place}" for count, place in zip(counts, places, strict=True))
        raise InputError(f"{rows[0].method} has different numbers of seeds: {told}; run all with the same --seeds")
    names = list(dict.fromkeys(row.data for row in rows))
    results = [_concatenated([row.results[seed] for row in rows]) for seed in range(counts[0])]
    return TransferRow(
        method=rows[0].method,
        kind=rows[0].kind,
        data="each camera's own" if single and len(names) > 1 else names[0],
        images=min(row.images for row in rows),
        results=tuple(results),
    )


def _concatenated(results: Sequence[Result]) -> Result:
    return Result(
        results[0].method,
        np.concatenate([result.estimates for result in results]),
        {kind: np.concatenate([result.errors[kind] for result in results]) for kind in results[0].errors},
        np.concatenate([result.guessed for result in results]),
    )


def _key(row: TransferRow, single: bool) -> tuple[str, Kind, str]:
    return row.method, row.kind, "" if single else row.data


def _require_apart(parts: Sequence[TransferResults]) -> None:
    """Refuse results of which two hold one image: it would count twice, and intervals would be too narrow."""
    seen: dict[tuple[str, tuple[float, ...]], int] = {}
    for number, part in enumerate(parts):
        for image, truth in zip(part.images, part.truths, strict=True):
            share = tuple(round(float(each / truth.sum()), 6) for each in truth)
            other = seen.setdefault((image, share), number)
            if other != number:
                raise InputError(
                    f"{image} is a test image of {parts[other].place} and of {part.place}; pool results of different "
                    "images, such as of different cameras, or of parts of one data set (evaluate transfer --only)"
                )


def _short_names(places: Sequence[str]) -> list[str]:
    """Return the folders' own names, or the paths as they were named where two folders have one name."""
    names = [Path(place).resolve().name for place in places]
    return names if len(set(names)) == len(names) else list(places)
