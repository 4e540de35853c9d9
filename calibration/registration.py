"""Where every point of the print lies in a frame: tags first, then the cells themselves.

Laws that hold inside:

- Tags give a homography and Brown's distortion and nothing finer: 35 of them cannot sample a wavy sheet. The local
  part is measured on the cells: the frame is rectified to the print, compared with the print's colours as the camera
  sees them (a colour model fitted on the frame itself), and a smooth displacement is fitted to what does not coincide.
- All colours are used, each in its own place: red and blue photosites lie a quarter pixel beside the blocks' centres.
- The result judges itself. A registration that cannot be trusted is a `RegistrationError`, never a value.

Places are half-size pixels, pixel centres at integers; millimetres on the print. Sources: D. C. Brown, "Close-range
camera calibration", 1971; B. D. Lucas and T. Kanade, "An iterative image registration technique", IJCAI 1981;
P. H. C. Eilers and B. D. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 1996.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage, optimize, sparse
from scipy.sparse import linalg as sparse_linalg
from scipy.spatial import cKDTree

from acquisition.chart import Chart, Tag
from acquisition.framing import (
    CHANNELS,
    Framing,
    Plane,
    blur_px,
    find_chart,
    fit_homography,
    frame_black,
    plane_of,
    project,
    rms,
)
from calibration.fitting import least_squares
from drivers.errors import RegistrationError
from drivers.rawfile import Mosaic

SAMPLE_REACH_PX = 3.25
"""From a cell's true centre to the outer edge of its 25 pixels: 2.5, rounding 0.5, registration 0.25."""

MIN_CELL_PX = 8.0
"""Half-size pixels a cell must have for 25 of them to lie safely inside; 8.6 already bleeds 1 % at σ = 0.7."""

MAX_TAG_RESIDUAL_PX = 8.0
"""RMS of the tags against homography and distortion; 2.3 is a sheet that waves by 6 mm and curls by 10."""

MIN_AGREEMENT = 0.8
"""Least correlation of the cells' colours with those predicted; another order of cells gives about 0."""

MIN_BLOCK_SCORE = 0.5
MIN_GOOD_BLOCKS = 0.75
MAX_BLOCK_RESIDUAL_PX = 0.5

_COARSE_CELLS = 10
_BLOCK_CELLS = 8
_KNOT_CELLS = 5
_COARSE_PER_CELL = 5
_COLOUR_PATCHES = 5000
_GAUSS_NEWTON_STEPS = 5
_TAG_SIGMA_PX = 0.15
_LEAST_INFORMATION = 4.0
"""px⁻²: a block that knows its place no better than half a pixel says nothing."""

_STRANGE_SIGMA = 10.0
_NEIGHBOURS = 13
"""A cell and the twelve within two cells of it."""

_STRANGE_NEIGHBOURS = 0.35
_STRANGE_SHARE = 0.08
"""Of paper white: the model's own errors at the gamut's corners stay below."""

_ROUGHNESS_PX = 0.1
"""Second difference of the displacement between knots that is thought usual: a wave of 2 px every 30 knots."""

_Float = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]
_ToPixels = Callable[[_Array], _Array]


@dataclass(frozen=True, eq=False)
class Lens:
    """A plane seen through a lens: homography, then Brown's radial and tangential distortion about the frame's middle.

    Attributes
    ----------
    homography
        (3, 3) float64, millimetres to undistorted half-size px.
    centre_px
        (2,) middle of the frame.
    radius_px
        Unit of distance for the coefficients: half the frame's diagonal.
    distortion
        (4,) k1, k2, p1, p2.
    """

    homography: _Array
    centre_px: _Array
    radius_px: float
    distortion: _Array

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return places (N, 2) of points (N, 2) on the print."""
        k1, k2, p1, p2 = self.distortion
        x, y = ((project(self.homography, points_mm) - self.centre_px) / self.radius_px).T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        seen = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        return seen * self.radius_px + self.centre_px


def fit_lens(points_mm: _Array, places_px: _Array, frame_size: tuple[int, int]) -> tuple[Lens, _Array]:
    """Return the lens through point pairs and the residuals.

    Plain least squares first, then robustly: robust from the start it sticks far off.

    Parameters
    ----------
    points_mm, places_px
        (N, 2) pairs, N ≥ 8.
    frame_size
        Width and height of the frame, half-size px.

    Returns
    -------
    Lens, ndarray
        (N, 2) float64 residuals, seen minus fitted, px.
    """
    centre = (np.array(frame_size, dtype=np.float64) - 1) / 2
    radius = float(np.hypot(*frame_size)) / 2
    # Few tags cannot tell the coefficients apart; each is given up where it would only fit noise.
    free = 4 if len(points_mm) >= 48 else 1 if len(points_mm) >= 16 else 0
    middle, spread = points_mm.mean(axis=0), points_mm.std(axis=0).max()
    normal = np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])
    start = fit_homography((points_mm - middle) / spread, (places_px - centre) / radius)
    if start is None:
        raise RegistrationError("the tags lie on one line; bring more of the chart into the frame")
    scale = np.array([[radius, 0, centre[0]], [0, radius, centre[1]], [0, 0, 1]])

    def lens(parameters: _Array) -> Lens:
        inner = np.append(parameters[:8], 1.0).reshape(3, 3)
        return Lens(scale @ inner @ normal, centre, radius, np.append(parameters[8:], np.zeros(4 - free)))

    def residuals(parameters: _Array) -> _Array:
        return (lens(parameters).to_pixels(points_mm) - places_px).ravel()

    start = np.append((start / start[2, 2]).ravel()[:8], np.zeros(free))
    plain = optimize.least_squares(residuals, start, x_scale="jac")
    robust = optimize.least_squares(residuals, plain.x, loss="soft_l1", f_scale=1.0, x_scale="jac")
    found = lens(np.asarray(robust.x))
    return found, places_px - found.to_pixels(points_mm)


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
        """Return the displacement zero over a rectangle, with knots about `knot_mm` apart."""
        spans = np.maximum(np.ceil((high_mm - low_mm) / knot_mm), 1).astype(int)
        return cls(low_mm, (high_mm - low_mm) / spans, np.zeros((spans[1] + 3, spans[0] + 3, 2)))

    def basis(self, points_mm: npt.ArrayLike) -> sparse.csr_array:
        """Return the (N, coefficients) matrix of the splines at points; outside, the border's cubic goes on."""
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
        """Return the displacement (N, 2) px at points (N, 2) mm."""
        return np.asarray(self.basis(points_mm) @ self.coefficients.reshape(-1, 2))

    def fitted(self, points_mm: _Array, information: _Array, pull: _Array) -> Displacement:
        """Return the smooth displacement most likely for measured places.

        Minimises Σ ½ dᵀ A d − pullᵀ d + ½ |second differences|² / roughness².

        Parameters
        ----------
        points_mm
            (N, 2) where it was measured.
        information
            (N, 2, 2) A: inverse covariance of each measurement, px⁻²; 0 where nothing was seen.
        pull
            (N, 2) A times the measured displacement, px⁻¹.
        """
        basis = self.basis(points_mm)
        rows, columns = self.coefficients.shape[:2]
        blocks = [[basis.T @ sparse.diags_array(information[:, i, j]) @ basis for j in (0, 1)] for i in (0, 1)]
        penalty = _second_differences(rows, columns) / _ROUGHNESS_PX**2
        # A hair of ridge keeps knots that no measurement reaches solvable; 1 px⁻² counts for nothing beside a cell.
        penalty = penalty + sparse.identity(rows * columns) * 1e-3
        matrix = sparse.block_array([[blocks[0][0] + penalty, blocks[0][1]], [blocks[1][0], blocks[1][1] + penalty]])
        right = np.concatenate([basis.T @ pull[:, 0], basis.T @ pull[:, 1]])
        solution = np.asarray(sparse_linalg.spsolve(sparse.csc_array(matrix), right))
        return replace(self, coefficients=solution.reshape(2, rows, columns).transpose(1, 2, 0))


def _cubic_weights(t: _Array) -> _Array:
    """Return the four uniform cubic B-spline weights (..., 4) at t in [0, 1] of a span."""
    s = 1 - t
    return np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3], axis=-1) / 6


def _second_differences(rows: int, columns: int) -> sparse.csr_array:
    """Return DᵀD of all second differences (xx, yy and twice xy) on a grid of coefficients."""

    def difference(n: int, order: int) -> sparse.csr_array:
        matrix = sparse.eye_array(n, format="csr")
        for _ in range(order):
            matrix = matrix[1:] - matrix[:-1]
        return sparse.csr_array(matrix)

    whole = [sparse.eye_array(n, format="csr") for n in (rows, columns)]
    xx = sparse.kron(whole[0], difference(columns, 2))
    yy = sparse.kron(difference(rows, 2), whole[1])
    xy = sparse.kron(difference(rows, 1), difference(columns, 1))
    return sparse.csr_array(xx.T @ xx + yy.T @ yy + 2 * (xy.T @ xy))


@dataclass(frozen=True, eq=False)
class ColourModel:
    """What camera RGB a printed code gives in one frame: a polynomial, times a smooth light over the page.

    Attributes
    ----------
    degree
        Of the polynomial in the three codes.
    coefficients
        (terms, 3) float64, counts.
    light
        (6, 3) float64, polynomial of second order in page coordinates −1 … 1, mean about 1.
    page_mm
        Width and height of the sheet.
    """

    degree: int
    coefficients: _Array
    light: _Array
    page_mm: tuple[float, float]

    def flat(self, rgb: npt.ArrayLike) -> _Array:
        """Return camera RGB (N, 3), counts, of printed codes (N, 3) under even light."""
        return _code_terms(rgb, self.degree) @ self.coefficients

    def seen(self, rgb: npt.ArrayLike, points_mm: _Array) -> _Array:
        """Return camera RGB (N, 3), counts, of printed codes at points of the page."""
        return self.flat(rgb) * (_page_terms(points_mm, self.page_mm) @ self.light)


def _code_terms(rgb: npt.ArrayLike, degree: int) -> _Array:
    r, g, b = (np.asarray(rgb, dtype=np.float64) / 255).T
    powers = [(i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(degree + 1 - i - j)]
    return np.column_stack([r**i * g**j * b**k for i, j, k in powers])


def _page_terms(points_mm: _Array, page_mm: tuple[float, float]) -> _Array:
    x, y = (2 * np.asarray(points_mm, dtype=np.float64) / page_mm - 1).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def fit_colours(rgb: _Array, points_mm: _Array, seen: _Array, page_mm: tuple[float, float]) -> ColourModel:
    """Return the colour model through patches, robust against those that are covered or not where they are thought.

    Parameters
    ----------
    rgb
        (N, 3) printed codes.
    points_mm
        (N, 2) centres.
    seen
        (N, 3) camera RGB, counts.
    page_mm
        Width and height of the sheet.
    """
    degree = 3 if len(rgb) >= 200 else 2 if len(rgb) >= 60 else 1
    terms, page = _code_terms(rgb, degree), _page_terms(points_mm, page_mm)
    coefficients, light = np.zeros((terms.shape[1], 3)), np.zeros((6, 3))
    for channel in range(3):
        field = np.array([1.0, 0, 0, 0, 0, 0])
        weights = np.ones(len(rgb))
        value = seen[:, channel]
        model = np.zeros(terms.shape[1])
        for _ in range(6):
            model = least_squares(terms * (page @ field)[:, None], value, weights)
            flat = terms @ model
            field = least_squares(page * flat[:, None], value, weights)
            residual = np.abs(value - flat * (page @ field))
            spread = max(1.4826 * float(np.median(residual)), 1e-9)
            weights = np.minimum(1, 2 * spread / np.maximum(residual, 1e-12))
        level = float((page @ field).mean())
        coefficients[:, channel], light[:, channel] = model * level, field / level
    return ColourModel(degree, coefficients, light, page_mm)


@dataclass(frozen=True, eq=False)
class Blocks:
    """How well the registration fits block by block, after the last step.

    Attributes
    ----------
    centres_mm
        (B, 2) float64.
    score
        (B,) float64, correlation of the frame with the print as predicted, −1 … 1; 0 where nothing can be compared.
    residual_px
        (B, 2) float64, displacement that the block alone would still ask for.
    """

    centres_mm: _Array
    score: _Array
    residual_px: _Array

    @property
    def good(self) -> _Mask:
        """(B,) whether a block was used."""
        return self.score >= MIN_BLOCK_SCORE


@dataclass(frozen=True, eq=False)
class Registration:
    """The chart's place in a frame.

    Attributes
    ----------
    framing
        The tags as found.
    lens, displacement
        The two parts of the map.
    tag_residual_px
        (T, 4, 2) float64, corners of the tags in `framing.tags` against the final map.
    lens_residual_px
        RMS of the tags against the lens alone: what the paper's waviness leaves.
    blocks
        Fit of the cells.
    colours
        The colour model of the frame.
    strangers
        (N,) bool, cells in the chart's order whose colour is not nearly the model's: covered, damaged, misprinted.
    agreement
        Correlation of the cells' colours with the model's, the mean of the channels that carry light.
    blur_px
        σ of the tags' edges.
    cell_px
        Half-size pixels per cell, the shorter side of the smallest.
    shift_px
        Movement since the frame that was registered, (dx, dy).
    """

    framing: Framing
    lens: Lens
    displacement: Displacement
    tag_residual_px: _Array
    lens_residual_px: float
    blocks: Blocks
    colours: ColourModel
    strangers: _Mask
    agreement: float
    blur_px: float
    cell_px: float
    shift_px: tuple[float, float] = (0.0, 0.0)

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the half-size pixels (N, 2) float64, x then y, of points (N, 2) on the print."""
        return self.lens.to_pixels(points_mm) + self.displacement.at(points_mm) + self.shift_px

    def shifted(self, dx: float, dy: float) -> Registration:
        """Return this registration for a frame in which the chart lies (dx, dy) px further."""
        return replace(self, shift_px=(self.shift_px[0] + dx, self.shift_px[1] + dy))

    @property
    def tag_rms_px(self) -> float:
        """RMS distance of the tags' corners from the final map."""
        return rms(self.tag_residual_px)

    @property
    def block_rms_px(self) -> float:
        """RMS of what the good blocks would still ask for: the registration's own estimate of its error."""
        return rms(self.blocks.residual_px[self.blocks.good])


def register(mosaic: Mosaic, chart: Chart, what: str = "the frame") -> Registration:
    """Return where the chart lies in a frame.

    About 5 s of one processor for the 32 768 cells on an 18-megapixel frame.

    Parameters
    ----------
    mosaic
        The frame; a white one is best, any with light in it will do.
    chart
        The chart expected.
    what
        The frame's name for messages.

    Raises
    ------
    RegistrationError
        The tags are missing, mirrored, too small or do not fit; the frame is out of focus or too small in the
        picture; the cells' colours are not those of the chart.
    """
    black = frame_black(mosaic)
    framing = find_chart(mosaic, chart, what)
    blur = blur_px(framing)
    planes = [plane_of(mosaic, channel, black) for channel in CHANNELS]
    tags = {tag.id: tag for tag in chart.tags}
    corners_mm = np.concatenate([tags[tag.id].corners_mm for tag in framing.tags])
    corners_px = np.concatenate([tag.corners_px for tag in framing.tags])
    height, width = planes[0].values.shape
    lens, residual = fit_lens(corners_mm, corners_px, (width, height))
    lens_rms = rms(residual)
    if lens_rms > MAX_TAG_RESIDUAL_PX:
        raise RegistrationError(
            f"{what}: the tags lie {lens_rms:.1f} px RMS off a plane seen through a lens, {MAX_TAG_RESIDUAL_PX:g} "
            "allowed; hang the print flat, and see that it is this chart's"
        )
    cell_px = _cell_px(lens, chart)
    _require_size_and_focus(cell_px, blur, what)
    matcher = _Matcher(chart, planes, lens, framing, blur, cell_px)
    matcher.match_coarsely(what)
    for _ in range(_GAUSS_NEWTON_STEPS):
        if matcher.step() < 0.01:
            break
    registration = matcher.result(lens_rms)
    _judge(registration, what)
    return registration


def _cell_px(lens: Lens, chart: Chart) -> float:
    """Return the shorter side of the smallest cell, half-size px."""
    half = np.array(chart.cell_mm) / 2
    across = [lens.to_pixels(chart.centres_mm + half * sign) for sign in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    sides = [np.linalg.norm(across[1] - across[0], axis=1), np.linalg.norm(across[3] - across[2], axis=1)]
    return float(min(side.min() for side in sides))


def _require_size_and_focus(cell_px: float, blur: float, what: str) -> None:
    if cell_px < MIN_CELL_PX:
        raise RegistrationError(
            f"{what}: a cell is {cell_px:.1f} px wide, at least {MIN_CELL_PX:g} expected for 25 pixels inside it; "
            "bring the camera nearer"
        )
    allowed = max(0.9, (cell_px / 2 - SAMPLE_REACH_PX) / 2)
    if not blur <= allowed:
        raise RegistrationError(
            f"{what} is out of focus: edges are blurred by σ = {blur:.2f} px, at most {allowed:.2f} allowed for cells "
            f"of {cell_px:.1f} px; focus on the print, stop down, and keep the camera still"
        )


class _Matcher:
    """Compares a frame with the print, in the print's own raster, and moves the map until they coincide."""

    def __init__(
        self, chart: Chart, planes: list[Plane], lens: Lens, framing: Framing, blur: float, cell_px: float
    ) -> None:
        self._chart = chart
        self._planes = planes
        self._lens = lens
        self._framing = framing
        self._blur = blur
        self._cell_px = cell_px
        cell = np.array(chart.cell_mm)
        references = chart.references
        self._rgb = np.concatenate([chart.rgb, np.array([r.rgb for r in references]).reshape(-1, 3)]).astype(np.float64)
        self._centres = np.concatenate([chart.centres_mm, np.array([r.centre_mm for r in references]).reshape(-1, 2)])
        self._sizes = np.concatenate(
            [np.broadcast_to(cell, chart.centres_mm.shape), np.array([r.size_mm for r in references]).reshape(-1, 2)]
        )
        marks = np.concatenate([self._centres - self._sizes / 2, self._centres + self._sizes / 2])
        marks = np.concatenate([marks, *(tag.corners_mm for tag in chart.tags)])
        low = np.maximum(marks.min(axis=0) - cell / 2, 0)
        high = np.minimum(marks.max(axis=0) + cell / 2, chart.page_mm)
        # The raster is aligned with the first cell, so that edges of a regular chart fall between its elements.
        low -= (low - chart.centres_mm[0] + cell / 2) % cell
        self._cells_across = np.ceil((high - low) / cell).astype(int)
        self._low, self._cell = low, cell
        across = float(self._cells_across.min())
        self._block_cells = int(np.clip(across // 4, 1, _BLOCK_CELLS))
        self.displacement = Displacement.over(
            low, low + self._cells_across * cell, float(cell.max()) * max(2.0, min(_KNOT_CELLS, across / 3))
        )
        self._per_cell = int(np.clip(round(0.8 * cell_px), 8, 16))
        self._raster = _Raster.of(low, cell / self._per_cell, self._cells_across * self._per_cell)
        self._cover = self._raster.coverage(self._centres, self._sizes)
        self._free = self._raster.outside_tags(chart.tags) & self._raster.near(self._cover, self._per_cell)
        self.colours = self._fit_colours()
        self._fit = Blocks(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        return self._lens.to_pixels(points_mm) + self.displacement.at(points_mm)

    def _seen(self) -> _Array:
        """Return the camera RGB (N, 3) at the middle of every patch, NaN outside the frame."""
        places = self.to_pixels(self._centres)
        seen = np.empty((len(places), 3))
        for column, plane in enumerate(self._planes):
            x, y = (places - plane.offset_px).T
            smooth = cv2.blur(plane.values, (3, 3))
            seen[:, column] = ndimage.map_coordinates(smooth, [y, x], order=1, cval=float("nan"))
        return seen

    def _fit_colours(self) -> ColourModel:
        seen = self._seen()
        there = np.flatnonzero(np.isfinite(seen).all(axis=1))
        # Some thousand patches tell a polynomial all they can.
        there = there[:: max(1, len(there) // _COLOUR_PATCHES)]
        return fit_colours(self._rgb[there], self._centres[there], seen[there], self._chart.page_mm)

    def _template(self, raster: _Raster, cover: sparse.csr_array, blur_px: float) -> _Float:
        """Return the print as the camera would see it, (H, W, 3) float32, under even light."""
        flat = self.colours.flat(self._rgb)
        paper = self.colours.flat(np.array([[255, 255, 255]]))[0]
        image = np.asarray(cover @ (flat - paper)) + paper
        image = image.reshape(*raster.shape, 3).astype(np.float32)
        sigma = blur_px / self._cell_px * self._cell / raster.step_mm
        return np.asarray(cv2.GaussianBlur(image, (0, 0), float(sigma[0]), sigmaY=float(sigma[1])), dtype=np.float32)

    def _rectified(self, raster: _Raster) -> tuple[_Float, _Mask]:
        """Return the frame as seen on the print's raster, (H, W, 3), and where it exists."""
        places = raster.spread(self.to_pixels)
        image = np.empty((*raster.shape, 3), dtype=np.float32)
        for channel, plane in enumerate(self._planes):
            image[..., channel] = cv2.remap(
                plane.values,
                places[..., 0] - np.float32(plane.offset_px[0]),
                places[..., 1] - np.float32(plane.offset_px[1]),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
        height, width = self._planes[0].values.shape
        there = (places >= 1).all(axis=-1) & (places[..., 0] <= width - 2) & (places[..., 1] <= height - 2)
        return image, there

    def match_coarsely(self, what: str) -> None:
        """Find blocks of cells where they are, up to one and a half cells away, and follow them smoothly."""
        raster = _Raster.of(self._low, self._cell / _COARSE_PER_CELL, self._cells_across * _COARSE_PER_CELL)
        cover = raster.coverage(self._centres, self._sizes)
        block = int(np.clip(self._cells_across.min() // 3, 2, _COARSE_CELLS))
        reach = round(_COARSE_PER_CELL * min(1.5, 0.25 * block))
        best = 0.0
        for _ in range(2):
            template = self._template(raster, cover, max(self._blur, 0.7))
            image, there = self._rectified(raster)
            # What is printed in the margin is no cell's business.
            bare = ~raster.near(cover, _COARSE_PER_CELL)
            image[bare] = template[bare]
            # Square roots keep a bright light's gradient from deciding; noise is even after it too (Anscombe 1948).
            pair = [np.sqrt(np.maximum(picture, 0)) for picture in (template, image)]
            centres: list[_Array] = []
            moves: list[_Array] = []
            scores: list[float] = []
            for rows, columns in _tiles(raster.shape, block * _COARSE_PER_CELL, reach):
                if not there[rows, columns].all():
                    continue
                wide = np.s_[rows.start - reach : rows.stop + reach, columns.start - reach : columns.stop + reach]
                match = cv2.matchTemplate(pair[1][wide], pair[0][rows, columns], cv2.TM_CCOEFF_NORMED)
                score, move = _peak(np.nan_to_num(np.asarray(match, dtype=np.float64)))
                centres.append(raster.point(0.5 * (columns.start + columns.stop), 0.5 * (rows.start + rows.stop)))
                moves.append(move - reach)
                scores.append(score)
            if not scores:
                raise RegistrationError(
                    f"{what}: too little of the chart lies in the picture; bring all of it into the picture"
                )
            centre, move, score = np.array(centres), np.array(moves), np.array(scores)
            best = float(np.median(score))
            moved_mm = move * raster.step_mm
            shift = self.to_pixels(centre + moved_mm) - self.to_pixels(centre)
            weight = _trusted(centre, shift, score, self._cell * block, self._cell_px)
            information = (weight / (0.05 * self._cell_px) ** 2)[:, None, None] * np.eye(2)
            total = self.displacement.at(centre) + shift
            self.displacement = self.displacement.fitted(
                centre, information, np.einsum("nij,nj->ni", information, total)
            )
            self.colours = self._fit_colours()
        if best < 0.3:
            raise _not_this_chart(what, f"blocks of cells correlate by {best:.2f} with the chart's, 0.3 expected")

    def step(self) -> float:
        """Move the map by one Gauss-Newton step of all cells together; return the RMS movement, px."""
        points, information, pull, score = self._measure()
        tag_points, tag_information, tag_pull = self._measure_tags()
        all_points = np.concatenate([points, tag_points])
        all_information = np.concatenate([information, tag_information])
        before = self.displacement.at(all_points)
        total = np.concatenate([pull, tag_pull]) + np.einsum("nij,nj->ni", all_information, before)
        self.displacement = self.displacement.fitted(all_points, all_information, total)
        moved = (self.displacement.at(all_points) - before)[: len(points)]
        # What the cells still ask for after the step is what they asked for less what they got.
        left = pull - np.einsum("nij,nj->ni", information, moved)
        self._fit = self._blocks(information, left, score)
        seen = information[:, 0, 0] > 0
        return rms(moved[seen])

    def _measure_tags(self) -> tuple[_Array, _Array, _Array]:
        """Return the tags' corners as `_measure` returns cells: they hold the map where no cells are."""
        tags = {tag.id: tag for tag in self._chart.tags}
        points = np.concatenate([tags[tag.id].corners_mm for tag in self._framing.tags])
        places = np.concatenate([tag.corners_px for tag in self._framing.tags])
        information = np.broadcast_to(np.eye(2) / _TAG_SIGMA_PX**2, (len(points), 2, 2))
        return points, information, (places - self.to_pixels(points)) / _TAG_SIGMA_PX**2

    def _measure(self) -> tuple[_Array, _Array, _Array, _Array]:
        """Return places (N, 2) mm, information (N, 2, 2), pull (N, 2) and score (N,) of every cell-sized square."""
        raster, n = self._raster, self._per_cell
        template = self._template(raster, self._cover, self._blur)
        image, there = self._rectified(raster)
        there &= self._free
        window = self._block_cells * n
        weight = there.astype(np.float32)
        share = np.maximum(_box(weight, window), np.float32(1e-3))
        agreeing = np.zeros(raster.shape, dtype=np.float32)
        wanted_power, seen_power = np.zeros_like(agreeing), np.zeros_like(agreeing)
        sums = np.zeros((*raster.tiles(n), 5), dtype=np.float64)
        for channel in range(3):
            wanted, seen = template[..., channel], image[..., channel]
            gy, gx = np.gradient(wanted)
            # Gain and offset are local, as the light and the lens's shading are.
            wanted = (wanted - _box(wanted * weight, window) / share) * weight
            seen = (seen - _box(seen * weight, window) / share) * weight
            power, common = _box(wanted * wanted, window), _box(wanted * seen, window)
            gain = common / np.maximum(power, np.float32(1e-6))
            error = seen - gain * wanted
            size = np.abs(error)
            noise = np.float32(1.4826 * float(np.median(size[::3, ::3][there[::3, ::3]])) + 1e-3)
            agreeing += common / noise**2
            wanted_power += power / noise**2
            seen_power += _box(seen * seen, window) / noise**2
            huber = weight / np.maximum(noise * noise, 0.5 * noise * size)
            gx *= gain
            gy *= gain
            for place, (one, other) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, error), (gy, error))):
                sums[..., place] += _sums(huber * one * other, n)
        score = agreeing / np.sqrt(np.maximum(wanted_power * seen_power, np.float32(1e-6)))
        score *= share > 0.25
        points = raster.points_of_tiles(n)
        information, pull = _to_pixel_units(sums.reshape(-1, 5), _jacobians(self.to_pixels, points, raster.step_mm))
        # Neighbouring raster elements repeat each other's noise where they are finer than the photosites.
        repeat = max(1.0, (n / self._cell_px) ** 2)
        score = _tile_middles(score, n).ravel().astype(np.float64)
        good = (score >= MIN_BLOCK_SCORE) / repeat
        return points, information * good[:, None, None], pull * good[:, None], score

    def _blocks(self, information: _Array, pull: _Array, score: _Array) -> Blocks:
        """Return how each block of cells fits and where it alone would move."""
        rows, columns = self._raster.tiles(self._per_cell)
        across, down = (max(1, count // self._block_cells) for count in (columns, rows))
        of_column = np.minimum(np.arange(columns) * across // columns, across - 1)
        of_row = np.minimum(np.arange(rows) * down // rows, down - 1)
        block = (of_row[:, None] * across + of_column[None, :]).ravel()
        count = across * down
        matrix, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
        np.add.at(matrix, block, information)
        np.add.at(right, block, pull)
        # Blank margins have nothing to compare: only squares that hold a cell are judged.
        points = self._raster.points_of_tiles(self._per_cell)
        column, row = np.floor((self._chart.centres_mm - self._low) / self._cell).astype(int).T
        held = np.zeros((rows, columns))
        held[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = 1
        holds = held.ravel()
        cells = np.bincount(block, holds, count)
        used = cells > 0
        divisor = np.maximum(cells, 1)
        centres = np.stack([np.bincount(block, points[:, axis] * holds, count) / divisor for axis in (0, 1)], axis=-1)
        mean = np.bincount(block, score * holds, count) / divisor
        known = np.linalg.eigvalsh(matrix)[:, 0] > _LEAST_INFORMATION
        residual = np.zeros((count, 2))
        residual[known] = np.linalg.solve(matrix[known], right[known, :, None])[..., 0]
        return Blocks(centres[used], np.where(known, mean, 0.0)[used], residual[used])

    def result(self, lens_rms: float) -> Registration:
        """Return the map with everything that tells how good it is."""
        self.colours = self._fit_colours()
        seen = self._seen()
        there = np.isfinite(seen).all(axis=1)
        wanted = self.colours.seen(self._rgb, self._centres)
        paper = self.colours.flat(np.array([[255, 255, 255]]))[0]
        tags = {tag.id: tag for tag in self._chart.tags}
        residual = np.stack([tag.corners_px - self.to_pixels(tags[tag.id].corners_mm) for tag in self._framing.tags])
        return Registration(
            framing=self._framing,
            lens=self._lens,
            displacement=self.displacement,
            tag_residual_px=residual,
            lens_residual_px=lens_rms,
            blocks=self._fit,
            colours=self.colours,
            strangers=_with_neighbours(
                _strangers(seen, wanted, paper)[: self._chart.colour_count], self._chart.centres_mm / self._cell
            ),
            agreement=_agreement(seen[there], wanted[there]),
            blur_px=self._blur,
            cell_px=self._cell_px,
        )


def _strangers(seen: _Array, wanted: _Array, paper: _Array) -> _Mask:
    """Return which patches (N,) differ from their model far more than is usual, and by a visible share of white."""
    residual = np.abs(seen - wanted)
    usual = 1.4826 * np.nanmedian(residual, axis=0)
    return np.asarray(((residual > _STRANGE_SIGMA * usual) & (residual > _STRANGE_SHARE * paper)).any(axis=1))


def _with_neighbours(strangers: _Mask, centres: _Array) -> _Mask:
    """Return the strangers (N,) and the cells amid them, which a cover of their own colour would hide.

    `centres` (N, 2) in cells.
    """
    near = cKDTree(centres).query(centres, k=min(_NEIGHBOURS, len(centres)))[1]
    share = strangers[np.asarray(near).reshape(len(centres), -1)].mean(axis=1)
    return np.asarray(strangers | (share > _STRANGE_NEIGHBOURS))


def _agreement(seen: _Array, wanted: _Array) -> float:
    """Return the correlation of colours with those wanted, the mean of the channels that carry most light."""
    light = np.median(seen, axis=0)
    used = np.flatnonzero(light >= 0.3 * light.max())
    return float(np.mean([np.corrcoef(seen[:, channel], wanted[:, channel])[0, 1] for channel in used]))


def _not_this_chart(what: str, measured: str) -> RegistrationError:
    return RegistrationError(
        f"{what}: the tags fit, but the cells' colours are not those of the chart: {measured}; "
        "name the chart.json of this print, or uncover it"
    )


def _judge(registration: Registration, what: str) -> None:
    """Refuse a registration that would build a wrong table."""
    blocks = registration.blocks
    if registration.agreement < MIN_AGREEMENT:
        raise _not_this_chart(
            what, f"they correlate by {registration.agreement:.2f} with those expected, {MIN_AGREEMENT:g} needed"
        )
    share = float(blocks.good.mean())
    if share < MIN_GOOD_BLOCKS:
        raise _not_this_chart(
            what,
            f"{share:.0%} of the blocks of cells look as the chart has them, at least {MIN_GOOD_BLOCKS:.0%} needed",
        )
    if registration.block_rms_px > MAX_BLOCK_RESIDUAL_PX:
        raise RegistrationError(
            f"{what}: blocks of cells still ask for movements of {registration.block_rms_px:.2f} px RMS, "
            f"{MAX_BLOCK_RESIDUAL_PX:g} allowed; hang the print flatter"
        )


@dataclass(frozen=True, eq=False)
class _Raster:
    """A raster on the print: element (row, column) has its centre at low + (column + ½, row + ½) · step."""

    low_mm: _Array
    step_mm: _Array
    shape: tuple[int, int]

    @classmethod
    def of(cls, low_mm: _Array, step_mm: _Array, size: _Array) -> _Raster:
        return cls(low_mm, step_mm, (int(size[1]), int(size[0])))

    def point(self, column: float, row: float) -> _Array:
        """Return the place (2,) mm of a border between elements."""
        return self.low_mm + np.array([column, row]) * self.step_mm

    def tiles(self, size: int) -> tuple[int, int]:
        """Return rows and columns of whole tiles of size × size elements."""
        return self.shape[0] // size, self.shape[1] // size

    def points_of_tiles(self, size: int) -> _Array:
        """Return the middles (N, 2) mm of tiles of size × size elements, row by row."""
        rows, columns = self.tiles(size)
        y, x = np.mgrid[:rows, :columns]
        return self.low_mm + (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) * size * self.step_mm

    def _lattice(self, to_pixels: _ToPixels) -> tuple[_Array, int]:
        """Return the map on a coarse lattice: nodes every `stride` elements from the first border on."""
        stride = 8
        rows, columns = (-(-length // stride) + 1 for length in self.shape)
        y, x = np.mgrid[:rows, :columns] * stride
        points = self.low_mm + np.stack([x.ravel(), y.ravel()], axis=-1) * self.step_mm
        return to_pixels(points).reshape(rows, columns, 2), stride

    def spread(self, to_pixels: _ToPixels) -> _Float:
        """Return the places (H, W, 2) float32 px of all elements; exact on a lattice, bilinear within (< 0.001 px)."""
        lattice, stride = self._lattice(to_pixels)
        rows, columns = ((np.arange(length) + 0.5) / stride for length in self.shape)
        i, j = rows.astype(int), columns.astype(int)
        v, u = (rows - i)[:, None, None], (columns - j)[None, :, None]
        along = lattice[:, j] * (1 - u) + lattice[:, j + 1] * u
        return (along[i] * (1 - v) + along[i + 1] * v).astype(np.float32)

    def coverage(self, centres_mm: _Array, sizes_mm: _Array) -> sparse.csr_array:
        """Return the share of each element that each rectangle covers, (H · W, N)."""
        height, width = self.shape
        low = (centres_mm - sizes_mm / 2 - self.low_mm) / self.step_mm
        high = (centres_mm + sizes_mm / 2 - self.low_mm) / self.step_mm
        # Edges on a border within rounding belong to it exactly.
        low, high = (np.where(np.abs(v - np.rint(v)) < 1e-3, np.rint(v), v) for v in (low, high))
        first = np.floor(low).astype(int)
        reach = int((np.ceil(high) - first).max())
        steps = np.arange(reach)
        shares = [
            np.clip(
                np.minimum(high[:, axis, None], first[:, axis, None] + steps + 1)
                - np.maximum(low[:, axis, None], first[:, axis, None] + steps),
                0,
                1,
            )
            for axis in (0, 1)
        ]
        rows = first[:, 1, None, None] + steps[None, :, None]
        columns = first[:, 0, None, None] + steps[None, None, :]
        value = (shares[1][:, :, None] * shares[0][:, None, :]).astype(np.float32)
        inside = (value > 0) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        which = np.broadcast_to(np.arange(len(centres_mm))[:, None, None], value.shape)[inside]
        return sparse.csr_array(
            (value[inside], ((rows * width + columns)[inside], which)), shape=(height * width, len(centres_mm))
        )

    def near(self, cover: sparse.csr_array, per_cell: int) -> _Mask:
        """Return which elements (H, W) are covered by a patch, or lie within a fifth of a cell of one.

        The margin beyond may hold anything: rulers, text, pins.
        """
        covered = (np.diff(cover.indptr) > 0).reshape(self.shape).astype(np.uint8)
        reach = 2 * max(1, round(0.2 * per_cell)) + 1
        return np.asarray(cv2.dilate(covered, np.ones((reach, reach), dtype=np.uint8))).astype(np.bool_)

    def outside_tags(self, tags: tuple[Tag, ...]) -> _Mask:
        """Return which elements (H, W) lie clear of every tag and its white rim."""
        free = np.ones(self.shape, dtype=bool)
        for tag in tags:
            rim = np.ptp(tag.corners_mm, axis=0).max() / 8 * 1.5
            low = np.floor((tag.corners_mm.min(axis=0) - rim - self.low_mm) / self.step_mm).astype(int)
            high = np.ceil((tag.corners_mm.max(axis=0) + rim - self.low_mm) / self.step_mm).astype(int)
            low = np.maximum(low, 0)
            free[low[1] : max(high[1], 0), low[0] : max(high[0], 0)] = False
        return free


def _tiles(shape: tuple[int, int], size: int, margin: int) -> Generator[tuple[slice, slice]]:
    """Yield tiles of about size × size elements that leave a margin all round."""
    starts: list[npt.NDArray[np.int64]] = []
    for length in shape:
        count = max(1, round((length - 2 * margin) / size))
        starts.append(np.linspace(margin, max(margin, length - margin - size), count).astype(int))
    for row in starts[0]:
        for column in starts[1]:
            if row + size + margin <= shape[0] and column + size + margin <= shape[1]:
                yield slice(int(row), int(row) + size), slice(int(column), int(column) + size)


def _peak(match: _Array) -> tuple[float, _Array]:
    """Return the height and place (x, y) of a correlation's peak, a parabola through its neighbours."""
    row, column = np.unravel_index(int(np.argmax(match)), match.shape)
    place = np.array([column, row], dtype=np.float64)
    for axis, (at, length) in enumerate(((int(column), match.shape[1]), (int(row), match.shape[0]))):
        if 0 < at < length - 1:
            line = match[row, at - 1 : at + 2] if axis == 0 else match[at - 1 : at + 2, column]
            bend = line[0] - 2 * line[1] + line[2]
            if bend < 0:
                place[axis] += 0.5 * (line[0] - line[2]) / bend
    return float(match[row, column]), place


def _trusted(centres_mm: _Array, shift_px: _Array, score: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
    """Return the weight (N,) of each block: its score squared, 0 where it is low or the neighbours say otherwise."""
    apart = np.abs(centres_mm[:, None] - centres_mm[None]) / spacing_mm
    near = np.asarray((apart < 1.6).all(axis=-1))
    weight = np.where(score > 0.3, score**2, 0.0)
    for index in range(len(score)):
        around = near[index] & (score > 0.3)
        if around.sum() >= 3 and np.linalg.norm(shift_px[index] - np.median(shift_px[around], axis=0)) > 0.6 * cell_px:
            weight[index] = 0.0
    return weight


def _jacobians(to_pixels: _ToPixels, points_mm: _Array, step_mm: _Array) -> _Array:
    """Return ∂(x, y) px / ∂(column, row) of a raster at points, (N, 2, 2)."""
    reach = np.diag(step_mm)
    slopes = [(to_pixels(points_mm + reach[axis]) - to_pixels(points_mm - reach[axis])) / 2 for axis in (0, 1)]
    return np.stack(slopes, axis=-1)


def _to_pixel_units(sums: _Array, jacobians: _Array) -> tuple[_Array, _Array]:
    """Return information (N, 2, 2) px⁻² and pull (N, 2) px⁻¹ of sums xx, xy, yy, xe, ye taken in raster elements."""
    inverse = np.linalg.inv(jacobians)
    matrix = sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    information = np.einsum("nji,njk,nkl->nil", inverse, matrix, inverse)
    return information, -np.einsum("nji,nj->ni", inverse, sums[:, 3:])


def _box(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return the mean over size × size elements around each."""
    return np.asarray(cv2.blur(image, (size, size)), dtype=np.float32)


def _sums(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return the sums over tiles of size × size elements; what is left over is dropped."""
    rows, columns = (length // size for length in image.shape)
    mean = cv2.resize(image[: rows * size, : columns * size], (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32) * np.float32(size * size)


def _tile_middles(image: npt.NDArray[np.floating], size: int) -> npt.NDArray[np.floating]:
    """Return the element in the middle of each tile."""
    rows, columns = (length // size for length in image.shape)
    return image[size // 2 :: size, size // 2 :: size][:rows, :columns]
