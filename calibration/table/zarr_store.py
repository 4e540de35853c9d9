"""A table as others get it: a sharded Zarr array on any store that fsspec reaches, and back to the folder that is used.

Zarr specification version 3 with the codec `sharding_indexed`: one light is a chunk, 32 lights an object, compressed by
Blosc (Zstandard after bit shuffle), about two thirds of `samples.npy`. The table's other files are attributes, word for
word, so that a table that was fetched is the one that was published, hash by hash.

Rules that hold inside:

- The attributes are completed last: an array without the attribute `whole` was never finished.
- Nothing is overwritten but such an array.
- A table that is fetched appears in its folder whole and verified, or not at all.

Needs zarr, the extra `cluster`.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from calibration.table.file_names import FRAMES, ILLUMINATIONS, PROVENANCE, REFERENCES, REPORT_JSON, SAMPLES
from calibration.table.lut import Lut, open_lut
from calibration.table.sample_hashes import light_sha256
from foundation.errors import CropError, FormatError, InputError, StorageError
from foundation.files import require_free, storage_error, whole_folder, write_whole
from foundation.hashing import file_sha256

FORMAT: Final = "crop.lut.published"
VERSION: Final = 1
"""The only version so far."""

SHARD_LIGHTS: Final = 32
"""Lights of one object of the store: 100 MB compressed of a full table, a size that stores and networks like."""

_TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, REPORT_JSON, PROVENANCE)
"""Files that go along where the table has them, the one that makes a folder a table last."""

ReportLights = Callable[[int, int], None]
"""Called with the number of lights copied, and the number of all."""


def publish(lut: Lut, url: str, progress: ReportLights | None = None) -> None:
    """Write a table to a store.

    Parameters
    ----------
    lut
        The table.
    url
        Where to: a path, or a URL that fsspec knows, such as ``s3://bucket/eos550d``. Must be free, or hold a table
        that was never finished.
    progress
        Called with the number of lights written, and the number of all.

    Raises
    ------
    InputError
        Something is there already, or zarr is not installed.
    StorageError
        The store cannot be written.
    """
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
            array[first:last] = np.asarray(lut.samples[first:last])
            if progress is not None:
                progress(last, lights)
        texts = {name: (lut.folder / name).read_text("utf-8") for name in _TEXTS if (lut.folder / name).is_file()}
        with (lut.folder / SAMPLES).open("rb") as stream:
            head = stream.read((lut.folder / SAMPLES).stat().st_size - lut.samples.nbytes)
        array.attrs.update({"version": VERSION, "files": texts, "head": base64.b64encode(head).decode(), "whole": True})
    except CropError:
        raise
    except Exception as error:
        # Every store raises errors of its own.
        raise StorageError(
            f"cannot write {url}: {_reason(error)}; check the address and that you may write there"
        ) from error


def fetch(url: str, folder: Path, progress: ReportLights | None = None) -> Lut:
    """Copy a published table to a folder, where it is memory-mapped.

    Parameters
    ----------
    url
        Where it was published.
    folder
        Must be free; appears when the table is complete and verified.
    progress
        Called with the number of lights read, and the number of all.

    Raises
    ------
    InputError
        The folder is taken, or zarr is not installed.
    FormatError
        There is no table, it was never finished, or what came is not what was published.
    StorageError
        The disk is full or read-only.
    """
    zarr = _zarr()
    require_free(folder, "the table")
    attributes = _attributes(url)
    if attributes is None or not attributes.get("whole"):
        raise FormatError(
            f"{url} holds no table, or one that was never finished; check the address, or publish it again"
        )
    if attributes.get("version") != VERSION:
        raise FormatError(
            f"{url} is published in version {attributes.get('version')!r}, this software reads {VERSION}; update it"
        )
    array: Any = zarr.open_array(url, mode="r")
    with whole_folder(folder, "the table") as partial:
        path = partial / SAMPLES
        try:
            with path.open("wb") as stream:
                stream.write(base64.b64decode(attributes["head"]))
                for light in range(array.shape[0]):
                    stream.write(_light(array, light, url).tobytes())
                    if progress is not None:
                        progress(light + 1, array.shape[0])
        except OSError as error:
            raise storage_error(path, error) from error
        files: dict[str, str] = attributes["files"]
        for name in _TEXTS:
            if name in files:
                write_whole(partial / name, files[name])
        _verify(open_lut(partial), url)
    return open_lut(folder)


def _light(array: Any, light: int, url: str) -> npt.NDArray[np.uint16]:
    try:
        return np.asarray(array[light], dtype="<u2")
    except Exception as error:
        # Every store raises errors of its own, and a damaged chunk those of its codec.
        raise FormatError(f"cannot read light {light} of {url}: {_reason(error)}; publish the table again") from error


def _verify(lut: Lut, url: str) -> None:
    """Refuse a table whose samples do not have the recorded hashes; the first tables of version 1 have none."""
    known = lut.provenance
    for light, then in enumerate(known.lights_sha256):
        if light_sha256(lut.samples[light]) != then:
            raise FormatError(
                f"the samples of light {light} from {url} are not those that were measured; publish again"
            )
    if known.samples_sha256 is not None and file_sha256(lut.folder / SAMPLES) != known.samples_sha256:
        raise FormatError(f"the samples from {url} are not those that were measured; publish the table again")


def _require_free(url: str) -> None:
    from fsspec.core import url_to_fs

    attributes = _attributes(url)
    if attributes is not None and attributes.get("whole"):
        raise InputError(f"{url} already holds a table; name another place, or remove what is there")
    if attributes is None:
        files, root = url_to_fs(url)
        if files.exists(root) and files.find(root):
            raise InputError(f"{url} already holds something else; name another place, or remove what is there")


def _attributes(url: str) -> dict[str, Any] | None:
    """Return the attributes of a published table, finished or not; None where there is none."""
    zarr = _zarr()
    try:
        array: Any = zarr.open_array(url, mode="r")
    except (FileNotFoundError, KeyError):
        return None
    except Exception as error:
        raise InputError(f"cannot look into {url}: {_reason(error)}; check the address") from error
    attributes = cast("dict[str, Any]", dict(array.attrs))
    return attributes if attributes.get("format") == FORMAT else None


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")


def _zarr() -> Any:
    if find_spec("zarr") is None:
        raise InputError("published tables need zarr; install it with: pip install zarr")
    zarr = import_module("zarr")
    import_module("zarr.codecs")
    return zarr
