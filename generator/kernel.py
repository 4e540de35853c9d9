"""From source codes to linear camera RGB: each pixel becomes one of the table's samples of its colour.

Paper, section 3.4. The choice is a pure function of (seed, image number, x, y); tiles, threads and workers cannot
change a byte. It is fixed by the following rule, which is part of the dataset format:

    colour   ((R >> (8 - n)) << 2n) | ((G >> (8 - n)) << n) | (B >> (8 - n)), n the table's bits (5 in the paper)
    word     word number x mod 4 of Philox4x32-10 with counter (⌊x/4⌋, y, image, 0) and the seed as key; `philox.py`
    sample   ⌊word · S / 2³²⌋, S the samples the table has of each colour (25 in the paper)
    pixel    samples[colour, sample]

The compiled loop holds no state and no lock and releases the interpreter's. It is not split by numba's own threads:
their pool cannot be entered from two Python threads at once and does not survive a fork. Rows are split by plain
threads instead.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

import numba
import numpy as np
import numpy.typing as npt
from numba import uint32, uint64

from drivers.errors import InputError
from generator.compiled import compiled
from generator.mixing import mixed_table as mixed_table
from generator.palette import bits_of, fit_picture
from generator.philox import KEY_STEPS, MULTIPLIERS, ROUNDS, SAMPLES, key_of

if TYPE_CHECKING:
    from calibration.lut import Lut

_M0: Final = np.uint64(MULTIPLIERS[0])
_M1: Final = np.uint64(MULTIPLIERS[1])
_W0: Final = np.uint32(KEY_STEPS[0])
_W1: Final = np.uint32(KEY_STEPS[1])
_HALF: Final = np.uint64(32)
_PURPOSE: Final = np.uint32(SAMPLES)
_BLOCK: Final = 1024
_WHOLE_LIGHT: Final = 1 << 20
"""Pixels from which reading a light's samples in one go is cheaper than touching their pages at random."""


@numba.njit(inline="always")
def _words(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> Any:
    """Return the four words of Philox4x32-10, all numbers uint32."""
    for _ in range(ROUNDS):
        p0, p1 = uint64(c0) * _M0, uint64(c2) * _M1
        c0, c1, c2, c3 = (
            uint32(uint32(p1 >> _HALF) ^ c1 ^ k0),
            uint32(p1),
            uint32(uint32(p0 >> _HALF) ^ c3 ^ k1),
            uint32(p0),
        )
        k0, k1 = uint32(k0 + _W0), uint32(k1 + _W1)
    return c0, c1, c2, c3


@compiled
def _gather(
    picture: Any, flat: Any, samples: Any, bits: Any, k0: Any, k1: Any, image: int, first_row: int, out: Any
) -> None:
    """Fill `out` from `picture`; `flat` is the light's samples as one row of uint16."""
    shift = uint32(8 - bits)
    high, low, count = uint32(2 * bits), uint32(bits), uint64(samples)
    chosen = np.empty((4, _BLOCK // 4), np.uint32)
    offset = np.empty(_BLOCK, np.uint32)
    for y in range(picture.shape[0]):
        for x in range(0, picture.shape[1], _BLOCK):
            pixels = min(_BLOCK, picture.shape[1] - x)
            for i in range((pixels + 3) // 4):
                a, b, c, d = _words(uint32(x // 4 + i), uint32(first_row + y), uint32(image), _PURPOSE, k0, k1)
                chosen[0, i] = (uint64(a) * count) >> _HALF
                chosen[1, i] = (uint64(b) * count) >> _HALF
                chosen[2, i] = (uint64(c) * count) >> _HALF
                chosen[3, i] = (uint64(d) * count) >> _HALF
            source = picture[y, x : x + pixels]
            for i in range(pixels):
                colour = (
                    ((uint32(source[i, 0]) >> shift) << high)
                    | ((uint32(source[i, 1]) >> shift) << low)
                    | (uint32(source[i, 2]) >> shift)
                )
                offset[i] = colour * samples
            target = out[y, x : x + pixels]
            for i in range(pixels):
                at = np.intp(offset[i] + chosen[i & 3, i >> 2]) * 3
                target[i, 0] = flat[at]
                target[i, 1] = flat[at + 1]
                target[i, 2] = flat[at + 2]


def draw_samples(
    samples: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    *,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of `picture` under one light; the rule stands at the head of this file.

    Parameters
    ----------
    samples
        (8**bits, S, 3) uint16, linear camera RGB of one light, S ≥ 1; for example `lut.samples[light]`.
    picture
        (H, W, 3) uint8 sRGB codes; the 8 − bits low bits of a code do not matter.
    seed
        0 … 2⁶⁴ − 1.
    image
        Number of the image in its dataset, 0 … 2³² − 1.
    first_row
        The row of the whole picture that `picture` begins with: a picture done in bands is the same picture.
    threads
        Threads that share the rows; no byte depends on it.
    out
        (H, W, 3) uint16 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB in the units of `samples`.

    Raises
    ------
    InputError
        A shape, type or number is not as above.
    """
    if samples.dtype != np.uint16 or samples.ndim != 3 or samples.shape[2] != 3 or not samples.shape[1]:
        raise InputError(f"the samples are {samples.dtype} {samples.shape}, expected uint16 (8**bits, samples, 3)")
    bits = bits_of(samples.shape[0])
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(f"the picture is {picture.dtype} {picture.shape}, expected uint8 (height, width, 3)")
    if out is None:
        out = np.empty(picture.shape, np.uint16)
    elif out.dtype != np.uint16 or out.shape != picture.shape:
        raise InputError(f"the target is {out.dtype} {out.shape}, expected uint16 {picture.shape}")
    if not 0 <= image < 1 << 32:
        raise InputError(f"the image number is {image}, expected 0 to 2^32 - 1")
    k0, k1 = (np.uint32(word) for word in key_of(seed))
    flat = np.ascontiguousarray(samples).reshape(-1)
    # The image's number goes in as a plain integer: as uint32 the compiler's code is a third slower.
    numbers = (np.uint32(samples.shape[1]), np.uint32(bits), k0, k1, image)

    def fill(top: int, bottom: int) -> None:
        _gather(picture[top:bottom], flat, *numbers, first_row + top, out[top:bottom])

    if threads <= 1:
        fill(0, len(picture))
    else:
        edges = [len(picture) * part // threads for part in range(threads + 1)]
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(fill, edges[:-1], edges[1:]))
    return out


def read_light(lut: Lut, light: int, pixels: int = _WHOLE_LIGHT) -> npt.NDArray[np.uint16]:
    """Return the samples (8**bits, S, 3) uint16 of light number `light`, in memory if `pixels` are worth the copy.

    Raises
    ------
    InputError
        The table has no such light.
    """
    if not 0 <= light < len(lut.samples):
        raise InputError(f"there is no light {light}; the table {lut.folder} has lights 0 to {len(lut.samples) - 1}")
    mapped = lut.samples[light]
    return np.array(mapped) if pixels >= _WHOLE_LIGHT else mapped


def render(
    lut: Lut, picture: npt.NDArray[np.uint8], light: int, *, seed: int = 0, image: int = 0, threads: int = 1
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image of `picture` printed, lit by the table's light `light` and photographed.

    Colours that the table lists as unfit are replaced by the nearest fit one; see `palette.fit_picture`.

    Parameters
    ----------
    lut
        A table, from `calibration.lut.open_lut`.
    picture
        (H, W, 3) uint8 sRGB codes, from `scene.read_picture` or any array.
    light
        Number of the light in the table.
    seed, image, threads
        As for `draw_samples`.

    Returns
    -------
    ndarray
        (H, W, 3) uint16, linear camera RGB, `lut.provenance.white_level` = saturation of the sensor.

    Raises
    ------
    InputError
        The table has no such light, or the picture is not of that shape and type.
    """
    samples = read_light(lut, light, picture.shape[0] * picture.shape[1])
    fit, _ = fit_picture(picture, lut.provenance)
    return draw_samples(samples, fit, seed=seed, image=image, threads=threads)
