"""A table as others get it: a sharded Zarr array on any store that fsspec reaches, and back to the folder that is used.

Zarr specification version 3 with the codec `sharding_indexed`: one light is a chunk, 32 lights an object, compressed by
Blosc (Zstandard after bit shuffle), about two thirds of `samples.npy`. The table's other files are attributes, word for
word, so that a table that was fetched is the one that was published, hash by hash.

Rules that hold inside:

- The attributes are completed last: an array without the attribute `whole` was never finished.
- Nothing is overwritten but such an array.
- Nothing that a store says of itself is believed before it fits together: sizes, names and codecs are bounded.
- A table that is fetched appears in its folder whole and verified, or not at all.

Needs zarr, the extra `cluster`.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from calibration.table.file_names import ILLUMINATIONS, PROVENANCE, SAMPLES
from calibration.table.lut import Lut, open_lut
from calibration.table.provenance import parse_provenance
from calibration.table.published_claims import (
    FORMAT,
    HASH,
    TEXTS,
    VERSION,
    attributes_of,
    described_at,
    head_of,
    reason_of,
    require_expected,
    require_room,
    require_shape,
    texts_of,
)
from calibration.table.sample_hashes import light_sha256
from calibration.table.sums import known_sums, require_listed
from experiment.lights import load_illuminations
from foundation.errors import CropError, FormatError, InputError, StorageError
from foundation.files import require_free, storage_error, whole_folder, write_whole
from foundation.hashing import file_sha256

SHARD_LIGHTS: Final = 32
"""Lights of one object of the store: 100 MB compressed of a full table, a size that stores and networks like."""

ReportLights = Callable[[int, int], None]
"""Called with the number of lights copied, and the number of all."""


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
        raise InputError(f"{expect!r} is no hash of a table; give the 64 digits that build-lut --info prints as Table")
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
    with whole_folder(folder, "the table") as partial:
        for name in TEXTS:
            if name in files:
                write_whole(partial / name, files[name])
        known = parse_provenance(files[PROVENANCE].encode(), partial / PROVENANCE)
        require_expected(partial, known, expect, url)
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
                    if known.lights_sha256 and light_sha256(samples) != known.lights_sha256[light]:
                        raise FormatError(
                            f"the samples of light {light} from {url} are not those that were measured; publish again"
                        )
                    stream.write(samples.tobytes())
                    if progress is not None:
                        progress(light + 1, lights)
        except OSError as error:
            raise storage_error(path, error) from error
        open_lut(partial)
        whole = known_sums(partial, known).get(SAMPLES)
        if whole is not None and file_sha256(path) != whole:
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
