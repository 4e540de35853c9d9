"""Angular errors of estimated lights and their summaries, as the paper defines them in section 4.1.

All angles are degrees. Percentiles are MATLAB's `prctile`, as in the program that the field's tables were made with:
the i-th of n sorted errors stands at 100 (i − ½) / n percent.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.angles import angles_deg
from foundation.errors import InputError

ErrorKind = Literal["reproduction", "recovery"]

_ZERO: Final = 1e-12
"""What replaces 0 in an estimate, over its largest channel: the angle is that of the limit to a double's last digit."""


def recovery_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between estimated and true light, degrees (paper, equation 3).

    Parameters
    ----------
    estimate, truth
        (..., 3) float or int, linear camera RGB of any length > 0.

    Returns
    -------
    ndarray
        (...) float64, 0 … 180.

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

    Parameters
    ----------
    estimate, truth
        (..., 3) float or int, linear camera RGB of any length > 0; a channel of the estimate at zero gives the limit.

    Returns
    -------
    ndarray
        (...) float64, 0 … 54.74: arccos(1/√3), white corrected to a single channel.

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


@dataclass(frozen=True)
class Summary:
    """Six numbers for the errors of a method on a dataset, in degrees, in the order of the paper's tables.

    Attributes
    ----------
    mean, median
        Of all errors.
    trimean
        (Q1 + 2 Q2 + Q3) / 4.
    best25, worst25
        Means of the errors up to the 25th and from the 75th percentile.
    avg
        Geometric mean of the five (J. T. Barron, "Convolutional color constancy", ICCV 2015).
    """

    mean: float
    median: float
    trimean: float
    best25: float
    worst25: float
    avg: float

    def as_tuple(self) -> tuple[float, ...]:
        """Return the six numbers."""
        return astuple(self)


def summarise(errors: npt.ArrayLike) -> Summary:
    """Return the summary of errors (N,) float, N ≥ 1, degrees.

    Raises
    ------
    InputError
        There is no error to summarise, or one is NaN or infinite.

    Examples
    --------
    >>> summarise([1, 2, 3, 4, 10])
    Summary(mean=4.0, median=3.0, trimean=3.3125, best25=1.0, worst25=10.0, avg=3.31...)
    """
    values = np.asarray(errors, dtype=np.float64).ravel()
    if not values.size or not np.isfinite(values).all():
        raise InputError(
            f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them not finite: nothing to sum up"
        )
    # NumPy calls MATLAB's definition after Hazen.
    q1, q2, q3 = np.percentile(values, [25, 50, 75], method="hazen")
    parts = (
        float(values.mean()),
        float(q2),
        float(q1 + 2 * q2 + q3) / 4,
        float(values[values <= q1].mean()),
        float(values[values >= q3].mean()),
    )
    return Summary(*parts, avg=float(np.prod(np.asarray(parts) ** 0.2)))
