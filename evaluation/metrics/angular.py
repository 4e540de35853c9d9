"""Angular errors of estimated lights, as the paper defines them in section 4.1; all angles are degrees."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg

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
