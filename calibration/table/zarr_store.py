"""A table as others get it: a sharded Zarr array on any store that fsspec reaches, and back to the folder that is used.

Zarr specification version 3 with the codec `sharding_indexed`: one light is a chunk, 32 lights an object, compressed by
Blosc (Zstandard after bit shuffle). The table's other files are attributes, word for word; `whole` is set last, and
nothing is overwritten but an array without it.

Nothing that a store says of itself is believed before it fits together: texts, the array's shape, its chunks and the
head of `samples.npy` have to say the same. Sizes are bounded, names and codecs are those of published tables. A table
that is fetched appears in its folder whole and verified, or not at all. Needs zarr, the extra `cluster`.
"""

from __future__ import annotations

import base64
import io
import math
import re
import shutil
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from calibration.table.lut import (
    CELLS,
    FRAMES,
    ILLUMINATIONS,
    MOST_BYTES,
    MOST_SAMPLES,
    PROVENANCE,
    REFERENCES,
    REPORT_JSON,
    SAMPLES,
    SUMS,
    UNCERTAINTY,
    Lut,
    known_sums,
    light_sha256,
    open_lut,
    parse_provenance,
    require_listed,
)
from experiment.lights import load_illuminations
from foundation.errors import CropError, FormatError, InputError, StorageError
from foundation.files import file_sha256, parse_json_object, require_plain_tree, storage_error, write_atomic
from foundation.folders import atomic_folder, require_free

FORMAT: Final = "crop.lut.published"

VERSION: Final = 1  # The only version so far

# Files that go along where the table has them, the one that makes a folder a table last.
TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, UNCERTAINTY, CELLS, REPORT_JSON, SUMS, PROVENANCE)

MOST_LIGHTS: Final = 65_536  # Lights of a table that is fetched, at most: a hundred times those of the paper

_METADATA: Final = "zarr.json"

# The metadata hold all files of the table but samples and page; see `calibration.table.lut.MOST_BYTES`.
_MOST_METADATA: Final = 256 << 20

_MOST_HEAD: Final = 10_000  # Longest head of an array file that NumPy reads

# Codecs of published tables; others are not run, for a store may name any that this machine has.
_CODECS: Final = frozenset({"sharding_indexed", "bytes", "blosc", "crc32c"})

HASH: Final = re.compile("[0-9a-f]{64}")  # A SHA-256 as it is printed and given

# Lights of one object of the store: 100 MB compressed of a full table, a size that stores and networks like.
SHARD_LIGHTS: Final = 32

ReportLights = Callable[[int, int], None]  # Called with the number of lights copied, and the number of all


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
    lacking = {PROVENANCE, ILLUMINATIONS, SUMS} - found.keys()
    if lacking:
        raise FormatError(f"{url} lacks {' and '.join(sorted(lacking))}; publish the table again")
    return found


def require_expected(folder: Path, expect: str | None, url: str) -> None:
    """Refuse a table of another hash than expected; None expects none."""
    found = file_sha256(folder / SUMS)
    if expect is not None and found != expect:
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


def publish(lut: Lut, url: str, progress: ReportLights | None = None) -> None:
    """Write a table to a store."""
    zarr = _zarr()
    lights, colours, samples, _ = lut.samples.shape
    _require_free(url)
    try:
        array = zarr.create_array(
            url,
            shape=lut.samples.shape,
            dtype="uint16",
            chunks=(1, colours, samples, 3),
            shards=(min(SHARD_LIGHTS, lights), colours, samples, 3),
            compressors=zarr.codecs.BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle", typesize=2),
            dimension_names=("light", "colour", "sample", "rgb"),
            attributes={"format": FORMAT, "whole": False},
            overwrite=True,
        )
        for first in range(0, lights, SHARD_LIGHTS):
            last = min(first + SHARD_LIGHTS, lights)
            array[first:last] = np.stack([lut.light_samples(light) for light in range(first, last)])
            if progress is not None:
                progress(last, lights)
        texts = {name: (lut.folder / name).read_text("utf-8") for name in TEXTS if (lut.folder / name).is_file()}
        with (lut.folder / SAMPLES).open("rb") as stream:
            head = stream.read((lut.folder / SAMPLES).stat().st_size - lut.samples.nbytes)
        array.attrs.update({"version": VERSION, "files": texts, "head": base64.b64encode(head).decode(), "whole": True})
    except CropError:
        raise
    except Exception as error:
        # Every store raises errors of its own.
        raise StorageError(
            f"cannot write {url}: {reason_of(error)}; check the address and that you may write there"
        ) from error


def fetch(url: str, folder: Path, progress: ReportLights | None = None, expect: str | None = None) -> Lut:
    """Copy a published table to a folder, where it is memory-mapped.

    What a store claims is believed only as far as it fits together and on the disk: the texts come first, and say how
    large the samples are; each light is held against its hash when it has come.

    `expect`: the table's hash as `Lut.sha256`, told by somebody who is trusted; None for any.
    """
    zarr = _zarr()
    if expect is not None and not HASH.fullmatch(expect):
        raise InputError(f"{expect!r} is no hash of a table; give the 64 digits that build-lut info prints as Table")
    require_free(folder, "the table")
    described = described_at(url)
    attributes = attributes_of(described)
    if described is None or attributes is None or attributes.get("whole") is not True:
        raise FormatError(
            f"{url} holds no table, or one that was never finished; check the address, or publish it again"
        )
    if attributes.get("version") != VERSION:
        raise FormatError(
            f"{url} is published in version {attributes.get('version')!r}, this software reads {VERSION}; update it"
        )
    files = texts_of(attributes, url)
    with atomic_folder(folder, "the table") as partial:
        for name in TEXTS:
            if name in files:
                write_atomic(partial / name, files[name])
        known = parse_provenance(files[PROVENANCE].encode(), partial / PROVENANCE)
        require_expected(partial, expect, url)
        lights = len(load_illuminations(partial / ILLUMINATIONS, computed=True))
        require_listed(partial, known, lights)
        shape = require_shape(described, (lights, 8**known.bits), url)
        head = head_of(attributes, shape, url)
        require_room(partial, len(head) + math.prod(shape) * 2, url)
        try:
            array: Any = zarr.open_array(url, mode="r")
        except Exception as error:
            # Every store raises errors of its own.
            raise FormatError(f"cannot read {url}: {reason_of(error)}; publish the table again") from error
        path = partial / SAMPLES
        try:
            with path.open("wb") as stream:
                stream.write(head)
                for light in range(lights):
                    samples = _light(array, light, shape, url)
                    if light_sha256(samples) != known.lights_sha256[light]:
                        raise FormatError(
                            f"the samples of light {light} from {url} are not those that were measured; publish again"
                        )
                    stream.write(samples.tobytes())
                    if progress is not None:
                        progress(light + 1, lights)
        except OSError as error:
            raise storage_error(path, error) from error
        open_lut(partial)
        if file_sha256(path) != known_sums(partial)[SAMPLES]:
            raise FormatError(f"the samples from {url} are not those that were measured; publish the table again")
    return open_lut(folder)


def _light(array: Any, light: int, shape: tuple[int, int, int, int], url: str) -> npt.NDArray[np.uint16]:
    try:
        samples = np.asarray(array[light], dtype="<u2")
        if samples.shape != shape[1:]:
            raise ValueError(f"it is of shape {samples.shape}")
    except Exception as error:
        # Every store raises errors of its own, and a damaged chunk those of its codec.
        raise FormatError(f"cannot read light {light} of {url}: {reason_of(error)}; publish the table again") from error
    return samples


def _require_free(url: str) -> None:
    from fsspec.core import url_to_fs

    attributes = attributes_of(described_at(url))
    if attributes is not None and attributes.get("whole"):
        raise InputError(f"{url} already holds a table; name another place, or remove what is there")
    if attributes is None:
        files, root = url_to_fs(url)
        if files.exists(root) and files.find(root):
            raise InputError(f"{url} already holds something else; name another place, or remove what is there")


def _zarr() -> Any:
    if find_spec("zarr") is None:
        raise InputError("published tables need zarr; install it with: pip install zarr")
    zarr = import_module("zarr")
    import_module("zarr.codecs")
    return zarr
