"""Image files: encode 16-bit linear images, masks and previews, and decode them.

docs/formats.md describes the formats; docs/decisions/0011-image-files.md compares them with others. Encoders are
lossless, except for previews. They release the interpreter lock while they compute and start no threads, because a data
set is made by one thread for each processor. Camera RGB is no display colour space, so files have no colour profile.
"""

from __future__ import annotations

import io
import json
import math
import struct
import tempfile
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast, get_args

import numpy as np
import numpy.typing as npt
from isal import isal_zlib
from numpy import float32, uint8, uint16, uint32, uint64

from drivers.raw.rawfile import Matrix, camera_matrix, decode_raw
from drivers.tiff import CFA, D65, RGB, Tags, TiffTag, ValueType, head, rationals, text
from foundation.compiled import compiled
from foundation.errors import CropError, FormatError, InputError
from generator.deflate import WIDEST, Packer

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

Image = npt.NDArray[np.uint16]
Format = Literal["png", "tiff", "exr", "jxl", "dng"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)

_threads = threading.local()  # The PNG packer of each thread, with its working memory


@dataclass(frozen=True)
class ImageMetadata:
    """Ground truth and camera of one image."""

    white_level: int  # saturation level in counts, 1 … 65535
    white: tuple[float, float, float]  # ground truth: linear camera RGB of an achromatic surface, not normalised
    camera: str  # maker and model, from the LUT

    def to_json(self) -> str:
        """Return one line of JSON in ASCII, for formats with a text field."""
        values = {"white_level": self.white_level, "white": self.white, "camera": self.camera}
        return json.dumps({"format": "crop.image", "values": "linear camera RGB, black 0", **values})


FULL: Final = 65535  # Largest value of 16 bits

# PNG (ISO/IEC 15948), with the deflate packer of `generator.deflate`; each IDAT chunk has one band of rows. There is no
# sBIT chunk, because values use the lower end of the 16 bits.
SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"  # The first bytes of every PNG file (clause 5.2)
TALLEST: Final = (1 << 31) - 1  # Largest height, px (clause 11.2.2)
# Largest number of pixels in a band of several rows: 1.5 MiB, so that large images need little memory.
BAND: Final = 1 << 18
_ZLIB: Final = bytes([0x78, 0x01])  # zlib header: deflate, window of 32 KiB, fastest level (RFC 1950, 2.2)
# Compression level of ISA-L (0 to 3) for maps, and for OpenEXR after prediction. With the filter Up, ISA-L compresses
# maps as well as OpenCV in a fifth of the time.
_LEVEL: Final = 1
# Number of bytes at the start that are compressed separately. The first hash in the main loop of ISA-L is undefined,
# but so few bytes are compressed in another loop (docs/decisions/0051-first-bytes-apart.md).
_FIRST_BYTES: Final = 8
_UP: Final = 2  # Filter type Up (clause 9.2)
# Colour types (clause 11.2.2).
_GREY: Final = 0
_RGB: Final = 2


def png_pieces(image: Image, metadata: ImageMetadata) -> Iterator[bytes | memoryview]:
    """Yield the PNG file of `image` (H, W, 3) uint16 in pieces, each valid until the next."""
    height, width, _ = image.shape
    if width > WIDEST or height > TALLEST:
        raise InputError(
            f"an image of {width}x{height} px is too large for PNG, which allows {WIDEST}x{TALLEST} px; reduce the "
            "image"
        )
    yield _png_head(width, height, _RGB)
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
    """Return the PNG file of smooth `values` (H, W) or (H, W, 3) uint16, such as a mask."""
    height, width = values.shape[:2]
    plain = values.astype(">u2").view(np.uint8).reshape(height, -1)
    rows = np.empty((height, 1 + plain.shape[1]), np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = plain[0]
    np.subtract(plain[1:], plain[:-1], out=rows[1:, 1:])
    head = _png_head(width, height, _GREY if values.ndim == 2 else _RGB)
    return b"".join([head, *_chunk(b"IDAT", _packed(rows)), *_chunk(b"IEND")])


def _packed(data: npt.NDArray[np.uint8]) -> bytes:
    packer, plain = isal_zlib.compressobj(_LEVEL), data.reshape(-1).data
    # In a single call, ISA-L would hash bytes 3 to 6 with an undefined register, and equal maps would give different
    # files.
    first = packer.compress(plain[:_FIRST_BYTES]) + packer.flush(isal_zlib.Z_SYNC_FLUSH)
    return b"".join([first, packer.compress(plain[_FIRST_BYTES:]), packer.flush()])


def _png_head(width: int, height: int, colour: int) -> bytes:
    size = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    return SIGNATURE + b"".join(_chunk(b"IHDR", size))


def _chunk(chunk_type: bytes, *pieces: bytes | memoryview) -> Iterator[bytes | memoryview]:
    checksum = isal_zlib.crc32(chunk_type)
    for piece in pieces:
        checksum = isal_zlib.crc32(piece, checksum)
    # Length, type, data and CRC (clause 5.3).
    yield struct.pack(">I", sum(len(piece) for piece in pieces)) + chunk_type
    yield from filter(None, pieces)
    yield struct.pack(">I", checksum)


def decode_png(data: bytes) -> npt.NDArray[np.generic]:
    """Return the values of a PNG: (H, W) or (H, W, channels) in RGB order, uint8 or uint16."""
    import cv2

    # OpenCV would also read other formats.
    decoded = None
    if data.startswith(SIGNATURE):
        decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded is None:
        raise ValueError("not a complete PNG file")
    if decoded.ndim == 2:
        return decoded
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB if decoded.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


# OpenEXR, scan lines with ZIP compression. The encoder is our own, as libraries write only to named files. Sources:
# "OpenEXR File Layout", "Technical Introduction to OpenEXR"; prediction as in ImfZip of the reference implementation.

# Largest signed 32-bit integer; window coordinates and chunk sizes in bytes have this type.
LARGEST_SIDE: Final = (1 << 31) - 1

# First bytes of an OpenEXR file of version 2 with scan lines in one part.
_MAGIC_AND_VERSION: Final = struct.pack("<ii", 20000630, 2)
_ZIP: Final = 3  # Code of ZIP_COMPRESSION
_LINES: Final = 16  # Scan lines in a block of ZIP_COMPRESSION
_FLOAT: Final = 2  # Code of the pixel type FLOAT


def encode_exr(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the OpenEXR file of `image` (H, W, 3) uint16."""
    height, width, _ = image.shape
    if 12 * width * _LINES > LARGEST_SIDE:
        largest = LARGEST_SIDE // 12 // _LINES
        raise InputError(
            f"an image is {width} px wide, EXR allows {largest} px; choose png or tiff, or reduce the image"
        )
    start = _header(width, height, metadata)
    chunks = [_scan_lines(image, y) for y in range(0, height, _LINES)]
    sizes = np.array([len(chunk) for chunk in chunks], dtype=np.uint64)
    offsets = np.full(len(chunks), len(start) + 8 * len(chunks), dtype="<u8")
    offsets[1:] += np.cumsum(sizes[:-1], dtype=np.uint64)
    return b"".join([start, offsets.tobytes(), *chunks])


def decode_exr(data: bytes) -> Image:
    """Return the image (H, W, 3) uint16 of an OpenEXR file."""
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
        raise ValueError("its values are not integers from 0 to 65535")
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


def _attribute(name: str, type_name: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + type_name.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _scan_lines(image: Image, y: int) -> bytes:
    # The order in a chunk is: channels B, G, R of a line, then the next line.
    lines = image[y : y + _LINES, :, ::-1].transpose(0, 2, 1).astype("<f4", order="C")
    raw = lines.reshape(-1).view(np.uint8)
    # Even and odd bytes are separated before differences are taken, so that exponents are not mixed with noise.
    separated = np.concatenate([raw[0::2], raw[1::2]])
    separated[1:] = separated[1:] - separated[:-1] + np.uint8(128)
    data = _packed(separated)
    # Data that compression does not reduce are stored unchanged.
    body = data if len(data) < raw.nbytes else raw.tobytes()
    return struct.pack("<ii", y, len(body)) + body


def encode_jxl(image: Image) -> bytes:
    """Return the lossless JPEG XL file (ISO/IEC 18181) of `image` (H, W, 3) uint16; the format has no metadata."""
    codecs = imagecodecs()
    try:
        return bytes(codecs.jpegxl_encode(np.ascontiguousarray(image), effort=1, lossless=True, numthreads=1))
    except codecs.JpegxlError as error:
        raise InputError(
            f"an image of {image.shape[1]}x{image.shape[0]} px cannot be written as JPEG XL: {error}; choose png"
        ) from error


def decode_jxl(data: bytes) -> npt.NDArray[np.generic]:
    """Return the values of a JPEG XL file: (H, W) or (H, W, channels), uint8, uint16 or float32 as stored."""
    return np.asarray(imagecodecs().jpegxl_decode(data, numthreads=1))


def imagecodecs() -> Any:
    """Return the module imagecodecs with libjxl, an optional dependency of 90 MB."""
    try:
        import imagecodecs as module
    except ImportError as error:
        raise InputError("JPEG XL needs the library imagecodecs; run pip install imagecodecs, or choose png") from error
    return module


def encode_tiff(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the TIFF 6.0 file of `image` (H, W, 3) uint16: one uncompressed strip."""
    # Many readers lack the zstd codec, and deflate costs more time than the smaller file saves.
    height, width, channels = image.shape
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # full-size image
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16] * channels),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [RGB]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [channels]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [height]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),  # interleaved
        TiffTag.SAMPLE_FORMAT: (ValueType.SHORT, [1] * channels),  # unsigned integers
    }
    try:
        start = head(tags, image.nbytes)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for TIFF: {error}; choose png or exr, or reduce the image"
        ) from error
    return b"".join([start, np.ascontiguousarray(image, dtype="<u2").data])


def decode_tiff(data: bytes) -> npt.NDArray[np.generic]:
    """Return the full picture of a TIFF: (H, W) or (H, W, channels), of the stored type."""
    # OpenCV misreads images stored plane by plane and truncated files, so it is not used.
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page, index = _full_page(file)
        if page.compression != tifffile.COMPRESSION.NONE and index is not None:
            return _decompressed(data)
        values = np.asarray(page.asarray())
        # If planes are stored one after another, they are the first axis.
        return np.moveaxis(values, 0, -1) if page.axes.startswith("S") and values.ndim == 3 else values


def full_picture_index(path: Path) -> int:
    """Return the index of the full picture among the images of a TIFF file; 0 if the file cannot be read.

    Raises FormatError if the picture is in a SubIFD, which OpenImageIO does not read.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            _, index = _full_page(file)
    except Exception:
        # OpenImageIO reads it, or reports the fault.
        return 0
    if index is None:
        raise FormatError(f"cannot read {path}: its full picture is in a SubIFD; convert it to a plain TIFF or PNG")
    return index


def _full_page(file: TiffFile) -> tuple[TiffPage, int | None]:
    # The first picture that is neither reduced nor a transparency mask (TIFF 6.0, NewSubfileType, bits 0 and 2), and
    # its index, which is None in a SubIFD. If all pictures are reduced, the first one is returned.
    hidden = _REDUCED | _TRANSPARENCY
    subpages: list[TiffPage] = []
    for index, page in enumerate(file.pages):
        page = cast("TiffPage", page.aspage())
        if not page.subfiletype & hidden:
            return page, index
        pages_below = [cast("TiffPage", subpage.aspage()) for subpage in page.pages or ()]
        subpages += [subpage for subpage in pages_below if not subpage.subfiletype & hidden]
    return (subpages[0], None) if subpages else (file.pages.first, 0)


_REDUCED, _TRANSPARENCY = 1, 4


def _decompressed(data: bytes) -> npt.NDArray[np.generic]:
    # OpenImageIO reads all usual compressions, but only files with a name.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.tif"
        path.write_bytes(data)
        values = read_native(path).values
    return values[..., 0] if values.shape[2] == 1 else values


@dataclass(frozen=True, eq=False)
class NativeImage:
    """Values of an image file as stored, without colour conversion or rotation.

    - `values`: (H, W, channels), of the stored type; 1-bit values are 0 and 255.
    - `alpha`: index of the transparency channel; None without one.
    - `orientation`: 1 … 8 (TIFF 6.0, tag Orientation).
    - `format`: name of the file format in OpenImageIO, such as ``"png"``.
    - `compression`: such as ``"lzw"``; empty if the format has none.
    """

    values: npt.NDArray[Any]
    alpha: int | None
    orientation: int
    format: str
    compression: str


@contextmanager
def opened_image(path: Path) -> Generator[Any]:
    """Open an image file with OpenImageIO at its full picture, with colours not multiplied by alpha; ValueError if not.

    If its own name is not UTF-8, the file is opened through a link.
    """
    import OpenImageIO as oiio  # noqa: N813

    request = oiio.ImageSpec()
    request.attribute("oiio:UnassociatedAlpha", 1)
    with ExitStack() as resources:
        name = str(path)
        try:
            name.encode()
        except UnicodeEncodeError:
            suffix = path.suffix.encode("ascii", "ignore").decode()
            link = Path(resources.enter_context(tempfile.TemporaryDirectory())) / f"picture{suffix}"
            link.symlink_to(path.absolute())
            name = str(link)
        stream = oiio.ImageInput.open(name, request)
        if stream is None:
            raise ValueError(oiio.geterror().replace(name, str(path)))
        resources.callback(stream.close)
        if stream.format_name() == "tiff":
            stream.seek_subimage(full_picture_index(path), 0)
        yield stream


def alpha_channel(spec: Any) -> int | None:
    """Return the index of the transparency channel of an OpenImageIO image, or None."""
    # For a GIF file, OpenImageIO reports an index that is too high by one.
    return min(spec.alpha_channel, spec.nchannels - 1) if spec.alpha_channel > 0 else None


def read_native(path: Path) -> NativeImage:
    """Return the full picture of an image file as stored; raises ValueError or CropError if it cannot be read."""
    with opened_image(path) as stream:
        spec, form = stream.spec(), stream.format_name()
        pixels = stream.read_image(spec.format)
        if pixels is None or stream.has_error:
            raise ValueError(stream.geterror().replace(str(path), "the file"))
    values = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    compression = spec.get_string_attribute("compression")
    return NativeImage(values, alpha_channel(spec), spec.get_int_attribute("Orientation", 1), form, compression)


def upright(picture: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Return a picture (H, W, channels) rotated or mirrored according to its orientation (TIFF 6.0), contiguous."""
    transforms = {
        2: lambda: picture[:, ::-1],
        3: lambda: picture[::-1, ::-1],
        4: lambda: picture[::-1],
        5: lambda: picture.transpose(1, 0, 2),
        6: lambda: picture.transpose(1, 0, 2)[:, ::-1],
        7: lambda: picture.transpose(1, 0, 2)[::-1, ::-1],
        8: lambda: picture.transpose(1, 0, 2)[::-1],
    }.get(orientation)
    return np.ascontiguousarray(transforms() if transforms else picture)


# DNG 1.7.1, chapters 2 and 4.
SMALLEST_SIDE = 22  # Smallest side in photosites; LibRaw does not open smaller raw files

# From XYZ to linear sRGB, IEC 61966-2-1.
_SRGB: Matrix = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def encode_dng(image: Image, metadata: ImageMetadata) -> bytes:
    """Return the uncompressed DNG file of `image` (H, W, 3) uint16 with an RGGB pattern."""
    height, width, _ = image.shape
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"an image of {width}x{height} px is too small for DNG, raw developers need "
            f"{SMALLEST_SIDE}x{SMALLEST_SIDE} px or more; choose png or tiff"
        )
    neutral = _neutral(metadata)
    # Neutral colours are correct with either matrix, other colours only with the matrix of the camera.
    matrix = camera_matrix(metadata.camera) or _SRGB
    model = f"{metadata.camera} generated".strip()
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # full-size image
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        # With the maker of the camera, raw developers would apply the black level and other properties of this camera.
        TiffTag.MAKE: text("CroP"),
        TiffTag.MODEL: text(model),
        TiffTag.ORIENTATION: (ValueType.SHORT, [1]),  # not rotated
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
            [integer for row in matrix for entry in row for integer in (round(10000 * entry), 10000)],
        ),
        TiffTag.AS_SHOT_NEUTRAL: rationals(*neutral),  # the ground truth
        TiffTag.CALIBRATION_ILLUMINANT_1: (ValueType.SHORT, [D65]),
    }
    try:
        start = head(tags, 2 * height * width)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for DNG: {error}; choose png, or reduce the image"
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

    Each pixel is made from a 2×2 block: red, the mean of both greens rounded up, and blue.
    """
    height, width = (size // 2 * 2 for size in counts.shape)
    image = np.empty((height // 2, width // 2, 3), np.uint16)
    image[..., 0] = counts[0:height:2, 0:width:2]
    greens = counts[0:height:2, 1:width:2].astype(np.uint32) + counts[1:height:2, 0:width:2]
    image[..., 1] = (greens + 1) // 2
    image[..., 2] = counts[1:height:2, 1:width:2]
    return image


def _single_piece(encode: Callable[[Image, ImageMetadata], bytes]) -> Callable[[Image, ImageMetadata], tuple[bytes]]:
    return lambda image, metadata: (encode(image, metadata),)


def _neutral(metadata: ImageMetadata) -> tuple[float, float, float]:
    if not 1 <= metadata.white_level <= 65535:
        raise InputError(f"the saturation level is {metadata.white_level}, DNG expects 1 to 65535; choose png or exr")
    largest = max(metadata.white)
    if not all(math.isfinite(channel) and channel > largest * 1e-5 for channel in metadata.white):
        raise InputError(f"the ground truth is {metadata.white}, DNG expects channels above 0; choose another format")
    red, green, blue = (channel / largest for channel in metadata.white)
    return red, green, blue


_JPEG_QUALITY: Final = 92  # Quality of previews on the scale of libjpeg (1 to 100): no visible blocks

_LONGEST_JPEG: Final = 65500  # Longest side of a JPEG file, px (JPEG_MAX_DIMENSION of libjpeg)

_DEFLATE_RATIO: Final = 1032  # Largest ratio of unpacked to packed bytes (RFC 1951: 258 bytes from two bits)


@dataclass(frozen=True)
class FileFormat:
    """A file format of images."""

    # Encodes an image (H, W, 3) uint16; each piece is valid until the next.
    pieces: Callable[[Image, ImageMetadata], Iterable[bytes | memoryview]]
    # Decodes the bytes of the named file to an array (H, W) or (H, W, channels).
    decode: Callable[[bytes, str], npt.NDArray[np.generic]]
    # Python packages whose version may change the bytes: encoders, or the source of the colour matrix of a raw file.
    libraries: tuple[str, ...] = ()
    smallest_side: int = 1  # px


# All formats by name.
FILE_FORMATS: Final[Mapping[Format, FileFormat]] = {
    "png": FileFormat(png_pieces, lambda data, _: decode_png(data)),
    "tiff": FileFormat(_single_piece(encode_tiff), lambda data, _: decode_tiff(data)),
    "exr": FileFormat(_single_piece(encode_exr), lambda data, _: decode_exr(data), libraries=("isal",)),
    "jxl": FileFormat(
        lambda image, _: (encode_jxl(image),),
        lambda data, _: decode_jxl(data),
        libraries=("imagecodecs",),
    ),
    "dng": FileFormat(
        _single_piece(encode_dng),
        lambda data, name: half_size(decode_raw(data, Path(name)).counts),
        libraries=("rawpy",),
        smallest_side=SMALLEST_SIDE,
    ),
}


def suffix_of(form: Format) -> str:
    """Return the file name suffix of a format, such as ``.png``."""
    return f".{form}"


def libraries_of(form: Format) -> tuple[str, ...]:
    """Return `FileFormat.libraries` of a format; raises InputError if one is not installed."""
    if form == "jxl":
        imagecodecs()
    return FILE_FORMATS[form].libraries


def encode_image(image: Image, form: Format, metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, linear camera RGB."""
    return b"".join(map(bytes, encode_pieces(image, form, metadata)))


def encode_pieces(image: Image, form: Format, metadata: ImageMetadata) -> Iterable[bytes | memoryview]:
    """Return the file of `image` (H, W, 3) uint16 in pieces, each valid until the next.

    A PNG is encoded piece by piece, so that large files need little memory.
    """
    _require_rgb16(image)
    return FILE_FORMATS[form].pieces(image, metadata)


def _require_rgb16(image: Image) -> None:
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"the image is {image.dtype} {image.shape}, expected uint16 (height, width, 3); convert it")


def decode_image(data: bytes, form: Format, name: str) -> Image:
    """Return the image (H, W, 3) uint16 of a file; for ``dng``, the half-size image (H // 2, W // 2, 3).

    `name` is the file name in messages. Raises FormatError.
    """
    require_plausible(data, name)
    try:
        image = FILE_FORMATS[form].decode(data, name)
    except CropError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FormatError(f"{name} cannot be read as {form}: {reason}; make it again") from error
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 3:
        raise FormatError(f"{name} is {image.dtype} {image.shape}, expected uint16 (height, width, 3); make it again")
    return image.astype(np.uint16, copy=False)


def require_plausible(data: bytes, name: str) -> None:
    """Raise FormatError if a PNG file declares more pixels or bytes than it can contain; accept other formats."""
    # A decoder allocates the declared size (ISO/IEC 15948, 5.3 and 11.2.2), so a small file with a false size could
    # fill the memory. Deflate unpacks one byte to at most 1032 (the "Maximum Compression Factor" of zlib).
    if len(data) < 26 or not data.startswith(SIGNATURE):
        return
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    channels = {2: 3, 4: 2, 6: 4}.get(colour, 1)
    claimed = height * (1 + width * channels * depth // 8)
    if claimed > _DEFLATE_RATIO * len(data):
        raise FormatError(f"{name} declares {width}x{height} px, but has only {len(data)} bytes; make it again")
    offset = 8
    while offset + 12 <= len(data):
        (size,) = struct.unpack(">I", data[offset : offset + 4])
        if size > len(data) - offset - 12:
            remaining = len(data) - offset - 12
            raise FormatError(f"{name}: a chunk declares {size} bytes, but {remaining} follow; make it again")
        offset += size + 12


# Previews: the image in camera RGB, reduced, tone mapped with Flash and stored as JPEG. Flash is N. Banić, S. Lončarić,
# "Flash and Storm: fast and highly practical tone mapping based on Naka-Rushton equation", VISAPP 2018. The paper on
# CroP uses it in section 4.2 and in the figure of the generation process.

# Replaces brightness 0, which has no logarithm; far below any signal, because linear values are 0 … 1.
DARK: Final = 1e-9

_BLACK: Final = np.float32(1e-30)  # Replaces 0 before the logarithm in float32; its code is 0


@dataclass(frozen=True)
class Flash:
    """The tone mapping operator Flash with the parameters of one image."""

    k: float  # semi-saturation: strength `a` of `fit_flash`, times exp(mean ln V) for the brightness V
    scale: float  # 255 divided by the value of the brightest pixel before scaling
    gamma: float  # display exponent: mapped values are raised to 1 / gamma; 1 for none

    def apply(self, linear: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Return codes (..., 3) float64 of linear RGB (..., 3) ≥ 0; the brightest fitted value becomes 255."""
        linear = np.asarray(linear, dtype=np.float64)
        brightness = np.maximum(linear.max(axis=-1, keepdims=True), DARK)
        return self.scale * (linear / (brightness + self.k)) ** (1 / self.gamma)

    def invert(self, codes: npt.NDArray[np.floating] | npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """Return linear RGB (..., 3) float64 of codes (..., 3), 0 … 255."""
        # For a linear value x, brightness V and mapped value y = x / (V + k), the largest channel is W = V / (V + k),
        # hence x = y k / (1 − W).
        mapped = (np.asarray(codes, dtype=np.float64) / self.scale) ** self.gamma
        largest = mapped.max(axis=-1, keepdims=True)
        # A code that was rounded up may give W = 1, which corresponds to infinite brightness.
        return mapped * self.k / np.maximum(1 - largest, DARK)


def fit_flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator fitted to an image (..., 3) float ≥ 0, linear RGB, 1 = saturation.

    `a` is the strength and `gamma` the display exponent, both above 0.
    """
    if not linear.size or a <= 0 or gamma <= 0:
        raise InputError(
            f"the image has shape {linear.shape}, a is {a}, gamma is {gamma}, expected pixels, and numbers above 0"
        )
    brightness = _brightness(np.asarray(linear))
    return flash_from_brightness(float(np.log(brightness).mean(dtype=np.float64)), float(brightness.max()), a, gamma)


def flash_from_brightness(mean_log: float, peak: float, a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator for the mean logarithm of brightness and the largest brightness of an image."""
    k = a * math.exp(mean_log)
    return Flash(k, 255.0 / (peak / (peak + k)) ** (1 / gamma), gamma)


def flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> npt.NDArray[np.uint8]:
    """Tone map a linear image with the operator Flash.

    It is computed in single precision, so a code may differ by one from the rounded result of `Flash.apply`.

    Parameters
    ----------
    linear
        (..., 3) float ≥ 0, linear RGB, 1 = saturation.
    a
        Strength, above 0; larger values give a darker image.
    gamma
        Display exponent, above 0; 1 for none.

    Returns
    -------
    ndarray
        (..., 3) uint8, codes for a display.

    Raises
    ------
    InputError
        The image has no pixels, or a parameter is not above 0.

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
        # exp and log are vectorised in numpy; a power takes ten times as long.
        np.maximum(mapped, _BLACK, out=mapped)
        np.log(mapped, out=mapped)
        mapped *= np.float32(1 / gamma)
        np.exp(mapped, out=mapped)
    mapped *= np.float32(operator.scale)
    np.rint(mapped, out=mapped)
    return np.clip(mapped, 0, 255, out=mapped).astype(np.uint8)


def _brightness(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    largest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
    return np.maximum(largest, linear.dtype.type(DARK))


# Longest side of a preview, px: enough to judge content and colours by eye, and a file of some tens of kB.
PREVIEW_SIDE: Final = 400

_GAMMA: Final = 2.2  # Exponent of a usual display, as in the figure of the paper
_HALF: Final = np.float32(0.5)  # Added before truncation, to round


@compiled
def _shrink(image: Any, factor: int, out: Any) -> None:
    # Fill `out` (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16 with the rounded means of blocks of `image` (H, W, 3) uint16,
    # `factor` pixels wide and high; blocks at the right and lower edge may be smaller.
    height, width = image.shape[0], image.shape[1]
    sums = np.empty(3 * width, np.int64)
    u1, u2 = uint64(1), uint64(2)
    for y in range(out.shape[0]):
        top, end = factor * y, min(factor * (y + 1), height)
        # Rows are added first, because the compiler can vectorise this loop over all samples.
        first, small = image[top].reshape(-1), out[y].reshape(-1)
        for i in range(3 * width):
            sums[i] = first[i]
        for row in range(top + 1, end):
            samples = image[row].reshape(-1)
            for i in range(3 * width):
                sums[i] += samples[i]
        sum_index, out_index = uint64(0), uint64(0)
        columns = min(factor, width)
        share = 1.0 / ((end - top) * columns)
        for x in range(out.shape[1]):
            if factor * (x + 1) > width:
                columns = width - factor * x
                share = 1.0 / ((end - top) * columns)
            red, green, blue = sums[sum_index], sums[sum_index + u1], sums[sum_index + u2]
            for _ in range(columns - 1):
                sum_index += uint64(3)
                red += sums[sum_index]
                green += sums[sum_index + u1]
                blue += sums[sum_index + u2]
            sum_index += uint64(3)
            small[out_index] = uint16(red * share + 0.5)
            small[out_index + u1] = uint16(green * share + 0.5)
            small[out_index + u2] = uint16(blue * share + 0.5)
            out_index += uint64(3)


def _shrunk(image: npt.NDArray[np.uint16], factor: int) -> npt.NDArray[np.uint16]:
    height, width = image.shape[:2]
    if factor == 2 and height % 2 == width % 2 == 0:
        # OpenCV gives the same 2×2 means (halves rounded up) in a third of the time; it rounds differently for
        # other factors.
        import cv2

        return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.uint16, copy=False)
    small = np.empty((-(-height // factor), -(-width // factor), 3), np.uint16)
    _shrink(image, factor, small)
    return small


@compiled
def _brightest(samples: Any, logs: Any) -> Any:
    # Return the largest value of `samples` (3 N,) uint16, and the sum over pixels of the logarithm of the largest
    # channel, from `logs` (65536,) float64. Pixels are counted by value, so that each logarithm is used once. With two
    # counters for each value, an increment rarely waits for the previous increment of the same counter.
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
def _tone_map(samples: Any, roots: Any, shades: Any, out: Any) -> None:
    # Fill `out` with the rounded product of the gamma root of each sample and a factor. `shades` has this factor for
    # each value of the largest channel.
    i = uint64(0)
    for _ in range(len(samples) // 3):
        red, green, blue = samples[i], samples[i + uint64(1)], samples[i + uint64(2)]
        shade = shades[max(red, green, blue)]
        # Products exceed 255 only by rounding errors, so no clipping is needed.
        out[i] = uint8(roots[red] * shade + _HALF)
        out[i + uint64(1)] = uint8(roots[green] * shade + _HALF)
        out[i + uint64(2)] = uint8(roots[blue] * shade + _HALF)
        i += uint64(3)


@lru_cache(maxsize=4)
def _tables(white_level: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    # Tables for all 16-bit values: brightness (value over saturation level, at least `DARK`), its logarithm, and the
    # gamma root of the value.
    linear = np.arange(1 << 16) / white_level
    brightness = np.maximum(linear, DARK)
    return brightness.astype(np.float32), np.log(brightness), (linear ** (1 / _GAMMA)).astype(np.float32)


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> npt.NDArray[np.uint8]:
    """Return the preview of a raw linear image (H, W, 3) uint16, reduced and tone mapped in camera RGB.

    Each pixel is the mean of k × k pixels, with the smallest k that reduces the longest side to `side` px. Returns
    (⌈H / k⌉, ⌈W / k⌉, 3) uint8, codes for a display.
    """
    height, width = image.shape[:2]
    factor = -(-max(height, width) // side)
    if factor > 1:
        image = _shrunk(np.ascontiguousarray(image), factor)
    brightness, logs, roots = _tables(white_level)
    samples = np.ascontiguousarray(image).reshape(-1)
    top, total = _brightest(samples, logs)
    levels = brightness[: int(top) + 1]
    operator = flash_from_brightness(float(total) / (samples.size // 3), float(levels[-1]), gamma=_GAMMA)
    shades = float32(operator.scale) * (levels + float32(operator.k)) ** float32(-1 / _GAMMA)
    picture = np.empty(image.shape, np.uint8)
    _tone_map(samples, roots, shades, picture.reshape(-1))
    return picture


def encode_preview(picture: npt.NDArray[np.uint8]) -> bytes:
    """Return the JPEG file of `picture` (H, W, 3) uint8, RGB."""
    import simplejpeg

    if max(picture.shape) > _LONGEST_JPEG:
        raise InputError(
            f"a preview has {picture.shape[1]}x{picture.shape[0]} px, JPEG allows {_LONGEST_JPEG} px; reduce it"
        )
    pixels = np.ascontiguousarray(picture)
    return simplejpeg.encode_jpeg(pixels, _JPEG_QUALITY, colorspace="RGB", colorsubsampling="420")
