"""Find the source pictures of a generated data set again, by name and hash, and read them as they were read for it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from foundation.hashing import file_sha256
from generator.dataset.reader import Dataset
from generator.pictures.picture import Preparation, open_picture
from generator.pictures.sources import PictureFile, RandomScene, find_pictures


@dataclass(frozen=True)
class FoundPicture:
    """A source picture of a data set that was found again.

    - `name`: its name in the data set.
    - `path`: its file; None for a picture of random colours, which is made again.
    - `height`, `width`: its size in the data set, px.
    - `preparation`: how it was prepared.
    """

    name: str
    path: Path | None
    height: int
    width: int
    preparation: Preparation

    def codes(self, crop: int = 0) -> npt.NDArray[np.uint8]:
        """Return the sRGB codes (H, W, 3) uint8 that images of the data set were made of: those of one of its crops."""
        if self.path is None:
            number = int(self.name.rpartition("-")[2])
            return RandomScene(number, self.width, self.height, self.preparation.seed).read().picture
        reading = open_picture(self.path, self.preparation, self.name)
        picture = reading.cuts[crop].picture if reading.cuts else reading.picture
        if picture.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{self.path} comes to {picture.shape[1]}x{picture.shape[0]} px where images of it are "
                f"{self.width}x{self.height}; use the release that made the data set"
            )
        return picture


def find_sources(dataset: Dataset, place: Path | str) -> tuple[Mapping[str, FoundPicture], tuple[str, ...]]:
    """Return the source pictures of a data set that a folder holds, by name, and the names of those that it lacks.

    A picture is the one that is meant if its bytes have the hash that the data set records; a file of that name is
    tried first, then files of other names. Pictures of random colours need no file.
    """
    preparation = preparation_of(dataset)
    # A set of random colours needs no folder, but one that is named must be there.
    files = _Files({file.name: Path(file.location) for file in _listed(place)})
    found: dict[str, FoundPicture] = {}
    missing: list[str] = []
    for record in dataset.sources:
        path = None if record.sha256 is None else files.find(record.name, record.sha256)
        if path is None and record.sha256 is not None:
            missing.append(record.name)
        else:
            found[record.name] = FoundPicture(record.name, path, record.height, record.width, preparation)
    return found, tuple(missing)


def preparation_of(dataset: Dataset) -> Preparation:
    """Return how the pictures of a data set were prepared, by its description."""
    options: Mapping[str, Any] = dataset.description.options
    crop = options.get("crop")
    return Preparation(
        max_side=options.get("max_side"),
        crop=(int(crop[0]), int(crop[1])) if crop else None,
        cover=bool(options.get("cover", False)),
        crop_at=options.get("crop_at", "centre"),
        profiles=options.get("profiles", "honour"),
        # Scenes that another data set had first are cut where its seed said.
        seed=options.get("lights_of", {}).get("pictures_seed", dataset.description.seed),
        crops=int(options.get("crops", 1)),
    )


def _listed(place: Path | str) -> Sequence[PictureFile]:
    if "://" in str(place):
        raise InputError(f"{place} is no folder of this machine; copy the pictures to one")
    return find_pictures(place)


class _Files:
    """Pictures by name and by hash; a hash is taken when it is asked for, once."""

    def __init__(self, paths: Mapping[str, Path]) -> None:
        self._paths = paths
        self._hashes: dict[str, str] = {}
        self._by_hash: dict[str, Path] | None = None

    def find(self, name: str, sha256: str) -> Path | None:
        """Return the file of that hash, one of that name first; None if there is none."""
        if name in self._paths and self._hash(name) == sha256:
            return self._paths[name]
        if self._by_hash is None:
            self._by_hash = {self._hash(other): path for other, path in self._paths.items()}
        return self._by_hash.get(sha256)

    def _hash(self, name: str) -> str:
        if name not in self._hashes:
            path = self._paths[name]
            try:
                self._hashes[name] = file_sha256(path)
            except OSError as error:
                raise InputError(f"cannot read {path}: {os.strerror(error.errno or 0)}; name another folder") from error
        return self._hashes[name]
