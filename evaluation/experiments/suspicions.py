"""Detect estimates or ground truths that were probably written in another convention.

Red and blue may be exchanged, values may be gains (reciprocals), or the images may be in another order. The errors are
then as large as with a poor method. Each of these possibilities is another reading of the estimates. If it fits the
ground truths far better, a note is printed; results are not changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.metrics import recovery_error
from evaluation.results.result import Result

_Lights = npt.NDArray[np.float64]

_MIN_IMAGES: Final = 8  # A median of fewer images is not reliable

# Below this median error, degrees, no other reading is tried. Illuminants near grey have small errors in every reading.
_MIN_MEDIAN_DEG: Final = 5.0

# Largest median error of another reading, as a fraction of the median error of the estimates as given. If these are
# correct, the fraction is far larger.
_MAX_RATIO: Final = 0.5

# Largest median error of another reading, degrees. A reading with larger errors is not evident.
_MAX_OTHER_DEG: Final = 8.0

_MIN_CHANNEL: Final = 1e-9  # Replaces smaller channels before inversion; fraction of the largest channel


def detect_other_conventions(images: Sequence[str], truths: _Lights, results: Sequence[Result]) -> tuple[str, ...]:
    """Return a note for each other reading of the estimates that fits the ground truths far better.

    `truths`: (N, 3) float64, linear camera RGB of any scale.

    Examples
    --------
    >>> truths = np.random.default_rng(0).random((9, 3)) + [2, 1, 0.2]
    >>> swapped = Result("Mine", truths[:, ::-1], {}, np.zeros(9, bool))
    >>> detect_other_conventions(list("abcdefghi"), truths, [swapped])[0][:86]
    'Mine: with red and blue exchanged its median recovery error would be 0.00 instead of 4'
    """
    if len(images) < _MIN_IMAGES:
        return ()
    better_readings: dict[str, list[tuple[str, float, float]]] = {}
    for result in results:
        has_estimate = ~result.guessed
        if int(has_estimate.sum()) < _MIN_IMAGES:
            continue
        median_deg = float(np.median(recovery_error(result.estimates[has_estimate], truths[has_estimate])))
        if median_deg < _MIN_MEDIAN_DEG:
            continue
        for reading, convert in _other_readings(images).items():
            other_deg = float(np.median(recovery_error(convert(result.estimates)[has_estimate], truths[has_estimate])))
            if other_deg <= min(_MAX_RATIO * median_deg, _MAX_OTHER_DEG):
                better_readings.setdefault(reading, []).append((result.method, other_deg, median_deg))
    return tuple(_note(reading, cases, len(results)) for reading, cases in better_readings.items())


def _other_readings(images: Sequence[str]) -> dict[str, Callable[[_Lights], _Lights]]:
    text_order = np.array(sorted(range(len(images)), key=lambda index: images[index]))
    readings: dict[str, Callable[[_Lights], _Lights]] = {
        "with red and blue exchanged": lambda lights: lights[:, ::-1],
        "as gains, the reciprocals of illuminants,": lambda lights: (
            1 / np.maximum(lights, _MIN_CHANNEL * lights.max(axis=1, keepdims=True))
        ),
        "assigned to the image before": lambda lights: np.roll(lights, -1, axis=0),
        "assigned to the image after": lambda lights: np.roll(lights, 1, axis=0),
    }
    if (text_order != np.arange(len(images))).any():
        number_order = np.argsort(text_order)
        readings["in the order of names as text (1, 10, 2)"] = lambda lights: lights[text_order]
        readings["in the order of names as numbers (1, 2, 10)"] = lambda lights: lights[number_order]
    return readings


def _note(reading: str, cases: Sequence[tuple[str, float, float]], method_count: int) -> str:
    method, other_deg, median_deg = min(cases, key=lambda case: case[1])
    numbers = f"{other_deg:.2f} instead of {median_deg:.2f} degrees"
    start = f"{method}: {reading} its median recovery error would be {numbers}"
    if len(cases) > 1:
        return f"{start}; {len(cases) - 1} more of {method_count} methods improve too; check images and ground truths"
    return f"{start}; check how its estimates, or the ground truths, are written"
