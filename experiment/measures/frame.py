"""Measure one frame: light in all regions, noise and exposure.

Tiles are rectangles of the frame, and strips are parts of its rows. Every photosite of the visible area belongs to one
tile and one strip, so every local change of the light is measured. No result depends on other frames, on the chart or
on the requested illuminant.

Positions are in 2×2 blocks of the mosaic (half-size pixels). There are T = 384 tiles, S strips (four in each row of
blocks) and M sampled blocks.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, Channel, Mosaic, frame_black, phases
from experiment.measures.exposure import BRIGHTEST_PERCENTILE
from foundation.compiled import compiled

# Number of tiles across and down a frame. A tile contains about a hundred patches, and a hand in front of the chart
# covers several tiles.
TILE_COLUMNS, TILE_ROWS = 24, 16

# Number of strips in a row of blocks.
SEGMENTS = 4

# Number of sampled blocks in which the noise of two frames is compared; correlations are then accurate to 1 %.
SAMPLES = 8192

# A photosite is empty (without data) if its count is below this fraction of the black level. Noise lowers no count so
# far.
_EMPTY_SHARE = 0.5

# Smallest black level at which empty photosites can be detected, counts. Older cameras by Nikon subtract the black
# level themselves, so their counts may be 0.
_LEAST_BLACK = 64.0

_NOISE_BINS = 6  # Number of levels at which noise is measured, with more than a thousand blocks each

# Fraction of the blocks of a level that are used for its noise: the blocks with the smallest differences.
_INNER_FRACTION = 0.3

_INNER_SIGMAS = 0.3853  # Limit of the inner 30 % of a normal distribution, in standard deviations: Φ⁻¹(0.65)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FramePlaces:
    """Division of a frame of `rows` × `columns` blocks into tiles and samples."""

    rows: int
    columns: int

    @cached_property
    def x_edges(self) -> npt.NDArray[np.int64]:
        """(25,) int64, block columns at which tiles start, and the end."""
        return np.linspace(0, self.columns, TILE_COLUMNS + 1).round().astype(np.int64)

    @cached_property
    def y_edges(self) -> npt.NDArray[np.int64]:
        """(17,) int64, block rows at which tiles start, and the end."""
        return np.linspace(0, self.rows, TILE_ROWS + 1).round().astype(np.int64)

    @cached_property
    def tile_blocks(self) -> npt.NDArray[np.float64]:
        """(384, 1) float64, number of blocks in each tile, row by row."""
        return np.outer(np.diff(self.y_edges), np.diff(self.x_edges)).reshape(-1, 1).astype(np.float64)

    @cached_property
    def sampled(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Rows (M,) and columns (M,) of random blocks over the whole frame."""
        indices = np.random.default_rng(7).choice(self.rows * self.columns, min(SAMPLES, self.rows * self.columns))
        indices.sort()
        return indices // self.columns, indices % self.columns

    def tile_box(self, tile: int) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom (exclusive) of a tile, in blocks."""
        row, column = divmod(tile, TILE_COLUMNS)
        x, y = self.x_edges, self.y_edges
        return int(x[column]), int(y[row]), int(x[column + 1]), int(y[row + 1])


def _mean_counts(
    counts: npt.NDArray[np.uint16], division: FramePlaces, clipping: float, empty_limit: float
) -> tuple[_Array, _Array, _Array]:
    """Return mean counts of tiles (T, 4) and strips (rows, 4, 4), and fractions (2,) of clipped and empty photosites.

    The last axis of the means is the position in the block, row by row.
    """
    sums = np.zeros((division.rows, TILE_COLUMNS, 4), dtype=np.int64)
    top = min(int(np.ceil(clipping)), 65535)
    totals = np.zeros(2, dtype=np.int64)
    _sum_rows(counts, division.x_edges, top, max(int(empty_limit), 0), sums, totals)
    tiles = np.add.reduceat(sums, division.y_edges[:-1], axis=0).reshape(-1, 4) / division.tile_blocks
    ends = np.arange(0, TILE_COLUMNS, TILE_COLUMNS // SEGMENTS)
    widths = np.add.reduceat(np.diff(division.x_edges), ends)
    strips = np.add.reduceat(sums, ends, axis=1) / widths[:, None]
    return tiles, strips, totals / counts.size


@dataclass(frozen=True, eq=False)
class Noise:
    """Photon transfer of a frame: variance of a photosite = `floor` + `slope` × counts above black, DN²."""

    floor: float
    slope: float

    def variance(self, level: npt.ArrayLike) -> _Array:
        """Return the variance (...) float64, DN², of a photosite at levels (...) in counts above black."""
        return self.floor + self.slope * np.maximum(np.asarray(level, dtype=np.float64), 0)


@dataclass(frozen=True, eq=False)
class GreenNoise:
    """Noise of blocks: the difference between the two greens of a block, in which the signal cancels."""

    pattern: _Array  # (M,), counts, centred at 0, outliers clipped
    deviation: float  # standard deviation of the pattern, counts
    spread: float  # standard deviation of the absolute pattern, counts

    @classmethod
    def of(cls, samples: npt.NDArray[np.uint16]) -> GreenNoise:
        """Measure the noise in the counts (M, 2) of both green photosites of blocks."""
        first, second = samples.astype(np.float64).T
        difference = first - second
        limit = 4 * float(np.median(np.abs(difference))) + 3
        centred = difference - np.median(difference)
        pattern = np.clip(centred, -limit, limit)
        return cls(pattern, float(pattern.std()), float(np.minimum(np.abs(centred), limit).std()))


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of one frame."""

    tiles: _Array  # (T, 3), mean R, G, B of each tile, counts above black
    strips: _Array  # (S, 3), mean R, G, B of each strip, counts above black
    samples: npt.NDArray[np.uint16]  # (M, 2), counts of both greens of the sampled blocks
    digest: bytes  # hash of the counts of all sampled blocks; differs between any two exposures
    noise: Noise  # photon transfer, from the differences of both greens; includes fixed-pattern noise
    black: float  # mean black level, counts
    black_measured: bool  # whether black was measured in a masked border of the frame
    range_dn: float  # saturation level minus black level
    # `BRIGHTEST_PERCENTILE` of the counts above black, for the brightest of the four positions in a block
    brightest_dn: float
    clipped: float  # fraction of photosites close to saturation, 0 … 1
    empty: float  # fraction of photosites with counts below half of the black level, 0 … 1
    camera: str  # from the file; "" if missing
    serial: str  # from the file; "" if missing
    places: FramePlaces

    @property
    def level(self) -> _Array:
        """(3,) float64, mean of all tiles, counts above black."""
        return np.asarray(self.tiles.mean(axis=0))

    @cached_property
    def green_noise(self) -> GreenNoise:
        """Noise of the sampled blocks, with which later frames are compared."""
        return GreenNoise.of(self.samples)


def measure(mosaic: Mosaic, black: _Array | None = None) -> Measured:
    """Measure a frame. `black`: (2, 2) float64 counts, if already known."""
    blocks = mosaic.block_planes()
    division = FramePlaces(int(blocks.shape[2]), int(blocks.shape[3]))
    black = frame_black(mosaic) if black is None else black
    mean_black = float(black.mean())
    empty_limit = _EMPTY_SHARE * mean_black if mean_black >= _LEAST_BLACK else 0.0
    *means, shares = _mean_counts(mosaic.counts, division, CLIPPING_SHARE * mosaic.white_level, empty_limit)
    rows, columns = division.sampled
    sampled = np.stack([blocks[r, c][rows, columns] for r in range(2) for c in range(2)], axis=-1)
    positions = phases(mosaic)
    greens = [2 * r + c for r, c in positions["G"]]
    green_samples = sampled[:, greens]
    brightest = max(
        float(np.percentile(sampled[:, 2 * r + c], BRIGHTEST_PERCENTILE) - black[r, c]) for r, c in np.ndindex(2, 2)
    )
    tiles, strips = (_channels(mean - black.ravel(), positions) for mean in means)
    return Measured(
        tiles=tiles,
        strips=strips.reshape(-1, 3),
        samples=green_samples,
        digest=hashlib.blake2b(sampled.tobytes(), digest_size=16).digest(),
        noise=_noise(green_samples.astype(np.float64) - [black[position] for position in positions["G"]]),
        black=mean_black,
        black_measured=bool(mosaic.masked),
        range_dn=float(mosaic.white_level - mean_black),
        brightest_dn=brightest,
        clipped=float(shares[0]),
        empty=float(shares[1]),
        camera=mosaic.camera,
        serial=mosaic.serial,
        places=division,
    )


def strip_blocks(division: FramePlaces) -> float:
    """Return the mean number of blocks in a strip."""
    return division.columns / SEGMENTS


def _channels(means: _Array, positions: dict[Channel, tuple[tuple[int, int], ...]]) -> _Array:
    channels = [np.mean([means[..., 2 * r + c] for r, c in positions[channel]], axis=0) for channel in CHANNELS]
    return np.stack(channels, axis=-1)


def _noise(greens: _Array) -> Noise:
    level = greens.mean(axis=1)
    difference = greens[:, 0] - greens[:, 1]
    edges = np.quantile(level, np.linspace(0, 1, _NOISE_BINS + 1))
    levels: list[float] = []
    variances: list[float] = []
    for low, high in pairwise(edges.tolist()):
        in_bin = (level >= low) & (level <= high)
        differences = difference[in_bin]
        centred = np.abs(differences - np.median(differences))
        # On an edge between two patches, the two greens of a block differ by more than noise, so such blocks are
        # omitted.
        sigma = float(np.quantile(centred, _INNER_FRACTION)) / _INNER_SIGMAS
        levels.append(float(np.median(level[in_bin])))
        variances.append(sigma**2 / 2)
    # Dark blocks have only read noise, bright blocks also photon noise. Residuals are relative to the variance.
    x, y = np.maximum(np.array(levels), 0), np.maximum(np.array(variances), 1e-3)
    design = np.column_stack([np.ones_like(x), x]) / y[:, None]
    floor, slope = np.linalg.lstsq(design, np.ones_like(y), rcond=None)[0].tolist()
    if slope <= 0:
        return Noise(float(y.mean()), 0.0)
    if floor <= 0:
        return Noise(float(y.min()) / 2, float(np.mean(y / np.maximum(x, 1))))
    return Noise(float(floor), float(slope))


@compiled
def _sum_rows(
    counts: npt.NDArray[np.uint16],
    x_edges: npt.NDArray[np.int64],
    top: int,
    empty_limit: int,
    sums: npt.NDArray[np.int64],
    totals: npt.NDArray[np.int64],
) -> None:
    """Sum counts (H, W) by tile into `sums` (rows, tiles, 4); count clipped and empty photosites in `totals` (2,)."""
    clipped, empty = 0, 0
    for row in range(sums.shape[0]):
        for half in range(2):
            line = counts[2 * row + half]
            for tile in range(sums.shape[1]):
                left, right = np.uint32(0), np.uint32(0)
                high, low = np.uint32(0), np.uint32(0)
                for block in range(x_edges[tile], x_edges[tile + 1]):
                    first, second = line[2 * block], line[2 * block + 1]
                    left += np.uint32(first)
                    right += np.uint32(second)
                    high += np.uint32(first >= top) + np.uint32(second >= top)
                    low += np.uint32(first < empty_limit) + np.uint32(second < empty_limit)
                sums[row, tile, 2 * half] = left
                sums[row, tile, 2 * half + 1] = right
                clipped += high
                empty += low
    totals[0] = clipped
    totals[1] = empty
