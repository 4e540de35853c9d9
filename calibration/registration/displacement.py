"""How a wavy sheet departs from a plane: a smooth displacement over the print, fitted to what was measured on it.

Half-size pixels as a function of millimetres on the print. Where measurements are few, a sheet is taken to have heights
over its plane, which move its points along the lines through the foot of the camera's perpendicular, and hardly to be
drawn out within it: an edge that is known across alone then tells of both directions. Source: P. H. C. Eilers and B. D.
Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from calibration.registration.lens import Lens

ROUGHNESS_PX = 0.2
"""Usual second difference of the displacement between knots: a wave of 2 px amplitude every 20 knots, or of 0.2 px
every 6. Where cells measure it, shorter waves are followed as well."""

MOST_ROUGHNESS_PX = 2.0
"""The same of a sheet that waves by 6 mm every 150 mm: rougher ones are refused, and not followed."""

_IN_PLANE_PX = 2.0
"""Usual displacement, half a field from its middle, by what is no height: a lens's distortion beyond Brown's, paper
that has grown in damp air (judgement)."""

_RIDGE = 1e-3
"""px⁻², on the diagonal: keeps knots that no measurement reaches solvable, and is nothing to a measured cell's."""

_DRAWS, _SEED = 32, 20
"""Draws from the posterior distribution: of 64 values a standard deviation is known to 9 %; always the same."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Displacement:
    """A smooth displacement over the print: tensor products of uniform cubic B-splines.

    - `origin_mm`, `knot_mm`: (2,) first knot and distance of knots in x and y.
    - `coefficients`: (rows, columns, 2) float64, half-size px (dx, dy).
    - `lens`: that by which heights are seen; None: any displacement is as likely as that of a height.
    - `heights`: (rows, columns) float64, half-size px that a height moves points by at the frame's corner; None without
      `lens`.
    """

    origin_mm: _Array
    knot_mm: _Array
    coefficients: _Array
    lens: Lens | None = None
    heights: _Array | None = None

    @classmethod
    def over(cls, low_mm: _Array, high_mm: _Array, knot_mm: float, lens: Lens | None = None) -> Displacement:
        """Return the displacement 0 over a rectangle between corners (2,) mm, with knots about `knot_mm` apart.

        With a lens it is that of heights.
        """
        spans = np.maximum(np.ceil((high_mm - low_mm) / knot_mm), 1).astype(int)
        shape = spans[1] + 3, spans[0] + 3
        heights = None if lens is None else np.zeros(shape)
        return cls(low_mm, (high_mm - low_mm) / spans, np.zeros((*shape, 2)), lens, heights)

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
        basis = self.basis(points_mm)
        moved = np.asarray(basis @ self.coefficients.reshape(-1, 2))
        if self.lens is None or self.heights is None:
            return moved
        return moved + np.asarray(basis @ self.heights.ravel())[:, None] * self.lens.parallax(points_mm)

    def fitted(
        self, points_mm: _Array, information: _Array, pull: _Array, roughness_px: float = ROUGHNESS_PX
    ) -> Displacement:
        """Return the smooth displacement most likely for measured places.

        Minimises ``Σ ½ dᵀ A d − pullᵀ d + ½ |second differences|² / roughness²``.

        `points_mm`: (N, 2) mm, where it was measured. `information`: (N, 2, 2) A: inverse covariance of each
        measurement, px⁻²; 0 where nothing was seen. `pull`: (N, 2) A times the measured displacement, px⁻¹.
        `roughness_px`: usual second difference between knots.
        """
        basis = self.basis(points_mm)
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        ways = self._ways(points_mm)
        right = np.concatenate([basis.T @ (way * pull).sum(axis=1) for way in ways])
        solution = np.asarray(sparse_linalg.spsolve(matrix, right)).reshape(len(ways), rows, columns)
        heights = None if self.lens is None else solution[2]
        return replace(self, coefficients=solution[:2].transpose(1, 2, 0), heights=heights)

    def errors_px(self, points_mm: _Array, information: _Array, at_mm: _Array) -> _Array:
        """Return the standard error (M,) float64 px of the displacement's length at places (M, 2) mm.

        From draws of the coefficients' posterior distribution, whose covariance is the inverse of the fit's matrix:
        each is the fit to data and roughness that scatter as they are taken to (G. Papandreou and A. L. Yuille,
        "Gaussian sampling by local perturbations", NIPS 2010). Where nothing is measured, the sheet is taken to be as
        rough as it is found elsewhere.

        `points_mm`: (N, 2) mm, where it was measured. `information`: (N, 2, 2) inverse covariance of each measurement,
        px⁻²; 0 where nothing was seen. `at_mm`: (M, 2) float64 mm, the places.
        """
        what = self._bending.reshape(*self.coefficients.shape[:2], -1)
        bends = [np.diff(what, 2, axis=axis) for axis in (0, 1)]
        roughness = max(ROUGHNESS_PX, *(float(np.sqrt((bend**2).mean())) for bend in bends))
        drawn = self._drawn(points_mm, information, roughness)
        wanted, ways = self.basis(at_mm), self._ways(at_mm)
        moved = np.zeros((len(at_mm), 2, _DRAWS))
        for part, way in zip(np.split(drawn, len(ways)), ways, strict=True):
            moved += way[:, :, None] * np.asarray(wanted @ part)[:, None]
        return np.sqrt((moved**2).sum(axis=1).mean(axis=1))

    def likely_roughness_px(self, points_mm: _Array, information: _Array, roughness_px: float) -> float:
        """Return the usual second difference between knots that the measurements make likely, `ROUGHNESS_PX` or more.

        What the fit bends, squared, over the number of bends that the measurements determine: one step of a fixed-point
        iteration (D. J. C. MacKay, "Bayesian interpolation", Neural Computation 1992).

        `points_mm`: (N, 2) float64 mm, where it was measured. `information`: (N, 2, 2) float64 px⁻², of the
        measurements to which this was fitted.
        """
        bending = _differences(*self.coefficients.shape[:2])
        what = self._bending
        drawn = self._drawn(points_mm, information, roughness_px)[-what.size :]
        parts = np.split(drawn, what.shape[1])
        open_px2 = sum(float((np.asarray(bending @ part) ** 2).sum()) for part in parts) / _DRAWS
        bent_px2 = float((np.asarray(bending @ what) ** 2).sum())
        determined = max(what.shape[1] * bending.shape[0] - open_px2 / roughness_px**2, 1.0)
        return float(np.clip(np.sqrt(bent_px2 / determined), ROUGHNESS_PX, MOST_ROUGHNESS_PX))

    @property
    def _bending(self) -> _Array:
        """What bends, coefficient by coefficient: (K, 1) heights, or without a lens (K, 2) both directions, px."""
        return self.coefficients.reshape(-1, 2) if self.heights is None else self.heights.reshape(-1, 1)

    def _ways(self, points_mm: _Array) -> list[_Array]:
        """Return into which direction (N, 2) each group of coefficients moves points (N, 2): x, y, and heights."""
        ways = [np.broadcast_to(way, points_mm.shape) for way in np.eye(2)]
        return ways if self.lens is None else [*ways, self.lens.parallax(points_mm)]

    def _roughnesses(self, roughness_px: float) -> list[float]:
        """Return the usual second difference between knots of each group of coefficients, px."""
        if self.lens is None:
            return [roughness_px] * 2
        # Independent bends add up to √(n³ / 3) times their size after n knots.
        knots = max(self.coefficients.shape[:2]) / 2
        in_plane = min(_IN_PLANE_PX * np.sqrt(3 / knots**3), roughness_px)
        return [in_plane, in_plane, roughness_px]

    def _drawn(self, points_mm: _Array, information: _Array, roughness_px: float) -> _Array:
        """Return draws (G K, draws) of the coefficients' posterior distribution about the fit, group after group."""
        random = np.random.Generator(np.random.SFC64(_SEED))
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        # What a measurement with this information would scatter by: its Cholesky factor times normal deviates.
        root = np.linalg.cholesky(information + 1e-9 * np.eye(2))
        scatter = np.einsum("nij,njs->nis", root, random.standard_normal((len(points_mm), 2, _DRAWS)))
        basis = self.basis(points_mm)
        ways = self._ways(points_mm)
        of_data = np.concatenate([basis.T @ np.einsum("ni,nis->ns", way, scatter) for way in ways])
        bending = _differences(rows, columns)
        of_sheet = [
            bending.T @ random.standard_normal((bending.shape[0], _DRAWS)) / roughness
            for roughness in self._roughnesses(roughness_px)
        ]
        of_ridge = np.sqrt(_RIDGE) * random.standard_normal((len(ways) * rows * columns, _DRAWS))
        right = of_data + np.concatenate(of_sheet) + of_ridge
        return np.asarray(sparse_linalg.splu(sparse.csc_matrix(matrix)).solve(right), dtype=np.float64)

    def _normal_matrix(self, points_mm: _Array, information: _Array, roughness_px: float) -> sparse.csc_array:
        """Return the matrix (G K, G K) of the normal equations, one of G groups after another, as for `fitted`."""
        basis = self.basis(points_mm)
        ways = self._ways(points_mm)
        weighted = [np.einsum("nij,nj->ni", information, way) for way in ways]
        blocks = [[basis.T @ sparse.diags_array((way * of).sum(axis=1)) @ basis for of in weighted] for way in ways]
        bending = _differences(*self.coefficients.shape[:2])
        for number, roughness in enumerate(self._roughnesses(roughness_px)):
            blocks[number][number] += bending.T @ bending / roughness**2 + sparse.identity(bending.shape[1]) * _RIDGE
        return sparse.csc_array(sparse.block_array(blocks))


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
