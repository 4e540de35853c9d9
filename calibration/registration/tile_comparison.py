"""A rectified frame compared with the print as it should be seen: how each tile of the raster would move the map.

One step of Lucas and Kanade's method, with gain and offset local and free, as the light and the lens's shading are, and
residuals weighted by Huber's function. Source: B. D. Lucas and T. Kanade, "An iterative image registration technique",
IJCAI 1981.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.registration.raster import Raster, ToPixels, box_mean, jacobians, sums_of, tile_middles, to_pixel_units
from foundation.robust import sigma_of

MIN_SCORE = 0.5
"""Least correlation of a part of the frame with the print as predicted, for it to move the map (judgement)."""

_LEAST_SHARE = 0.25
"""Share of a tile's surroundings that must be comparable, for its score to mean anything (judgement)."""

_Float = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]


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
        noise = np.float32(sigma_of(magnitude[::3, ::3][weight[::3, ::3] > 0]) + 1e-3)
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
        self._inner = None
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
