"""A user's own images: a folder with a table of their lights.

It lies so::

    gt.csv              image,r,g,b: one row an image; its path from the table's folder, with or without the ending
                        columns black, saturation: levels of the image, in the units of its file, optional
                        column mask: a picture that is not 0 where a pixel must not be used, optional
                        column fold: whole numbers from 0 for cross-validation, optional
    photo1.png …        linear camera RGB, red first: PNG or TIFF of 16 bits, TIFF of floats, or NumPy files

The table is the folder's only .csv with those columns, or is named itself. Pictures for the eye are refused: JPEG, and
8 bits a channel, are sRGB, whose values are not proportional to light.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from evaluation.datasets.names import IMAGE_ENDINGS, Folder
from evaluation.datasets.options import DataOptions, stated
from evaluation.datasets.raw_scene import Mask, RawScene
from evaluation.datasets.truths import Light, light_of, number_of, read_rows
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError, first_of

COLUMNS = ("image", "r", "g", "b")
"""What the table must have."""

_PICTURES = (".jpg", ".jpeg", ".webp", ".heic", ".gif", ".bmp")
_RAWS = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef", ".srw", ".crw")
_MOST = 50
"""Tables of a folder whose heads are read to find the one with the lights."""


@dataclass(frozen=True, slots=True)
class OwnScene(RawScene):
    """An image of the user's.

    Attributes
    ----------
    mask_path
        A picture that is not 0 where a pixel must not be used; "" for none.
    """

    mask_path: str = ""

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool, True where the picture of the mask is not 0, of an image (H, W, 3), or None without one.

        Raises
        ------
        FormatError
            The picture cannot be read or is of another size.
        """
        if not self.mask_path:
            return None
        import cv2

        try:
            data = np.fromfile(self.mask_path, np.uint8)
        except OSError as error:
            raise FormatError(f"{self.mask_path} cannot be read: {error.strerror or error}; restore it") from error
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
        if picture is None:
            raise FormatError(f"{self.mask_path} is no picture that can be read; make it again as PNG")
        if picture.shape != image.shape[:2]:
            raise FormatError(
                f"{self.mask_path} is {picture.shape[1]} × {picture.shape[0]}, expected {image.shape[1]} × "
                f"{image.shape[0]} as {self.path}; make it again"
            )
        return np.asarray(picture != 0)


def is_plain_folder(folder: Folder) -> bool:
    """Return whether a folder has a table of images and lights."""
    return bool(_tables(folder))


def open_plain_folder(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the images of a table; they are read when they are used.

    Parameters
    ----------
    place
        The folder with the table, or the table.
    options
        `black` and `saturation` serve images whose levels the table does not give.
    listed
        The names in that folder, where they were read already.

    Raises
    ------
    InputError
        There are several tables.
    FormatError
        There is no table, it is damaged, or an image is missing, named twice or a picture for the eye.
    """
    path = _table_of(Path(place), listed)
    folder = path.parent
    scenes: list[OwnScene] = []
    folds: list[int] = []
    missing: list[str] = []
    seen: set[str] = set()
    given: set[str] = set()
    paths: dict[str, str] = {}
    listings: dict[str, _Listing] = {"": _Listing(listed)} if listed else {}
    for where, row in read_rows(path, COLUMNS):
        name = row["image"].strip()
        if not name or name in seen:
            raise FormatError(f"{where}: the image {name!r} is {'named twice' if name else 'no name'}; correct it")
        seen.add(name)
        image = _find(folder, name, where, listings)
        light = light_of(row, COLUMNS[1:], where)
        if image is None:
            missing.append(name)
            continue
        if (before := paths.setdefault(os.path.normpath(image), name)) != name:
            raise FormatError(f"{where}: {name} is the file of {before} too, expected each image once; take one away")
        given.update(column for column in ("black", "saturation", "mask", "fold") if row.get(column, "").strip())
        scenes.append(_scene(folder, name, image, light, row, where, options))
        folds.append(_fold(row, where))
    if not scenes or (missing and not options.partial):
        remedy = "complete the folder" + (", or take what is there with --partial" if scenes else "")
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(seen)} images of {path.name} "
            f"({first_of(missing) or 'it is empty'}); {remedy}"
        )
    if "fold" in given and min(folds) < 0:
        raise FormatError(f"{path}: some rows have a fold and others none, expected one in each; complete the column")
    return SceneSet(
        name=folder.resolve().name,
        layout="folder",
        place=place,
        scenes=tuple(scenes),
        treatment={
            "images": str(len(scenes)) + (f"; {len(missing)} more of {path.name} are not there" if missing else ""),
            "black level": _stated("black", given, path, options.black, "0: assumed, as neither a column black nor "
            "--black gives it"),
            "saturation": _stated("saturation", given, path, options.saturation, "none: neither a column saturation "
            "nor --saturation gives it, so clipped pixels are used"),
            "mask": f"column mask of {path.name}: where the picture is not 0" if "mask" in given else "none",
            "ground truth": f"r, g, b of {path.name}",
        },
        folds=tuple(folds) if "fold" in given else None,
    )  # fmt: skip


def _stated(column: str, given: set[str], path: Path, option: float | None, otherwise: str) -> str:
    if column in given:
        return f"column {column} of {path.name}" + ("" if option is None else f", {option:g} where it is empty")
    return stated(option, otherwise)


def _table_of(place: Path, listed: Folder | None) -> Path:
    if place.is_file():
        return place
    tables = _tables(listed or Folder(place))
    if not tables:
        raise FormatError(f"{place} has no table with the columns {','.join(COLUMNS)}; write one, a row an image")
    if len(tables) > 1:
        raise InputError(f"{place} has several tables of lights ({first_of(tables)}); name the one that is meant")
    return place / tables[0]


def _tables(folder: Folder) -> list[str]:
    """Return the names of the .csv files of a folder that have the columns of such a table."""
    return list(_with_columns(folder))


def _with_columns(folder: Folder) -> Iterator[str]:
    for name in [name for name in folder.files if name.lower().endswith(".csv")][:_MOST]:
        try:
            with (folder.path / name).open(encoding="utf-8-sig") as file:
                head = [column.strip().strip('"') for column in file.readline().split(",")]
        except (OSError, UnicodeDecodeError):
            continue
        if all(column in head for column in COLUMNS):
            yield name


@dataclass(frozen=True)
class _Listing:
    """The names in a folder, for quick questions."""

    folder: Folder

    @cached_property
    def files(self) -> frozenset[str]:
        return frozenset(self.folder.files if self.folder.path.is_dir() else ())

    @cached_property
    def images(self) -> Mapping[str, str]:
        return self.folder.images(IMAGE_ENDINGS) if self.files else {}


def _find(folder: Path, name: str, where: str, listings: dict[str, _Listing]) -> str | None:
    """Return the path of an image that a table names with or without its ending; None if it is not there."""
    below, _, file = name.rpartition("/")
    ending = f".{file.rpartition('.')[2].lower()}"
    if ending in _PICTURES:
        raise FormatError(
            f"{where}: {name} is a picture for the eye (sRGB), whose values are not proportional to light; expected "
            f"linear camera RGB ({', '.join(IMAGE_ENDINGS)})"
        )
    if ending in _RAWS:
        raise FormatError(
            f"{where}: {name} is a raw file, whose mosaic has yet to be interpolated; make a linear 16-bit file of it, "
            "for instance with dcraw -h -D -4 -T or rawpy, and name that"
        )
    if below not in listings:
        listings[below] = _Listing(Folder(folder / below))
    listing = listings[below]
    if ending in IMAGE_ENDINGS:
        return f"{listing.folder.path}{os.sep}{file}" if file in listing.files else None
    return listing.images.get(file)


def _scene(
    folder: Path, name: str, image: str, light: Light, row: Mapping[str, str], where: str, options: DataOptions
) -> OwnScene:
    black = _level(row, "black", where, options.black)
    white = _level(row, "saturation", where, options.saturation)
    if white is not None and white <= (black or 0):
        raise FormatError(f"{where}: saturation {white:g} is not above black {black or 0:g}; correct it")
    mask = row.get("mask", "").strip()
    if mask and not (folder / mask).is_file():
        raise FormatError(f"{where}: there is no mask {folder / mask}; restore it, or leave the field empty")
    return OwnScene(name, image, light, black or 0.0, white, str(folder / mask) if mask else "")


def _level(row: Mapping[str, str], column: str, where: str, otherwise: float | None) -> float | None:
    text = row.get(column, "").strip()
    if not text:
        return otherwise
    level = number_of(text, where, column)
    if not (np.isfinite(level) and level >= 0):
        raise FormatError(
            f"{where}: {column} is {text}, expected a number from 0, in the units of the file; correct it"
        )
    return level


def _fold(row: Mapping[str, str], where: str) -> int:
    """Return the fold of a row, -1 if it has none."""
    text = row.get("fold", "").strip()
    if text and not text.isdecimal():
        raise FormatError(f"{where}: fold is {text!r}, expected a whole number from 0; correct it")
    return int(text) if text else -1
