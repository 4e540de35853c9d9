"""A raster on the print, in which the rectified frame and the print as drawn can be compared element by element.

Pure geometry and sums, without lenses or colours. Elements, millimetres on the print, and half-size pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy import sparse

from experiment.chart.model import TAG_MODULES, Tag

_Float = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]
ToPixels = Callable[[_Array], _Array]
"""From points (N, 2) mm to places (N, 2) px."""


_LATTICE_STRIDE = 8
"""Elements between nodes of the lattice on which maps are computed: bilinear within, they are off by < 0.001 px."""


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster on the print: element (row, column) has its centre at low + (column + ½, row + ½) · step.

    - `low_mm`: (2,) float64, corner of the first element, x then y.
    - `step_mm`: (2,) float64, an element's width and height.
    - `shape`: rows and columns.
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
