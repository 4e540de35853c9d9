"""What data sets on a disk are made of: folders of files, lights as text and tables, and images of camera RGB.

Names are looked at before any file is opened: whether those are there that should be. An image is read when it is used:
black subtracted, red first, its mask beside it. Data sets keep such images as PNG, TIFF or NumPy files of 16 bits or
more a channel. Decoders that refuse what is truncated read them; pictures for the eye (JPEG, 8-bit sRGB) are refused,
since their values are not linear.
"""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image
from foundation import files
from foundation.errors import FormatError, InputError, first_few
from generator.files import decode_png, decode_tiff

IMAGE_ENDINGS = (".png", ".tif", ".tiff", ".npy")  # Of files that hold linear images of 16 bits or more


@dataclass(frozen=True)
class Folder:
    """The names in a folder, read once; hidden files, such as those that systems leave behind, are not seen."""

    path: Path

    @cached_property
    def _entries(self) -> tuple[list[str], list[str]]:
        files: list[str] = []
        folders: list[str] = []
        try:
            with os.scandir(self.path) as found:
                for entry in found:
                    if not entry.name.startswith("."):
                        (folders if entry.is_dir() else files).append(entry.name)
        except OSError as error:
            raise FormatError(f"{self.path} cannot be read: {error.strerror or error}; name a folder") from error
        return files, folders

    @cached_property
    def files(self) -> Sequence[str]:
        """The names of its files, sorted."""
        return sorted(self._entries[0])

    @cached_property
    def folders(self) -> Mapping[str, Folder]:
        """The folders in it by their names, numbers in them by their value."""
        return {name: Folder(self.path / name) for name in in_natural_order(self._entries[1])}

    def has(self, name: str) -> bool:
        """Return whether a file of that name is in it."""
        return (self.path / name).is_file()

    def within(self, depth: int) -> Iterator[Folder]:
        """Yield this folder and those below it, down to `depth` folders deep."""
        yield self
        if depth:
            for folder in self.folders.values():
                yield from folder.within(depth - 1)

    def images(self, endings: Collection[str] = (".png",)) -> dict[str, str]:
        """Return the paths of its images by their names without ending, in natural order."""
        found: dict[str, str] = {}
        for name in self.files:
            stem, _, ending = name.rpartition(".")
            if f".{ending.lower()}" in endings:
                if stem in found:
                    raise FormatError(
                        f"{self.path} has {name} and {Path(found[stem]).name}, expected one file an image; remove one"
                    )
                found[stem] = f"{self.path}{os.sep}{name}"
        return {stem: found[stem] for stem in in_natural_order(found)}


def gather(folders: Iterable[Folder], endings: Collection[str] = (".png",)) -> dict[str, str]:
    """Return the paths of the images in several folders by their names without ending."""
    found: dict[str, str] = {}
    for folder in folders:
        images = folder.images(endings)
        twice = next((name for name in images if name in found), None)
        if twice is not None:
            raise FormatError(
                f"{images[twice]} and {found[twice]} are both there, expected each image once; remove one"
            )
        found |= images
    return found


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Return names sorted so that numbers in them go by their values.

    Examples
    --------
    >>> in_natural_order(["a10", "10", "9", "a2"])
    ['9', '10', 'a2', 'a10']
    """
    given = list(names)
    if len({name.translate(_DIGITS) for name in given}) <= 1:
        return sorted(given)  # Numbers of as many digits in the same places: a million names in a second.
    return sorted(given, key=natural)


_DIGITS = str.maketrans("0123456789", "0" * 10)


def natural(name: str) -> list[str | int]:
    """Return what sorts names with numbers by the numbers' values.

    Examples
    --------
    >>> sorted(["a10", "10.png", "9.png", "a2"], key=natural)
    ['9.png', '10.png', 'a2', 'a10']
    """
    parts: list[str | int] = list(re.split(r"([0-9]+)", name))  # Text and digits in turn, text first.
    parts[1::2] = [int(digits) for digits in parts[1::2]]
    return parts


def present(
    names: Sequence[str], images: Mapping[str, str], source: str, folder: Path | str, partial: bool
) -> tuple[list[int], str]:
    """Return which of the images that a data set should have are there, and a sentence on their number.

    Examples
    --------
    >>> present(["1", "2"], {"2": "set/2.png"}, "gt.txt", Path("set"), partial=True)
    ([1], '1; 1 of the 2 of gt.txt is not in this copy and left out')
    """
    wanted = set(names)
    if len(wanted) != len(names):
        seen: set[str] = set()
        twice = next(name for name in names if name in seen or seen.add(name))
        raise FormatError(f"{source} names {twice} twice, expected each image once; correct it")
    missing = [name for name in names if name not in images]
    superfluous = [name for name in images if name not in wanted]
    if superfluous:
        raise FormatError(
            f"{folder} has {len(superfluous)} images that {source} does not know ({first_few(superfluous)}), expected "
            f"its {len(names)} and no other; remove them, or complete {source}"
        )
    if missing and (not partial or len(missing) == len(names)):
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(names)} images of {source} ({first_few(missing)}); complete "
            "the copy" + ("" if len(missing) == len(names) else ", or take what is there with --read partial")
        )
    kept = [number for number, name in enumerate(names) if name in images]
    note = str(len(kept))
    if missing:
        note += (
            f"; {len(missing)} of the {len(names)} of {source} {'is' if len(missing) == 1 else 'are'} not in this "
            "copy and left out"
        )
    return kept, note


Light = tuple[float, float, float]  # Linear camera RGB of a light, of any length


def check_light(values: Sequence[float], where: str, remedy: str = "restore the file") -> Light:
    """Return a light, after checking that it is one."""
    if len(values) != 3 or not all(map(math.isfinite, values)) or min(values) < 0 or not any(values):
        raise FormatError(
            f"{where}: {' '.join(f'{value:g}' for value in values) or 'nothing'} is no light, expected red, green and "
            f"blue, none below 0 and not all 0; {remedy}"
        )
    red, green, blue = values
    return float(red), float(green), float(blue)


def read_text(path: Path | str) -> str:
    """Return the content of a text file of a data set."""
    return files.read_text(Path(path), "restore it from the data set's archive")


def numbers_in(text: str, where: str) -> list[float]:
    """Return the numbers in a text, between blanks, commas or line ends.

    Examples
    --------
    >>> numbers_in("0.5, 0.75 1e-2", "gt.txt, line 1")
    [0.5, 0.75, 0.01]
    """
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError as error:
        raise FormatError(f"{where}: {text.strip()!r} is not made of numbers; restore the file") from error


def read_lights(path: Path) -> list[Light]:
    """Return the lights of a file that has one a line, red, green, blue; empty lines at its end do not count."""
    lines = read_text(path).rstrip().splitlines()
    return [
        check_light(numbers_in(line, f"{path}, line {number}"), f"{path}, line {number}")
        for number, line in enumerate(lines, 1)
    ]


def read_light(path: Path | str) -> Light:
    """Return the light of a file that holds one, on one line or three."""
    return check_light(numbers_in(read_text(path), str(path)), str(path))


def read_rows(path: Path, needed: Sequence[str]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the rows of a table, each with its place for messages."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file, skipinitialspace=True)
            head = [name.strip() for name in next(rows, list[str]())]
            lacking = [name for name in needed if name not in head]
            if lacking:
                raise FormatError(
                    f"{path} has the columns {','.join(head) or 'of an empty file'}, expected "
                    f"{','.join(needed)} among them; {','.join(lacking)} is missing"
                )
            twice = [name for name in needed if head.count(name) > 1]
            if twice:
                raise FormatError(f"{path} has two columns {twice[0]!r}, expected each once; take one away")
            for row in rows:
                where = f"{path}, line {rows.line_num}"
                if not row:
                    continue
                if len(row) != len(head):
                    raise FormatError(f"{where} has {len(row)} fields, expected {len(head)} as its head; correct it")
                yield where, dict(zip(head, row, strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FormatError(f"{path} cannot be read: {reason}; restore it") from error


def light_of(row: Mapping[str, str], columns: Sequence[str], where: str, remedy: str = "restore the file") -> Light:
    """Return the light in three columns of a row; `remedy` is what to do where it is none."""
    return check_light([number_of(row[column], where, column) for column in columns], where, remedy)


def number_of(text: str, where: str, column: str) -> float:
    """Return a field as a number."""
    try:
        return float(text)
    except ValueError as error:
        raise FormatError(f"{where}: {column} is {text!r}, expected a number; correct it") from error


Mask = npt.NDArray[np.bool_]  # (H, W), True where a pixel must not be used


@dataclass(frozen=True, slots=True)
class RawScene:
    """An image in a file, with its levels; a layout with a mask has a subclass.

    - `name`: the image's name, unique in its data set.
    - `light`: linear camera RGB of the light, of any length; or the path of its text file, read when it is asked for.
    - `black`: black level, in the units of the file.
    - `white`: value from which a pixel is clipped, in the units of the file, black not subtracted; None if none is.
    """

    name: str
    path: str
    light: Light | str
    black: float
    white: float | None

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB of any length."""
        return np.array(read_light(self.light) if isinstance(self.light, str) else self.light)

    @property
    def saturation(self) -> float | None:
        """Value from which a pixel is clipped, in the units that `read` gives: black is subtracted from it too."""
        return None if self.white is None else self.white - self.black

    def read(self) -> tuple[Image, Mask | None]:
        """Return the image (H, W, 3), linear camera RGB with black at 0, and its mask (H, W) bool or None."""
        image = subtract_black(self.decoded(), self.black)
        return image, self.mask(image)

    def decoded(self) -> Image:
        """Return the image (H, W, 3) as the file's numbers are."""
        return decode_image(self.path)

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool, True where a pixel of the image (H, W, 3) must not be used, or None if none is masked."""
        del image
        return None


def require_above_black(scenes: Iterable[RawScene]) -> None:
    """Refuse black levels that no pixel of any image is above; of levels that fit, one image is read as a rule."""
    highest: list[tuple[float, RawScene]] = []
    for scene in scenes:
        try:
            highest.append((float(scene.decoded().max()), scene))
        except FormatError:
            return  # An image that cannot be read is told where it is used.
        if highest[-1][0] > scene.black:
            return
    if highest:
        value, scene = max(highest, key=lambda one: one[0])
        raise InputError(
            f"black level {scene.black:g} is above every pixel of all {len(highest)} images, whose largest value is "
            f"{value:g} ({scene.path}); give the level in their units, by --read black=LEVEL or the column black"
        )


_LOOKED_AT = 16  # Images that are looked at for a black level that was not subtracted

# Share of an image's largest value that some pixel of it is below; pedestals of cameras are 3 % of saturation or
# more, and of usual exposures a larger share.
_NEAR_BLACK = 0.01


def pedestal_note(scenes: Sequence[RawScene]) -> str:
    """Return what is said where no pixel comes near 0, as if black were in it; "" where one does."""
    least: list[float] = []
    for scene in scenes[:: -(-len(scenes) // _LOOKED_AT)]:
        try:
            image, mask = scene.read()
        except FormatError:
            return ""
        used = image if mask is None else image[~mask]
        if not used.size or used.min() <= _NEAR_BLACK * used.max():
            return ""
        least.append(float(used.min()))
    looked = "the image" if len(least) == 1 else f"{len(least)} images looked at"
    return f"; but no pixel of {looked} is below {min(least):g}: black may be left in; give it with --read black=LEVEL"


@dataclass(frozen=True, slots=True)
class PaintedScene(RawScene):
    """An image whose pixels that are zero in every channel are masked: so charts and faces are painted over."""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True where every channel of the image (H, W, 3) is zero."""
        return np.asarray((image[..., 0] == 0) & (image[..., 1] == 0) & (image[..., 2] == 0))


def box_mask(shape: tuple[int, int], rows: slice, columns: slice) -> Mask:
    """Return a mask (H, W) bool of that shape, True in a box.

    Examples
    --------
    >>> box_mask((2, 3), slice(1, None), slice(0, 2)).astype(int)
    array([[0, 0, 0],
           [1, 1, 0]])
    """
    mask = np.zeros(shape, dtype=bool)
    mask[rows, columns] = True
    return mask


def chart_mask(shape: tuple[int, int], corners: npt.NDArray[np.float64], path: str) -> Mask:
    """Return a mask (H, W) bool of that shape, True in and on a chart; a FormatError where corners are far outside.

    `corners`: (N, 2) float64, x then y, px, pixel centres at integers; rounded to whole pixels. `path`: of the image
    or of the corners.

    Examples
    --------
    >>> chart_mask((3, 4), np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.2], [1.0, 1.2]]), "a.png").astype(int)
    array([[0, 1, 1, 0],
           [0, 1, 1, 0],
           [0, 0, 0, 0]])
    """
    import cv2

    # The drawing of a line takes as long as the line is, and what does not fit into 32 bits wraps round.
    if not (np.abs(corners) < 2 * max(shape)).all():
        raise FormatError(
            f"the chart of {path} has the corners {corners.tolist()}, far outside of an image of {shape[1]} × "
            f"{shape[0]}; restore them from the data set's archive"
        )
    mask = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], (1,))
    return np.asarray(mask, dtype=bool)


def subtract_black(image: Image, black: float) -> Image:
    """Return an image (H, W, 3) with a black level subtracted, 0 where it was below; the image given is used up.

    It stays uint16 where the level is whole, and becomes float32 where it is not; float images keep their dtype.

    Examples
    --------
    >>> subtract_black(np.array([[[2047, 2048, 2050]]], np.uint16), 2048)
    array([[[0, 0, 2]]], dtype=uint16)
    """
    import cv2

    if image.dtype == np.uint16 and not float(black).is_integer():
        image = image.astype(np.float32)
    if black:
        if not image.flags.c_contiguous:
            # A TIFF may hold a plane a channel, which OpenCV does not write to.
            image = image.copy(order="C")
        cv2.subtract(image, np.array([black, black, black, 0.0]), dst=image)  # Saturates at 0 in integers.
    return image if image.dtype == np.uint16 else np.maximum(image, 0, out=image)


def decode_image(path: str, eight_bits: bool = False) -> Image:
    """Return the image (H, W, 3) of a file as its numbers are, red first: uint16, float32 or float64.

    `eight_bits`: whether 8 bits a channel are taken, as uint16 of the same values.
    """
    image = _values(path)
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise FormatError(f"{path} holds an image {image.shape}, expected (height, width, 3): linear camera RGB")
    if image.dtype == np.uint8:
        if not eight_bits:
            raise FormatError(
                f"{path} has 8 bits a channel, as pictures for the eye (sRGB) have, expected linear camera RGB of 16 "
                "bits; make a linear TIFF of the raw file with dcraw -h -D -4 -T, which neither balances white nor "
                "subtracts black: its black level is for you to give"
            )
        return image.astype(np.uint16)
    if image.dtype.name not in ("uint16", "float32", "float64"):
        raise FormatError(f"{path} holds {image.dtype}, expected uint16, float32 or float64")
    if image.dtype != np.uint16 and not np.isfinite(image).all():
        raise FormatError(f"{path} has values that are not finite, expected linear camera RGB; make it again")
    return image


def _values(path: str) -> npt.NDArray[Any]:
    ending = Path(path).suffix.lower()
    try:
        if ending == ".npy":
            return np.asarray(np.load(path, allow_pickle=False))
        data = Path(path).read_bytes()
        if ending == ".png":
            return decode_png(data)
        if ending in (".tif", ".tiff"):
            return decode_tiff(data)
    except Exception as error:
        reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        raise FormatError(f"{path} cannot be read: {reason or type(error).__name__}; restore it") from error
    raise FormatError(f"{path} ends in {ending!r}, expected .png, .tif, .tiff or .npy: linear camera RGB of 16 bits")
