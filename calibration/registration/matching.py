"""Correct the map from print to frame by comparing patches, and estimate the uncertainty of positions.

The frame is rectified and compared with a predicted image of the print. The colour model for the prediction is fitted
to the frame itself. First, blocks of patches are located by correlation (`find_blocks`), so that the result is not one
patch off. Then Gauss-Newton steps (`compare_tiles`) fit a smooth displacement to the differences of all patches. All
channels are used, each at its own position; the map is valid for green.

A chart without tags is in smooth order: the colours of neighbouring patches are similar. Its first steps use blurred
images in place of blocks. `information` and `pull` are defined in `calibration.registration.tiles`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from calibration.registration.colours import ColourModel, displaced_areas, fit_colours
from calibration.registration.geometry import (
    MAX_ROUGHNESS_PX,
    ROUGHNESS_PX,
    Displacement,
    LateralColour,
    Lens,
    fit_lens,
)
from calibration.registration.tiles import MIN_SCORE, Raster, TileComparison, box_mean, compare_tiles, find_blocks
from drivers.raw.rawfile import CHANNELS, Channel, Plane
from experiment.chart.model import PAPER_WHITE, Chart
from experiment.framing.homography import rms
from foundation.errors import RegistrationError

# Smallest information of a displacement, px⁻²; it corresponds to a standard uncertainty of 0.5 px.
_MIN_INFORMATION = 4.0

_MEDIAN_CHI2 = 1.386  # Median of χ² with 2 degrees of freedom

# Window width for the mean of residual displacements, in patches. The noise of a single patch is 0.05 px.
_MEAN_WINDOW_CELLS = 3

# Largest weight of a patch in this mean, as a fraction of the median information. Without this limit, patches at a
# curled rim would hardly count, because they have little information.
_MAX_WEIGHT = 0.15

# Systematic standard uncertainty of positions, because the blur of the predicted print is not exact (simulated frames).
SYSTEMATIC_PX = 0.01

# Ratio of the squared position error to the squared outline residual: a factor 2 because a position has two axes, and
# a factor 2 because the map is fitted to the outline only.
_INSIDE_FACTOR = 4.0

_NEAR_MARKS = 24  # Number of neighbouring outline points in a local mean square

# Multiple of the expected noise variance that is subtracted from a squared mean displacement.
_NOISE_FACTOR = 2.0

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

# Block width and search range of the first and the second search, in patches. Large blocks are unambiguous; small
# blocks follow waves and curled edges.
_COARSE_BLOCKS = ((10, 1.5), (5, 1.0))

_BLOCK_CELLS = 8  # Window width of the fine comparison, in patches

# Spacing of spline knots, in patches. It is smaller than the window, so the spline follows every shape that the window
# resolves.
_KNOT_CELLS = 5

_COARSE_PER_CELL = 5  # Raster elements per patch width in the block search

# Fine comparison: raster elements per pixel, and smallest and largest number of elements per patch width.
_ELEMENTS_PER_PX, _MIN_PER_CELL, _MAX_PER_CELL = 0.8, 8, 16

# Window width of the comparison of blurred images, in patches. Gain and offset are constant in a window.
_BLURRED_WINDOW_CELLS = 12

# Number of independent measurements in such a window. It is small, because colour errors are correlated over many
# patches.
_WINDOW_MEASUREMENTS = 4

_RIM_SIGMAS = 3.0  # Width of the excluded rim of the patch area, in standard deviations of the blur

# Number of neighbouring raster elements with the same colour error, for charts in smooth order.
_CORRELATED_ELEMENTS = 10

# Standard uncertainty of positions in a smooth order, in patches (simulated frames). It is caused by colour errors,
# which look like displacements in such an order.
_COLOUR_ERROR_CELLS = 0.005

_SCORE_BLUR_CELLS = 0.6  # Blur for the scores of blocks in smooth order, in patches

_MIN_BLOCK_SCORE = 0.3  # Minimum median correlation of located blocks; another chart gives about 0

_COLOUR_PATCHES = 5000  # Approximate number of patches for fitting the colour model; more do not improve it

_LENS_POINTS = 2000  # Approximate number of patches for refitting the lens; more do not improve it

# Assumed standard uncertainty of the positions of these patches, px. Chosen by judgement.
_LENS_POINT_SIGMA_PX = 0.1

# Blur that cubic interpolation adds to the rectified frame, as a standard deviation, measured on sharp edges. The
# predicted print gets the same blur.
_INTERPOLATION_PX = 0.28

_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Quality of the registration in each block of patches, after the last step."""

    centres_mm: _Array  # (B, 2)
    score: _Array  # (B,) correlation of frame and predicted print, −1 … 1; 0 if not comparable
    residual_px: _Array  # (B, 2) measured displacement of the block from the final map

    @property
    def good(self) -> _Mask:
        """(B,) bool, blocks with a sufficient correlation."""
        return self.score >= MIN_SCORE


def fit_blocks(
    comparison: TileComparison, raster: Raster, per_cell: int, chart: Chart, block_cells: int, keep_scores: bool
) -> Blocks:
    """Return score and residual of each block; `keep_scores`: keep the score of a block with little contrast."""
    rows, columns = raster.tiles(per_cell)
    across, down = (max(1, count // block_cells) for count in (columns, rows))
    block_column = np.minimum(np.arange(columns) * across // columns, across - 1)
    block_row = np.minimum(np.arange(rows) * down // rows, down - 1)
    block = (block_row[:, None] * across + block_column[None, :]).ravel()
    count = across * down
    matrix, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(matrix, block, comparison.information)
    np.add.at(right, block, comparison.pull)
    # Only tiles that contain a patch are used, because blank margins have no contrast.
    column, row = np.floor((chart.centres_mm - raster.low_mm) / np.array(chart.cell_mm)).astype(int).T
    occupied = np.zeros((rows, columns))
    occupied[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = 1
    has_patch = occupied.ravel()
    patch_counts = np.bincount(block, has_patch, count)
    is_used = patch_counts > 0
    divisor = np.maximum(patch_counts, 1)
    points = comparison.points_mm
    centres = np.stack([np.bincount(block, points[:, axis] * has_patch, count) / divisor for axis in (0, 1)], axis=-1)
    mean = np.bincount(block, comparison.score * has_patch, count) / divisor
    is_known = np.linalg.eigvalsh(matrix)[:, 0] > _MIN_INFORMATION
    residual = np.zeros((count, 2))
    residual[is_known] = np.linalg.solve(matrix[is_known], right[is_known, :, None])[..., 0]
    return Blocks(centres[is_used], np.where(is_known | keep_scores, mean, 0.0)[is_used], residual[is_used])


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """Standard uncertainty of the positions of a registration."""

    raster: Raster  # on the print, one element per patch
    error_px: _Array  # (rows, columns) at the centres of the elements; root of the sum of the variances of x and y

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard uncertainty (N,) float64 px at points (N, 2) mm; outside, the value of the rim."""
        column, row = ((np.asarray(points_mm, dtype=np.float64) - self.raster.low_mm) / self.raster.step_mm - 0.5).T
        return np.asarray(ndimage.map_coordinates(self.error_px, [row, column], order=1, mode="nearest"))


def unfollowed_wave_sigma_px(
    points_mm: _Array, marks_mm: _Array, residual_px: _Array, departure_px: float, reach_mm: float
) -> _Array:
    """Return the standard uncertainty (N,) float64 px from waves of the sheet that the map does not follow.

    These waves are visible only at the outline. Inside, they are assumed to be as large as the RMS residual of the
    outline, and near the outline as large as the residual of the nearest outline points, if this is larger.

    `points_mm`: (N, 2) float64. `marks_mm`, `residual_px`: (M, 2) float64, outline points and their distance from the
    map. `departure_px`: RMS displacement of the outline. `reach_mm`: largest distance of points near the outline.
    """
    squared_residual = (residual_px**2).sum(axis=1)
    distance, neighbours = cKDTree(marks_mm).query(points_mm, k=min(_NEAR_MARKS, len(squared_residual)))
    distance, neighbours = np.reshape(distance, (len(points_mm), -1)), np.reshape(neighbours, (len(points_mm), -1))
    local = np.where(distance[:, 0] <= reach_mm, squared_residual[neighbours].mean(axis=1), 0.0)
    squared = _INSIDE_FACTOR * np.maximum(local, squared_residual.mean())
    low, high = marks_mm.min(axis=0), marks_mm.max(axis=0)
    # Corner points are left out: each measures the position across only one of its two sides.
    on_side = (marks_mm - low < reach_mm / 4) | (high - marks_mm < reach_mm / 4)
    for axis in (0, 1):
        for end in (low[axis], high[axis]):
            side = marks_mm[(np.abs(marks_mm[:, axis] - end) < reach_mm / 4) & ~on_side[:, 1 - axis]]
            # If a part of the outline is missing, as at a curled corner, the uncertainty near it is at least the RMS
            # displacement of the measured parts.
            is_missing = cKDTree(side).query(points_mm)[0] > np.abs(points_mm[:, axis] - end) + reach_mm
            squared = np.where(is_missing, np.maximum(squared, departure_px**2), squared)
    return np.sqrt(squared)


def place_errors(
    comparison: TileComparison,
    raster: Raster,
    per_cell: int,
    displacement: Displacement,
    anchors: tuple[_Array, _Array],
    systematic_px: _Array | float = SYSTEMATIC_PX,
    correlated: bool = False,
) -> PlaceErrors:
    """Estimate the standard uncertainty of positions from noise and from residual displacements of patches.

    The first part is the posterior uncertainty of the smooth fit; it grows in areas without measurements. The second
    part covers shapes that the smooth fit cannot follow, such as folds and curled edges.

    `anchors`: (N, 2) mm and (N, 2, 2) px⁻², other points that fix the map, and their information. `systematic_px`:
    additional standard uncertainty, one value or (N,) per tile. `correlated`: neighbouring patches have common errors.
    """
    shape, information = raster.tiles(per_cell), comparison.information
    is_known = np.linalg.eigvalsh(information)[:, 0] > _MIN_INFORMATION
    movement = np.zeros_like(comparison.pull)
    movement[is_known] = np.linalg.solve(information[is_known], comparison.pull[is_known, :, None])[..., 0]
    chi2 = (movement * comparison.pull).sum(axis=1)[is_known]
    scatter = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2) if len(chi2) else 1.0
    points = comparison.points_mm
    fit_error = displacement.errors_px(
        np.concatenate([points, anchors[0]]), np.concatenate([information / scatter, anchors[1]]), points
    )
    # The weight is proportional to the information up to a limit, so that patches with weak edges get a low weight.
    strength = np.zeros(len(points))
    strength[is_known] = np.linalg.eigvalsh(information[is_known])[:, 0]
    weight_limit = _MAX_WEIGHT * float(np.median(strength[is_known])) if len(chi2) else 0.0
    weight = np.minimum(strength, weight_limit)

    def local_mean(values: _Array) -> _Array:
        return np.asarray(box_mean(values.reshape(shape), _MEAN_WINDOW_CELLS), dtype=np.float64)

    total = np.maximum(local_mean(weight), 1e-6)
    residual2 = (local_mean(weight * movement[:, 0]) / total) ** 2 + (local_mean(weight * movement[:, 1]) / total) ** 2
    if correlated:
        noise = 2 * scatter * (local_mean(weight / np.sqrt(np.maximum(strength, 1e-6))) / total) ** 2
    else:
        noise = 2 * scatter * local_mean(weight**2 / np.maximum(strength, 1e-6)) / (_MEAN_WINDOW_CELLS * total) ** 2
    residual2 = np.maximum(residual2 - _NOISE_FACTOR * noise, 0.0)
    # In the margin and next to tags, too few patches contribute to the mean.
    residual2[total < 0.5 * weight_limit] = 0.0
    # The residual of a wave passes through zero next to its maximum, so the maximum of the neighbourhood is used.
    residual2 = ndimage.maximum_filter(residual2, _MEAN_WINDOW_CELLS)
    patch_raster = Raster(raster.low_mm, raster.step_mm * per_cell, shape)
    return PlaceErrors(patch_raster, np.sqrt((fit_error**2 + np.square(systematic_px)).reshape(shape) + residual2))


@dataclass(frozen=True, eq=False)
class Anchors:
    """Measured points other than patches: tag corners or outline points. They fix the map in areas without patches."""

    points_mm: _Array  # (N, 2)
    positions_px: _Array  # (3, N, 2) positions of red, green and blue; any finite value without a measurement
    information: _Array  # (3, N, 2, 2) inverse covariance of the positions, px⁻²; 0 without a measurement

    def select(self, selection: _Mask) -> Anchors:
        """Return the anchors of a selection (N,) bool."""
        return Anchors(self.points_mm[selection], self.positions_px[:, selection], self.information[:, selection])

    def with_errors_scaled(self, factor: float) -> Anchors:
        """Return anchors with standard uncertainties multiplied by a factor."""
        return Anchors(self.points_mm, self.positions_px, self.information / factor**2)

    def pull(self, expected_px: _Array) -> _Array:
        """Return information times distance (3, N, 2) float64 px⁻¹ from expected positions (3, N, 2)."""
        return np.einsum("cnij,cnj->cni", self.information, self.positions_px - expected_px)

    def residual_px(self, expected_px: _Array) -> _Array:
        """Return the distance (N, 2) float64 px from expected positions (3, N, 2): weighted mean of the channels."""
        inverse = np.asarray(np.linalg.pinv(self.information.sum(axis=0), rcond=1e-9, hermitian=True), dtype=np.float64)
        return np.einsum("nij,cnj->ni", inverse, self.pull(expected_px))


class Matcher:
    """Compares the rectified frame with the predicted print, and corrects the map step by step."""

    def __init__(
        self,
        chart: Chart,
        planes: list[Plane],
        lens: Lens,
        anchors: Anchors,
        lateral: LateralColour,
        blur_px: float,
        cell_px: float,
    ) -> None:
        self._chart = chart
        # In a smooth order, contrast is low: it consists of the steps between neighbouring codes.
        self._smooth_order = not chart.tags
        self._planes = planes
        self.lens = lens
        self.lateral = lateral
        self._anchors = anchors
        self.blur_px = blur_px
        self.cell_px = cell_px
        cell = np.array(chart.cell_mm)
        references = chart.references
        self._rgb = np.concatenate([chart.rgb, np.array([r.rgb for r in references]).reshape(-1, 3)]).astype(np.float64)
        self._centres = np.concatenate([chart.centres_mm, np.array([r.centre_mm for r in references]).reshape(-1, 2)])
        self._sizes = np.concatenate(
            [np.broadcast_to(cell, chart.centres_mm.shape), np.array([r.size_mm for r in references]).reshape(-1, 2)]
        )
        corners_mm = np.concatenate([self._centres - self._sizes / 2, self._centres + self._sizes / 2])
        corners_mm = np.concatenate([corners_mm, *(tag.corners_mm for tag in chart.tags)])
        low = np.maximum(corners_mm.min(axis=0) - cell / 2, 0)
        high = np.minimum(corners_mm.max(axis=0) + cell / 2, chart.page_mm)
        # The raster is aligned with the first patch, so that patch edges of a regular chart are element borders.
        low -= (low - chart.centres_mm[0] + cell / 2) % cell
        self._cells_across = np.ceil((high - low) / cell).astype(int)
        self._low, self._cell = low, cell
        smaller_count = float(self._cells_across.min())
        self._block_cells = int(np.clip(smaller_count // 4, 1, _BLOCK_CELLS))
        self.displacement = Displacement.over(
            low,
            low + self._cells_across * cell,
            float(cell.max()) * max(2.0, min(_KNOT_CELLS, smaller_count / 3)),
            lens if self._smooth_order else None,
        )
        self._roughness_px = ROUGHNESS_PX
        self._per_cell = int(np.clip(round(_ELEMENTS_PER_PX * cell_px), _MIN_PER_CELL, _MAX_PER_CELL))
        self._raster = Raster.of(low, cell / self._per_cell, self._cells_across * self._per_cell)
        self._cover = self._raster.coverage(self._centres, self._sizes)
        self._valid = self._raster.outside_tags(chart.tags) & self._raster.near(self._cover, self._per_cell)
        if self._smooth_order:
            # The rim is excluded: light blurred from the margin changes it by more than the steps between patches.
            kernel = 2 * int(np.ceil(_RIM_SIGMAS * blur_px / cell_px * self._per_cell)) + 1
            patch_cover = (self._raster.coverage(chart.centres_mm, self._sizes[: chart.colour_count]) > 0).sum(axis=1)
            covered = np.asarray(patch_cover).reshape(self._raster.shape).astype(np.uint8)
            self._valid = np.asarray(cv2.erode(covered, np.ones((kernel, kernel), dtype=np.uint8))).astype(np.bool_)
        self.colours = self._fit_colours()
        self._remainder: TileComparison | None = None

    def to_pixels(self, points_mm: npt.ArrayLike, channel: Channel = "G") -> _Array:
        """Map points (N, 2) mm to half-size px (N, 2) float64 of a channel, with the current map."""
        positions_px = self.lens.to_pixels(points_mm) + self.displacement.at(points_mm)
        return positions_px + self.lateral.shift_px(positions_px, channel)

    def in_channels(self, points_mm: npt.ArrayLike) -> _Array:
        """Map points (N, 2) mm to half-size px (3, N, 2) float64 of red, green and blue."""
        return self.lateral.channels_px(self.to_pixels(points_mm))

    def _measured_rgb(self) -> _Array:
        positions_px = self.to_pixels(self._centres)
        measured = np.empty((len(positions_px), 3))
        for column, plane in enumerate(self._planes):
            x, y = (positions_px + self.lateral.shift_px(positions_px, plane.channel) - plane.offset_px).T
            smooth = cv2.blur(plane.values, (3, 3))
            measured[:, column] = ndimage.map_coordinates(smooth, [y, x], order=1, cval=float("nan"))
        return measured

    def patches(self) -> tuple[_Array, _Array, _Array]:
        """Return measured and predicted camera RGB of all patches, and predicted camera RGB of the paper, in counts.

        Patches, with the references last: (N, 3) float64; measured values are NaN outside the frame. Paper: (3,).
        """
        self.colours = self._fit_colours()
        return self._measured_rgb(), self.colours.predict(self._rgb, self._centres), self._paper_rgb()

    def _paper_rgb(self) -> _Array:
        return self.colours.predict_flat(np.array([PAPER_WHITE]))[0]

    def _fit_colours(self) -> ColourModel:
        rgb = self._measured_rgb()
        used = np.flatnonzero(np.isfinite(rgb).all(axis=1))
        used = used[:: max(1, len(used) // _COLOUR_PATCHES)]
        return fit_colours(self._rgb[used], self._centres[used], rgb[used], self._chart.page_mm, self._smooth_order)

    def _template(self, raster: Raster, cover: sparse.csr_array, sigma: _Array) -> _Float:
        """Predict the rectified frame (H, W, 3) float32, counts; `sigma` (2,) is the blur in elements."""
        flat = self.colours.predict_flat(self._rgb)
        paper = self._paper_rgb()
        image = np.asarray(cover @ (flat - paper)) + paper
        image = image.reshape(*raster.shape, 3).astype(np.float32)
        if self._smooth_order:
            image *= raster.smooth(self.colours.light_at)
        x, y = np.hypot(sigma, self._elements(raster, _INTERPOLATION_PX)).tolist()
        return np.asarray(cv2.GaussianBlur(image, (0, 0), x, sigmaY=y), dtype=np.float32)

    # Convert a length from px to raster elements along x and y; elements need not be square.
    def _elements(self, raster: Raster, length_px: float) -> _Array:
        return np.asarray(length_px / self.cell_px * self._cell.min() / raster.step_mm, dtype=np.float64)

    def _rectified(self, raster: Raster) -> tuple[_Float, _Mask]:
        positions = raster.element_positions(self.to_pixels)
        image = np.empty((*raster.shape, 3), dtype=np.float32)
        for channel, plane in enumerate(self._planes):
            channel_positions = positions
            if plane.channel != "G" and self.lateral.terms_px.any():
                channel_positions = raster.element_positions(partial(self.to_pixels, channel=plane.channel))
            image[..., channel] = cv2.remap(
                plane.values,
                channel_positions[..., 0] - np.float32(plane.offset_px[0]),
                channel_positions[..., 1] - np.float32(plane.offset_px[1]),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
        height, width = self._planes[0].values.shape
        is_inside = (positions >= 1).all(axis=-1) & (positions[..., 0] <= width - 2) & (positions[..., 1] <= height - 2)
        return image, is_inside

    def match_coarsely(self, frame_name: str) -> None:
        """Locate blocks of patches with a search range of 1.5 patches, and fit a smooth displacement to them."""
        elements, smaller_count = _COARSE_PER_CELL, int(self._cells_across.min())
        blocks = [int(np.clip(smaller_count // 3, 2, cells)) for cells, _ in _COARSE_BLOCKS]
        reaches = [round(elements * min(range_cells, 0.25 * blocks[0])) for _, range_cells in _COARSE_BLOCKS]
        # The raster exceeds the outermost patches by the search range, so that blocks include the rim.
        step, margin = self._cell / elements, max(reaches)
        raster = Raster.of(self._low - margin * step, step, self._cells_across * elements + 2 * margin)
        cover = raster.coverage(self._centres, self._sizes)
        best_score = 0.0
        for block, reach in zip(blocks, reaches, strict=True):
            template = self._template(raster, cover, self._elements(raster, max(self.blur_px, 0.7)))
            image, is_inside = self._rectified(raster)
            # The margin is replaced by its prediction, so that print there has no effect.
            is_margin = ~raster.near(cover, elements)
            image[is_margin] = template[is_margin]
            located = find_blocks(raster, template, image, is_inside, block * elements, reach, block**2)
            if not len(located.score):
                raise RegistrationError(
                    f"{frame_name}: no block of patches is inside the frame, expected all; bring the whole chart into "
                    "the frame"
                )
            centre = located.centres_mm
            best_score = max(best_score, float(np.median(located.score)))
            shift = self.to_pixels(centre + located.moves_mm) - self.to_pixels(centre)
            information = located.information(shift, self._cell * block, self.cell_px)
            total = self.displacement.at(centre) + shift
            self.displacement = self.displacement.fitted(
                centre, information, np.einsum("nij,nj->ni", information, total), MAX_ROUGHNESS_PX
            )
            self.colours = self._fit_colours()
        if best_score < _MIN_BLOCK_SCORE:
            raise not_this_chart(
                frame_name, f"the correlation of blocks is {best_score:.2f}, expected at least {_MIN_BLOCK_SCORE:g}"
            )

    def step_blurred(self, sigma_cells: float) -> None:
        """Make one Gauss-Newton step with print and frame blurred by `sigma_cells` patches."""
        # The blur removes the steps between patches, so the result cannot be one patch off. Only large structures of
        # the colour order remain; areas with an even gradient get the displacement of their neighbours.
        repeat = (_BLURRED_WINDOW_CELLS * _COARSE_PER_CELL) ** 2 / _WINDOW_MEASUREMENTS
        self._move(self._compare_blurred(sigma_cells).weakened(repeat))
        self.colours = self._fit_colours()

    def refit_lens(self) -> None:
        """Refit the lens to the positions of the patches, and the heights to the residual of the new lens."""
        # The first lens was fitted to the outline alone, which cannot separate curl of the sheet from distortion.
        points = self._chart.centres_mm[:: max(1, self._chart.colour_count // _LENS_POINTS)]
        positions_px = self.to_pixels(points)
        height, width = self._planes[0].values.shape
        self.lens, residual = fit_lens(points, positions_px, (width, height))
        start = replace(self.displacement, lens=self.lens)
        information = np.broadcast_to(np.eye(2) / _LENS_POINT_SIGMA_PX**2, (len(points), 2, 2))
        self.displacement = start.fitted(points, information, residual / _LENS_POINT_SIGMA_PX**2, self._roughness_px)

    def _compare_blurred(self, sigma_cells: float) -> TileComparison:
        elements = _COARSE_PER_CELL
        raster = Raster.of(self._low, self._cell / elements, self._cells_across * elements)
        cover = raster.coverage(self._centres, self._sizes)
        is_comparable = raster.outside_tags(self._chart.tags) & raster.near(cover, elements)
        template = self._template(raster, cover, np.full(2, sigma_cells * elements))
        image, is_inside = self._rectified(raster)
        frame_sigma = self._elements(raster, self.blur_px)
        image[~is_comparable] = self._template(raster, cover, frame_sigma)[~is_comparable]
        x, y = np.sqrt(np.maximum((sigma_cells * elements) ** 2 - frame_sigma**2, 0.01 * elements**2)).tolist()
        for channel in range(3):
            image[..., channel] = cv2.GaussianBlur(image[..., channel], (0, 0), x, sigmaY=y)
        weight = (is_inside & is_comparable).astype(np.float32)
        window = _BLURRED_WINDOW_CELLS * elements
        return compare_tiles(
            raster, elements, template, image, weight, window, self.to_pixels, self.cell_px, without_gradient=True
        )

    def blocks(self) -> Blocks:
        """Return the quality of all blocks; call `step` first."""
        assert self._remainder is not None
        comparison = self._remainder
        if self._smooth_order:
            # Steps between dark patches are below the noise, so the score is calculated from blurred images.
            comparison = replace(comparison, score=self._compare_blurred(_SCORE_BLUR_CELLS).score)
        return fit_blocks(
            comparison, self._raster, self._per_cell, self._chart, self._block_cells, keep_scores=self._smooth_order
        )

    def place_errors(self) -> PlaceErrors:
        """Return the uncertainty of positions; call `step` first."""
        assert self._remainder is not None
        points, information = self._anchors.points_mm, self._anchors.information.sum(axis=0)
        systematic: _Array | float = SYSTEMATIC_PX
        if self._smooth_order:
            residual = self._anchors.residual_px(self.in_channels(points))
            reach = _KNOT_CELLS * float(self._cell.max())
            departure = rms(self.displacement.at(points))
            unfollowed = unfollowed_wave_sigma_px(self._remainder.points_mm, points, residual, departure, reach)
            systematic = np.hypot(unfollowed, _COLOUR_ERROR_CELLS * self.cell_px)
        anchors = points, information
        return place_errors(
            self._remainder, self._raster, self._per_cell, self.displacement, anchors, systematic, self._smooth_order
        )

    def find_displaced_areas(self, mismatched_cells: _Mask) -> tuple[_Array, int]:
        """Return the centres (B, 2) mm of areas that are displaced by a patch, and the number of tested areas.

        `mismatched_cells`: (C,) bool, patches to ignore.
        """
        measured, expected, paper = self.patches()
        count = self._chart.colour_count
        column, row = np.floor((self._chart.centres_mm - self._low) / self._cell).astype(int).T
        columns, rows = self._cells_across.tolist()
        centres, area_count = displaced_areas(
            measured[:count], expected[:count], paper, mismatched_cells, (row, column), (rows, columns)
        )
        return self._low + centres * self._cell, area_count

    def step(self) -> tuple[float, float]:
        """Make one Gauss-Newton step with all patches; return the RMS and the largest movement of the map, px."""
        raster, elements = self._raster, self._per_cell
        template = self._template(raster, self._cover, self._elements(raster, self.blur_px))
        image, is_inside = self._rectified(raster)
        weight = (is_inside & self._valid).astype(np.float32)
        window = self._block_cells * elements
        compared = compare_tiles(
            raster, elements, template, image, weight, window, self.to_pixels, self.cell_px, self._smooth_order
        )
        if self._smooth_order:
            compared = compared.weakened(_CORRELATED_ELEMENTS)
        points = compared.points_mm
        previous, positions_px = self.displacement, self.to_pixels(points)
        shifted = self.lateral.channels_px(positions_px)
        self.lateral = self.lateral.remeasured(*self._with_anchors(*self._in_blocks(compared, positions_px)))
        compared = compared.after(self.lateral.channels_px(positions_px) - shifted)
        moved = self._move(compared)
        self._remainder = compared.after(self.displacement.at(points) - previous.at(points))
        return moved

    def _in_blocks(self, compared: TileComparison, positions_px: _Array) -> tuple[_Array, _Array, _Array]:
        column, row = np.floor((compared.points_mm - self._low) / (self._cell * self._block_cells)).astype(int).T
        block = row * (column.max() + 1) + column
        count = int(block.max()) + 1

        def summed(values: _Array) -> _Array:
            total = np.zeros((count, *values.shape[1:]))
            np.add.at(total, block, values)
            return total

        tiles = np.maximum(np.bincount(block, minlength=count), 1)
        information, pull = (np.stack([summed(c) for c in channels]) for channels in compared.of_channels)
        return summed(positions_px) / tiles[:, None], information, pull

    def _with_anchors(self, positions_px: _Array, information: _Array, pull: _Array) -> tuple[_Array, _Array, _Array]:
        anchors = self._anchors
        anchor_px = self.in_channels(anchors.points_mm)
        return (
            np.concatenate([positions_px, anchor_px[CHANNELS.index("G")]]),
            np.concatenate([information, anchors.information], axis=1),
            np.concatenate([pull, anchors.pull(anchor_px)], axis=1),
        )

    def _move(self, compared: TileComparison) -> tuple[float, float]:
        """Fit the displacement to tiles and anchors; return the RMS and the largest movement of the tiles, px."""
        anchors, points = self._anchors, compared.points_mm
        all_points = np.concatenate([points, anchors.points_mm])
        all_information = np.concatenate([compared.information, anchors.information.sum(axis=0)])
        previous = self.displacement.at(all_points)
        anchored = anchors.pull(self.in_channels(anchors.points_mm)).sum(axis=0)
        total = np.concatenate([compared.pull, anchored]) + np.einsum("nij,nj->ni", all_information, previous)
        self.displacement = self.displacement.fitted(all_points, all_information, total, self._roughness_px)
        if self._smooth_order:
            # In areas with an even gradient the shape is not measured, so the result depends on the prior roughness.
            self._roughness_px = self.displacement.likely_roughness_px(all_points, all_information, self._roughness_px)
        moved = (self.displacement.at(all_points) - previous)[: len(points)]
        moved = moved[compared.information[:, 0, 0] > 0]
        return rms(moved), float(np.linalg.norm(moved, axis=1).max(initial=0.0))


def not_this_chart(frame_name: str, measurement: str) -> RegistrationError:
    """Return the error for a frame with another chart; `measurement` states the measured and the expected value."""
    return RegistrationError(
        f"{frame_name}: the colours of the patches do not match the chart: {measurement}; "
        "give the chart.json of this print, or uncover it"
    )
