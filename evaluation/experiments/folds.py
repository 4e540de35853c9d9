"""Folds of a data set: its authors' own, drawn by a seed, or read from a file; written as one.

A fold is held back while a method is trained on the others. Images that share a group, such as one picture under
several lights, are always in the same fold: otherwise the method is tested on what it was trained on.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.datasets.identity import first_copies
from evaluation.scene import Scene, SceneSet
from foundation.errors import FormatError, InputError, counted, first_few
from foundation.files import csv_text, read_csv
from generator.named_numbers import is_number

FOLDS = 3  # Folds that are drawn by default: what the field's tables have, on NUS and on Cube+

_LEAST = 2  # Folds: with one there is nothing left to train on


def group_of(scene: Scene) -> str:
    """Return what the scene shares with others that must not be parted from it: its `group`, else its name."""
    return str(getattr(scene, "group", scene.name))


def groups_of(scenes: Sequence[Scene]) -> tuple[str, ...] | None:
    """Return the group of each scene; None where no two share one."""
    groups = tuple(map(group_of, scenes))
    return groups if len(set(groups)) < len(groups) else None


def choose_folds(data: SceneSet, text: str | None = None, seed: int = 0) -> tuple[npt.NDArray[np.int64], str]:
    """Return the fold of each image, (N,) int64 from 0, and where the folds come from, for the reader.

    `text`: what --folds was given: a number of folds to draw, or the path of a CSV file with the columns image,fold.
    None takes the data set's own folds, else draws `FOLDS`.
    """
    if text is None and data.folds is not None:
        return np.asarray(data.folds, dtype=np.int64), "the data set's own"
    if text is not None and not re.fullmatch(r"[+-]?\d+", text):
        if is_number(text) or not (Path(text).suffix or Path(text).is_file()):
            raise InputError(f"--folds is {text!r}, expected a number from 2, or a CSV file with image,fold")
        return read_folds(Path(text), [scene.name for scene in data.scenes]), f"from {text}"
    groups = groups_of(data.scenes)
    origin = f"drawn by seed {seed}"
    if groups is not None:
        origin += f", {len(set(groups))} groups of images kept together"
    return draw_scene_folds(data.scenes, FOLDS if text is None else int(text), seed), origin


def draw_folds(count: int, folds: int, seed: int = 0, groups: Sequence[str] | None = None) -> npt.NDArray[np.int64]:
    """Return the fold of each image, (N,) int64 from 0; the folds differ in size as little as the groups allow.

    `groups`: the group of each of the N images; None if every image is one of its own.

    Examples
    --------
    >>> np.bincount(draw_folds(10, 3)).tolist()
    [4, 3, 3]
    >>> pairs = draw_folds(6, 3, groups=["a", "b", "c", "a", "b", "c"])
    >>> (pairs[:3] == pairs[3:]).all()
    np.True_
    """
    names = [str(number) for number in range(count)] if groups is None else list(groups)
    if len(names) != count:
        raise ValueError(f"{len(names)} groups of {count} images; expected one an image")
    kinds, member, sizes = np.unique(names, return_inverse=True, return_counts=True)
    if not _LEAST <= folds <= len(kinds):
        told = f"{count} images" + ("" if groups is None else f" in {len(kinds)} groups that stay together")
        what, own = ("images", "an image") if groups is None else ("groups", "a group")
        if len(kinds) < _LEAST:
            needed = f"cross-validation needs {_LEAST} {what} at least; give more images"
        else:
            most = f"2 to {len(kinds)}" if len(kinds) > _LEAST else "2"
            needed = f"each fold holds {own} of its own; {most} folds are possible here (--folds)"
        raise InputError(f"{counted(folds, 'fold')} of {told}: {needed}")
    order = np.random.default_rng(seed).permutation(len(kinds))
    # The largest groups first, each into the emptiest fold: sizes then differ by less than the largest group.
    order = order[np.argsort(-sizes[order], kind="stable")]
    filled, chosen = np.zeros(folds, np.int64), np.zeros(len(kinds), np.int64)
    for kind in order:
        chosen[kind] = np.argmin(filled)
        filled[chosen[kind]] += sizes[kind]
    return chosen[member].astype(np.int64)


def draw_scene_folds(scenes: Sequence[Scene], folds: int, seed: int = 0) -> npt.NDArray[np.int64]:
    """Return the fold of each scene, (N,) int64 from 0, groups and copies kept together: the same for all commands."""
    groups = groups_of(scenes)
    if groups is None:
        names = [scene.name for scene in scenes]
        copied = tuple(names[first] for first in first_copies(scenes))
        # Names would be dealt in another order than numbers, and data sets without groups have none but their names.
        groups = copied if len(set(copied)) < len(copied) else None
    return draw_folds(len(scenes), folds, seed, groups)


def read_folds(path: Path, names: Sequence[str]) -> npt.NDArray[np.int64]:
    """Return the fold of each image, (N,) int64 from 0, as a CSV file has them: `image,fold`, a line an image.

    Folds may be any words or numbers; they are counted in their sorted order. Images that the data set lacks are
    refused as well as images that the file lacks.
    """
    columns, table = read_csv(path, "expected CSV, image,fold a line", "folds from")
    if not {"image", "fold"} <= set(columns):
        have = ",".join(columns) or "of an empty file"
        raise FormatError(f"{path} has the columns {have}; expected image,fold; correct its first line")
    given = {row["image"]: row["fold"].strip() for row in table}
    twice = [image for image, count in Counter(row["image"] for row in table).items() if count > 1]
    missing = [name for name in names if not given.get(name)]
    strange = sorted(set(given) - set(names))
    for wrong, what in ((twice, "more than once"), (missing, "without a fold"), (strange, "which the data set lacks")):
        if wrong:
            raise FormatError(f"{path} has images {what}: {first_few(wrong)}; expected each image of the data set once")
    kinds, folds = np.unique([given[name] for name in names], return_inverse=True)
    if len(kinds) < _LEAST:
        raise FormatError(f"{path} has the fold {first_few(list(kinds))} only; expected at least two")
    return folds.astype(np.int64)


def folds_to_csv(names: Sequence[str], folds: npt.NDArray[np.int64]) -> str:
    """Return folds (N,) int64 as CSV text that `read_folds` reads: `image,fold`.

    Examples
    --------
    >>> print(folds_to_csv(["a.png", "b.png"], np.array([1, 0])), end="")
    image,fold
    a.png,1
    b.png,0
    """
    return csv_text([("image", "fold"), *zip(names, map(int, folds), strict=True)])


def require_apart(scenes: Sequence[Scene], folds: npt.NDArray[np.int64]) -> None:
    """Refuse folds (N,) int64 that part images of one group."""
    seen: dict[str, int] = {}
    for scene, fold in zip(scenes, folds, strict=True):
        group = group_of(scene)
        if seen.setdefault(group, int(fold)) != int(fold):
            raise InputError(
                f"images of {group} are in the folds {seen[group]} and {int(fold)}: a method would be tested on "
                "what it was trained on; put all images of a group into one fold"
            )
