"""Hashes of `samples.npy`: of the whole file, and of each light's part, by which damage is traced to a light."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from foundation.hashing import sha256_of


def light_sha256(samples: npt.NDArray[np.uint16]) -> str:
    """Return the SHA-256 of one light's samples (8**bits, S, 3) uint16, as their bytes lie in the file."""
    return sha256_of(np.ascontiguousarray(samples, dtype="<u2").data)


def samples_sha256(
    path: Path, samples: npt.NDArray[np.uint16], progress: Callable[[int, int], None] | None = None
) -> tuple[str, list[str]]:
    """Return the hash of the file, and of each light's part of it, read once and in order.

    Parameters
    ----------
    path
        `samples.npy`.
    samples
        (L, 8**bits, S, 3) uint16, the same file mapped: its shape is used.
    progress
        Called with the number of lights read, and the number of all.

    Raises
    ------
    FormatError
        The file cannot be read.
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
