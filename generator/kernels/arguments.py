"""What the kernels' callers hand in, looked at before compiled code touches it; and rows shared among threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator.kernels.palette import bits_of
from generator.kernels.philox import key_of

Samples = npt.NDArray[np.uint16]
Picture = npt.NDArray[np.uint8]

_PAGE: Final = 4096
"""The smallest unit of memory protection on the processors we know; larger pages are whole multiples."""
_OFFSETS: Final = 0xFFFFFFFF
"""Compiled code counts bytes of a light's samples in 32 bits."""


def check_samples(samples: Samples) -> int:
    """Return the bits of a light's samples; they must be uint16 (8**bits, S, 3), S ≥ 1.

    Raises
    ------
    InputError
        They are something else.
    """
    if samples.dtype != np.uint16 or samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
        raise InputError(f"the samples are {samples.dtype} {samples.shape}, expected uint16 (8**bits, samples, 3)")
    if samples.nbytes > _OFFSETS:
        raise InputError(f"the samples of a light take {samples.nbytes} bytes, expected at most {_OFFSETS}")
    return bits_of(samples.shape[0])


def check_tables(tables: Samples | Sequence[Samples]) -> list[Samples]:
    """Return the samples of several lights as a list; they must be uint16 (8**bits, S, 3), all alike.

    Raises
    ------
    InputError
        There is none, or they are something else.
    """
    checked = list(tables)
    if not checked:
        raise InputError("no light was given to mix; give at least one")
    for table in checked:
        check_samples(table)
        if table.shape != checked[0].shape:
            raise InputError(f"the lights' samples are {checked[0].shape} and {table.shape}, expected one shape")
    return checked


def check_picture(picture: Picture) -> None:
    """Check that `picture` is uint8 (H, W, 3).

    Raises
    ------
    InputError
        It is something else.
    """
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(f"the picture is {picture.dtype} {picture.shape}, expected uint8 (height, width, 3)")


def check_target(
    out: npt.NDArray[Any] | None, shape: tuple[int, ...], dtype: type[np.uint16] | type[np.float32]
) -> npt.NDArray[Any]:
    """Return `out`, or a new array if it is None.

    Raises
    ------
    InputError
        `out` is of another shape or type, or not to be written to.
    """
    if out is None:
        return np.empty(shape, dtype)
    if out.dtype != dtype or out.shape != shape:
        raise InputError(f"the target is {out.dtype} {out.shape}, expected {np.dtype(dtype)} {shape}")
    if not out.flags.writeable:
        raise InputError("the target may not be written to; give an array whose flags.writeable is True")
    return out


def check_place(seed: int, image: int) -> np.uint64:
    """Return the seed as compiled code takes it.

    Raises
    ------
    InputError
        The seed is not 0 … 2⁶⁴ − 1 or the image number not 0 … 2³² − 1.
    """
    key_of(seed)
    if not 0 <= image < 1 << 32:
        raise InputError(f"the image number is {image}, expected 0 to 2^32 - 1")
    return np.uint64(seed)


def check_white(white_level: int) -> None:
    """Check that `white_level` is 1 … 65535.

    Raises
    ------
    InputError
        It is not.
    """
    if not 1 <= white_level <= 65535:
        raise InputError(f"the white level is {white_level}, expected 1 to 65535")


def packed(picture: Picture) -> Picture:
    """Return `picture` with the bytes of each row in one piece, itself where they are."""
    return picture if picture.strides[1:] == (3, 1) else np.ascontiguousarray(picture)


def readable(samples: Samples) -> Samples:
    """Return samples in one piece, behind which two more bytes can be read: themselves where possible.

    Samples are fetched eight bytes at a time. The two bytes behind an array can be read wherever they are on the page
    of its last byte, be they anyone's; where they are not, the samples are copied.
    """
    last = samples.ctypes.data + samples.nbytes - 1
    if samples.flags.c_contiguous and last // _PAGE == (last + 2) // _PAGE:
        return samples
    roomy = np.empty(samples.size + 1, np.uint16)
    roomy[:-1] = samples.reshape(-1)
    return roomy[:-1].reshape(samples.shape)


def writable(target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target` if its rows are pieces at even addresses, else an array of its shape to be `delivered`."""
    piece = (6, 2) if target.ndim == 3 else (2,)
    return target if target.strides[1:] == piece and target.flags.aligned else np.empty(target.shape, target.dtype)


def delivered(work: npt.NDArray[np.uint16], target: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return `target` with the content of `work`, which is itself or came from `writable`."""
    if work is not target:
        target[...] = work
    return target


def share(fill: Callable[[int, int], object], count: int, threads: int) -> None:
    """Call `fill(first, end)` for parts of 0 … count − 1, in as many threads."""
    threads = min(threads, count)
    if threads <= 1:
        fill(0, count)
        return
    edges = [count * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, edges[:-1], edges[1:]))
