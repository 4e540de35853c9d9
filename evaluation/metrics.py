"""How far estimates are off: angular errors, their summaries, and errors by pixel where several lights fall.

Angular errors are those of the paper's section 4.1; all angles are degrees. Percentiles are MATLAB's `prctile`, as in
the programs that the field's tables were made with: the i-th of n sorted errors stands at 100 (i − ½) / n percent,
between two of them a straight line joins, and beyond the first and last they are those (Hazen's definition; R. J.
Hyndman, Y. Fan, "Sample quantiles in statistical packages", The American Statistician 50(4), 1996, definition 5).
NumPy's own default is another: quartiles lie a quarter of the distance between two neighbouring errors further in.

Under several lights errors are by pixel against the map of lights, and by region against each light. The definitions
are those of D. Kim et al., "Large scale multi-illuminant (LSMI) dataset for developing white balance algorithm under
mixed illumination", ICCV 2021, as its authors' program computes them (github.com/DY112/LSMI-dataset, commit 0de53b8:
`get_MAE` of SVWB_Unet/metrics.py, `test` of SVWB_Unet/solver.py):

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
from dataclasses import astuple, dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg
from foundation.errors import InputError

ErrorKind = Literal["reproduction", "recovery"]

# What replaces 0 in an estimate, over its largest channel: the angle is that of the limit to a double's last digit.
_ZERO: Final = 1e-12


def recovery_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between estimated and true light, degrees (paper, equation 3).

    `estimate`, `truth`: (..., 3) float or int, linear camera RGB of any length > 0. Returns (...) float64, 0 … 180.

    Examples
    --------
    >>> round(float(recovery_error([1, 1, 0], [1, 0, 0])), 6)
    45.0
    >>> recovery_error([[0.2, 0.6, 0.2], [0.3, 0.4, 0.3]], [1, 1, 1]).round(3)
    array([29.496,  8.049])
    """
    return angles_deg(estimate, truth)


def reproduction_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between the white surface after correction and white, degrees (paper, equation 4).

    `estimate`, `truth`: (..., 3) float or int, linear camera RGB of any length > 0; a channel of the estimate at zero
    gives the limit. Returns (...) float64, 0 … 54.74: arccos(1/√3), white corrected to a single channel.

    Examples
    --------
    Unlike the recovery error it stays the same when the light, true and estimated, is filtered:

    >>> estimate, truth, glass = np.array([1, 1, 1]), np.array([2, 1, 1]), np.array([0.5, 1, 3])
    >>> round(float(reproduction_error(estimate, truth)), 3)
    19.471
    >>> round(float(reproduction_error(estimate * glass, truth * glass)), 3)
    19.471
    """
    given = np.asarray(estimate, dtype=np.float64)
    floor = _ZERO * given.max(axis=-1, keepdims=True)
    corrected = np.asarray(truth, dtype=np.float64) / np.maximum(given, floor)
    return angles_deg(corrected, np.ones_like(corrected))


_Array = npt.NDArray[np.float64]

# Share of a pixel's light above which the pixel belongs to a light's region: no two lights have the same pixel.
DOMINANT: Final = 0.5

# Pixels that are worked on at a time: some 100 MB of intermediate results whatever the image's size.
_ROWS_OF: Final = 1 << 19


@dataclass(frozen=True)
class RegionError:
    """The error of the region of one light, degrees.

    - `light`: the light's number, from 0.
    - `share`: pixels of the region over pixels that are judged, above 0.
    - `recovery`, `reproduction`: angular errors against that light, averaged over the region's pixels.
    """

    light: int
    share: float
    recovery: float
    reproduction: float


@dataclass(frozen=True)
class MapError:
    """The errors of an estimate on an image under several lights, degrees.

    - `recovery`, `reproduction`: angular errors by pixel, averaged over pixels; the first is LSMI's MAE_illum. NaN
      where no pixel is judged.
    - `rgb`: LSMI's MAE_rgb. NaN where no pixel is judged.
    - `regions`: of each light that gives more than half of some pixel's light, in the lights' order.
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

    `estimate`: (3,) float, the light of every pixel, or (H, W, 3) float, one light a pixel; linear camera RGB of any
    length above 0, no channel below 0. `truth`: (H, W, 3) float, the true light of each pixel, of any length; NaN where
    it is not known. `weights`: (H, W, K) float, the share of each light in each pixel, 0 … 1. `lights`: (K, 3) float,
    the lights, of any length above 0. `image`: (H, W, 3) of any dtype of numbers, linear camera RGB ≥ 0, black
    subtracted. `saturation`: value at which a corrected pixel is clipped; None if none is. `mask`: (H, W) bool, True
    where a pixel must not be judged.

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


# Errors below it are counted as small: the limit that many papers of the field take for an acceptable error.
SMALL_DEG: Final = 3.0


@dataclass(frozen=True)
class Summary:
    """The numbers that sum up the errors of a method on a data set, degrees: first the paper's six, in its order.

    - `mean`, `median`: of all errors.
    - `trimean`: (Q1 + 2 Q2 + Q3) / 4.
    - `best25`, `worst25`: means of the errors up to the 25th and from the 75th percentile.
    - `avg`: geometric mean of the five (J. T. Barron, "Convolutional color constancy", ICCV 2015).
    - `p95`: 95th percentile.
    - `maximum`: the largest error.
    - `below3`: share of the errors below 3 degrees, 0 … 1.
    """

    mean: float
    median: float
    trimean: float
    best25: float
    worst25: float
    avg: float
    p95: float
    maximum: float
    below3: float

    def as_tuple(self) -> tuple[float, ...]:
        """Return the six numbers of the paper's tables."""
        return astuple(self)[:6]


def summarise(errors: npt.ArrayLike) -> Summary:
    """Return the summary of errors (N,) float, N ≥ 1, degrees.

    Raises `InputError`: there is no error to summarise, or one is NaN or infinite.

    Examples
    --------
    >>> summary = summarise([1, 2, 3, 4, 10])
    >>> summary.as_tuple()
    (4.0, 3.0, 3.3125, 1.0, 10.0, 3.31...)
    >>> summary.p95, summary.maximum, summary.below3
    (10.0, 10.0, 0.4)
    """
    values = np.asarray(errors, dtype=np.float64).ravel()
    if not values.size or not np.isfinite(values).all():
        raise InputError(
            f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them not finite: nothing to sum up"
        )
    q1, q2, q3, p95 = (float(level) for level in percentiles(values, (25, 50, 75, 95)))
    parts = (
        float(values.mean()),
        q2,
        (q1 + 2 * q2 + q3) / 4,
        float(values[values <= q1].mean()),
        float(values[values >= q3].mean()),
    )
    return Summary(
        *parts,
        avg=float(np.prod(np.asarray(parts) ** 0.2)),
        p95=p95,
        maximum=float(values.max()),
        below3=float((values < SMALL_DEG).mean()),
    )


def percentiles(errors: npt.ArrayLike, levels: tuple[float, ...]) -> npt.NDArray[np.float64]:
    """Return percentiles (L,) float64 of errors (N,) float, N ≥ 1, at levels of 0 … 100, as MATLAB's `prctile`.

    Examples
    --------
    >>> percentiles([1, 2, 3, 4], (25, 50, 95))
    array([1.5, 2.5, 4. ])
    """
    # NumPy calls MATLAB's definition after Hazen.
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
