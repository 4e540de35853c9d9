"""Where the chart lay in the first white frame, and how far it has moved, and blurred, since.

The gauges are the chart's tags, or the outline of its field, or, where no chart is looked for, the places of most
texture (`experiment.framing.movement`); the frame is kept around them alone. Half-size pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic
from experiment.chart.model import Chart
from experiment.framing.finding import FoundTag, Framing, find_chart, find_tags
from experiment.framing.homography import project
from experiment.framing.movement import Shift, gauge_boxes, gauges_of, shift_between
from experiment.framing.planes import CHANNELS, Channel, Plane, plane_of, strongest_plane

_TEXTURE_PX = 32
"""Side of a textured place that stands for a tag."""

_TEXTURES = (4, 2)
"""Textured places along the frame's width and height: as many as gauges are measured."""

_PAPER_REACH_PX = 4
"""How far from where a plane print would have it a white reference is looked for: lens and waves move it as far."""

_PAPER_LEVEL = 0.7
"""Share of the brightest references' light that a place must have to be paper: the field falls off to about that."""

_MOST_PAPER = 300
"""White references that are looked at: their mean is good to 0.1 % where one is to 2 %."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Anchor:
    """The chart's place in a white frame.

    - `framing`: its tags, or its field, or places of texture that stand for tags.
    - `gauges`: the frame around them, of each channel, counts above black; 0 elsewhere.
    - `paper`: (N, 2) int64, columns and rows of blocks in the middle of bare paper.
    - `of_chart`: whether the chart was found; else the places are just textured ones.
    """

    framing: Framing
    gauges: dict[Channel, Plane]
    paper: npt.NDArray[np.int64]
    of_chart: bool

    @classmethod
    def of(cls, mosaic: Mosaic, black: _Array, chart: Chart | None) -> Anchor:
        """Return the anchor of a white frame; `black` (2, 2) float64 counts, `chart` None if none is looked for."""
        if chart is None:
            plane = strongest_plane(mosaic, black)
            framing = _textures(plane)
            paper = _brightest(plane.values)
        else:
            framing = find_chart(mosaic, chart, "the white frame")
            whites = np.array([reference.centre_mm for reference in chart.white_references]).reshape(-1, 2)
            paper = _paper(framing.plane.values, project(framing.homography, whites[:_MOST_PAPER]))
        gauges: dict[Channel, Plane] = {c: gauges_of(mosaic, c, black, framing) for c in CHANNELS}
        # The whole plane is let go: only the gauges' surroundings are ever looked at again.
        kept = replace(framing, plane=gauges[framing.plane.channel])
        return cls(kept, gauges, paper, chart is not None)

    def shift(self, mosaic: Mosaic, black: _Array, channel: Channel) -> Shift:
        """Return how far the chart has moved, and how much softer it is, in a later frame's colour.

        `black` (2, 2) float64 counts, of that frame.
        """
        return shift_between(self.gauges[channel], self.framing, gauges_of(mosaic, channel, black, self.framing))

    def displacement(self, mosaic: Mosaic, black: _Array, channel: Channel) -> tuple[float, float] | None:
        """Return how far the tags have moved however far that is, px right and down; None where they are not seen.

        `black` (2, 2) float64 counts, of the frame.
        """
        if not self.of_chart or not self.framing.tags:
            return None
        found = {tag.id: tag.centre_px for tag in find_tags(plane_of(mosaic, channel, black))}
        moved = [found[tag.id] - tag.centre_px for tag in self.framing.tags if tag.id in found]
        if len(moved) < max(2, len(self.framing.tags) // 4):
            return None
        dx, dy = np.median(np.array(moved), axis=0).tolist()
        return dx, dy

    def paper_level(self, mosaic: Mosaic, black: _Array, phases: dict[Channel, tuple[tuple[int, int], ...]]) -> _Array:
        """Return (3,) float64: camera RGB of bare paper above `black` (2, 2) float64, median over all its places."""
        blocks = mosaic.block_planes()
        x, y = self.paper.T
        around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        level = np.empty(3)
        for number, channel in enumerate(CHANNELS):
            seen = [
                np.mean([blocks[place][y + dy, x + dx] for dy, dx in around], axis=0) - black[place]
                for place in phases[channel]
            ]
            # The median of the places: a hand before some of them does not count.
            level[number] = np.median(np.mean(seen, axis=0)) if len(x) else np.nan
        return level

    @property
    def outlines(self) -> tuple[_Array, ...]:
        """(K, 2) float64 each, px: outlines of the tags, or of the field; none where no chart is looked for."""
        if not self.of_chart:
            return ()
        field = self.framing.field
        return tuple(tag.corners_px for tag in self.framing.tags) if field is None else (field.corners_px,)

    def boxes(self) -> list[tuple[int, int, int, int]]:
        """Return what of the gauges' planes is not 0: left, top, right, bottom (exclusive)."""
        height, width = self.framing.plane.values.shape
        return [(x0, y0, min(x1, width), min(y1, height)) for x0, y0, x1, y1 in gauge_boxes(self.framing)]


def _paper(values: npt.NDArray[np.float32], places: _Array) -> npt.NDArray[np.int64]:
    """Return (N, 2) the brightest 3×3 neighbourhoods near places (N, 2) px, if they are as bright as paper."""
    import cv2

    height, width = values.shape
    reach = _PAPER_REACH_PX
    at = places.round().astype(np.int64)
    inside = ((at > reach + 1) & (at < (width - reach - 2, height - reach - 2))).all(axis=1)
    found: list[tuple[int, int]] = []
    levels: list[float] = []
    for x, y in at[inside].tolist():
        crop = cv2.blur(values[y - reach - 1 : y + reach + 2, x - reach - 1 : x + reach + 2], (3, 3))[1:-1, 1:-1]
        row, column = divmod(int(crop.argmax()), crop.shape[1])
        found.append((x - reach + column, y - reach + row))
        levels.append(float(crop[row, column]))
    if not found:
        return _brightest(values)
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(found, dtype=np.int64)[bright]


def _brightest(values: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Return (N, 2) the brightest 3×3 neighbourhoods of the parts of a plane, those as bright as the brightest."""
    import cv2

    smooth = cv2.blur(values, (3, 3))
    height, width = smooth.shape
    found: list[tuple[int, int]] = []
    levels: list[float] = []
    for top in range(2, height - height // 12, height // 12):
        for left in range(2, width - width // 16, width // 16):
            part = smooth[top : top + height // 12 - 2, left : left + width // 16 - 2]
            row, column = divmod(int(part.argmax()), part.shape[1])
            found.append((left + column, top + row))
            levels.append(float(part[row, column]))
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(found, dtype=np.int64)[bright]


def _textures(plane: Plane) -> Framing:
    """Return a framing whose tags are the places of most texture, one in each part of the frame."""
    import cv2

    values = plane.values
    height, width = values.shape
    energy = cv2.boxFilter(cv2.Laplacian(values, cv2.CV_32F) ** 2, -1, (_TEXTURE_PX, _TEXTURE_PX))
    tags: list[FoundTag] = []
    margin = 2 * _TEXTURE_PX
    half = _TEXTURE_PX / 2
    across, down = _TEXTURES
    for row in range(down):
        for column in range(across):
            top, bottom = (max(margin, row * height // down), min(height - margin, (row + 1) * height // down))
            left, right = (max(margin, column * width // across), min(width - margin, (column + 1) * width // across))
            if bottom <= top or right <= left:
                continue
            part = energy[top:bottom, left:right]
            y, x = divmod(int(part.argmax()), part.shape[1])
            middle = np.array([left + x, top + y]) + plane.offset_px
            corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
            tags.append(FoundTag(len(tags), corners + middle, 0.0))
    return Framing(plane, tuple(tags), (), np.eye(3), 0.0, float("nan"), 1.0, True, 0.0)
