"""What is measured of a decoded frame: light at all places, noise, exposure, who took it.

One pass over the counts and a few thousand photosites besides; everything that is judged later is in `Measured`, and
nothing in it depends on other frames.

T = 384 tiles, S strips of rows (four a row of blocks), M blocks that are sampled.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.framing.planes import CHANNELS, CLIPPING_SHARE, frame_black, phases
from acquisition.judge.places import SEGMENTS, Places, sum_counts
from drivers.raw.rawfile import Mosaic

_EMPTY_SHARE = 0.5
"""Counts below this share of black are none of a sensor: its noise reaches down by some tens, black is hundreds."""

_LEAST_BLACK = 64.0
"""Counts of black below which nothing can be said of counts below it: Nikon's older bodies subtract it themselves."""

_NOISE_BINS = 6
"""Levels at which noise is measured: enough for a straight line, with a thousand blocks each."""

_INNER = 0.3
"""Share of a level's blocks, those with the least differences, from which its noise is taken."""

_INNER_SIGMAS = 0.3853
"""Standard deviations within which that share of normal deviates lies: Φ⁻¹(0.65)."""

_BRIGHTEST = 99.9
"""Percentile of sampled blocks' channels that stands for the brightest counts (as in `acquisition.judge.exposure`)."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Noise:
    """Photon transfer of a frame: the variance of a photosite is `floor` + `slope` × counts above black, DN²."""

    floor: float
    slope: float

    def variance(self, level: npt.ArrayLike) -> _Array:
        """Return the variance (...) float64, DN², of a photosite at levels (...), counts above black."""
        return self.floor + self.slope * np.maximum(np.asarray(level, dtype=np.float64), 0)


@dataclass(frozen=True, eq=False)
class Measured:
    """A frame as it was measured.

    Attributes
    ----------
    tiles
        (T, 3) float64, mean R, G, B of each tile, counts above black.
    strips
        (S, 3) float64, of each strip, likewise.
    samples
        (M, 2) uint16, counts of both greens of the sampled blocks.
    digest
        Of the counts of all sampled blocks: equal for no two frames that a sensor took.
    noise
        Photon transfer, by the differences of the greens; it contains the photosites' own differences.
    black
        Mean black level of the frame, counts.
    black_measured
        Whether it was measured in the frame's masked border.
    range_dn
        Saturation minus black.
    brightest_dn
        Brightest counts above black, of the brightest channel.
    clipped, empty
        Shares of photosites 0 … 1: near saturation, and without any count.
    camera, serial
        As the file states them; empty where it does not.
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
    places: Places

    @property
    def level(self) -> _Array:
        """(3,) float64, mean of all tiles, counts above black."""
        return np.asarray(self.tiles.mean(axis=0))


def measure(mosaic: Mosaic) -> Measured:
    """Return what is measured of a frame."""
    blocks = mosaic.block_planes()
    places = Places(int(blocks.shape[2]), int(blocks.shape[3]))
    black = frame_black(mosaic)
    measured = bool(mosaic.masked) and mosaic.masked_black() is not None
    mean_black = float(black.mean())
    floor = _EMPTY_SHARE * mean_black if mean_black >= _LEAST_BLACK else 0.0
    sums = sum_counts(mosaic.counts, places, CLIPPING_SHARE * mosaic.white_level, floor)
    rows, columns = places.sampled
    sampled = np.stack([blocks[r, c][rows, columns] for r in range(2) for c in range(2)], axis=-1)
    of = phases(mosaic)
    greens = [2 * r + c for r, c in of["G"]]
    pair = sampled[:, greens]
    bright = max(
        float(np.percentile(sampled[:, 2 * r + c], _BRIGHTEST) - black[r, c]) for places_of in of.values()
        for r, c in places_of
    )  # fmt: skip
    tiles, strips = (_channels(means - black.ravel(), of) for means in (sums.tiles, sums.strips))
    return Measured(
        tiles=tiles,
        strips=strips.reshape(-1, 3),
        samples=pair,
        digest=hashlib.blake2b(sampled.tobytes(), digest_size=16).digest(),
        noise=_noise(pair.astype(np.float64) - [black[place] for place in of["G"]]),
        black=mean_black,
        black_measured=measured,
        range_dn=float(mosaic.white_level - mean_black),
        brightest_dn=bright,
        clipped=sums.clipped / mosaic.counts.size,
        empty=sums.empty / mosaic.counts.size,
        camera=mosaic.camera,
        serial=mosaic.serial,
        places=places,
    )


def strip_blocks(places: Places) -> float:
    """Return how many blocks a strip has, on average."""
    return places.columns / SEGMENTS


def _channels(means: _Array, of: dict[str, tuple[tuple[int, int], ...]]) -> _Array:
    """Return R, G, B (..., 3) of the four positions of the block (..., 4)."""
    return np.stack(
        [np.mean([means[..., 2 * r + c] for r, c in of[channel]], axis=0) for channel in CHANNELS], axis=-1
    )


def _noise(greens: _Array) -> Noise:
    """Return the photon transfer of pairs of greens (M, 2), counts above black, of the same block."""
    level = greens.mean(axis=1)
    difference = greens[:, 0] - greens[:, 1]
    edges = np.quantile(level, np.linspace(0, 1, _NOISE_BINS + 1))
    at: list[float] = []
    variance: list[float] = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
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
