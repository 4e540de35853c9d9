"""Source pictures: any file OpenImageIO reads, or random colours, as 8-bit sRGB codes.

What is done to a file's values, in this order, so that one picture always gives the same codes:

    channels      the first three as R, G, B; a single one as grey; of several images in a file the first
    depth         8-bit codes as they are; 16-bit codes v become ⌊(v + 128) / 257⌋; floating-point values are linear
                  light, 1 = white, clipped and encoded with the sRGB curve (IEC 61966-2-1) unless the file calls itself
                  sRGB
    transparency  white shows through, as the paper does in a print; mixed in the values the file holds
    orientation   turned as the file's EXIF or TIFF orientation asks
    size          only ever made smaller, on request, by averaging areas

Embedded colour profiles are not applied: codes are printed as they stand.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from drivers.errors import FormatError, InputError
from generator import philox

Picture = npt.NDArray[np.uint8]

SUFFIXES: Final = frozenset(
    {".avif", ".bmp", ".dpx", ".exr", ".gif", ".hdr", ".heic", ".heif", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)
"""What a folder is searched for, in lower or upper case; a file that is named itself may end as it likes."""

LARGEST_SIDE: Final = 65535
"""Longest side of a random scene, px."""


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


def read_picture(path: Path | str, max_side: int | None = None) -> Picture:
    """Return the sRGB codes of a picture file; the head of this file says what is done to its values.

    Parameters
    ----------
    path
        Any file that OpenImageIO reads.
    max_side
        Longest side allowed, px, ≥ 1; a larger picture is made smaller by averaging areas.

    Returns
    -------
    ndarray
        (H, W, 3) uint8, sRGB codes.

    Raises
    ------
    FormatError
        The file cannot be read as a picture; the message has OpenImageIO's reason.
    """
    path = Path(path)
    values, alpha, associated, linear, orientation = _read(path)
    if linear:
        values = np.clip(np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0), 0.0, None)
    if alpha is not None:
        opaque = alpha[..., None]
        white = (1.0 - opaque) * (1.0 if linear else 255.0)
        values = (values if associated else values * opaque) + white
    if linear:
        codes = _encode(values)
    else:
        # Rounding takes seconds on a large picture, and codes of 8 bits have nothing to round.
        codes = (values if values.dtype == np.uint8 else np.rint(np.clip(values, 0, 255))).astype(np.uint8, copy=False)
    return _shrink(_turn(codes, orientation), max_side)


def _read(path: Path) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64] | None, bool, bool, int]:
    """Return values (H, W, 3), 0 … 255 or linear 0 … 1; alpha (H, W) 0 … 1; associated?; linear?; orientation 1 … 8."""
    import OpenImageIO as oiio  # noqa: N813

    if not path.is_file():
        raise FormatError(f"cannot read {path}: there is no such file; name a picture")
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(str(path), wish)
    if stream is None:
        raise FormatError(f"cannot read {path}: {_reason(oiio.geterror())}; use another picture, or convert it to PNG")
    try:
        spec = stream.spec()
        if spec.deep or spec.depth > 1 or spec.nchannels < 1:
            raise FormatError(f"cannot read {path}: it is no flat picture; use another, or convert it to PNG")
        space = str(spec.get_string_attribute("oiio:ColorSpace")).lower()
        kind = spec.format.basetype
        floating = kind in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        linear = floating and "srgb" not in space.replace("lin_srgb", "")
        pixels = stream.read_image("float" if floating else "uint8" if kind == oiio.UINT8 else "uint16")
        if pixels is None or stream.has_error:
            raise FormatError(
                f"cannot read {path}: {_reason(stream.geterror())}; the file is damaged, use another copy"
            )
        alpha_channel = spec.alpha_channel
        associated = not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
        orientation = spec.get_int_attribute("Orientation", 1)
    finally:
        stream.close()
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    alpha = None
    if 0 < alpha_channel < spec.nchannels:
        top = 1.0 if floating else float(np.iinfo(pixels.dtype).max)
        alpha = np.clip(pixels[..., alpha_channel].astype(np.float64) / top, 0.0, 1.0)
        if alpha.min() == 1.0:
            alpha = None
    colours = [channel for channel in range(spec.nchannels) if channel != alpha_channel]
    if colours[:3] == [0, 1, 2]:
        values = pixels[..., :3]
    else:
        values = pixels[..., colours[:3] if len(colours) >= 3 else [colours[0] if colours else 0] * 3]
    if values.dtype == np.uint16:
        values = ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif floating:
        values = values.astype(np.float64) * (1.0 if linear else 255.0)
    return values, alpha, associated, linear, orientation


def _reason(message: str) -> str:
    """Return a library's message as part of our sentence."""
    return " ".join(message.split()).rstrip(".") or "no known picture format"


def _encode(linear: npt.NDArray[np.float64]) -> Picture:
    """Return the sRGB codes 0 … 255 of linear light, clipped at 1 (IEC 61966-2-1)."""
    light = np.clip(linear, 0.0, 1.0)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
    return np.rint(255 * code).astype(np.uint8)


def _turn(picture: Picture, orientation: int) -> Picture:
    """Return `picture` as it is meant to be seen (TIFF 6.0, tag 274 Orientation)."""
    turned = {
        2: lambda: picture[:, ::-1],
        3: lambda: picture[::-1, ::-1],
        4: lambda: picture[::-1],
        5: lambda: picture.transpose(1, 0, 2),
        6: lambda: picture.transpose(1, 0, 2)[:, ::-1],
        7: lambda: picture.transpose(1, 0, 2)[::-1, ::-1],
        8: lambda: picture.transpose(1, 0, 2)[::-1],
    }.get(orientation)
    return np.ascontiguousarray(turned() if turned else picture)


def _shrink(picture: Picture, max_side: int | None) -> Picture:
    """Return `picture` with its longest side at most `max_side` px, each pixel the mean of the area it covers."""
    height, width = picture.shape[:2]
    if max_side is None or max(height, width) <= max_side:
        return picture
    if max_side < 1:
        raise InputError(f"the longest side is to be {max_side} px, expected 1 or more")
    import cv2

    scale = max_side / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
