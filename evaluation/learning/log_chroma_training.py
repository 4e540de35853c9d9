"""Fit the filters and the bias of `log_chroma.py`.

J. T. Barron, Y.-T. Tsai, "Fast Fourier color constancy", CVPR 2017, sections 3 and 4 and its supplement. The loss of
the first iterations is convex, the cross-entropy between the softmax and the bin of the true light; that of the others
is the negative log-likelihood of the true light under the fitted bivariate von Mises distribution, taken as a normal
one on the unrolled torus (equations 9 to 13). The penalties, squares of the parameters and of their differences
between neighbouring bins, are diagonal in Fourier space, where L-BFGS runs on parameters scaled so that the penalty is
half their squared length (preconditioning, section 4.2).

The Fourier transforms of real arrays are symmetric; instead of the paper's packing of their independent parts, the
scaled parameters stay in the plane of bins and pass through Fourier space and back, a symmetric linear map. Gradients
are in single precision, which is what makes the processor's cache hold a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

BINS = 64
"""Bins of the torus along each axis (section 5 of the paper)."""
_BATCH = 16
"""Images at a time: their arrays then lie in a processor's second cache."""
_SHAPE = (BINS, BINS)
_ANGLE = 2 * np.pi / BINS
"""Radians a bin."""
_TINY = 1e-12
"""Least squared length of a mean direction: that of a flat distribution is 0, and its angle nothing to divide by."""


@dataclass(frozen=True)
class Penalties:
    """Weights of what keeps a model simple.

    - `smoothness`: of squared differences between neighbouring bins: pixel filter, edge filter, bias.
    - `size`: of squares.
    - `spread`: variance that is added to the distribution's along each axis, bins².
    """

    smoothness: tuple[float, float, float]
    size: tuple[float, float, float]
    spread: float


@dataclass(frozen=True, eq=False)
class Moments:
    """Means and covariances of distributions (N, 64, 64) on the torus, in bins.

    - `mean`: (N, 2), the circular means, 0 … 64.
    - `covariance`: (N, 3): of u and u, v and v, u and v, about the means on the unrolled torus.
    - `slopes`: (N, 2, 64), derivative of each mean by the marginal probability of a bin.
    - `steps`: (N, 2, 64), distance of each bin from the nearest bin to the mean, −32 … 31.
    - `centre`: (N, 2), means of the steps.
    """

    mean: npt.NDArray[Any]
    covariance: npt.NDArray[Any]
    slopes: npt.NDArray[Any]
    steps: npt.NDArray[Any]
    centre: npt.NDArray[Any]


def moments(likely: npt.NDArray[np.floating]) -> Moments:
    """Return the moments of distributions (N, 64, 64) of any float dtype and of sum 1, in their dtype."""
    kind = likely.dtype
    bins = np.arange(BINS)
    sine, cosine = np.sin(_ANGLE * bins).astype(kind), np.cos(_ANGLE * bins).astype(kind)
    marginals = np.stack([likely.sum(axis=2), likely.sum(axis=1)], axis=1)
    y, x = marginals @ sine, marginals @ cosine
    mean = np.arctan2(y, x) / kind.type(_ANGLE) % BINS
    length = np.maximum(x * x + y * y, kind.type(_TINY)) * kind.type(_ANGLE)
    slopes = (x[..., None] * sine - y[..., None] * cosine) / length[..., None]
    half = BINS // 2
    steps = ((bins - np.rint(mean)[..., None] + half) % BINS - half).astype(kind)
    centre = (marginals * steps).sum(axis=2)
    variance = (marginals * steps**2).sum(axis=2) - centre**2
    mixed = (np.matmul(likely, steps[:, 1, :, None])[..., 0] * steps[:, 0]).sum(axis=1) - centre.prod(axis=1)
    return Moments(mean, np.concatenate([variance, mixed[:, None]], axis=1), slopes, steps, centre)


def likelihood(
    likely: npt.NDArray[np.floating], found: Moments, places: npt.NDArray[np.floating], spread: float
) -> tuple[float, npt.NDArray[Any]]:
    """Return the summed loss of true places (N, 2) and its derivative by the response, (N, 64, 64) of a float dtype.

    The loss of an image is the negative log-likelihood less the least it can be, that of a hit with no spread but
    `spread`.

    `likely`: (N, 64, 64) of a float dtype, the distributions. `places`: (N, 2) of a float dtype, the true lights, bins.
    """
    away = found.mean - places
    away = away - BINS * np.rint(away / BINS)
    uu, vv, uv = found.covariance[:, 0] + spread, found.covariance[:, 1] + spread, found.covariance[:, 2]
    determinant = uu * vv - uv * uv
    inverse_u, inverse_v, inverse_uv = vv / determinant, uu / determinant, -uv / determinant
    pull_u = inverse_u * away[:, 0] + inverse_uv * away[:, 1]
    pull_v = inverse_uv * away[:, 0] + inverse_v * away[:, 1]
    loss = 0.5 * (pull_u * away[:, 0] + pull_v * away[:, 1] + np.log(determinant)) - np.log(spread)
    by_uu, by_vv, by_uv = inverse_u - pull_u**2, inverse_v - pull_v**2, inverse_uv - pull_u * pull_v
    step_u, step_v = found.steps[:, 0], found.steps[:, 1]
    centre_u, centre_v = found.centre[:, :1], found.centre[:, 1:]
    along_u = pull_u[:, None] * found.slopes[:, 0] + 0.5 * by_uu[:, None] * step_u * (step_u - 2 * centre_u)
    along_v = pull_v[:, None] * found.slopes[:, 1] + 0.5 * by_vv[:, None] * step_v * (step_v - 2 * centre_v)
    along_u = along_u - by_uv[:, None] * centre_v * step_u
    along_v = along_v - by_uv[:, None] * centre_u * step_v
    ones = np.ones_like(step_u)
    left = np.stack([along_u, ones, by_uv[:, None] * step_u], axis=2)
    right = np.stack([ones, along_v, step_v], axis=1)
    slope = np.matmul(left, right)
    mean = (likely * slope).sum(axis=(1, 2), keepdims=True)
    return float(loss.sum(dtype=np.float64)), likely * (slope - mean)


def crossentropy(
    response: npt.NDArray[np.floating], likely: npt.NDArray[np.floating], places: npt.NDArray[np.floating]
) -> tuple[float, npt.NDArray[Any]]:
    """Return the summed cross-entropy with the bins of true places, and its derivative (N, 64, 64), a float dtype.

    `response`: (N, 64, 64) of a float dtype, logarithms of the distributions up to a constant. `likely`: (N, 64, 64) of
    a float dtype, the distributions. `places`: (N, 2) of a float dtype, the true lights, bins.
    """
    u, v = (np.rint(places).astype(np.int64) % BINS).T
    image = np.arange(len(places))
    totals = np.log(np.exp(response.astype(np.float64)).sum(axis=(1, 2)))
    slope = likely.copy()
    slope[image, u, v] -= 1
    return float((totals - response[image, u, v]).sum()), slope


def train(
    histograms: npt.NDArray[np.float64],
    places: npt.NDArray[np.float64],
    penalties: Penalties,
    stages: Sequence[tuple[int, float, float]],
) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.float64]]:
    """Return the fitted filters (2, 64, 33) complex128, in Fourier space, and the bias (64, 64) float64.

    `histograms`: (N, 2, 64, 64) float64, each of sum 1. `places`: (N, 2) float64, the true lights in bins; they may lie
    outside 0 … 64.
    """
    import scipy.fft
    import scipy.optimize

    fft: Any = scipy.fft
    minimize: Any = scipy.optimize.minimize
    whiten = np.stack([_scale(*weights) for weights in zip(penalties.smoothness, penalties.size, strict=True)])
    spectra: Any = fft.rfft2(histograms.astype(np.float32))
    wanted = places.astype(np.float32)
    count = len(histograms)

    def spread_out(scaled: npt.NDArray[np.float64]) -> tuple[Any, Any]:
        spectrum: Any = whiten * fft.rfft2(scaled.reshape(3, *_SHAPE))
        return spectrum[:2], fft.irfft2(spectrum[2], s=_SHAPE)

    def loss(scaled: npt.NDArray[np.float64], entropy_weight: float, likelihood_weight: float) -> tuple[float, Any]:
        filters, bias = spread_out(scaled)
        single, level = filters.astype(np.complex64), bias.astype(np.float32)
        total = 0.5 * count * float(scaled @ scaled)
        gradient = np.zeros((3, BINS, BINS // 2 + 1), np.complex128)
        for start in range(0, count, _BATCH):
            batch, aim = spectra[start : start + _BATCH], wanted[start : start + _BATCH]
            response: Any = fft.irfft2((batch * single).sum(axis=1), s=_SHAPE) + level
            response -= response.max(axis=(1, 2), keepdims=True)
            likely = np.exp(response)
            likely /= likely.sum(axis=(1, 2), keepdims=True)
            if entropy_weight:
                value, slope = crossentropy(response, likely, aim)
                weight = entropy_weight
            else:
                value, slope = likelihood(likely, moments(likely), aim, penalties.spread)
                weight = likelihood_weight
            total += weight * value
            back: Any = fft.rfft2(slope)
            gradient[:2] += weight * (batch.conj() * back[:, None]).sum(axis=0)
            gradient[2] += weight * back.sum(axis=0)
        scaled_gradient: Any = fft.irfft2(whiten * gradient, s=_SHAPE)
        return total, scaled_gradient.ravel() + count * scaled

    scaled = np.zeros(3 * BINS * BINS)
    for iterations, *weights in stages:
        options = {"maxiter": iterations, "maxcor": iterations, "maxfun": 4 + 2 * iterations, "ftol": 0, "gtol": 0}
        found: Any = minimize(loss, scaled, tuple(weights), "L-BFGS-B", jac=True, options=options)
        scaled = found.x
    filters, bias = spread_out(scaled)
    return filters, bias


def _scale(smoothness: float, size: float) -> npt.NDArray[np.float64]:
    """Return what each Fourier coefficient is multiplied by so that the penalty becomes the squared length, (64, 33).

    The authors' penalty is Σ |F|² (smoothness (|1 − e^iα|² + |1 − e^iβ|²) / 8 + size) over all coefficients F. The
    constant one is left out: the softmax does not see it.
    """
    differences = (2 - 2 * np.cos(_ANGLE * np.arange(BINS))) / 8
    weights = smoothness * (differences[:, None] + differences[None, : BINS // 2 + 1]) + size
    weights[0, 0] = np.inf
    return 1 / (BINS * np.sqrt(weights))
