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

from acquisition.chart.model import Chart
from acquisition.framing.homography import rms
from acquisition.framing.planes import Plane
from calibration.registration.colour_model import ColourModel, fit_colours
from calibration.registration.displacement import Displacement
from calibration.registration.lens import Lens
from calibration.registration.raster import Raster, box, jacobians, sums_of, tile_middles, tiles, to_pixel_units
from foundation.errors import RegistrationError
from foundation.robust import sigma_of

MIN_BLOCK_SCORE = 0.5

_COARSE_CELLS = 10
_BLOCK_CELLS = 8
_KNOT_CELLS = 5
_COARSE_PER_CELL = 5
_FOLLOWED_CELLS = 12
_WINDOW_WORTH = 4
_RIM_SIGMAS = 3.0
_COLOURS_REPEAT = 10
"""How many neighbouring elements the misfit of the colours is alike over, where steps of colour are all there is."""

_SLIP_CELLS = 16
_SLIP = 0.5
_SLIP_SIGMAS = 6.0
_PART_WORTH = 8
_COLOUR_MISFIT, _MOST_NOISE = 0.003, 0.01
"""Of paper white: what the model of the colours leaves, and what noise may count for beside it."""

_STRANGE = 20.0
_LOOK_CELLS = 0.6
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
        # An even order, as the paper's, has no more than the steps between neighbouring codes to go by.
        self._finely = not chart.tags
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
        if self._finely:
            # The margin's light that is blurred into the outermost cells is stronger than all their steps.
            rim = 2 * int(np.ceil(_RIM_SIGMAS * blur_px / cell_px * self._per_cell)) + 1
            cells = (self._raster.coverage(chart.centres_mm, self._sizes[: chart.colour_count]) > 0).sum(axis=1)
            covered = np.asarray(cells).reshape(self._raster.shape).astype(np.uint8)
            self._free = np.asarray(cv2.erode(covered, np.ones((rim, rim), dtype=np.uint8))).astype(np.bool_)
        self.colours = self._fit_colours()
        self._left = np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros(0)

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
        return fit_colours(self._rgb[there], self._centres[there], seen[there], self._chart.page_mm, self._finely)

    def _template(self, raster: Raster, cover: sparse.csr_array, sigma: _Array) -> _Float:
        """Return the print as the camera would see it, (H, W, 3) float32; under even light if it has tags.

        `sigma` (2,) along x and y is that of the blur in elements of the raster, interpolation not included.
        """
        flat = self.colours.flat(self._rgb)
        paper = self.colours.flat(np.array([[255, 255, 255]]))[0]
        image = np.asarray(cover @ (flat - paper)) + paper
        image = image.reshape(*raster.shape, 3).astype(np.float32)
        if self._finely:
            image *= raster.smooth(self.colours.light_at)
        x, y = np.hypot(sigma, self._elements(raster, _INTERPOLATION_PX)).tolist()
        return np.asarray(cv2.GaussianBlur(image, (0, 0), x, sigmaY=y), dtype=np.float32)

    def _elements(self, raster: Raster, length_px: float) -> _Array:
        """Return a length in the frame in elements of a raster, (2,) along x and y: cells need not be square."""
        return np.asarray(length_px / self.cell_px * self._cell.min() / raster.step_mm, dtype=np.float64)

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
            template = self._template(raster, cover, self._elements(raster, max(self.blur_px, 0.7)))
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

    def follow(self, sigma_cells: float) -> float:
        """Move the map by one Gauss-Newton step of what is coarser than cells; return the RMS movement, px.

        Blurred by `sigma_cells`, the steps between cells are gone, and with them the danger to lock onto the
        neighbouring cell; folds of a smooth order and the texture of a random one remain. Where the colours only rise
        evenly nothing can be told, and nothing is claimed: the map goes on smoothly from where it can.
        """
        points, information, pull, _ = self._compared_softly(sigma_cells)
        # What the colours leave is alike over many cells: a window is about one measurement.
        repeat = (_FOLLOWED_CELLS * _COARSE_PER_CELL) ** 2 / _WINDOW_WORTH
        moved = self._move(points, information / repeat, pull / repeat)
        self.colours = self._fit_colours()
        return moved

    def _compared_softly(self, sigma_cells: float) -> tuple[_Array, _Array, _Array, _Array]:
        """Return what `_compared` does of print and frame, both blurred by some cells."""
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
        return self._compared(raster, n, template, image, weight, _FOLLOWED_CELLS * n, even=True)

    def blocks(self) -> Blocks:
        """Return how each block fits after the last step."""
        information, pull, score = self._left
        if self._finely:
            # The steps of dark cells drown in noise; whether these are the chart's colours shows over many cells.
            score = self._compared_softly(_LOOK_CELLS)[3]
        return self._blocks(information, pull, score)

    def slipped(self, strangers: _Mask) -> tuple[_Array, int]:
        """Return the middles (B, 2) mm of parts of the field that look like their neighbours, and of how many parts.

        By the colours' own level, which steps and correlations do not look at: what is seen less what is wanted is
        held against what the next cell would change, part by part. `strangers` (N,) are cells left out.
        """
        seen, wanted, paper = self.patches()
        count = self._chart.colour_count
        column, row = np.floor((self._chart.centres_mm - self._low) / self._cell).astype(int).T
        columns, rows = self._cells_across
        grid = np.full((2, rows + 2, columns + 2, 3), np.nan)
        for picture, colours in zip(grid, (seen, wanted), strict=True):
            picture[row + 1, column + 1] = colours[:count]
        grid[0, row[strangers] + 1, column[strangers] + 1] = np.nan
        error = (grid[0] - grid[1])[1:-1, 1:-1]
        # Noise, from neighbour to neighbour, and what a model of colours leaves; a slip must not count as usual.
        noise = 1.0484 * np.nanmedian(np.abs(np.diff(error, axis=1)), axis=(0, 1))
        usual = np.hypot(np.minimum(noise, _MOST_NOISE * paper), _COLOUR_MISFIT * paper) + 1e-9
        steps = (
            (grid[1, 1:-1, 2:] - grid[1, 1:-1, :-2]) / 2 / usual,
            (grid[1, 2:, 1:-1] - grid[1, :-2, 1:-1]) / 2 / usual,
        )
        error = np.clip(error / usual, -_STRANGE, _STRANGE)
        places: list[_Array] = []
        parts_seen = 0
        size = int(np.clip(min(rows, columns) // 2, 4, _SLIP_CELLS))
        for top in range(0, rows, size):
            for left in range(0, columns, size):
                part = np.s_[top : top + size, left : left + size]
                parts = [picture[part].ravel() for picture in (*steps, error)]
                known = np.isfinite(parts).all(axis=0)
                if known.sum() < size**2:
                    continue
                parts_seen += 1
                design = np.stack([values[known] for values in parts[:2]], axis=1)
                gram = design.T @ design
                slip = np.linalg.solve(gram + 1e-9 * np.eye(2), design.T @ parts[2][known])
                # The misfit of the colours is alike over many cells: a part tells a few things only.
                sure = np.sqrt(np.diag(gram) * _PART_WORTH / known.sum())
                if ((np.abs(slip) > _SLIP) & (np.abs(slip) * sure > _SLIP_SIGMAS)).any():
                    places.append(self._low + (np.array([left, top]) + size / 2) * self._cell)
        return np.array(places).reshape(-1, 2), parts_seen

    def step(self) -> float:
        """Move the map by one Gauss-Newton step of all cells together; return the RMS movement, px."""
        raster, n = self._raster, self._per_cell
        template = self._template(raster, self._cover, self._elements(raster, self.blur_px))
        image, there = self._rectified(raster)
        weight = (there & self._free).astype(np.float32)
        points, information, pull, score = self._compared(
            raster, n, template, image, weight, self._block_cells * n, self._finely
        )
        if self._finely:
            information, pull = information / _COLOURS_REPEAT, pull / _COLOURS_REPEAT
        before = self.displacement
        moved = self._move(points, information, pull)
        # What the cells still ask for after the step is what they asked for less what they got.
        got = self.displacement.at(points) - before.at(points)
        self._left = information, pull - np.einsum("nij,nj->ni", information, got), score
        return moved

    def _move(self, points: _Array, information: _Array, pull: _Array) -> float:
        """Move the map to where measured places (N, 2) and the anchors ask for; return the RMS movement, px."""
        anchors = self._anchors
        all_points = np.concatenate([points, anchors.points_mm])
        all_information = np.concatenate([information, anchors.information])
        before = self.displacement.at(all_points)
        off = anchors.places_px - self.to_pixels(anchors.points_mm)
        anchored = np.einsum("nij,nj->ni", anchors.information, off)
        total = np.concatenate([pull, anchored]) + np.einsum("nij,nj->ni", all_information, before)
        self.displacement = self.displacement.fitted(all_points, all_information, total)
        moved = (self.displacement.at(all_points) - before)[: len(points)]
        return rms(moved[information[:, 0, 0] > 0])

    def _compared(
        self, raster: Raster, n: int, template: _Float, image: _Float, weight: _Float, window: int, even: bool = False
    ) -> tuple[_Array, _Array, _Array, _Array]:
        """Return places (N, 2) mm, information (N, 2, 2), pull (N, 2) and score (N,) of tiles of n × n elements.

        Parameters
        ----------
        raster, n
            The raster, and the elements of a tile along a side.
        template, image
            (H, W, 3) the print as it should be seen and the frame.
        weight
            (H, W) 1 where they can be compared, else 0.
        window
            Elements over which gain and offset are thought constant.
        even
            Whether what an even gradient could tell is left out, as an offset explains it as well as a movement does.
        """
        mean = _Mean(weight, window, even)
        agreeing = np.zeros(raster.shape, dtype=np.float32)
        wanted_power, seen_power = np.zeros_like(agreeing), np.zeros_like(agreeing)
        sums = np.zeros((*raster.tiles(n), 5), dtype=np.float64)
        for channel in range(3):
            wanted, seen = template[..., channel], image[..., channel]
            gy, gx = np.gradient(wanted)
            # Gain and offset are local, as the light and the lens's shading are.
            wanted = (wanted - mean(wanted)) * weight
            seen = (seen - mean(seen)) * weight
            power, common = box(wanted * wanted, window), box(wanted * seen, window)
            gain = common / np.maximum(power, np.float32(1e-6))
            error = seen - gain * wanted
            size = np.abs(error)
            noise = np.float32(sigma_of(size[::3, ::3][weight[::3, ::3] > 0]) + 1e-3)
            agreeing += common / noise**2
            wanted_power += power / noise**2
            seen_power += box(seen * seen, window) / noise**2
            huber = weight / np.maximum(noise * noise, 0.5 * noise * size)
            if even:
                gx, gy = ((slope - mean(slope)) * weight for slope in (gx, gy))
                gx, gy = (
                    slope - wanted * box(slope * wanted, window) / np.maximum(power, np.float32(1e-6))
                    for slope in (gx, gy)
                )
            gx, gy = gx * gain, gy * gain
            for place, (one, other) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, error), (gy, error))):
                sums[..., place] += sums_of(huber * one * other, n)
        score = agreeing / np.sqrt(np.maximum(wanted_power * seen_power, np.float32(1e-6)))
        score *= mean.share > 0.25
        points = raster.points_of_tiles(n)
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
        return Blocks(centres[used], np.where(known | self._finely, mean, 0.0)[used], residual[used])


class _Mean:
    """The mean over a window around each element, of those that count."""

    def __init__(self, weight: _Float, window: int, even: bool) -> None:
        self._weight, self._window = weight, window
        self.share = np.maximum(box(weight, window), np.float32(1e-3))
        rows, columns = (np.flatnonzero(weight.any(axis=axis)) for axis in (1, 0))
        self._inner = None
        if even and min(len(rows), len(columns)) > window:
            self._inner = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    def __call__(self, image: _Float) -> _Float:
        """Return the mean (H, W); if even, an even gradient is its own mean up to the border of what counts."""
        if self._inner is None:
            return np.asarray(box(image * self._weight, self._window) / self.share, dtype=np.float32)
        around = self._window // 2 + 1
        padded = np.pad(image[self._inner], around, mode="reflect", reflect_type="odd")
        mean = np.zeros_like(image)
        mean[self._inner] = box(padded, self._window)[around:-around, around:-around]
        return mean


def not_this_chart(what: str, measured: str) -> RegistrationError:
    """Return that the chart seen is another one."""
    return RegistrationError(
        f"{what}: a chart is there, but its cells' colours are not those of the chart: {measured}; "
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
