"""Where every point of the print lies in a frame, and what is seen there.

Tags alone place a wavy sheet to some pixels only. So the smooth map through them is corrected block by block: the chart
as printed is laid over the frame as seen, and shifted until it fits best. Good to a few tenths of a pixel, where
`calibration.registration` is to a few hundredths: enough for the middle of a cell, and a tenth of the time.

Places are half-size pixels (`drivers.raw.rawfile`), points millimetres on the print.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, Mosaic, Plane, frame_black, plane_of
from experiment.chart.model import Chart
from experiment.chart.printing import field_drawing
from experiment.framing.finding import Framing
from experiment.framing.homography import project
from experiment.measures.least_squares import page_polynomial, page_powers, robust_least_squares

MAX_TERMS_SHARE = 0.6
"""Terms of the smooth map over the number of tags, at most: each tag is one independent place."""

MAX_MAP_ORDER = 5
"""Highest order of the smooth map: Brown's distortion is of third order, the sheet's waves of some more."""

BLOCK_PX = 64
"""Side of the blocks that are shifted, px: forty cells of a full chart, so that chance does not fit."""

MIN_MATCH = 0.5
"""Correlation from which a block's shift is believed (judgement); right ones have 0.8 and more, wrong ones 0.3."""

SHIFT_SPREAD_PX = 1.0
"""How far a block's shift may lie from the median of its neighbours: paper bends no faster."""

_LUMA = np.array([0.3, 0.6, 0.1])
"""How a code's channels show in any one camera channel, roughly: only the order of bright and dark matters."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ChartMap:
    """The map from the print to a frame.

    - `page_mm`: width and height of the page.
    - `homography`: (3, 3) float64, mm to px.
    - `bend`: (terms, 2) float64 px, what a polynomial over the page adds.
    - `shifts`: (rows, columns, 2) float64 px, what blocks add, at places evenly spread over the page, the first and
      last of each axis on its edges; (1, 1, 2) zeros where blocks were not matched.
    - `matched`: share of the blocks whose shift was believed; NaN where none were tried.
    """

    page_mm: tuple[float, float]
    homography: _Array
    bend: _Array
    shifts: _Array
    matched: float

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the places (N, 2) float64 px of points (N, 2) mm."""
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        order = next(k for k in range(MAX_MAP_ORDER + 1) if len(page_powers(k)) == len(self.bend))
        places = project(self.homography, points) + page_polynomial(points, self.page_mm, order) @ self.bend
        if self.shifts.shape[:2] == (1, 1):
            return places + self.shifts[0, 0]
        from scipy.ndimage import map_coordinates

        rows, columns = self.shifts.shape[:2]
        at = np.clip(points / self.page_mm, 0, 1)[:, ::-1] * (rows - 1, columns - 1)
        for axis in (0, 1):
            places[:, axis] += map_coordinates(self.shifts[..., axis], at.T, order=1, mode="nearest")
        return places

    def scale(self, points_mm: npt.ArrayLike) -> _Array:
        """Return pixels to the millimetre (N, 2) float64 at points (N, 2) mm, along the page's x and y."""
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        step = 0.01 * min(self.page_mm)
        along = [project(self.homography, points + step * unit) - project(self.homography, points - step * unit)
                 for unit in np.eye(2)]  # fmt: skip
        return np.stack([np.linalg.norm(each, axis=1) / (2 * step) for each in along], axis=1)


def place_chart(framing: Framing, chart: Chart) -> ChartMap:
    """Return the map from a chart to the frame in which it was found."""
    smooth = _smooth_map(framing, chart)
    return _shifted(smooth, framing.plane, chart) if framing.field is None else smooth


def _smooth_map(framing: Framing, chart: Chart) -> ChartMap:
    """Return the homography and the polynomial through tags, or through the outline of a field without tags."""
    none = np.zeros((1, 1, 2))
    if framing.field is not None:
        field = framing.field
        off = ((field.outline_px - project(framing.homography, field.outline_mm)) * field.normals).sum(axis=1)
        basis = page_polynomial(field.outline_mm, chart.page_mm, 3)
        design = np.concatenate([basis * field.normals[:, :1], basis * field.normals[:, 1:]], axis=1)
        both = robust_least_squares(design, off, 3)[0]
        return ChartMap(chart.page_mm, framing.homography, both.reshape(2, -1).T, none, float("nan"))
    known = {tag.id: tag.corners_mm for tag in chart.tags}
    points = np.concatenate([known[tag.id] for tag in framing.tags])
    places = np.concatenate([tag.corners_px for tag in framing.tags])
    allowed = MAX_TERMS_SHARE * len(framing.tags)
    order = max((k for k in range(1, MAX_MAP_ORDER + 1) if len(page_powers(k)) <= allowed), default=0)
    off = places - project(framing.homography, points)
    basis = np.ascontiguousarray(page_polynomial(points, chart.page_mm, order))
    bend = np.stack([robust_least_squares(basis, off[:, axis], 3)[0] for axis in (0, 1)], axis=1)
    return ChartMap(chart.page_mm, framing.homography, bend, none, float("nan"))


def _shifted(smooth: ChartMap, plane: Plane, chart: Chart) -> ChartMap:
    """Return a map corrected by the shifts of blocks."""
    width, height = chart.page_mm
    px_per_mm = float(smooth.scale([(width / 2, height / 2)]).mean())
    columns, rows = (max(2, round(side * px_per_mm / BLOCK_PX) + 1) for side in (width, height))
    printed = _printed(chart, px_per_mm)
    seen = _rectified(smooth, plane, printed.shape, px_per_mm)
    reach = int(np.clip(0.8 * min(chart.cell_mm) * px_per_mm, 3, 12))
    half = BLOCK_PX // 2
    found, good = np.zeros((rows, columns, 2)), np.zeros((rows, columns), dtype=np.bool_)
    for row in range(rows):
        for column in range(columns):
            x, y = column / (columns - 1) * width * px_per_mm, row / (rows - 1) * height * px_per_mm
            left, top = (
                int(np.clip(place - half, reach, size - 2 * half - reach))
                for place, size in ((x, printed.shape[1]), (y, printed.shape[0]))
            )
            if min(left, top) < reach:
                continue
            template = printed[top : top + 2 * half, left : left + 2 * half]
            window = seen[top - reach : top + 2 * half + reach, left - reach : left + 2 * half + reach]
            if float(template.std()) < 1e-3 or float(window.std()) < 1e-6:
                continue
            score = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
            _, best, _, place = cv2.minMaxLoc(score)
            good[row, column] = best >= MIN_MATCH
            found[row, column] = _peak(np.asarray(score, dtype=np.float64), place[0], place[1]) - reach
    shifts = _settled(found, good)
    axes = smooth.homography[:2, :2] / np.linalg.norm(smooth.homography[:2, :2], axis=0)
    # Shifts were seen in the print's directions; a frame's are turned against them.
    return ChartMap(chart.page_mm, smooth.homography, smooth.bend, shifts @ axes.T, float(good.mean()))


def _printed(chart: Chart, px_per_mm: float) -> npt.NDArray[np.float32]:
    """Return the chart as printed, (H, W) float32 brightness 0 … 1, at so many pixels to the millimetre."""
    width, height = (round(side * px_per_mm) for side in chart.page_mm)
    drawing = field_drawing(chart)
    canvas = np.full((2 * height, 2 * width), 255, dtype=np.uint8)
    boxes = np.rint(2 * px_per_mm * drawing.rectangles_mm).astype(int).tolist()
    values = np.rint(drawing.rgb @ _LUMA).astype(int).tolist()
    for (left, top, right, bottom), value in zip(boxes, values, strict=True):
        canvas[top:bottom, left:right] = value
    small = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small / 255, dtype=np.float32)


def _rectified(smooth: ChartMap, plane: Plane, shape: tuple[int, ...], px_per_mm: float) -> npt.NDArray[np.float32]:
    """Return a plane as it would look upright and flat, (H, W) float32, at so many pixels to the millimetre."""
    step = 16
    rows, columns = (size // step + 2 for size in shape[:2])
    y, x = np.mgrid[:rows, :columns] * step
    points = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) / px_per_mm
    places = (smooth.to_pixels(points) - plane.offset_px).reshape(rows, columns, 2).astype(np.float32)
    fine_y, fine_x = np.mgrid[: shape[0], : shape[1]].astype(np.float32) / step
    maps = [cv2.remap(np.ascontiguousarray(places[..., axis]), fine_x, fine_y, cv2.INTER_LINEAR) for axis in (0, 1)]
    return np.asarray(cv2.remap(plane.values, maps[0], maps[1], cv2.INTER_LINEAR), dtype=np.float32)


def _peak(score: _Array, column: int, row: int) -> _Array:
    """Return the place (x, y) of a score's highest value, to a part of a pixel by parabolas."""
    place = np.array([column, row], dtype=np.float64)
    for axis, (at, values) in enumerate(((column, score[row]), (row, score[:, column]))):
        if 0 < at < len(values) - 1:
            before, top, after = values[at - 1 : at + 2]
            bend = before - 2 * top + after
            place[axis] += float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
    return place


def _settled(found: _Array, good: npt.NDArray[np.bool_]) -> _Array:
    """Return shifts (rows, columns, 2) in which what does not agree with its neighbours is replaced by their median."""
    rows, columns = good.shape
    values = np.where(good[..., None], found, np.nan)
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    around = np.stack([padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)])
    known = np.isfinite(around).any(axis=0)
    middle = np.where(known, np.nanmedian(np.where(known, around, 0.0), axis=0), 0.0)
    with np.errstate(invalid="ignore"):
        near = (np.abs(values - middle) <= SHIFT_SPREAD_PX).all(axis=-1, keepdims=True)
    return np.where(near & good[..., None], found, middle)


@dataclass(frozen=True, eq=False)
class Levels:
    """What patches of the print show in a frame.

    - `mean`: (N, 3) float64 camera RGB, counts above black, mean over a window in the middle; NaN outside the frame.
    - `clipped`: (N,) bool, whether a photosite of the window is clipped.
    """

    mean: _Array
    clipped: npt.NDArray[np.bool_]


def smallest_cell_px(chart: Chart, place: ChartMap) -> float:
    """Return the shorter side of the chart's smallest cell, half-size px."""
    width, height = chart.page_mm
    corners = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, height / 2)]
    return float((place.scale(corners) * chart.cell_mm).min())


def window_px(chart: Chart, place: ChartMap) -> int:
    """Return the side of the window that is looked at of a patch, px: half the smallest patch, odd, 3 … 9."""
    width, height = chart.page_mm
    smallest = np.min([chart.cell_mm, *(reference.size_mm for reference in chart.references)], axis=0)
    cell = float((smallest * place.scale([(width / 2, height / 2)])).min())
    return int(np.clip(2 * (cell // 4) + 1, 3, 9))


def levels(mosaic: Mosaic, place: ChartMap, points_mm: npt.ArrayLike, window: int, saturation: float) -> Levels:
    """Return what patches about points (N, 2) mm show in a frame.

    `points_mm`: (N, 2) float, middles of the patches. `window`: side of the window, px, odd. `saturation`: raw count at
    which the sensor saturates.
    """
    from scipy.ndimage import map_coordinates

    black = frame_black(mosaic)
    places = place.to_pixels(points_mm)
    # By pairs of planes: a maximum along axes of two takes ten times as long.
    (top_left, top_right), (bottom_left, bottom_right) = mosaic.block_planes()
    highest = np.maximum(np.maximum(top_left, top_right), np.maximum(bottom_left, bottom_right))
    height, width = highest.shape
    margin = window // 2
    inside = ((places >= margin) & (places <= (width - 1 - margin, height - 1 - margin))).all(axis=1)
    mean = np.full((len(places), 3), np.nan)
    for number, channel in enumerate(CHANNELS):
        plane = plane_of(mosaic, channel, black)
        smooth = cv2.blur(plane.values, (window, window))
        at = places[inside] - plane.offset_px
        mean[inside, number] = map_coordinates(smooth, at[:, ::-1].T, order=1, mode="nearest")
    full = cv2.dilate((highest >= CLIPPING_SHARE * saturation).astype(np.uint8), np.ones((window, window), np.uint8))
    columns, rows = np.rint(places[inside]).astype(int).T
    clipped = np.zeros(len(places), dtype=np.bool_)
    clipped[inside] = full[rows, columns] > 0
    return Levels(mean, clipped)
