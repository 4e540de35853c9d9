"""The map from print to frame moved until both coincide, and how well each place is known then.

The frame is rectified to the print, compared with the print's colours as the camera sees them (a colour model fitted on
the frame itself), and a smooth displacement is fitted to what does not coincide: first whole blocks are found by
correlation (`find_blocks`), then all cells move together, by Gauss-Newton steps (`compare_tiles`). Without the first
the second locks onto the neighbouring cell. All colours are used, each in its own place; the map is green's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from calibration.registration.colours import ColourModel, fit_colours, slipped_parts
from calibration.registration.geometry import (
    MOST_ROUGHNESS_PX,
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

# px⁻²: a block whose place has a standard error of half a pixel or more does not count as compared.
_LEAST_INFORMATION = 4.0

_MEDIAN_CHI2 = 1.386  # Median of χ² with 2 degrees of freedom

# Cells along a neighbourhood whose own movements are averaged: one alone is known to .05 px, its noise.
_AROUND_CELLS = 3

# Of the usual cell's information, from which on a cell's movement counts as much as others': a curled rim has less.
_LEAST_SHARE = 0.15

# Standard error that no number of cells takes away: the print as predicted is not blurred quite as the frame is
# (simulated frames, small charts and large).
SYSTEMATIC_PX = 0.01

# Square of a place's error for each square of the outline's residual: two axes for the one across, and twice that, as
# the map bends towards the outline's points and not towards places inside.
_OF_OUTLINE = 4.0

_NEAR_MARKS = 24  # Points of an outline of 640 whose mean square is that of a part of it: known to a third

_NOISE = 2.0  # Times the noise to be expected of such a mean that are taken off its square: what is left is no noise

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

# Cells along the blocks that are searched for, and how far, first and then: large ones are never taken for others,
# small ones follow waves of 150 mm and curled edges to 0.2 … 0.3 px RMS, in simulated frames (of 6 mm).
_COARSE_BLOCKS = ((10, 1.5), (5, 1.0))

# Cells along the window of the fine comparison: blocks of 6 leave larger errors at the worst cell, .40 px for .38.
_BLOCK_CELLS = 8

# Cells between the displacement's knots: less than a window's, so that the spline follows what windows resolve.
_KNOT_CELLS = 5

_COARSE_PER_CELL = 5  # Raster elements along a cell where whole blocks are searched for

# Raster elements for each pixel of a cell in the fine comparison, and how many a cell has.
_PER_CELL_PX, _LEAST_PER_CELL, _MOST_PER_CELL = 0.8, 8, 16

# Cells along the window within which gain and offset are constant where print and frame are blurred by cells.
_FOLLOWED_CELLS = 12

# Independent measurements that such a window counts for: what the colours leave is alike over many cells.
_WINDOW_WORTH = 4

_RIM_SIGMAS = 3.0  # Standard deviations of the blur by which the field's rim is left out

# How many neighbouring elements the misfit of the colours is alike over, where steps of colour are all there is.
_COLOURS_REPEAT = 10

# Of a cell: standard error of places by what the model of a smooth order's colours misses. It is taken for a
# movement, alike over many cells (simulated frames: .002 to .005 RMS at cells of 8 to 23 px).
_COLOURS_SHIFT = 0.005

_BLURRED_CELLS = 0.6  # Blur in cells at which blocks of a smooth order are compared with the chart's

_LEAST_BLOCK_SCORE = 0.3  # Median correlation of the blocks that are searched for; blocks of another chart give about 0

# Patches that the colour model is fitted on: more do not improve a polynomial of some dozen terms.
_COLOUR_PATCHES = 5000

_LENS_POINTS = 2000  # Cells that the lens is fitted to again: more do not improve a dozen parameters

# How well they are known then (judgement): what is lost of the displacement, .02 px, the next steps measure again.
_LENS_POINT_SIGMA_PX = 0.1

# σ that cubic interpolation adds to a frame's edges: measured on edges of σ 0.4 to 0.7 px, less where they are
# softer. Without it in the template, the error of the cells' places is half as large again.
_INTERPOLATION_PX = 0.28

_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Blocks:
    """How well the registration fits block by block, after the last step.

    - `centres_mm`: (B, 2) float64.
    - `score`: (B,) float64, correlation of the frame with the print as predicted, −1 … 1; 0 where nothing can be
      compared.
    - `residual_px`: (B, 2) float64, displacement that the block alone would still need.
    """

    centres_mm: _Array
    score: _Array
    residual_px: _Array

    @property
    def good(self) -> _Mask:
        """(B,) bool, whether a block was used."""
        return self.score >= MIN_SCORE


def fit_blocks(
    comparison: TileComparison, raster: Raster, per_cell: int, chart: Chart, block_cells: int, all_known: bool
) -> Blocks:
    """Return how each block of cells fits, and by how much it alone would move.

    `chart`: the chart. Blank margins have nothing to compare: only tiles that hold a cell count.
    """
    rows, columns = raster.tiles(per_cell)
    across, down = (max(1, count // block_cells) for count in (columns, rows))
    of_column = np.minimum(np.arange(columns) * across // columns, across - 1)
    of_row = np.minimum(np.arange(rows) * down // rows, down - 1)
    block = (of_row[:, None] * across + of_column[None, :]).ravel()
    count = across * down
    matrix, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(matrix, block, comparison.information)
    np.add.at(right, block, comparison.pull)
    column, row = np.floor((chart.centres_mm - raster.low_mm) / np.array(chart.cell_mm)).astype(int).T
    occupied = np.zeros((rows, columns))
    occupied[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = 1
    holds = occupied.ravel()
    cells = np.bincount(block, holds, count)
    used = cells > 0
    divisor = np.maximum(cells, 1)
    points = comparison.points_mm
    centres = np.stack([np.bincount(block, points[:, axis] * holds, count) / divisor for axis in (0, 1)], axis=-1)
    mean = np.bincount(block, comparison.score * holds, count) / divisor
    known = np.linalg.eigvalsh(matrix)[:, 0] > _LEAST_INFORMATION
    residual = np.zeros((count, 2))
    residual[known] = np.linalg.solve(matrix[known], right[known, :, None])[..., 0]
    return Blocks(centres[used], np.where(known | all_known, mean, 0.0)[used], residual[used])


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """How well the places of a registration are known.

    - `raster`: A raster on the print whose elements are cells.
    - `error_px`: (rows, columns) float64, standard error of the place of each element's middle, its length over x and
      y.
    """

    raster: Raster
    error_px: _Array

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard error (N,) float64 px at points (N, 2) mm; beyond the field, that of its rim."""
        column, row = ((np.asarray(points_mm, dtype=np.float64) - self.raster.low_mm) / self.raster.step_mm - 0.5).T
        return np.asarray(ndimage.map_coordinates(self.error_px, [row, column], order=1, mode="nearest"))


def unfollowed_px(
    points_mm: _Array, marks_mm: _Array, residual_px: _Array, departure_px: float, reach_mm: float
) -> _Array:
    """Return the standard error (N,) float64 px of places by what the map does not follow of an outline.

    A sheet is taken to wave as much inside as its outline does, along both axes; near a part of the outline, as much as
    there. Where a part of the outline was not found, a curled corner for instance, it is taken to lie as far from a
    plane seen through a lens as the sheet does elsewhere.

    `points_mm`: (N, 2) float64. `marks_mm`, `residual_px`: (M, 2) float64, points of the outline, a rectangle, and how
    far from the map they are seen, across it.
    """
    off2 = (residual_px**2).sum(axis=1)
    far, near = cKDTree(marks_mm).query(points_mm, k=min(_NEAR_MARKS, len(off2)))
    far, near = np.reshape(far, (len(points_mm), -1)), np.reshape(near, (len(points_mm), -1))
    here = np.where(far[:, 0] <= reach_mm, off2[near].mean(axis=1), 0.0)
    squared = _OF_OUTLINE * np.maximum(here, off2.mean())
    low, high = marks_mm.min(axis=0), marks_mm.max(axis=0)
    # Points at a corner may be of either side, and each tells of one direction alone.
    on = (marks_mm - low < reach_mm / 4) | (high - marks_mm < reach_mm / 4)
    for axis in (0, 1):
        for end in (low[axis], high[axis]):
            side = marks_mm[(np.abs(marks_mm[:, axis] - end) < reach_mm / 4) & ~on[:, 1 - axis]]
            lost = cKDTree(side).query(points_mm)[0] > np.abs(points_mm[:, axis] - end) + reach_mm
            squared = np.where(lost, np.maximum(squared, departure_px**2), squared)
    return np.sqrt(squared)


def place_errors(
    comparison: TileComparison,
    raster: Raster,
    per_cell: int,
    displacement: Displacement,
    anchors: tuple[_Array, _Array],
    systematic_px: _Array | float = SYSTEMATIC_PX,
    alike: bool = False,
) -> PlaceErrors:
    """Return how well places are known: what scatter leaves open, and what the cells still ask for.

    The first is the error of the smooth displacement's fit, its measurements taken to scatter as they are found to; it
    grows where nothing was compared. The second is what a displacement cannot follow, or has not: folds, a curled edge.
    In simulated rooms with waves, curl and dog-ears 99 % of a whole chart's cells lie within three standard errors,
    98 % of a chart of 512 cells.

    `anchors`: (N, 2) mm and (N, 2, 2) px⁻², places that fix the map besides cells, and their information.
    `systematic_px`: standard error besides, at all tiles' middles or (N,) at each.
    """
    shape, information = raster.tiles(per_cell), comparison.information
    known = np.linalg.eigvalsh(information)[:, 0] > _LEAST_INFORMATION
    own = np.zeros_like(comparison.pull)
    own[known] = np.linalg.solve(information[known], comparison.pull[known, :, None])[..., 0]
    chi2 = (own * comparison.pull).sum(axis=1)[known]
    scatter = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2) if len(chi2) else 1.0
    points = comparison.points_mm
    fitted = displacement.errors_px(
        np.concatenate([points, anchors[0]]), np.concatenate([information / scatter, anchors[1]]), points
    )
    # Cells whose edges differ strongly would outvote those beside them, those that hardly differ would bring noise.
    strength = np.zeros(len(points))
    strength[known] = np.linalg.eigvalsh(information[known])[:, 0]
    most = _LEAST_SHARE * float(np.median(strength[known])) if len(chi2) else 0.0
    weight = np.minimum(strength, most)

    def around(values: _Array) -> _Array:
        return np.asarray(box_mean(values.reshape(shape), _AROUND_CELLS), dtype=np.float64)

    total = np.maximum(around(weight), 1e-6)
    asked = (around(weight * own[:, 0]) / total) ** 2 + (around(weight * own[:, 1]) / total) ** 2
    if alike:
        noise = 2 * scatter * (around(weight / np.sqrt(np.maximum(strength, 1e-6))) / total) ** 2
    else:
        noise = 2 * scatter * around(weight**2 / np.maximum(strength, 1e-6)) / (_AROUND_CELLS * total) ** 2
    asked = np.maximum(asked - _NOISE * noise, 0.0)
    # In the margin and beside tags it would be one cell's noise, or the rounding of the means, over almost nothing.
    asked[total < 0.5 * most] = 0.0
    # What a displacement cannot follow swings about it: next to where it shows it may be hidden.
    asked = ndimage.maximum_filter(asked, _AROUND_CELLS)
    cells = Raster(raster.low_mm, raster.step_mm * per_cell, shape)
    return PlaceErrors(cells, np.sqrt((fitted**2 + np.square(systematic_px)).reshape(shape) + asked))


@dataclass(frozen=True, eq=False)
class Anchors:
    """Places found by other means, which fix the map where no cells are.

    - `points_mm`: (N, 2) float64.
    - `places_px`: (3, N, 2) float64 where red, green and blue see them; any finite values where they were not measured.
    - `information`: (3, N, 2, 2) float64, inverse covariance of the places, px⁻²; 0 where they were not measured.
    """

    points_mm: _Array
    places_px: _Array
    information: _Array

    def of(self, chosen: _Mask) -> Anchors:
        """Return those chosen (N,)."""
        return Anchors(self.points_mm[chosen], self.places_px[:, chosen], self.information[:, chosen])

    def known_to(self, factor: float) -> Anchors:
        """Return them with standard errors a factor times as large."""
        return Anchors(self.points_mm, self.places_px, self.information / factor**2)

    def pull(self, expected_px: _Array) -> _Array:
        """Return information times the distance (3, N, 2) float64 px⁻¹ from places (3, N, 2) expected."""
        return np.einsum("cnij,cnj->cni", self.information, self.places_px - expected_px)

    def residual_px(self, expected_px: _Array) -> _Array:
        """Return the distance (N, 2) float64 px from places (3, N, 2) expected, the colours' weighted mean."""
        inverse = np.asarray(np.linalg.pinv(self.information.sum(axis=0), rcond=1e-9, hermitian=True), dtype=np.float64)
        return np.einsum("nij,cnj->ni", inverse, self.pull(expected_px))


class Matcher:
    """Compares a frame with the print, in the print's own raster, and moves the map until they coincide.

    - `displacement`: what is added to the lens; zero at first.
    """

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
        # A smooth order of colours, as the paper's, has no more than the steps between neighbouring codes to go by.
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
            low,
            low + self._cells_across * cell,
            float(cell.max()) * max(2.0, min(_KNOT_CELLS, across / 3)),
            lens if self._smooth_order else None,
        )
        self._roughness_px = ROUGHNESS_PX
        self._per_cell = int(np.clip(round(_PER_CELL_PX * cell_px), _LEAST_PER_CELL, _MOST_PER_CELL))
        self._raster = Raster.of(low, cell / self._per_cell, self._cells_across * self._per_cell)
        self._cover = self._raster.coverage(self._centres, self._sizes)
        self._free = self._raster.outside_tags(chart.tags) & self._raster.near(self._cover, self._per_cell)
        if self._smooth_order:
            # The margin's light that is blurred into the outermost cells is stronger than all their steps.
            rim = 2 * int(np.ceil(_RIM_SIGMAS * blur_px / cell_px * self._per_cell)) + 1
            cells = (self._raster.coverage(chart.centres_mm, self._sizes[: chart.colour_count]) > 0).sum(axis=1)
            covered = np.asarray(cells).reshape(self._raster.shape).astype(np.uint8)
            self._free = np.asarray(cv2.erode(covered, np.ones((rim, rim), dtype=np.uint8))).astype(np.bool_)
        self.colours = self._fit_colours()
        self._left: TileComparison | None = None

    def to_pixels(self, points_mm: npt.ArrayLike, channel: Channel = "G") -> _Array:
        """Return the half-size pixels (N, 2) float64 where a channel sees points (N, 2) mm by the map of the moment."""
        places = self.lens.to_pixels(points_mm) + self.displacement.at(points_mm)
        return places + self.lateral.shift_px(places, channel)

    def in_channels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the half-size pixels (3, N, 2) float64 where red, green and blue see points (N, 2) mm."""
        return self.lateral.seen_px(self.to_pixels(points_mm))

    def _seen(self) -> _Array:
        """Return the camera RGB (N, 3) at the middle of every patch, counts, NaN outside the frame."""
        places = self.to_pixels(self._centres)
        seen = np.empty((len(places), 3))
        for column, plane in enumerate(self._planes):
            x, y = (places + self.lateral.shift_px(places, plane.channel) - plane.offset_px).T
            smooth = cv2.blur(plane.values, (3, 3))
            seen[:, column] = ndimage.map_coordinates(smooth, [y, x], order=1, cval=float("nan"))
        return seen

    def patches(self) -> tuple[_Array, _Array, _Array]:
        """Return camera RGB of all patches as seen and as expected, and of bare paper, counts.

        Returns (N, 3) float64 of the cells in the chart's order, then of the references; seen NaN outside the frame.
        Returns (3,) float64.
        """
        self.colours = self._fit_colours()
        return self._seen(), self.colours.seen(self._rgb, self._centres), self._paper()

    def _paper(self) -> _Array:
        """Return camera RGB (3,) of bare paper under even light."""
        return self.colours.flat(np.array([PAPER_WHITE]))[0]

    def _fit_colours(self) -> ColourModel:
        seen = self._seen()
        there = np.flatnonzero(np.isfinite(seen).all(axis=1))
        there = there[:: max(1, len(there) // _COLOUR_PATCHES)]
        return fit_colours(self._rgb[there], self._centres[there], seen[there], self._chart.page_mm, self._smooth_order)

    def _template(self, raster: Raster, cover: sparse.csr_array, sigma: _Array) -> _Float:
        """Return the print as the camera would see it, (H, W, 3) float32; under even light if it has tags.

        `sigma` (2,) along x and y is that of the blur in elements of the raster, interpolation not included.
        """
        flat = self.colours.flat(self._rgb)
        paper = self._paper()
        image = np.asarray(cover @ (flat - paper)) + paper
        image = image.reshape(*raster.shape, 3).astype(np.float32)
        if self._smooth_order:
            image *= raster.smooth(self.colours.light_at)
        x, y = np.hypot(sigma, self._elements(raster, _INTERPOLATION_PX)).tolist()
        return np.asarray(cv2.GaussianBlur(image, (0, 0), x, sigmaY=y), dtype=np.float32)

    def _elements(self, raster: Raster, length_px: float) -> _Array:
        """Return a length in the frame in elements of a raster, (2,) along x and y: cells need not be square."""
        return np.asarray(length_px / self.cell_px * self._cell.min() / raster.step_mm, dtype=np.float64)

    def _rectified(self, raster: Raster) -> tuple[_Float, _Mask]:
        """Return the frame as seen on the print's raster, (H, W, 3) float32, and where it exists, (H, W) bool."""
        places = raster.element_places(self.to_pixels)
        image = np.empty((*raster.shape, 3), dtype=np.float32)
        for channel, plane in enumerate(self._planes):
            own = places
            if plane.channel != "G" and self.lateral.terms_px.any():
                own = raster.element_places(partial(self.to_pixels, channel=plane.channel))
            image[..., channel] = cv2.remap(
                plane.values,
                own[..., 0] - np.float32(plane.offset_px[0]),
                own[..., 1] - np.float32(plane.offset_px[1]),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
        height, width = self._planes[0].values.shape
        there = (places >= 1).all(axis=-1) & (places[..., 0] <= width - 2) & (places[..., 1] <= height - 2)
        return image, there

    def match_coarsely(self, what: str) -> None:
        """Find blocks of cells where they are, up to one and a half cells away, and follow them smoothly."""
        n, across = _COARSE_PER_CELL, int(self._cells_across.min())
        blocks = [int(np.clip(across // 3, 2, cells)) for cells, _ in _COARSE_BLOCKS]
        reaches = [round(n * min(far, 0.25 * blocks[0])) for _, far in _COARSE_BLOCKS]
        # The raster goes on beyond the outermost cells as far as they are looked for, so that blocks reach the rim.
        step, beyond = self._cell / n, max(reaches)
        raster = Raster.of(self._low - beyond * step, step, self._cells_across * n + 2 * beyond)
        cover = raster.coverage(self._centres, self._sizes)
        best = 0.0
        for block, reach in zip(blocks, reaches, strict=True):
            template = self._template(raster, cover, self._elements(raster, max(self.blur_px, 0.7)))
            image, there = self._rectified(raster)
            # What is printed in the margin must not move cells.
            bare = ~raster.near(cover, n)
            image[bare] = template[bare]
            found = find_blocks(raster, template, image, there, block * n, reach, block**2)
            if not len(found.score):
                raise RegistrationError(
                    f"{what}: too little of the chart lies in the picture; bring all of it into the picture"
                )
            centre = found.centres_mm
            best = max(best, float(np.median(found.score)))
            shift = self.to_pixels(centre + found.moves_mm) - self.to_pixels(centre)
            information = found.information(shift, self._cell * block, self.cell_px)
            total = self.displacement.at(centre) + shift
            self.displacement = self.displacement.fitted(
                centre, information, np.einsum("nij,nj->ni", information, total), MOST_ROUGHNESS_PX
            )
            self.colours = self._fit_colours()
        if best < _LEAST_BLOCK_SCORE:
            raise not_this_chart(
                what, f"blocks of cells correlate by {best:.2f} with the chart's, {_LEAST_BLOCK_SCORE:g} expected"
            )

    def follow(self, sigma_cells: float) -> None:
        """Move the map by one Gauss-Newton step of what is coarser than cells.

        Blurred by `sigma_cells`, the steps between cells are gone, and with them the danger to lock onto the
        neighbouring cell; folds of a smooth order and the texture of a random one remain. Where the colours only rise
        evenly a tile measures nothing, and the map goes on smoothly from where others do.
        """
        # What the colours leave is alike over many cells: a window is about one measurement.
        repeat = (_FOLLOWED_CELLS * _COARSE_PER_CELL) ** 2 / _WINDOW_WORTH
        self._move(self._compared_softly(sigma_cells).weakened(repeat))
        self.colours = self._fit_colours()

    def refit_lens(self) -> None:
        """Fit the lens to where the whole field is found, and the sheet's heights to what that leaves.

        An outline alone does not tell a curl from distortion, whose steep corners no smooth displacement takes back.
        """
        points = self._chart.centres_mm[:: max(1, self._chart.colour_count // _LENS_POINTS)]
        places = self.to_pixels(points)
        height, width = self._planes[0].values.shape
        self.lens, left = fit_lens(points, places, (width, height))
        flat = replace(self.displacement, lens=self.lens)
        known = np.broadcast_to(np.eye(2) / _LENS_POINT_SIGMA_PX**2, (len(points), 2, 2))
        self.displacement = flat.fitted(points, known, left / _LENS_POINT_SIGMA_PX**2, self._roughness_px)

    def _compared_softly(self, sigma_cells: float) -> TileComparison:
        n = _COARSE_PER_CELL
        raster = Raster.of(self._low, self._cell / n, self._cells_across * n)
        cover = raster.coverage(self._centres, self._sizes)
        free = raster.outside_tags(self._chart.tags) & raster.near(cover, n)
        template = self._template(raster, cover, np.full(2, sigma_cells * n))
        image, there = self._rectified(raster)
        own = self._elements(raster, self.blur_px)
        image[~free] = self._template(raster, cover, own)[~free]
        x, y = np.sqrt(np.maximum((sigma_cells * n) ** 2 - own**2, 0.01 * n**2)).tolist()
        for channel in range(3):
            image[..., channel] = cv2.GaussianBlur(image[..., channel], (0, 0), x, sigmaY=y)
        weight = (there & free).astype(np.float32)
        window = _FOLLOWED_CELLS * n
        return compare_tiles(
            raster, n, template, image, weight, window, self.to_pixels, self.cell_px, without_gradient=True
        )

    def blocks(self) -> Blocks:
        """Return how each block fits after the last step; a step must have been made."""
        assert self._left is not None
        comparison = self._left
        if self._smooth_order:
            # The steps of dark cells drown in noise; whether these are the chart's colours shows over many cells.
            comparison = replace(comparison, score=self._compared_softly(_BLURRED_CELLS).score)
        return fit_blocks(
            comparison, self._raster, self._per_cell, self._chart, self._block_cells, all_known=self._smooth_order
        )

    def place_errors(self) -> PlaceErrors:
        """Return how well places are known after the last step; a step must have been made."""
        assert self._left is not None
        points, information = self._anchors.points_mm, self._anchors.information.sum(axis=0)
        systematic: _Array | float = SYSTEMATIC_PX
        if self._smooth_order:
            residual = self._anchors.residual_px(self.in_channels(points))
            reach = _KNOT_CELLS * float(self._cell.max())
            departure = rms(self.displacement.at(points))
            unfollowed = unfollowed_px(self._left.points_mm, points, residual, departure, reach)
            systematic = np.hypot(unfollowed, _COLOURS_SHIFT * self.cell_px)
        anchors = points, information
        return place_errors(
            self._left, self._raster, self._per_cell, self.displacement, anchors, systematic, self._smooth_order
        )

    def slipped(self, mismatched_cells: _Mask) -> tuple[_Array, int]:
        """Return the middles (B, 2) mm of parts of the field with their neighbours' colours, and of how many parts.

        `mismatched_cells` (C,) bool are left out.
        """
        seen, expected, paper = self.patches()
        count = self._chart.colour_count
        column, row = np.floor((self._chart.centres_mm - self._low) / self._cell).astype(int).T
        columns, rows = self._cells_across.tolist()
        places, parts = slipped_parts(
            seen[:count], expected[:count], paper, mismatched_cells, (row, column), (rows, columns)
        )
        return self._low + places * self._cell, parts

    def step(self) -> tuple[float, float]:
        """Move the map by one Gauss-Newton step of all cells together; return the RMS and largest movement, px."""
        raster, n = self._raster, self._per_cell
        template = self._template(raster, self._cover, self._elements(raster, self.blur_px))
        image, there = self._rectified(raster)
        weight = (there & self._free).astype(np.float32)
        window = self._block_cells * n
        compared = compare_tiles(
            raster, n, template, image, weight, window, self.to_pixels, self.cell_px, self._smooth_order
        )
        if self._smooth_order:
            compared = compared.weakened(_COLOURS_REPEAT)
        points = compared.points_mm
        before, places = self.displacement, self.to_pixels(points)
        shifted = self.lateral.seen_px(places)
        self.lateral = self.lateral.remeasured(*self._with_anchors(*self._in_blocks(compared, places)))
        compared = compared.after(self.lateral.seen_px(places) - shifted)
        moved = self._move(compared)
        self._left = compared.after(self.displacement.at(points) - before.at(points))
        return moved

    def _in_blocks(self, compared: TileComparison, places_px: _Array) -> tuple[_Array, _Array, _Array]:
        """Return middles (B, 2) px of blocks of cells, and their information (3, B, 2, 2) and pull (3, B, 2)."""
        column, row = np.floor((compared.points_mm - self._low) / (self._cell * self._block_cells)).astype(int).T
        number = row * (column.max() + 1) + column
        count = int(number.max()) + 1

        def summed(values: _Array) -> _Array:
            total = np.zeros((count, *values.shape[1:]))
            np.add.at(total, number, values)
            return total

        tiles = np.maximum(np.bincount(number, minlength=count), 1)
        information, pull = (np.stack([summed(one) for one in channels]) for channels in compared.of_channels)
        return summed(places_px) / tiles[:, None], information, pull

    def _with_anchors(self, places_px: _Array, information: _Array, pull: _Array) -> tuple[_Array, _Array, _Array]:
        """Return what blocks measure channel by channel and, after them, what anchors do; arrays as of `_in_blocks`."""
        anchors = self._anchors
        places = self.in_channels(anchors.points_mm)
        return (
            np.concatenate([places_px, places[CHANNELS.index("G")]]),
            np.concatenate([information, anchors.information], axis=1),
            np.concatenate([pull, anchors.pull(places)], axis=1),
        )

    def _move(self, compared: TileComparison) -> tuple[float, float]:
        """Move the map to where tiles and anchors measured it; return the tiles' RMS and largest movement, px."""
        anchors, points = self._anchors, compared.points_mm
        all_points = np.concatenate([points, anchors.points_mm])
        all_information = np.concatenate([compared.information, anchors.information.sum(axis=0)])
        before = self.displacement.at(all_points)
        anchored = anchors.pull(self.in_channels(anchors.points_mm)).sum(axis=0)
        total = np.concatenate([compared.pull, anchored]) + np.einsum("nij,nj->ni", all_information, before)
        self.displacement = self.displacement.fitted(all_points, all_information, total, self._roughness_px)
        if self._smooth_order:
            # Colours that only rise evenly leave the sheet's shape to what it is taken to be.
            self._roughness_px = self.displacement.likely_roughness_px(all_points, all_information, self._roughness_px)
        moved = (self.displacement.at(all_points) - before)[: len(points)]
        moved = moved[compared.information[:, 0, 0] > 0]
        return rms(moved), float(np.linalg.norm(moved, axis=1).max(initial=0.0))


def not_this_chart(what: str, measured: str) -> RegistrationError:
    """Return the error that the chart seen is another one."""
    return RegistrationError(
        f"{what}: a chart is there, but its cells' colours are not those of the chart: {measured}; "
        "name the chart.json of this print, or uncover it"
    )
