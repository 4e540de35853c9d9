"""Where source pictures come from: files, folders, or random colours."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from drivers.errors import InputError
from generator import philox
from generator.picture import LARGEST_SIDE, Picture, read_picture

SUFFIXES: Final = frozenset(
    {".avif", ".bmp", ".dpx", ".exr", ".gif", ".hdr", ".heic", ".heif", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)
"""What a folder is searched for, in lower or upper case; a file that is named itself may end as it likes."""


class Source(Protocol):
    """Something that gives one picture."""

    @property
    def name(self) -> str:
        """What the dataset calls it."""
        ...

    def read(self) -> Picture:
        """Return the picture (H, W, 3) uint8, sRGB codes; a FormatError says why it cannot be had."""
        ...

    def sha256(self) -> str | None:
        """Return the hash of the file's bytes; None where there is no file."""
        ...


@dataclass(frozen=True)
class PictureFile:
    """A file; `name` is its path below the folder it was found in, with forward slashes."""

    name: str
    path: Path
    max_side: int | None = None

    def read(self) -> Picture:
        """Return the picture (H, W, 3) uint8; see `read_picture`."""
        return read_picture(self.path, self.max_side)

    def sha256(self) -> str:
        """Return the hash of the file's bytes."""
        digest = hashlib.sha256()
        with self.path.open("rb") as stream:
            while chunk := stream.read(1 << 20):
                digest.update(chunk)
        return digest.hexdigest()


@dataclass(frozen=True)
class RandomScene:
    """A picture whose every code is drawn uniformly from 0 … 255: the paper's second set of scenes (section 4.3).

    Codes R, G, B of pixel (x, y) are the three high bytes, highest first, of word x mod 4 of Philox4x32-10 with counter
    (⌊x/4⌋, y, number, 2) and the seed as key.
    """

    number: int
    width: int
    height: int
    seed: int = 0

    @property
    def name(self) -> str:
        """What the dataset calls it."""
        return f"random-{self.number:06d}"

    def read(self) -> Picture:
        """Return the picture (H, W, 3) uint8."""
        places = np.arange((self.width + 3) // 4)
        rows = np.arange(self.height)[:, None]
        four = philox.words(self.seed, places, rows, self.number, philox.SCENES)
        words = np.stack(four, axis=-1).reshape(self.height, -1)[:, : self.width]
        return np.stack([words >> np.uint32(24), words >> np.uint32(16), words >> np.uint32(8)], axis=-1).astype(
            np.uint8
        )

    def sha256(self) -> None:
        """Return None: there is no file."""
        return


def random_scenes(count: int, width: int, height: int, seed: int = 0) -> tuple[RandomScene, ...]:
    """Return `count` random scenes of `width` × `height` px, numbered from 0.

    Raises
    ------
    InputError
        A number is out of range.
    """
    if count < 1:
        raise InputError(f"{count} random scenes were asked for, expected 1 or more")
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise InputError(f"random scenes of {width}x{height} were asked for, expected sides of 1 to {LARGEST_SIDE} px")
    return tuple(RandomScene(number, width, height, seed) for number in range(count))


def find_pictures(places: Sequence[Path], max_side: int | None = None) -> tuple[PictureFile, ...]:
    """Return the pictures of folders and files.

    A folder is searched with all folders below it, without hidden ones and without following links to folders, for
    files that end in one of `SUFFIXES`, sorted by their path below it, code point by code point. The order of `places`
    is kept.

    Raises
    ------
    InputError
        A place is missing, or a folder holds no picture.
    """
    found: list[PictureFile] = []
    for place in places:
        if place.is_dir():
            below = [
                path
                for path in place.rglob("*")
                if path.suffix.lower() in SUFFIXES
                and not any(part.startswith(".") for part in path.relative_to(place).parts)
                and path.is_file()
            ]
            if not below:
                raise InputError(
                    f"{place} holds no picture; expected files that end in one of {' '.join(sorted(SUFFIXES))}"
                )
            named = sorted((path.relative_to(place).as_posix(), path) for path in below)
            found += [PictureFile(_printable(name), path, max_side) for name, path in named]
        elif place.exists():
            found.append(PictureFile(_printable(place.name), place, max_side))
        else:
            raise InputError(f"there is no {place}; name a picture or a folder of pictures")
    return tuple(found)


def _printable(name: str) -> str:
    """Return `name` as text for a CSV file; a byte that is no text becomes its hexadecimal escape."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
