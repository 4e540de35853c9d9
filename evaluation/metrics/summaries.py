"""Summaries of angular errors, degrees.

Percentiles are MATLAB's `prctile`, as in the programs that the field's tables were made with: the i-th of n sorted
errors stands at 100 (i − ½) / n percent, between two of them a straight line joins, and beyond the first and last they
are those (Hazen's definition; R. J. Hyndman, Y. Fan, "Sample quantiles in statistical packages", The American
Statistician 50(4), 1996, definition 5). NumPy's own default is another: quartiles lie a quarter of the distance between
two neighbouring errors further in.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

SMALL_DEG: Final = 3.0
"""Errors below it are counted as small: the limit that many papers of the field take for an acceptable error."""


@dataclass(frozen=True)
class Summary:
    """The numbers that sum up the errors of a method on a data set, degrees: first the paper's six, in its order.

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
    p95
        95th percentile.
    maximum
        The largest error.
    below3
        Share of the errors below 3 degrees, 0 … 1.
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

    Raises
    ------
    InputError
        There is no error to summarise, or one is NaN or infinite.

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
