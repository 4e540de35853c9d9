"""Arguments of the kernels, checked before compiled code reads their memory; and rows split among threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator.kernels.palette import bits_of
from generator.philox import key_of

Samples = npt.NDArray[np.uint16]
Picture = npt.NDArray[np.uint8]

_PAGE: Final = 4096
"""Bytes of a page, the smallest unit of memory protection on x86-64 and arm64; larger pages are whole multiples."""
_OFFSETS: Final = 0xFFFFFFFF
"""Most bytes of a light's samples: compiled code counts them in 32 bits."""


def check_samples(samples: Samples) -> int:
    """Return the bits a channel of a light's samples; they must be uint16 (8**bits, S, 3), S ≥ 1."""
    if samples.dtype != np.uint16 or samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
        raise InputError(f"the samples are {samples.dtype} {samples.shape}, expected uint16 (8**bits, samples, 3)")
    if samples.nbytes > _OFFSETS:
        raise InputError(f"the samples of a light take {samples.nbytes} bytes, expected at most {_OFFSETS}")
    return bits_of(samples.shape[0])


def check_tables(tables: Samples | Sequence[Samples]) -> list[Samples]:
    """Return the samples of several lights as a list; they must be uint16 (8**bits, S, 3), all of one shape."""
    checked = list(tables)
    if not checked:
        raise InputError("no light was given to mix; give at least one")
    for table in checked:
        check_samples(table)
        if table.shape != checked[0].shape:
            raise InputError(f"the lights' samples are {checked[0].shape} and {table.shape}, expected one shape")
    return checked


def check_picture(picture: Picture) -> None:
    """Check that `picture` is uint8 (H, W, 3)."""
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(f"the picture is {picture.dtype} {picture.shape}, expected uint8 (height, width, 3)")


def check_out(
    out: npt.NDArray[Any] | None, shape: tuple[int, ...], dtype: type[np.uint16] | type[np.float32]
) -> npt.NDArray[Any]:
    """Return `out`, of that shape and that dtype, or a new array of them if it is None."""
    if out is None:
        return np.empty(shape, dtype)
    if out.dtype != dtype or out.shape != shape:
        raise InputError(f"the target is {out.dtype} {out.shape}, expected {np.dtype(dtype)} {shape}")
    if not out.flags.writeable:
        raise InputError("the target may not be written to; give an array whose flags.writeable is True")
    return out


def check_seed(seed: int, image: int) -> np.uint64:
    """Return the seed as uint64 after checking it and the image number."""
    key_of(seed)
    if not 0 <= image < 1 << 32:
        raise InputError(f"the image number is {image}, expected 0 to 2^32 - 1")
    return np.uint64(seed)


def check_white_level(white_level: int) -> None:
    """Check that `white_level` is 1 … 65535."""
    if not 1 <= white_level <= 65535:
        raise InputError(f"the white level is {white_level}, expected 1 to 65535")


def check_weights(weights: npt.ArrayLike, lights: int) -> npt.NDArray[np.float64]:
    """Return the weights (K,) of `lights` lights as (K,) float64."""
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (lights,) or not np.isfinite(checked).all() or (checked < 0).any():
        raise InputError(f"the weights are {np.asarray(weights).tolist()}, expected {lights} finite numbers from 0")
    return checked


def packed_rows(picture: Picture) -> Picture:
    """Return `picture` (H, W, 3) uint8 with the bytes of each row contiguous: itself, or a copy if they are not."""
    return picture if picture.strides[1:] == (3, 1) else np.ascontiguousarray(picture)


def readable(samples: Samples) -> Samples:
    """Return samples (8**bits, S, 3) uint16 as a contiguous array behind which two more bytes can be read.

    Samples, of six bytes, are fetched eight bytes at a time. The two bytes behind an array can be read if they are on
    the page of its last byte, whoever owns them; if not, or if the samples are not contiguous, a copy is returned.
    """
    last = samples.ctypes.data + samples.nbytes - 1
    if samples.flags.c_contiguous and last // _PAGE == (last + 2) // _PAGE:
        return samples
    padded = np.empty(samples.size + 1, np.uint16)
    padded[:-1] = samples.reshape(-1)
    return padded[:-1].reshape(samples.shape)


def writable(target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target`, (H, W, 3) or (H, W) uint16, if compiled code can write its rows, else a new array of its shape.

    Rows must be contiguous and at even addresses. A new array is to be given to `copied_back` when it is filled.
    """
    piece = (6, 2) if target.ndim == 3 else (2,)
    return target if target.strides[1:] == piece and target.flags.aligned else np.empty(target.shape, target.dtype)


def copied_back(work: npt.NDArray[np.uint16], target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target`, (H, W, 3) or (H, W) uint16, with the content of `work`: itself, or the array from `writable`."""
    if work is not target:
        target[...] = work
    return target


def run_in_threads(fill: Callable[[int, int], object], count: int, threads: int) -> None:
    """Call `fill(first, end)` for as many parts of 0 … count − 1 as there are threads, a thread each."""
    threads = min(threads, count)
    if threads <= 1:
        fill(0, count)
        return
    edges = [count * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, edges[:-1], edges[1:]))
