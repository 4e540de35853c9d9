"""The preview beside an image: the image in camera colours, made small and tone mapped by Flash.

An image of 16 bits has few values, so every logarithm and power is taken once for each value and not once for each
pixel. Nothing here starts threads of its own: the images of a dataset are made by as
many threads as there are processors.

Flash is N. Banić, S. Lončarić, "Flash and Storm: fast and highly practical tone mapping based on Naka-Rushton
equation", VISAPP 2018; used for the previews as the paper uses it in its figure of the generation process, and in its
section 4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import float32, uint8, uint16, uint32, uint64

from foundation.compiled import compiled
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


PREVIEW_SIDE: Final = 400
"""Longest side of a preview, px: enough to judge content and colours by eye, in some tens of kB, and less than that of
the images of most datasets, of which a preview of the same size would be a copy."""

_GAMMA: Final = 2.2
"""Exponent of a usual display, as in the paper's figure of the generation process."""
_HALF: Final = np.float32(0.5)
"""Added before a number is cut to a whole one, which rounds it."""


@compiled
def _shrink(image: Any, factor: int, out: Any) -> None:
    """Fill `out` with the rounded means of the blocks of `image`, `factor` pixels wide and high, or what is left there.

    `image` is (H, W, 3) uint16, `out` (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16.
    """
    height, width = image.shape[0], image.shape[1]
    sums = np.empty(3 * width, np.int64)
    one, two = uint64(1), uint64(2)
    for y in range(out.shape[0]):
        top, end = factor * y, min(factor * (y + 1), height)
        # Rows are added first, so that the compiler can vectorise what touches every sample.
        first, small = image[top].reshape(-1), out[y].reshape(-1)
        for i in range(3 * width):
            sums[i] = first[i]
        for row in range(top + 1, end):
            samples = image[row].reshape(-1)
            for i in range(3 * width):
                sums[i] += samples[i]
        left, at = uint64(0), uint64(0)
        columns = min(factor, width)
        share = 1.0 / ((end - top) * columns)
        for x in range(out.shape[1]):
            if factor * (x + 1) > width:
                columns = width - factor * x
                share = 1.0 / ((end - top) * columns)
            red, green, blue = sums[left], sums[left + one], sums[left + two]
            for _ in range(columns - 1):
                left += uint64(3)
                red += sums[left]
                green += sums[left + one]
                blue += sums[left + two]
            left += uint64(3)
            small[at] = uint16(red * share + 0.5)
            small[at + one] = uint16(green * share + 0.5)
            small[at + two] = uint16(blue * share + 0.5)
            at += uint64(3)


def _smaller(image: npt.NDArray[np.uint16], factor: int) -> npt.NDArray[np.uint16]:
    """Return the rounded means (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16 of the blocks of `image` (H, W, 3)."""
    height, width = image.shape[:2]
    if factor == 2 and height % 2 == width % 2 == 0:
        # OpenCV's means of two by two are the same, halves rounded up, in a third of the time; of others they are not.
        import cv2

        return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.uint16, copy=False)
    small = np.empty((-(-height // factor), -(-width // factor), 3), np.uint16)
    _shrink(image, factor, small)
    return small


@compiled
def _brightest(samples: Any, logs: Any) -> Any:
    """Return the largest channel of all pixels, and the sum over pixels of the logarithm of the largest channel.

    `samples` is (3 N,) uint16, `logs` (65536,) float64 the logarithm of each value.
    """
    # Two counters, so that equal values do not wait for each other.
    counts = np.zeros((2, 1 << 16), np.uint32)
    top = uint16(0)
    i = uint64(0)
    for pixel in range(len(samples) // 3):
        brightness = max(samples[i], samples[i + uint64(1)], samples[i + uint64(2)])
        counts[pixel & 1, brightness] += uint32(1)
        top = max(top, brightness)
        i += uint64(3)
    total = 0.0
    for value in range(int(top) + 1):
        total += (uint64(counts[0, value]) + uint64(counts[1, value])) * logs[value]
    return top, total


@compiled
def _map(samples: Any, roots: Any, shades: Any, out: Any) -> None:
    """Fill `out` with the rounded product of each sample's gamma root and the shade of its pixel's largest channel."""
    i = uint64(0)
    for _ in range(len(samples) // 3):
        red, green, blue = samples[i], samples[i + uint64(1)], samples[i + uint64(2)]
        shade = shades[max(red, green, blue)]
        # None is above 255 by more than an error of rounding.
        out[i] = uint8(roots[red] * shade + _HALF)
        out[i + uint64(1)] = uint8(roots[green] * shade + _HALF)
        out[i + uint64(2)] = uint8(roots[blue] * shade + _HALF)
        i += uint64(3)


@lru_cache(maxsize=4)
def _tables(white_level: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return lookup tables (65536,) over the values of 16 bits: brightness, its logarithm, its gamma root.

    Brightness is the value over the white level, at least `DARK`.
    """
    linear = np.arange(1 << 16) / white_level
    brightness = np.maximum(linear, DARK)
    return brightness.astype(np.float32), np.log(brightness), (linear ** (1 / _GAMMA)).astype(np.float32)


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> npt.NDArray[np.uint8]:
    """Return the preview of a raw linear image: made small, then tone mapped, colours as the camera saw them.

    `image`: (H, W, 3) uint16, linear camera RGB. `side`: longest side allowed, px. A pixel of the preview is the mean
    of k × k pixels, k the least whole number that makes it fit. Returns (h, w, 3) uint8, codes for a display; h and w
    are H / k and W / k, rounded up.

    Examples
    --------
    >>> wall = np.full((20, 1000, 3), (1000, 2000, 1500), np.uint16)
    >>> preview = preview_of(wall, white_level=4000, side=100)
    >>> preview.shape, preview[0, 0]
    ((2, 100, 3), array([186, 255, 224], dtype=uint8))
    """
    height, width = image.shape[:2]
    factor = -(-max(height, width) // side)
    if factor > 1:
        image = _smaller(np.ascontiguousarray(image), factor)
    brightness, logs, roots = _tables(white_level)
    samples = np.ascontiguousarray(image).reshape(-1)
    top, total = _brightest(samples, logs)
    seen = brightness[: int(top) + 1]
    operator = flash_from_brightness(float(total) / (samples.size // 3), float(seen[-1]), gamma=_GAMMA)
    shades = float32(operator.scale) * (seen + float32(operator.k)) ** float32(-1 / _GAMMA)
    picture = np.empty(image.shape, np.uint8)
    _map(samples, roots, shades, picture.reshape(-1))
    return picture
