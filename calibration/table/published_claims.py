"""What a store claims of a published table, believed only as far as it fits together.

The metadata of the array (`zarr.json`; Zarr specification version 3, "Array metadata") hold the table's texts, which
say how many lights and colours there are; the array's shape, its chunks and the head of `samples.npy` have to say the
same. Sizes are bounded, names are those of a table's files, codecs are the four of published tables: a store may name
any that this machine has, and a count that is only claimed would fill the disk.
"""

from __future__ import annotations

import base64
import io
import re
import shutil
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from calibration.table.file_names import FRAMES, ILLUMINATIONS, PROVENANCE, REFERENCES, REPORT_JSON, SUMS
from calibration.table.lut import table_sha256
from calibration.table.provenance import Provenance
from calibration.table.sample_hashes import MOST_SAMPLES
from calibration.table.sums import MOST_BYTES
from foundation.errors import FormatError, InputError, StorageError
from foundation.foreign_folders import parse_json_object, require_plain_tree

FORMAT: Final = "crop.lut.published"
VERSION: Final = 1
"""The only version so far."""

TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, REPORT_JSON, SUMS, PROVENANCE)
"""Files that go along where the table has them, the one that makes a folder a table last."""

MOST_LIGHTS: Final = 65_536
"""Lights of a table that is fetched, at most: a hundred times those of the paper."""

_METADATA: Final = "zarr.json"
_MOST_METADATA: Final = 256 << 20
"""The metadata hold all files of the table but samples and page; see `calibration.table.sums.MOST_BYTES`."""

_MOST_HEAD: Final = 10_000
"""Longest head of an array file that NumPy reads."""

_CODECS: Final = frozenset({"sharding_indexed", "bytes", "blosc", "crc32c"})
"""Codecs of published tables; others are not run, for a store may name any that this machine has."""

HASH: Final = re.compile("[0-9a-f]{64}")
"""A SHA-256 as it is printed and given."""


def reason_of(error: Exception) -> str:
    """Return what a store's library says, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")


def texts_of(attributes: dict[str, Any], url: str) -> dict[str, str]:
    """Return the table's files of text by name, those alone that a table has; a FormatError if one is none."""
    files = attributes.get("files")
    if not isinstance(files, dict):
        raise FormatError(f"{url} does not hold the files of a table; publish it again")
    found: dict[str, str] = {}
    for name, text in cast("dict[str, Any]", files).items():
        if name not in TEXTS or not isinstance(text, str) or len(text) > MOST_BYTES[name]:
            raise FormatError(f"{url} holds {name!r}, which is no file of a table or too large; publish it again")
        found[name] = text
    lacking = {PROVENANCE, ILLUMINATIONS} - found.keys()
    if lacking:
        raise FormatError(f"{url} lacks {' and '.join(sorted(lacking))}; publish the table again")
    return found


def require_expected(folder: Path, known: Provenance, expect: str | None, url: str) -> None:
    """Refuse a table of another hash than expected, or whose hash says nothing of its samples."""
    if expect is None:
        return
    if not known.lights_sha256:
        raise FormatError(
            f"{url} is a table without hashes of its samples, so that its own hash does not vouch for them; have it "
            "built and published again"
        )
    found = table_sha256(folder, known)
    if found != expect:
        raise FormatError(
            f"{url} is not the table that was expected: its hash is {found}, expected {expect}; ask who told you the "
            "hash which table they mean"
        )


def require_shape(described: dict[str, Any], expected: tuple[int, int], url: str) -> tuple[int, int, int, int]:
    """Return the shape of the samples; a FormatError if it, or how they lie there, is not that of a published table."""
    shape = described.get("shape")
    chunks: Any = {}
    codecs: set[Any] = set()
    try:
        (sharding,) = described["codecs"]
        chunks = sharding["configuration"]["chunk_shape"]
        inner = sharding["configuration"]["codecs"] + sharding["configuration"]["index_codecs"]
        codecs = {sharding["name"], *(codec["name"] for codec in inner)}
        lights, colours, samples, channels = (int(side) for side in cast("list[int]", shape))
        fits = (
            (lights, colours, channels) == (*expected, 3)
            and 0 < samples <= MOST_SAMPLES
            and lights <= MOST_LIGHTS
            and list(chunks) == [1, colours, samples, 3]
            and described["data_type"] == "uint16"
            and codecs <= _CODECS
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        fits, (lights, colours, samples, channels) = False, (0, 0, 0, 0)
    if not fits:
        raise FormatError(
            f"{url} is an array {str(shape)[:200]} that is not stored as published tables are; expected "
            f"[{expected[0]}, {expected[1]}, samples, 3], as its files say, a light a chunk; publish the table again"
        )
    return lights, colours, samples, channels


def head_of(attributes: dict[str, Any], shape: tuple[int, int, int, int], url: str) -> bytes:
    """Return the first bytes of `samples.npy`; a FormatError if they do not belong to samples of that shape."""
    try:
        head = base64.b64decode(attributes["head"], validate=True)[:_MOST_HEAD]
        stream = io.BytesIO(head)
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("it is not of version 1.0")
        described = np.lib.format.read_array_header_1_0(stream)
        if described != (shape, False, np.dtype("<u2")) or stream.read():
            raise ValueError("it is that of another array")
    except Exception as error:
        # The head is a Python literal, which fails in many ways.
        raise FormatError(f"the head of the samples of {url} is damaged: {error}; publish the table again") from error
    return head


def require_room(folder: Path, size: int, url: str) -> None:
    """Refuse what does not fit on the disk, before any of it has come."""
    free = shutil.disk_usage(folder).free
    if size > free:
        raise StorageError(
            f"the samples of {url} have {size / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free at {folder.parent}; free "
            "space or choose another disk, then run the same command again"
        )


def described_at(url: str) -> dict[str, Any] | None:
    """Return what a store says of an array, `zarr.json` (Zarr 3, "Array metadata"); None where there is none."""
    from fsspec.core import url_to_fs

    if "://" not in url or url.startswith("file://"):
        require_plain_tree(Path(url.removeprefix("file://")))
    try:
        files, root = url_to_fs(url)
        with files.open(f"{root.rstrip('/')}/{_METADATA}", "rb") as stream:
            data = stream.read(_MOST_METADATA + 1)
    except FileNotFoundError:
        return None
    except Exception as error:
        # Every store raises errors of its own.
        raise InputError(f"cannot look into {url}: {reason_of(error)}; check the address") from error
    if len(data) > _MOST_METADATA:
        raise FormatError(f"{url} has a {_METADATA} of more than {_MOST_METADATA} bytes, which no table has")
    return parse_json_object(data, f"{_METADATA} of {url}")


def attributes_of(described: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the attributes of a published table, finished or not; None where there is none."""
    attributes = (described or {}).get("attributes")
    if not isinstance(attributes, dict):
        return None
    found = cast("dict[str, Any]", attributes)
    return found if found.get("format") == FORMAT else None
