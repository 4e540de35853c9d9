"""The lights of a real data set as a density in the plane of ln(R/G) and ln(B/G).

In that plane a light's distance to another does not depend on the gains of the camera's channels, and kernels of one
size fit daylight and lamps alike.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from generator.lights.gamut import rb_of
from generator.philox import Words, standard_normal
from generator.statistics import log_chroma

_OF_SCOTT: Final = 0.5
"""Share of Scott's factor n^(−1/6), which is for one normal cloud: real lights lie in clusters. Measured on four real
sets (NUS 600D and 1Ds Mark III, INTEL-TAU 5DSR prints and field): with a half the likelihood of left-out fifths is
highest, or within .1 of it, and the energy distance to the lights is .001 to .008 instead of .007 to .016; with a
quarter the likelihood falls apart on two of them."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LogKernels:
    """A kernel density estimate of lights in the plane of ln(R/G) and ln(B/G), of the lights' own covariance.

    Kernels are Gaussians with the lights' covariance times f², f half of Scott's factor n^(−1/6) (D. W. Scott,
    Multivariate Density Estimation, 1992). What is drawn is brought nearer to the mean by 1/√(1 + f²), so that the mean
    and the covariance of the density are those of the lights (B. W. Silverman, G. A. Young, "The bootstrap: to smooth
    or not to smooth?", Biometrika 74 (1987) 469-479).

    - `places`: (N, 2) float64, the lights' ln(R/G) and ln(B/G).
    - `root`: (2, 2) float64, lower triangular, times its transpose the kernel's covariance.
    - `factor`: f.
    - `file`, `sha256`: name of the file of the lights, and the hash of those read from it.
    """

    places: _Array
    root: _Array
    factor: float
    file: str
    sha256: str

    @classmethod
    def of(cls, lights: _Array, file: str = "") -> LogKernels:
        """Return the density of lights (N, 3) float64 above 0, linear RGB of the table's camera, of any length."""
        places = log_chroma(lights)
        factor = _OF_SCOTT * len(places) ** (-1 / 6)
        try:
            if len(places) < 3:
                raise np.linalg.LinAlgError
            root = np.linalg.cholesky(np.cov(places.T, bias=True)) * factor
            if not root.diagonal().min() > 1e-6 * factor * max(1e-6, root.diagonal().max() / factor):
                raise np.linalg.LinAlgError
        except np.linalg.LinAlgError as error:
            raise FormatError(
                f"no density fits the {len(places)} lights of {file or 'the list'}: expected three or more that do not "
                f"lie on a line; take them as they are with --match {file or 'FILE'}"
            ) from error
        digest = hashlib.sha256(np.ascontiguousarray(lights, dtype="<f8").tobytes()).hexdigest()
        return cls(places, root, factor, file, digest)

    def draw(self, words: tuple[Words, Words, Words, Words]) -> _Array:
        """Return (N, 2) float64, r and b, from four arrays (N,) uint32 of random words."""
        mean = self.places.mean(axis=0)
        drawn = mean + (draw_kernels(self.places, self.root, words) - mean) / np.sqrt(1 + self.factor**2)
        red, blue = np.exp(drawn).T
        return rb_of(np.stack([red, np.ones_like(red), blue], axis=1))

    def describe(self) -> dict[str, Any]:
        """Return the density as plain values."""
        return {
            "distribution": "log kernels",
            "file": self.file,
            "lights": len(self.places),
            "sha256": self.sha256,
            "factor": self.factor,
            "kernel": self.root.tolist(),
        }


def draw_kernels(places: _Array, root: _Array, words: tuple[Words, Words, Words, Words]) -> _Array:
    """Return draws from a density of Gaussian kernels, (N, 2) float64.

    `places`: (M, 2) float64, the kernels' centres, each as likely. `root`: (2, 2) float64, lower triangular, times its
    transpose the kernels' covariance. `words`: four arrays (N,) uint32 of random words: two for the normal deviates,
    the third for the kernel.
    """
    chosen = (words[2].astype(np.uint64) * np.uint64(len(places))) >> np.uint64(32)
    normal = standard_normal(words)
    aside = np.stack([root[0, 0] * normal[:, 0], root[1, 0] * normal[:, 0] + root[1, 1] * normal[:, 1]], axis=1)
    return places[chosen.astype(np.intp)] + aside
