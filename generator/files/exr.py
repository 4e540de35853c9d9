"""OpenEXR, scan lines of 32-bit floats compressed by zip: every 16-bit number is kept, and every reader knows it.

Half floats would round numbers above 2048. Floats hold the image's own numbers, saturation at the white level, which
stands in the header with camera and light. Written here, since the libraries at hand write to named files only.

Source: "OpenEXR File Layout" and "Technical Introduction to OpenEXR", version 2 of the file, one part; the reordering
and prediction before zip are those of the reference implementation (ImfZip).
"""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from foundation.errors import InputError
from generator.files.metadata import ImageMetadata

LARGEST_SIDE: Final = (1 << 31) - 1
"""Largest number of a signed 32-bit integer, which counts the columns of a window and the bytes of a chunk."""

_MAGIC_AND_VERSION: Final = struct.pack("<ii", 20000630, 2)
"""First bytes of every OpenEXR file of version 2 with scan lines in one part."""
_ZIP: Final = 3
"""Number of the compression ZIP_COMPRESSION."""
_LINES: Final = 16
"""Scan lines that ZIP_COMPRESSION packs together."""
_FLOAT: Final = 2
"""Number of the pixel type FLOAT."""
_LEVEL: Final = 1
"""Level of ISA-L's compression, of 0 to 3, as for maps."""


def encode_exr(image: npt.NDArray[np.uint16], metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16."""
    height, width, _ = image.shape
    if 12 * width * _LINES > LARGEST_SIDE:
        raise InputError(f"an image of {width}x{height} px is too wide for EXR; choose png or tiff, or make it smaller")
    start = _header(width, height, metadata)
    chunks = [_chunk(image, y) for y in range(0, height, _LINES)]
    sizes = np.array([len(chunk) for chunk in chunks], dtype=np.uint64)
    offsets = np.full(len(chunks), len(start) + 8 * len(chunks), dtype="<u8")
    offsets[1:] += np.cumsum(sizes[:-1], dtype=np.uint64)
    return b"".join([start, offsets.tobytes(), *chunks])


def decode_exr(data: bytes) -> npt.NDArray[np.uint16]:
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


def _chunk(image: npt.NDArray[np.uint16], y: int) -> bytes:
    """Return the chunk of the scan lines from `y` on: channels B, G, R of a line, then the next line."""
    lines = image[y : y + _LINES, :, ::-1].transpose(0, 2, 1).astype("<f4", order="C")
    raw = lines.reshape(-1).view(np.uint8)
    # Bytes of even and of odd places are parted, then differences taken: so noise and exponents stand apart.
    apart = np.concatenate([raw[0::2], raw[1::2]])
    apart[1:] = apart[1:] - apart[:-1] + np.uint8(128)
    data = isal_zlib.compress(apart.data, _LEVEL)
    # Data that do not become smaller are stored without reordering.
    body = data if len(data) < raw.nbytes else raw.tobytes()
    return struct.pack("<ii", y, len(body)) + body
