"""Read file names, ground truths and linear images of data sets from a disk.

File names are checked before any file is opened, and images are read on use. Images are PNG, TIFF or NumPy files with
16 bits or more per channel. Truncated files are refused. JPEG and 8-bit sRGB are also refused, because their values are
not linear.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image
from foundation import files
from foundation.arrays import native
from foundation.errors import FormatError, InputError, first_few
from foundation.names import comparable, in_natural_order
from generator.files import decode_png, decode_tiff, read_native, require_plausible

IMAGE_ENDINGS = (".png", ".tif", ".tiff", ".npy")  # file types of linear images with 16 bits or more


@dataclass(frozen=True)
class Folder:
    """Names in a folder, read once. Hidden files are ignored, because operating systems create them."""

    path: Path

    @cached_property
    def _names(self) -> tuple[list[str], list[str]]:
        files: list[str] = []
        folders: list[str] = []
        try:
            with os.scandir(self.path) as scanned_entries:
                for entry in scanned_entries:
                    if not entry.name.startswith("."):
                        (folders if entry.is_dir() else files).append(entry.name)
        except OSError as error:
            raise FormatError(f"{self.path} cannot be read: {error.strerror or error}; name a folder") from error
        return files, folders

    @cached_property
    def files(self) -> Sequence[str]:
        """Sorted names of the files."""
        return sorted(self._names[0])

    @cached_property
    def folders(self) -> Mapping[str, Folder]:
        """Subfolders by name, in natural order."""
        return {name: Folder(self.path / name) for name in in_natural_order(self._names[1])}

    def has(self, name: str) -> bool:
        """Return True if the folder has a file of this name."""
        return (self.path / name).is_file()

    def within(self, depth: int) -> Iterator[Folder]:
        """Yield this folder and its subfolders down to `depth` levels."""
        yield self
        if depth:
            for folder in self.folders.values():
                yield from folder.within(depth - 1)

    def images(self, endings: Collection[str] = (".png",)) -> dict[str, str]:
        """Return the paths of the images by name without ending, in natural order."""
        paths: dict[str, str] = {}
        for name in self.files:
            stem, _, ending = name.rpartition(".")
            if f".{ending.lower()}" in endings:
                stem = comparable(stem)
                if stem in paths:
                    raise FormatError(
                        f"{self.path} has {name} and {Path(paths[stem]).name}, expected one file per image; remove one"
                    )
                paths[stem] = f"{self.path}{os.sep}{name}"
        return {stem: paths[stem] for stem in in_natural_order(paths)}


def gather_images(folders: Iterable[Folder], endings: Collection[str] = (".png",)) -> dict[str, str]:
    """Return the paths of the images in several folders by name without ending."""
    paths: dict[str, str] = {}
    for folder in folders:
        images = folder.images(endings)
        duplicate = next((name for name in images if name in paths), None)
        if duplicate is not None:
            raise FormatError(
                f"{images[duplicate]} and {paths[duplicate]} have the same name, expected each image once; remove one"
            )
        paths |= images
    return paths


def match_images(
    names: Sequence[str], images: Mapping[str, str], source: str, folder: Path | str, partial: bool
) -> tuple[list[int], str]:
    """Return the indices of the listed `names` that exist in `images`, and a note on their number.

    `source` and `folder` are used in messages: the name of the list, and the place of the images. If `partial`, missing
    images are allowed.

    Examples
    --------
    >>> match_images(["1", "2"], {"2": "set/2.png"}, "gt.txt", Path("set"), partial=True)
    ([1], '1; 1 of the 2 images of gt.txt is missing and excluded')
    """
    names = [comparable(name) for name in names]
    expected_names = set(names)
    if len(expected_names) != len(names):
        seen_names: set[str] = set()
        duplicate = next(name for name in names if name in seen_names or seen_names.add(name))
        raise FormatError(f"{source} names {duplicate} twice, expected each image once; correct it")
    missing = [name for name in names if name not in images]
    unlisted = [name for name in images if name not in expected_names]
    if unlisted:
        raise FormatError(
            f"{folder} has {len(unlisted)} images that are not in {source} ({first_few(unlisted)}), expected only its "
            f"{len(names)}; remove them, or complete {source}"
        )
    if missing and (not partial or len(missing) == len(names)):
        raise FormatError(
            f"{folder} lacks {len(missing)} of the {len(names)} images of {source} ({first_few(missing)}); complete "
            "the copy" + ("" if len(missing) == len(names) else ", or use the existing images with --read partial")
        )
    indices = [index for index, name in enumerate(names) if name in images]
    note = str(len(indices))
    if missing:
        note += (
            f"; {len(missing)} of the {len(names)} images of {source} {'is' if len(missing) == 1 else 'are'} missing "
            "and excluded"
        )
    return indices, note


Light = tuple[float, float, float]  # linear camera RGB of an illuminant, any length


def check_light(values: Sequence[float], origin: str, remedy: str = "restore the file") -> Light:
    """Return three values as an illuminant; raise FormatError if they are not an illuminant."""
    if len(values) != 3 or not all(map(math.isfinite, values)) or min(values) < 0 or not any(values):
        raise FormatError(
            f"{origin}: the illuminant is {' '.join(f'{value:g}' for value in values) or 'empty'}, expected red, green "
            f"and blue, each 0 or more and at least one above 0; {remedy}"
        )
    red, green, blue = values
    return float(red), float(green), float(blue)


def read_text(path: Path | str) -> str:
    """Return the content of a text file."""
    return files.read_text(Path(path), "restore it from the data set's archive")


def to_numbers(text: str, origin: str) -> list[float]:
    """Return the numbers in a text, separated by blanks, commas or line ends.

    Examples
    --------
    >>> to_numbers("0.5, 0.75 1e-2", "gt.txt, line 1")
    [0.5, 0.75, 0.01]
    """
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError as error:
        raise FormatError(f"{origin}: {text.strip()!r} was read, expected numbers; restore the file") from error


def read_lights(path: Path) -> list[Light]:
    """Return the illuminants of a text file: red, green, blue in each line; empty lines at the end are ignored."""
    lines = read_text(path).rstrip().splitlines()
    return [
        check_light(to_numbers(line, f"{path}, line {number}"), f"{path}, line {number}")
        for number, line in enumerate(lines, 1)
    ]


def read_light(path: Path | str) -> Light:
    """Return the illuminant of a text file with three numbers, on one line or on three."""
    return check_light(to_numbers(read_text(path), str(path)), str(path))


def split_header(line: str) -> tuple[list[str], str]:
    """Return the column names in the first line of a table and its separator: comma, semicolon or tab."""
    separator = max(",;\t", key=line.count)
    return [name.strip().strip('"') for name in line.split(separator)], separator


def read_rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield for each row of a table a text for messages with file and line number, and the fields by column."""
    lines = files.read_text(path, "restore it", is_table=True).splitlines()
    header, separator = split_header(lines[0] if lines else "")
    missing = [name for name in columns if name not in header]
    if missing:
        raise FormatError(
            f"{path} has the columns {','.join(header) or 'of an empty file'}, expected {','.join(columns)} among "
            f"them; {','.join(missing)} is missing"
        )
    duplicates = [name for name in columns if header.count(name) > 1]
    if duplicates:
        raise FormatError(f"{path} has two columns {duplicates[0]!r}, expected each once; remove one")
    rows = csv.reader(lines[1:], delimiter=separator, skipinitialspace=True)
    try:
        for row in rows:
            origin = f"{path}, line {rows.line_num + 1}"
            if not row:
                continue
            if len(row) != len(header):
                raise FormatError(f"{origin} has {len(row)} fields, expected {len(header)}; correct it")
            yield origin, dict(zip(header, row, strict=True))
    except csv.Error as error:
        raise FormatError(f"{path} cannot be read: {error}; restore it") from error


_NAMED_COLUMNS = ("image", "r", "g", "b")  # of a line in a text file of named ground truths


def is_named_light(line: str) -> bool:
    """Return True if a line of text has a name and three numbers, separated by blanks.

    Examples
    --------
    >>> is_named_light("my photo.png 0.2 0.5 0.3"), is_named_light("0.2 0.5 0.3")
    (True, False)
    """
    words = line.rsplit(maxsplit=3)
    try:
        return len(words) == 4 and all(math.isfinite(float(word)) for word in words[1:])
    except ValueError:
        return False


def read_named_lights(path: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the lines `name r g b` of a text file as `read_rows` yields rows; empty lines and `#` lines are ignored."""
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            if not is_named_light(line):
                raise FormatError(
                    f"{path}, line {number}: {line[:80]!r}, expected a name and three numbers, separated by blanks; "
                    "correct the line"
                )
            yield f"{path}, line {number}", dict(zip(_NAMED_COLUMNS, line.rsplit(maxsplit=3), strict=True))


def parse_light(row: Mapping[str, str], columns: Sequence[str], origin: str, remedy: str = "restore the file") -> Light:
    """Return the illuminant in three columns of a row; `remedy` ends the message if the values are wrong."""
    return check_light([parse_number(row[column], origin, column) for column in columns], origin, remedy)


def parse_number(text: str, origin: str, column: str) -> float:
    """Return the number in a field of a table."""
    try:
        return float(text)
    except ValueError as error:
        raise FormatError(f"{origin}: {column} is {text!r}, expected a number; correct it") from error


Mask = npt.NDArray[np.bool_]  # (H, W), True for pixels that must not be used


@dataclass(frozen=True, slots=True)
class RawScene:
    """Image in a file, with its black and saturation levels. Layouts with masks define subclasses.

    - `name`: name of the image, unique in its data set.
    - `path`: path of the image file.
    - `light`: linear camera RGB of the illuminant, any length; or the path of its text file, read on use.
    - `black`: black level in the units of the file.
    - `white`: saturation level in the units of the file, before black is subtracted; None if no pixel is clipped.
    """

    name: str
    path: str
    light: Light | str
    black: float
    white: float | None

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth (3,) float64, linear camera RGB of any scale."""
        return np.array(read_light(self.light) if isinstance(self.light, str) else self.light)

    @property
    def saturation(self) -> float | None:
        """Saturation level of the image that `read` returns, so minus black level; None if no pixel is clipped."""
        return None if self.white is None else self.white - self.black

    def read(self) -> tuple[Image, Mask | None]:
        """Return the image (H, W, 3), linear camera RGB minus black level, and its mask (H, W) bool or None."""
        image = subtract_black(self.decode(), self.black)
        return image, self.mask(image)

    def decode(self) -> Image:
        """Return the unchanged values of the file, (H, W, 3)."""
        return decode_image(self.path)

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool, True for pixels of the image (H, W, 3) that must not be used; None if all are usable."""
        del image
        return None


def require_black_below_peak(scenes: Iterable[RawScene]) -> None:
    """Raise InputError if the black level is not below the largest value of all images."""
    peaks: list[tuple[float, RawScene]] = []
    for scene in scenes:
        try:
            peaks.append((float(scene.decode().max()), scene))
        except FormatError:
            return  # An unreadable image is reported when it is used.
        if peaks[-1][0] > scene.black:
            return  # If the level is correct, usually only one image is read.
    if peaks:
        peak_value, scene = max(peaks, key=lambda peak: peak[0])
        raise InputError(
            f"black level {scene.black:g}, expected below the largest value of the {len(peaks)} images, {peak_value:g} "
            f"({scene.path}); give the level in the units of the files, by --read black=LEVEL or the column black"
        )


_INSPECTED_IMAGES = 16  # largest number of images that `black_level_warning` reads

# If black was subtracted, an image has pixels below this fraction of its largest value. Black levels of cameras are 3 %
# of saturation or more.
_NEAR_BLACK_SHARE = 0.01


def black_level_warning(scenes: Sequence[RawScene]) -> str:
    """Return a warning if no pixel is near 0, because black was probably not subtracted; else an empty string."""
    minima: list[float] = []
    for scene in scenes[:: -(-len(scenes) // _INSPECTED_IMAGES)]:
        try:
            image, mask = scene.read()
        except FormatError:
            return ""
        usable = image if mask is None else image[~mask]
        if not usable.size or usable.min() <= _NEAR_BLACK_SHARE * usable.max():
            return ""
        minima.append(float(usable.min()))
    inspected = "the image" if len(minima) == 1 else f"the {len(minima)} inspected images"
    return f"; but the smallest value of {inspected} is {min(minima):g}, expected 0; give --read black=LEVEL"


@dataclass(frozen=True, slots=True)
class ZeroMaskedScene(RawScene):
    """Image whose charts or faces are painted over with zeros; pixels that are zero in every channel are masked."""

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True if all channels of the image (H, W, 3) are zero."""
        return np.asarray((image[..., 0] == 0) & (image[..., 1] == 0) & (image[..., 2] == 0))


def box_mask(shape: tuple[int, int], rows: slice, columns: slice) -> Mask:
    """Return a mask (H, W) bool that is True in a rectangle.

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
    """Return a mask (H, W) bool that is True inside and on the outline of a chart.

    `corners` are (N, 2) float64, x then y, px, with pixel centres at integers; they are rounded to whole pixels.

    Examples
    --------
    >>> chart_mask((3, 4), np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.2], [1.0, 1.2]]), "a.png").astype(int)
    array([[0, 1, 1, 0],
           [0, 1, 1, 0],
           [0, 0, 0, 0]])
    """
    import cv2

    # Drawing to distant corners takes long, and corners beyond 32 bits overflow.
    if not (np.abs(corners) < 2 * max(shape)).all():
        raise FormatError(
            f"the chart of {path} has the corners {corners.tolist()}, expected corners in the image of "
            f"{shape[1]} × {shape[0]} px; restore them from the data set's archive"
        )
    mask = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], (1,))
    return np.asarray(mask, dtype=bool)


def subtract_black(image: Image, black: float) -> Image:
    """Return an image (H, W, 3) minus black level, clipped at 0; the input may be overwritten.

    uint16 images become float32 if the level is not a whole number; float images keep their dtype.

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
            # The array of a TIFF with one plane per channel is not contiguous; OpenCV cannot write to it.
            image = image.copy(order="C")
        cv2.subtract(image, np.array([black, black, black, 0.0]), dst=image)  # clips integers at 0
    return image if image.dtype == np.uint16 else np.maximum(image, 0, out=image)


def decode_image(path: str, eight_bits: bool = False) -> Image:
    """Return the unchanged values of an image file, (H, W, 3) uint16, float32 or float64.

    With `eight_bits`, files with 8 bits per channel are accepted too, as uint16.
    """
    image = _read_values(path)
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise FormatError(f"{path} has the shape {image.shape}, expected (height, width, 3); replace it")
    if image.dtype == np.uint8:
        if not eight_bits:
            raise FormatError(
                f"{path} has 8 bits per channel, like sRGB pictures, expected linear camera RGB of 16 bits; make a "
                "linear TIFF from the raw file with dcraw -h -D -4 -T, and give its black level, which dcraw does not "
                "subtract"
            )
        return image.astype(np.uint16)
    if image.dtype.name not in ("uint16", "float32", "float64"):
        raise FormatError(f"{path} has values of {image.dtype}, expected uint16, float32 or float64; convert it")
    if image.dtype != np.uint16 and not np.isfinite(image).all():
        raise FormatError(f"{path} has infinite or NaN values, expected finite linear camera RGB; make it again")
    return image


def _read_values(path: str) -> npt.NDArray[Any]:
    ending = Path(path).suffix.lower()
    try:
        if ending == ".npy":
            return native(np.load(path, allow_pickle=False))
        data = Path(path).read_bytes()
        if ending == ".png":
            return decode_png(data)
        if ending in (".tif", ".tiff"):
            return native(decode_tiff(data))
    except Exception as error:
        raise _unreadable(path, error, "restore it") from error
    raise FormatError(f"{path} ends in {ending!r}, expected .png, .tif, .tiff or .npy; convert it to linear 16 bits")


def _unreadable(path: str, error: Exception, remedy: str) -> FormatError:
    reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
    return FormatError(f"{path} cannot be read: {reason or type(error).__name__}; {remedy}")


# Formats that store every mask pixel exactly, and compressions of TIFF that change pixels.
_LOSSLESS_FORMATS = frozenset({"png", "tiff", "bmp", "gif", "pnm"})
_LOSSY_COMPRESSIONS = ("jpeg", "jp2", "webp", "lerc", "jxl")


def read_mask(path: str) -> Mask:
    """Return the mask (H, W) bool of a picture: True if any colour channel is not 0 and the pixel is not transparent.

    The picture is read as stored: its orientation is ignored, like that of images. Lossy pictures are refused, because
    their pixels near an edge are rarely exactly 0.
    """
    remedy = "make it again as PNG"
    try:
        if path.lower().endswith(".npy"):
            values, alpha = native(np.load(path, allow_pickle=False)), None
            values = values[..., None] if values.ndim == 2 else values
        else:
            require_plausible(Path(path).read_bytes(), path)
            image = read_native(Path(path))
            values, alpha = image.values, image.alpha
            if image.format not in _LOSSLESS_FORMATS or image.compression.startswith(_LOSSY_COMPRESSIONS):
                raise FormatError(
                    f"{path} is a lossy picture ({image.compression or image.format}), expected a mask as PNG or TIFF; "
                    f"{remedy}"
                )
    except FormatError:
        raise
    except Exception as error:
        raise _unreadable(path, error, remedy) from error
    if values.ndim != 3 or values.dtype.kind not in "buif" or not np.isfinite(values).all():
        raise FormatError(f"{path} has {values.dtype} {values.shape}, expected finite pixels; {remedy}")
    colours = [channel for channel in range(values.shape[2]) if channel != alpha]
    mask = values[..., colours].any(axis=2)
    return np.asarray(mask if alpha is None else mask & (values[..., alpha] != 0))
