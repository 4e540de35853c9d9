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

PLACES = 9
"""Terms of a near kernel's share over the frame: aberrations grow with the field angle, and a lens may be decentred, so
it is a polynomial, quadratic along either axis (`place_terms`). What is wider comes from scatter, and is the same
everywhere."""

_NEAR_TERMS = PLACES * len(NEAR_PX)

TERMS = 3 * _NEAR_TERMS + len(FAR_PX) + 1
"""Unknowns: near kernels for each channel and term over the frame, far ones and the veil for all channels together."""

LEAST_GAIN = 16.0
"""By how much a kernel must lower the sum of squares, in units of its variance: a share of four standard errors. All
together must do as much on parts of the print that they were not fitted on."""

_Array = npt.NDArray[np.float64]


def kernel_names() -> list[str]:
    """Return the name of each kernel: σ in half-size px, and "veil".

    >>> kernel_names()
    ['1.5', '3', '6', '12', '24', '96', 'veil']
    """
    return [*(f"{scale:g}" for scale in NEAR_PX + FAR_PX), "veil"]


def place_terms(places_px: npt.NDArray[np.floating], frame_px: tuple[int, int]) -> _Array:
    """Return the terms (N, 9) float64 of a near kernel's share at pixels: products of Legendre polynomials, 1 first.

    `places_px`: (N, 2) float half-size px, x then y.
    """
    unit = 2 * np.clip(places_px / (np.array(frame_px[::-1]) - 1.0), 0, 1) - 1
    x, y = (np.stack([np.ones_like(t), t, 1.5 * t**2 - 0.5], axis=-1) for t in unit.T)
    return (y[:, :, None] * x[:, None, :]).reshape(-1, PLACES)


def terms_of(channel: int) -> npt.NDArray[np.int64]:
    """Return which unknowns (T,) int64 hold in a channel: kernel by kernel, term by term, the veil last."""
    return np.concatenate([np.arange(_NEAR_TERMS) + channel * _NEAR_TERMS, np.arange(3 * _NEAR_TERMS, TERMS)])


def kernel_of_terms() -> list[tuple[int, int | None]]:
    """Return the kernel and the term over the frame of each unknown of a channel; None: the same all over."""
    near: list[tuple[int, int | None]] = [(kernel, place) for kernel in range(len(NEAR_PX)) for place in range(PLACES)]
    return near + [(kernel, None) for kernel in range(len(NEAR_PX), len(NEAR_PX) + len(FAR_PX) + 1)]


def groups_of_terms() -> list[npt.NDArray[np.int64]]:
    """Return the unknowns (n,) int64 that are kept or left out together.

    A kernel's mean shares, and how they change over the frame.
    """
    terms = np.array([(kernel, 0 if place is None else min(place, 1)) for kernel, place in kernel_of_terms()])
    found: list[npt.NDArray[np.int64]] = []
    for kernel, changing in sorted({(int(kernel), int(changing)) for kernel, changing in terms}):
        own = np.flatnonzero((terms[:, 0] == kernel) & (terms[:, 1] == changing))
        found.append(np.unique(np.concatenate([terms_of(channel)[own] for channel in range(3)])))
    return found


def free_terms() -> npt.NDArray[np.bool_]:
    """Return which unknowns, (n,) bool of all, may be of either sign: near kernels', which the print shows clearly."""
    return np.arange(TERMS) < 3 * _NEAR_TERMS


@dataclass(frozen=True, eq=False)
class PointSpread:
    """What a lens spreads beside its sharp core, as measured on the print.

    - `shares`: (TERMS,) float64, unknowns as `terms_of` has them, by which frames are corrected: 0 where a kernel is
      not proven, all of them where none is. Every lens has a veil: beside a proven kernel it has its likeliest share.
    - `covariance`: (TERMS, TERMS) float64, of all unknowns measured together, proven or not.
    - `gain`: by how much the kernels lower the sum of squares of what cells of known colour differ by, in units of its
      variance: what chance gives is one for each unknown; the proven ones'.
    - `held_out`: the same for parts of the print that the shares were not fitted on, each from the others.
    - `misfit`: what is left of light that lies smoothly over the print and is none of the kernels', over what chance
      leaves, ≥ 1: the covariance has been multiplied by it.
    - `likeliest`: (TERMS,) float64, as `shares`, whether they are proven or not: what is known beside the covariance.
    """

    shares: _Array
    covariance: _Array
    gain: float
    held_out: float
    misfit: float
    likeliest: _Array

    @property
    def unexplained(self) -> _Array:
        """(T, T) float64, mean square of what the T shares may be off by: their variance, and what is left out.

        Of what is likely but not subtracted the standard errors alone would say too little.
        """
        left_out = self.likeliest - self.shares
        return self.covariance + np.outer(left_out, left_out)

    @property
    def proven(self) -> bool:
        """Whether there is anything to correct, and it holds on parts of the print that it was not fitted on."""
        return bool(self.shares.any()) and self.held_out > LEAST_GAIN * self.misfit

    def amounts(self) -> _Array:
        """Return the share (9, 3, K) float64 of each kernel: terms over the frame, by channel, the veil last."""
        return self._by_kernel(self.shares)

    def errors(self) -> _Array:
        """Return the standard error (9, 3, K) float64 of each of them."""
        return self._by_kernel(np.sqrt(np.diag(self.covariance)))

    def _by_kernel(self, values: _Array) -> _Array:
        found = np.zeros((PLACES, 3, len(NEAR_PX) + len(FAR_PX) + 1))
        for channel in range(3):
            for (kernel, place), value in zip(kernel_of_terms(), values[terms_of(channel)], strict=True):
                found[place or 0, channel, kernel] = value
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the spread as `lut.json` and `report.json` state it."""
        return {
            "sigma_px": [*NEAR_PX, *FAR_PX, None],
            "share": self.amounts().round(7).tolist(),
            "standard_error": self.errors().round(7).tolist(),
            "gain": float(f"{self.gain:.4g}"),
            "gain_held_out": float(f"{self.held_out:.4g}"),
            "misfit": float(f"{self.misfit:.4g}"),
        }
