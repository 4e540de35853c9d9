"""How a wavy sheet departs from a plane: a smooth displacement over the print, fitted to what was measured on it.

Half-size pixels as a function of millimetres on the print. Source: P. H. C. Eilers and B. D. Marx, "Flexible smoothing
with B-splines and penalties", Statistical Science 1996.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

ROUGHNESS_PX = 0.2
"""Usual second difference of the displacement between knots: a wave of 2 px amplitude every 20 knots, or of 0.2 px
every 6. Where cells measure it, shorter waves are followed as well."""

MOST_ROUGHNESS_PX = 2.0
"""The same of a sheet that waves by 6 mm every 150 mm: rougher ones are refused, and not followed."""

_RIDGE = 1e-3
"""px⁻², on the diagonal: keeps knots that no measurement reaches solvable, and is nothing to a measured cell's."""

_DRAWS, _SEED = 32, 20
"""Draws from the posterior distribution: of 64 values a standard deviation is known to 9 %; always the same."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Displacement:
    """A smooth displacement over the print: a tensor product of uniform cubic B-splines.

    Attributes
    ----------
    origin_mm, knot_mm
        (2,) first knot and distance of knots in x and y.
    coefficients
        (rows, columns, 2) float64, half-size px (dx, dy).
    """

    origin_mm: _Array
    knot_mm: _Array
    coefficients: _Array

    @classmethod
    def over(cls, low_mm: _Array, high_mm: _Array, knot_mm: float) -> Displacement:
        """Return the displacement 0 over a rectangle between corners (2,) mm, with knots about `knot_mm` apart."""
        spans = np.maximum(np.ceil((high_mm - low_mm) / knot_mm), 1).astype(int)
        return cls(low_mm, (high_mm - low_mm) / spans, np.zeros((spans[1] + 3, spans[0] + 3, 2)))

    def basis(self, points_mm: npt.ArrayLike) -> sparse.csr_array:
        """Return the splines (N, K) float64 at points (N, 2) float mm; outside, the border's cubic goes on."""
        rows, columns = self.coefficients.shape[:2]
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        at = (points - self.origin_mm) / self.knot_mm
        first = np.clip(np.floor(at).astype(int), 0, (columns - 4, rows - 4))
        weights = _cubic_weights(at - first)
        index = ((first[:, 1, None, None] + np.arange(4)[:, None]) * columns + first[:, 0, None, None]) + np.arange(4)
        values = weights[:, 1, :, None] * weights[:, 0, None, :]
        row = np.repeat(np.arange(len(points)), 16)
        shape = (len(points), rows * columns)
        return sparse.csr_array((values.ravel(), (row, index.ravel())), shape=shape)

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the displacement (N, 2) float64 px at points (N, 2) mm."""
        return np.asarray(self.basis(points_mm) @ self.coefficients.reshape(-1, 2))

    def fitted(
        self, points_mm: _Array, information: _Array, pull: _Array, roughness_px: float = ROUGHNESS_PX
    ) -> Displacement:
        """Return the smooth displacement most likely for measured places.

        Minimises ``Σ ½ dᵀ A d − pullᵀ d + ½ |second differences|² / roughness²``.

        Parameters
        ----------
        points_mm
            (N, 2) mm, where it was measured.
        information
            (N, 2, 2) A: inverse covariance of each measurement, px⁻²; 0 where nothing was seen.
        pull
            (N, 2) A times the measured displacement, px⁻¹.
        roughness_px
            Usual second difference between knots.
        """
        basis = self.basis(points_mm)
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        right = np.concatenate([basis.T @ pull[:, 0], basis.T @ pull[:, 1]])
        solution = np.asarray(sparse_linalg.spsolve(matrix, right))
        return replace(self, coefficients=solution.reshape(2, rows, columns).transpose(1, 2, 0))

    def errors_px(self, points_mm: _Array, information: _Array, at_mm: _Array) -> _Array:
        """Return the standard error (M,) float64 px of the displacement's length at places (M, 2) mm.

        From draws of the coefficients' posterior distribution, whose covariance is the inverse of the fit's matrix:
        each is the fit to data and roughness that scatter as they are taken to (G. Papandreou and A. L. Yuille,
        "Gaussian sampling by local perturbations", NIPS 2010). Where nothing is measured, the sheet is taken to be as
        rough as it is found elsewhere.

        Parameters
        ----------
        points_mm
            (N, 2) mm, where it was measured.
        information
            (N, 2, 2) inverse covariance of each measurement, px⁻²; 0 where nothing was seen.
        at_mm
            (M, 2) float64 mm, the places.
        """
        bends = [np.diff(self.coefficients, 2, axis=axis) for axis in (0, 1)]
        roughness = max(ROUGHNESS_PX, *(float(np.sqrt((bend**2).mean())) for bend in bends))
        drawn = self._drawn(points_mm, information, roughness)
        wanted, half = self.basis(at_mm), len(drawn) // 2
        x, y = (np.asarray(wanted @ part, dtype=np.float64) for part in (drawn[:half], drawn[half:]))
        return np.sqrt((x**2 + y**2).mean(axis=1))

    def likely_roughness_px(self, points_mm: _Array, information: _Array, roughness_px: float) -> float:
        """Return the usual second difference between knots that the measurements make likely, `ROUGHNESS_PX` or more.

        What the fit bends, squared, over the number of bends that the measurements determine: one step of a fixed-point
        iteration (D. J. C. MacKay, "Bayesian interpolation", Neural Computation 1992).

        Parameters
        ----------
        points_mm
            (N, 2) float64 mm, where it was measured.
        information
            (N, 2, 2) float64 px⁻², of the measurements to which this was fitted.
        roughness_px
            With which it was fitted.
        """
        rows, columns = self.coefficients.shape[:2]
        bending = _differences(rows, columns)
        drawn = self._drawn(points_mm, information, roughness_px)
        half = len(drawn) // 2
        open_px2 = sum(float((np.asarray(bending @ part) ** 2).sum()) for part in (drawn[:half], drawn[half:])) / _DRAWS
        bent_px2 = float((np.asarray(bending @ self.coefficients.reshape(-1, 2)) ** 2).sum())
        determined = max(2 * bending.shape[0] - open_px2 / roughness_px**2, 1.0)
        return float(np.clip(np.sqrt(bent_px2 / determined), ROUGHNESS_PX, MOST_ROUGHNESS_PX))

    def _drawn(self, points_mm: _Array, information: _Array, roughness_px: float) -> _Array:
        """Return draws (2 K, draws) of the coefficients' posterior distribution about the fit; all x before all y."""
        random = np.random.Generator(np.random.SFC64(_SEED))
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        # What a measurement with this information would scatter by: its Cholesky factor times normal deviates.
        root = np.linalg.cholesky(information + 1e-9 * np.eye(2))
        scatter = np.einsum("nij,njs->nis", root, random.standard_normal((len(points_mm), 2, _DRAWS)))
        basis = self.basis(points_mm)
        of_data = np.concatenate([basis.T @ scatter[:, axis] for axis in (0, 1)])
        bending = _differences(rows, columns)
        of_sheet = [bending.T @ random.standard_normal((bending.shape[0], _DRAWS)) / roughness_px for _ in (0, 1)]
        of_ridge = np.sqrt(_RIDGE) * random.standard_normal((2 * rows * columns, _DRAWS))
        right = of_data + np.concatenate(of_sheet) + of_ridge
        return np.asarray(sparse_linalg.splu(sparse.csc_matrix(matrix)).solve(right), dtype=np.float64)

    def _normal_matrix(self, points_mm: _Array, information: _Array, roughness_px: float) -> sparse.csc_array:
        """Return the matrix (2 K, 2 K) of the normal equations, all x before all y; parameters as for `fitted`."""
        basis = self.basis(points_mm)
        rows, columns = self.coefficients.shape[:2]
        blocks = [[basis.T @ sparse.diags_array(information[:, i, j]) @ basis for j in (0, 1)] for i in (0, 1)]
        bending = _differences(rows, columns)
        penalty = bending.T @ bending / roughness_px**2 + sparse.identity(rows * columns) * _RIDGE
        matrix = sparse.block_array([[blocks[0][0] + penalty, blocks[0][1]], [blocks[1][0], blocks[1][1] + penalty]])
        return sparse.csc_array(matrix)


def _cubic_weights(t: _Array) -> _Array:
    """Return the four uniform cubic B-spline weights (..., 4) at t in [0, 1] of a span."""
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6


def _differences(rows: int, columns: int) -> sparse.csr_array:
    """Return all second differences (D, K) on a grid of coefficients: yy, then xx, then √2 times xy."""

    def difference(n: int, order: int) -> sparse.csr_array:
        matrix = sparse.eye_array(n, format="csr")
        for _ in range(order):
            matrix = matrix[1:] - matrix[:-1]
        return sparse.csr_array(matrix)

    whole = [sparse.eye_array(n, format="csr") for n in (rows, columns)]
    xy = sparse.kron(difference(rows, 1), difference(columns, 1)) * np.sqrt(2)
    parts = (sparse.kron(whole[0], difference(columns, 2)), sparse.kron(difference(rows, 2), whole[1]), xy)
    return sparse.csr_array(sparse.vstack([sparse.csr_array(part) for part in parts]))
