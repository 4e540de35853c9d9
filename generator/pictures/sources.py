"""Source pictures: where they come from, and how a file becomes 8-bit sRGB codes, as a printer would be given them.

They are files, folders of any size, remote stores, or random colours. These steps turn a file's values into codes, in
this order, so that one picture always gives the same codes::

    channels      the first three as R, G, B; a single one as grey; of several images in a file the first
    depth         8-bit codes are kept; 16-bit codes v become ⌊(v + 128) / 257⌋; floating-point values are linear
                  light, 1 = white, clipped and encoded with the sRGB curve (IEC 61966-2-1) unless the file calls itself
                  sRGB
    transparency  white shows through, as paper does in a print; mixed in the values that the file holds
    profile       codes of another colour space become those of sRGB (`generator.pictures.conversion`)
    orientation   turned as the file's EXIF or TIFF orientation asks
    size          only ever made smaller, on request, by averaging areas of codes
    crop          cut, on request, from the centre or at places that the picture's name and a seed choose

Other colour spaces are in `generator.pictures.conversion`, random colours in `.random_scenes`.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import struct
import tempfile
import zlib
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import FormatError, InputError, StorageError
from foundation.files import file_sha256, sha256_of, stream_sha256
from foundation.secret_texts import masked
from generator import philox
from generator.pictures.conversion import from_adobe_rgb, to_srgb
from generator.stores import DESCRIPTION, filesystem, is_remote, local_path

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem


ADOBE_RGB: Final = "Adobe RGB (1998) by EXIF, converted to sRGB"  # Remark on a picture that a camera made in that space

LINEAR: Final = "floating-point values, taken as linear light"
TRANSPARENT: Final = "transparent, composited on white"
# Notes on a picture, as those above, for its row of the dataset's list of sources.
PROFILE_UNUSED: Final = "colour profile not applied"

_PNG: Final = b"\x89PNG\r\n\x1a\n"  # First bytes of a PNG file

# Places of which a further crop takes the best; chosen, not measured: with one, crops may be nearly the same.
_CANDIDATES: Final = 8


def random_places(
    free: tuple[int, int],
    size: tuple[int, int],
    count: int,
    seed: int,
    name: str,
    first: tuple[int, int] | None = None,
) -> list[tuple[int, int]]:
    """Return `count` different places of crops in a picture.

    Candidate n is made of the first two words of Philox with counter (a + n mod 2³², b, number, 6); a, b, number are
    the first three words of the SHA-256 of the picture's name. The first crop is at candidate 0, or at `first`. Each
    further one is at that of the next eight candidates which overlaps least with the crops before it, the first of
    equals, as in best-candidate sampling (D. Mitchell, "Spectrally optimal sampling for distribution ray tracing",
    SIGGRAPH 1991), where its eight are all taken, at the first free place after them, row by row.

    `free`: columns and rows at which a crop can begin, 1 or more; together `count` or more places. `size`: width and
    height of a crop, px. `first`: column and row of the first crop, px; None for a random place. Returns column and row
    of each, px.
    """
    digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()
    a, b, number = (int.from_bytes(digest[at : at + 4], "little") for at in (0, 4, 8))
    tried = (a + np.arange(1 + _CANDIDATES * (count - 1), dtype=np.int64)) % (1 << 32)
    across, down, _, _ = philox.words(seed, tried, b, number, philox.CROPS)
    candidates = [
        (int(column) * free[0] >> 32, int(row) * free[1] >> 32) for column, row in zip(across, down, strict=True)
    ]
    places = candidates[:1] if first is None else [first]
    for crop in range(1, count):
        begin = 1 + _CANDIDATES * (crop - 1)
        left = [place for place in candidates[begin : begin + _CANDIDATES] if place not in places]
        if left:
            places.append(min(left, key=lambda place: max(_overlap(place, other, size) for other in places)))
            continue
        last = candidates[begin + _CANDIDATES - 1]
        start, total = last[1] * free[0] + last[0], free[0] * free[1]
        following = (((start + step) % total % free[0], (start + step) % total // free[0]) for step in range(total))
        places.append(next(place for place in following if place not in places))
    return places


def _overlap(one: tuple[int, int], other: tuple[int, int], size: tuple[int, int]) -> int:
    wide, high = (max(0, side - abs(a - b)) for side, a, b in zip(size, one, other, strict=True))
    return wide * high


def clear_bits(codes: npt.NDArray[np.uint8], bits: int) -> npt.NDArray[np.uint8]:
    """Return codes (...) uint8 with their lowest `bits` bits, 0 … 8, set to zero."""
    if not 0 <= bits <= 8:
        raise InputError(f"{bits} bits of a code of 8 were to be set to zero, expected 0 to 8")
    return codes & np.uint8(0xFF << bits & 0xFF)


Picture = npt.NDArray[np.uint8]

LARGEST_SIDE: Final = 65535  # Longest side of a crop or a random scene, px: what 16 bits count
# Most pixels of a picture, 1.6 GB of codes: a small file can claim more than memory holds.
LARGEST_PICTURE: Final = 1 << 29

_UNCALIBRATED: Final = 0xFFFF  # Value of the tag ColorSpace (EXIF 2.3, tag 40961) for a space that is not sRGB
# Formats whose colours are multiplied by alpha unless the file says otherwise, by OpenImageIO's names.
_MULTIPLIED: Final = frozenset({"dpx", "iff", "openexr", "rla", "tiff"})


@dataclass(frozen=True, slots=True)
class Preparation:
    """How pictures are prepared on request: made smaller, cut.

    - `max_side`: longest side allowed, px; a larger picture is made smaller.
    - `crop`: (width, height), px, to cut every picture to.
    - `cover`: whether a picture is first made as small as still covers the crop.
    - `crop_at`: where to cut: ``"centre"``, or ``"random"``, a place that the seed and the picture's name choose; None
      for the centre of one crop, and random places of several.
    - `crops`: how many different crops to cut. The first is where `crop_at` says, at random that of one; the others are
      at random places far from it and from each other.
    - `seed`: 0 … 2⁶⁴ − 1, of random crops.
    """

    max_side: int | None = None
    crop: tuple[int, int] | None = None
    cover: bool = False
    crop_at: Literal["centre", "random"] | None = None
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
            raise InputError(f"{self.crops} crops of a picture have no size; give that of a crop: --crop 512x512")

    @property
    def place(self) -> Literal["centre", "random"]:
        """Where the first crop is cut."""
        return self.crop_at or ("centre" if self.crops == 1 else "random")

    def describe(self) -> dict[str, Any]:
        """Return the options that are set, as a JSON object."""
        options: dict[str, Any] = {"profiles": "honour"}
        if self.max_side is not None:
            options["max_side"] = self.max_side
        if self.crop is not None:
            options |= {"crop": list(self.crop), "cover": self.cover, "crop_at": self.place}
        if self.crops > 1:
            options |= {"crops": self.crops}
        return options


UNPREPARED: Final = Preparation()  # Nothing is done on request: the whole picture in its own size


@dataclass(frozen=True, eq=False, slots=True)
class Cut:
    """A part of a picture: place of its top left pixel in the picture, px, and its codes (H, W, 3) uint8."""

    left: int
    top: int
    picture: Picture


@dataclass(frozen=True, eq=False, slots=True)
class SourcePicture:
    """A source picture as it was read.

    - `picture`: (H, W, 3) uint8, sRGB codes; of several crops the first.
    - `sha256`: hash of the file's bytes; None where there is no file, or it is opened alone.
    - `profile`: how its colour profile was treated, in words, such as ``"Display P3, converted to sRGB"``;
      empty where there is no file.
    - `cuts`: the crops, where several were asked for.
    - `notes`: what else of the file was not plain sRGB codes and may look unlike what its owner expects.
    """

    picture: Picture
    sha256: str | None = None
    profile: str = ""
    cuts: tuple[Cut, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class _FileValues:
    """Values of a file: `light` (H, W, 3) uint8 or float64, 0 … 255 or linear 0 … 1; `alpha` (H, W) float64 0 … 1."""

    light: npt.NDArray[Any]
    alpha: npt.NDArray[np.float64] | None
    associated: bool
    linear: bool
    orientation: int
    icc: bytes | None
    adobe_rgb: bool = False


def read_picture(path: Path | str, max_side: int | None = None) -> Picture:
    """Return the sRGB codes (H, W, 3) uint8 of a picture file; the head of this file lists the steps.

    Parameters
    ----------
    path
        Any file that OpenImageIO reads.
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
    path: Path,
    preparation: Preparation = UNPREPARED,
    name: str | None = None,
    data: bytes | None = None,
    most_pixels: int | None = None,
) -> SourcePicture:
    """Return the sRGB codes of a picture file and how its profile was treated; the head of this file lists the steps.

    `name`: name of the picture, which chooses the place of a random crop; its file's name if None. `data`: the file's
    bytes, where they were read already. `most_pixels`: of the largest file that is read; `LARGEST_PICTURE` if None.
    Returns the codes (H, W, 3) uint8 and the treatment of its profile.
    """
    values = _read(path, data, LARGEST_PICTURE if most_pixels is None else most_pixels)
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
        word = "none, taken as sRGB"
    elif values.icc is not None:
        codes, word = to_srgb(codes, values.icc)
    else:
        codes, word = from_adobe_rgb(codes), ADOBE_RGB
    noted = {
        LINEAR: values.linear,
        TRANSPARENT: values.alpha is not None,
        PROFILE_UNUSED: values.icc is not None and word.endswith("taken as sRGB"),
    }
    codes = _turn(codes, values.orientation)
    cuts = _fit(codes, preparation, path, path.name if name is None else name)
    notes = tuple(note for note, holds in noted.items() if holds)
    several = cuts if preparation.crops > 1 else ()
    return SourcePicture(cuts[0].picture, profile=word, cuts=several, notes=notes)


def _read(path: Path, data: bytes | None, most_pixels: int) -> _FileValues:
    if not path.is_file():
        raise FormatError(f"cannot read {path}: there is no such file; name a picture")
    has_profile = _checked_png(path, data)
    with _named_in_text(path) as name:
        values = _read_named(path, name, data, most_pixels)
    # The reader drops a profile that it cannot use without a word; no bytes are a damaged one.
    lost = has_profile and values.icc is None and not values.adobe_rgb
    return replace(values, icc=b"") if lost else values


def _checked_png(path: Path, data: bytes | None) -> bool:
    """Return whether a file is a PNG that has a colour profile (PNG, third edition, clause 5.3).

    Pixels that are damaged or cut off are refused here: libpng, which finds them, too, prints lines of its own.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(_PNG)) != _PNG:
                return False
            content = memoryview(_PNG + stream.read() if data is None else data)
    except OSError:
        # OpenImageIO names the fault.
        return False
    place, has_profile = len(_PNG), False
    while place + 8 <= len(content):
        size, kind = struct.unpack(">I4s", content[place : place + 8])
        end = place + 12 + size
        has_profile |= kind == b"iCCP"
        if kind in (b"IHDR", b"PLTE", b"IDAT"):
            cut = end > len(content)
            if cut or zlib.crc32(content[place + 4 : end - 4]) != int.from_bytes(content[end - 4 : end]):
                fault = "it ends within" if cut else "the checksum is not that of"
                raise FormatError(
                    f"cannot read {path}: {fault} its chunk {kind.decode()} at byte {place}; the file is damaged, use "
                    "another copy"
                )
        place = end
    return has_profile


def _read_named(path: Path, name: str, data: bytes | None, most_pixels: int) -> _FileValues:
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
        if spec.width * spec.height > most_pixels:
            raise FormatError(
                f"cannot read {path}: {spec.width}x{spec.height} px are more than {most_pixels}; make it smaller"
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
    return _FileValues(values, alpha, associated, linear, orientation, profile, adobe_rgb)


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


# Ends of the names for which a folder is searched, in either case; a file that is named itself may have any end.
SUFFIXES: Final = frozenset(
    {".bmp", ".dpx", ".exr", ".gif", ".hdr", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)

# Ends of pictures' names that no library of a plain installation reads; those in a folder are told.
UNREADABLE: Final = frozenset({".avif", ".heic", ".heif"})

# Backslashes before a byte that is no text, or before two digits that are written like one.
_LIKE_A_BYTE: Final = re.compile(r"\\+(?=x[89a-f][0-9a-f]|[\udc80-\udcff])")
# Most bytes of a file that is read once, to be hashed and decoded: 32 MiB are nothing beside what it unpacks to.
_KEPT: Final = 1 << 25

_log = logging.getLogger(__name__)

# Errors of reading that have their cause in the machine or its store, not in the file.
_MACHINE_ERRORS: Final = frozenset(
    {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN}
)


class Source(Protocol):
    """One picture that can be read, from wherever."""

    @property
    def name(self) -> str:
        """The picture's name in the dataset."""
        ...

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; a FormatError says why it cannot be read."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return as a JSON object how the picture is made or read, without the place of a file."""
        ...


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A file on this machine, or on a store that fsspec knows.

    - `root`: folder it was found in, as a path or URL; the file itself where it was named.
    - `below`: path below the root with forward slashes; empty where the file was named itself.
    - `preparation`: how it is prepared.
    """

    root: str
    below: str
    preparation: Preparation = UNPREPARED

    @property
    def name(self) -> str:
        r"""Its name in the dataset: its path below the folder, with \xNN for bytes that are no text.

        No two paths have one name: backslashes before such a byte, or before what reads like one, stand twice.
        """
        name = self.below or PurePosixPath(masked(self.root).replace(os.sep, "/")).name
        name = _LIKE_A_BYTE.sub(lambda found: 2 * found[0], name)
        text = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        # Many readers of CSV end a line at a carriage return, quoted or not.
        return text.replace("\r", "\\r")

    def to_json(self) -> dict[str, Any]:
        """Return its name and its preparation as a JSON object."""
        return {"picture": self.name, **self.preparation.describe()}

    @property
    def location(self) -> str:
        """The file's path or URL."""
        return f"{self.root.rstrip('/')}/{self.below}" if self.below else self.root

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; see `picture.open_picture`."""
        with _local_file(self.location) as path:
            try:
                sha256, data = _hashed(path)
                read = open_picture(path, self.preparation, self.name, data)
            except FormatError as error:
                raise FormatError(str(error).replace(str(path), self.location)) from error
            except OSError as error:
                raise _unreadable(self.location, error, _is_of_the_file(path, error)) from error
            except MemoryError as error:
                raise InputError(
                    f"there is not enough memory to read {self.location}; use fewer workers, or leave it out"
                ) from error
        return replace(read, sha256=sha256)


def hash_since(source: Source, moment: float) -> str | None:
    """Return the SHA-256 of a source's file if that is on this machine and was changed after a moment.

    Returns none where there is no such file, or it was not changed. A file that was removed has an empty hash.
    """
    file: object = getattr(source, "source", source)
    if not isinstance(file, PictureFile) or is_remote(file.location):
        return None
    try:
        status = Path(file.location).stat()
        # The second changes with every change of the first, and no program sets it back.
        return file_sha256(Path(file.location)) if max(status.st_mtime, status.st_ctime) > moment else None
    except OSError:
        return ""


@contextmanager
def _local_file(location: str) -> Generator[Path]:
    """Yield the path of a file of this machine; one of a store is copied, and the copy removed at the end."""
    if not is_remote(location):
        yield Path(location)
        return
    store, path = filesystem(location)
    try:
        copy = tempfile.NamedTemporaryFile(prefix="crop-", suffix=PurePosixPath(location).suffix)  # noqa: SIM115
    except OSError as error:
        raise _unreadable(location, error, of_the_file=False) from error
    with copy:
        try:
            store.get_file(path, copy.name)
        except Exception as error:
            # Every store raises errors of its own.
            gone = isinstance(error, FileNotFoundError)
            raise _unreadable(location, error, of_the_file=gone and _folder_is_there(store, path)) from error
        yield Path(copy.name)


def _hashed(path: Path) -> tuple[str, bytes | None]:
    """Return the SHA-256 of a file, and its bytes where they are few enough to be kept until they are decoded."""
    # Without a buffer of Python's own, which asks the system four questions about each file.
    with path.open("rb", buffering=0) as stream:
        if os.fstat(stream.fileno()).st_size > _KEPT:
            return stream_sha256(stream), None
        data = stream.read()
    return sha256_of(data), data


def _is_of_the_file(path: Path, error: OSError) -> bool:
    if error.errno in _MACHINE_ERRORS:
        return False
    # The folder of a disk that is not mounted, or fails, is missing, empty or cannot be listed.
    try:
        with os.scandir(path.parent) as entries:
            return next(entries, None) is not None
    except OSError:
        return False


def _folder_is_there(store: AbstractFileSystem, path: str) -> bool:
    try:
        store.invalidate_cache()
        return bool(store.isdir(path.rpartition("/")[0]))
    except Exception:
        return False


def _unreadable(location: str, error: Exception, of_the_file: bool) -> FormatError | StorageError:
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split()).rstrip(".")
    if of_the_file:
        return FormatError(f"cannot read {location}: {reason}; name a picture")
    return StorageError(
        f"cannot read {location}: {reason}; see that every machine that works on the dataset can read it, then run the "
        "same command again"
    )


def find_pictures(
    places: Sequence[Path | str] | Path | str, preparation: Preparation = UNPREPARED
) -> tuple[PictureFile, ...]:
    """Return the pictures of folders and files.

    A folder is searched with all folders below it, except hidden ones and data sets, for files whose names end in one
    of `SUFFIXES`. A link to a folder is followed, unless that is searched already or holds what is searched, so that
    no picture comes twice and no search goes round in a circle. Pictures are sorted by their path below the folder,
    code point by code point; the order of `places` is kept. No file is opened; a million of them take about 0.2 GB of
    memory. A warning is logged of pictures that cannot be read (`UNREADABLE`).

    Parameters
    ----------
    places
        Paths of this machine, or URLs that fsspec knows, such as ``s3://bucket/folder``; or a single one.
    preparation
        How each is prepared.

    Raises
    ------
    InputError
        A place is missing or neither file nor folder, a folder holds no picture, or two pictures would have one name.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b.png", "a.JPG", "notes.txt"):
    ...         Path(folder, name).touch()
    ...     [picture.name for picture in find_pictures(folder)]
    ['a.JPG', 'b.png']
    """
    found: list[PictureFile] = []
    named = (places,) if isinstance(places, Path | str) else places
    for place in named:
        remote = is_remote(str(place))
        # Absolute, since a worker may have been started in another folder.
        root = str(place) if remote else os.path.abspath(local_path(place))  # noqa: PTH100  keeps no link's target
        if not remote and not os.path.lexists(root):
            raise InputError(f"there is no {place}; name a picture or a folder of pictures")
        if not remote and Path(root).exists() and not (Path(root).is_dir() or Path(root).is_file()):
            raise InputError(f"{place} is a device or a pipe; name a picture or a folder of pictures")
        if not remote and not Path(root).is_dir():
            found.append(PictureFile(root, "", preparation))
            continue
        before = len(found)
        search = _Search(root)
        below = _below_url(root, search) if remote else _below_folder(root, search)
        found += [PictureFile(root, name, preparation) for name in below]
        told = search.sentence(masked(root))
        if len(found) == before:
            expected = f"expected files that end in one of {' '.join(sorted(SUFFIXES))}"
            raise InputError(told or f"{root} holds no picture; {expected}")
        if told:
            _log.warning(told)
    if len(named) > 1:
        _refuse_names(found)
    return tuple(found)


def _refuse_names(found: Sequence[PictureFile]) -> None:
    seen: dict[str, PictureFile] = {}
    for picture in found:
        if (other := seen.setdefault(picture.name, picture)) is not picture:
            if other.location == picture.location:
                raise InputError(f"{picture.location} is named twice; name it, or the folder that it is in, once")
            raise InputError(
                f"two pictures would be called {picture.name}: {other.location} and {picture.location}; name a folder "
                "that holds both, or rename one"
            )


def _is_unreadable(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in UNREADABLE  # noqa: PTH122  as below


def _is_picture(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in SUFFIXES  # noqa: PTH122  a million Path objects take a minute


class _Search:
    """What a search for pictures has followed and passed over."""

    def __init__(self, root: str) -> None:
        self._searched = [root if is_remote(root) else os.path.realpath(root)]
        self._unreadable = 0
        self._first = ""

    def follows(self, link: str) -> bool:
        """Return whether a link to a folder is followed: what is, or holds, what is searched already is not."""
        target = os.path.realpath(link)
        for folder in self._searched:
            if os.path.commonpath([folder, target]) in (folder, target):
                _log.info("%s is not followed: it leads to %s, which is searched already or holds it", link, target)
                return False
        self._searched.append(target)
        return True

    def pass_over(self, name: str) -> None:
        """Count a picture that cannot be read."""
        self._unreadable += 1
        self._first = self._first or name

    def sentence(self, place: str) -> str | None:
        """Return what is to be told of pictures that cannot be read; None if there are none."""
        if not self._unreadable:
            return None
        others = f" and {self._unreadable - 1} more" if self._unreadable > 1 else ""
        return (
            f"{place} holds {self._first}{others}, which {'are' if others else 'is'} left out: HEIC and AVIF are not "
            "read; convert to JPEG or PNG"
        )


def _below_folder(folder: str, search: _Search, prefix: str = "") -> Iterator[str]:
    """Yield the pictures below a folder in the order of their paths, with one folder's list in memory at a time."""
    links: set[str] = set()
    try:
        with os.scandir(folder) as entries:
            listed: list[str] = []
            for entry in entries:
                name = entry.name
                if name.startswith("."):
                    continue
                if _is(entry.is_dir):
                    # A folder is sorted with the slash that follows it in a path.
                    listed.append(f"{name}/")
                    if entry.is_symlink():
                        links.add(f"{name}/")
                elif name == DESCRIPTION or (_is_picture(name) and _is(entry.is_file)) or _is_unreadable(name):
                    listed.append(name)
            listed.sort()
    except OSError as error:
        raise InputError(f"cannot look into {folder}: {error.strerror}; name a folder that may be read") from error
    if DESCRIPTION in listed:
        # A data set among the pictures, perhaps the one that is made of them: its images are no sources.
        if prefix:
            return
        listed.remove(DESCRIPTION)
    for name in listed:
        if name.endswith("/"):
            path = f"{folder.rstrip('/')}/{name[:-1]}"
            if name not in links or search.follows(path):
                yield from _below_folder(path, search, prefix + name)
        elif _is_unreadable(name):
            search.pass_over(prefix + name)
        else:
            yield prefix + name


def _is(asked: Callable[[], bool]) -> bool:
    """Return what an entry says of itself, a link of what it leads to; a link in a circle of links leads nowhere."""
    try:
        return asked()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return False
        raise


def _below_url(url: str, search: _Search) -> list[str]:
    """Return the pictures below a URL, or ``""`` where it is a file itself."""
    store, root = filesystem(url)
    try:
        if store.isfile(root):
            return [""]
        top = PurePosixPath(root)
        listed = [PurePosixPath(path).relative_to(top) for path in store.find(root)]
    except Exception as error:
        # Every store raises errors of its own.
        raise InputError(f"cannot look into {url}: {error}; check the address and that you may read there") from error
    datasets = {path.parent for path in listed if path.name == DESCRIPTION and len(path.parts) > 1}
    seen = sorted(
        path.as_posix()
        for path in listed
        if not any(part.startswith(".") for part in path.parts) and datasets.isdisjoint(path.parents)
    )
    for name in filter(_is_unreadable, seen):
        search.pass_over(name)
    return list(filter(_is_picture, seen))
