"""A user's own images: a folder with a table of their lights.

It lies so::

    gt.csv              image,r,g,b: one row an image; its path from the table's folder, with or without the ending
                        columns black, saturation: levels of the image, in the units of its file, optional
                        column mask: a picture that is not 0 where a pixel must not be used, optional
                        column fold: whole numbers from 0 for cross-validation, optional
    photo1.png …        linear camera RGB, red first: PNG or TIFF of 16 bits, TIFF of floats, or NumPy files
    photo1_mask.png     the mask of photo1 where column mask names none, optional

The table is the folder's only .csv with those columns, or is named itself. An image beside them that has no row is
refused, so that none is left out unseen. Pictures for the eye are refused: JPEG, and
8 bits a channel, are sRGB, whose values are not proportional to light.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from evaluation.datasets.files import IMAGE_ENDINGS, Folder, Light, Mask, RawScene, light_of, number_of, read_rows
from evaluation.datasets.options import DataOptions, stated
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, InputError, first_few

COLUMNS = ("image", "r", "g", "b")  # What the table must have

# What is stated where nothing says what black is.
ASSUMED_BLACK = "0: assumed, as neither a column black nor --read black gives it"

_PICTURES = (".jpg", ".jpeg", ".webp", ".heic", ".gif", ".bmp")
_RAWS = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef", ".srw", ".crw")
_MASK = "_mask"
_MASK_ENDINGS = (".png", ".tif", ".tiff")
_MOST = 50  # Tables of a folder whose heads are read to find the one with the lights


@dataclass(frozen=True, slots=True)
class OwnScene(RawScene):
    """An image of the user's.

    `mask_path`: A picture that is not 0 where a pixel must not be used; "" for none.
    """

    mask_path: str = ""

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool, True where the mask's picture is not 0, of an image (H, W, 3); None without one."""
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
    """Return the images of a table; they are read when they are used."""
    path = _table_of(Path(place), listed)
    folder = path.parent
    scenes: list[OwnScene] = []
    folds: list[int] = []
    missing: list[str] = []
    refused: str | None = None
    masks: set[str] = set()
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
        light = light_of(row, COLUMNS[1:], where, "correct the line")
        if image is None:
            missing.append(name)
            refused = refused or _unusable(folder, name, where, listings)
            continue
        if (before := paths.setdefault(os.path.normpath(image), name)) != name:
            raise FormatError(f"{where}: {name} is the file of {before} too, expected each image once; take one away")
        given.update(column for column in ("black", "saturation", "mask", "fold") if row.get(column, "").strip())
        beside = _mask_beside(name, image, listings)
        scenes.append(_scene(folder, name, image, beside, light, row, where, options))
        if scenes[-1].mask_path:
            masks.add(os.path.normpath(scenes[-1].mask_path))
        given.update(("mask beside",) if beside and scenes[-1].mask_path == beside else ())
        folds.append(_fold(row, where))
    if not scenes or (missing and not options.partial):
        if refused:
            raise FormatError(refused)
        remedy = "complete the folder" + (", or take what is there with --read partial" if scenes else "")
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(seen)} images of {path.name} "
            f"({first_few(missing) or 'it is empty'}); {remedy}"
        )
    if "fold" in given and min(folds) < 0:
        raise FormatError(f"{path}: some rows have a fold and others none, expected one in each; complete the column")
    if both := sorted(masks & paths.keys()):
        raise FormatError(f"{path} has a row for {first_few(both)}, which is a mask too; rename one of the two")
    left_out = _without_row(Path(place), path, listings, paths.keys(), masks, options.partial)
    return SceneSet(
        name=folder.resolve().name,
        layout="folder",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": str(len(scenes))
            + (f"; {len(missing)} more of {path.name} are not there" if missing else "")
            + (f"; {left_out}" if left_out else ""),
            "black level": _stated("black", given, path, options.black, ASSUMED_BLACK),
            "saturation": _stated("saturation", given, path, options.saturation, "none: neither a column saturation "
            "nor --read saturation gives it, so clipped pixels are used"),
            "mask": _mask_stated(given, path, len(masks), len(scenes)),
            "ground truth": f"r, g, b of {path.name}",
        },
        folds=tuple(folds) if "fold" in given else None,
    )  # fmt: skip


def _mask_stated(given: set[str], path: Path, masks: int, count: int) -> str:
    of = ((f"column mask of {path.name}", "mask"), ("NAME_mask beside the image", "mask beside"))
    sources = " or ".join(text for text, key in of if key in given)
    return f"{sources}: where the picture is not 0; {masks} of {count} images have one" if sources else "none"


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
        raise InputError(f"{place} has several tables of lights ({first_few(tables)}); name the one that is meant")
    return place / tables[0]


def require_no_other_table(folder: Folder) -> None:
    """Refuse, by its columns, the one table of a folder beside images that is none of images and lights."""
    heads = _heads(folder)
    if len(heads) == 1 and folder.images(IMAGE_ENDINGS):
        ((name, head),) = heads.items()
        lacking = [column for column in COLUMNS if column not in _columns(head)]
        raise FormatError(
            f"{folder.path} is no dataset of a layout that is known: for images of your own {name} lacks the columns "
            f"{','.join(lacking)} (found: {head.strip()[:80] or 'nothing'}), expected {','.join(COLUMNS)} between "
            "commas in its first line; correct it, or name another folder"
        )


def _tables(folder: Folder) -> list[str]:
    return [name for name, head in _heads(folder).items() if all(column in _columns(head) for column in COLUMNS)]


def _heads(folder: Folder) -> dict[str, str]:
    found: dict[str, str] = {}
    for name in [name for name in folder.files if name.lower().endswith(".csv")][:_MOST]:
        try:
            with (folder.path / name).open(encoding="utf-8-sig") as file:
                found[name] = file.readline()
        except (OSError, UnicodeDecodeError):
            continue
    return found


def _columns(head: str) -> list[str]:
    return [column.strip().strip('"') for column in head.split(",")]


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

    @cached_property
    def masks(self) -> Mapping[str, str]:
        """Files that are masks by their names, by the names of the images that they belong to, without ending."""
        found: dict[str, str] = {}
        for known in (_PICTURES, _MASK_ENDINGS):
            for file in sorted(self.files, reverse=True):
                stem = file.rpartition(".")[0]
                if stem.endswith(_MASK) and _ending(file) in known:
                    found[stem[: -len(_MASK)]] = file
        return found

    @cached_property
    def unusable(self) -> Mapping[str, str]:
        """Pictures for the eye and raw files by their names without ending."""
        return {Path(file).stem: file for file in self.files if _ending(file) in (*_PICTURES, *_RAWS)}


def _ending(file: str) -> str:
    return f".{file.rpartition('.')[2].lower()}"


def _find(folder: Path, name: str, where: str, listings: dict[str, _Listing]) -> str | None:
    """Return the path of an image that a table names with or without its ending; None if it is not there."""
    below, _, file = name.rpartition("/")
    if why := _no_image(file):
        raise FormatError(f"{where}: {name} is {why}")
    if below not in listings:
        listings[below] = _Listing(Folder(folder / below))
    listing = listings[below]
    if _ending(file) in IMAGE_ENDINGS:
        return f"{listing.folder.path}{os.sep}{file}" if file in listing.files else None
    return listing.images.get(file)


def _no_image(file: str) -> str:
    """Return why a file of that name holds no linear camera RGB; "" if it may."""
    if _ending(file) in _PICTURES:
        kind = "JPEG, " if _ending(file) in (".jpg", ".jpeg") else ""
        return (
            f"{kind}a picture for the eye (sRGB), whose values are not proportional to light; expected linear camera "
            f"RGB ({', '.join(IMAGE_ENDINGS)})"
        )
    if _ending(file) in _RAWS:
        return (
            "a raw file, whose mosaic has yet to be interpolated; make a linear 16-bit file of it, for instance with "
            "dcraw -h -D -4 -T, and name that"
        )
    return ""


def _unusable(folder: Path, name: str, where: str, listings: Mapping[str, _Listing]) -> str | None:
    """Return why a file that has the name of a missing image is refused; None if there is no such file."""
    below, _, file = name.rpartition("/")
    stem = Path(file).stem if _ending(file) in IMAGE_ENDINGS else file
    found = listings[below].unusable.get(stem)
    return found and f"{where}: of {name} there is only {folder / below / found}: {_no_image(found)}"


def _mask_beside(name: str, image: str, listings: Mapping[str, _Listing]) -> str:
    """Return the path of the mask that belongs to an image by its name; "" if there is none."""
    listing = listings[name.rpartition("/")[0]]
    file = listing.masks.get(Path(image).stem)
    return f"{listing.folder.path}{os.sep}{file}" if file else ""


def _without_row(
    place: Path,
    path: Path,
    listings: Mapping[str, _Listing],
    images: Collection[str],
    masks: Collection[str],
    partial: bool,
) -> str:
    """Return a sentence on the images that the table does not name; "" if there are none.

    Where a table was named and has others beside it, it is a choice of the images; else one without a row is an error.
    """
    folders = {file.rpartition(os.sep)[0] or "." for file in images}
    root = Folder(path.parent)
    looked_at = [listing.folder for listing in listings.values() if listing.files]
    among: list[str] = []
    elsewhere: list[str] = []
    for folder in {os.path.normpath(each.path): each for each in (*looked_at, *root.within(1))}.values():
        at = os.path.normpath(folder.path)
        files = [os.path.normpath(f"{at}{os.sep}{file}") for file in folder.files if _ending(file) in IMAGE_ENDINGS]
        (among if at in folders else elsewhere).extend(
            file for file in files if file not in images and file not in masks
        )
    # A mask without a row is its image's affair, unless it lies there alone.
    among = [file for file in among if not Path(file).stem.endswith(_MASK)] or among
    chosen = place.is_file() and len(_tables(root)) > 1
    if among and not (partial or chosen):
        raise FormatError(
            f"{path} has no row for {len(among)} of the images beside those that it names "
            f"({first_few([os.path.relpath(file, root.path) for file in among])}), expected one for each; add what is "
            "missing, take the files away, or leave them out with --read partial"
        )
    notes = ((among, "beside them"), (elsewhere, "in other folders there"))
    return ", ".join(f"{len(files)} {what} without a row in {path.name} left out" for files, what in notes if files)


def _scene(
    folder: Path,
    name: str,
    image: str,
    beside: str,
    light: Light,
    row: Mapping[str, str],
    where: str,
    options: DataOptions,
) -> OwnScene:
    black = _level(row, "black", where, options.black)
    white = _level(row, "saturation", where, options.saturation)
    if white is not None and white <= (black or 0):
        raise FormatError(f"{where}: saturation {white:g} is not above black {black or 0:g}; correct it")
    mask = row.get("mask", "").strip()
    if mask and not (folder / mask).is_file():
        raise FormatError(f"{where}: there is no mask {folder / mask}; restore it, or leave the field empty")
    if not mask and _ending(beside) in _PICTURES:
        raise FormatError(f"{where}: the mask {beside} is no {' or '.join(_MASK_ENDINGS)}; make it again as PNG")
    return OwnScene(name, image, light, black or 0.0, white, str(folder / mask) if mask else beside)


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
