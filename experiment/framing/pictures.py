"""A frame as a picture to look at: what of the chart was found on it, looked for and not found, or deviates.

`annotated_png` shows where the chart is, at half size; the ticks along its border count raw pixels, in which corners
are given by hand (`experiment.framing.field`). `preview_jpeg` is the small picture that a session keeps of each frame.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Mosaic
from experiment.chart.model import Chart
from experiment.framing.field import PreparedPicture
from experiment.framing.finding import Framing, find_tags
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
