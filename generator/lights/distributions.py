"""Distributions of illuminants in the rb-chromaticity plane, and files of ground truths.

A distribution converts random 32-bit integers to chromaticities. The caller repeats a draw that is outside the gamut
of the LUT. This cuts the distribution to the gamut and keeps its shape inside.
"""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from foundation.files import read_text
from generator.lights.gamut import rb_of
from generator.named_numbers import is_number, parse_numbers
from generator.philox import Words, standard_normal

_Array = npt.NDArray[np.float64]


# Column names of ground truths in data sets and tables, in lower case.
TRIPLES: Final = (
    ("gt_r", "gt_g", "gt_b"),
    ("r", "g", "b"),
    ("red", "green", "blue"),
    ("white_r", "white_g", "white_b"),
)


def load_ground_truths(path: Path) -> npt.NDArray[np.float64]:
    """Return the ground truths of a file, (N, 3) float64 ≥ 0, linear camera RGB, not normalised."""
    return np.array(list(ground_truths_by_line(path).values()))


def ground_truths_by_line(path: Path) -> dict[int, list[float]]:
    """Return the ground truths of a file, linear camera RGB ≥ 0, by line number.

    A CSV file has the columns `GT_R,GT_G,GT_B` or `r,g,b`; other columns are ignored. Any other file has three
    numbers in each line, separated by blanks or commas, as in `gt.txt` and Cube+. Raises FormatError.
    """
    lines = read_text(path, "give a text file", "ground truths").splitlines()
    numbered = [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]
    if not numbered:
        raise FormatError(f"{path} is empty, expected three numbers in each line; choose another file")
    columns: Sequence[int] = (0, 1, 2)
    head = [field.strip().lower() for field in next(csv.reader([numbered[0][1]]))]
    has_header = not any(is_number(token) for token in re.split(r"[\s,;]+", numbered[0][1]))
    if has_header:
        triple = next((names for names in TRIPLES if all(name in head for name in names)), None)
        if triple is None:
            raise FormatError(f"{path}, line 1 is {','.join(head)}, expected GT_R,GT_G,GT_B or r,g,b; correct it")
        columns = [head.index(name) for name in triple]
    truths: dict[int, list[float]] = {}
    for number, line in numbered[has_header:]:
        fields = next(csv.reader([line])) if has_header else re.split(r"[\s,;]+", line.strip(",; "))
        try:
            if not has_header and len(fields) != 3:
                raise ValueError(f"{len(fields)} numbers, expected 3")
            if len(fields) <= max(columns):
                raise ValueError(f"{len(fields)} fields, expected at least {max(columns) + 1}")
            truth = [float(fields[column]) for column in columns]
        except ValueError as error:
            raise FormatError(f"{path}, line {number}: {line!r} is not a ground truth ({error}); correct it") from error
        if not is_ground_truth(truth):
            raise FormatError(
                f"{path}, line {number}: {line!r} is not a ground truth, expected numbers ≥ 0, sum above 0; correct it"
            )
        truths[number] = truth
    if not truths:
        raise FormatError(f"{path} has only a header, expected a ground truth in each line below; choose another file")
    return truths


def is_ground_truth(numbers: Sequence[float]) -> bool:
    """Return whether numbers can be linear RGB of an illuminant: three, finite, ≥ 0, sum above 0."""
    return len(numbers) == 3 and bool(np.isfinite(numbers).all()) and min(numbers) >= 0 and sum(numbers) > 0


_WORD: Final = float(1 << 32)  # Number of values of a random word


@dataclass(frozen=True)
class Uniform:
    """Uniform over the triangle of all r, b ≥ 0 with r + b ≤ 1."""

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words."""
        r, b = ((word + 0.5) / _WORD for word in words[:2])
        # Points with r + b > 1 are rotated into the triangle, about the centre of the square.
        over = r + b > 1
        return np.stack([np.where(over, 1 - r, r), np.where(over, 1 - b, b)], axis=1)

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values."""
        return {"distribution": "uniform"}


@dataclass(frozen=True)
class Gaussian:
    """Normal distribution of r and b: means, standard deviations above 0, correlation between −1 and 1."""

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
    """Kernel density estimate over the chromaticities of the ground truths of a data set.

    Kernels are Gaussians with the covariance of the data, scaled by Scott's factor n^(−1/6) (D. W. Scott, Multivariate
    Density Estimation, 1992; `scipy.stats.gaussian_kde`).
    """

    rb: _Array  # (N, 2) float64, chromaticities of the data
    root: _Array  # (2, 2) float64, Cholesky factor of the covariance of the kernel
    file: str  # name of the data file
    sha256: str  # hash of the ground truths

    @classmethod
    def of(cls, truths: _Array, file: str = "") -> Fitted:
        """Return the distribution of ground truths (N, 3) float64, linear RGB of the camera of the LUT."""
        from scipy.stats import gaussian_kde

        rb = rb_of(truths)
        try:
            covariance = np.atleast_2d(np.asarray(gaussian_kde(rb.T).covariance, dtype=np.float64))
            root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        except ValueError as error:
            raise FormatError(
                f"no distribution can be fitted to the {len(rb)} ground truths of {file or 'the list'}, expected three "
                "or more that are not on a line; choose another file"
            ) from error
        return cls(rb, root, file, hashlib.sha256(np.ascontiguousarray(truths, dtype="<f8").tobytes()).hexdigest())

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words. The third selects kernels."""
        kernels = (words[2].astype(np.uint64) * np.uint64(len(self.rb))) >> np.uint64(32)
        normal, root = standard_normal(words), self.root
        offsets = np.stack([root[0, 0] * normal[:, 0], root[1, 0] * normal[:, 0] + root[1, 1] * normal[:, 1]], axis=1)
        return self.rb[kernels.astype(np.intp)] + offsets

    def describe(self) -> dict[str, Any]:
        """Return the distribution as plain values."""
        return {
            "distribution": "fit",
            "file": self.file,
            "ground_truths": len(self.rb),
            "sha256": self.sha256,
            "kernel": self.root.tolist(),
        }


# Maps random words to r and b; some results may be outside the triangle of chromaticities.
Distribution = Uniform | Gaussian | Fitted

# Allowed ranges of the parameters of a Gaussian. With a standard deviation of 0 or a correlation of 1, it has no
# density.
_GAUSSIAN: Final = {
    "r": (0.0, 1.0),
    "b": (0.0, 1.0),
    "sd": (1e-6, 1.0),
    "sd_r": (1e-6, 1.0),
    "sd_b": (1e-6, 1.0),
    "corr": (-0.999999, 0.999999),
}


def parse_distribution(text: str) -> Distribution:
    """Return the distribution that a text specifies.

    It is ``uniform``, ``gaussian:r=0.3,b=0.25,sd=0.02``, ``gaussian:r=0.3,b=0.25,sd_r=0.03,sd_b=0.02,corr=-0.8``, or
    the name of a file for `load_ground_truths`.
    """
    name, _, rest = text.strip().partition(":")
    if name == "uniform" and not rest:
        return Uniform()
    path = Path(text)
    if path.is_file():
        return Fitted.of(load_ground_truths(path), path.name)
    if name == "gaussian":
        numbers = parse_numbers(rest, _GAUSSIAN, "the distribution gaussian")
        spread = [numbers.get(name, numbers.get("sd")) for name in ("sd_r", "sd_b")]
        if "r" in numbers and "b" in numbers and spread[0] is not None and spread[1] is not None:
            return Gaussian(numbers["r"], numbers["b"], spread[0], spread[1], numbers.get("corr", 0.0))
        raise InputError(f"{text!r} is incomplete; write gaussian:r=0.3,b=0.25,sd=0.02, or sd_r and sd_b, not sd")
    raise InputError(f"{text!r} is not a distribution; write uniform, gaussian:r=0.3,b=0.25,sd=0.02, or a file")
