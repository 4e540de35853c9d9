"""The map from print to frame: a lens, how a wavy sheet departs from its plane, where red and blue lie beside green.

- `Lens`: a homography and Brown's distortion, fitted to places known on both (D. C. Brown, "Close-range camera
  calibration", 1971).
- `Displacement`: a smooth displacement over the print, fitted to what was measured on it. Where measurements are few, a
  sheet is taken to have heights over its plane, which move its points along the lines through the foot of the camera's
  perpendicular, and hardly to be drawn out within it: an edge that is known across alone then tells of both directions
  (P. H. C. Eilers and B. D. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996).
- `LateralColour`: red and blue lie a ρ + b ρ³ further out than green, at ρ of the way from the frame's middle to its
  corner. The linear term is the chromatic difference of magnification, the cubic one that of distortion (W. T. Welford,
  "Aberrations of Optical Systems", 1986, ch. 10). Measured with the cells' map: what a channel alone would move blocks
  of cells by, against what all channels together would.

Half-size pixels, pixel centres at integers, x right, y down; millimetres on the print.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt
from scipy import optimize, sparse
from scipy.sparse import linalg as sparse_linalg

from drivers.raw.rawfile import CHANNELS, Channel
from experiment.framing.homography import fit_homography, on_one_line, project
from foundation.errors import RegistrationError

# Pairs from which on all four coefficients are fitted, or the first: the corners of twelve tags and of four. Fewer do
# not determine them, and each would fit noise.
_PAIRS_FOR_ALL, _PAIRS_FOR_ONE = 48, 16

# Focal length over half the frame's diagonal, as it is taken to be: a tilt of 2° is then seen to move the foot of the
# camera's perpendicular by 3 to 5 % of the diagonal, where with lenses of 1.5 to .8 diagonals it moves by 5 to 3 %.
_FOCAL_RADII = 2.2

_STEP = 1e-3  # Of the distance, by which points leave the plane: small enough for a straight line

_ON_ONE_LINE = (
    "the marks of the chart that were found lie on one line, and marks spread over the sheet are expected; bring all "
    "of the chart into the frame, and uncover it"
)

# Usual second difference of the displacement between knots: a wave of 2 px amplitude every 20 knots, or of 0.2 px
# every 6. Where cells measure it, shorter waves are followed as well.
ROUGHNESS_PX = 0.2

# The same of a sheet that waves by 6 mm every 150 mm: rougher ones are refused, and not followed.
MOST_ROUGHNESS_PX = 2.0

# Usual displacement, half a field from its middle, by what is no height: a lens's distortion beyond Brown's, paper
# that has grown in damp air (judgement).
_IN_PLANE_PX = 2.0

# px⁻², on the diagonal: keeps knots that no measurement reaches solvable, and is nothing to a measured cell's.
_RIDGE = 1e-3

# Draws from the posterior distribution: of 64 values a standard deviation is known to 9 %; always the same.
_DRAWS, _SEED = 32, 20

_Array = npt.NDArray[np.float64]

# Shift at the frame's corner by which a term is taken to be 0 before it is measured: lenses have 0 to 1 px. It
# decides only under lights that leave a channel dark.
_USUAL_PX = 2.0

# Standard error of each term that no number of cells takes away: what the model of the colours leaves is alike over
# the frame (simulated frames: .003 to .009 px at the corner without aberration, .02 in a dim light).
_MODEL_PX = 0.01

# Reweighted least squares: blocks that are covered, or whose colours the model misses, end with little weight.
_ROUNDS = 4

_HUBER = 2.0  # Usual misfits beyond which a block counts less

_ONE_DIRECTION = 1e-9  # Share of the larger eigenvalue of an information below which the smaller is rounding, and none

_MEDIAN_CHI2 = 3.357  # Median of χ² with 4 degrees of freedom: two colours, two directions


@dataclass(frozen=True, eq=False)
class Lens:
    """A plane seen through a lens: homography, then Brown's radial and tangential distortion about the frame's middle.

    - `homography`: (3, 3) float64, millimetres to undistorted half-size px.
    - `centre_px`: (2,) middle of the frame.
    - `radius_px`: unit of distance for the coefficients: half the frame's diagonal.
    - `distortion`: (4,) k1, k2, p1, p2.
    """

    homography: _Array
    centre_px: _Array
    radius_px: float
    distortion: _Array

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return places (N, 2) float64 half-size px, x then y, of points (N, 2) mm on the print."""
        return self._bent((project(self.homography, points_mm) - self.centre_px) / self.radius_px)

    def _bent(self, undistorted: _Array) -> _Array:
        """Return places (N, 2) px of undistorted ones (N, 2) in units of the radius about the centre."""
        k1, k2, p1, p2 = self.distortion
        x, y = undistorted.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        seen = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        return seen * self.radius_px + self.centre_px

    def parallax(self, points_mm: npt.ArrayLike) -> _Array:
        """Return into which direction (N, 2) float64 points (N, 2) mm are seen to move when they leave the plane.

        Its length is 1 at half the frame's diagonal from the foot of the camera's perpendicular, and grows evenly from
        0 there: plane and parallax (R. Hartley and A. Zisserman, "Multiple View Geometry", 2nd edition, section 13.3).
        """
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        x, y = self.centre_px
        to_camera = np.array([[1, 0, -x], [0, 1, -y], [0, 0, _FOCAL_RADII * self.radius_px]])
        plane = to_camera @ self.homography
        normal = np.cross(plane[:, 0], plane[:, 1])
        # The plane's distance from the camera along its normal is the same at all its points.
        step = _STEP * (normal @ plane[:, 2]) / (normal @ normal) * normal
        places = np.column_stack([points, np.ones(len(points))]) @ plane.T
        before, after = (
            self._bent(_FOCAL_RADII * side[:, :2] / side[:, 2:]) for side in (places + step, places - step)
        )
        return (after - before) / (2 * _STEP * self.radius_px)


def fit_lens(
    points_mm: _Array, places_px: _Array, frame_size: tuple[int, int], normals: _Array | None = None
) -> tuple[Lens, _Array]:
    """Return the lens through point pairs and the residuals.

    Plain least squares first, then robust (soft L1 beyond 1 px): robust from the start it stops in a local minimum.

    `points_mm`, `places_px`: (N, 2) float64 pairs, mm and half-size px, N ≥ 8. `frame_size`: width and height of the
    frame, half-size px. `normals`: (N, 2) the directions in which places are known, if they lie on lines; None where
    they are points. Returns (N, 2) float64 residuals, seen minus fitted, px; along the normals if there are some.
    """
    centre = (np.array(frame_size, dtype=np.float64) - 1) / 2
    radius = float(np.hypot(*frame_size)) / 2
    free = 4 if len(points_mm) >= _PAIRS_FOR_ALL else 1 if len(points_mm) >= _PAIRS_FOR_ONE else 0
    if on_one_line(points_mm) or on_one_line(places_px):
        raise RegistrationError(_ON_ONE_LINE)
    middle, spread = points_mm.mean(axis=0), points_mm.std(axis=0).max()
    normal = np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])
    start = fit_homography((points_mm - middle) / spread, (places_px - centre) / radius)
    if start is None:
        raise RegistrationError(_ON_ONE_LINE)
    scale = np.array([[radius, 0, centre[0]], [0, radius, centre[1]], [0, 0, 1]])

    def lens(parameters: _Array) -> Lens:
        inner = np.append(parameters[:8], 1.0).reshape(3, 3)
        return Lens(scale @ inner @ normal, centre, radius, np.append(parameters[8:], np.zeros(4 - free)))

    def residuals(parameters: _Array) -> _Array:
        off = lens(parameters).to_pixels(points_mm) - places_px
        return off.ravel() if normals is None else np.asarray((off * normals).sum(axis=1))

    start = np.append((start / start[2, 2]).ravel()[:8], np.zeros(free))
    plain = optimize.least_squares(residuals, start, x_scale="jac")
    robust = optimize.least_squares(residuals, plain.x, loss="soft_l1", f_scale=1.0, x_scale="jac")
    found = lens(np.asarray(robust.x))
    left = places_px - found.to_pixels(points_mm)
    return found, left if normals is None else (left * normals).sum(axis=1, keepdims=True) * normals


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
        groups = range(len(ways))
        # Each is its own transpose, and that of one group and another is that of the other and the one.
        upper = {
            (one, other): basis.T @ sparse.diags_array((ways[one] * weighted[other]).sum(axis=1)) @ basis
            for one, other in combinations_with_replacement(groups, 2)
        }
        bending = _differences(*self.coefficients.shape[:2])
        stiffness, ridge = bending.T @ bending, sparse.identity(bending.shape[1]) * _RIDGE
        for number, roughness in enumerate(self._roughnesses(roughness_px)):
            upper[number, number] += stiffness / roughness**2 + ridge
        blocks = [[upper[min(one, other), max(one, other)] for other in groups] for one in groups]
        return sparse.csc_array(sparse.block_array(blocks))


def _cubic_weights(t: _Array) -> _Array:
    """Return the four uniform cubic B-spline weights (..., 4) at t in [0, 1] of a span."""
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6


@lru_cache(maxsize=4)
def _differences(rows: int, columns: int) -> sparse.csr_array:
    """Return all second differences (D, K) on a grid of coefficients: yy, then xx, then √2 times xy; not to be written.

    A registration asks for those of one grid dozens of times.
    """

    def difference(n: int, order: int) -> sparse.csr_array:
        matrix = sparse.eye_array(n, format="csr")
        for _ in range(order):
            matrix = matrix[1:] - matrix[:-1]
        return sparse.csr_array(matrix)

    whole = [sparse.eye_array(n, format="csr") for n in (rows, columns)]
    xy = sparse.kron(difference(rows, 1), difference(columns, 1)) * np.sqrt(2)
    parts = (sparse.kron(whole[0], difference(columns, 2)), sparse.kron(difference(rows, 2), whole[1]), xy)
    return sparse.csr_array(sparse.vstack([sparse.csr_array(part) for part in parts]))


@dataclass(frozen=True, eq=False)
class LateralColour:
    """How far out red and blue lie against green.

    - `centre_px`: (2,) float64, the frame's middle.
    - `terms_px`: (2, 2) float64, of red and of blue: the linear and the cubic term at the frame's corner. Zeros until
      measured.
    - `covariance_px2`: (4, 4) float64 of `terms_px`, row by row.
    """

    centre_px: _Array
    radius_px: float
    terms_px: _Array
    covariance_px2: _Array

    @classmethod
    def unmeasured(cls, frame_size: tuple[int, int]) -> LateralColour:
        """Return none at all, as uncertain as a lens is before it is seen; `frame_size` is width and height."""
        size = np.array(frame_size, dtype=np.float64)
        return cls((size - 1) / 2, float(np.hypot(*size)) / 2, np.zeros((2, 2)), np.eye(4) * _USUAL_PX**2)

    def shift_px(self, places_px: _Array, channel: Channel) -> _Array:
        """Return how far out (N, 2) float64 px the channel sees what green sees at places (N, 2)."""
        if channel == "G":
            return np.zeros_like(places_px)
        linear, cubic = self.terms_px[0 if channel == "R" else 1]
        away = (places_px - self.centre_px) / self.radius_px
        return away * (linear + cubic * (away**2).sum(axis=-1, keepdims=True))

    def seen_px(self, places_px: _Array) -> _Array:
        """Return where red, green and blue see what green sees at places (N, 2) px, (3, N, 2) float64 px."""
        return np.stack([places_px + self.shift_px(places_px, channel) for channel in CHANNELS])

    def corner_px(self, channel: Channel) -> float:
        """Return the shift at the frame's corner, half-size px, outwards positive."""
        return 0.0 if channel == "G" else float(self.terms_px[0 if channel == "R" else 1].sum())

    def corner_error_px(self, channel: Channel) -> float:
        """Return the standard error of `corner_px`; that of a lens never seen where the channel is dark."""
        if channel == "G":
            return 0.0
        own = slice(0, 2) if channel == "R" else slice(2, 4)
        return float(np.sqrt(self.covariance_px2[own, own].sum()))

    def remeasured(self, places_px: _Array, information: _Array, pull: _Array) -> LateralColour:
        """Return the shifts most likely once blocks were compared channel by channel.

        Whatever all channels share, block by block, is left to the map: it is eliminated, not assumed.

        `places_px`: (B, 2) float64, the blocks' middles. `information`: (3, B, 2, 2) float64 px⁻², of red, green and
        blue: inverse covariance of the displacement that each alone measures; 0 where nothing was seen. `pull`: (3, B,
        2) float64 px⁻¹, information times that displacement, from where the channels are taken to be now.
        """
        total: _Array = information.sum(axis=0)
        # What one colour alone shows says nothing of others.
        seen = (np.trace(information, axis1=2, axis2=3) > 0).sum(axis=0) > 1
        if not seen.any():
            return self
        places, own, by = places_px[seen], information[:, seen], pull[:, seen]
        # A point of an edge is known across it alone.
        inverse = np.asarray(np.linalg.pinv(total[seen], rcond=_ONE_DIRECTION, hermitian=True), dtype=np.float64)
        away = (places - self.centre_px) / self.radius_px
        design = np.stack([away, away * (away**2).sum(axis=1, keepdims=True)], axis=-1)
        colours = [CHANNELS.index("R"), CHANNELS.index("B")]
        # Of red and blue what is left of their information when the map is free: a Schur complement.
        left = np.empty((len(places), 2, 2, 2, 2))
        for i, one in enumerate(colours):
            for j, other in enumerate(colours):
                left[:, i, j] = -np.einsum("nij,njk,nkl->nil", own[one], inverse, own[other])
            left[:, i, i] += own[one]
        free: _Array = np.einsum("nij,nj->ni", inverse, by.sum(axis=0))
        right = np.stack([by[one] - np.einsum("nij,nj->ni", own[one], free) for one in colours], axis=1)
        # Misfits are judged by what is left of them in units of their own error.
        spread = np.linalg.pinv(left.transpose(0, 1, 3, 2, 4).reshape(-1, 4, 4), hermitian=True)
        weight, scale = np.ones(len(places)), 1.0
        terms = before = self.terms_px.ravel()
        covariance = self.covariance_px2
        for _ in range(_ROUNDS):
            normal: _Array = np.einsum("n,nip,nabij,njq->apbq", weight, design, left, design).reshape(4, 4) / scale
            towards: _Array = np.einsum("n,nip,nai->ap", weight, design, right).ravel() / scale
            prior = np.eye(4) / _USUAL_PX**2
            covariance = np.linalg.inv(normal + prior)
            step = covariance @ (towards - prior @ before)
            terms = before + step
            moved: _Array = np.einsum("nip,ap->nai", design, step.reshape(2, 2))
            explained: _Array = np.einsum("nabij,nbj->nai", left, moved)
            misfit = (right - explained).reshape(-1, 4)
            chi2: _Array = np.einsum("ni,nij,nj->n", misfit, spread, misfit)
            scale = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
            weight = np.minimum(1.0, _HUBER * np.sqrt(4 * scale / np.maximum(chi2, 1e-9)))
        return replace(self, terms_px=terms.reshape(2, 2), covariance_px2=covariance + np.eye(4) * _MODEL_PX**2)
