"""Read a user's own images: a folder with a table of their ground truths.

Layout::

    gt.csv              image,r,g,b: one row per image; image is a path relative to the table, its ending is optional
                        columns black, saturation: levels of the image, in the units of its file, optional
                        column mask: a picture that is not 0 at pixels that must not be used, optional
                        column fold: whole numbers from 0 for cross-validation, optional
    gt.txt              instead of gt.csv: lines of name r g b, separated by blanks
    photo1.png …        linear camera RGB, red first: PNG or TIFF of 16 bits, TIFF of floats, or NumPy files
    photo1_mask.png     mask of photo1 if column mask is empty, optional

The table may have any name. If several .csv files of the folder have these columns, the path of one must be given. A
.txt is used if no .csv has these columns. Images without a row are refused, so that no image is excluded by mistake.
JPEG and 8-bit sRGB are refused, because their values are not proportional to light.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from evaluation.datasets.files import (
    IMAGE_ENDINGS,
    Folder,
    Light,
    Mask,
    RawScene,
    is_named_light,
    parse_light,
    parse_number,
    read_mask,
    read_named_lights,
    read_rows,
    split_header,
)
from evaluation.datasets.options import DataOptions, level_note
from evaluation.scene import Image, SceneSet
from foundation.compiled import ordered_map, processor_count
from foundation.errors import FormatError, InputError, first_few
from foundation.files import table_encoding
from foundation.names import comparable

COLUMNS = ("image", "r", "g", "b")  # required columns of the table

# Source of the black level if neither the table nor the user gives one.
ASSUMED_BLACK = "0: assumed, because neither a column black nor --read black gives it"

_PICTURES = (".jpg", ".jpeg", ".webp", ".heic", ".gif", ".bmp")
_RAWS = (".cr2", ".cr3", ".nef", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef", ".srw", ".crw")
_MASK_SUFFIX = "_mask"
_MASK_ENDINGS = (".png", ".tif", ".tiff")
_MAX_HEADER_BYTES = 4096  # bytes of a table that are read to find its first line
_INSPECTED_TABLES = 50  # number of tables whose headers are read to find the one with ground truths


@dataclass(frozen=True, slots=True)
class OwnScene(RawScene):
    """Image of the user; `mask_path` is the path of its mask picture, or empty."""

    mask_path: str = ""

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool for an image (H, W, 3), True if the mask picture is not 0; None without a mask."""
        if not self.mask_path:
            return None
        mask = read_mask(self.mask_path)
        if mask.shape != image.shape[:2]:
            raise FormatError(
                f"{self.mask_path} has {mask.shape[1]} × {mask.shape[0]} px, expected {image.shape[1]} × "
                f"{image.shape[0]} like {self.path}; make it again"
            )
        return mask


def is_plain_folder(folder: Folder) -> bool:
    """Return True if a folder has a table of images and ground truths."""
    return bool(_tables(folder))


def open_plain_folder(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of a table; they are read on use."""
    path = _find_table(Path(location), scanned_folder)
    folder = path.parent
    scenes: list[OwnScene] = []
    folds: list[int] = []
    missing: list[str] = []
    first_refusal: str | None = None
    masks: set[str] = set()
    names: set[str] = set()
    given_columns: set[str] = set()
    paths: dict[str, str] = {}
    indices: dict[str, _FolderIndex] = {"": _FolderIndex(scanned_folder)} if scanned_folder else {}
    rows = read_named_lights(path) if _is_text(path.name) else read_rows(path, COLUMNS)
    for origin, row in rows:
        name = row["image"].strip()
        if not name or name in names:
            problem = f"image {name!r} is listed twice, expected once" if name else "no image name, expected one"
            raise FormatError(f"{origin}: {problem}; correct the line")
        names.add(name)
        image = _find_image(folder, name, origin, indices)
        light = parse_light(row, COLUMNS[1:], origin, "correct the line")
        if image is None:
            missing.append(name)
            first_refusal = first_refusal or _unusable_file(folder, name, origin, indices)
            continue
        if (earlier_name := paths.setdefault(os.path.normpath(image), name)) != name:
            raise FormatError(f"{origin}: {name} and {earlier_name} are the same file, expected one row; remove one")
        given_columns.update(name for name in ("black", "saturation", "mask", "fold") if row.get(name, "").strip())
        mask_path = _find_mask(name, image, indices)
        scenes.append(_scene(folder, name, image, mask_path, light, row, origin, options))
        if scenes[-1].mask_path:
            masks.add(os.path.normpath(scenes[-1].mask_path))
        given_columns.update(("mask beside",) if mask_path and scenes[-1].mask_path == mask_path else ())
        folds.append(_parse_fold(row, origin))
    if not scenes or (missing and not options.partial):
        if first_refusal:
            raise FormatError(first_refusal)
        remedy = "complete the folder" + (", or use the existing images with --read partial" if scenes else "")
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(names)} images of {path.name} "
            f"({first_few(missing) or 'it is empty'}); {remedy}"
        )
    if "fold" in given_columns and min(folds) < 0:
        raise FormatError(f"{path}: some rows have a fold, expected a fold in all rows or in none; complete the column")
    if mask_images := sorted(masks & paths.keys()):
        raise FormatError(f"{path}: {first_few(mask_images)} is an image and a mask, expected only one; rename it")
    exclusion_note = _unlisted_note(Path(location), path, indices, paths.keys(), masks, options.partial)
    return SceneSet(
        name=folder.resolve().name,
        layout="folder",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": str(len(scenes))
            + (f"; {len(missing)} of {path.name} are missing and excluded" if missing else "")
            + (f"; {exclusion_note}" if exclusion_note else ""),
            "black level": _level_note("black", given_columns, path, options.black, ASSUMED_BLACK),
            "saturation": _level_note("saturation", given_columns, path, options.saturation, "none: neither a column "
            "saturation nor --read saturation gives it, so clipped pixels are used"),
            "mask": _mask_source(given_columns, path, scenes),
            "ground truth": f"r, g, b of {path.name}",
        },
        folds=tuple(folds) if "fold" in given_columns else None,
    )  # fmt: skip


def _mask_source(given_columns: set[str], path: Path, scenes: Sequence[OwnScene]) -> str:
    sources_by_key = ((f"column mask of {path.name}", "mask"), ("NAME_mask next to the image", "mask beside"))
    sources = " or ".join(text for text, key in sources_by_key if key in given_columns)
    if not sources:
        return "none"
    masked_scenes = [scene for scene in scenes if scene.mask_path]
    # All masks are read before the first image, so that a damaged mask is reported at once.
    masks = ordered_map(lambda scene: read_mask(scene.mask_path), masked_scenes, processor_count())
    counts = [(int(mask.sum()), mask.size) for mask in masks]
    masked, total = (sum(column) for column in zip(*counts, strict=True))
    empty = [scene.name for scene, (count, _) in zip(masked_scenes, counts, strict=True) if not count]
    return (
        f"{sources}: pixels that are not 0; {len(masked_scenes)} of {len(scenes)} images have one, with {masked} "
        f"masked pixels ({100 * masked / total:.3g} %)"
        + (f"; {len(empty)} masks are empty ({first_few(empty)})" if empty else "")
    )


def _level_note(column: str, given_columns: set[str], path: Path, option: float | None, default: str) -> str:
    if column in given_columns:
        return f"column {column} of {path.name}" + ("" if option is None else f", {option:g} if empty")
    return level_note(option, default)


def _find_table(location: Path, scanned_folder: Folder | None) -> Path:
    if location.is_file():
        return location
    tables = _tables(scanned_folder or Folder(location))
    if not tables:
        raise FormatError(f"{location} has no table with the columns {','.join(COLUMNS)}; write one, a row per image")
    if len(tables) > 1:
        raise InputError(
            f"{location} has {len(tables)} tables of ground truths, expected one; give {first_few(tables)}"
        )
    return location / tables[0]


def refuse_unusable_table(folder: Folder) -> None:
    """Raise FormatError if a folder with images has exactly one table, and this table lacks required columns."""
    headers = _headers(folder)
    if len(headers) == 1 and folder.images(IMAGE_ENDINGS):
        ((name, header),) = headers.items()
        missing = [column for column in COLUMNS if column not in _columns(header)]
        raise FormatError(
            f"{folder.path} has no supported layout: for images of your own, {name} lacks the columns "
            f"{','.join(missing)} (its first line: {header.strip()[:80] or 'empty'}), expected {','.join(COLUMNS)}, "
            "separated by commas, semicolons or tabs; correct it, or give another folder"
        )


def _tables(folder: Folder) -> list[str]:
    tables = [name for name, line in _headers(folder).items() if all(column in _columns(line) for column in COLUMNS)]
    return tables or [name for name, line in _headers(folder, (".txt",)).items() if is_named_light(line)]


def _is_text(name: str) -> bool:
    return name.lower().endswith(".txt")


def _headers(folder: Folder, endings: tuple[str, ...] = (".csv",)) -> dict[str, str]:
    headers: dict[str, str] = {}
    for name in [name for name in folder.files if name.lower().endswith(endings)][:_INSPECTED_TABLES]:
        try:
            with (folder.path / name).open("rb") as file:
                start = file.read(_MAX_HEADER_BYTES)
        except OSError:
            continue
        # Bytes that are not UTF-8 are reported when the table is read.
        text = start.decode(table_encoding(start), errors="ignore")
        headers[name] = next((line for line in text.splitlines() if not line.startswith("#")), "")
    return headers


def _columns(header: str) -> list[str]:
    return split_header(header)[0]


@dataclass(frozen=True)
class _FolderIndex:
    """Names in a folder as sets and mappings, for quick look-up."""

    folder: Folder

    @cached_property
    def files(self) -> Mapping[str, str]:
        """Names of the files, by their normal form."""
        return {comparable(name): name for name in self.folder.files} if self.folder.path.is_dir() else {}

    @cached_property
    def images(self) -> Mapping[str, str]:
        return self.folder.images(IMAGE_ENDINGS) if self.files else {}

    @cached_property
    def masks(self) -> Mapping[str, str]:
        """Mask files, by name of their image without ending."""
        mask_files: dict[str, str] = {}
        for endings in (_PICTURES, _MASK_ENDINGS):
            for name in sorted(self.files, reverse=True):
                stem = name.rpartition(".")[0]
                if stem.endswith(_MASK_SUFFIX) and _ending(name) in endings:
                    mask_files[stem[: -len(_MASK_SUFFIX)]] = self.files[name]
        return mask_files

    @cached_property
    def unusable(self) -> Mapping[str, str]:
        """Files of other types than images, by name without ending."""
        return {Path(name).stem: file for name, file in self.files.items() if _ending(file) not in IMAGE_ENDINGS}


def _ending(file: str) -> str:
    return f".{file.rpartition('.')[2].lower()}"


def _find_image(folder: Path, name: str, origin: str, indices: dict[str, _FolderIndex]) -> str | None:
    """Return the path of an image by its name in the table, which may lack the ending; None if it does not exist."""
    parent, _, file = comparable(name).rpartition("/")
    if _ending(file) in (*_PICTURES, *_RAWS):
        raise FormatError(f"{origin}: {name} is {_refusal_reason(file)}")
    if parent not in indices:
        indices[parent] = _FolderIndex(Folder(folder / parent))
    index = indices[parent]
    if file in index.files:
        if _ending(file) in IMAGE_ENDINGS:
            return f"{index.folder.path}{os.sep}{index.files[file]}"
        raise FormatError(f"{origin}: {name} is {_refusal_reason(file)}")
    return index.images.get(file)


def _refusal_reason(file: str) -> str:
    """Return the reason if a file with this ending is not read as an image."""
    if _ending(file) in _PICTURES:
        file_type = "JPEG, " if _ending(file) in (".jpg", ".jpeg") else ""
        return (
            f"{file_type}an sRGB picture, whose values are not proportional to light; expected linear camera RGB "
            f"({', '.join(IMAGE_ENDINGS)}); convert the raw file without gamma, and list that file"
        )
    if _ending(file) in _RAWS:
        return (
            "a raw file with a colour mosaic, expected an image; make a linear 16-bit file of it, for instance with "
            "dcraw -h -D -4 -T, and list that file"
        )
    return (
        f"a file of the type {_ending(file)}, which is not read; expected linear camera RGB "
        f"({', '.join(IMAGE_ENDINGS)}); convert it, and list that file"
    )


def _unusable_file(folder: Path, name: str, origin: str, indices: Mapping[str, _FolderIndex]) -> str | None:
    """Return a message if a missing image exists only as a file that cannot be used, else None."""
    parent, _, file = comparable(name).rpartition("/")
    stem = Path(file).stem if _ending(file) in IMAGE_ENDINGS else file
    file_name = indices[parent].unusable.get(stem)
    return file_name and f"{origin}: {name} exists only as {folder / parent / file_name}: {_refusal_reason(file_name)}"


def _find_mask(name: str, image: str, indices: Mapping[str, _FolderIndex]) -> str:
    index = indices[comparable(name).rpartition("/")[0]]
    file = index.masks.get(comparable(Path(image).stem))
    return f"{index.folder.path}{os.sep}{file}" if file else ""


def _unlisted_note(
    location: Path,
    path: Path,
    indices: Mapping[str, _FolderIndex],
    images: Collection[str],
    masks: Collection[str],
    partial: bool,
) -> str:
    """Return a note on excluded images without a row; an empty string if there are no such images."""
    folders = {file.rpartition(os.sep)[0] or "." for file in images}
    root = Folder(path.parent)
    row_folders = [index.folder for index in indices.values() if index.files]
    near_images: list[str] = []
    elsewhere: list[str] = []
    for folder_path, folder in {os.path.normpath(item.path): item for item in (*row_folders, *root.within(1))}.items():
        names = [name for name in folder.files if _ending(name) in IMAGE_ENDINGS]
        files = [os.path.normpath(f"{folder_path}{os.sep}{name}") for name in names]
        (near_images if folder_path in folders else elsewhere).extend(
            file for file in files if file not in images and file not in masks
        )
    # Unused masks are reported only if there are no other images without a row.
    near_images = [file for file in near_images if not Path(file).stem.endswith(_MASK_SUFFIX)] or near_images
    # A table that the user chose from several may list only some images. In a single table, a missing row is an error.
    is_selection = location.is_file() and len(_tables(root)) > 1
    if near_images and not (partial or is_selection):
        raise FormatError(
            f"{path} has no row for {len(near_images)} images in the folders of its images "
            f"({first_few([os.path.relpath(file, root.path) for file in near_images])}), expected one row each; add "
            "rows, remove the files, or exclude them with --read partial"
        )
    groups = ((near_images, "in the same folders"), (elsewhere, "in other folders"))
    return ", ".join(f"{len(files)} more {note} excluded (no row in {path.name})" for files, note in groups if files)


def _scene(
    folder: Path,
    name: str,
    image: str,
    mask_path: str,
    light: Light,
    row: Mapping[str, str],
    origin: str,
    options: DataOptions,
) -> OwnScene:
    black = _parse_level(row, "black", origin, options.black)
    white = _parse_level(row, "saturation", origin, options.saturation)
    if white is not None and white <= (black or 0):
        raise FormatError(f"{origin}: saturation {white:g}, expected above black {black or 0:g}; correct it")
    mask = row.get("mask", "").strip()
    if mask and not (folder / mask).is_file():
        raise FormatError(f"{origin}: mask {folder / mask} does not exist; restore it, or leave the field empty")
    if not mask and _ending(mask_path) in _PICTURES:
        raise FormatError(f"{origin}: mask {mask_path}, expected {' or '.join(_MASK_ENDINGS)}; make it again as PNG")
    return OwnScene(name, image, light, black or 0.0, white, str(folder / mask) if mask else mask_path)


def _parse_level(row: Mapping[str, str], column: str, origin: str, default: float | None) -> float | None:
    text = row.get(column, "").strip()
    if not text:
        return default
    level = parse_number(text, origin, column)
    if not (np.isfinite(level) and level >= 0):
        raise FormatError(f"{origin}: {column} is {text}, expected 0 or more, in the units of the file; correct it")
    return level


def _parse_fold(row: Mapping[str, str], origin: str) -> int:
    text = row.get("fold", "").strip()
    if text and not text.isdecimal():
        raise FormatError(f"{origin}: fold is {text!r}, expected a whole number from 0; correct it")
    return int(text) if text else -1  # -1: no fold
