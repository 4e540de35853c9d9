"""Weights of images by which a set of them gets the moments of another set: entropy balancing.

J. Hainmueller, "Entropy balancing for causal effects", Political Analysis 20 (2012) 25-46: of all weights that give the
wanted moments, those nearest to equal ones (least Kullback-Leibler divergence). They are exponentials of a sum of the
moments, each times a multiplier. The wanted moments are means over M real images and known so well only: multipliers
have a normal prior of spread 1, which M images overrule (S. F. Chen, R. Rosenfeld, "A Gaussian prior for smoothing
maximum entropy models", CMU-CS-99-108, 1999). Of few real images little is learned, and weights stay nearer to equal.

What is left of images is told by the effective sample size, (Σw)² / Σw² (L. Kish, Survey Sampling, 1965): as many
equally weighted images would give means as precise. If it falls below a floor, the multipliers are bounded, ever more
narrowly until it does not. A moment that hardly any image has cannot then take the weights from those that can be met:
a bounded multiplier is a price by the missing share instead of a condition.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]

LEAST_EFFECTIVE: Final = 0.2
"""Least effective share of images: chosen. With a fifth, a mean over a thousand pictures is as precise as one over two
hundred, the size of the real sets that they are made like; each picture counts about five times at most typically."""

_BOUNDS: Final = tuple(float(bound) for bound in np.geomspace(8, 0.01, 40))
"""Bounds of the multipliers that are tried, widest first: a moment of 1 more may count e⁸ times as much, that is
freely, down to 1 %, that is hardly."""


def effective_size(weights: _Array) -> float:
    """Return Kish's effective sample size of weights (N,) float64 ≥ 0.

    Examples
    --------
    >>> effective_size(np.array([1.0, 1.0, 1.0, 1.0])), effective_size(np.array([1.0, 0.0]))
    (4.0, 1.0)
    """
    return float(weights.sum() ** 2 / np.square(weights).sum())


def balance(
    moments: _Array, wanted: _Array, real: float, least_effective: float = LEAST_EFFECTIVE, variants: int = 1
) -> _Array:
    """Return the weights (N,) float64 of images, sum 1, by which their moments' means come near to the wanted ones.

    `moments`: (N, K) float64, the moments of each image. `wanted`: (K,) float64, their wanted means. `least_effective`:
    least effective sample size as a share of the images, 0 … 1.

    Examples
    --------
    >>> weights = balance(np.arange(100.0)[:, None] / 100, np.array([0.6]), np.inf)
    >>> round(float(weights @ np.arange(100.0)) / 100, 3), round(effective_size(weights))
    (0.6, 88)
    """
    aside = moments - wanted
    penalty, least = 1 / real, least_effective * len(moments) / variants

    def is_enough(weights: _Array) -> bool:
        return effective_size(weights.reshape(-1, variants).sum(axis=1)) >= least

    free = _dual(aside, penalty, np.zeros(len(wanted)), None)
    found = _weights(aside, free)
    if is_enough(found):
        return found
    best, low, high = np.full(len(moments), 1 / len(moments)), 0, len(_BOUNDS) - 1
    while low <= high:
        middle = (low + high) // 2
        found = _weights(aside, _dual(aside, penalty, free, _BOUNDS[middle]))
        if is_enough(found):
            best, high = found, middle - 1
        else:
            low = middle + 1
    return best


def _weights(aside: _Array, multipliers: _Array) -> _Array:
    exponents = aside @ multipliers
    parts = np.exp(exponents - exponents.max())
    return parts / parts.sum()


def _dual(aside: _Array, penalty: float, start: _Array, bound: float | None) -> _Array:
    """Return the multipliers (K,) that minimise ln of the mean of exp(aside · λ), plus half of penalty · λ²."""
    from scipy.optimize import minimize

    def value(multipliers: _Array) -> tuple[float, _Array]:
        exponents = aside @ multipliers
        top = exponents.max()
        parts = np.exp(exponents - top)
        total = parts.sum()
        slope = parts @ aside / total + penalty * multipliers
        return float(top + np.log(total) + 0.5 * penalty * np.square(multipliers).sum()), slope

    bounds = None if bound is None else [(-bound, bound)] * len(start)
    begin = start if bound is None else np.clip(start, -bound, bound)
    # The problem is convex and smooth, so that the start does not matter.
    found = minimize(
        value,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 500, "ftol": 1e-10, "gtol": 1e-6},
    )
    return np.asarray(found.x, dtype=np.float64)
