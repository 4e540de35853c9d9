"""A raw mosaic as planes of one colour each, above black, with the places of their photosites.

Places are half-size pixels, x right, y down, centres at integers. A plane of red or blue photosites lies a quarter
pixel beside the blocks' centres, and `Plane.offset_px` puts its places right; green is the mean of its two photosites
and lies in the middle. A sum of planes under deep red or blue would be a fifth of a pixel off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic

Channel = Literal["R", "G", "B"]
CHANNELS: tuple[Channel, Channel, Channel] = ("R", "G", "B")

CLIPPING_SHARE = 0.98
"""Counts above this share of saturation are treated as clipped (judgement: the knee of the response lies above)."""

MIN_SIGNAL = 12.0
"""Counts above black that the brightest parts of the strongest plane must have for a chart to be looked for."""

PAPER_PERCENTILE = 98
"""Percentile of the counts that stands for paper: bare paper is more than a fiftieth of a picture, hot photosites and
highlights are less."""

_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plane:
    """One colour of a mosaic: `values` (H // 2, W // 2) float32, counts above black; `offset_px` (x, y).

    The element [i, j] was measured at the half-size place x = j + offset_px[0], y = i + offset_px[1].
    """

    channel: Channel
    values: _Float
    offset_px: tuple[float, float]


def phases(mosaic: Mosaic) -> dict[Channel, tuple[tuple[int, int], ...]]:
    """Return which (row, column) of the 2×2 block carry each colour."""
    found: dict[Channel, tuple[tuple[int, int], ...]] = {}
    for channel in CHANNELS:
        found[channel] = tuple(divmod(place, 2) for place, letter in enumerate(mosaic.pattern) if letter == channel)
    return found


def channel_offset_px(places: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return where photosites at `places` of the block lie from its centre, half-size px (x, y): 0 or ±0.25."""
    rows, columns = np.mean(np.asarray(places, dtype=np.float64), axis=0)
    return (float(columns) - 0.5) / 2, (float(rows) - 0.5) / 2


def frame_black(mosaic: Mosaic) -> npt.NDArray[np.float64]:
    """Return the black level (2, 2) float64 of each position of the block: measured in the masked border, or stated."""
    measured = mosaic.masked_black()
    return mosaic.black if measured is None else measured


def plane_of(mosaic: Mosaic, channel: Channel, black: npt.NDArray[np.float64] | None = None) -> Plane:
    """Return one colour of a mosaic above `black`, (2, 2) float64 counts, by default measured from the frame."""
    black = frame_black(mosaic) if black is None else black
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = float(np.mean([black[place] for place in places]))
    values = blocks[places[0]].astype(np.float32)
    for place in places[1:]:
        values += blocks[place]
    values /= len(places)
    values -= level
    return Plane(channel, values, channel_offset_px(places))


def strongest_plane(mosaic: Mosaic, black: npt.NDArray[np.float64] | None = None) -> Plane:
    """Return the colour with the brightest paper; `black` (2, 2) float64 counts as in `plane_of`."""
    black = frame_black(mosaic) if black is None else black
    return plane_of(mosaic, strongest_channel(mosaic, black, every=8), black)


def strongest_channel(mosaic: Mosaic, black: npt.NDArray[np.float64], every: int = 16) -> Channel:
    """Return the colour with the brightest paper, from one block in `every` along rows and columns.

    `black` (2, 2) float64 counts.
    """
    blocks = mosaic.block_planes()[:, :, ::every, ::every]
    levels = [
        max(float(np.percentile(blocks[place], PAPER_PERCENTILE) - black[place]) for place in places)
        for places in phases(mosaic).values()
    ]
    return CHANNELS[int(np.argmax(levels))]


def paper_level(plane: Plane) -> float:
    """Return how bright the brightest parts of a plane are, counts above black: means of 4×4 pixels, 99.5th percentile.

    Means, so that a dark frame's noise is not taken for light.
    """
    height, width = plane.values.shape
    size = (max(1, width // 4), max(1, height // 4))
    return float(np.percentile(cv2.resize(plane.values, size, interpolation=cv2.INTER_AREA), 99.5))
