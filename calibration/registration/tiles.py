"""A rectified frame compared with the print as drawn, on a raster on the print: block by block, then tile by tile.

`find_blocks` finds blocks of cells where they are, by correlation, up to one and a half cells away. `compare_tiles`
then says how each tile would move the map: one step of Lucas and Kanade's method, with gain and offset local and free,
and residuals weighted by Huber's function (B. D. Lucas and T. Kanade, "An iterative image registration technique",
IJCAI 1981). Elements, millimetres on the print, and half-size pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import sparse

from experiment.chart.model import TAG_MODULES, Tag
from foundation.robust import robust_sigma

_Array = npt.NDArray[np.float64]

ToPixels = Callable[[_Array], _Array]  # From points (N, 2) mm to places (N, 2) px

# Elements between nodes of the lattice on which maps are computed: bilinear within, they are off by < 0.001 px.
_LATTICE_STRIDE = 8

# Least correlation of a part of the frame with the print as predicted, for it to move the map (judgement).
MIN_SCORE = 0.5

# Share of a tile's surroundings that must be comparable, for its score to mean anything (judgement).
_LEAST_SHARE = 0.25

_Float = npt.NDArray[np.float32]

# Correlation below which a block does not count; other cells than the chart's give about 0, but for chance, which in
# blocks of few cells reaches .4.
_LEAST_SCORE, _LEAST_SCORE_OF_FEW = 0.3, 0.5

_FEW_CELLS = 64  # Cells from which on a block has not few

_NEIGHBOUR_BLOCKS = 1.6  # Blocks that are nearer, in units of their spacing, are neighbours: the eight around

_MOST_DISAGREEMENT = 0.6  # Cells that a block may move otherwise than its neighbours: more is the neighbouring cell

# Standard error of a block's place, in cells: a tenth of an element of the coarse raster, 0.2 px of cells of 10 px
# (simulated frames).
_MOVE_SIGMA_CELLS = 0.02

_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster on the print: element (row, column) has its centre at low + (column + ½, row + ½) · step.

    - `low_mm`: (2,) float64, corner of the first element, x then y.
    - `step_mm`: (2,) float64, an element's width and height.
    """

    low_mm: _Array
    step_mm: _Array
    shape: tuple[int, int]

    @classmethod
    def of(cls, low_mm: _Array, step_mm: _Array, size: _Array) -> Raster:
        """Return the raster that begins at `low_mm` (2,) and has `size` (columns, rows) elements of `step_mm` (2,)."""
        return cls(low_mm, step_mm, (int(size[1]), int(size[0])))

    def point(self, column: float, row: float) -> _Array:
        """Return the place (2,) float64 mm of a border between elements."""
        return self.low_mm + np.array([column, row]) * self.step_mm

    def tiles(self, size: int) -> tuple[int, int]:
        """Return rows and columns of whole tiles of size × size elements."""
        return self.shape[0] // size, self.shape[1] // size

    def points_of_tiles(self, size: int) -> _Array:
        """Return the middles (N, 2) float64 mm of tiles of size × size elements, row by row."""
        rows, columns = self.tiles(size)
        y, x = np.mgrid[:rows, :columns]
        return self.low_mm + (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) * size * self.step_mm

    def _lattice(self, to_pixels: ToPixels) -> tuple[_Array, int]:
        """Return the map (rows, columns, 2) px on a coarse lattice, and its stride: nodes from the first border on."""
        stride = _LATTICE_STRIDE
        rows, columns = (-(-length // stride) + 1 for length in self.shape)
        y, x = np.mgrid[:rows, :columns] * stride
        points = self.low_mm + np.stack([x.ravel(), y.ravel()], axis=-1) * self.step_mm
        return to_pixels(points).reshape(rows, columns, 2), stride

    def element_places(self, to_pixels: ToPixels) -> _Float:
        """Return the places (H, W, 2) float32 px, x then y, of all elements; exact on a lattice, bilinear within."""
        lattice, stride = self._lattice(to_pixels)
        rows, columns = ((np.arange(length) + 0.5) / stride for length in self.shape)
        i, j = rows.astype(int), columns.astype(int)
        v, u = (rows - i)[:, None, None], (columns - j)[None, :, None]
        along = lattice[:, j] * (1 - u) + lattice[:, j + 1] * u
        return (along[i] * (1 - v) + along[i + 1] * v).astype(np.float32)

    def smooth(self, of_points: ToPixels) -> _Float:
        """Return what changes slowly over the print, (H, W, K) float32, from its values (N, K) at points (N, 2) mm."""
        rows, columns = (max(2, length // 32) for length in self.shape)
        y, x = np.mgrid[:rows, :columns]
        low, high = self.low_mm + self.step_mm / 2, self.low_mm + (np.array(self.shape[::-1]) - 0.5) * self.step_mm
        share = np.stack([x.ravel() / (columns - 1), y.ravel() / (rows - 1)], axis=-1)
        coarse = of_points(low + share * (high - low)).reshape(rows, columns, -1).astype(np.float32)
        sizes = zip((columns, rows), self.shape[::-1], strict=True)
        across, down = (np.linspace(0, count - 1, length, dtype=np.float32) for count, length in sizes)
        where_x, where_y = np.meshgrid(across, down)
        return np.asarray(cv2.remap(coarse, where_x, where_y, cv2.INTER_LINEAR), dtype=np.float32)

    def coverage(self, centres_mm: _Array, sizes_mm: _Array) -> sparse.csr_array:
        """Return the share of each element that each rectangle covers, (H · W, N) float32.

        `centres_mm`, `sizes_mm`: (N, 2) float64, x then y.
        """
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
        """Return which elements (H, W) bool are covered by a patch, or lie within a fifth of a cell of one.

        The margin beyond may have anything on it: rulers, text, pins.
        """
        covered = (np.diff(cover.indptr) > 0).reshape(self.shape).astype(np.uint8)
        reach = 2 * max(1, round(0.2 * per_cell)) + 1
        return np.asarray(cv2.dilate(covered, np.ones((reach, reach), dtype=np.uint8))).astype(np.bool_)

    def outside_tags(self, tags: tuple[Tag, ...]) -> _Mask:
        """Return which elements (H, W) bool lie clear of every tag and its white rim."""
        free = np.ones(self.shape, dtype=bool)
        for tag in tags:
            rim = np.ptp(tag.corners_mm, axis=0).max() / TAG_MODULES * 1.5
            low = np.floor((tag.corners_mm.min(axis=0) - rim - self.low_mm) / self.step_mm).astype(int)
            high = np.ceil((tag.corners_mm.max(axis=0) + rim - self.low_mm) / self.step_mm).astype(int)
            low = np.maximum(low, 0)
            free[low[1] : max(high[1], 0), low[0] : max(high[0], 0)] = False
        return free


def tiles(shape: tuple[int, int], size: int, margin: int) -> Generator[tuple[slice, slice]]:
    """Yield rows and columns of tiles of size × size elements, evenly spread, that leave a margin all round."""
    starts: list[npt.NDArray[np.int64]] = []
    for length in shape:
        count = max(1, round((length - 2 * margin) / size))
        starts.append(np.linspace(margin, max(margin, length - margin - size), count).astype(int))
    for row in starts[0]:
        for column in starts[1]:
            if row + size + margin <= shape[0] and column + size + margin <= shape[1]:
                yield slice(int(row), int(row) + size), slice(int(column), int(column) + size)


def jacobians(to_pixels: ToPixels, points_mm: _Array, step_mm: _Array) -> _Array:
    """Return ∂(x, y) px / ∂(column, row) at points (N, 2) mm of a raster with elements of `step_mm` (2,).

    (N, 2, 2) float64.
    """
    reach = np.diag(step_mm)
    slopes = [(to_pixels(points_mm + reach[axis]) - to_pixels(points_mm - reach[axis])) / 2 for axis in (0, 1)]
    return np.stack(slopes, axis=-1)


def to_pixel_units(sums: _Array, jacobians: _Array) -> tuple[_Array, _Array]:
    """Return information (N, 2, 2) px⁻² and pull (N, 2) px⁻¹ of sums (N, 5) xx, xy, yy, xe, ye in raster elements.

    x and y are the image's slopes, e its error; `jacobians` (N, 2, 2) are those of the map; all float64.
    """
    inverse = np.linalg.inv(jacobians)
    matrix = sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    information = np.einsum("nji,njk,nkl->nil", inverse, matrix, inverse)
    return information, -np.einsum("nji,nj->ni", inverse, sums[:, 3:])


def box_mean(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return the mean (H, W) float32 over size × size elements around each of an image (H, W)."""
    return np.asarray(cv2.blur(image, (size, size)), dtype=np.float32)


def sums_of(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return the sums (rows, columns) float32 of an image (H, W) over tiles of size × size; the rest is dropped."""
    rows, columns = (length // size for length in image.shape)
    mean = cv2.resize(image[: rows * size, : columns * size], (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32) * np.float32(size * size)


def tile_middles(image: npt.NDArray[np.floating], size: int) -> npt.NDArray[np.floating]:
    """Return the middle element of each tile, (rows, columns) of the image's dtype, of an image (H, W)."""
    rows, columns = (length // size for length in image.shape)
    return image[size // 2 :: size, size // 2 :: size][:rows, :columns]


@dataclass(frozen=True, eq=False)
class TileComparison:
    """Displacements that the tiles of a raster measure.

    - `points_mm`: (N, 2) float64, the tiles' middles.
    - `information`: (N, 2, 2) float64 px⁻², inverse covariance of the displacement that each tile measures; 0 where it
      is not used.
    - `pull`: (N, 2) float64 px⁻¹, information times the measured displacement.
    - `score`: (N,) float64, correlation of frame and print around each tile, −1 … 1; 0 where nothing can be compared.
    - `of_channels`: (3, N, 2, 2) and (3, N, 2) float64, what red, green and blue contribute to information and pull.
    """

    points_mm: _Array
    information: _Array
    pull: _Array
    score: _Array
    of_channels: tuple[_Array, _Array]

    @classmethod
    def of(cls, points_mm: _Array, information: _Array, pull: _Array, score: _Array) -> TileComparison:
        """Return the comparison from the channels' information (3, N, 2, 2) and pull (3, N, 2)."""
        return cls(points_mm, information.sum(axis=0), pull.sum(axis=0), score, (information, pull))

    def after(self, moved_px: _Array) -> TileComparison:
        """Return what is left to do once the map has moved by (N, 2) px at the tiles.

        `moved_px` may be (3, N, 2), of red, green and blue each its own.
        """
        information, pull = self.of_channels
        moved = np.broadcast_to(moved_px, pull.shape)
        return self.of(self.points_mm, information, pull - np.einsum("cnij,cnj->cni", information, moved), self.score)

    def weakened(self, times: float) -> TileComparison:
        """Return the same with the weight of fewer measurements: one for each `times` that repeat each other."""
        information, pull = self.of_channels
        return self.of(self.points_mm, information / times, pull / times, self.score)


def compare_tiles(
    raster: Raster,
    size: int,
    expected: _Float,
    seen: _Float,
    weight: _Float,
    window: int,
    to_pixels: ToPixels,
    cell_px: float,
    without_gradient: bool = False,
) -> TileComparison:
    """Return how tiles of size × size elements would move the map by which a frame was rectified.

    `raster`, `size`: the raster (H, W), and the elements of a tile along a side. `expected`, `seen`: (H, W, 3) float32
    counts, the print as it should be seen and the frame. `weight`: (H, W) float32, 1 where they can be compared, else
    0. `to_pixels`: the map, from points (N, 2) mm to places (N, 2) px.
    """
    mean = _LocalMean(weight, window, without_gradient)
    agreeing = np.zeros(raster.shape, dtype=np.float32)
    expected_power, seen_power = np.zeros_like(agreeing), np.zeros_like(agreeing)
    sums = np.zeros((3, *raster.tiles(size), 5), dtype=np.float64)
    for channel in range(3):
        model, values = expected[..., channel], seen[..., channel]
        gy, gx = np.gradient(model)
        model = (model - mean(model)) * weight
        values = (values - mean(values)) * weight
        power, common = box_mean(model * model, window), box_mean(model * values, window)
        gain = common / np.maximum(power, np.float32(1e-6))
        error = values - gain * model
        magnitude = np.abs(error)
        noise = np.float32(robust_sigma(magnitude[::3, ::3][weight[::3, ::3] > 0]) + 1e-3)
        agreeing += common / noise**2
        expected_power += power / noise**2
        seen_power += box_mean(values * values, window) / noise**2
        huber = weight / np.maximum(noise * noise, 0.5 * noise * magnitude)
        if without_gradient:
            gx, gy = ((slope - mean(slope)) * weight for slope in (gx, gy))
            gx, gy = (
                slope - model * box_mean(slope * model, window) / np.maximum(power, np.float32(1e-6))
                for slope in (gx, gy)
            )
        gx, gy = gx * gain, gy * gain
        for place, (one, other) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, error), (gy, error))):
            sums[channel, ..., place] = sums_of(huber * one * other, size)
    score = agreeing / np.sqrt(np.maximum(expected_power * seen_power, np.float32(1e-6)))
    score *= mean.share > _LEAST_SHARE
    points = raster.points_of_tiles(size)
    slopes = jacobians(to_pixels, points, raster.step_mm)
    units = [to_pixel_units(one.reshape(-1, 5), slopes) for one in sums]
    information, pull = np.stack([one for one, _ in units]), np.stack([one for _, one in units])
    # Neighbouring raster elements repeat each other's noise where they are finer than the photosites.
    repeat = max(1.0, (size / cell_px) ** 2)
    score = tile_middles(score, size).ravel().astype(np.float64)
    good = (score >= MIN_SCORE) / repeat
    return TileComparison.of(points, information * good[:, None, None], pull * good[:, None], score)


class _LocalMean:
    """The mean over a window around each element, of those that count.

    `share` (H, W) float32 is how much of each window counts.
    """

    def __init__(self, weight: _Float, window: int, keep_gradient: bool) -> None:
        self._weight, self._window = weight, window
        self.share = np.maximum(box_mean(weight, window), np.float32(1e-3))
        rows, columns = (np.flatnonzero(weight.any(axis=axis)) for axis in (1, 0))
        self._inner: tuple[slice, slice] | None = None
        if keep_gradient and min(len(rows), len(columns)) > window:
            self._inner = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    def __call__(self, image: _Float) -> _Float:
        """Return the mean (H, W); an even gradient that is kept is its own mean up to the border of what counts."""
        if self._inner is None:
            return np.asarray(box_mean(image * self._weight, self._window) / self.share, dtype=np.float32)
        around = self._window // 2 + 1
        padded = np.pad(image[self._inner], around, mode="reflect", reflect_type="odd")
        mean = np.zeros_like(image)
        mean[self._inner] = box_mean(padded, self._window)[around:-around, around:-around]
        return mean


@dataclass(frozen=True, eq=False)
class FoundBlocks:
    """Where blocks of cells were found.

    - `centres_mm`: (B, 2) float64, where the map has them, on the print.
    - `moves_mm`: (B, 2) float64, how far from there they were found, on the print.
    - `score`: (B,) float64, correlation with the print, −1 … 1.
    - `least_score`: below it a block does not count.
    """

    centres_mm: _Array
    moves_mm: _Array
    score: _Array
    least_score: float = _LEAST_SCORE

    def information(self, moves_px: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
        """Return the inverse covariance (B, 2, 2) float64 px⁻² of the blocks' places.

        `moves_px`: (B, 2) the moves in the frame. `spacing_mm`: (2,) distance of blocks in x and y.
        """
        score = np.where(self.score > self.least_score, self.score, 0.0)
        weight = _weights(self.centres_mm, moves_px, score, spacing_mm, cell_px)
        return (weight / (_MOVE_SIGMA_CELLS * cell_px) ** 2)[:, None, None] * np.eye(2)


def find_blocks(
    raster: Raster, expected: _Float, seen: _Float, there: _Mask, size: int, reach: int, cells: int
) -> FoundBlocks:
    """Return where square blocks of the print are found in a rectified frame, by normalised correlation.

    `raster`: the raster (H, W). `expected`, `seen`: (H, W, 3) float32 counts, the print as it should be seen and the
    frame. `there`: (H, W) bool, where the frame exists; blocks beyond are left out.
    """
    # Square roots keep a bright light's gradient from deciding; noise is even after it too (Anscombe 1948).
    expected, seen = (np.sqrt(np.maximum(picture, 0)) for picture in (expected, seen))
    centres: list[_Array] = []
    moves: list[_Array] = []
    scores: list[float] = []
    for rows, columns in tiles(raster.shape, size, reach):
        if not there[rows, columns].all():
            continue
        wide = np.s_[rows.start - reach : rows.stop + reach, columns.start - reach : columns.stop + reach]
        match = cv2.matchTemplate(seen[wide], expected[rows, columns], cv2.TM_CCOEFF_NORMED)
        score, move = _peak(np.nan_to_num(np.asarray(match, dtype=np.float64)))
        centres.append(raster.point(0.5 * (columns.start + columns.stop), 0.5 * (rows.start + rows.stop)))
        moves.append(move - reach)
        scores.append(score)
    return FoundBlocks(
        np.array(centres).reshape(-1, 2),
        np.array(moves).reshape(-1, 2) * raster.step_mm,
        np.array(scores),
        _LEAST_SCORE if cells >= _FEW_CELLS else _LEAST_SCORE_OF_FEW,
    )


def _peak(match: _Array) -> tuple[float, _Array]:
    """Return the height and place (x, y) of a correlation's peak, by a parabola through its neighbours."""
    row, column = np.unravel_index(int(np.argmax(match)), match.shape)
    place = np.array([column, row], dtype=np.float64)
    for axis, (at, length) in enumerate(((int(column), match.shape[1]), (int(row), match.shape[0]))):
        if 0 < at < length - 1:
            line = match[row, at - 1 : at + 2] if axis == 0 else match[at - 1 : at + 2, column]
            bend = line[0] - 2 * line[1] + line[2]
            if bend < 0:
                place[axis] += 0.5 * (line[0] - line[2]) / bend
    return float(match[row, column]), place


def _weights(centres_mm: _Array, moves_px: _Array, score: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
    """Return the weight (B,) of each block: its score squared, 0 where it is 0 or the neighbours disagree."""
    apart = np.abs(centres_mm[:, None] - centres_mm[None]) / spacing_mm
    near = np.asarray((apart < _NEIGHBOUR_BLOCKS).all(axis=-1))
    weight = score**2
    for index in range(len(score)):
        around = near[index] & (score > 0)
        usual = np.median(moves_px[around], axis=0) if around.sum() >= 3 else moves_px[index]
        if np.linalg.norm(moves_px[index] - usual) > _MOST_DISAGREEMENT * cell_px:
            weight[index] = 0.0
    return weight
