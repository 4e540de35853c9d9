"""Masks that a user gives as image files.

A folder of masks holds one set for each image, in the order of the names, starting over when they end::

    NAME_1.png … NAME_K.png    K grey masks, one a light; the numbers, of three digits at most, give the order and may
                               begin anywhere
    NAME_1.png … NAME_K−1.png  one fewer: masks of the second light and those after it
    NAME.png                   one grey mask for two lights: where the second falls
    NAME.png                   one colour picture for three lights, a channel each

Full scale is weight 1; 8 or 16 bits, or float from 0 to 1; transparency does not count. A set of any size is made to
fit the image. Weights are divided by their sum. Where K masks leave a pixel dark, the first light falls.

The masks of a dataset (`masks.maps`) can be given again: in a folder of such names alone a set belongs to the image of
its number, since a picture that was passed over leaves its numbers out. An image whose number has no set takes one in
turn.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from generator.masks.decoding import decode_values
from generator.masks.weights import MaskMaker, Weights, quantise_shares

SUFFIXES: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".webp", ".pgm", ".ppm")
"""Endings of what is taken for a mask."""

_Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class GivenMasks:
    """The masks of one image, from files; a `MaskMaker`."""

    files: tuple[Path, ...]

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        masks = [_fitted(mask, height, width) for file in self.files for mask in _read(file)]
        names = ", ".join(file.name for file in self.files)
        if len(masks) not in (lights, lights - 1):
            raise FormatError(
                f"{names} in {self.files[0].parent}: {lights} lights need {lights} masks, or {lights - 1} for those "
                f"after the first; found {len(masks)}"
            )
        total = np.sum(masks, axis=0, dtype=np.float32)
        if len(masks) == lights:
            masks[0] = np.where(total > 0, masks[0], 1)
            shares = np.stack(masks)
        else:
            over = np.maximum(total, 1)
            shares = np.stack([np.maximum(1 - total, 0), *(mask / over for mask in masks)])
        out = np.empty((height, width, lights), np.float32)
        quantise_shares(shares, out)
        return out


@dataclass(frozen=True)
class GivenMaskPlan:
    """Sets of mask files for one image after another, starting over when they end; a `MaskPlan`.

    - `folder`: name of the folder.
    - `sets`: in the order of their names.
    - `sha256`: over the names and bytes of all files in their order.
    - `places`: which set belongs to the image of a number; empty where all are taken in turn.
    """

    folder: str
    sets: tuple[GivenMasks, ...]
    sha256: str
    places: Mapping[int, int] = field(default_factory=dict[int, int])

    def maker(self, number: int) -> MaskMaker:
        """Return the masks of image `number`."""
        return self.sets[self.places.get(number, number % len(self.sets))]

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return {"masks": "files", "folder": self.folder, "sets": len(self.sets), "sha256": self.sha256}


def find_masks(folder: Path, lights: int) -> GivenMaskPlan:
    """Return the sets of masks in a folder; the head of this file has the rules."""
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    except OSError as error:
        raise FormatError(f"cannot list the masks of {folder}: {error.strerror}; name a folder of masks") from error
    groups: dict[str, list[tuple[int, Path]]] = {}
    for path in files:
        # Cameras count their files with four digits or more.
        match = re.fullmatch(r"(.+)_(\d{1,3})", path.stem)
        name, number = (f"{match[1]}_", int(match[2])) if match else (path.stem, 0)
        groups.setdefault(name, []).append((number, path))
    if not groups:
        raise FormatError(f"there is no mask in {folder}; expected images such as NAME_1.png, NAME_2.png, a light each")
    digest = hashlib.sha256()
    sets: list[GivenMasks] = []
    for name in sorted(groups):
        members = tuple(path for _, path in sorted(groups[name]))
        for path in members:
            digest.update(f"{path.name}\n".encode())
            digest.update(_bytes_of(path))
        given = GivenMasks(members)
        given.weights(2, 2, lights)
        sets.append(given)
    keys = [re.fullmatch(r"(\d{6,})_", name) for name in sorted(groups)]
    places = {int(key[1]): place for place, key in enumerate(keys) if key}
    return GivenMaskPlan(folder.name, tuple(sets), digest.hexdigest(), places if len(places) == len(sets) else {})


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}") from error


def _read(path: Path) -> list[_Array]:
    """Return the masks of a file, (H, W) float32, 0 … 1: one if it is grey or its channels are equal, else three."""
    image = decode_values(_bytes_of(path), path)
    if image.dtype.kind == "u" and image.dtype.itemsize <= 2:
        scaled = np.asarray(image / np.float32(np.iinfo(image.dtype).max), dtype=np.float32)
    elif image.dtype.kind == "f" and np.isfinite(image).all():
        scaled = np.clip(image, 0, 1).astype(np.float32)
    else:
        raise FormatError(f"{path} holds {image.dtype} values, or some that are no numbers; give masks of 8 or 16 bits")
    if scaled.ndim == 2:
        return [scaled]
    grey = bool((scaled == scaled[..., :1]).all())
    return [np.ascontiguousarray(scaled[..., channel]) for channel in range(1 if grey else 3)]


def _fitted(mask: _Array, height: int, width: int) -> _Array:
    """Return a mask (H, W) float32 at the size of the image: averaged over areas to shrink it, else interpolated."""
    import cv2

    if mask.shape == (height, width):
        return mask
    smaller = height <= mask.shape[0] and width <= mask.shape[1]
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask, (width, height), interpolation=interpolation), dtype=np.float32)
