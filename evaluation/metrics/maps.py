"""Errors where several lights fall on an image: by pixel against the map of lights, and by region against each light.

The definitions are those of D. Kim et al., "Large scale multi-illuminant (LSMI) dataset for developing white balance
algorithm under mixed illumination", ICCV 2021, as its authors' program computes them (github.com/DY112/LSMI-dataset,
commit 0de53b8: `get_MAE` of SVWB_Unet/metrics.py, `test` of SVWB_Unet/solver.py):

MAE_illum
    The angle between the estimated and the true light of a pixel, averaged over an image's pixels that are not masked,
    then over images. It is the recovery error by pixel, and the figure of the paper's tables (issue 10 there).
MAE_rgb
    The angle between the pixel's colour corrected by the estimate and corrected by the truth, averaged likewise.
    Correction divides red and blue by the light's over its green, and clips at the white level. A black pixel is black
    under every correction and counts as 0, as there. Small constants that keep that program from dividing by zero
    (10⁻⁴ counts) are left out.

The error by region is this suite's: a light's region are the pixels of which it gives more than half; its error is the
angle between their estimates and that light, averaged over them. Errors by pixel hide a light that falls on few pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.metrics.angular import recovery_error, reproduction_error

_Array = npt.NDArray[np.float64]

DOMINANT: Final = 0.5
"""Share of a pixel's light above which the pixel belongs to a light's region: no two lights have the same pixel."""

_ROWS_OF: Final = 1 << 19
"""Pixels that are worked on at a time: some 100 MB of intermediate results whatever the image's size."""

_ZERO: Final = 1e-12
"""What replaces 0 in a light that is divided by, over its largest channel; see `angular.reproduction_error`."""


@dataclass(frozen=True)
class RegionError:
    """The error of the region of one light, degrees.

    Attributes
    ----------
    light
        The light's number, from 0.
    share
        Pixels of the region over pixels that are judged, above 0.
    recovery, reproduction
        Angular errors against that light, averaged over the region's pixels.
    """

    light: int
    share: float
    recovery: float
    reproduction: float


@dataclass(frozen=True)
class MapError:
    """The errors of an estimate on an image under several lights, degrees.

    Attributes
    ----------
    recovery, reproduction
        Angular errors by pixel, averaged over pixels; the first is LSMI's MAE_illum. NaN where no pixel is judged.
    rgb
        LSMI's MAE_rgb. NaN where no pixel is judged.
    regions
        Of each light that gives more than half of some pixel's light, in the lights' order.
    """

    recovery: float
    reproduction: float
    rgb: float
    regions: tuple[RegionError, ...]


def measure_map(
    estimate: npt.NDArray[np.floating[Any]],
    truth: npt.NDArray[np.floating[Any]],
    weights: npt.NDArray[np.floating[Any]],
    lights: npt.NDArray[np.floating[Any]],
    image: npt.NDArray[Any],
    saturation: float | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
) -> MapError:
    """Return the errors of an estimate on an image under several lights.

    Left out are pixels that are masked, and those of which the true light is not known (NaN).

    Parameters
    ----------
    estimate
        (3,) float, the light of every pixel, or (H, W, 3) float, one light a pixel; linear camera RGB of any length
        above 0, no channel below 0.
    truth
        (H, W, 3) float, the true light of each pixel, of any length; NaN where it is not known.
    weights
        (H, W, K) float, the share of each light in each pixel, 0 … 1.
    lights
        (K, 3) float, the lights, of any length above 0.
    image
        (H, W, 3) of any dtype of numbers, linear camera RGB ≥ 0, black subtracted.
    saturation
        Value at which a corrected pixel is clipped; None if none is.
    mask
        (H, W) bool, True where a pixel must not be judged.

    Examples
    --------
    The left half of a wall under a red light, the right half under white; the estimate is white everywhere:

    >>> lights = np.array([[1.0, 0.5, 0.5], [1, 1, 1]])
    >>> weights = np.zeros((4, 8, 2))
    >>> weights[:, :4, 0] = weights[:, 4:, 1] = 1
    >>> error = measure_map(np.ones(3), weights @ lights, weights, lights, image=weights @ lights)
    >>> round(error.recovery, 2), [round(region.recovery, 2) for region in error.regions]
    (9.74, [19.47, 0.0])
    """
    sums = np.zeros(3)
    judged = 0
    by_region = np.zeros((len(lights), 3))
    for rows in _bands(image.shape):
        known = np.isfinite(truth[rows]).all(axis=2)
        if mask is not None:
            known &= ~mask[rows]
        given = estimate[rows][known] if estimate.ndim == 3 else np.broadcast_to(estimate, (int(known.sum()), 3))
        given, actual = given.astype(np.float64), truth[rows][known].astype(np.float64)
        judged += len(actual)
        sums[0] += recovery_error(given, actual).sum()
        sums[1] += reproduction_error(given, actual).sum()
        sums[2] += _rgb_errors(image[rows][known].astype(np.float64), given, actual, saturation).sum()
        shares = weights[rows][known]
        for number, light in enumerate(lights):
            inside = given[shares[:, number] > DOMINANT]
            by_region[number] += (
                len(inside),
                recovery_error(inside, light).sum(),
                reproduction_error(inside, light).sum(),
            )
    if not judged:
        return MapError(np.nan, np.nan, np.nan, ())
    regions = tuple(
        RegionError(number, float(count / judged), float(recovery / count), float(reproduction / count))
        for number, (count, recovery, reproduction) in enumerate(by_region)
        if count
    )
    return MapError(*(float(part) for part in sums / judged), regions=regions)


def _bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield bands of rows of an image of that shape, which bound the memory for images of any size."""
    step = max(1, _ROWS_OF // max(1, shape[1]))
    for top in range(0, shape[0], step):
        yield slice(top, top + step)


def _rgb_errors(pixels: _Array, given: _Array, actual: _Array, saturation: float | None) -> _Array:
    """Return the angles (N,) between pixels (N, 3) corrected by estimated and by true lights (N, 3), degrees."""
    corrected = [
        np.minimum(pixels * _gains(light), np.inf if saturation is None else saturation) for light in (given, actual)
    ]
    lit = pixels.any(axis=1)
    errors = np.zeros(len(pixels))
    errors[lit] = recovery_error(corrected[0][lit], corrected[1][lit])
    return errors


def _gains(lights: _Array) -> _Array:
    """Return the gains (N, 3) that correct for lights (N, 3) and leave green as it is."""
    floored = np.maximum(lights, _ZERO * lights.max(axis=1, keepdims=True))
    return floored[:, 1:2] / floored
