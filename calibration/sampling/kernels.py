"""The inner loops of sampling a frame, compiled: photosites become samples, samples the table's values.

Compiled for the processor at hand at the first call and kept on disk for the next. No state, no lock, and the
interpreter's is released, so that each frame has a thread to itself. Without licence to reorder sums: a table's bytes
depend on neither processor nor thread. What the numbers mean stands where the kernels are called, in
`calibration.sampling.samples`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy import uint64

from foundation.compiled import compiled, inlined

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Place = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


@inlined
def _rounded(value: Any, field: Any) -> Any:
    """Return a sample as the table holds it."""
    return np.uint16(min(max(np.rint(value / field), np.float32(0)), np.float32(65535)))


@compiled
def sample(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    samples: _Float,
    peak: _Count,
) -> None:
    """Fill samples (N, window², 3) float32 and their highest counts `peak` (N,); patches that are not inside get 0.

    `sensor`: (photosites,) uint16. `corner`: (N,) the top-left photosite of each patch's first pixel. `order`: (N,) the
    patches as they are best visited: neighbours on the sensor one after another, for the memory's sake. `inside`: (N,)
    whether a patch lies on the sensor. `places`: (4,) photosites from a block's top-left one to its red, its two greens
    and its blue. `black`: (3,) float32 counts, of red, green and blue.
    """
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest = np.int32(0)
        patch_samples = samples[patch]
        if not inside[patch]:
            patch_samples[:] = 0
            peak[patch] = 0
            continue
        number = uint64(0)
        for row in range(window):
            # Unsigned places spare the test for one before the array's beginning.
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                patch_samples[number, 0] = np.float32(r) - black[0]
                patch_samples[number, 1] = np.float32(g + h) * np.float32(0.5) - black[1]
                patch_samples[number, 2] = np.float32(b) - black[2]
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def tabulate(samples: _Float, dark: _Float, field: _Float, values: _Count) -> None:
    """Fill values (N, S, 3) uint16 from samples (N, S, 3) float32, less `dark` (N, 3), over `field` (N, 3)."""
    for patch in range(samples.shape[0]):
        for number in range(samples.shape[1]):
            for channel in range(3):
                above = samples[patch, number, channel] - dark[patch, channel]
                values[patch, number, channel] = _rounded(above, field[patch, channel])


@compiled
def sample_to_table(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    dark: _Float,
    field: _Float,
    values: _Count,
    peak: _Count,
) -> None:
    """Do `sample` and `tabulate` in one pass, without the samples (N, window², 3) between them.

    `values` (N, window², 3) uint16 and `peak` (N,) uint16 are filled; `dark` and `field` are (N, 3) float32, the rest
    as for `sample`.
    """
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest = np.int32(0)
        patch_values = values[patch]
        if not inside[patch]:
            patch_values[:] = 0
            peak[patch] = 0
            continue
        number = uint64(0)
        for row in range(window):
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                above = np.float32(r) - black[0] - dark[patch, 0]
                patch_values[number, 0] = _rounded(above, field[patch, 0])
                above = np.float32(g + h) * np.float32(0.5) - black[1] - dark[patch, 1]
                patch_values[number, 1] = _rounded(above, field[patch, 1])
                above = np.float32(b) - black[2] - dark[patch, 2]
                patch_values[number, 2] = _rounded(above, field[patch, 2])
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def count_means(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    means: _Array,
) -> None:
    """Fill means (N, 3) float64, counts above black; patches that are not inside get 0. Parameters as for `sample`."""
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    samples = window * window
    for patch in order:
        if not inside[patch]:
            means[patch] = 0
            continue
        r, g, b = np.int64(0), np.int64(0), np.int64(0)
        for row in range(window):
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r += sensor[at + red]
                g += np.int64(sensor[at + green]) + np.int64(sensor[at + other])
                b += sensor[at + blue]
                at += uint64(2)
        means[patch, 0] = r / samples - black[0]
        means[patch, 1] = g / (2 * samples) - black[1]
        means[patch, 2] = b / samples - black[2]


@compiled
def patch_means(values: _Count, means: _Array) -> None:
    """Fill means (N, 3) float64 of values (N, S, 3) uint16."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        red, green, blue = np.int64(0), np.int64(0), np.int64(0)
        for number in range(samples):
            red += values[patch, number, 0]
            green += values[patch, number, 1]
            blue += values[patch, number, 2]
        means[patch, 0], means[patch, 1], means[patch, 2] = red / samples, green / samples, blue / samples
