"""Compare a rectified frame with the predicted image of the print, in blocks or in tiles of a raster on the print.

`find_blocks` locates blocks of patches by correlation. `compare_tiles` estimates the displacement of each tile with one
step of the method of Lucas and Kanade, with local gain and offset, and Huber weights (B. D. Lucas and T. Kanade, "An
iterative image registration technique", IJCAI 1981). Lengths are in raster elements, mm on the print, or half-size
pixels. `information` is the inverse covariance of a displacement; `pull` is information times displacement.
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

ToPixels = Callable[[_Array], _Array]  # from points (N, 2) mm to positions (N, 2) px

# Spacing of raster nodes whose positions in the frame are calculated exactly, in elements. Others are interpolated.
_LATTICE_STRIDE = 8

# Minimum correlation of frame and predicted print around a tile; other tiles are not used. Chosen by judgement.
MIN_SCORE = 0.5

# Minimum share of comparable elements in the window of a tile; otherwise its score is 0. Chosen by judgement.
_MIN_SHARE = 0.25

_Float = npt.NDArray[np.float32]

# Minimum correlation of a located block, and of a block with few patches. Another chart gives about 0, but blocks with
# few patches may reach 0.4 by chance.
_MIN_BLOCK_SCORE, _MIN_SMALL_BLOCK_SCORE = 0.3, 0.5

_FEW_CELLS = 64  # Blocks with fewer patches need the higher correlation

_NEIGHBOUR_BLOCKS = 1.6  # Distance limit of neighbours, in block spacings: it includes the eight surrounding blocks

# Largest difference between the displacements of a block and its neighbours, in patches; above it, the match is wrong.
_MAX_DISAGREEMENT_CELLS = 0.6

# Standard uncertainty of the position of a block, in patches (simulated frames).
_MOVE_SIGMA_CELLS = 0.02

_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Raster:
    """Raster on the print. The centre of element (row, column) is `low_mm` + (column + ½, row + ½) · `step_mm`."""

    low_mm: _Array  # (2,) corner of the first element, x then y
    step_mm: _Array  # (2,) width and height of an element
    shape: tuple[int, int]

    @classmethod
    def of(cls, low_mm: _Array, step_mm: _Array, size: _Array) -> Raster:
        """Return the raster with corner `low_mm` (2,) and `size` (columns, rows) elements of `step_mm` (2,)."""
        return cls(low_mm, step_mm, (int(size[1]), int(size[0])))

    def point(self, column: float, row: float) -> _Array:
        """Return the position (2,) float64 mm of raster coordinates; integers are borders between elements."""
        return self.low_mm + np.array([column, row]) * self.step_mm

    def tiles(self, size: int) -> tuple[int, int]:
        """Return the number of rows and columns of complete tiles of size × size elements."""
        return self.shape[0] // size, self.shape[1] // size

    def points_of_tiles(self, size: int) -> _Array:
        """Return the centres (N, 2) float64 mm of tiles of size × size elements, row by row."""
        rows, columns = self.tiles(size)
        y, x = np.mgrid[:rows, :columns]
        return self.low_mm + (np.stack([x.ravel(), y.ravel()], axis=-1) + 0.5) * size * self.step_mm

    def _lattice(self, to_pixels: ToPixels) -> tuple[_Array, int]:
        stride = _LATTICE_STRIDE
        rows, columns = (-(-length // stride) + 1 for length in self.shape)
        y, x = np.mgrid[:rows, :columns] * stride
        points = self.low_mm + np.stack([x.ravel(), y.ravel()], axis=-1) * self.step_mm
        return to_pixels(points).reshape(rows, columns, 2), stride

    def element_positions(self, to_pixels: ToPixels) -> _Float:
        """Return positions (H, W, 2) float32 px of all elements, x then y, interpolated between exact nodes."""
        lattice, stride = self._lattice(to_pixels)
        rows, columns = ((np.arange(length) + 0.5) / stride for length in self.shape)
        i, j = rows.astype(int), columns.astype(int)
        v, u = (rows - i)[:, None, None], (columns - j)[None, :, None]
        along = lattice[:, j] * (1 - u) + lattice[:, j + 1] * u
        return (along[i] * (1 - v) + along[i + 1] * v).astype(np.float32)

    def smooth(self, function: ToPixels) -> _Float:
        """Evaluate a smooth function of points (N, 2) mm, with values (N, K), on the raster: (H, W, K) float32."""
        rows, columns = (max(2, length // 32) for length in self.shape)
        y, x = np.mgrid[:rows, :columns]
        low, high = self.low_mm + self.step_mm / 2, self.low_mm + (np.array(self.shape[::-1]) - 0.5) * self.step_mm
        fraction = np.stack([x.ravel() / (columns - 1), y.ravel() / (rows - 1)], axis=-1)
        coarse = function(low + fraction * (high - low)).reshape(rows, columns, -1).astype(np.float32)
        sizes = zip((columns, rows), self.shape[::-1], strict=True)
        across, down = (np.linspace(0, count - 1, length, dtype=np.float32) for count, length in sizes)
        map_x, map_y = np.meshgrid(across, down)
        return np.asarray(cv2.remap(coarse, map_x, map_y, cv2.INTER_LINEAR), dtype=np.float32)

    def coverage(self, centres_mm: _Array, sizes_mm: _Array) -> sparse.csr_array:
        """Return the share of each element that each rectangle covers, (H · W, N) float32.

        `centres_mm`, `sizes_mm`: (N, 2) float64, x then y.
        """
        height, width = self.shape
        low = (centres_mm - sizes_mm / 2 - self.low_mm) / self.step_mm
        high = (centres_mm + sizes_mm / 2 - self.low_mm) / self.step_mm
        # Edges that differ from an element border only by rounding are moved to the border.
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
        patch = np.broadcast_to(np.arange(len(centres_mm))[:, None, None], value.shape)[inside]
        return sparse.csr_array(
            (value[inside], ((rows * width + columns)[inside], patch)), shape=(height * width, len(centres_mm))
        )

    def near(self, cover: sparse.csr_array, cell_elements: int) -> _Mask:
        """Return the elements (H, W) bool on a patch, or at most a fifth of a patch width away from it."""
        # The margin outside these elements may contain rulers, text or pins.
        covered = (np.diff(cover.indptr) > 0).reshape(self.shape).astype(np.uint8)
        reach = 2 * max(1, round(0.2 * cell_elements)) + 1
        return np.asarray(cv2.dilate(covered, np.ones((reach, reach), dtype=np.uint8))).astype(np.bool_)

    def outside_tags(self, tags: tuple[Tag, ...]) -> _Mask:
        """Return the elements (H, W) bool outside of all tags and their white rims."""
        is_outside = np.ones(self.shape, dtype=bool)
        for tag in tags:
            rim = np.ptp(tag.corners_mm, axis=0).max() / TAG_MODULES * 1.5
            low = np.floor((tag.corners_mm.min(axis=0) - rim - self.low_mm) / self.step_mm).astype(int)
            high = np.ceil((tag.corners_mm.max(axis=0) + rim - self.low_mm) / self.step_mm).astype(int)
            low = np.maximum(low, 0)
            is_outside[low[1] : max(high[1], 0), low[0] : max(high[0], 0)] = False
        return is_outside


def tiles(shape: tuple[int, int], size: int, margin: int) -> Generator[tuple[slice, slice]]:
    """Yield rows and columns of evenly spaced tiles of size × size elements, with a margin on all sides."""
    starts: list[npt.NDArray[np.int64]] = []
    for length in shape:
        count = max(1, round((length - 2 * margin) / size))
        starts.append(np.linspace(margin, max(margin, length - margin - size), count).astype(int))
    for row in starts[0]:
        for column in starts[1]:
            if row + size + margin <= shape[0] and column + size + margin <= shape[1]:
                yield slice(int(row), int(row) + size), slice(int(column), int(column) + size)


def jacobians(to_pixels: ToPixels, points_mm: _Array, step_mm: _Array) -> _Array:
    """Return ∂(x, y) px / ∂(column, row), (N, 2, 2), at points (N, 2) mm; `step_mm`: (2,) size of an element."""
    reach = np.diag(step_mm)
    slopes = [(to_pixels(points_mm + reach[axis]) - to_pixels(points_mm - reach[axis])) / 2 for axis in (0, 1)]
    return np.stack(slopes, axis=-1)


def to_pixel_units(sums: _Array, jacobians: _Array) -> tuple[_Array, _Array]:
    """Convert sums (N, 5) in raster elements to information (N, 2, 2) px⁻² and pull (N, 2) px⁻¹.

    The sums are xx, xy, yy, xe, ye of the image slopes x, y and the error e. `jacobians`: (N, 2, 2) of the map, px per
    element.
    """
    inverse = np.linalg.inv(jacobians)
    matrix = sums[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    information = np.einsum("nji,njk,nkl->nil", inverse, matrix, inverse)
    return information, -np.einsum("nji,nj->ni", inverse, sums[:, 3:])


def box_mean(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return the mean (H, W) float32 over the size × size elements around each element of an image (H, W)."""
    return np.asarray(cv2.blur(image, (size, size)), dtype=np.float32)


def sums_of(image: npt.NDArray[np.floating], size: int) -> _Float:
    """Return sums (rows, columns) float32 over complete tiles of size × size elements of an image (H, W)."""
    rows, columns = (length // size for length in image.shape)
    mean = cv2.resize(image[: rows * size, : columns * size], (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32) * np.float32(size * size)


def tile_middles(image: npt.NDArray[np.floating], size: int) -> npt.NDArray[np.floating]:
    """Return the centre element of each tile of an image (H, W)."""
    rows, columns = (length // size for length in image.shape)
    return image[size // 2 :: size, size // 2 :: size][:rows, :columns]


@dataclass(frozen=True, eq=False)
class TileComparison:
    """Displacements measured by the tiles of a raster."""

    points_mm: _Array  # (N, 2) centres of the tiles
    information: _Array  # (N, 2, 2) inverse covariance of the displacement of each tile, px⁻²; 0 if not used
    pull: _Array  # (N, 2) information times measured displacement, px⁻¹
    score: _Array  # (N,) correlation of frame and print around each tile, −1 … 1; 0 if not comparable
    of_channels: tuple[_Array, _Array]  # (3, N, 2, 2), (3, N, 2): information and pull of red, green and blue

    @classmethod
    def of(cls, points_mm: _Array, information: _Array, pull: _Array, score: _Array) -> TileComparison:
        """Return the comparison from the channels' information (3, N, 2, 2) and pull (3, N, 2)."""
        return cls(points_mm, information.sum(axis=0), pull.sum(axis=0), score, (information, pull))

    def after(self, moved_px: _Array) -> TileComparison:
        """Return the remaining displacements after a movement of the map by (N, 2) px, or (3, N, 2) per channel."""
        information, pull = self.of_channels
        shift = np.broadcast_to(moved_px, pull.shape)
        return self.of(self.points_mm, information, pull - np.einsum("cnij,cnj->cni", information, shift), self.score)

    def weakened(self, times: float) -> TileComparison:
        """Return the comparison with information divided by `times`, because `times` measurements share one error."""
        information, pull = self.of_channels
        return self.of(self.points_mm, information / times, pull / times, self.score)


def compare_tiles(
    raster: Raster,
    size: int,
    expected: _Float,
    measured: _Float,
    weight: _Float,
    window: int,
    to_pixels: ToPixels,
    cell_px: float,
    without_gradient: bool = False,
) -> TileComparison:
    """Estimate how far the frame deviates from the mapped positions, in tiles of size × size elements.

    `expected`, `measured`: (H, W, 3) float32 counts, the predicted print and the rectified frame. `weight`: (H, W)
    float32, 1 for comparable elements, else 0. `window`: width of the window for gain and offset, in elements.
    `to_pixels`: the map, from points (N, 2) mm to positions (N, 2) px. `without_gradient`: ignore uniform gradients.
    """
    mean = _LocalMean(weight, window, without_gradient)
    agreeing = np.zeros(raster.shape, dtype=np.float32)
    expected_power, measured_power = np.zeros_like(agreeing), np.zeros_like(agreeing)
    sums = np.zeros((3, *raster.tiles(size), 5), dtype=np.float64)
    for channel in range(3):
        model, values = expected[..., channel], measured[..., channel]
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
        measured_power += box_mean(values * values, window) / noise**2
        huber = weight / np.maximum(noise * noise, 0.5 * noise * magnitude)
        if without_gradient:
            gx, gy = ((slope - mean(slope)) * weight for slope in (gx, gy))
            gx, gy = (
                slope - model * box_mean(slope * model, window) / np.maximum(power, np.float32(1e-6))
                for slope in (gx, gy)
            )
        gx, gy = gx * gain, gy * gain
        for term, (first, second) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, error), (gy, error))):
            sums[channel, ..., term] = sums_of(huber * first * second, size)
    score = agreeing / np.sqrt(np.maximum(expected_power * measured_power, np.float32(1e-6)))
    score *= mean.share > _MIN_SHARE
    points = raster.points_of_tiles(size)
    slopes = jacobians(to_pixels, points, raster.step_mm)
    units = [to_pixel_units(channel_sums.reshape(-1, 5), slopes) for channel_sums in sums]
    information, pull = (np.stack(values) for values in zip(*units, strict=True))
    # If raster elements are smaller than pixels, the noise of neighbouring elements is correlated.
    repeat = max(1.0, (size / cell_px) ** 2)
    score = tile_middles(score, size).ravel().astype(np.float64)
    good = (score >= MIN_SCORE) / repeat
    return TileComparison.of(points, information * good[:, None, None], pull * good[:, None], score)


class _LocalMean:
    """Weighted mean over a window around each element."""

    def __init__(self, weight: _Float, window: int, without_gradient: bool) -> None:
        self._weight, self._window = weight, window
        # (H, W) valid share of each window
        self.share = np.maximum(box_mean(weight, window), np.float32(1e-3))
        rows, columns = (np.flatnonzero(weight.any(axis=axis)) for axis in (1, 0))
        self._inner: tuple[slice, slice] | None = None
        if without_gradient and min(len(rows), len(columns)) > window:
            self._inner = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)

    def __call__(self, image: _Float) -> _Float:
        """Return the mean (H, W). With `without_gradient`, it follows a uniform gradient up to the border."""
        if self._inner is None:
            return np.asarray(box_mean(image * self._weight, self._window) / self.share, dtype=np.float32)
        margin = self._window // 2 + 1
        padded = np.pad(image[self._inner], margin, mode="reflect", reflect_type="odd")
        mean = np.zeros_like(image)
        mean[self._inner] = box_mean(padded, self._window)[margin:-margin, margin:-margin]
        return mean


@dataclass(frozen=True, eq=False)
class LocatedBlocks:
    """Positions of blocks of patches, located by correlation."""

    centres_mm: _Array  # (B, 2) expected positions on the print
    moves_mm: _Array  # (B, 2) located minus expected positions
    score: _Array  # (B,) correlation of frame and predicted print, −1 … 1
    least_score: float = _MIN_BLOCK_SCORE  # blocks with a lower score are not used

    def information(self, moves_px: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
        """Return the inverse covariance (B, 2, 2) float64 px⁻² of the positions of the blocks.

        `moves_px`: (B, 2) `moves_mm` converted to the frame. `spacing_mm`: (2,) distance of blocks in x and y.
        """
        score = np.where(self.score > self.least_score, self.score, 0.0)
        weight = _weights(self.centres_mm, moves_px, score, spacing_mm, cell_px)
        return (weight / (_MOVE_SIGMA_CELLS * cell_px) ** 2)[:, None, None] * np.eye(2)


def find_blocks(
    raster: Raster, expected: _Float, measured: _Float, is_inside: _Mask, size: int, reach: int, cells: int
) -> LocatedBlocks:
    """Locate square blocks of the print in a rectified frame by normalised correlation.

    `expected`, `measured`: (H, W, 3) float32 counts, the predicted print and the rectified frame. `is_inside`: (H, W)
    bool, elements inside the frame; blocks with other elements are dropped. `size`, `reach`: block size and search
    range in elements. `cells`: number of patches in a block.
    """
    # The square root makes the noise uniform (Anscombe 1948) and reduces the effect of illumination gradients.
    expected, measured = (np.sqrt(np.maximum(image, 0)) for image in (expected, measured))
    centres: list[_Array] = []
    moves: list[_Array] = []
    scores: list[float] = []
    for rows, columns in tiles(raster.shape, size, reach):
        if not is_inside[rows, columns].all():
            continue
        search_area = np.s_[rows.start - reach : rows.stop + reach, columns.start - reach : columns.stop + reach]
        match = cv2.matchTemplate(measured[search_area], expected[rows, columns], cv2.TM_CCOEFF_NORMED)
        score, move = _peak(np.nan_to_num(np.asarray(match, dtype=np.float64)))
        centres.append(raster.point(0.5 * (columns.start + columns.stop), 0.5 * (rows.start + rows.stop)))
        moves.append(move - reach)
        scores.append(score)
    return LocatedBlocks(
        np.array(centres).reshape(-1, 2),
        np.array(moves).reshape(-1, 2) * raster.step_mm,
        np.array(scores),
        _MIN_BLOCK_SCORE if cells >= _FEW_CELLS else _MIN_SMALL_BLOCK_SCORE,
    )


def _peak(match: _Array) -> tuple[float, _Array]:
    row, column = np.unravel_index(int(np.argmax(match)), match.shape)
    position = np.array([column, row], dtype=np.float64)
    for axis, (index, length) in enumerate(((int(column), match.shape[1]), (int(row), match.shape[0]))):
        if 0 < index < length - 1:
            line = match[row, index - 1 : index + 2] if axis == 0 else match[index - 1 : index + 2, column]
            # Vertex of the parabola through three values.
            bend = line[0] - 2 * line[1] + line[2]
            if bend < 0:
                position[axis] += 0.5 * (line[0] - line[2]) / bend
    return float(match[row, column]), position


def _weights(centres_mm: _Array, moves_px: _Array, score: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
    distance = np.abs(centres_mm[:, None] - centres_mm[None]) / spacing_mm
    is_near = np.asarray((distance < _NEIGHBOUR_BLOCKS).all(axis=-1))
    # The weight is the squared score, or 0 if the displacement of a block differs from the median of its neighbours.
    weight = score**2
    for index in range(len(score)):
        neighbours = is_near[index] & (score > 0)
        median_move = np.median(moves_px[neighbours], axis=0) if neighbours.sum() >= 3 else moves_px[index]
        if np.linalg.norm(moves_px[index] - median_move) > _MAX_DISAGREEMENT_CELLS * cell_px:
            weight[index] = 0.0
    return weight
