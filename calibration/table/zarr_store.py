"""Publish a LUT as a sharded Zarr array on any fsspec store, and fetch it back to a folder.

Zarr specification version 3 with the codec `sharding_indexed`: one chunk per illuminant, 32 illuminants per object,
compressed by Blosc (Zstandard after bit shuffle). The other files of the LUT are stored unchanged as attributes. The
attribute `whole` is set to true at the end; only an array without it may be overwritten.

Data from a store are not trusted. Files, shape and chunks of the array and the header of `samples.npy` must agree.
Sizes are limited, and only the file names and codecs of published LUTs are accepted. A fetched LUT appears in its
folder complete and verified, or not at all. Needs zarr, the extra `cluster`.
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
    light_sha256,
    open_lut,
    parse_provenance,
    recorded_sums,
    require_listed,
)
from experiment.lights import load_illuminants
from foundation.errors import RUN_AGAIN, CropError, FormatError, InputError, StorageError
from foundation.files import file_sha256, parse_json_object, require_plain_tree, storage_error, write_atomic
from foundation.folders import atomic_folder, require_free
from foundation.remote import filesystem, is_remote, remote_error

FORMAT: Final = "crop.lut.published"

VERSION: Final = 1  # the only version so far

# Text files that are published if they exist; `lut.json` last, because it completes a LUT.
TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, UNCERTAINTY, CELLS, REPORT_JSON, SUMS, PROVENANCE)

MOST_LIGHTS: Final = 65_536  # largest number of illuminants in a fetched LUT; the paper's LUT has about 700

_METADATA: Final = "zarr.json"

# Largest size of the metadata, in bytes. They contain all files except samples and report page.
_MOST_METADATA: Final = 256 << 20

_MOST_HEAD: Final = 10_000  # longest header of an array file that NumPy reads, bytes

# Codecs of published LUTs; others are not run, because a store could name any installed codec.
_CODECS: Final = frozenset({"sharding_indexed", "bytes", "blosc", "crc32c"})

HASH: Final = re.compile("[0-9a-f]{64}")  # SHA-256 in hexadecimal digits

SHARD_LIGHTS: Final = 32  # number of illuminants per object of the store; 100 MB in a full LUT

ReportLights = Callable[[int, int], None]  # called with the number of copied illuminants and the total number


def table_texts(attributes: dict[str, Any], url: str) -> dict[str, str]:
    """Return the text files of a published LUT by name; raise `FormatError` if there are other files."""
    files = attributes.get("files")
    if not isinstance(files, dict):
        raise FormatError(f"{url} has no files attribute, which every LUT has; publish the LUT again")
    texts: dict[str, str] = {}
    for name, text in cast("dict[str, Any]", files).items():
        if name not in TEXTS or not isinstance(text, str) or len(text) > MOST_BYTES[name]:
            raise FormatError(
                f"{url} contains {name!r}, which is not a file of a LUT or is too large; publish the LUT again"
            )
        texts[name] = text
    missing = {PROVENANCE, ILLUMINATIONS, SUMS} - texts.keys()
    if missing:
        raise FormatError(f"{url} lacks {' and '.join(sorted(missing))}; publish the LUT again")
    return texts


def require_expected(folder: Path, expect: str | None, url: str) -> None:
    """Raise `FormatError` if the hash of a LUT differs from `expect`; None accepts any hash."""
    table_hash = file_sha256(folder / SUMS)
    if expect is not None and table_hash != expect:
        raise FormatError(
            f"{url} is another LUT: its hash is {table_hash}, expected {expect}; check the hash and the address"
        )


def require_shape(metadata: dict[str, Any], expected: tuple[int, int], url: str) -> tuple[int, int, int, int]:
    """Return the shape of the samples; raise `FormatError` if shape, chunks, type or codecs are not of a LUT.

    `expected`: numbers of illuminants and colours.
    """
    shape = metadata.get("shape")
    chunks: Any = {}
    codecs: set[Any] = set()
    try:
        (sharding,) = metadata["codecs"]
        chunks = sharding["configuration"]["chunk_shape"]
        inner = sharding["configuration"]["codecs"] + sharding["configuration"]["index_codecs"]
        codecs = {sharding["name"], *(codec["name"] for codec in inner)}
        lights, colours, samples, channels = (int(side) for side in cast("list[int]", shape))
        is_valid = (
            (lights, colours, channels) == (*expected, 3)
            and 0 < samples <= MOST_SAMPLES
            and lights <= MOST_LIGHTS
            and list(chunks) == [1, colours, samples, 3]
            and metadata["data_type"] == "uint16"
            and codecs <= _CODECS
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        is_valid, (lights, colours, samples, channels) = False, (0, 0, 0, 0)
    if not is_valid:
        raise FormatError(
            f"{url} is an array of shape {str(shape)[:200]}, expected [{expected[0]}, {expected[1]}, samples, 3] as in "
            "its files, uint16 with a chunk per illuminant; publish the LUT again"
        )
    return lights, colours, samples, channels


def samples_header(attributes: dict[str, Any], shape: tuple[int, int, int, int], url: str) -> bytes:
    """Return the header of `samples.npy`; raise `FormatError` if it does not match the shape."""
    try:
        head = base64.b64decode(attributes["head"], validate=True)[:_MOST_HEAD]
        stream = io.BytesIO(head)
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("its version is not 1.0")
        header = np.lib.format.read_array_header_1_0(stream)
        if header != (shape, False, np.dtype("<u2")) or stream.read():
            raise ValueError("it belongs to another array")
    except Exception as error:
        # The header is a Python literal, which can raise many kinds of errors.
        raise FormatError(f"the header of the samples of {url} is damaged: {error}; publish the LUT again") from error
    return head


def require_space(folder: Path, size: int, url: str) -> None:
    """Raise `StorageError` if the samples do not fit on the disk, before they are copied."""
    free_bytes = shutil.disk_usage(folder).free
    if size > free_bytes:
        raise StorageError(
            f"the samples of {url} need {size / 1e9:.1f} GB, but {free_bytes / 1e9:.1f} GB are free at "
            f"{folder.parent}; free space or choose another disk, {RUN_AGAIN}"
        )


def read_metadata(url: str) -> dict[str, Any] | None:
    """Return the metadata of an array, `zarr.json` (Zarr 3, "Array metadata"); None if it does not exist."""
    if not is_remote(url):
        require_plain_tree(Path(url.removeprefix("file://")))
    files, root = filesystem(url)
    try:
        with files.open(f"{root.rstrip('/')}/{_METADATA}", "rb") as stream:
            data = stream.read(_MOST_METADATA + 1)
    except FileNotFoundError:
        return None
    except Exception as error:
        # Each kind of store raises different errors.
        raise remote_error(error, "read", url) from error
    if len(data) > _MOST_METADATA:
        raise FormatError(f"{url}: {_METADATA} has more than {_MOST_METADATA} bytes, expected fewer; check the address")
    return parse_json_object(data, f"{_METADATA} of {url}")


def table_attributes(metadata: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the attributes of a published LUT, complete or not; None if the array is no LUT."""
    attributes = (metadata or {}).get("attributes")
    if not isinstance(attributes, dict):
        return None
    published = cast("dict[str, Any]", attributes)
    return published if published.get("format") == FORMAT else None


def publish(lut: Lut, url: str, progress: ReportLights | None = None) -> None:
    """Write a LUT to a store."""
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
        # Each kind of store raises different errors.
        raise remote_error(error, "write", url) from error


def fetch(url: str, folder: Path, progress: ReportLights | None = None, expect: str | None = None) -> Lut:
    """Copy a published LUT to a folder, and open it.

    Text files are copied first; they determine the size of the samples. The samples of each illuminant are verified
    when they arrive.

    Parameters
    ----------
    url : str
    folder : Path
    progress : callable, optional
        Called with the number of copied illuminants and the total number.
    expect : str, optional
        Hash of the LUT (`Lut.sha256`) from a trusted person; None accepts any LUT.
    """
    zarr = _zarr()
    if expect is not None and not HASH.fullmatch(expect):
        raise InputError(f"{expect!r} is not the hash of a LUT; give the 64 digits after LUT in build-lut info")
    require_free(folder, "the LUT")
    metadata = read_metadata(url)
    attributes = table_attributes(metadata)
    if metadata is None or attributes is None or attributes.get("whole") is not True:
        raise FormatError(f"{url} is not a complete LUT; check the address, or publish the LUT again")
    if attributes.get("version") != VERSION:
        raise FormatError(f"{url} has version {attributes.get('version')!r}, expected {VERSION}; update this software")
    files = table_texts(attributes, url)
    with atomic_folder(folder, "the LUT") as partial:
        for name in TEXTS:
            if name in files:
                write_atomic(partial / name, files[name])
        provenance = parse_provenance(files[PROVENANCE].encode(), partial / PROVENANCE)
        require_expected(partial, expect, url)
        lights = len(load_illuminants(partial / ILLUMINATIONS, computed=True))
        require_listed(partial, provenance, lights)
        shape = require_shape(metadata, (lights, 8**provenance.bits), url)
        head = samples_header(attributes, shape, url)
        require_space(partial, len(head) + math.prod(shape) * 2, url)
        try:
            array: Any = zarr.open_array(url, mode="r")
        except Exception as error:
            # Each kind of store raises different errors.
            raise remote_error(error, "read", url, "publish the LUT again") from error
        path = partial / SAMPLES
        try:
            with path.open("wb") as stream:
                stream.write(head)
                for light in range(lights):
                    samples = _light(array, light, shape, url)
                    if light_sha256(samples) != provenance.lights_sha256[light]:
                        raise FormatError(
                            f"the samples of illuminant {light} of {url} are damaged; publish the LUT again"
                        )
                    stream.write(samples.tobytes())
                    if progress is not None:
                        progress(light + 1, lights)
        except OSError as error:
            raise storage_error(path, error) from error
        open_lut(partial)
        if file_sha256(path) != recorded_sums(partial)[SAMPLES]:
            raise FormatError(f"the samples of {url} are damaged; publish the LUT again")
    return open_lut(folder)


def _light(array: Any, light: int, shape: tuple[int, int, int, int], url: str) -> npt.NDArray[np.uint16]:
    try:
        samples = np.asarray(array[light], dtype="<u2")
        if samples.shape != shape[1:]:
            raise ValueError(f"its shape is {samples.shape}, expected {shape[1:]}")
    except Exception as error:
        # Each kind of store raises different errors, and damaged chunks raise errors of the codec.
        raise remote_error(error, "read", f"illuminant {light} of {url}", "publish the LUT again") from error
    return samples


def _require_free(url: str) -> None:
    attributes = table_attributes(read_metadata(url))
    if attributes is not None and attributes.get("whole"):
        raise InputError(f"{url} already has a LUT; give another address, or remove it")
    if attributes is None:
        files, root = filesystem(url)
        if files.exists(root) and files.find(root):
            raise InputError(f"{url} already has other files; give another address, or remove them")


def _zarr() -> Any:
    if find_spec("zarr") is None:
        raise InputError("published LUTs need zarr; install it with: pip install zarr")
    zarr = import_module("zarr")
    import_module("zarr.codecs")
    return zarr
