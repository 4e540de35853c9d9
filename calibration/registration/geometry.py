"""Map points on the print to the frame: lens, displacement of the sheet, and lateral colour.

- `Lens`: homography and Brown's distortion (D. C. Brown, "Close-range camera calibration", 1971).
- `Displacement`: penalised tensor-product B-splines over the print (P. H. C. Eilers and B. D. Marx, "Flexible smoothing
  with B-splines and penalties", Statistical Science 1996). For a chart without tags, most of the displacement is
  modelled as height of the sheet above its plane. Height moves a point along a known line in the frame, so one measured
  component determines the other.
- `LateralColour`: red and blue lie a ρ + b ρ³ further out than green, where ρ is the distance from the frame centre, 1
  at the corner. The linear term is the chromatic difference of magnification, the cubic term the chromatic difference
  of distortion (W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 10).

Functions receive a measured displacement d as two arrays: its inverse covariance A (`information`) and A d (`pull`).
Positions are half-size pixels with pixel centres at integers, x right, y down; points on the print are millimetres.
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

# Minimum number of point pairs for fitting all four distortion coefficients (corners of twelve tags), or only the first
# coefficient (four tags). With fewer pairs the coefficients would fit noise.
_PAIRS_FOR_ALL, _PAIRS_FOR_ONE = 48, 16

# Assumed focal length of the camera lens, in half diagonals of the frame. `parallax` depends little on it.
_FOCAL_RADII = 2.2

# Height difference for the numerical derivative in `parallax`, relative to the camera distance.
_HEIGHT_STEP = 1e-3

_COLLINEAR_MARKS_MESSAGE = (
    "the detected marks of the chart lie on one line, expected marks all over the sheet; bring the whole chart "
    "into the frame, and uncover it"
)

# Prior standard deviation of the second differences of the spline coefficients. It allows a wave of 2 px amplitude
# over 20 knots.
ROUGHNESS_PX = 0.2

# Prior standard deviation for the roughest accepted sheet: waves of 6 mm with a period of 150 mm.
MAX_ROUGHNESS_PX = 2.0

# Prior standard deviation of the in-plane displacement of the sheet's edge relative to its centre. Causes are lens
# distortion beyond Brown's model, and paper expanded by humidity. Chosen by judgement.
_IN_PLANE_PX = 2.0

# Added to the diagonal of the normal matrix, px⁻². It makes the matrix regular at knots without measurements.
_RIDGE = 1e-3

# Number of draws from the posterior distribution, and seed. The standard deviation of a position is accurate to 9 %.
_DRAWS, _SEED = 32, 20

_Array = npt.NDArray[np.float64]

# Prior standard deviation of each term of the lateral colour, at the frame corner; lenses have 0 to 1 px. The prior
# only matters if a channel receives no light.
_TERM_PRIOR_PX = 2.0

# Systematic standard uncertainty of each term, at the frame corner (simulated frames). It is caused by errors of the
# colour model, which are the same in all blocks.
_SYSTEMATIC_PX = 0.01

# Rounds of reweighted least squares. Covered blocks and blocks with colour errors get a low weight.
_REWEIGHTING_ROUNDS = 4

_HUBER = 2.0  # Misfit, in standard deviations, above which the weight of a block decreases

# Smallest ratio of the eigenvalues of an information matrix. A smaller eigenvalue is a rounding error and set to zero.
_MIN_EIGEN_RATIO = 1e-9

_MEDIAN_CHI2 = 3.357  # Median of χ² with 4 degrees of freedom: two colours, two directions


@dataclass(frozen=True, eq=False)
class Lens:
    """Image of a plane through a lens: homography, then Brown's radial and tangential distortion."""

    homography: _Array  # (3, 3) mm to undistorted half-size px
    centre_px: _Array  # (2,) centre of the frame
    radius_px: float  # half the frame diagonal, the unit of length of `distortion`
    distortion: _Array  # (4,) k1, k2, p1, p2

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Map points (N, 2) mm on the print to positions (N, 2) float64 in half-size px, x then y."""
        return self._distort((project(self.homography, points_mm) - self.centre_px) / self.radius_px)

    def _distort(self, undistorted: _Array) -> _Array:
        k1, k2, p1, p2 = self.distortion
        x, y = undistorted.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        distorted = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        return distorted * self.radius_px + self.centre_px

    def parallax(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the relative movement (N, 2) float64 of the images of points (N, 2) mm that rise above the plane.

        Points move away from the foot of the perpendicular from the camera to the plane. The movement is proportional
        to the distance from the foot, and scaled to 1 at a distance of half the frame diagonal.
        Source: plane and parallax (R. Hartley and A. Zisserman, "Multiple View Geometry", 2nd edition, section 13.3).
        """
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        x, y = self.centre_px
        to_camera = np.array([[1, 0, -x], [0, 1, -y], [0, 0, _FOCAL_RADII * self.radius_px]])
        plane = to_camera @ self.homography
        normal = np.cross(plane[:, 0], plane[:, 1])
        # Along the normal, all points of the plane have the same distance from the camera.
        step = _HEIGHT_STEP * (normal @ plane[:, 2]) / (normal @ normal) * normal
        plane_points = np.column_stack([points, np.ones(len(points))]) @ plane.T
        raised_px, lowered_px = (
            self._distort(_FOCAL_RADII * moved_points[:, :2] / moved_points[:, 2:])
            for moved_points in (plane_points + step, plane_points - step)
        )
        return (lowered_px - raised_px) / (2 * _HEIGHT_STEP * self.radius_px)


def fit_lens(
    points_mm: _Array, positions_px: _Array, frame_size: tuple[int, int], normals: _Array | None = None
) -> tuple[Lens, _Array]:
    """Fit homography and distortion to pairs of points.

    Parameters
    ----------
    points_mm, positions_px : (N, 2) float64
        Pairs in mm and half-size px, N ≥ 8.
    frame_size : (int, int)
        Width and height in half-size px.
    normals : (N, 2) float64, optional
        Unit vectors across the edges, if the points lie on edges. Only the component along the normal is then used.

    Returns
    -------
    Lens
    (N, 2) float64
        Residuals, measured minus fitted, px; along the normals if given.
    """
    centre = (np.array(frame_size, dtype=np.float64) - 1) / 2
    radius = float(np.hypot(*frame_size)) / 2
    free_count = 4 if len(points_mm) >= _PAIRS_FOR_ALL else 1 if len(points_mm) >= _PAIRS_FOR_ONE else 0
    if on_one_line(points_mm) or on_one_line(positions_px):
        raise RegistrationError(_COLLINEAR_MARKS_MESSAGE)
    middle, extent = points_mm.mean(axis=0), points_mm.std(axis=0).max()
    normalise = np.array([[1 / extent, 0, -middle[0] / extent], [0, 1 / extent, -middle[1] / extent], [0, 0, 1]])
    start = fit_homography((points_mm - middle) / extent, (positions_px - centre) / radius)
    if start is None:
        raise RegistrationError(_COLLINEAR_MARKS_MESSAGE)
    denormalise = np.array([[radius, 0, centre[0]], [0, radius, centre[1]], [0, 0, 1]])

    def lens(parameters: _Array) -> Lens:
        inner = np.append(parameters[:8], 1.0).reshape(3, 3)
        return Lens(
            denormalise @ inner @ normalise, centre, radius, np.append(parameters[8:], np.zeros(4 - free_count))
        )

    def residuals(parameters: _Array) -> _Array:
        difference = lens(parameters).to_pixels(points_mm) - positions_px
        return difference.ravel() if normals is None else np.asarray((difference * normals).sum(axis=1))

    start = np.append((start / start[2, 2]).ravel()[:8], np.zeros(free_count))
    # A robust fit (soft L1 beyond 1 px) stops in a local minimum if it does not start from plain least squares.
    plain = optimize.least_squares(residuals, start, x_scale="jac")
    robust = optimize.least_squares(residuals, plain.x, loss="soft_l1", f_scale=1.0, x_scale="jac")
    fitted = lens(np.asarray(robust.x))
    residual = positions_px - fitted.to_pixels(points_mm)
    return fitted, residual if normals is None else (residual * normals).sum(axis=1, keepdims=True) * normals


@dataclass(frozen=True, eq=False)
class Displacement:
    """Smooth displacement over the print: tensor products of uniform cubic B-splines."""

    origin_mm: _Array  # (2,) first knot
    knot_mm: _Array  # (2,) distance of knots in x and y
    coefficients: _Array  # (rows, columns, 2) half-size px (dx, dy)
    lens: Lens | None = None  # maps heights to the frame; None: displacement without heights
    # (rows, columns) heights; unit: the height that moves a point by 1 half-size px where `Lens.parallax` is 1
    heights: _Array | None = None

    @classmethod
    def over(cls, low_mm: _Array, high_mm: _Array, knot_mm: float, lens: Lens | None = None) -> Displacement:
        """Return a zero displacement over a rectangle with corners (2,) mm; knots are about `knot_mm` apart.

        With `lens`, the displacement includes heights of the sheet.
        """
        spans = np.maximum(np.ceil((high_mm - low_mm) / knot_mm), 1).astype(int)
        shape = spans[1] + 3, spans[0] + 3
        heights = None if lens is None else np.zeros(shape)
        return cls(low_mm, (high_mm - low_mm) / spans, np.zeros((*shape, 2)), lens, heights)

    def basis(self, points_mm: npt.ArrayLike) -> sparse.csr_array:
        """Return the values (N, K) float64 of the splines at points (N, 2) mm; outside, they are extrapolated."""
        rows, columns = self.coefficients.shape[:2]
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        knot_position = (points - self.origin_mm) / self.knot_mm
        first = np.clip(np.floor(knot_position).astype(int), 0, (columns - 4, rows - 4))
        weights = _cubic_weights(knot_position - first)
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
        """Return the most likely smooth displacement for measured positions.

        Minimises ``Σ ½ dᵀ A d − pullᵀ d + ½ |second differences|² / roughness²``.

        `points_mm`: (N, 2), measured points. `information`: (N, 2, 2) A, px⁻²; 0 without a measurement. `pull`: (N, 2),
        px⁻¹. `roughness_px`: prior standard deviation of second differences.
        """
        basis = self.basis(points_mm)
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        directions = self._directions(points_mm)
        right = np.concatenate([basis.T @ (direction * pull).sum(axis=1) for direction in directions])
        solution = np.asarray(sparse_linalg.spsolve(matrix, right)).reshape(len(directions), rows, columns)
        heights = None if self.lens is None else solution[2]
        return replace(self, coefficients=solution[:2].transpose(1, 2, 0), heights=heights)

    def errors_px(self, points_mm: _Array, information: _Array, at_mm: _Array) -> _Array:
        """Return the standard uncertainty (M,) float64, px, of the displacement at points `at_mm` (M, 2)."""
        penalised = self._shape_coefficients.reshape(*self.coefficients.shape[:2], -1)
        bends = [np.diff(penalised, 2, axis=axis) for axis in (0, 1)]
        # Areas without measurements are assumed to be as rough as the measured areas.
        roughness = max(ROUGHNESS_PX, *(float(np.sqrt((bend**2).mean())) for bend in bends))
        # Each draw is a fit to simulated noise of the data and of the prior. The covariance of the draws is the inverse
        # of the normal matrix (G. Papandreou and A. L. Yuille, "Gaussian sampling by local perturbations", NIPS 2010).
        drawn = self._draw_deviations(points_mm, information, roughness)
        basis, directions = self.basis(at_mm), self._directions(at_mm)
        moved = np.zeros((len(at_mm), 2, _DRAWS))
        for draws, direction in zip(np.split(drawn, len(directions)), directions, strict=True):
            moved += direction[:, :, None] * np.asarray(basis @ draws)[:, None]
        return np.sqrt((moved**2).sum(axis=1).mean(axis=1))

    def likely_roughness_px(self, points_mm: _Array, information: _Array, roughness_px: float) -> float:
        """Return the most likely standard deviation of second differences, `ROUGHNESS_PX` to `MAX_ROUGHNESS_PX`.

        One step of a fixed-point iteration (D. J. C. MacKay, "Bayesian interpolation", Neural Computation 1992): the
        sum of squared second differences, divided by the number of second differences that the data determine.
        """
        bending = _differences(*self.coefficients.shape[:2])
        penalised = self._shape_coefficients
        drawn = self._draw_deviations(points_mm, information, roughness_px)[-penalised.size :]
        groups = np.split(drawn, penalised.shape[1])
        undetermined_px2 = sum(float((np.asarray(bending @ draws) ** 2).sum()) for draws in groups) / _DRAWS
        fitted_px2 = float((np.asarray(bending @ penalised) ** 2).sum())
        determined = max(penalised.shape[1] * bending.shape[0] - undetermined_px2 / roughness_px**2, 1.0)
        return float(np.clip(np.sqrt(fitted_px2 / determined), ROUGHNESS_PX, MAX_ROUGHNESS_PX))

    @property
    def _shape_coefficients(self) -> _Array:
        """Coefficients for the shape of the sheet, px: (K, 1) heights, or without a lens (K, 2) displacements."""
        return self.coefficients.reshape(-1, 2) if self.heights is None else self.heights.reshape(-1, 1)

    def _directions(self, points_mm: _Array) -> list[_Array]:
        directions = [np.broadcast_to(direction, points_mm.shape) for direction in np.eye(2)]
        return directions if self.lens is None else [*directions, self.lens.parallax(points_mm)]

    def _roughness_by_group(self, roughness_px: float) -> list[float]:
        if self.lens is None:
            return [roughness_px] * 2
        # Over n knots, independent second differences of 1 px add up to a displacement of √(n³ / 3) px.
        knots = max(self.coefficients.shape[:2]) / 2
        in_plane = min(_IN_PLANE_PX * np.sqrt(3 / knots**3), roughness_px)
        return [in_plane, in_plane, roughness_px]

    def _draw_deviations(self, points_mm: _Array, information: _Array, roughness_px: float) -> _Array:
        """Draw random deviations of all coefficients, (G K, draws), from their posterior distribution.

        The G groups of coefficients are x, y and, with a lens, height.
        """
        random = np.random.Generator(np.random.SFC64(_SEED))
        rows, columns = self.coefficients.shape[:2]
        matrix = self._normal_matrix(points_mm, information, roughness_px)
        # Simulated noise of the measurements: Cholesky factor of the information times normal deviates.
        root = np.linalg.cholesky(information + 1e-9 * np.eye(2))
        scatter = np.einsum("nij,njs->nis", root, random.standard_normal((len(points_mm), 2, _DRAWS)))
        basis = self.basis(points_mm)
        directions = self._directions(points_mm)
        data_term = np.concatenate([basis.T @ np.einsum("ni,nis->ns", direction, scatter) for direction in directions])
        bending = _differences(rows, columns)
        roughness_term = [
            bending.T @ random.standard_normal((bending.shape[0], _DRAWS)) / roughness
            for roughness in self._roughness_by_group(roughness_px)
        ]
        ridge_term = np.sqrt(_RIDGE) * random.standard_normal((len(directions) * rows * columns, _DRAWS))
        right = data_term + np.concatenate(roughness_term) + ridge_term
        return np.asarray(sparse_linalg.splu(sparse.csc_matrix(matrix)).solve(right), dtype=np.float64)

    def _normal_matrix(self, points_mm: _Array, information: _Array, roughness_px: float) -> sparse.csc_array:
        basis = self.basis(points_mm)
        directions = self._directions(points_mm)
        weighted = [np.einsum("nij,nj->ni", information, direction) for direction in directions]
        groups = range(len(directions))
        # Each block is symmetric, and block (i, j) is equal to block (j, i).
        upper = {
            (row, column): basis.T @ sparse.diags_array((directions[row] * weighted[column]).sum(axis=1)) @ basis
            for row, column in combinations_with_replacement(groups, 2)
        }
        bending = _differences(*self.coefficients.shape[:2])
        stiffness, ridge = bending.T @ bending, sparse.identity(bending.shape[1]) * _RIDGE
        for number, roughness in enumerate(self._roughness_by_group(roughness_px)):
            upper[number, number] += stiffness / roughness**2 + ridge
        blocks = [[upper[min(row, column), max(row, column)] for column in groups] for row in groups]
        return sparse.csc_array(sparse.block_array(blocks))


def _cubic_weights(t: _Array) -> _Array:
    # Weights of the four uniform cubic B-splines at position t, 0 … 1, between two knots.
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6


# Matrix of all second differences on the grid: xx, yy, then √2 times xy. The result is cached; do not modify it.
@lru_cache(maxsize=4)
def _differences(rows: int, columns: int) -> sparse.csr_array:
    def difference(n: int, order: int) -> sparse.csr_array:
        matrix = sparse.eye_array(n, format="csr")
        for _ in range(order):
            matrix = matrix[1:] - matrix[:-1]
        return sparse.csr_array(matrix)

    identity = [sparse.eye_array(n, format="csr") for n in (rows, columns)]
    xy = sparse.kron(difference(rows, 1), difference(columns, 1)) * np.sqrt(2)
    matrices = (sparse.kron(identity[0], difference(columns, 2)), sparse.kron(difference(rows, 2), identity[1]), xy)
    return sparse.csr_array(sparse.vstack([sparse.csr_array(kron) for kron in matrices]))


@dataclass(frozen=True, eq=False)
class LateralColour:
    """Radial shifts of red and blue against green."""

    centre_px: _Array  # (2,) centre of the frame
    radius_px: float  # half the frame diagonal
    terms_px: _Array  # (2, 2) red and blue: linear and cubic term at the frame corner
    covariance_px2: _Array  # (4, 4) of `terms_px`, row by row

    @classmethod
    def unmeasured(cls, frame_size: tuple[int, int]) -> LateralColour:
        """Return zero shifts with the prior uncertainty; `frame_size` is width and height."""
        size = np.array(frame_size, dtype=np.float64)
        return cls((size - 1) / 2, float(np.hypot(*size)) / 2, np.zeros((2, 2)), np.eye(4) * _TERM_PRIOR_PX**2)

    def shift_px(self, positions_px: _Array, channel: Channel) -> _Array:
        """Return the outward shift (N, 2) float64 px of a channel at positions (N, 2) px of green."""
        if channel == "G":
            return np.zeros_like(positions_px)
        linear, cubic = self.terms_px[0 if channel == "R" else 1]
        offset = (positions_px - self.centre_px) / self.radius_px
        return offset * (linear + cubic * (offset**2).sum(axis=-1, keepdims=True))

    def channels_px(self, positions_px: _Array) -> _Array:
        """Return positions (3, N, 2) float64 px of red, green and blue for positions (N, 2) px of green."""
        return np.stack([positions_px + self.shift_px(positions_px, channel) for channel in CHANNELS])

    def corner_px(self, channel: Channel) -> float:
        """Return the shift at the frame corner, half-size px, positive outwards."""
        return 0.0 if channel == "G" else float(self.terms_px[0 if channel == "R" else 1].sum())

    def corner_error_px(self, channel: Channel) -> float:
        """Return the standard uncertainty of `corner_px`; the prior value if the channel is dark."""
        if channel == "G":
            return 0.0
        terms = slice(0, 2) if channel == "R" else slice(2, 4)
        return float(np.sqrt(self.covariance_px2[terms, terms].sum()))

    def remeasured(self, positions_px: _Array, information: _Array, pull: _Array) -> LateralColour:
        """Return the most likely shifts after a comparison of blocks in each channel.

        `positions_px`: (B, 2) float64, centres of the blocks. `information`: (3, B, 2, 2) float64 px⁻²
        and `pull`: (3, B, 2) float64 px⁻¹, of each channel's displacement from the position that these shifts predict;
        0 without a measurement.
        """
        # A displacement common to all channels is no lateral colour and is eliminated from each block.
        total: _Array = information.sum(axis=0)
        # A shift between channels can only be measured if at least two channels are measured.
        is_used = (np.trace(information, axis1=2, axis2=3) > 0).sum(axis=0) > 1
        if not is_used.any():
            return self
        positions, precisions, pulls = positions_px[is_used], information[:, is_used], pull[:, is_used]
        # The matrix may be singular, because the position of an edge point is only measured across the edge.
        inverse = np.asarray(np.linalg.pinv(total[is_used], rcond=_MIN_EIGEN_RATIO, hermitian=True), dtype=np.float64)
        offset = (positions - self.centre_px) / self.radius_px
        design = np.stack([offset, offset * (offset**2).sum(axis=1, keepdims=True)], axis=-1)
        colours = [CHANNELS.index("R"), CHANNELS.index("B")]
        # Information of red and blue after the elimination (Schur complement).
        reduced = np.empty((len(positions), 2, 2, 2, 2))
        for i, row in enumerate(colours):
            for j, column in enumerate(colours):
                reduced[:, i, j] = -np.einsum("nij,njk,nkl->nil", precisions[row], inverse, precisions[column])
            reduced[:, i, i] += precisions[row]
        common: _Array = np.einsum("nij,nj->ni", inverse, pulls.sum(axis=0))
        reduced_pull = np.stack(
            [pulls[row] - np.einsum("nij,nj->ni", precisions[row], common) for row in colours], axis=1
        )
        # Inverse covariance of the misfits, for χ².
        misfit_precision = np.linalg.pinv(reduced.transpose(0, 1, 3, 2, 4).reshape(-1, 4, 4), hermitian=True)
        weight, scale = np.ones(len(positions)), 1.0
        terms = start = self.terms_px.ravel()
        covariance = self.covariance_px2
        for _ in range(_REWEIGHTING_ROUNDS):
            normal: _Array = np.einsum("n,nip,nabij,njq->apbq", weight, design, reduced, design).reshape(4, 4) / scale
            gradient: _Array = np.einsum("n,nip,nai->ap", weight, design, reduced_pull).ravel() / scale
            prior = np.eye(4) / _TERM_PRIOR_PX**2
            covariance = np.linalg.inv(normal + prior)
            step = covariance @ (gradient - prior @ start)
            terms = start + step
            shift: _Array = np.einsum("nip,ap->nai", design, step.reshape(2, 2))
            fitted: _Array = np.einsum("nabij,nbj->nai", reduced, shift)
            misfit = (reduced_pull - fitted).reshape(-1, 4)
            chi2: _Array = np.einsum("ni,nij,nj->n", misfit, misfit_precision, misfit)
            scale = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)
            weight = np.minimum(1.0, _HUBER * np.sqrt(4 * scale / np.maximum(chi2, 1e-9)))
        return replace(self, terms_px=terms.reshape(2, 2), covariance_px2=covariance + np.eye(4) * _SYSTEMATIC_PX**2)
