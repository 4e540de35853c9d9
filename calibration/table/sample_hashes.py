"""Hashes of `samples.npy`: of the whole file, and of each light's part, by which damage is traced to a light."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from foundation.files import reading_error
from foundation.hashing import sha256_of

MOST_SAMPLES: Final = 1024
"""Samples of a cell at most: the largest window has 9×9."""


def light_sha256(samples: npt.NDArray[np.uint16]) -> str:
    """Return the SHA-256 of one light's samples (8**bits, S, 3) uint16, as their bytes lie in the file."""
    return sha256_of(np.ascontiguousarray(samples, dtype="<u2").data)


def map_samples(path: Path, lights: int, bits: int) -> npt.NDArray[np.uint16]:
    """Return `samples.npy` (lights, 8**bits, samples, 3) uint16, mapped from the disk."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            if version != (1, 0):
                raise ValueError(f"it is of version {version[0]}.{version[1]}, 1.0 expected")
            shape, columns_first, dtype = np.lib.format.read_array_header_1_0(stream)
            offset, size = stream.tell(), stream.seek(0, 2)
    except OSError as error:
        raise reading_error(path, error, "build the table again") from error
    except Exception as error:
        # The head is a Python literal, which fails in many ways.
        raise FormatError(f"cannot read {path}: {error}; restore it from a copy, or build the table again") from error
    if dtype != np.dtype("<u2") or columns_first or shape[:2] != (lights, 8**bits) or shape[3:] != (3,):
        raise FormatError(
            f"{path} holds {dtype} {shape}, expected uint16 ({lights}, {8**bits}, samples, 3); build the table again"
        )
    expected = offset + math.prod(shape) * 2
    if size != expected or not 0 < shape[2] <= MOST_SAMPLES:
        raise FormatError(f"{path} has {size} bytes, {expected} expected; restore it from a copy, or build it again")
    return np.memmap(path, dtype, "r", offset, shape)


def samples_sha256(
    path: Path, samples: npt.NDArray[np.uint16], progress: Callable[[int, int], None] | None = None
) -> tuple[str, list[str]]:
    """Return the hash of the file, and of each light's part of it, read once and in order.

    `samples`: (L, 8**bits, S, 3) uint16, the same file mapped: its shape is used.
    """
    whole, lights = hashlib.sha256(), list[str]()
    size = samples[0].nbytes
    try:
        with path.open("rb") as stream:
            whole.update(stream.read(path.stat().st_size - len(samples) * size))
            for light in range(len(samples)):
                slab = stream.read(size)
                whole.update(slab)
                lights.append(sha256_of(slab))
                if progress is not None:
                    progress(light + 1, len(samples))
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check the disk, or build the table again") from error
    return whole.hexdigest(), lights
