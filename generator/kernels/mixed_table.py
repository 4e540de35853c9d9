"""The samples of a light that is the mixture of some lights, by the formula at the head of `mixing.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from foundation.errors import InputError
from generator import philox
from generator.kernels.arguments import Samples, check_seed, check_tables, check_weights, check_white_level
from generator.kernels.choice import philox4x32

_MIXTURES: Final = np.uint32(philox.MIXTURES)


@compiled
def _mix_table(samples: Any, weight: float, seed: Any, place: int, shuffled: bool, chosen: Any, total: Any) -> None:
    """Add one light to `total` (N, S, 3) float64, each chosen colour's samples in the order of a shuffle of its own."""
    count = samples.shape[1]
    root = np.sqrt(weight)
    order = np.empty(count, np.uint32)
    for i in range(count):
        order[i] = i
    words = np.empty(count + 3, np.uint32)
    rest = np.empty(3)
    for number, colour in enumerate(chosen):
        drawn, sums = samples[colour], total[number]
        if shuffled:
            for i in range(0, count, 4):
                words[i], words[i + 1], words[i + 2], words[i + 3] = philox4x32(
                    np.uint32(colour), np.uint32(i // 4), np.uint32(place), _MIXTURES, seed
                )
            for i in range(count):
                order[i] = i
            for i in range(count - 1):
                j = i + np.int64((np.uint64(words[i]) * np.uint64(count - i)) >> np.uint64(32))
                order[i], order[j] = order[j], order[i]
        red = green = blue = 0
        for i in range(count):
            red, green, blue = red + drawn[i, 0], green + drawn[i, 1], blue + drawn[i, 2]
        for channel, mean in enumerate((red / count, green / count, blue / count)):
            rest[channel] = (weight - root) * mean
        for i in range(count):
            sample = drawn[order[i]]
            for channel in range(3):
                sums[i, channel] += root * sample[channel] + rest[channel]


@compiled
def _round_table(total: Any, white: float, chosen: Any, out: Any) -> None:
    for number, colour in enumerate(chosen):
        for i in range(total.shape[1]):
            for channel in range(3):
                out[colour, i, channel] = np.uint16(min(max(total[number, i, channel] + 0.5, 0.0), white))


def mixed_table(
    tables: Samples | Sequence[Samples],
    weights: npt.ArrayLike,
    *,
    white_level: int = 65535,
    seed: int = 0,
    colours: npt.NDArray[np.bool_] | None = None,
) -> Samples:
    """Return the samples of a light that is the mixture of some lights; the formula stands at the head of `mixing.py`.

    The result is used as a light's samples: `draw_samples(mixed_table(...), picture)`. Each colour's samples of the
    first light with a weight keep their order; those of each further light are shuffled on their own, so that the
    lights' noises meet by chance.

    Parameters
    ----------
    tables
        (K, 8**bits, S, 3) uint16 or a sequence of K (8**bits, S, 3), linear camera RGB of the lights.
    weights
        (K,) float ≥ 0, what each light contributes; 1 is the light as it was photographed.
    white_level
        Saturation of the sensor, 1 … 65535: larger values are cut to it.
    seed
        Of the shuffles, 0 … 2⁶⁴ − 1.
    colours
        (8**bits,) bool, which colours are wanted, as from `palette.colours_in`; None for all. For a small picture it is
        much less work. The samples of the others are 0; those of the wanted ones do not depend on it.

    Returns
    -------
    ndarray
        (8**bits, S, 3) uint16, linear camera RGB, rounded to the nearest count, halves up.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

    Examples
    --------
    >>> red, blue = np.zeros((2, 8, 25, 3), np.uint16)
    >>> red[7], blue[7] = (800, 400, 200), (200, 400, 800)
    >>> mixed_table([red, blue], [0.5, 0.25])[7, 0]
    array([450, 300, 300], dtype=uint16)
    """
    lights = check_tables(tables)
    checked = check_weights(weights, len(lights))
    check_white_level(white_level)
    key = check_seed(seed, 0)
    shape = lights[0].shape
    if colours is not None and (colours.shape != shape[:1] or colours.dtype != np.bool_):
        raise InputError(f"the colours are {colours.dtype} {colours.shape}, expected bool ({shape[0]},)")
    chosen = np.flatnonzero(np.ones(shape[0], np.bool_) if colours is None else colours)
    total = np.zeros((len(chosen), *shape[1:]), np.float64)
    shuffled = False
    for place, (samples, weight) in enumerate(zip(lights, checked, strict=True)):
        if weight > 0:
            _mix_table(np.asarray(samples), float(weight), key, place, shuffled, chosen, total)
            shuffled = True
    out = np.zeros(shape, np.uint16)
    _round_table(total, float(white_level), chosen, out)
    return out
