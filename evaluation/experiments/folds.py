"""Folds of a data set: defined by its authors, drawn by a seed, or read from a file.

A method is trained on all folds except one, and tested on that fold. Related images, such as one picture under several
illuminants, form a group and are always in the same fold. Otherwise a method would be tested on its training data.
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

FOLDS = 3  # Default number of folds, as in the published tables for NUS and Cube+

_MIN_FOLDS = 2  # With one fold there are no training images


def group_of(scene: Scene) -> str:
    """Return the group of related images to which the scene belongs: its `group` if it has one, else its name."""
    return str(getattr(scene, "group", scene.name))


def groups_of(scenes: Sequence[Scene]) -> tuple[str, ...] | None:
    """Return the group of each scene; None if every scene is its own group."""
    groups = tuple(map(group_of, scenes))
    return groups if len(set(groups)) < len(groups) else None


def choose_folds(data: SceneSet, text: str | None = None, seed: int = 0) -> tuple[npt.NDArray[np.int64], str]:
    """Return the fold of each image, (N,) int64 from 0, and a text on the origin of the folds.

    `text`: value of --folds, a number of folds to draw or the path of a CSV file with the columns image,fold. If it is
    None, the folds of the data set are used; a data set without folds gets `FOLDS` drawn folds.
    """
    if text is None and data.folds is not None:
        return np.asarray(data.folds, dtype=np.int64), "the data set's own"
    if text is not None and not re.fullmatch(r"[+-]?\d+", text):
        if is_number(text) or not (Path(text).suffix or Path(text).is_file()):
            raise InputError(f"--folds is {text!r}, expected a number ≥ 2 or a CSV file with image,fold; correct it")
        return read_folds(Path(text), [scene.name for scene in data.scenes]), f"from {text}"
    groups = groups_of(data.scenes)
    origin = f"drawn by seed {seed}"
    if groups is not None:
        origin += f", {len(set(groups))} groups of images kept together"
    return draw_scene_folds(data.scenes, FOLDS if text is None else int(text), seed), origin


def draw_folds(count: int, folds: int, seed: int = 0, groups: Sequence[str] | None = None) -> npt.NDArray[np.int64]:
    """Draw the fold of each image, (N,) int64 from 0. Folds are as equal in size as the groups allow.

    `groups`: group of each of the N images; None if every image is its own group.

    Examples
    --------
    >>> np.bincount(draw_folds(10, 3)).tolist()
    [4, 3, 3]
    >>> pairs = draw_folds(6, 3, groups=["a", "b", "c", "a", "b", "c"])
    >>> (pairs[:3] == pairs[3:]).all()
    np.True_
    """
    names = [str(index) for index in range(count)] if groups is None else list(groups)
    if len(names) != count:
        raise ValueError(f"{len(names)} groups of {count} images, expected one for each image")
    group_names, group_indices, sizes = np.unique(names, return_inverse=True, return_counts=True)
    if not _MIN_FOLDS <= folds <= len(group_names):
        available = f"{count} images" + ("" if groups is None else f" in {len(group_names)} groups that stay together")
        units, unit = ("images", "an image") if groups is None else ("groups", "a group")
        if len(group_names) < _MIN_FOLDS:
            expectation = f"expected at least {_MIN_FOLDS} {units} for cross-validation; add images"
        else:
            possible = f"2 to {len(group_names)}" if len(group_names) > _MIN_FOLDS else "2"
            expectation = f"expected {possible} folds, at least {unit} in each; choose another number (--folds)"
        raise InputError(f"{counted(folds, 'fold')} of {available}: {expectation}")
    order = np.random.default_rng(seed).permutation(len(group_names))
    # The largest groups are assigned first, each to the smallest fold, so that fold sizes differ little.
    order = order[np.argsort(-sizes[order], kind="stable")]
    fold_sizes, group_folds = np.zeros(folds, np.int64), np.zeros(len(group_names), np.int64)
    for group in order:
        group_folds[group] = np.argmin(fold_sizes)
        fold_sizes[group_folds[group]] += sizes[group]
    return group_folds[group_indices].astype(np.int64)


def draw_scene_folds(scenes: Sequence[Scene], folds: int, seed: int = 0) -> npt.NDArray[np.int64]:
    """Draw the fold of each scene, (N,) int64 from 0. Groups of images and copies stay together."""
    groups = groups_of(scenes)
    if groups is None:
        names = [scene.name for scene in scenes]
        copy_names = tuple(names[first] for first in first_copies(scenes))
        # Without copies, `groups` stays None. `draw_folds` would sort names, and thus draw other folds.
        groups = copy_names if len(set(copy_names)) < len(copy_names) else None
    return draw_folds(len(scenes), folds, seed, groups)


def read_folds(path: Path, names: Sequence[str]) -> npt.NDArray[np.int64]:
    """Return the fold of each image, (N,) int64 from 0, from a CSV file `image,fold` with a line for each image.

    Folds may have any names; they are numbered in sorted order. Missing and unknown images are refused.
    """
    columns, rows = read_csv(path, "use a CSV file with the columns image,fold", "folds from")
    if not {"image", "fold"} <= set(columns):
        column_text = ",".join(columns) or "none"
        raise FormatError(f"{path} has the columns {column_text}, expected image,fold; correct its first line")
    fold_texts = {row["image"]: row["fold"].strip() for row in rows}
    repeated = [image for image, count in Counter(row["image"] for row in rows).items() if count > 1]
    missing = [name for name in names if not fold_texts.get(name)]
    unknown = sorted(set(fold_texts) - set(names))
    for images, problem in ((repeated, "twice"), (missing, "without a fold"), (unknown, "not in the data set")):
        if images:
            raise FormatError(f"{path} has images {problem}: {first_few(images)}, expected each once; correct it")
    fold_names, folds = np.unique([fold_texts[name] for name in names], return_inverse=True)
    if len(fold_names) < _MIN_FOLDS:
        raise FormatError(f"{path} has only the fold {first_few(list(fold_names))}, expected at least two; correct it")
    return folds.astype(np.int64)


def folds_to_csv(names: Sequence[str], folds: npt.NDArray[np.int64]) -> str:
    """Return folds (N,) int64 as CSV text for `read_folds`.

    Examples
    --------
    >>> print(folds_to_csv(["a.png", "b.png"], np.array([1, 0])), end="")
    image,fold
    a.png,1
    b.png,0
    """
    return csv_text([("image", "fold"), *zip(names, map(int, folds), strict=True)])


def require_groups_together(scenes: Sequence[Scene], folds: npt.NDArray[np.int64]) -> None:
    """Raise InputError if folds (N,) int64 separate images of the same group."""
    group_folds: dict[str, int] = {}
    for scene, fold in zip(scenes, folds, strict=True):
        group = group_of(scene)
        if group_folds.setdefault(group, int(fold)) != int(fold):
            raise InputError(
                f"images of {group} are in the folds {group_folds[group]} and {int(fold)}, expected one fold, because "
                "a method would be tested on its training data; put all images of a group into one fold"
            )
