"""A picture file becomes 8-bit sRGB codes, as a printer would be given them.

These steps turn a file's values into codes, in this order, so that one picture always gives the same codes::

    channels      the first three as R, G, B; a single one as grey; of several images in a file the first
    depth         8-bit codes are kept; 16-bit codes v become ⌊(v + 128) / 257⌋; floating-point values are linear
                  light, 1 = white, clipped and encoded with the sRGB curve (IEC 61966-2-1) unless the file calls itself
                  sRGB
    transparency  white shows through, as paper does in a print; mixed in the values that the file holds
    profile       codes of another colour space become those of sRGB; see `generator.pictures.profiles`
    orientation   turned as the file's EXIF or TIFF orientation asks
    size          only ever made smaller, on request, by averaging areas of codes
    crop          cut, on request, from the centre or at places that the picture's name and a seed choose
"""

from __future__ import annotations

import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import FormatError, InputError
from generator.pictures.crop_places import random_places
from generator.pictures.profiles import ADOBE_RGB, ASSUMED, from_adobe_rgb, to_srgb

Picture = npt.NDArray[np.uint8]

LARGEST_SIDE: Final = 65535
"""Longest side of a crop or a random scene, px: what 16 bits count."""
LARGEST_PICTURE: Final = 1 << 29
"""Most pixels of a picture, 1.6 GB of codes: a small file can claim more than memory holds."""

_UNCALIBRATED: Final = 0xFFFF
"""Value of the tag ColorSpace (EXIF 2.3, tag 40961) for a space that is not sRGB."""
_MULTIPLIED: Final = frozenset({"dpx", "iff", "openexr", "rla", "tiff"})
"""Formats whose colours are multiplied by alpha unless the file says otherwise, by OpenImageIO's names."""


@dataclass(frozen=True, slots=True)
class Preparation:
    """How pictures are prepared on request: made smaller, cut, taken as sRGB.

    - `max_side`: longest side allowed, px; a larger picture is made smaller.
    - `crop`: (width, height), px, to cut every picture to.
    - `cover`: whether a picture is first made as small as still covers the crop.
    - `crop_at`: where to cut: ``"centre"``, or ``"random"``, a place that the seed and the picture's name choose; None
      for the centre of one crop, and random places of several.
    - `crops`: how many different crops to cut. The first is where `crop_at` says, at random that of one; the others are
      at random places far from it and from each other.
    - `profiles`: ``"honour"`` converts pictures of other colour spaces to sRGB; ``"ignore"`` takes all codes as they
      stand.
    - `seed`: 0 … 2⁶⁴ − 1, of random crops.
    """

    max_side: int | None = None
    crop: tuple[int, int] | None = None
    cover: bool = False
    crop_at: Literal["centre", "random"] | None = None
    profiles: Literal["honour", "ignore"] = "honour"
    seed: int = 0
    crops: int = 1

    def __post_init__(self) -> None:
        if self.max_side is not None and self.max_side < 1:
            raise InputError(f"the longest side is to be {self.max_side} px, expected 1 or more")
        if self.crop is not None and not all(1 <= side <= LARGEST_SIDE for side in self.crop):
            raise InputError(
                f"a crop of {self.crop[0]}x{self.crop[1]} was asked for, expected sides of 1 to {LARGEST_SIDE} px"
            )
        if self.crop is None and (self.cover or self.crop_at == "random"):
            raise InputError("no crop was given to cover or to cut at random; give its size, such as 512x512")
        if self.crops < 1:
            raise InputError(f"{self.crops} crops of a picture were asked for, expected 1 or more")
        if self.crops > 1 and self.crop is None:
            raise InputError(f"{self.crops} crops of a picture have no size; give that of a crop, such as 512x512")

    @property
    def place(self) -> Literal["centre", "random"]:
        """Where the first crop is cut."""
        return self.crop_at or ("centre" if self.crops == 1 else "random")

    def describe(self) -> dict[str, Any]:
        """Return the options that are set, as a JSON object."""
        options: dict[str, Any] = {"profiles": self.profiles}
        if self.max_side is not None:
            options["max_side"] = self.max_side
        if self.crop is not None:
            options |= {"crop": list(self.crop), "cover": self.cover, "crop_at": self.place}
        if self.crops > 1:
            options |= {"crops": self.crops}
        return options


UNPREPARED: Final = Preparation()
"""Nothing is done on request: the whole picture in its own size, profiles honoured."""


@dataclass(frozen=True, eq=False, slots=True)
class Cut:
    """A part of a picture: place of its top left pixel in the picture, px, and its codes (H, W, 3) uint8."""

    left: int
    top: int
    picture: Picture


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """A picture as it was read.

    - `picture`: (H, W, 3) uint8, sRGB codes; of several crops the first.
    - `profile`: how its colour profile was treated, in words, such as ``"Display P3, converted to sRGB"``.
    - `cuts`: the crops, where several were asked for.
    """

    picture: Picture
    profile: str
    cuts: tuple[Cut, ...] = ()


def read_picture(path: Path | str, max_side: int | None = None) -> Picture:
    """Return the sRGB codes (H, W, 3) uint8 of a picture file; the head of this file lists the steps.

    Parameters
    ----------
    path
        Any file that OpenImageIO reads, or AVIF.
    max_side
        Longest side allowed, px; a larger picture is made smaller. None allows any.

    Raises
    ------
    FormatError
        The file cannot be read as a picture.

    Examples
    --------
    >>> from PIL import Image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "orange.png"
    ...     Image.new("RGB", (40, 20), (255, 128, 0)).save(path)
    ...     codes = read_picture(path, max_side=10)
    >>> codes.shape, codes.dtype, codes[0, 0]
    ((5, 10, 3), dtype('uint8'), array([255, 128,   0], dtype=uint8))
    """
    return open_picture(Path(path), Preparation(max_side=max_side)).picture


def open_picture(
    path: Path, preparation: Preparation = UNPREPARED, name: str | None = None, data: bytes | None = None
) -> Reading:
    """Return the sRGB codes of a picture file and how its profile was treated; the head of this file lists the steps.

    `name`: name of the picture, which chooses the place of a random crop; its file's name if None. `data`: the file's
    bytes, where they were read already. Returns the codes (H, W, 3) uint8 and the treatment of its profile.

    Examples
    --------
    >>> from PIL import Image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "orange.png"
    ...     Image.new("RGB", (40, 20), (255, 128, 0)).save(path)
    ...     reading = open_picture(path, Preparation(crop=(8, 8)))
    >>> reading.picture.shape, reading.profile
    ((8, 8, 3), 'none, taken as sRGB')
    """
    values = _read(path, data)
    light = values.light
    if values.linear:
        light = np.clip(np.nan_to_num(light, nan=0.0, posinf=1.0, neginf=0.0), 0.0, None)
    if values.alpha is not None:
        opaque = values.alpha[..., None]
        white = (1.0 - opaque) * (1.0 if values.linear else 255.0)
        light = (light if values.associated else light * opaque) + white
    if values.linear:
        codes = srgb_codes(light)
    else:
        # Rounding takes seconds on a large picture, and codes of 8 bits have nothing to round.
        codes = (light if light.dtype == np.uint8 else np.rint(np.clip(light, 0, 255))).astype(np.uint8, copy=False)
    if values.linear:
        word = "linear light, encoded as sRGB"
    elif values.icc is None and not values.adobe_rgb:
        word = ASSUMED
    elif preparation.profiles == "ignore":
        word = "ignored, taken as sRGB"
    elif values.icc is not None:
        codes, word = to_srgb(codes, values.icc)
    else:
        codes, word = from_adobe_rgb(codes), ADOBE_RGB
    codes = _turn(codes, values.orientation)
    cuts = _fit(codes, preparation, path, path.name if name is None else name)
    return Reading(cuts[0].picture, word, cuts if preparation.crops > 1 else ())


@dataclass(frozen=True, eq=False, slots=True)
class _Values:
    """Values of a file: `light` (H, W, 3) uint8 or float64, 0 … 255 or linear 0 … 1; `alpha` (H, W) float64 0 … 1."""

    light: npt.NDArray[Any]
    alpha: npt.NDArray[np.float64] | None
    associated: bool
    linear: bool
    orientation: int
    icc: bytes | None
    adobe_rgb: bool


def _read(path: Path, data: bytes | None) -> _Values:
    if not path.is_file():
        raise FormatError(f"cannot read {path}: there is no such file; name a picture")
    if path.suffix.lower() == ".avif":
        from generator.pictures.avif import read_avif

        picture = read_avif(path, LARGEST_PICTURE)
        return _Values(picture.codes, picture.alpha, False, False, picture.orientation, picture.icc, False)
    with _named_in_text(path) as name:
        return _read_named(path, name, data)


def _read_named(path: Path, name: str, data: bytes | None) -> _Values:
    import OpenImageIO as oiio  # noqa: N813

    request = oiio.ImageSpec()
    request.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(name, request)
    if stream is None:
        reason = _reason(oiio.geterror()).replace(name, str(path))
        raise FormatError(f"cannot read {path}: {reason}; use another picture, or convert it to PNG")
    try:
        spec = stream.spec()
        if spec.deep or spec.depth > 1 or spec.nchannels < 1:
            raise FormatError(f"cannot read {path}: it is no flat picture; use another, or convert it to PNG")
        if spec.width * spec.height > LARGEST_PICTURE:
            raise FormatError(
                f"cannot read {path}: {spec.width}x{spec.height} px are more than {LARGEST_PICTURE}; make it smaller"
            )
        space = str(spec.get_string_attribute("oiio:ColorSpace")).lower()
        kind = spec.format.basetype
        floating = kind in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        linear = floating and "srgb" not in space.replace("lin_srgb", "")
        pixels = None
        if stream.format_name() == "jpeg" and spec.nchannels == 3:
            pixels = _jpeg(path.read_bytes() if data is None else data)
        if pixels is None:
            pixels = stream.read_image("float" if floating else "uint8" if kind == oiio.UINT8 else "uint16")
        if pixels is None or stream.has_error:
            raise FormatError(
                f"cannot read {path}: {_reason(stream.geterror())}; the file is damaged, use another copy"
            )
        alpha_channel = spec.alpha_channel
        kept_apart = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) or stream.format_name() not in _MULTIPLIED
        orientation = spec.get_int_attribute("Orientation", 1)
        icc = spec.getattribute("ICCProfile")
        uncalibrated = spec.get_int_attribute("Exif:ColorSpace", 0) == _UNCALIBRATED
    finally:
        stream.close()
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    # Of a GIF file the reader names the channel after the last.
    alpha_channel = min(alpha_channel, spec.nchannels - 1)
    alpha = None
    if alpha_channel > 0:
        top = 1.0 if floating else float(np.iinfo(pixels.dtype).max)
        alpha = np.clip(pixels[..., alpha_channel].astype(np.float64) / top, 0.0, 1.0)
        # The fourth byte of a plain BMP file means nothing, and most programs write 0.
        if alpha.min() == 1.0 or (not alpha.any() and stream.format_name() == "bmp"):
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
    associated = not kept_apart
    if alpha is not None and not floating:
        # What is brighter than its alpha was not multiplied by it, whatever the format's custom.
        associated = associated and not bool(np.any(values > 255.0 * alpha[..., None] + 1.0))
    profile = None if icc is None else np.asarray(icc, dtype=np.uint8).tobytes()
    adobe_rgb = uncalibrated and profile is None and _interoperability(path) == "R03"
    return _Values(values, alpha, associated, linear, orientation, profile, adobe_rgb)


@contextmanager
def _named_in_text(path: Path) -> Generator[str]:
    """Yield a name of a file that OpenImageIO takes: a link to the file where its own name is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            suffix = path.suffix.encode("ascii", "ignore").decode()
            link = Path(folder) / f"picture{suffix}"
            link.symlink_to(path.absolute())
            yield str(link)
    else:
        yield str(path)


def _interoperability(path: Path) -> str:
    """Return the interoperability index of a file's EXIF data; empty if there is none."""
    from PIL import Image
    from PIL.ExifTags import IFD

    try:
        with Image.open(path) as picture:
            index = picture.getexif().get_ifd(IFD.Interop).get(1, "")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        # Damaged data, or a picture too large for Pillow: it has no index then. OpenImageIO has read the picture.
        return ""
    return str(index).strip("\0 ")


def _jpeg(data: bytes) -> npt.NDArray[np.uint8] | None:
    """Return the pixels (H, W, 3) uint8 of a usual colour JPEG in half of OpenImageIO's time, or None for another."""
    import simplejpeg

    try:
        if simplejpeg.decode_jpeg_header(data)[2] != "YCbCr":
            return None
        return simplejpeg.decode_jpeg(data, strict=True)
    except ValueError:
        # OpenImageIO reads it, or names the fault.
        return None


def _reason(message: str) -> str:
    """Return a library's message on one line without its full stop, to be a part of our sentence."""
    return " ".join(message.split()).rstrip(".") or "no known picture format"


def _turn(picture: Picture, orientation: int) -> Picture:
    """Return `picture` (H, W, 3) uint8 turned upright (TIFF 6.0, tag Orientation)."""
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


def _fit(picture: Picture, preparation: Preparation, path: Path, name: str) -> tuple[Cut, ...]:
    """Return `picture` (H, W, 3) uint8 made smaller and cut, in as many crops as are asked for."""
    height, width = picture.shape[:2]
    scale = 1.0 if preparation.max_side is None else preparation.max_side / max(height, width)
    if preparation.crop is None:
        return (Cut(0, 0, _shrink(picture, scale)),)
    wide, high = preparation.crop
    if preparation.cover:
        scale = min(scale, max(wide / width, high / height))
    picture = _shrink(picture, scale)
    height, width = picture.shape[:2]
    if wide > width or high > height:
        raise FormatError(
            f"cannot cut {path}: it is {width}x{height} px where the crop is {wide}x{high}; ask for a smaller crop"
        )
    centre = ((width - wide) // 2, (height - high) // 2)
    places = [centre]
    if preparation.place == "random" or preparation.crops > 1:
        free = (width - wide + 1, height - high + 1)
        if preparation.crops > free[0] * free[1]:
            raise FormatError(
                f"cannot cut {path} in {preparation.crops} different crops of {wide}x{high} px: it is "
                f"{width}x{height} px and has {free[0] * free[1]}; ask for fewer, or for smaller ones"
            )
        first = centre if preparation.place == "centre" else None
        places = random_places(free, (wide, high), preparation.crops, preparation.seed, name, first)
    return tuple(
        Cut(left, top, np.ascontiguousarray(picture[top : top + high, left : left + wide])) for left, top in places
    )


def _shrink(picture: Picture, scale: float) -> Picture:
    """Return `picture` (H, W, 3) uint8 scaled by `scale` if below 1, each pixel the mean of the area that it covers."""
    if scale >= 1:
        return picture
    import cv2

    height, width = picture.shape[:2]
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
