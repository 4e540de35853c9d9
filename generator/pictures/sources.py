"""Find source pictures and convert them to 8-bit sRGB codes, as for a printer.

A source is a file, a folder of any size, a remote store, or random colours. The conversion has these steps, in this
order, so that a picture always gives the same codes::

    image         the first one, if the file has several; the first full one of a TIFF with reduced images
    channels      the first three are R, G and B; if there are fewer, the first is grey
    depth         8-bit codes are kept; 16-bit codes v become ⌊(v + 128) / 257⌋; floating-point values are linear
                  light, 1 = white, clipped and encoded with the sRGB curve (IEC 61966-2-1), unless the file is
                  marked as sRGB or has a profile that is not linear
    transparency  composited on white, like paper in a print; codes are not decoded for this
    profile       another colour space, by profile or by primaries and transfer function, is converted to sRGB
                  (`generator.pictures.conversion`); HDR pictures and unknown spaces are refused
    orientation   rotated or mirrored according to EXIF or TIFF orientation
    size          on request only: reduced; codes are averaged over areas
    crop          on request only: from the centre, or at positions derived from the name of the picture and a seed
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
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import FormatError, InputError, StorageError
from foundation.files import file_sha256, sha256_of, stream_sha256
from foundation.remote import filesystem, is_remote, remote_error
from foundation.secret_texts import masked
from generator import philox
from generator.files import SIGNATURE, alpha_channel, opened_image, upright
from generator.pictures.conversion import (
    RgbSpace,
    from_adobe_rgb,
    linear_space,
    space_of_cicp,
    space_of_gamma,
    space_of_primaries,
    to_srgb,
)
from generator.stores import DESCRIPTION, local_path

if TYPE_CHECKING:
    from fsspec.spec import AbstractFileSystem


ADOBE_RGB: Final = "Adobe RGB (1998) by EXIF, converted to sRGB"  # Treatment of a photograph in Adobe RGB

# Notes on a picture, for `sources.csv` of the data set.
LINEAR: Final = "floating-point values, taken as linear light"
TRANSPARENT: Final = "transparent, composited on white"
PROFILE_UNUSED: Final = "colour profile not applied"

# Number of candidates for each crop after the first, chosen by judgement. With one candidate, two crops could be nearly
# equal.
_CROP_CANDIDATES: Final = 8


def random_positions(
    starts: tuple[int, int],
    size: tuple[int, int],
    count: int,
    seed: int,
    name: str,
    first: tuple[int, int] | None = None,
) -> list[tuple[int, int]]:
    """Return `count` different positions of crops in a picture: column and row of each, px.

    Candidate n is computed from the first two words of Philox with counter (a + n mod 2³², b, number, 6). a, b and
    number are the first three words of the SHA-256 of the name of the picture. The first crop is at candidate 0, or at
    `first`. For each further crop, the next 8 candidates are compared: the one with the least overlap with existing
    crops is used, or the first of several equal ones. This is best-candidate sampling (D. Mitchell, "Spectrally optimal
    sampling for distribution ray tracing", SIGGRAPH 1991). If all 8 positions are taken, the first free position after
    the eighth is used, row by row.

    `starts`: numbers of columns and rows at which a crop can begin, with a product of at least `count`. `size`: width
    and height of a crop, px. `first`: column and row of the first crop, px; None for a random position.
    """
    digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()
    a, b, number = (int.from_bytes(digest[at : at + 4], "little") for at in (0, 4, 8))
    candidate_numbers = (a + np.arange(1 + _CROP_CANDIDATES * (count - 1), dtype=np.int64)) % (1 << 32)
    across, down, _, _ = philox.words(seed, candidate_numbers, b, number, philox.CROPS)
    candidates = [
        (int(column) * starts[0] >> 32, int(row) * starts[1] >> 32) for column, row in zip(across, down, strict=True)
    ]
    positions = candidates[:1] if first is None else [first]
    for crop in range(1, count):
        begin = 1 + _CROP_CANDIDATES * (crop - 1)
        remaining = [position for position in candidates[begin : begin + _CROP_CANDIDATES] if position not in positions]
        if remaining:
            positions.append(min(remaining, key=lambda start: max(_overlap(start, cut, size) for cut in positions)))
            continue
        last_candidate = candidates[begin + _CROP_CANDIDATES - 1]
        begin, total = last_candidate[1] * starts[0] + last_candidate[0], starts[0] * starts[1]
        following = (((begin + step) % total % starts[0], (begin + step) % total // starts[0]) for step in range(total))
        positions.append(next(position for position in following if position not in positions))
    return positions


def _overlap(first: tuple[int, int], second: tuple[int, int], size: tuple[int, int]) -> int:
    shared_width, shared_height = (max(0, side - abs(a - b)) for side, a, b in zip(size, first, second, strict=True))
    return shared_width * shared_height


def clear_bits(codes: npt.NDArray[np.uint8], bits: int) -> npt.NDArray[np.uint8]:
    """Return codes (...) uint8 with their lowest `bits` bits, 0 … 8, set to 0."""
    if not 0 <= bits <= 8:
        raise InputError(f"{bits} bits of 8-bit codes are to be cleared, expected 0 to 8")
    return codes & np.uint8(0xFF << bits & 0xFF)


Picture = npt.NDArray[np.uint8]

LARGEST_SIDE: Final = 65535  # Longest side of a crop or a random scene, px: largest 16-bit number
# Largest number of pixels, 1.6 GB of codes. The header of a small file may state more pixels than fit into memory.
LARGEST_PICTURE: Final = 1 << 29

_UNCALIBRATED: Final = 0xFFFF  # Value of the tag ColorSpace (EXIF 2.3, tag 40961) for a space that is not sRGB
# Formats that store colours multiplied by alpha, unless the file states otherwise; names of OpenImageIO.
_PREMULTIPLIED: Final = frozenset({"dpx", "iff", "openexr", "rla", "tiff"})


@dataclass(frozen=True, slots=True)
class Preparation:
    """Requested preparation of pictures: reduced size and crops.

    - `max_side`: longest side allowed, px; a larger picture is reduced.
    - `crop`: width and height of the crops of every picture, px.
    - `cover`: before cropping, reduce a picture to the smallest size that covers the crop.
    - `crop_at`: position of the first crop: ``"centre"`` or ``"random"``. None is the centre for one crop, and random
      for several. A random position depends on the seed and the name of the picture.
    - `crops`: number of different crops. Further crops are at random positions, far from each other.
    - `seed`: seed of random positions, 0 … 2⁶⁴ − 1.
    """

    max_side: int | None = None
    crop: tuple[int, int] | None = None
    cover: bool = False
    crop_at: Literal["centre", "random"] | None = None
    seed: int = 0
    crops: int = 1

    def __post_init__(self) -> None:
        if self.max_side is not None and self.max_side < 1:
            raise InputError(f"the longest side is {self.max_side} px, expected 1 or more")
        if self.crop is not None and not all(1 <= side <= LARGEST_SIDE for side in self.crop):
            raise InputError(f"the crop has {self.crop[0]}x{self.crop[1]} px, expected sides of 1 to {LARGEST_SIDE} px")
        if self.crop is None and (self.cover or self.crop_at == "random"):
            raise InputError("`cover` or a random position needs a crop, none is given; add its size, such as 512x512")
        if self.crops < 1:
            raise InputError(f"{self.crops} crops per picture are requested, expected 1 or more")
        if self.crops > 1 and self.crop is None:
            raise InputError(f"{self.crops} crops per picture are requested without a size; add --crop 512x512")

    @property
    def first_crop_at(self) -> Literal["centre", "random"]:
        """Position of the first crop."""
        return self.crop_at or ("centre" if self.crops == 1 else "random")

    def describe(self) -> dict[str, Any]:
        """Return the options as a JSON object, without unused ones."""
        options: dict[str, Any] = {"profiles": "honour"}
        if self.max_side is not None:
            options["max_side"] = self.max_side
        if self.crop is not None:
            options |= {"crop": list(self.crop), "cover": self.cover, "crop_at": self.first_crop_at}
        if self.crops > 1:
            options |= {"crops": self.crops}
        return options


UNPREPARED: Final = Preparation()  # The whole picture in its own size


@dataclass(frozen=True, eq=False, slots=True)
class Cut:
    """A crop: position of its top left pixel in the picture, px, and its codes (H, W, 3) uint8."""

    left: int
    top: int
    picture: Picture


@dataclass(frozen=True, eq=False, slots=True)
class SourcePicture:
    """A source picture that was read.

    - `picture`: (H, W, 3) uint8, sRGB codes; the first crop if there are several.
    - `sha256`: SHA-256 of the file; None if there is no file. `open_picture` leaves it None.
    - `profile`: treatment of its colour profile, such as ``"Display P3, converted to sRGB"``; empty without a file.
    - `cuts`: the crops, if several were requested.
    - `notes`: other conversions that may change the look of the picture.
    """

    picture: Picture
    sha256: str | None = None
    profile: str = ""
    cuts: tuple[Cut, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class _FileValues:
    """Content of a picture file before conversion.

    - `pixels`: (H, W, 3), codes 0 … 255, or linear values 0 … 1 in float64.
    - `alpha`: (H, W), 0 … 1; None without transparency.
    - `is_associated`: whether the colours are multiplied by alpha already.
    """

    pixels: npt.NDArray[Any]
    alpha: npt.NDArray[np.float64] | None
    is_associated: bool
    is_linear: bool
    orientation: int
    icc: bytes | None
    is_adobe_rgb: bool = False
    space: RgbSpace | None = None  # space of `pixels`, if it is neither sRGB nor given by `icc`


def read_picture(path: Path | str, max_side: int | None = None) -> Picture:
    """Read a picture file as sRGB codes; the module docstring lists the steps.

    Parameters
    ----------
    path
        Any file that OpenImageIO can read.
    max_side
        Longest side allowed, px; a larger picture is reduced. None allows any size.

    Returns
    -------
    ndarray
        (H, W, 3) uint8, sRGB codes.

    Raises
    ------
    FormatError
        If the file cannot be read as a picture.

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
    """Read a picture file as sRGB codes with notes on the conversion; the module docstring lists the steps.

    `name`: name of the picture, from which random positions of crops are derived; the file name if None. `data`: bytes
    of the file, if they were read already. `most_pixels`: largest number of pixels; `LARGEST_PICTURE` if None.
    """
    values = _read(path, data, LARGEST_PICTURE if most_pixels is None else most_pixels)
    pixels = values.pixels
    if values.is_linear:
        pixels = np.clip(np.nan_to_num(pixels, nan=0.0, posinf=1.0, neginf=0.0), 0.0, None)
    if values.alpha is not None:
        coverage = values.alpha[..., None]
        white = (1.0 - coverage) * (1.0 if values.is_linear else 255.0)
        pixels = (pixels if values.is_associated else pixels * coverage) + white
    if values.space is not None:
        codes = values.space.srgb_codes(pixels if values.is_linear else pixels / 255)
    elif values.is_linear:
        codes = srgb_codes(pixels)
    else:
        # Rounding takes seconds for a large picture; 8-bit codes need none.
        codes = (pixels if pixels.dtype == np.uint8 else np.rint(np.clip(pixels, 0, 255))).astype(np.uint8, copy=False)
    if values.space is not None:
        treatment = f"{values.space.name}, converted to sRGB"
    elif values.is_linear:
        treatment = "linear light, encoded as sRGB"
    elif values.icc is None and not values.is_adobe_rgb:
        treatment = "none, taken as sRGB"
    elif values.icc is not None:
        codes, treatment = to_srgb(codes, values.icc)
    else:
        codes, treatment = from_adobe_rgb(codes), ADOBE_RGB
    note_conditions = {
        LINEAR: values.is_linear,
        TRANSPARENT: values.alpha is not None,
        PROFILE_UNUSED: values.icc is not None and treatment.endswith("taken as sRGB"),
    }
    codes = upright(codes, values.orientation)
    cuts = _crops(codes, preparation, path, path.name if name is None else name)
    notes = tuple(note for note, applies in note_conditions.items() if applies)
    several_crops = cuts if preparation.crops > 1 else ()
    return SourcePicture(cuts[0].picture, profile=treatment, cuts=several_crops, notes=notes)


def _read(path: Path, data: bytes | None, most_pixels: int) -> _FileValues:
    if not path.is_file():
        raise FormatError(f"cannot read {path}: no such file; correct the path")
    chunks = _checked_png(path, data)
    values = _read_values(path, data, most_pixels, chunks)
    has_profile = b"iCCP" in chunks and values.space is None
    # OpenImageIO silently drops a profile that it cannot use. It is replaced by an empty one, which counts as damaged.
    profile_was_dropped = has_profile and values.icc is None and not values.is_adobe_rgb
    return replace(values, icc=b"") if profile_was_dropped else values


# Chunks of a PNG that state its colour space (PNG, third edition, clause 5.6).
_COLOUR_CHUNKS: Final = (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM")


def _checked_png(path: Path, data: bytes | None) -> Mapping[bytes, bytes]:
    # Returns the chunks of a PNG that state its colour space. Truncated or damaged pixels are refused here, because
    # libpng would print its own messages.
    try:
        with path.open("rb") as stream:
            if stream.read(len(SIGNATURE)) != SIGNATURE:
                return {}
            content = memoryview(SIGNATURE + stream.read() if data is None else data)
    except OSError:
        # OpenImageIO reports the fault.
        return {}
    position, colour_chunks = len(SIGNATURE), dict[bytes, bytes]()
    while position + 8 <= len(content):
        size, chunk_type = struct.unpack(">I4s", content[position : position + 8])
        end = position + 12 + size
        if chunk_type in _COLOUR_CHUNKS:
            colour_chunks[chunk_type] = bytes(content[position + 8 : end - 4])
        if chunk_type in (b"IHDR", b"PLTE", b"IDAT"):
            is_truncated = end > len(content)
            if is_truncated or zlib.crc32(content[position + 4 : end - 4]) != int.from_bytes(content[end - 4 : end]):
                fault = "it ends within" if is_truncated else "wrong checksum of"
                raise FormatError(
                    f"cannot read {path}: {fault} chunk {chunk_type.decode()} at byte {position}; the file is damaged, "
                    "use another copy"
                )
        position = end
    return colour_chunks


def _png_space(chunks: Mapping[bytes, bytes]) -> RgbSpace | None:
    # The first of cICP, iCCP, sRGB, and gAMA with cHRM is valid (PNG, third edition, clause 13.14).
    if len(codes := chunks.get(b"cICP", b"")) == 4:
        return space_of_cicp(codes)
    gamma, chromaticities = chunks.get(b"gAMA", b""), chunks.get(b"cHRM", b"")
    if b"iCCP" in chunks or b"sRGB" in chunks or (len(gamma), len(chromaticities)) not in ((4, 0), (4, 32), (0, 32)):
        return None
    file_gamma = struct.unpack(">I", gamma)[0] / 100_000 if gamma else 0.0
    points = [value / 100_000 for value in struct.unpack(">8I", chromaticities)] if chromaticities else None
    return space_of_gamma(file_gamma, points)


# First lines of a Radiance file, which may give x, y of red, green, blue and white.
_RADIANCE_HEAD_BYTES: Final = 4096
_RADIANCE_PRIMARIES: Final = re.compile(rb"^PRIMARIES=((?:\s+[-+.0-9eE]+){8})\s*$", re.MULTILINE)


def _stated_space(path: Path, stream: Any, chunks: Mapping[bytes, bytes], icc: bytes | None) -> RgbSpace | None:
    # The colour space that a file states by primaries and transfer function, or by a profile of linear light.
    if b"cICP" not in chunks and icc is not None:
        return linear_space(icc)
    if chunks:
        return _png_space(chunks)
    spec = stream.spec()
    if (cicp := spec.getattribute("CICP")) is not None:
        return space_of_cicp(cicp)
    if (chromaticities := spec.getattribute("chromaticities")) is not None:
        return space_of_primaries("linear light by chromaticities", chromaticities)
    name = str(spec.get_string_attribute("oiio:ColorSpace"))
    if stream.format_name() == "hdr":
        with path.open("rb") as stream:
            primaries = _RADIANCE_PRIMARIES.search(stream.read(_RADIANCE_HEAD_BYTES).partition(b"\n\n")[0])
        if primaries:
            return space_of_primaries("linear light by PRIMARIES", [float(value) for value in primaries[1].split()])
    elif name and not name.lower().startswith(_KNOWN_SPACES):
        raise FormatError(f"its colour space {name} is not supported, expected sRGB; convert it to an sRGB PNG")
    return None


# Beginnings of the names of colour spaces in OpenImageIO that are read as sRGB or as linear light.
_KNOWN_SPACES: Final = ("srgb", "rec709", "lin_srgb", "lin_rec709", "linear", "scene_linear", "g22_rec709")


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    with ExitStack() as resources:
        try:
            stream = resources.enter_context(opened_image(path))
        except ValueError as error:
            reason = _reason(str(error))
            raise FormatError(f"cannot read {path}: {reason}; use another picture, or convert it to PNG") from error
        yield stream


def _read_values(path: Path, data: bytes | None, most_pixels: int, chunks: Mapping[bytes, bytes]) -> _FileValues:
    import OpenImageIO as oiio  # noqa: N813

    with _opened(path) as stream:
        spec = stream.spec()
        if spec.deep or spec.depth > 1 or spec.nchannels < 1:
            raise FormatError(f"cannot read {path}: it is a deep or 3D picture, expected a flat one; convert it to PNG")
        if spec.width * spec.height > most_pixels:
            raise FormatError(
                f"cannot read {path}: {spec.width}x{spec.height} px, at most {most_pixels} pixels allowed; reduce it"
            )
        space = str(spec.get_string_attribute("oiio:ColorSpace")).lower()
        base_type = spec.format.basetype
        is_floating = base_type in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        icc_values = spec.getattribute("ICCProfile")
        icc = None if icc_values is None else np.asarray(icc_values, dtype=np.uint8).tobytes()
        try:
            own_space = _stated_space(path, stream, chunks, icc)
        except FormatError as error:
            raise FormatError(f"cannot read {path}: {error}") from error
        own_space = None if own_space is None or own_space.is_srgb else own_space
        is_encoded = "srgb" in space.replace("lin_srgb", "") or (icc is not None and own_space is None)
        is_linear = is_floating and not is_encoded
        pixels = None
        if stream.format_name() == "jpeg" and spec.nchannels == 3:
            pixels = _decode_jpeg(path.read_bytes() if data is None else data)
        if pixels is None:
            pixels = stream.read_image("float" if is_floating else "uint8" if base_type == oiio.UINT8 else "uint16")
        if pixels is None or stream.has_error:
            raise FormatError(
                f"cannot read {path}: {_reason(stream.geterror())}; the file is damaged, use another copy"
            )
        is_separate = spec.get_int_attribute("oiio:UnassociatedAlpha", 0) or stream.format_name() not in _PREMULTIPLIED
        orientation = spec.get_int_attribute("Orientation", 1)
        is_uncalibrated = spec.get_int_attribute("Exif:ColorSpace", 0) == _UNCALIBRATED
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    transparency = alpha_channel(spec)
    alpha = None
    if transparency is not None:
        largest = 1.0 if is_floating else float(np.iinfo(pixels.dtype).max)
        alpha = np.clip(pixels[..., transparency].astype(np.float64) / largest, 0.0, 1.0)
        # The fourth byte of a plain BMP file is unused, and most programs write 0.
        if alpha.min() == 1.0 or (not alpha.any() and stream.format_name() == "bmp"):
            alpha = None
    colours = [channel for channel in range(spec.nchannels) if channel != transparency]
    if colours[:3] == [0, 1, 2]:
        values = pixels[..., :3]
    else:
        values = pixels[..., colours[:3] if len(colours) >= 3 else [colours[0] if colours else 0] * 3]
    if own_space is not None and not is_floating:
        values = values * (255.0 / np.iinfo(values.dtype).max)
    elif values.dtype == np.uint16:
        values = ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif is_floating:
        values = values.astype(np.float64) * (1.0 if is_linear else 255.0)
    is_associated = not is_separate
    if alpha is not None and not is_floating:
        # A value above alpha cannot have been multiplied by alpha, even if the format usually stores such products.
        is_associated = is_associated and not bool(np.any(values > 255.0 * alpha[..., None] + 1.0))
    is_adobe_rgb = is_uncalibrated and icc is None and own_space is None and _interoperability(path) == "R03"
    return _FileValues(values, alpha, is_associated, is_linear, orientation, icc, is_adobe_rgb, own_space)


def _interoperability(path: Path) -> str:
    from PIL import Image
    from PIL.ExifTags import IFD

    try:
        with Image.open(path) as picture:
            index = picture.getexif().get_ifd(IFD.Interop).get(1, "")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        # The EXIF data are damaged, or the picture is too large for Pillow. OpenImageIO has already read the picture.
        return ""
    return str(index).strip("\0 ")


def _decode_jpeg(data: bytes) -> npt.NDArray[np.uint8] | None:
    # simplejpeg decodes a usual colour JPEG in half the time of OpenImageIO.
    import simplejpeg

    try:
        if simplejpeg.decode_jpeg_header(data)[2] != "YCbCr":
            return None
        return simplejpeg.decode_jpeg(data, strict=True)
    except ValueError:
        # OpenImageIO reads it, or reports the fault.
        return None


def _reason(message: str) -> str:
    return " ".join(message.split()).rstrip(".") or "unknown picture format"


def _crops(picture: Picture, preparation: Preparation, path: Path, name: str) -> tuple[Cut, ...]:
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
        raise FormatError(f"cannot crop {path}: it has {width}x{height} px, the crop {wide}x{high}; use a smaller crop")
    centre = ((width - wide) // 2, (height - high) // 2)
    positions = [centre]
    if preparation.first_crop_at == "random" or preparation.crops > 1:
        starts = (width - wide + 1, height - high + 1)
        if preparation.crops > starts[0] * starts[1]:
            raise FormatError(
                f"cannot cut {preparation.crops} different crops of {wide}x{high} px from {path}: its "
                f"{width}x{height} px allow only {starts[0] * starts[1]}; use fewer or smaller crops"
            )
        first = centre if preparation.first_crop_at == "centre" else None
        positions = random_positions(starts, (wide, high), preparation.crops, preparation.seed, name, first)
    return tuple(
        Cut(left, top, np.ascontiguousarray(picture[top : top + high, left : left + wide])) for left, top in positions
    )


def _shrink(picture: Picture, scale: float) -> Picture:
    if scale >= 1:
        return picture
    import cv2

    height, width = picture.shape[:2]
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


# Suffixes of pictures in a folder, in upper or lower case; a file that is named directly may have any suffix.
SUFFIXES: Final = frozenset(
    {".bmp", ".dpx", ".exr", ".gif", ".hdr", ".j2k", ".jp2", ".jpe", ".jpeg", ".jpg"}
    | {".jxl", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".psd", ".rgbe", ".sgi", ".tga", ".tif", ".tiff", ".webp"}
)

# Suffixes of pictures that no installed library reads; such pictures in a folder are reported.
UNREADABLE: Final = frozenset({".avif", ".heic", ".heif"})

# Backslashes before a byte that is not UTF-8, or before text that looks like an escaped byte, such as x8a.
_BYTE_LIKE: Final = re.compile(r"\\+(?=x[89a-f][0-9a-f]|[\udc80-\udcff])")
# Files up to this size are read once, for both hash and decoding: 32 MiB are little next to the decoded picture.
_BYTES_READ_AT_ONCE: Final = 1 << 25

_log = logging.getLogger(__name__)

# Read errors caused by the machine or its storage, not by the file.
_MACHINE_ERRORS: Final = frozenset(
    {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN}
)


class Source(Protocol):
    """A source picture, from a file or random."""

    @property
    def name(self) -> str:
        """Name of the picture in the data set."""
        ...

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; raise FormatError if it cannot be read."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Return the parameters of the picture as a JSON object, without the location of a file."""
        ...


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A picture file on this machine or on a store that fsspec supports.

    - `root`: path or URL of the searched folder; the file itself if it was named directly.
    - `relative_path`: path below the root with forward slashes; empty if the file was named directly.
    - `preparation`: requested size and crops.
    """

    root: str
    relative_path: str
    preparation: Preparation = UNPREPARED

    @property
    def name(self) -> str:
        r"""Name in the data set: path below the folder, with \xNN for bytes that are not text.

        To keep names distinct, backslashes are doubled before such a byte and before text such as ``x8a``.
        """
        name = self.relative_path or PurePosixPath(masked(self.root).replace(os.sep, "/")).name
        name = _BYTE_LIKE.sub(lambda match: 2 * match[0], name)
        text = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        # Many CSV readers end a line at a carriage return, even if quoted.
        return text.replace("\r", "\\r")

    def to_json(self) -> dict[str, Any]:
        """Return name and preparation as a JSON object."""
        return {"picture": self.name, **self.preparation.describe()}

    @property
    def location(self) -> str:
        """Path or URL of the file."""
        return f"{self.root.rstrip('/')}/{self.relative_path}" if self.relative_path else self.root

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; see `open_picture`."""
        with _local_file(self.location) as path:
            try:
                sha256, data = _hashed(path)
                picture = open_picture(path, self.preparation, self.name, data)
            except FormatError as error:
                raise FormatError(str(error).replace(str(path), self.location)) from error
            except OSError as error:
                raise _unreadable_error(self.location, error, _is_file_fault(path, error)) from error
            except MemoryError as error:
                raise InputError(
                    f"there is not enough memory to read {self.location}; use fewer workers, or remove the picture"
                ) from error
        return replace(picture, sha256=sha256)


def changed_sha256(source: Source, since: float) -> str | None:
    """Return the SHA-256 of the local file of a source if it was changed after the time `since`.

    Returns None if there is no local file, or if it is unchanged. A removed file has an empty hash.
    """
    file: object = getattr(source, "source", source)
    if not isinstance(file, PictureFile) or is_remote(file.location):
        return None
    try:
        status = Path(file.location).stat()
        # ctime changes whenever mtime does, and no program can set it back.
        return file_sha256(Path(file.location)) if max(status.st_mtime, status.st_ctime) > since else None
    except OSError:
        return ""


@contextmanager
def _local_file(location: str) -> Generator[Path]:
    """Yield a local path of a file; a remote file is copied, and the copy is removed at the end."""
    if not is_remote(location):
        yield Path(location)
        return
    store, path = filesystem(location)
    try:
        copy = tempfile.NamedTemporaryFile(prefix="crop-", suffix=PurePosixPath(location).suffix)  # noqa: SIM115
    except OSError as error:
        raise _unreadable_error(location, error, is_file_fault=False) from error
    with copy:
        try:
            store.get_file(path, copy.name)
        except Exception as error:
            # Each store has its own exceptions.
            is_gone = isinstance(error, FileNotFoundError)
            raise _unreadable_error(location, error, is_file_fault=is_gone and _folder_exists(store, path)) from error
        yield Path(copy.name)


def _hashed(path: Path) -> tuple[str, bytes | None]:
    # The bytes of a small file are also returned, so that it is read once. Unbuffered reading saves four system calls.
    with path.open("rb", buffering=0) as stream:
        if os.fstat(stream.fileno()).st_size > _BYTES_READ_AT_ONCE:
            return stream_sha256(stream), None
        data = stream.read()
    return sha256_of(data), data


def _is_file_fault(path: Path, error: OSError) -> bool:
    if error.errno in _MACHINE_ERRORS:
        return False
    # The file is not at fault if its disk is not mounted or fails: then the folder is missing, empty or cannot be
    # listed.
    try:
        with os.scandir(path.parent) as entries:
            return next(entries, None) is not None
    except OSError:
        return False


def _folder_exists(store: AbstractFileSystem, path: str) -> bool:
    try:
        store.invalidate_cache()
        return bool(store.isdir(path.rpartition("/")[0]))
    except Exception:
        return False


def _unreadable_error(location: str, error: Exception, is_file_fault: bool) -> FormatError | StorageError:
    reason = " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split()).rstrip(".")
    if is_file_fault:
        return FormatError(f"cannot read {location}: {reason}; use another picture")
    return StorageError(
        f"cannot read {location}: {reason}; make it readable on every machine that works on the data set, then run the "
        "same command again"
    )


def find_pictures(
    locations: Sequence[Path | str] | Path | str, preparation: Preparation = UNPREPARED
) -> tuple[PictureFile, ...]:
    """Find the pictures of folders and files.

    A folder is searched for files with one of the `SUFFIXES`, including its subfolders, except hidden folders and data
    sets. A link to a folder is followed unless that folder is searched already or contains a searched one, so no
    picture occurs twice. Pictures are sorted by their path below the folder, by code point; the order of `locations` is
    kept. No file is opened. One million pictures need about 0.2 GB of memory. Pictures that cannot be read
    (`UNREADABLE`) are logged as a warning.

    Parameters
    ----------
    locations
        Local paths, or URLs that fsspec supports, such as ``s3://bucket/folder``; or a single one.
    preparation
        Preparation of each picture.

    Returns
    -------
    tuple of PictureFile
        The pictures.

    Raises
    ------
    InputError
        If a location is missing or is neither file nor folder, a folder has no picture, or two pictures have one name.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for name in ("b.png", "a.JPG", "notes.txt"):
    ...         Path(folder, name).touch()
    ...     [picture.name for picture in find_pictures(folder)]
    ['a.JPG', 'b.png']
    """
    pictures: list[PictureFile] = []
    location_list = (locations,) if isinstance(locations, Path | str) else locations
    for location in location_list:
        is_url = is_remote(str(location))
        # Absolute, because a worker may have another working folder.
        root = str(location) if is_url else os.path.abspath(local_path(location))  # noqa: PTH100  keeps links
        if not is_url and not os.path.lexists(root):
            raise InputError(f"{location} does not exist; name a picture or a folder of pictures")
        if not is_url and Path(root).exists() and not (Path(root).is_dir() or Path(root).is_file()):
            raise InputError(f"{location} is a device or a pipe; name a picture or a folder of pictures")
        if not is_url and not Path(root).is_dir():
            pictures.append(PictureFile(root, "", preparation))
            continue
        previous_count = len(pictures)
        search = _Search(root)
        relative_paths = _below_url(root, search) if is_url else _below_folder(root, search)
        pictures += [PictureFile(root, name, preparation) for name in relative_paths]
        warning = search.warning_text(masked(root))
        if len(pictures) == previous_count:
            expected = f"expected files with one of the suffixes {' '.join(sorted(SUFFIXES))}"
            raise InputError(warning or f"{root} contains no picture, {expected}; name another folder")
        if warning:
            _log.warning(warning)
    if len(location_list) > 1:
        _require_unique_names(pictures)
    return tuple(pictures)


def _require_unique_names(pictures: Sequence[PictureFile]) -> None:
    by_name: dict[str, PictureFile] = {}
    for picture in pictures:
        if (existing := by_name.setdefault(picture.name, picture)) is not picture:
            if existing.location == picture.location:
                raise InputError(f"{picture.location} is named twice; name it, or its folder, once")
            raise InputError(
                f"two pictures have the name {picture.name}: {existing.location} and {picture.location}; name a folder "
                "that contains both, or rename one"
            )


def _is_unreadable(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in UNREADABLE  # noqa: PTH122  as below


def _is_picture(name: str) -> bool:
    return os.path.splitext(name)[1].lower() in SUFFIXES  # noqa: PTH122  a million Path objects take a minute


class _Search:
    """State of a search: followed folders and pictures that cannot be read."""

    def __init__(self, root: str) -> None:
        self._searched = [root if is_remote(root) else os.path.realpath(root)]
        self._unreadable_count = 0
        self._first_unreadable = ""

    def follows(self, link: str) -> bool:
        """Return False for a link to a folder that was searched, is in a searched folder, or contains one."""
        target = os.path.realpath(link)
        for folder in self._searched:
            if os.path.commonpath([folder, target]) in (folder, target):
                _log.info("link %s is not followed: %s is searched already or contains a searched folder", link, target)
                return False
        self._searched.append(target)
        return True

    def skip(self, name: str) -> None:
        """Count a picture that cannot be read."""
        self._unreadable_count += 1
        self._first_unreadable = self._first_unreadable or name

    def warning_text(self, location: str) -> str | None:
        """Return a warning about pictures that cannot be read; None if there are none."""
        if not self._unreadable_count:
            return None
        others_text = f" and {self._unreadable_count - 1} more" if self._unreadable_count > 1 else ""
        return (
            f"{location} contains {self._first_unreadable}{others_text}, skipped: HEIC and AVIF cannot be read; "
            "convert them to JPEG or PNG"
        )


def _below_folder(folder: str, search: _Search, prefix: str = "") -> Iterator[str]:
    """Yield the pictures below a folder in the order of their paths."""
    linked_folders: set[str] = set()
    try:
        with os.scandir(folder) as entries:
            names: list[str] = []
            for entry in entries:
                name = entry.name
                if name.startswith("."):
                    continue
                if _entry_is(entry.is_dir):
                    # The name of a folder is sorted with a slash at the end, as in a path.
                    names.append(f"{name}/")
                    if entry.is_symlink():
                        linked_folders.add(f"{name}/")
                elif name == DESCRIPTION or (_is_picture(name) and _entry_is(entry.is_file)) or _is_unreadable(name):
                    names.append(name)
            names.sort()
    except OSError as error:
        raise InputError(f"cannot list {folder}: {error.strerror}; name a readable folder") from error
    if DESCRIPTION in names:
        # A data set below the searched folder, perhaps made from these pictures, is skipped.
        if prefix:
            return
        names.remove(DESCRIPTION)
    for name in names:
        if name.endswith("/"):
            path = f"{folder.rstrip('/')}/{name[:-1]}"
            if name not in linked_folders or search.follows(path):
                yield from _below_folder(path, search, prefix + name)
        elif _is_unreadable(name):
            search.skip(prefix + name)
        else:
            yield prefix + name


def _entry_is(query: Callable[[], bool]) -> bool:
    # For a link, the query is about its target. A circle of links has no target, so the answer is False.
    try:
        return query()
    except OSError as error:
        if error.errno == errno.ELOOP:
            return False
        raise


def _below_url(url: str, search: _Search) -> list[str]:
    store, root = filesystem(url)
    try:
        if store.isfile(root):
            return [""]
        root_path = PurePosixPath(root)
        paths = [PurePosixPath(path).relative_to(root_path) for path in store.find(root)]
    except Exception as error:
        # Each store has its own exceptions.
        raise remote_error(error, "list", url) from error
    datasets = {path.parent for path in paths if path.name == DESCRIPTION and len(path.parts) > 1}
    names = sorted(
        path.as_posix()
        for path in paths
        if not any(component.startswith(".") for component in path.parts) and datasets.isdisjoint(path.parents)
    )
    for name in filter(_is_unreadable, names):
        search.skip(name)
    return list(filter(_is_picture, names))
