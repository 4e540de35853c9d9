"""The Gray-Edge framework: the light is the Minkowski mean of an image or of its derivatives.

J. van de Weijer, T. Gevers, A. Gijsenij, "Edge-based color constancy", IEEE Transactions on Image Processing 16(9),
2007, equation 13: ``e ∝ (∫ |∂ⁿ f_σ / ∂xⁿ|ᵖ dx)^(1/p)`` for each channel. With n = 0 and σ = 0 it is Gray-world (p = 1),
White-Patch (p = ∞) and Shades-of-Gray; with n = 0 general Gray-world. Filters and exclusions follow the authors'
program: Gaussian kernels cut at 3σ, edges continued by their last pixel, order 2 as √(f_xx² + 4 f_xy² + f_yy²).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import unit, usable


@dataclass(frozen=True)
class GrayEdge:
    """One method of the framework.

    Attributes
    ----------
    name
        Its name in tables.
    order
        n, order of the derivative: 0, 1 or 2.
    p
        Minkowski norm, ≥ 1; infinity takes the maximum.
    sigma
        Scale of the Gaussian, px; 0 for none, which only order 0 allows.
    border
        Pixels left out along every edge; by default ⌊σ⌋ + 1 as in the authors' program.

    Raises
    ------
    ValueError
        Order, norm and scale make no method of the framework.

    Examples
    --------
    Gray-world on an image that is grey on average under a greenish light:

    >>> image = np.array([[[100, 200, 100], [300, 600, 300]], [[50, 100, 50], [30, 60, 30]]], np.uint16)
    >>> GrayEdge("Gray-world", order=0, p=1, sigma=0, border=0).estimate(image).round(3)
    array([0.408, 0.816, 0.408])
    """

    name: str
    order: int
    p: float
    sigma: float
    border: int | None = None

    def __post_init__(self) -> None:
        if self.order not in (0, 1, 2) or self.p < 1 or self.sigma < 0 or (self.order and not self.sigma):
            raise ValueError(
                f"order {self.order}, p {self.p}, sigma {self.sigma} make no method of the framework; expected order 0 "
                "to 2, p from 1, and sigma from 0, above 0 for a derivative"
            )

    def estimate(
        self,
        image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
        saturation: float | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        border = math.floor(self.sigma) + 1 if self.border is None else self.border
        used = usable(image, saturation, mask, border)
        response = differentiate(image.astype(np.float32), self.order, self.sigma)
        channels = [response[..., channel][used] for channel in range(3)]
        peaks = np.array([channel.max(initial=0.0) for channel in channels], dtype=np.float64)
        if math.isinf(self.p) or not peaks.max():
            return unit(peaks)
        return unit([_minkowski(channel, self.p, float(peaks.max())) for channel in channels])


def _minkowski(values: npt.NDArray[np.float32], p: float, scale: float) -> float:
    """Return the p-norm of values (N,) ≥ 0 over `scale`, which keeps powers from over- and underflowing."""
    if p == 1:
        return float(values.sum(dtype=np.float64)) / scale
    scaled = values / np.float32(scale)
    powers = scaled * scaled if p == 2 else scaled**p
    return float(powers.sum(dtype=np.float64)) ** (1 / p)


def differentiate(image: npt.NDArray[np.float32], order: int, sigma: float) -> npt.NDArray[np.float32]:
    """Return the size of an image's Gaussian derivative, (H, W, 3) float32, channel by channel.

    Order 0 is the smoothed image, order 1 the gradient's length, order 2 √(f_xx² + 4 f_xy² + f_yy²).

    Parameters
    ----------
    image
        (H, W, 3) float32 ≥ 0, linear camera RGB.
    order
        0, 1 or 2.
    sigma
        Scale of the Gaussian, px; 0 for none, which only order 0 allows.

    Examples
    --------
    >>> ramp = np.full((1, 40, 3), 2, np.float32).cumsum(axis=1)
    >>> differentiate(ramp, order=1, sigma=1.0)[0, 20].round(3)
    array([2., 2., 2.], dtype=float32)
    """
    if not sigma:
        return np.abs(image)
    if order == 0:
        return np.abs(_filter(image, sigma, 0, 0))
    if order == 1:
        along_x, along_y = _filter(image, sigma, 1, 0), _filter(image, sigma, 0, 1)
        return np.sqrt(along_x**2 + along_y**2)
    xx, xy, yy = (_filter(image, sigma, *orders) for orders in ((2, 0), (1, 1), (0, 2)))
    return np.sqrt(xx**2 + 4 * xy**2 + yy**2)


def gaussian_kernel(sigma: float, order: int) -> npt.NDArray[np.float64]:
    """Return the kernel (N,) float64 of a Gaussian's derivative, to be correlated with; N = 2⌊3σ + ½⌋ + 1.

    Normalised on the grid of pixels: order 0 sums to 1; order 1 gives 1 for the ramp x; order 2 gives 1 for x²/2 and 0
    for a constant.

    Parameters
    ----------
    sigma
        Standard deviation of the Gaussian, px, above 0.
    order
        Order of the derivative, 0, 1 or 2.

    Examples
    --------
    >>> gaussian_kernel(0.5, 1).round(3)
    array([-0.002, -0.495,  0.   ,  0.495,  0.002])
    """
    reach = math.floor(3 * sigma + 0.5)
    x = np.arange(-reach, reach + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * sigma**2))
    if order == 0:
        return bell / bell.sum()
    if order == 1:
        slope = x * bell
        return slope / (x * slope).sum()
    bend = (x**2 / sigma**4 - 1 / sigma**2) * bell
    bend -= bend.mean()
    return bend / (0.5 * x**2 * bend).sum()


def _filter(image: npt.NDArray[np.float32], sigma: float, along_x: int, along_y: int) -> npt.NDArray[np.float32]:
    import cv2

    kernel_x, kernel_y = gaussian_kernel(sigma, along_x), gaussian_kernel(sigma, along_y)
    filtered = cv2.sepFilter2D(image, cv2.CV_32F, kernel_x, kernel_y, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(filtered, dtype=np.float32)
