"""Angular errors of illuminant estimates, their statistics, and errors by pixel under several illuminants.

All angles are degrees. Angular errors follow section 4.1 of the CroP paper. Percentiles follow MATLAB's `prctile`,
which the published tables of the field use: the i-th of n sorted errors is the 100 (i − ½) / n percentile, with linear
interpolation (Hazen; R. J. Hyndman, Y. Fan, "Sample quantiles in statistical packages", The American Statistician
50(4), 1996, definition 5).

Under several illuminants, errors are measured by pixel against the map of illuminants, and by region. Definitions by
pixel: D. Kim et al., "Large scale multi-illuminant (LSMI) dataset for developing white balance algorithm under mixed
illumination", ICCV 2021, as computed by its authors' program (github.com/DY112/LSMI-dataset, commit 0de53b8:
`get_MAE` of SVWB_Unet/metrics.py, `test` of SVWB_Unet/solver.py):

MAE_illum
    Recovery error of each pixel, averaged over the unmasked pixels of an image, then over images.
MAE_rgb
    Angle between a pixel corrected by the estimate and the same pixel corrected by the ground truth, averaged in the
    same way.

The error by region is our own definition: the mean error of the pixels that receive more than half of their light from
one illuminant. It also shows errors for illuminants that reach only a few pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg
from foundation.errors import InputError

ErrorKind = Literal["reproduction", "recovery"]

# Replaces 0 in an estimate, relative to its largest channel; the angle then equals the limit in double precision.
_ZERO_REPLACEMENT: Final = 1e-12


def recovery_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between estimated and true illuminant (paper, equation 3).

    Parameters
    ----------
    estimate, truth
        (..., 3), linear camera RGB of any length > 0.

    Returns
    -------
    (...) float64, degrees, 0 … 180.

    Examples
    --------
    >>> round(float(recovery_error([1, 1, 0], [1, 0, 0])), 6)
    45.0
    >>> recovery_error([[0.2, 0.6, 0.2], [0.3, 0.4, 0.3]], [1, 1, 1]).round(3)
    array([29.496,  8.049])
    """
    return angles_deg(estimate, truth)


def reproduction_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between a white surface after correction and white (paper, equation 4).

    Parameters
    ----------
    estimate, truth
        (..., 3), linear camera RGB of any length > 0. For a channel of 0 in the estimate, the result is the limit.

    Returns
    -------
    (...) float64, degrees, 0 … 54.74. The limit arccos(1/√3) is reached if only one channel of the corrected white is
    not zero.

    Examples
    --------
    Unlike the recovery error, it does not change if the same filter is applied to estimate and ground truth:

    >>> estimate, truth, glass = np.array([1, 1, 1]), np.array([2, 1, 1]), np.array([0.5, 1, 3])
    >>> round(float(reproduction_error(estimate, truth)), 3)
    19.471
    >>> round(float(reproduction_error(estimate * glass, truth * glass)), 3)
    19.471
    """
    channels = np.asarray(estimate, dtype=np.float64)
    floor = _ZERO_REPLACEMENT * channels.max(axis=-1, keepdims=True)
    corrected = np.asarray(truth, dtype=np.float64) / np.maximum(channels, floor)
    return angles_deg(corrected, np.ones_like(corrected))


_Array = npt.NDArray[np.float64]

# A pixel belongs to the region of an illuminant that gives more than this fraction of its light. From 0.5 on, regions
# cannot overlap.
DOMINANT: Final = 0.5

# Pixels computed at once. Intermediate results then take about 100 MB for images of any size.
_PIXELS_AT_ONCE: Final = 1 << 19


@dataclass(frozen=True)
class RegionError:
    """Error of the region of one illuminant.

    - `light`: index of the illuminant, from 0.
    - `share`: number of pixels of the region relative to all evaluated pixels, > 0.
    - `recovery`, `reproduction`: mean angular error of the region's pixels against this illuminant, degrees.
    """

    light: int
    share: float
    recovery: float
    reproduction: float


@dataclass(frozen=True)
class MapError:
    """Errors of an estimate on an image under several illuminants, degrees; NaN if no pixel is evaluated.

    - `recovery`, `reproduction`: mean angular error by pixel; `recovery` is LSMI's MAE_illum.
    - `rgb`: LSMI's MAE_rgb.
    - `regions`: regions that are not empty, in the order of the illuminants.
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
    """Return the errors of an estimate on an image under several illuminants.

    Parameters
    ----------
    estimate
        (3,) float for the whole image or (H, W, 3) float by pixel; linear camera RGB ≥ 0 of any length > 0.
    truth
        (H, W, 3) float, illuminant of each pixel, of any length; pixels with NaN are not evaluated.
    weights
        (H, W, K) float, fraction of each illuminant in each pixel, 0 … 1.
    lights
        (K, 3) float, the illuminants, of any length > 0.
    image
        (H, W, 3) numbers, linear camera RGB ≥ 0, black level subtracted.
    saturation
        Value at which a corrected pixel is clipped; None for no clipping.
    mask
        (H, W) bool, True for pixels that are not evaluated.

    Examples
    --------
    The left half of a wall is under a red illuminant, the right half under white; the estimate is white everywhere:

    >>> lights = np.array([[1.0, 0.5, 0.5], [1, 1, 1]])
    >>> weights = np.zeros((4, 8, 2))
    >>> weights[:, :4, 0] = weights[:, 4:, 1] = 1
    >>> error = measure_map(np.ones(3), weights @ lights, weights, lights, image=weights @ lights)
    >>> round(error.recovery, 2), [round(region.recovery, 2) for region in error.regions]
    (9.74, [19.47, 0.0])
    """
    sums = np.zeros(3)
    evaluated_count = 0
    region_sums = np.zeros((len(lights), 3))
    for rows in _row_bands(image.shape):
        is_evaluated = np.isfinite(truth[rows]).all(axis=2)
        if mask is not None:
            is_evaluated &= ~mask[rows]
        count = int(is_evaluated.sum())
        evaluated_count += count
        estimated = estimate[rows][is_evaluated] if estimate.ndim == 3 else np.broadcast_to(estimate, (count, 3))
        estimated, actual = estimated.astype(np.float64), truth[rows][is_evaluated].astype(np.float64)
        sums[0] += recovery_error(estimated, actual).sum()
        sums[1] += reproduction_error(estimated, actual).sum()
        sums[2] += _rgb_errors(image[rows][is_evaluated].astype(np.float64), estimated, actual, saturation).sum()
        shares = weights[rows][is_evaluated]
        for index, light in enumerate(lights):
            region_estimates = estimated[shares[:, index] > DOMINANT]
            region_sums[index] += (
                len(region_estimates),
                recovery_error(region_estimates, light).sum(),
                reproduction_error(region_estimates, light).sum(),
            )
    if not evaluated_count:
        return MapError(np.nan, np.nan, np.nan, ())
    regions = tuple(
        RegionError(index, float(count / evaluated_count), float(recovery / count), float(reproduction / count))
        for index, (count, recovery, reproduction) in enumerate(region_sums)
        if count
    )
    return MapError(*(float(mean) for mean in sums / evaluated_count), regions=regions)


def _row_bands(shape: tuple[int, ...]) -> Iterator[slice]:
    step = max(1, _PIXELS_AT_ONCE // max(1, shape[1]))
    for top in range(0, shape[0], step):
        yield slice(top, top + step)


def _rgb_errors(pixels: _Array, estimated: _Array, actual: _Array, saturation: float | None) -> _Array:
    corrected = [
        np.minimum(pixels * _gains(light), np.inf if saturation is None else saturation)
        for light in (estimated, actual)
    ]
    # A black pixel stays black under every correction: its error is 0, as in LSMI's program. That program adds 1e-4
    # counts to avoid a division by 0; this is omitted here.
    lit = pixels.any(axis=1)
    errors = np.zeros(len(pixels))
    errors[lit] = recovery_error(corrected[0][lit], corrected[1][lit])
    return errors


def _gains(lights: _Array) -> _Array:
    # Gains leave green unchanged.
    floored = np.maximum(lights, _ZERO_REPLACEMENT * lights.max(axis=1, keepdims=True))
    return floored[:, 1:2] / floored


# Errors below this limit count as small; many papers of the field call them acceptable.
SMALL_DEG: Final = 3.0


@dataclass(frozen=True)
class Summary:
    """Statistics of the errors of a method on a data set, degrees; the first six are in the order of the paper.

    - `mean`, `median`: of all errors.
    - `trimean`: (Q1 + 2 Q2 + Q3) / 4.
    - `best25`, `worst25`: mean of the errors up to the 25th and from the 75th percentile.
    - `avg`: geometric mean of these five (J. T. Barron, "Convolutional color constancy", ICCV 2015).
    - `worst5`: mean of the errors from the 95th percentile (M. Afifi et al., "Cross-camera convolutional color
      constancy", ICCV 2021).
    - `p95`: 95th percentile.
    - `maximum`: largest error.
    - `below3`: fraction of the errors below 3 degrees, 0 … 1.
    """

    mean: float
    median: float
    trimean: float
    best25: float
    worst25: float
    avg: float
    worst5: float
    p95: float
    maximum: float
    below3: float

    def as_tuple(self) -> tuple[float, ...]:
        """Return the numbers of tables: the six of the paper, and `worst5`."""
        return astuple(self)[:7]


def summarise(errors: npt.ArrayLike) -> Summary:
    """Return the statistics of errors (N,) float, N ≥ 1, degrees.

    Raises `InputError` if there is no error, or if an error is NaN or infinite.

    Examples
    --------
    >>> summary = summarise([1, 2, 3, 4, 10])
    >>> summary.as_tuple()
    (4.0, 3.0, 3.3125, 1.0, 10.0, 3.31..., 10.0)
    >>> summary.p95, summary.maximum, summary.below3
    (10.0, 10.0, 0.4)
    """
    values = np.asarray(errors, dtype=np.float64).ravel()
    if not values.size or not np.isfinite(values).all():
        raise InputError(
            f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them NaN or infinite, expected at least one "
            "error, all finite; correct or remove the NaN and infinite errors"
        )
    q1, q2, q3, p95 = (float(level) for level in percentiles(values, (25, 50, 75, 95)))
    first_five = (
        float(values.mean()),
        q2,
        (q1 + 2 * q2 + q3) / 4,
        float(values[values <= q1].mean()),
        float(values[values >= q3].mean()),
    )
    return Summary(
        *first_five,
        avg=float(np.prod(np.asarray(first_five) ** 0.2)),
        worst5=float(values[values >= p95].mean()),
        p95=p95,
        maximum=float(values.max()),
        below3=float((values < SMALL_DEG).mean()),
    )


def percentiles(errors: npt.ArrayLike, levels: tuple[float, ...]) -> npt.NDArray[np.float64]:
    """Return the percentiles (L,) float64 of errors (N,), N ≥ 1, at levels 0 … 100, as MATLAB's `prctile`.

    Examples
    --------
    >>> percentiles([1, 2, 3, 4], (25, 50, 95))
    array([1.5, 2.5, 4. ])
    """
    # NumPy calls MATLAB's definition "hazen". The default of NumPy gives quartiles closer to the extremes.
    return np.percentile(np.asarray(errors, dtype=np.float64), levels, method="hazen")


__all__ = [
    "ErrorKind",
    "MapError",
    "RegionError",
    "Summary",
    "measure_map",
    "percentiles",
    "recovery_error",
    "reproduction_error",
    "summarise",
]
