"""What one pass over the counts of a frame gives: light at all places, noise, exposure, who took it.

Every photosite of the visible area counts towards one tile and one strip, so that nothing escapes between places.
Nothing depends on other frames, on the chart or on what was ordered.

Places are in 2×2 blocks of the mosaic ("half-size pixels"). T = 384 tiles, S strips of rows (four a row of blocks), M
blocks that are sampled.
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

# Tiles over a frame of 3 : 2: 384 squares of 108 px on an EOS 550D, each about a hundred cells of the chart, so that
# their mean is known to 0.1 % and a hand covers several.
TILE_COLUMNS, TILE_ROWS = 24, 16

# Strips along a row: 650 px on an EOS 550D, 65 cells, whose mean differs from row of cells to row of cells.
SEGMENTS = 4

# Blocks whose photosites are kept to compare the noise of two frames: correlations are then known to 1 %.
SAMPLES = 8192

# Counts below this share of black are none of a sensor: its noise reaches down by some tens, black is hundreds.
_EMPTY_SHARE = 0.5

# Counts of black below which nothing can be said of counts below it: Nikon's older bodies subtract it themselves.
_LEAST_BLACK = 64.0

_NOISE_BINS = 6  # Levels at which noise is measured: enough for a straight line, with a thousand blocks each

_INNER = 0.3  # Share of a level's blocks, those with the least differences, from which its noise is taken

_INNER_SIGMAS = 0.3853  # Standard deviations within which that share of normal deviates lies: Φ⁻¹(0.65)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FramePlaces:
    """The places of a frame of `rows` × `columns` blocks."""

    rows: int
    columns: int

    @cached_property
    def x_edges(self) -> npt.NDArray[np.int64]:
        """(25,) columns of blocks at which the tiles begin, and the end."""
        return np.linspace(0, self.columns, TILE_COLUMNS + 1).round().astype(np.int64)

    @cached_property
    def y_edges(self) -> npt.NDArray[np.int64]:
        """(17,) rows of blocks at which the tiles begin, and the end."""
        return np.linspace(0, self.rows, TILE_ROWS + 1).round().astype(np.int64)

    @cached_property
    def tile_blocks(self) -> npt.NDArray[np.float64]:
        """(384, 1) float64, blocks in each tile, row by row."""
        return np.outer(np.diff(self.y_edges), np.diff(self.x_edges)).reshape(-1, 1).astype(np.float64)

    @cached_property
    def sampled(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Rows (M,) and columns (M,) of blocks spread evenly, and without a lattice, over the frame."""
        chosen = np.random.default_rng(7).choice(self.rows * self.columns, min(SAMPLES, self.rows * self.columns))
        chosen.sort()
        return chosen // self.columns, chosen % self.columns

    def tile_box(self, tile: int) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom (exclusive) of a tile, in blocks."""
        row, column = divmod(tile, TILE_COLUMNS)
        x, y = self.x_edges, self.y_edges
        return int(x[column]), int(y[row]), int(x[column + 1]), int(y[row + 1])


def _mean_counts(
    counts: npt.NDArray[np.uint16], places: FramePlaces, clipping: float, floor: float
) -> tuple[_Array, _Array, _Array]:
    """Return the mean counts at all places, of counts (H, W), in one pass, and the shares of odd photosites.

    Tiles (T, 4) and strips (rows, 4, 4) for the four positions of the block, row by row; shares (2,) of photosites at
    or above the clipping level, and of those that no light and no darkness gives.
    """
    sums = np.zeros((places.rows, TILE_COLUMNS, 4), dtype=np.int64)
    top = min(int(np.ceil(clipping)), 65535)
    tallies = np.zeros(2, dtype=np.int64)
    _sum_rows(counts, places.x_edges, top, max(int(floor), 0), sums, tallies)
    tiles = np.add.reduceat(sums, places.y_edges[:-1], axis=0).reshape(-1, 4) / places.tile_blocks
    ends = np.arange(0, TILE_COLUMNS, TILE_COLUMNS // SEGMENTS)
    widths = np.add.reduceat(np.diff(places.x_edges), ends)
    strips = np.add.reduceat(sums, ends, axis=1) / widths[:, None]
    return tiles, strips, tallies / counts.size


@dataclass(frozen=True, eq=False)
class Noise:
    """Photon transfer of a frame: the variance of a photosite is `floor` + `slope` × counts above black, DN²."""

    floor: float
    slope: float

    def variance(self, level: npt.ArrayLike) -> _Array:
        """Return the variance (...) float64, DN², of a photosite at levels (...), counts above black."""
        return self.floor + self.slope * np.maximum(np.asarray(level, dtype=np.float64), 0)


@dataclass(frozen=True, eq=False)
class GreenNoise:
    """The noise of blocks as the difference of their two greens, from which colour and light drop out.

    - `pattern`: (M,) float64 counts, about 0, without outliers.
    - `deviation`: its standard deviation, counts.
    - `spread`: standard deviation of its size, counts.
    """

    pattern: _Array
    deviation: float
    spread: float

    @classmethod
    def of(cls, samples: npt.NDArray[np.uint16]) -> GreenNoise:
        """Return the noise of counts (M, 2) of both greens of blocks."""
        one, other = samples.astype(np.float64).T
        difference = one - other
        most = 4 * float(np.median(np.abs(difference))) + 3
        centred = difference - np.median(difference)
        pattern = np.clip(centred, -most, most)
        return cls(pattern, float(pattern.std()), float(np.minimum(np.abs(centred), most).std()))


@dataclass(frozen=True, eq=False)
class Measured:
    """A frame as it was measured.

    - `tiles`: (T, 3) float64, mean R, G, B of each tile, counts above black.
    - `strips`: (S, 3) float64, of each strip, likewise.
    - `samples`: (M, 2) uint16, counts of both greens of the sampled blocks.
    - `digest`: of the counts of all sampled blocks: equal for no two frames that a sensor took.
    - `noise`: photon transfer, by the differences of the greens; it contains the photosites' own differences.
    - `black`: mean black level of the frame, counts.
    - `black_measured`: whether the frame has a masked border to measure it in.
    - `range_dn`: saturation minus black.
    - `brightest_dn`: brightest counts above black, of the brightest channel.
    - `clipped`, `empty`: shares of photosites 0 … 1: near saturation, and without any count.
    - `camera`, `serial`: as the file states them; empty where it does not.
    """

    tiles: _Array
    strips: _Array
    samples: npt.NDArray[np.uint16]
    digest: bytes
    noise: Noise
    black: float
    black_measured: bool
    range_dn: float
    brightest_dn: float
    clipped: float
    empty: float
    camera: str
    serial: str
    places: FramePlaces

    @property
    def level(self) -> _Array:
        """(3,) float64, mean of all tiles, counts above black."""
        return np.asarray(self.tiles.mean(axis=0))

    @cached_property
    def green_noise(self) -> GreenNoise:
        """The noise of the sampled blocks, of which there are some; each of the next frames is held against it."""
        return GreenNoise.of(self.samples)


def measure(mosaic: Mosaic, black: _Array | None = None) -> Measured:
    """Return what is measured of a frame; `black` (2, 2) float64 counts if it is known already."""
    blocks = mosaic.block_planes()
    places = FramePlaces(int(blocks.shape[2]), int(blocks.shape[3]))
    black = frame_black(mosaic) if black is None else black
    mean_black = float(black.mean())
    floor = _EMPTY_SHARE * mean_black if mean_black >= _LEAST_BLACK else 0.0
    *means, odd = _mean_counts(mosaic.counts, places, CLIPPING_SHARE * mosaic.white_level, floor)
    rows, columns = places.sampled
    sampled = np.stack([blocks[r, c][rows, columns] for r in range(2) for c in range(2)], axis=-1)
    of = phases(mosaic)
    greens = [2 * r + c for r, c in of["G"]]
    pair = sampled[:, greens]
    bright = max(
        float(np.percentile(sampled[:, 2 * r + c], BRIGHTEST_PERCENTILE) - black[r, c]) for places_of in of.values()
        for r, c in places_of
    )  # fmt: skip
    tiles, strips = (_channels(mean - black.ravel(), of) for mean in means)
    return Measured(
        tiles=tiles,
        strips=strips.reshape(-1, 3),
        samples=pair,
        digest=hashlib.blake2b(sampled.tobytes(), digest_size=16).digest(),
        noise=_noise(pair.astype(np.float64) - [black[place] for place in of["G"]]),
        black=mean_black,
        black_measured=bool(mosaic.masked),
        range_dn=float(mosaic.white_level - mean_black),
        brightest_dn=bright,
        clipped=float(odd[0]),
        empty=float(odd[1]),
        camera=mosaic.camera,
        serial=mosaic.serial,
        places=places,
    )


def strip_blocks(places: FramePlaces) -> float:
    """Return how many blocks a strip has, on average."""
    return places.columns / SEGMENTS


def _channels(means: _Array, of: dict[Channel, tuple[tuple[int, int], ...]]) -> _Array:
    """Return R, G, B (..., 3) of the four positions of the block (..., 4)."""
    return np.stack([np.mean([means[..., 2 * r + c] for r, c in of[channel]], axis=0) for channel in CHANNELS], axis=-1)


def _noise(greens: _Array) -> Noise:
    """Return the photon transfer of pairs of greens (M, 2), counts above black, of the same block."""
    level = greens.mean(axis=1)
    difference = greens[:, 0] - greens[:, 1]
    edges = np.quantile(level, np.linspace(0, 1, _NOISE_BINS + 1))
    at: list[float] = []
    variance: list[float] = []
    for low, high in pairwise(edges.tolist()):
        chosen = (level >= low) & (level <= high)
        seen = difference[chosen]
        centred = np.abs(seen - np.median(seen))
        # Blocks across an edge between two cells differ by more than noise, and where cells are small they are many.
        spread = float(np.quantile(centred, _INNER)) / _INNER_SIGMAS
        at.append(float(np.median(level[chosen])))
        variance.append(spread**2 / 2)
    # The darkest blocks show the read noise, the brighter ones what light adds, each with a weight that noise gives it.
    x, y = np.maximum(np.array(at), 0), np.maximum(np.array(variance), 1e-3)
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
    floor: int,
    sums: npt.NDArray[np.int64],
    tallies: npt.NDArray[np.int64],
) -> None:
    """Write sums (rows, tiles, 4) int64 of counts (H, W) between column edges; tally (2,) clipped and empty."""
    clipped, empty = 0, 0
    for row in range(sums.shape[0]):
        for part in range(2):
            line = counts[2 * row + part]
            for tile in range(sums.shape[1]):
                left, right = np.uint32(0), np.uint32(0)
                high, low = np.uint32(0), np.uint32(0)
                for block in range(x_edges[tile], x_edges[tile + 1]):
                    one, two = line[2 * block], line[2 * block + 1]
                    left += np.uint32(one)
                    right += np.uint32(two)
                    high += np.uint32(one >= top) + np.uint32(two >= top)
                    low += np.uint32(one < floor) + np.uint32(two < floor)
                sums[row, tile, 2 * part] = left
                sums[row, tile, 2 * part + 1] = right
                clipped += high
                empty += low
    tallies[0] = clipped
    tallies[1] = empty
