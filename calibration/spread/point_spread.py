"""The lens's point spread beside its sharp core, as a value: shares of Gaussians of rising size, and the veil.

A share is that of a point's light which the lens spreads over a Gaussian of that σ, rather than where it belongs.
Gaussians add up to any spread that falls with the distance: exponentials, Moffat's function and power laws are all
mixtures of them. Light that the lens spreads evenly over the frame is the veil (veiling glare, ISO 9358).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

NEAR_PX = (1.5, 3.0, 6.0)
"""σ of the near kernels, half-size px: from where a window of 25 pixels begins to see its neighbours to a slot's width;
in steps of two, within which a smooth spread differs from their sum by less than what is measured."""

FAR_PX = (12.0, 24.0, 96.0)
"""σ of the far kernels: one slot, two, and a tenth of the chart's height. Wider ones are not told from the veil."""

TERMS = 3 * len(NEAR_PX) + len(FAR_PX) + 1
"""Unknowns: near kernels for each channel, far ones and the veil for all channels together."""

_Array = npt.NDArray[np.float64]


def kernel_names() -> list[str]:
    """Return the name of each kernel: σ in half-size px, and "veil".

    >>> kernel_names()
    ['1.5', '3', '6', '12', '24', '96', 'veil']
    """
    return [*(f"{scale:g}" for scale in NEAR_PX + FAR_PX), "veil"]


def terms_of(channel: int) -> npt.NDArray[np.int64]:
    """Return which unknowns (K,) int64 are the K kernels' shares in a channel, the veil last."""
    near = len(NEAR_PX)
    return np.concatenate([np.arange(near) + channel * near, np.arange(3 * near, TERMS)])


@dataclass(frozen=True, eq=False)
class PointSpread:
    """What a lens spreads beside its sharp core, as measured on the print.

    Attributes
    ----------
    shares
        (TERMS,) float64, 0 … 1, unknowns as `terms_of` has them; 0 where a kernel is not proven.
    covariance
        (TERMS, TERMS) float64, of all unknowns measured together, proven or not.
    gain
        By how much the kernels lower the sum of squares of what cells of known colour differ by, in units of its
        variance: what chance gives is one for each unknown.
    held_out
        The same for parts of the print that the shares were not fitted on, each from the others.
    """

    shares: _Array
    covariance: _Array
    gain: float
    held_out: float

    @property
    def proven(self) -> bool:
        """Whether there is anything to correct, and it holds on parts of the print that it was not fitted on."""
        return bool(self.shares.any()) and self.held_out > 0

    def amounts(self) -> _Array:
        """Return the share (3, K) float64 of each kernel in each channel, the veil last."""
        return np.array([self.shares[terms_of(channel)] for channel in range(3)])

    def errors(self) -> _Array:
        """Return the standard error (3, K) float64 of each share."""
        error = np.sqrt(np.diag(self.covariance))
        return np.array([error[terms_of(channel)] for channel in range(3)])

    def to_json(self) -> dict[str, Any]:
        """Return the spread as `lut.json` and `report.json` state it."""
        return {
            "sigma_px": [*NEAR_PX, *FAR_PX, None],
            "share": self.amounts().round(7).tolist(),
            "standard_error": self.errors().round(7).tolist(),
            "gain": float(f"{self.gain:.4g}"),
            "gain_held_out": float(f"{self.held_out:.4g}"),
        }
