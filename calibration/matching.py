"""The cells held against the print until they coincide: what tags and lens leave is measured on the cells themselves.

Laws that hold inside:

- The frame is rectified to the print, compared with the print's colours as the camera sees them (a colour model fitted
  on the frame itself), and a smooth displacement is fitted to what does not coincide.
- First whole blocks are found where they are, by correlation; then all cells move together, by Gauss-Newton steps.
  Without the first the second locks onto the neighbouring cell.
- All colours are used, each in its own place: red and blue photosites lie a quarter pixel beside the blocks' centres.

Source: B. D. Lucas and T. Kanade, "An iterative image registration technique", IJCAI 1981.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse

from acquisition.chart import Chart
from acquisition.homography import rms
from acquisition.planes import Plane
from calibration.colours import ColourModel, fit_colours
from calibration.displacement import Displacement
from calibration.lens import Lens
from calibration.raster import Raster, box, jacobians, sums_of, tile_middles, tiles, to_pixel_units
from drivers.errors import RegistrationError

MIN_BLOCK_SCORE = 0.5

_COARSE_CELLS = 10
_BLOCK_CELLS = 8
_KNOT_CELLS = 5
_COARSE_PER_CELL = 5
_COLOUR_PATCHES = 5000
_INTERPOLATION_PX = 0.28
"""σ that cubic interpolation adds to a frame's edges: measured on edges of σ 0.4 to 0.7 px, less where they are softer.
Without it in the template, cells are found half as well again."""

_LEAST_INFORMATION = 4.0
"""px⁻²: a block that knows its place no better than half a pixel says nothing."""

_Float = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


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
class Anchors:
    """Places found otherwise that hold the map where no cells are.

    Attributes
    ----------
    points_mm
        (N, 2) float64.
    places_px
        (N, 2) float64 where they are seen.
    information
        (N, 2, 2) float64, inverse covariance of the places, px⁻².
    """

    points_mm: _Array
    places_px: _Array
    information: _Array


class Matcher:
    """Compares a frame with the print, in the print's own raster, and moves the map until they coincide."""

    def __init__(
        self, chart: Chart, planes: list[Plane], lens: Lens, anchors: Anchors, blur_px: float, cell_px: float
    ) -> None:
        self._chart = chart
        self._planes = planes
        self.lens = lens
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
            low, low + self._cells_across * cell, float(cell.max()) * max(2.0, min(_KNOT_CELLS, across / 3))
        )
        self._per_cell = int(np.clip(round(0.8 * cell_px), 8, 16))
        self._raster = Raster.of(low, cell / self._per_cell, self._cells_across * self._per_cell)
        self._cover = self._raster.coverage(self._centres, self._sizes)
        self._free = self._raster.outside_tags(chart.tags) & self._raster.near(self._cover, self._per_cell)
        self.colours = self._fit_colours()
        self.blocks = Blocks(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the half-size pixels (N, 2) of points (N, 2) mm by the map of the moment."""
        return self.lens.to_pixels(points_mm) + self.displacement.at(points_mm)

    def _seen(self) -> _Array:
        """Return the camera RGB (N, 3) at the middle of every patch, NaN outside the frame."""
        places = self.to_pixels(self._centres)
        seen = np.empty((len(places), 3))
        for column, plane in enumerate(self._planes):
            x, y = (places - plane.offset_px).T
            smooth = cv2.blur(plane.values, (3, 3))
            seen[:, column] = ndimage.map_coordinates(smooth, [y, x], order=1, cval=float("nan"))
        return seen

    def patches(self) -> tuple[_Array, _Array, _Array]:
        """Return camera RGB (N, 3) of all patches as seen and as wanted, NaN outside the frame, and paper's (3,)."""
        self.colours = self._fit_colours()
        paper = self.colours.flat(np.array([[255, 255, 255]]))[0]
        return self._seen(), self.colours.seen(self._rgb, self._centres), paper

    def _fit_colours(self) -> ColourModel:
        seen = self._seen()
        there = np.flatnonzero(np.isfinite(seen).all(axis=1))
        # Some thousand patches tell a polynomial all they can.
        there = there[:: max(1, len(there) // _COLOUR_PATCHES)]
        return fit_colours(self._rgb[there], self._centres[there], seen[there], self._chart.page_mm)

    def _template(self, raster: Raster, cover: sparse.csr_array, blur_px: float) -> _Float:
        """Return the print as the camera would see it, (H, W, 3) float32, under even light."""
        flat = self.colours.flat(self._rgb)
        paper = self.colours.flat(np.array([[255, 255, 255]]))[0]
        image = np.asarray(cover @ (flat - paper)) + paper
        image = image.reshape(*raster.shape, 3).astype(np.float32)
        blurred = float(np.hypot(blur_px, _INTERPOLATION_PX))
        sigma = blurred / self.cell_px * self._cell / raster.step_mm
        return np.asarray(cv2.GaussianBlur(image, (0, 0), float(sigma[0]), sigmaY=float(sigma[1])), dtype=np.float32)

    def _rectified(self, raster: Raster) -> tuple[_Float, _Mask]:
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
        raster = Raster.of(self._low, self._cell / _COARSE_PER_CELL, self._cells_across * _COARSE_PER_CELL)
        cover = raster.coverage(self._centres, self._sizes)
        block = int(np.clip(self._cells_across.min() // 3, 2, _COARSE_CELLS))
        reach = round(_COARSE_PER_CELL * min(1.5, 0.25 * block))
        best = 0.0
        for _ in range(2):
            template = self._template(raster, cover, max(self.blur_px, 0.7))
            image, there = self._rectified(raster)
            # What is printed in the margin is no cell's business.
            bare = ~raster.near(cover, _COARSE_PER_CELL)
            image[bare] = template[bare]
            # Square roots keep a bright light's gradient from deciding; noise is even after it too (Anscombe 1948).
            pair = [np.sqrt(np.maximum(picture, 0)) for picture in (template, image)]
            centres: list[_Array] = []
            moves: list[_Array] = []
            scores: list[float] = []
            for rows, columns in tiles(raster.shape, block * _COARSE_PER_CELL, reach):
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
            weight = _trusted(centre, shift, score, self._cell * block, self.cell_px)
            information = (weight / (0.05 * self.cell_px) ** 2)[:, None, None] * np.eye(2)
            total = self.displacement.at(centre) + shift
            self.displacement = self.displacement.fitted(
                centre, information, np.einsum("nij,nj->ni", information, total)
            )
            self.colours = self._fit_colours()
        if best < 0.3:
            raise not_this_chart(what, f"blocks of cells correlate by {best:.2f} with the chart's, 0.3 expected")

    def step(self) -> float:
        """Move the map by one Gauss-Newton step of all cells together; return the RMS movement, px."""
        points, information, pull, score = self._measure()
        anchors = self._anchors
        all_points = np.concatenate([points, anchors.points_mm])
        all_information = np.concatenate([information, anchors.information])
        before = self.displacement.at(all_points)
        off = anchors.places_px - self.to_pixels(anchors.points_mm)
        anchored = np.einsum("nij,nj->ni", anchors.information, off)
        total = np.concatenate([pull, anchored]) + np.einsum("nij,nj->ni", all_information, before)
        self.displacement = self.displacement.fitted(all_points, all_information, total)
        moved = (self.displacement.at(all_points) - before)[: len(points)]
        # What the cells still ask for after the step is what they asked for less what they got.
        left = pull - np.einsum("nij,nj->ni", information, moved)
        self.blocks = self._blocks(information, left, score)
        seen = information[:, 0, 0] > 0
        return rms(moved[seen])

    def _measure(self) -> tuple[_Array, _Array, _Array, _Array]:
        """Return places (N, 2) mm, information (N, 2, 2), pull (N, 2) and score (N,) of every cell-sized square."""
        raster, n = self._raster, self._per_cell
        template = self._template(raster, self._cover, self.blur_px)
        image, there = self._rectified(raster)
        there &= self._free
        window = self._block_cells * n
        weight = there.astype(np.float32)
        share = np.maximum(box(weight, window), np.float32(1e-3))
        agreeing = np.zeros(raster.shape, dtype=np.float32)
        wanted_power, seen_power = np.zeros_like(agreeing), np.zeros_like(agreeing)
        sums = np.zeros((*raster.tiles(n), 5), dtype=np.float64)
        for channel in range(3):
            wanted, seen = template[..., channel], image[..., channel]
            gy, gx = np.gradient(wanted)
            # Gain and offset are local, as the light and the lens's shading are.
            wanted = (wanted - box(wanted * weight, window) / share) * weight
            seen = (seen - box(seen * weight, window) / share) * weight
            power, common = box(wanted * wanted, window), box(wanted * seen, window)
            gain = common / np.maximum(power, np.float32(1e-6))
            error = seen - gain * wanted
            size = np.abs(error)
            noise = np.float32(1.4826 * float(np.median(size[::3, ::3][there[::3, ::3]])) + 1e-3)
            agreeing += common / noise**2
            wanted_power += power / noise**2
            seen_power += box(seen * seen, window) / noise**2
            huber = weight / np.maximum(noise * noise, 0.5 * noise * size)
            gx *= gain
            gy *= gain
            for place, (one, other) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, error), (gy, error))):
                sums[..., place] += sums_of(huber * one * other, n)
        score = agreeing / np.sqrt(np.maximum(wanted_power * seen_power, np.float32(1e-6)))
        score *= share > 0.25
        points = raster.points_oftiles(n)
        information, pull = to_pixel_units(sums.reshape(-1, 5), jacobians(self.to_pixels, points, raster.step_mm))
        # Neighbouring raster elements repeat each other's noise where they are finer than the photosites.
        repeat = max(1.0, (n / self.cell_px) ** 2)
        score = tile_middles(score, n).ravel().astype(np.float64)
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
        points = self._raster.points_oftiles(self._per_cell)
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


def not_this_chart(what: str, measured: str) -> RegistrationError:
    """Return that the chart seen is another one."""
    return RegistrationError(
        f"{what}: the tags fit, but the cells' colours are not those of the chart: {measured}; "
        "name the chart.json of this print, or uncover it"
    )


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
