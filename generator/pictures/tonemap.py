"""The Flash tone mapping operator and its inverse: from linear images to codes for a display, and back.

N. Banić, S. Lončarić, "Flash and Storm: fast and highly practical tone mapping based on Naka-Rushton equation",
VISAPP 2018; used for the previews as the paper uses it in its figure of the generation process, and in its section 4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

DARK: Final = 1e-9
"""Replaces brightness 0, which has no logarithm; linear values are 0 … 1, so it is far below any signal."""

_BLACK: Final = np.float32(1e-30)
"""Replaces 0 before a logarithm of float32, and is code 0 afterwards."""


@dataclass(frozen=True)
class Flash:
    """The operator with the parameters of one image, so that it can be undone.

    - `k`: semi-saturation: a · exp(mean ln V) of the image it was fitted to.
    - `scale`: code that the brightest value became, divided by that value: undone before anything else.
    - `gamma`: display exponent g of y ** (1 / g); 1 for none.

    Examples
    --------
    >>> linear = np.array([[0.01, 0.02, 0.05], [0.4, 0.5, 0.2]])
    >>> operator = fit_flash(linear)
    >>> operator.invert(operator.apply(linear)).round(6)
    array([[0.01, 0.02, 0.05],
           [0.4 , 0.5 , 0.2 ]])
    """

    k: float
    scale: float
    gamma: float

    def apply(self, linear: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Return codes (..., 3) float64 of linear RGB (..., 3) ≥ 0; the fitted image's brightest value becomes 255."""
        linear = np.asarray(linear, dtype=np.float64)
        brightness = np.maximum(linear.max(axis=-1, keepdims=True), DARK)
        return self.scale * (linear / (brightness + self.k)) ** (1 / self.gamma)

    def invert(self, codes: npt.NDArray[np.floating] | npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """Return linear RGB (..., 3) float64 of codes (..., 3) of any type, 0 … 255, rounded or not.

        With y = x / (V + k) the largest channel W = V / (V + k), hence x = y k / (1 − W).
        """
        mapped = (np.asarray(codes, dtype=np.float64) / self.scale) ** self.gamma
        largest = mapped.max(axis=-1, keepdims=True)
        # A rounded-up brightest code may reach W = 1, which no finite brightness has.
        return mapped * self.k / np.maximum(1 - largest, DARK)


def fit_flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator fitted to an image.

    `linear`: (..., 3) float ≥ 0, linear RGB, 1 = saturation.

    Examples
    --------
    >>> fit_flash(np.full((4, 4, 3), 0.5), a=5, gamma=1)
    Flash(k=2.5, scale=1530.0, gamma=1)
    """
    if not linear.size or a <= 0 or gamma <= 0:
        raise InputError(
            f"tone mapping got an image {linear.shape}, a={a} and gamma={gamma}, expected pixels and numbers above 0"
        )
    brightness = _brightness(np.asarray(linear))
    return flash_from_brightness(float(np.log(brightness).mean(dtype=np.float64)), float(brightness.max()), a, gamma)


def flash_from_brightness(mean_log: float, peak: float, a: float = 5.0, gamma: float = 2.2) -> Flash:
    """Return the operator for an image with that mean of the logarithms of brightness, and that largest brightness."""
    k = a * math.exp(mean_log)
    return Flash(k, 255.0 / (peak / (peak + k)) ** (1 / gamma), gamma)


def flash(linear: npt.NDArray[np.floating], a: float = 5.0, gamma: float = 2.2) -> npt.NDArray[np.uint8]:
    """Return the picture (..., 3) uint8 of a linear image (..., 3) float, 1 = saturation; see `fit_flash`.

    Computed in single precision: a code may differ by one from the rounded result of `Flash.apply`.

    Parameters
    ----------
    linear
        (..., 3) float ≥ 0, linear RGB, 1 = saturation.
    a, gamma
        Strength and display exponent, as for `fit_flash`.

    Examples
    --------
    >>> flash(np.array([[[0.0, 0.01, 0.02], [0.4, 0.5, 0.2]]]))
    array([[[  0,  58,  79],
            [230, 255, 168]]], dtype=uint8)
    """
    linear = np.asarray(linear, dtype=np.float32)
    operator = fit_flash(linear, a, gamma)
    mapped = linear / (_brightness(linear) + np.float32(operator.k))[..., None]
    if gamma != 1:
        # Through logarithms, which numpy computes several at once; a power takes ten times as long.
        np.maximum(mapped, _BLACK, out=mapped)
        np.log(mapped, out=mapped)
        mapped *= np.float32(1 / gamma)
        np.exp(mapped, out=mapped)
    mapped *= np.float32(operator.scale)
    np.rint(mapped, out=mapped)
    return np.clip(mapped, 0, 255, out=mapped).astype(np.uint8)


def _brightness(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return brightness (...), the largest channel of `linear` (..., 3), at least `DARK`."""
    largest = np.maximum(np.maximum(linear[..., 0], linear[..., 1]), linear[..., 2])
    return np.maximum(largest, linear.dtype.type(DARK))
