"""A 16-bit linear image as the bytes of a file, losslessly, and back; masks and previews beside it.

docs/formats.md says what each format is, and `docs/decisions/0011-image-files.md` what else was weighed. Every encoder
releases the interpreter's lock while it computes (not while it copies uncompressed pixels into the file). Beside image
and file a PNG takes some megabytes, however large.

**PNG** (ISO/IEC 15948). Chunks are written here around `generator.deflate`; one of data holds a band of rows. Values
are the image's own: no gAMA, cICP or iCCP chunk, since camera RGB is no display's and some readers would convert, and
no sBIT, since values lie at the lower end of the 16 bits. Maps are smooth: of differences to the row above ISA-L makes
as few bytes as OpenCV's writer does, in a fifth of its time; its bytes depend on its version and may on the processor,
but on nothing else if it is used as `docs/decisions/0051-first-bytes-apart.md` says.

**TIFF** 6.0 as every reader can read it: one uncompressed strip. The zstd codec is missing from widespread readers,
and deflate, at the speed of their TIFF writers, costs more time than it saves room.

**OpenEXR**, scan lines under zip, saturation at the white level. Written here, since the libraries at hand write to
named files only. Source: "OpenEXR File Layout" and "Technical Introduction to OpenEXR", version 2 of the file, one
part; the reordering and prediction before zip are those of the reference implementation (ImfZip).

**JPEG XL** (ISO/IEC 18181) at its lowest effort; it has no place for the image's metadata.

**DNG** 1.7.1, chapters 2 and 4. Each photosite of the RGGB pattern takes its own channel of its pixel. Black is 0,
white the table's saturation, AsShotNeutral the ground truth, so that a raw program shows neutral things as neutral.
The colour matrix is the one that LibRaw holds for the table's camera or, for a camera unknown to it, that of linear
sRGB: neutral things stay neutral with both, other colours are right with the first only. The file names CroP as its
maker, so that no program applies facts of the camera's own files to it, such as their black level.

**Previews** are the image in camera colours, made small and tone mapped by Flash, as JPEG. An image of 16 bits has few
values, so every logarithm and power is taken once for each value and not once for each pixel. Nothing here starts
threads of its own: the images of a dataset are made by as many threads as there are processors. Flash is N. Banić,
S. Lončarić, "Flash and Storm: fast and highly practical tone mapping based on Naka-Rushton equation", VISAPP 2018; used
for the previews as the paper uses it in its figure of the generation process, and in its section 4.2.
"""

from __future__ import annotations

import io
import json
import math
import struct
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from isal import isal_zlib
from numpy import float32, uint8, uint16, uint32, uint64

from drivers.raw.rawfile import Matrix, camera_matrix, decode_raw
from drivers.tiff import CFA, D65, RGB, Tags, TiffTag, ValueType, head, rationals, text
from foundation.compiled import compiled
from foundation.errors import CropError, FormatError, InputError
from generator.deflate import WIDEST, Packer

Image = npt.NDArray[np.uint16]
Format = Literal["png", "tiff", "exr", "jxl", "dng"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)

_threads = threading.local()  # Each thread's packer of PNG, with its working memory


@dataclass(frozen=True)
class ImageMetadata:
    """Light and camera of one image.

    - `white_level`: value of saturation, 1 … 65535, in the units of the image.
    - `white`: linear camera RGB of an achromatic surface under the image's light, of any length: the ground truth.
    - `camera`: maker and model, as the table has it.
    """

    white_level: int
    white: tuple[float, float, float]
    camera: str

    def to_json(self) -> str:
        """Return one line of JSON in ASCII, for formats with a place for a text."""
        values = {"white_level": self.white_level, "white": self.white, "camera": self.camera}
        return json.dumps({"format": "crop.image", "values": "linear camera RGB, black 0", **values})


FULL: Final = 65535  # Largest number of 16 bits, which saturation becomes


SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"  # The first bytes of every PNG file (clause 5.2)
TALLEST: Final = (1 << 31) - 1  # Largest size in the format (clause 11.2.2)
# Most pixels of a band, unless a row has more: 1.5 MiB, so that an image of any size needs little memory.
BAND: Final = 1 << 18
_ZLIB: Final = bytes([0x78, 0x01])  # Deflate, a window of 32 KiB, packed fast (RFC 1950, 2.2)
# Level of ISA-L's compression, of 0 to 3, for maps and for what OpenEXR's prediction leaves: both are smooth.
_LEVEL: Final = 1
# Bytes that are packed before all others; of more than 16 ISA-L would use the loop that is wrong at its start.
_APART: Final = 8
_UP: Final = 2  # The filter type Up (clause 9.2)
# Colour types (clause 11.2.2).
_GREY: Final = 0
_RGB: Final = 2


def png_pieces(image: Image, metadata: ImageMetadata) -> Iterator[bytes | memoryview]:
    """Yield the file of `image` (H, W, 3) uint16 piece by piece; the memory of each is used again for the next."""
    height, width, _ = image.shape
    if width > WIDEST or height > TALLEST:
        raise InputError(
            f"an image of {width}x{height} px is too large for PNG: {WIDEST} columns and {TALLEST} rows at most; "
            "make it smaller"
        )
    yield _head(width, height, _RGB)
    yield from _chunk(b"tEXt", b"Description\0" + metadata.to_json().encode("ascii"))
    rows = max(1, BAND // width)
    checksum = 1
    for top in range(0, height, rows):
        last = top + rows >= height
        data, plain = _packer().pack(np.ascontiguousarray(image[top : top + rows]), last=last)
        checksum = isal_zlib.adler32(plain.data, checksum)
        yield from _chunk(b"IDAT", b"" if top else _ZLIB, data.data, struct.pack(">I", checksum) if last else b"")
    yield from _chunk(b"IEND")


def _packer() -> Packer:
    if not hasattr(_threads, "packer"):
        _threads.packer = Packer()
    return _threads.packer


def encode_map(values: Image) -> bytes:
    """Return smooth `values` (H, W) or (H, W, 3) uint16, such as a mask of weights, as the bytes of a PNG."""
    height, width = values.shape[:2]
    plain = values.astype(">u2").view(np.uint8).reshape(height, -1)
    rows = np.empty((height, 1 + plain.shape[1]), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = plain[0]
    np.subtract(plain[1:], plain[:-1], out=rows[1:, 1:])
    head = _head(width, height, _GREY if values.ndim == 2 else _RGB)
    return b"".join([head, *_chunk(b"IDAT", _packed(rows)), *_chunk(b"IEND")])


def _packed(data: npt.NDArray[np.uint8]) -> bytes:
    """Return contiguous `data` as zlib data, RFC 1950, the same bytes in every process."""
    packer, plain = isal_zlib.compressobj(_LEVEL), data.reshape(-1).data
    # Given all at once, ISA-L takes what lies in a register for its hash of the third to the sixth byte.
    first = packer.compress(plain[:_APART]) + packer.flush(isal_zlib.Z_SYNC_FLUSH)
    return b"".join([first, packer.compress(plain[_APART:]), packer.flush()])


def _head(width: int, height: int, colour: int) -> bytes:
    size = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    return SIGNATURE + b"".join(_chunk(b"IHDR", size))


def _chunk(kind: bytes, *parts: bytes | memoryview) -> Iterator[bytes | memoryview]:
    """Yield the pieces of a chunk (clause 5.3)."""
    checksum = isal_zlib.crc32(kind)
    for part in parts:
        checksum = isal_zlib.crc32(part, checksum)
    yield struct.pack(">I", sum(len(part) for part in parts)) + kind
    yield from filter(None, parts)
    yield struct.pack(">I", checksum)


def decode_png(data: bytes) -> npt.NDArray[np.generic]:
    """Return what a PNG holds, (H, W) or (H, W, channels), RGB, uint8 or uint16, as it stands there."""
    import cv2

    # OpenCV would read other formats, too.
    found = None
    if data.startswith(SIGNATURE):
        found = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise ValueError("no whole PNG file")
    if found.ndim == 2:
        return found
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB if found.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


# Largest number of a signed 32-bit integer, which counts the columns of a window and the bytes of a chunk.
LARGEST_SIDE: Final = (1 << 31) - 1

# First bytes of every OpenEXR file of version 2 with scan lines in one part.
_MAGIC_AND_VERSION: Final = struct.pack("<ii", 20000630, 2)
_ZIP: Final = 3  # Number of the compression ZIP_COMPRESSION
_LINES: Final = 16  # Scan lines that ZIP_COMPRESSION packs together
_FLOAT: Final = 2  # Number of the pixel type FLOAT


def encode_exr(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16."""
    height, width, _ = image.shape
    if 12 * width * _LINES > LARGEST_SIDE:
        raise InputError(f"an image of {width}x{height} px is too wide for EXR; choose png or tiff, or make it smaller")
    start = _header(width, height, metadata)
    chunks = [_scan_lines(image, y) for y in range(0, height, _LINES)]
    sizes = np.array([len(chunk) for chunk in chunks], dtype=np.uint64)
    offsets = np.full(len(chunks), len(start) + 8 * len(chunks), dtype="<u8")
    offsets[1:] += np.cumsum(sizes[:-1], dtype=np.uint64)
    return b"".join([start, offsets.tobytes(), *chunks])


def decode_exr(data: bytes) -> Image:
    """Return the image (H, W, 3) uint16 of a file's bytes."""
    import OpenImageIO as oiio  # noqa: N813

    # OpenImageIO reads named files only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        path.write_bytes(data)
        stream = oiio.ImageInput.open(str(path))
        if stream is None:
            raise ValueError(oiio.geterror())
        values = stream.read_image("float")
        if values is None:
            raise ValueError(stream.geterror())
    values = np.asarray(values)
    image = values.astype(np.uint16) if values.size and values.min() >= 0 and values.max() <= 65535 else None
    if image is None or not np.array_equal(image, values):
        raise ValueError("its values are not whole numbers 0 to 65535")
    return image


def _header(width: int, height: int, metadata: ImageMetadata) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = struct.pack("<iB3xii", _FLOAT, 0, 1, 1)
    attributes = [
        _attribute("channels", "chlist", b"".join(name + b"\0" + channel for name in (b"B", b"G", b"R")) + b"\0"),
        _attribute("compression", "compression", bytes([_ZIP])),
        _attribute("crop:camera", "string", metadata.camera.encode()),
        _attribute("crop:white", "v3f", struct.pack("<3f", *metadata.white)),
        _attribute("crop:white_level", "int", struct.pack("<i", metadata.white_level)),
        _attribute("dataWindow", "box2i", window),
        _attribute("displayWindow", "box2i", window),
        _attribute("lineOrder", "lineOrder", b"\0"),
        _attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
        _attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        _attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
    ]
    return _MAGIC_AND_VERSION + b"".join(attributes) + b"\0"


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _scan_lines(image: Image, y: int) -> bytes:
    """Return the chunk of the scan lines from `y` on: channels B, G, R of a line, then the next line."""
    lines = image[y : y + _LINES, :, ::-1].transpose(0, 2, 1).astype("<f4", order="C")
    raw = lines.reshape(-1).view(np.uint8)
    # Bytes of even and of odd places are parted, then differences taken: so noise and exponents stand apart.
    apart = np.concatenate([raw[0::2], raw[1::2]])
    apart[1:] = apart[1:] - apart[:-1] + np.uint8(128)
    data = _packed(apart)
    # Data that do not become smaller are stored without reordering.
    body = data if len(data) < raw.nbytes else raw.tobytes()
    return struct.pack("<ii", y, len(body)) + body


def encode_jxl(image: Image) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, all 16 bits kept."""
    codecs = imagecodecs()
    try:
        return bytes(codecs.jpegxl_encode(np.ascontiguousarray(image), effort=1, lossless=True, numthreads=1))
    except codecs.JpegxlError as error:
        raise InputError(
            f"an image of {image.shape[1]}x{image.shape[0]} px cannot be written as JPEG XL: {error}; choose png"
        ) from error


def decode_jxl(data: bytes) -> npt.NDArray[np.generic]:
    """Return what a JPEG XL file holds, (H, W, channels) or (H, W), uint8, uint16 or float32 as it is stored."""
    return np.asarray(imagecodecs().jpegxl_decode(data, numthreads=1))


def imagecodecs() -> Any:
    """Return the module that has libjxl; a plain installation does without its 90 MB."""
    try:
        import imagecodecs as module
    except ImportError as error:
        raise InputError("JPEG XL needs imagecodecs: pip install imagecodecs; or choose png") from error
    return module


def encode_tiff(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16."""
    height, width, channels = image.shape
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # the picture itself
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16] * channels),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [RGB]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [channels]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [height]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),  # pixel by pixel
        TiffTag.SAMPLE_FORMAT: (ValueType.SHORT, [1] * channels),  # unsigned integers
    }
    try:
        start = head(tags, image.nbytes)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for TIFF: {error}; choose png or exr, or make it smaller"
        ) from error
    return b"".join([start, np.ascontiguousarray(image, dtype="<u2").data])


def decode_tiff(data: bytes) -> npt.NDArray[np.generic]:
    """Return the first picture of a TIFF, (H, W) or (H, W, channels), uint8, uint16, float32 or whatever is stored.

    OpenCV's reader is not used: of pictures stored plane by plane, and of files that are cut off, it makes others.
    """
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages.first
        found = np.asarray(page.asarray())
        # Planes that are stored one after another come as the first axis.
        return np.moveaxis(found, 0, -1) if page.axes.startswith("S") and found.ndim == 3 else found


SMALLEST_SIDE = 22  # Photosites along a side below which LibRaw takes a file for no raw file

# From XYZ to linear sRGB, IEC 61966-2-1.
_SRGB: Matrix = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def encode_dng(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, uncompressed."""
    height, width, _ = image.shape
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"an image of {width}x{height} px is too small for DNG: raw programs open none below "
            f"{SMALLEST_SIDE}x{SMALLEST_SIDE}; choose png or tiff"
        )
    neutral = _neutral(metadata)
    matrix = camera_matrix(metadata.camera) or _SRGB
    model = f"{metadata.camera} generated".strip()
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # the picture itself
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        TiffTag.MAKE: text("CroP"),
        TiffTag.MODEL: text(model),
        TiffTag.ORIENTATION: (ValueType.SHORT, [1]),  # as it lies
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [1]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [height]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),
        TiffTag.CFA_REPEAT_PATTERN_DIM: (ValueType.SHORT, [2, 2]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, [0, 1, 1, 2]),  # red, green, green, blue
        TiffTag.DNG_VERSION: (ValueType.BYTE, [1, 4, 0, 0]),
        TiffTag.DNG_BACKWARD_VERSION: (ValueType.BYTE, [1, 1, 0, 0]),
        TiffTag.UNIQUE_CAMERA_MODEL: text(f"CroP {model}"),
        TiffTag.CFA_PLANE_COLOR: (ValueType.BYTE, [0, 1, 2]),
        TiffTag.CFA_LAYOUT: (ValueType.SHORT, [1]),  # rectangular
        TiffTag.BLACK_LEVEL: (ValueType.SHORT, [0]),
        TiffTag.WHITE_LEVEL: (ValueType.SHORT, [metadata.white_level]),
        TiffTag.COLOR_MATRIX_1: (
            ValueType.SRATIONAL,
            [part for row in matrix for entry in row for part in (round(10000 * entry), 10000)],
        ),
        TiffTag.AS_SHOT_NEUTRAL: rationals(*neutral),
        TiffTag.CALIBRATION_ILLUMINANT_1: (ValueType.SHORT, [D65]),
    }
    try:
        start = head(tags, 2 * height * width)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for DNG: {error}; choose png, or make it smaller"
        ) from error
    return b"".join([start, mosaic_of(image).data])


def mosaic_of(image: Image) -> Image:
    """Return the RGGB mosaic (H, W) uint16, little-endian, of `image` (H, W, 3) uint16."""
    counts = np.empty(image.shape[:2], "<u2")
    counts[0::2, 0::2] = image[0::2, 0::2, 0]
    counts[0::2, 1::2] = image[0::2, 1::2, 1]
    counts[1::2, 0::2] = image[1::2, 0::2, 1]
    counts[1::2, 1::2] = image[1::2, 1::2, 2]
    return counts


def half_size(counts: Image) -> Image:
    """Return linear RGB (H // 2, W // 2, 3) uint16 of an RGGB mosaic (H, W) uint16.

    Each 2×2 block becomes a pixel: red, the mean of both greens rounded up, blue.
    """
    height, width = (size // 2 * 2 for size in counts.shape)
    image = np.empty((height // 2, width // 2, 3), np.uint16)
    image[..., 0] = counts[0:height:2, 0:width:2]
    greens = counts[0:height:2, 1:width:2].astype(np.uint32) + counts[1:height:2, 0:width:2]
    image[..., 1] = (greens + 1) // 2
    image[..., 2] = counts[1:height:2, 1:width:2]
    return image


def _whole(encode: Callable[[Image, ImageMetadata], bytes]) -> Callable[[Image, ImageMetadata], tuple[bytes]]:
    return lambda image, metadata: (encode(image, metadata),)


def _neutral(metadata: ImageMetadata) -> tuple[float, float, float]:
    if not 1 <= metadata.white_level <= 65535:
        raise InputError(f"the white level is {metadata.white_level}; DNG expects 1 to 65535")
    largest = max(metadata.white)
    if not all(math.isfinite(part) and part > largest * 1e-5 for part in metadata.white):
        raise InputError(
            f"the light's white is {metadata.white}, DNG expects every channel above 0; choose png, tiff, exr or jxl"
        )
    red, green, blue = (part / largest for part in metadata.white)
    return red, green, blue


_JPEG_QUALITY: Final = 92  # Of previews, on libjpeg's scale to 100: no blocks are visible


_LONGEST_JPEG: Final = 65500  # Longest side that libjpeg writes, px (its JPEG_MAX_DIMENSION)

_DEFLATE_RATIO: Final = 1032  # Bytes that deflate makes of one at most (RFC 1951: 258 of two bits)


@dataclass(frozen=True)
class FileFormat:
    """A format of images' files.

    - `pieces`: the file of an image (H, W, 3) uint16 and its light in pieces, whose memory may be used again for the
      next one.
    - `decode`: the array in the bytes of a file of that name, (H, W) or (H, W, channels), as it stands there.
    - `libraries`: distributions that encode it, or for a raw file name its colour matrix: their versions may change the
      bytes of a file. None if CroP encodes it.
    - `smallest_side`: least width and height, px.
    """

    pieces: Callable[[Image, ImageMetadata], Iterable[bytes | memoryview]]
    decode: Callable[[bytes, str], npt.NDArray[np.generic]]
    libraries: tuple[str, ...] = ()
    smallest_side: int = 1


# All formats by name.
FILE_FORMATS: Final[Mapping[Format, FileFormat]] = {
    "png": FileFormat(png_pieces, lambda data, _: decode_png(data)),
    "tiff": FileFormat(_whole(encode_tiff), lambda data, _: decode_tiff(data)),
    "exr": FileFormat(_whole(encode_exr), lambda data, _: decode_exr(data), libraries=("isal",)),
    "jxl": FileFormat(
        lambda image, _: (encode_jxl(image),),
        lambda data, _: decode_jxl(data),
        libraries=("imagecodecs",),
    ),
    "dng": FileFormat(
        _whole(encode_dng),
        lambda data, name: half_size(decode_raw(data, Path(name)).counts),
        libraries=("rawpy",),
        smallest_side=SMALLEST_SIDE,
    ),
}


def suffix_of(form: Format) -> str:
    """Return the suffix of file names of that format, such as ``.png``."""
    return f".{form}"


def libraries_of(form: Format) -> tuple[str, ...]:
    """Return the distributions whose version may change the bytes of a file of that format; none if CroP encodes it."""
    if form == "jxl":
        imagecodecs()
    return FILE_FORMATS[form].libraries


def encode_image(image: Image, form: Format, metadata: ImageMetadata) -> bytes:
    """Return `image` as the bytes of a file.

    `image`: (H, W, 3) uint16, linear camera RGB.
    """
    return b"".join(map(bytes, encode_pieces(image, form, metadata)))


def encode_pieces(image: Image, form: Format, metadata: ImageMetadata) -> Iterable[bytes | memoryview]:
    """Return the file of `image` (H, W, 3) uint16 in pieces, whose memory may be used again for the next one.

    Pieces of a PNG are encoded one after the other, so that a file of any size needs little memory.
    """
    _check(image)
    return FILE_FORMATS[form].pieces(image, metadata)


def _check(image: Image) -> None:
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image is {image.dtype} {image.shape}, expected uint16 (height, width, 3)")


def decode_image(data: bytes, form: Format, what: str) -> Image:
    """Return the image that `encode_image` made a file of.

    `data`: the file's bytes. Returns (H, W, 3) uint16, as it was encoded; of `dng` (H // 2, W // 2, 3), the half-size
    linear RGB of its mosaic: red, the mean of both greens, rounded up, and blue of each 2×2 block.
    """
    require_plausible(data, what)
    try:
        image = FILE_FORMATS[form].decode(data, what)
    except CropError:
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
    if len(data) < 26 or not data.startswith(SIGNATURE):
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


# Replaces brightness 0, which has no logarithm; linear values are 0 … 1, so it is far below any signal.
DARK: Final = 1e-9

_BLACK: Final = np.float32(1e-30)  # Replaces 0 before a logarithm of float32, and is code 0 afterwards


@dataclass(frozen=True)
class Flash:
    """The operator with the parameters of one image, so that it can be undone.

    - `k`: semi-saturation: a · exp(mean ln V) of the image it was fitted to.
    - `scale`: code that the brightest value became, divided by that value: undone before anything else.
    - `gamma`: display exponent g of y ** (1 / g); 1 for none.
    """

    k: float
    scale: float
    gamma: float

    def apply(self, linear: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Return codes (..., 3) float64 of linear RGB (..., 3) ≥ 0; the fitted image's brightest value becomes 255."""
        linear = np.asarray(linear, dtype=np.float64)
        brightness = np.maximum(linear.max(axis=-1, keepdims=True), DARK)
        return self.scale * (linear / (brightness + self.k)) ** (1 / self.gamma)

    def invert(self, codes: npt.NDArray[np.floating] | npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """Return linear RGB (..., 3) float64 of codes (..., 3) of any type, 0 … 255, rounded or not.

        With y = x / (V + k) the largest channel W = V / (V + k), hence x = y k / (1 − W).
        """
        mapped = (np.asarray(codes, dtype=np.float64) / self.scale) ** self.gamma
        largest = mapped.max(axis=-1, keepdims=True)
        # A rounded-up brightest code may reach W = 1, which no finite brightness has.
        return mapped * self.k / np.maximum(1 - largest, DARK)


def fit_flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator fitted to an image.

    `linear`: (..., 3) float ≥ 0, linear RGB, 1 = saturation.
    """
    if not linear.size or a <= 0 or gamma <= 0:
        raise InputError(
            f"tone mapping got an image {linear.shape}, a={a} and gamma={gamma}, expected pixels and numbers above 0"
        )
    brightness = _brightness(np.asarray(linear))
    return flash_from_brightness(float(np.log(brightness).mean(dtype=np.float64)), float(brightness.max()), a, gamma)


def flash_from_brightness(mean_log: float, peak: float, a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator for an image with that mean of the logarithms of brightness, and that largest brightness."""
    k = a * math.exp(mean_log)
    return Flash(k, 255.0 / (peak / (peak + k)) ** (1 / gamma), gamma)


def flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> npt.NDArray[np.uint8]:
    """Return the picture (..., 3) uint8 of a linear image (..., 3) float, 1 = saturation; see `fit_flash`.

    Computed in single precision: a code may differ by one from the rounded result of `Flash.apply`.

    Parameters
    ----------
    linear
        (..., 3) float ≥ 0, linear RGB, 1 = saturation.
    a, gamma
        Strength and display exponent, as for `fit_flash`.

    Examples
    --------
    >>> flash(np.array([[[0.0, 0.01, 0.02], [0.4, 0.5, 0.2]]]))
    array([[[  0,  58,  79],
            [230, 255, 168]]], dtype=uint8)
    """
    linear = np.asarray(linear, dtype=np.float32)
    operator = fit_flash(linear, a, gamma)
    mapped = linear / (_brightness(linear) + np.float32(operator.k))[..., None]
    if gamma != 1:
        # Through logarithms, which numpy computes several at once; a power takes ten times as long.
        np.maximum(mapped, _BLACK, out=mapped)
        np.log(mapped, out=mapped)
        mapped *= np.float32(1 / gamma)
        np.exp(mapped, out=mapped)
    mapped *= np.float32(operator.scale)
    np.rint(mapped, out=mapped)
    return np.clip(mapped, 0, 255, out=mapped).astype(np.uint8)


def _brightness(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return brightness (...), the largest channel of `linear` (..., 3), at least `DARK`."""
    largest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
    return np.maximum(largest, linear.dtype.type(DARK))


# Longest side of a preview, px: enough to judge content and colours by eye, in some tens of kB, and less than that of
# the images of most datasets, of which a preview of the same size would be a copy.
PREVIEW_SIDE: Final = 400

_GAMMA: Final = 2.2  # Exponent of a usual display, as in the paper's figure of the generation process
_HALF: Final = np.float32(0.5)  # Added before a number is cut to a whole one, which rounds it


@compiled
def _shrink(image: Any, factor: int, out: Any) -> None:
    """Fill `out` with the rounded means of the blocks of `image`, `factor` pixels wide and high, or what is left there.

    `image` is (H, W, 3) uint16, `out` (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16.
    """
    height, width = image.shape[0], image.shape[1]
    sums = np.empty(3 * width, np.int64)
    one, two = uint64(1), uint64(2)
    for y in range(out.shape[0]):
        top, end = factor * y, min(factor * (y + 1), height)
        # Rows are added first, so that the compiler can vectorise what touches every sample.
        first, small = image[top].reshape(-1), out[y].reshape(-1)
        for i in range(3 * width):
            sums[i] = first[i]
        for row in range(top + 1, end):
            samples = image[row].reshape(-1)
            for i in range(3 * width):
                sums[i] += samples[i]
        left, at = uint64(0), uint64(0)
        columns = min(factor, width)
        share = 1.0 / ((end - top) * columns)
        for x in range(out.shape[1]):
            if factor * (x + 1) > width:
                columns = width - factor * x
                share = 1.0 / ((end - top) * columns)
            red, green, blue = sums[left], sums[left + one], sums[left + two]
            for _ in range(columns - 1):
                left += uint64(3)
                red += sums[left]
                green += sums[left + one]
                blue += sums[left + two]
            left += uint64(3)
            small[at] = uint16(red * share + 0.5)
            small[at + one] = uint16(green * share + 0.5)
            small[at + two] = uint16(blue * share + 0.5)
            at += uint64(3)


def _smaller(image: npt.NDArray[np.uint16], factor: int) -> npt.NDArray[np.uint16]:
    """Return the rounded means (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16 of the blocks of `image` (H, W, 3)."""
    height, width = image.shape[:2]
    if factor == 2 and height % 2 == width % 2 == 0:
        # OpenCV's means of two by two are the same, halves rounded up, in a third of the time; of others they are not.
        import cv2

        return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.uint16, copy=False)
    small = np.empty((-(-height // factor), -(-width // factor), 3), np.uint16)
    _shrink(image, factor, small)
    return small


@compiled
def _brightest(samples: Any, logs: Any) -> Any:
    """Return the largest channel of all pixels, and the sum over pixels of the logarithm of the largest channel.

    `samples` is (3 N,) uint16, `logs` (65536,) float64 the logarithm of each value.
    """
    # Two counters, so that equal values do not wait for each other.
    counts = np.zeros((2, 1 << 16), np.uint32)
    top = uint16(0)
    i = uint64(0)
    for pixel in range(len(samples) // 3):
        brightness = max(samples[i], samples[i + uint64(1)], samples[i + uint64(2)])
        counts[pixel & 1, brightness] += uint32(1)
        top = max(top, brightness)
        i += uint64(3)
    total = 0.0
    for value in range(int(top) + 1):
        total += (uint64(counts[0, value]) + uint64(counts[1, value])) * logs[value]
    return top, total


@compiled
def _map(samples: Any, roots: Any, shades: Any, out: Any) -> None:
    """Fill `out` with the rounded product of each sample's gamma root and the shade of its pixel's largest channel."""
    i = uint64(0)
    for _ in range(len(samples) // 3):
        red, green, blue = samples[i], samples[i + uint64(1)], samples[i + uint64(2)]
        shade = shades[max(red, green, blue)]
        # None is above 255 by more than an error of rounding.
        out[i] = uint8(roots[red] * shade + _HALF)
        out[i + uint64(1)] = uint8(roots[green] * shade + _HALF)
        out[i + uint64(2)] = uint8(roots[blue] * shade + _HALF)
        i += uint64(3)


@lru_cache(maxsize=4)
def _tables(white_level: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return lookup tables (65536,) over the values of 16 bits: brightness, its logarithm, its gamma root.

    Brightness is the value over the white level, at least `DARK`.
    """
    linear = np.arange(1 << 16) / white_level
    brightness = np.maximum(linear, DARK)
    return brightness.astype(np.float32), np.log(brightness), (linear ** (1 / _GAMMA)).astype(np.float32)


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> npt.NDArray[np.uint8]:
    """Return the preview of a raw linear image: made small, then tone mapped, colours as the camera saw them.

    `image`: (H, W, 3) uint16, linear camera RGB. `side`: longest side allowed, px. A pixel of the preview is the mean
    of k × k pixels, k the least whole number that makes it fit. Returns (h, w, 3) uint8, codes for a display; h and w
    are H / k and W / k, rounded up.
    """
    height, width = image.shape[:2]
    factor = -(-max(height, width) // side)
    if factor > 1:
        image = _smaller(np.ascontiguousarray(image), factor)
    brightness, logs, roots = _tables(white_level)
    samples = np.ascontiguousarray(image).reshape(-1)
    top, total = _brightest(samples, logs)
    seen = brightness[: int(top) + 1]
    operator = flash_from_brightness(float(total) / (samples.size // 3), float(seen[-1]), gamma=_GAMMA)
    shades = float32(operator.scale) * (seen + float32(operator.k)) ** float32(-1 / _GAMMA)
    picture = np.empty(image.shape, np.uint8)
    _map(samples, roots, shades, picture.reshape(-1))
    return picture


def encode_preview(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return `picture` (H, W, 3) uint8, RGB, as the bytes of a JPEG file."""
    import simplejpeg

    if max(picture.shape) > _LONGEST_JPEG:
        raise InputError(
            f"a preview of {picture.shape[1]}x{picture.shape[0]} px cannot be written as JPEG; make it smaller"
        )
    pixels = np.ascontiguousarray(picture)
    return simplejpeg.encode_jpeg(pixels, _JPEG_QUALITY, colorspace="RGB", colorsubsampling="420")
