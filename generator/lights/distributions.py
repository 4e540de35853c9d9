"""Distributions of lights in the rb-chromaticity plane, from which a table's gamut is filled.

A distribution turns random words into chromaticities; the caller draws again what falls outside the gamut, so
that every distribution is cut to the gamut and keeps its shape within.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from generator.lights.gamut import rb_of
from generator.lights.log_kernels import LogKernels, draw_kernels
from generator.named_numbers import parse_numbers
from generator.philox import Words, standard_normal

_Array = npt.NDArray[np.float64]
_WORD: Final = float(1 << 32)
"""Values of a random word."""


class Distribution(Protocol):
    """Chromaticities r and b as a function of random words."""

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four (N,) uint32 random words; some may be no chromaticities at all."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values for `dataset.json`."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Every chromaticity of the gamut equally likely: uniform over the triangle of all r, b ≥ 0 with r + b ≤ 1."""

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words."""
        r, b = ((word + 0.5) / _WORD for word in words[:2])
        # The upper half of the square is the lower half turned about its centre.
        over = r + b > 1
        return np.stack([np.where(over, 1 - r, r), np.where(over, 1 - b, b)], axis=1)

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values."""
        return {"distribution": "uniform"}


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution of r and b: means, standard deviations above 0, correlation within −1 … 1."""

    r: float
    b: float
    sd_r: float
    sd_b: float
    correlation: float = 0.0

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words."""
        first, second = standard_normal(words).T
        across = self.correlation * first + np.sqrt(1 - self.correlation**2) * second
        return np.stack([self.r + self.sd_r * first, self.b + self.sd_b * across], axis=1)

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values."""
        return {
            "distribution": "gaussian",
            "mean": [self.r, self.b],
            "sd": [self.sd_r, self.sd_b],
            "correlation": self.correlation,
        }


@dataclass(frozen=True, eq=False)
class Fitted:
    """The lights of a data set: a kernel density estimate over the chromaticities of its ground truths.

    Kernels are Gaussians with the data's covariance, made small by Scott's factor n^(−1/6) (D. W. Scott, Multivariate
    Density Estimation, 1992; `scipy.stats.gaussian_kde`).

    - `rb`: (N, 2) float64, the data's chromaticities.
    - `root`: (2, 2) float64, lower triangular, times its transpose the kernel's covariance.
    - `file`, `sha256`: name of the file of the data, and the hash of the ground truths read from it.
    """

    rb: _Array
    root: _Array
    file: str
    sha256: str

    @classmethod
    def of(cls, truths: _Array, file: str = "") -> Fitted:
        """Return the distribution of ground truths (N, 3) float64, linear RGB of the table's camera, of any length."""
        from scipy.stats import gaussian_kde

        rb = rb_of(truths)
        try:
            covariance = np.atleast_2d(np.asarray(gaussian_kde(rb.T).covariance, dtype=np.float64))
            root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise FormatError(
                f"no distribution fits the {len(rb)} ground truths of {file or 'the list'}: expected three or more "
                "that do not lie on a line"
            ) from error
        return cls(rb, root, file, hashlib.sha256(np.ascontiguousarray(truths, dtype="<f8").tobytes()).hexdigest())

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words."""
        return draw_kernels(self.rb, self.root, words)

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values."""
        return {
            "distribution": "fit",
            "file": self.file,
            "ground_truths": len(self.rb),
            "sha256": self.sha256,
            "kernel": self.root.tolist(),
        }


_GAUSSIAN: Final = {
    "r": (0.0, 1.0),
    "b": (0.0, 1.0),
    "sd": (1e-6, 1.0),
    "sd_r": (1e-6, 1.0),
    "sd_b": (1e-6, 1.0),
    "corr": (-0.999999, 0.999999),
}
"""Ranges of the numbers of a Gaussian; without breadth, or with a correlation of 1, it would have no density."""


def parse_distribution(text: str) -> Distribution:
    """Return the distribution that a text names.

    ``uniform``; ``gaussian:r=.3,b=.25,sd=.02`` or ``gaussian:r=.3,b=.25,sd_r=.03,sd_b=.02,corr=-.8``; ``fit:GT.csv``
    with a file as `ground_truths.load_ground_truths` reads it, or the file alone; of a `STATS.json` that
    `evaluate describe` wrote the lights are fitted in the plane of ln(R/G) and ln(B/G) (`log_kernels`).

    Examples
    --------
    >>> parse_distribution("gaussian:r=.3,b=.25,sd=.02")
    Gaussian(r=0.3, b=0.25, sd_r=0.02, sd_b=0.02, correlation=0.0)
    """
    from generator.lights.ground_truths import is_statistics, load_ground_truths

    kind, _, rest = text.strip().partition(":")
    if kind == "uniform" and not rest:
        return Uniform()
    path = Path(rest if kind == "fit" else text)
    if (kind == "fit" and rest) or path.is_file():
        if is_statistics(path):
            return LogKernels.of(load_ground_truths(path), path.name)
        return Fitted.of(load_ground_truths(path), path.name)
    if kind == "gaussian":
        numbers = parse_numbers(rest, _GAUSSIAN, "the distribution gaussian")
        spread = [numbers.get(name, numbers.get("sd")) for name in ("sd_r", "sd_b")]
        if "r" in numbers and "b" in numbers and spread[0] is not None and spread[1] is not None:
            return Gaussian(numbers["r"], numbers["b"], spread[0], spread[1], numbers.get("corr", 0.0))
        raise InputError(f"{text!r} lacks a number; write gaussian:r=.3,b=.25,sd=.02, or sd_r, sd_b and corr for sd")
    raise InputError(f"{text!r} is no distribution of lights; write uniform, gaussian:r=.3,b=.25,sd=.02, or fit:GT.csv")
