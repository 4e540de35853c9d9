"""A 16-bit linear image as the bytes of a file, losslessly, and back; masks and previews beside it.

    png     16-bit RGB; read by everything; the smallest of photographs
    tiff    16-bit RGB, uncompressed: the fastest to write and to read
    exr     OpenEXR, 32-bit float, which holds every 16-bit number (half does not); compressed by zip
    jxl     JPEG XL, lossless, 16 bits: the smallest of smooth pictures
    dng     a raw file: the Bayer mosaic of the image, two thirds of the values left out, as by a sensor

Every encoder releases the interpreter's lock while it computes (not while it copies uncompressed pixels into the file),
and no byte depends on the number of threads. Beside image and file a PNG takes some megabytes, however large.

This is the room's door: code of other rooms imports this file and no other of `generator.files`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from generator.files.full_scale import FULL, from_full_scale, to_full_scale
from generator.files.metadata import ImageMetadata

__all__ = [
    "FORMATS",
    "FULL",
    "Format",
    "ImageMetadata",
    "decode_array",
    "decode_image",
    "encode_image",
    "encode_map",
    "encode_pieces",
    "encode_preview",
    "from_full_scale",
    "libraries_of",
    "require_plausible",
    "smallest_side",
    "suffix_of",
    "to_full_scale",
]

Format = Literal["png", "tiff", "exr", "jxl", "dng"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)

_LIBRARIES: Final[dict[Format, tuple[str, ...]]] = {
    "png": (),
    "tiff": (),
    "exr": ("isal",),
    "jxl": ("imagecodecs",),
    "dng": ("rawpy",),
}
"""Distributions that encode a format, or for a raw file name its colour matrix."""

_JPEG_QUALITY: Final = 92
"""Of previews, on libjpeg's scale to 100: no blocks are visible."""


_LONGEST_JPEG: Final = 65500
"""Longest side that libjpeg writes, px (its JPEG_MAX_DIMENSION)."""

_DEFLATE_RATIO: Final = 1032
"""Bytes that deflate makes of one at most (RFC 1951: 258 of two bits)."""


def suffix_of(form: Format) -> str:
    """Return the suffix of file names of that format, such as ``.png``."""
    return f".{form}"


def libraries_of(form: Format) -> tuple[str, ...]:
    """Return the distributions whose version may change the bytes of a file of that format; none if CroP encodes it."""
    if form == "jxl":
        from generator.files.jxl import imagecodecs

        imagecodecs()
    return _LIBRARIES[form]


def smallest_side(form: Format) -> int:
    """Return the least width and height, px, of an image in that format."""
    if form != "dng":
        return 1
    from generator.files.dng import SMALLEST_SIDE

    return SMALLEST_SIDE


def encode_image(image: npt.NDArray[np.uint16], form: Format, metadata: ImageMetadata) -> bytes:
    """Return `image` as the bytes of a file.

    `image`: (H, W, 3) uint16, linear camera RGB.

    Examples
    --------
    >>> image = np.full((4, 6, 3), 1000, np.uint16)
    >>> data = encode_image(image, "png", ImageMetadata(white_level=4095, white=(0.4, 1.0, 0.7), camera="Maker Model"))
    >>> data[1:4]
    b'PNG'
    >>> decode_image(data, "png", "a.png")[0, 0]
    array([1000, 1000, 1000], dtype=uint16)
    """
    _check(image)
    if form == "png":
        from generator.files.png import encode_png

        return encode_png(image, metadata)
    if form == "tiff":
        from generator.files.tiff import encode_tiff

        return encode_tiff(image, metadata)
    if form == "exr":
        from generator.files.exr import encode_exr

        return encode_exr(image, metadata)
    if form == "jxl":
        from generator.files.jxl import encode_jxl

        return encode_jxl(image)
    from generator.files.dng import encode_dng

    return encode_dng(image, metadata)


def encode_pieces(image: npt.NDArray[np.uint16], form: Format, metadata: ImageMetadata) -> Iterable[bytes | memoryview]:
    """Return the file of `image` (H, W, 3) uint16 in pieces, whose memory may be used again for the next one.

    Pieces of a PNG are encoded one after the other, so that a file of any size needs little memory. The parameters are
    those of `encode_image`.
    """
    _check(image)
    if form == "png":
        from generator.files.png import png_pieces

        return png_pieces(image, metadata)
    return (encode_image(image, form, metadata),)


def _check(image: npt.NDArray[np.uint16]) -> None:
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image is {image.dtype} {image.shape}, expected uint16 (height, width, 3)")


def decode_image(data: bytes, form: Format, what: str) -> npt.NDArray[np.uint16]:
    """Return the image that `encode_image` made a file of.

    `data`: the file's bytes. Returns (H, W, 3) uint16, as it was encoded; of `dng` (H // 2, W // 2, 3), the half-size
    linear RGB of its mosaic: red, the mean of both greens, rounded up, and blue of each 2×2 block.
    """
    if form == "dng":
        from drivers.raw.rawfile import decode_raw
        from generator.files.dng import half_size

        return half_size(decode_raw(data, Path(what)).counts)
    require_plausible(data, what)
    try:
        image = decode_array(data, form)
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(f"{what} cannot be read as {form}: {reason}; make it again") from error
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3:
        raise FormatError(f"{what} holds {image.dtype} {image.shape}, expected uint16 (height, width, 3)")
    return image.astype(np.uint16, copy=False)


def require_plausible(data: bytes, what: str) -> None:
    """Refuse a PNG file that claims more pixels or bytes than it can hold; says nothing of other formats.

    Deflate makes at most 1032 bytes of one (zlib's "Maximum Compression Factor"): a decoder that believed the head
    would fill memory before it found that there is nothing (ISO/IEC 15948, 5.3 and 11.2.2).

    `data`: the file's bytes.
    """
    if len(data) < 26 or data[:8] != b"\x89PNG\r\n\x1a\n":
        return
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    channels = {2: 3, 4: 2, 6: 4}.get(colour, 1)
    claimed = height * (1 + width * channels * depth // 8)
    if claimed > _DEFLATE_RATIO * len(data):
        raise FormatError(f"{what} claims {width}x{height} px, which its {len(data)} bytes cannot hold; make it again")
    place = 8
    while place + 12 <= len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        if size > len(data) - place - 12:
            left = len(data) - place - 12
            raise FormatError(f"{what}: a part of the PNG claims {size} bytes where {left} are left; make it again")
        place += size + 12


def decode_array(data: bytes, form: Format) -> npt.NDArray[np.generic]:
    """Return the array in a file's bytes, (H, W) or (H, W, channels), uint8, uint16 or float32, as it stands there."""
    if form == "png":
        from generator.files.png import decode_png

        return decode_png(data)
    if form == "tiff":
        from generator.files.tiff import decode_tiff

        return decode_tiff(data)
    if form == "jxl":
        from generator.files.jxl import decode_jxl

        return decode_jxl(data)
    from generator.files.exr import decode_exr

    return decode_exr(data)


def encode_map(values: npt.NDArray[np.uint16]) -> bytes:
    """Return smooth `values` (H, W) or (H, W, 3) uint16, such as a mask of weights, as the bytes of a 16-bit PNG."""
    from generator.files import maps

    return maps.encode_map(values)


def encode_preview(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return `picture` (H, W, 3) uint8, RGB, as the bytes of a JPEG file."""
    import simplejpeg

    if max(picture.shape) > _LONGEST_JPEG:
        raise InputError(
            f"a preview of {picture.shape[1]}x{picture.shape[0]} px cannot be written as JPEG; make it smaller"
        )
    pixels = np.ascontiguousarray(picture)
    return simplejpeg.encode_jpeg(pixels, _JPEG_QUALITY, colorspace="RGB", colorsubsampling="420")
