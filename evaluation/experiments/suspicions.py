"""What results look like when lights were written otherwise than they are read: notes for people, no number changes.

Lights that are written blue first, as gains (the reciprocals of lights), or in another order of the images have errors
like those of a bad method, and nothing in the files tells. Read the other way round they would fit far better: that is
what is looked for, in the estimates of each method against the ground truths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.metrics import recovery_error
from evaluation.results.result import Result

_Lights = npt.NDArray[np.float64]

_LEAST_IMAGES: Final = 8  # Images below which a median says too little

# Median error below which lights are read rightly: all ways of reading lights near grey fit about as well.
_LEAST_DEG: Final = 5.0

# Share of the median error that another way of reading must leave at most; right data never come near it.
_BETTER: Final = 0.5

# Median error that another way of reading must leave at most: one that is bad too is not how lights were written.
_GOOD_DEG: Final = 8.0

_FLOOR: Final = 1e-9  # What replaces a channel at 0, over the largest, where a light is inverted


def suspicions(images: Sequence[str], truths: npt.NDArray[np.float64], results: Sequence[Result]) -> tuple[str, ...]:
    """Return a sentence for each other way of reading lights under which results would be far better.

    `truths`: (N, 3) float64, linear camera RGB of any length.

    Examples
    --------
    >>> truths = np.random.default_rng(0).random((9, 3)) + [2, 1, 0.2]
    >>> swapped = Result("Mine", truths[:, ::-1], {}, np.zeros(9, bool))
    >>> suspicions(list("abcdefghi"), truths, [swapped])[0][:86]
    'Mine: with red and blue exchanged its median recovery error would be 0.00 instead of 4'
    """
    if len(images) < _LEAST_IMAGES:
        return ()
    found: dict[str, list[tuple[str, float, float]]] = {}
    for result in results:
        known = ~result.guessed
        if int(known.sum()) < _LEAST_IMAGES:
            continue
        is_now = float(np.median(recovery_error(result.estimates[known], truths[known])))
        if is_now < _LEAST_DEG:
            continue
        for how, read in _ways(images).items():
            other = float(np.median(recovery_error(read(result.estimates)[known], truths[known])))
            if other <= min(_BETTER * is_now, _GOOD_DEG):
                found.setdefault(how, []).append((result.method, other, is_now))
    return tuple(_sentence(how, those, len(results)) for how, those in found.items())


def _ways(images: Sequence[str]) -> dict[str, Callable[[_Lights], _Lights]]:
    """Return other ways of reading lights (N, 3), each by what it is called."""
    by_text = np.array(sorted(range(len(images)), key=lambda place: images[place]))
    ways: dict[str, Callable[[_Lights], _Lights]] = {
        "with red and blue exchanged": lambda lights: lights[:, ::-1],
        "as gains, the reciprocals of lights,": lambda lights: (
            1 / np.maximum(lights, _FLOOR * lights.max(axis=1, keepdims=True))
        ),
        "given to the image before": lambda lights: np.roll(lights, -1, axis=0),
        "given to the image after": lambda lights: np.roll(lights, 1, axis=0),
    }
    if (by_text != np.arange(len(images))).any():
        back = np.argsort(by_text)
        ways["in the order of names as text (1, 10, 2)"] = lambda lights: lights[by_text]
        ways["in the order of names as numbers (1, 2, 10)"] = lambda lights: lights[back]
    return ways


def _sentence(how: str, those: Sequence[tuple[str, float, float]], methods: int) -> str:
    name, other, is_now = min(those, key=lambda one: one[1])
    told = f"{name}: {how} its median recovery error would be {other:.2f} instead of {is_now:.2f} degrees"
    if len(those) > 1:
        return f"{told}, and {len(those) - 1} more of {methods} methods gain likewise; check images and ground truths"
    return f"{told}; check how its lights, or the ground truths, are written"
