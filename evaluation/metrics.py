"""Angular errors and their summaries, as the paper defines them in section 4.1.

All angles are degrees. Percentiles are MATLAB's `prctile`, as in the program that the field's tables were made with:
the sorted errors stand at 100 (i − ½) / n percent.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from foundation.angles import angles_deg
from foundation.errors import InputError

ErrorKind = Literal["reproduction", "recovery"]


def recovery_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between estimated and true light, degrees (paper, equation 3).

    Parameters
    ----------
    estimate, truth
        (..., 3), linear camera RGB of any length > 0.

    Returns
    -------
    ndarray
        (...) float64, 0 … 180.
    """
    return angles_deg(estimate, truth)


def reproduction_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angle between the white surface after correction and white, degrees (paper, equation 4).

    Parameters
    ----------
    estimate, truth
        (..., 3), linear camera RGB of any length > 0; a channel of the estimate at zero gives the limit.

    Returns
    -------
    ndarray
        (...) float64, 0 … 54.74.
    """
    given = np.asarray(estimate, dtype=np.float64)
    # Zero would divide; next to nothing beside the largest channel has the limit's angle to the last digit.
    floor = 1e-12 * given.max(axis=-1, keepdims=True)
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
        Geometric mean of the five (Barron 2015).
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
    """Return the summary of errors (N,), N ≥ 1, degrees.

    Raises
    ------
    InputError
        There is no error to summarise, or one is not a number.
    """
    values = np.asarray(errors, dtype=np.float64).ravel()
    if not values.size or not np.isfinite(values).all():
        raise InputError(
            f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them no number: nothing to sum up"
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
