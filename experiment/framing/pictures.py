"""A frame as a picture to look at, and how large and how sharp the chart is on it.

`annotated_png` shows where the chart is, at half size; the ticks along its border count raw pixels, in which corners
are given by hand (`experiment.framing.field`). `preview_jpeg` is the small picture that a session keeps of each frame.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from drivers.raw.rawfile import Mosaic
from experiment.chart.model import TAG_MODULES, Chart
from experiment.framing.field import FoundField, PreparedPicture
from experiment.framing.finding import MIN_MODULE_PX, FoundTag, Framing, find_tags
from experiment.framing.homography import project
from experiment.framing.planes import CHANNELS, Plane, frame_black, phases, plane_of, strongest_plane

WIDTH_PX = 640
"""Longer side of a preview at most, as the journal has it."""

_QUALITY = 80
"""JPEG quality: some 40 kB, 30 MB a session."""

_GREEN, _RED, _AMBER, _GREY = (60, 200, 60), (40, 40, 255), (40, 200, 255), (200, 200, 200)
"""BGR codes: of page and tags; of outlines that place them and of what deviates; of texts and candidates; of ticks."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TICK_RAW_PX = 500
"""Raw pixels from tick to tick along the border: about ten on the longer side of an 18-megapixel frame."""

_LETTER_PX = 7.4
"""Width of a letter of the cause at `_SCALE`, px."""

_SCALE = 0.42
"""Size of the letters, of OpenCV's font: the least that is read with ease."""

_FAINTEST = 0.01
"""Share of white to which a dark frame is brightened at most: else its noise would be the picture."""

_Image = npt.NDArray[np.uint8]
_Points = npt.NDArray[np.float64]


def annotated_png(mosaic: Mosaic, chart: Chart, framing: Framing | None) -> bytes:
    """Return a frame, stretched to be seen, as PNG bytes: half-size, with what was found, or looked for, drawn on it.

    Found are the page's outline and tags, or the outline of the field. Where the chart was not found, the picture says
    what was looked for, and shows what came nearest: tags of any number, or large outlines.
    """
    black = frame_black(mosaic)
    plane = framing.plane if framing is not None else strongest_plane(mosaic, black)
    white = max(float(np.percentile(plane.values[::4, ::4], 99.5)), 1.0)
    grey = np.clip(plane.values / white, 0, 1) ** (1 / 2.2) * 255
    image: _Image = cv2.cvtColor(grey.astype(np.uint8), cv2.COLOR_GRAY2BGR).astype(np.uint8)
    _draw_ticks(image)
    if framing is not None:
        width, height = chart.page_mm
        _draw_outline(image, project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)]), _GREEN)
        _draw_tags(image, framing)
        if framing.field is not None:
            for place in framing.field.outline_px.round().astype(int).tolist():
                cv2.circle(image, place, 2, _RED, -1)
    elif chart.tags:
        _draw_missing_tags(image, plane, chart)
    else:
        _draw_rectangles(image, [plane_of(mosaic, channel, black) for channel in CHANNELS], chart)
    return cv2.imencode(".png", image)[1].tobytes()


def _draw_missing_tags(image: _Image, plane: Plane, chart: Chart) -> None:
    ids = sorted(tag.id for tag in chart.tags)
    found = find_tags(plane)
    for tag in found:
        _draw_outline(image, tag.corners_px, _AMBER)
    _draw_text(
        image,
        f"looked for: {len(ids)} AprilTags 36h11, ids {ids[0]} to {ids[-1]}",
        f"found: {', '.join(str(tag.id) for tag in found[:12]) or 'none'}",
    )


def _draw_rectangles(image: _Image, planes: list[Plane], chart: Chart) -> None:
    quads = PreparedPicture.of(planes).quads()
    for quad in quads:
        _draw_outline(image, quad, _AMBER, 1)
    _draw_text(
        image,
        f"looked for: a rectangle of {chart.colour_count} cells in white paper",
        f"found: {len(quads) or 'no'} large rectangles, none of these cells",
    )


def _draw_tags(image: _Image, framing: Framing) -> None:
    for tag in framing.tags:
        _draw_outline(image, tag.corners_px, _RED)
        place = tag.corners_px[0].round().astype(int).tolist()
        cv2.putText(image, str(tag.id), place, _FONT, 0.8, _AMBER, 2, cv2.LINE_AA)


def _draw_outline(image: _Image, corners_px: _Points, colour: tuple[int, int, int], width: int = 2) -> None:
    cv2.polylines(image, [corners_px.round().astype(np.int32)], True, colour, width, cv2.LINE_AA)


def _draw_ticks(image: _Image) -> None:
    height, width = image.shape[:2]
    for raw in range(_TICK_RAW_PX, 2 * max(height, width), _TICK_RAW_PX):
        at = raw // 2
        if at < width:
            cv2.line(image, (at, 0), (at, 12), _GREY, 1)
            cv2.putText(image, str(raw), (at + 3, 14), _FONT, 0.45, _GREY, 1, cv2.LINE_AA)
        if at < height:
            cv2.line(image, (0, at), (12, at), _GREY, 1)
            cv2.putText(image, str(raw), (3, at - 4), _FONT, 0.45, _GREY, 1, cv2.LINE_AA)


def _draw_text(image: _Image, *lines: str) -> None:
    height, width = image.shape[:2]
    scale = max(0.4, width / 1600)
    step = round(36 * scale)
    image[height - step * len(lines) - step // 3 :] = 0
    for number, line in enumerate(lines):
        place = (step // 2, height - step * (len(lines) - number - 1) - step // 2)
        cv2.putText(image, line, place, _FONT, scale, _AMBER, 1, cv2.LINE_AA)


def preview_jpeg(
    mosaic: Mosaic,
    black: _Points,
    white: _Points,
    outlines_px: Sequence[_Points],
    boxes: Sequence[tuple[int, int, int, int]],
    cause: str,
) -> bytes:
    """Return a frame as JPEG bytes, at most 640 px wide or high.

    `black`: (2, 2) float64, the frame's black level. `white`: (3,) float64, camera RGB above black that is shown as
    white: paper under full white. `outlines_px`: (K, 2) float64 each, half-size px: outlines of tags, or of the field.
    `boxes`: left, top, right, bottom of parts that deviate, half-size px.
    """
    blocks = mosaic.block_planes()
    height, width = blocks.shape[2:]
    step = -(-max(height, width) // WIDTH_PX)
    of = phases(mosaic)
    small = np.empty((-(-height // step), -(-width // step), 3), dtype=np.float32)
    for number, channel in enumerate(CHANNELS):
        row, column = of[channel][0]
        scale = np.float32(1 / max(float(white[number]), 1.0))
        small[:, :, 2 - number] = (blocks[row, column, ::step, ::step] - np.float32(black[row, column])) * scale
    brightest = max(float(np.percentile(small[::4, ::4].max(axis=2), 99.5)), _FAINTEST)
    image = (np.sqrt(np.clip(small, 0, brightest) / np.float32(brightest)) * 255).astype(np.uint8)
    for corners in outlines_px:
        cv2.polylines(image, [(corners / step).round().astype(np.int32)], True, _GREEN, 1, cv2.LINE_AA)
    for box in boxes:
        x0, y0, x1, y1 = (edge // step for edge in box)
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), _RED, 1)
    if cause:
        image = _written(image, cause)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _written(image: npt.NDArray[np.uint8], cause: str) -> npt.NDArray[np.uint8]:
    """Return the picture with a sentence over its lower edge."""
    # OpenCV's letters are those of ASCII.
    plain = cause.replace("°", " deg").replace("×", "x").replace("–", "-").replace("−", "-").replace("…", "...")
    lines = textwrap.wrap(plain.encode("ascii", "replace").decode(), max(20, int(image.shape[1] / _LETTER_PX)))[:5]
    height, line = len(image), 17
    top = height - line * len(lines) - line // 2
    image[top:] //= 3
    for number, text in enumerate(lines):
        cv2.putText(image, text, (6, top + line * (number + 1)), _FONT, _SCALE, _AMBER, 1, cv2.LINE_AA)
    return image


MIN_CELL_PX = 8.0
"""Half-size pixels a cell must have for 25 of them to lie safely inside: 5, rounding and registration, and the blur.
8.6 already bleeds 1 % at σ = 0.7."""

HALF_SIZE_PX = {"EOS 550D": (2601, 1732), "EOS 6D Mark II": (3132, 2090)}
"""Width and height of the paper's cameras' half-size images (section 3.3 names them)."""

FILL = 0.94
"""Share of the frame that a sheet fills along its tighter axis."""


MAX_BLUR_PX = 1.0
"""σ of the print's edges up to which cells of any size are found to a few hundredths of a pixel; beyond it the 25
samples of a cell of 10 px take in more than 1 % of light from its neighbours."""

_BLURS = np.geomspace(0.15, 4, 48)
"""σ that are tried, half-size px: from less than a photosite's own to far beyond use, 7 % apart."""

_OUTLINE_PLACES = 80
"""Places of the field's outline at which blur is measured: enough for a median that marks in the margin do not move."""

_INWARDS_PX, _OUTWARDS_PX, _ALONG_PX = 5.0, 2.5, 3.0
"""How much around a place of the field's outline is looked at: one cell, and not the marks in the margin."""


@dataclass(frozen=True)
class ApparentSize:
    """What a camera sees of a chart: pixels of a cell's shorter side and of a tag's module (None without tags)."""

    camera: str
    cell_px: float
    module_px: float | None

    @property
    def enough(self) -> bool:
        """Whether 25 pixels of a cell can be sampled and tags be found."""
        return self.cell_px >= MIN_CELL_PX and (self.module_px is None or self.module_px >= MIN_MODULE_PX)

    def __str__(self) -> str:
        """Return "EOS 550D: 6.1 px a cell, 2.4 px a tag module"."""
        module = "" if self.module_px is None else f", {self.module_px:.1f} px a tag module"
        return f"{self.camera}: {self.cell_px:.1f} px a cell{module}"


def apparent_sizes(chart: Chart) -> list[ApparentSize]:
    """Return what each of the paper's cameras sees of a chart that fills 94 % of its frame, turned as it fits best."""
    module_mm = min((float(np.ptp(tag.corners_mm[:, 0])) / TAG_MODULES for tag in chart.tags), default=None)
    page = sorted(chart.page_mm)
    seen: list[ApparentSize] = []
    for camera, frame in HALF_SIZE_PX.items():
        px_per_mm = FILL * min(pixels / side for pixels, side in zip(sorted(frame), page, strict=True))
        seen.append(ApparentSize(camera, min(chart.cell_mm) * px_per_mm, module_mm and module_mm * px_per_mm))
    return seen


def small_parts_warning(chart: Chart) -> str | None:
    """Return a sentence when a camera cannot separate the chart's cells or read its tags, else None."""
    seen = apparent_sizes(chart)
    if all(size.enough for size in seen):
        return None
    least = "" if seen[0].module_px is None else f" and {MIN_MODULE_PX:g} px a tag module"
    return (
        f"cells of {min(chart.cell_mm):.2f} mm are small for a camera: at {FILL:.0%} of the frame (half-size) "
        f"{'; '.join(map(str, seen))}; {MIN_CELL_PX:g} px a cell{least} are needed: fewer bits, larger cells, or a "
        "page nearer to 3 : 2"
    )


def blur_px(framing: Framing) -> float:
    """Return how soft the picture is: σ of the Gaussian that printed edges have been blurred with, px.

    Median over edges: the tags', or of a chart without tags its field's against the margin. Across a tag's edge lie the
    tag's data, its black border, its white rim and what is beyond, the middle two one module wide: a staircase of four
    unknown levels and known steps, blurred. The σ whose staircase fits the pixels best, each at its own distance from
    the edge, is taken; nothing is interpolated, which would blur as well (a slanted edge, as in ISO 12233). It
    contains what lens, focus and movement do, and the photosites' own size and spacing: 0.29 px for green (two
    photosites half a pixel apart), 0.14 px for red and blue. Good to 0.01 px up to a quarter of a module, beyond that
    read up to a tenth high, as the corners themselves are less sure.
    """
    if framing.field is not None:
        found = _outline_blurs(framing.plane, framing.field)[1]
    else:
        found = np.concatenate([_edge_blurs(framing.plane, tag) for tag in framing.tags])
    return float(np.median(found)) if len(found) else float("nan")


def edge_blurs(framing: Framing) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return where blur was measured, (N, 2) half-size px, and its σ there, (N,) px, as in `blur_px`.

    One place a tag, with the median of its four edges; of a chart without tags, places along its field's outline.
    """
    if framing.field is not None:
        return _outline_blurs(framing.plane, framing.field)
    seen = [(tag.centre_px, edges) for tag in framing.tags if len(edges := _edge_blurs(framing.plane, tag))]
    places = np.array([place for place, _ in seen], dtype=np.float64).reshape(-1, 2)
    return places, np.array([float(np.median(edges)) for _, edges in seen])


def _edge_blurs(plane: Plane, tag: FoundTag) -> npt.NDArray[np.float64]:
    """Return the σ of each of a tag's four edges; none where the picture ends."""
    module = tag.side_px / TAG_MODULES
    corners = tag.corners_px - plane.offset_px
    left, top = np.floor(corners.min(axis=0) - module).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + module).astype(int) + 1
    height, width = plane.values.shape
    if left < 0 or top < 0 or right > width or bottom > height:
        return np.empty(0)
    values = plane.values[top:bottom, left:right].ravel().astype(np.float64)
    rows, columns = np.mgrid[top:bottom, left:right]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    found = np.empty(4)
    for edge, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        length = float(np.linalg.norm(end - start))
        tangent = (end - start) / length
        along = (pixels - start) @ tangent / length
        # Corners run clockwise with y down, so this points out of the tag.
        across = (pixels - start) @ np.array([tangent[1], -tangent[0]])
        # Clear of the corners, where another edge is near.
        near = (along > 0.2) & (along < 0.8) & (np.abs(across) < module)
        seen, aside = values[near], across[near]
        found[edge] = _sigma(seen, aside, (-module, 0.0, module))
    return found


def _outline_blurs(plane: Plane, field: FoundField) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return places all round the field's edge, (N, 2) px, and the edge's σ there; none where the picture ends."""
    height, width = plane.values.shape
    reach = int(np.ceil(_INWARDS_PX + _ALONG_PX))
    found: list[float] = []
    places: list[_Points] = []
    for number in range(0, len(field.outline_px), max(1, len(field.outline_px) // _OUTLINE_PLACES)):
        place, normal = field.outline_px[number] - plane.offset_px, field.normals[number]
        left, top = np.floor(place).astype(int) - reach
        if left < 0 or top < 0 or left + 2 * reach + 2 > width or top + 2 * reach + 2 > height:
            continue
        rows, columns = np.mgrid[top : top + 2 * reach + 2, left : left + 2 * reach + 2]
        pixels = np.column_stack([columns.ravel(), rows.ravel()]) - place
        across = pixels @ normal
        along = pixels @ np.array([-normal[1], normal[0]])
        near = (np.abs(along) < _ALONG_PX) & (across > -_INWARDS_PX) & (across < _OUTWARDS_PX)
        seen = plane.values[top : top + 2 * reach + 2, left : left + 2 * reach + 2].ravel()[near].astype(np.float64)
        found.append(_sigma(seen, across[near], (0.0,)))
        places.append(field.outline_px[number])
    return np.array(places, dtype=np.float64).reshape(-1, 2), np.array(found)


def _sigma(seen: _Points, aside: _Points, steps_at: Sequence[float]) -> float:
    """Return the σ whose blurred staircase fits counts best: steps of unknown height at places across an edge."""
    sigma = _BLURS[:, None]
    steps = [ndtr((aside - at) / sigma) for at in steps_at]
    # The slope of the edge itself takes up what its place is off.
    slope = np.exp(-0.5 * (aside / sigma) ** 2)
    basis = np.linalg.qr(np.stack([np.ones_like(slope), *steps, slope], axis=-1)).Q
    misfit = (seen**2).sum() - ((seen @ basis) ** 2).sum(axis=-1)
    best = int(np.clip(misfit.argmin(), 1, len(_BLURS) - 2))
    before, least, after = misfit[best - 1 : best + 2]
    part = 0.5 * (before - after) / max(before - 2 * least + after, 1e-12)
    return float(_BLURS[best] * (_BLURS[1] / _BLURS[0]) ** float(np.clip(part, -1, 1)))
