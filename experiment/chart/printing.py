"""Draw the sheet as rectangles on bare paper, and save it as TIFF, PDF and preview.

- The files have true size: print them at 100 %, never with "fit to page". In the TIFF, each patch has the same whole
  number of pixels, and each tag module, too. Unequal modules would shift the detected corners of a tag.
- The codes are amounts of ink, not colours. Therefore the codes have no profile (they are untagged) on the page of the
  PDF and in the normal TIFF. For printing with colour management, the output intent of the PDF and the tagged TIFF
  declare sRGB.
- An A0 sheet at 600 dpi has 1.7 GB of pixels, so it is compressed strip by strip and never completely in memory.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiment.chart.margins import DESIGN_DPI, MM_PER_INCH, PX_MM, Boxes, margin_marks, whole_px
from experiment.chart.model import PAPER_WHITE, TAG_FAMILY, TAG_MODULES, Chart, Tag
from experiment.chart.pdf_x import filled, save_page, srgb_display_profile
from foundation.errors import InputError
from foundation.files import atomic_file, write_atomic

POINTS_PER_MM = 72 / MM_PER_INCH  # A PDF has 72 points per inch (ISO 32000-1, 8.3.2.3)

# Number of rows in a strip of the TIFF. A strip of an A0 sheet at 600 dpi has 5 MB.
_STRIP_ROWS = 64

_BANDS = 64  # A band is a group of equal rows; this number of bands is painted at a time to limit memory

_SUPERSAMPLING = 8  # A preview pixel is the mean of this number of fine pixels in each direction

# In the PDF, a patch overlaps the next patches by `_OVERLAP_PX`, so that no line of paper is visible between them.
# Every rectangle is reduced by `_INSET_PX` on all sides, so that rounding errors do not paint the next pixel.
_OVERLAP_PX, _INSET_PX = 0.2, 0.01


@dataclass(frozen=True, eq=False)
class Drawing:
    """Rectangles on bare paper; later ones cover earlier ones."""

    page_mm: tuple[float, float]  # width and height of the sheet
    rectangles_mm: npt.NDArray[np.float64]  # (N, 4), left, top, right, bottom, from the top-left corner of the sheet
    rgb: npt.NDArray[np.uint8]  # (N, 3), printed code of each rectangle; (255, 255, 255) is bare paper
    tiles: int = 0  # so many rectangles at the end are adjacent patches and references, row by row


def drawing(chart: Chart) -> Drawing:
    """Return the whole sheet: marks in the margins (`experiment.chart.margins`), then tags, patches and references."""
    field = field_drawing(chart)
    marks = _marks_px(chart).astype(np.float64) * PX_MM
    rgb = np.concatenate([np.zeros((len(marks), 3), dtype=np.uint8), field.rgb])
    return Drawing(chart.page_mm, np.concatenate([marks, field.rectangles_mm]), rgb, field.tiles)


def field_drawing(chart: Chart, within_mm: tuple[float, float, float, float] | None = None) -> Drawing:
    """Return the rectangles of the tags (white rim, black square, white modules), then of patches and references.

    `within_mm`: left, top, right, bottom of a window; parts that are not completely inside are omitted.
    """
    left, top, right, bottom = (-math.inf, -math.inf, math.inf, math.inf) if within_mm is None else within_mm
    boxes = _part_boxes(chart)
    codes = np.array([reference.rgb for reference in chart.references], dtype=np.uint8).reshape(-1, 3)
    # Allow for the rounding of coordinates in a file.
    limits = np.array([left, top, -right, -bottom]) - 1e-3
    is_inside = np.asarray((boxes * [1, 1, -1, -1] >= limits).all(axis=1))
    rectangles, rgb = [np.empty((0, 4))], [np.empty((0, 3), dtype=np.uint8)]
    for index, tag in enumerate(chart.tags):
        if is_inside[index]:
            tag_rectangles, shades = _tag_rectangles(tag)
            rectangles.append(tag_rectangles)
            rgb.append(shades)
    tile_indices = np.flatnonzero(is_inside[len(chart.tags) :])
    tiles, colours = boxes[len(chart.tags) :][tile_indices], np.concatenate([chart.rgb, codes])[tile_indices]
    order = np.lexsort(tiles[:, :2].round(3).T)
    all_rectangles = np.concatenate([*rectangles, tiles[order]])
    return Drawing(chart.page_mm, all_rectangles, np.concatenate([*rgb, colours[order]]), len(order))


def _part_boxes(chart: Chart) -> npt.NDArray[np.float64]:
    """Return the boxes (N, 4) float64 mm of tags with white rims, then of patches, then of references."""
    rims = [_tag_rectangles(tag)[0][:1] for tag in chart.tags]
    half = np.array(chart.cell_mm) / 2
    cells = np.concatenate([chart.centres_mm - half, chart.centres_mm + half], axis=1)
    centres = np.array([reference.centre_mm for reference in chart.references]).reshape(-1, 2)
    halves = np.array([reference.size_mm for reference in chart.references]).reshape(-1, 2) / 2
    return np.concatenate([*rims, cells, np.concatenate([centres - halves, centres + halves], axis=1)])


def field_px(chart: Chart) -> Boxes:
    """Return the bounding box of all tags and patches, (4,) int64 px at 600 dpi: left, top, right, bottom."""
    boxes = whole_px(_part_boxes(chart)[: len(chart.tags) + len(chart.centres_mm)])
    return np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])


def _marks_px(chart: Chart) -> Boxes:
    field = field_px(chart)
    references = whole_px(_part_boxes(chart)[len(chart.tags) + len(chart.centres_mm) :])
    is_outside = ((references[:, :2] < field[:2]) | (references[:, 2:] > field[2:])).any(axis=1)
    width, height = (int(side / PX_MM) for side in chart.page_mm)
    return margin_marks(field, (width, height), references[is_outside], label_lines(chart))


def tag_modules(tag: Tag) -> npt.NDArray[np.bool_]:
    """Return the modules of a tag on the upright print, (8, 8) bool, true for white.

    In OpenCV's `DICT_APRILTAG_36h11`, each tag is rotated by 180° against the tag of the AprilTag authors. The detector
    of these authors returns the same id, and the corners of `corners_mm` in the order [1, 0, 3, 2].
    """
    import cv2

    if tag.family != TAG_FAMILY:
        raise InputError(f"tag {tag.id} has family {tag.family}, expected {TAG_FAMILY}; use a chart of acquire chart")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    if not 0 <= tag.id < len(dictionary.bytesList):
        raise InputError(
            f"tag id {tag.id} does not exist, expected 0 to {len(dictionary.bytesList) - 1} for family {TAG_FAMILY}; "
            "use a chart of acquire chart"
        )
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, tag.id, TAG_MODULES)) > 127


def _tag_rectangles(tag: Tag) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    left, top = tag.corners_mm[0]
    right, bottom = tag.corners_mm[2]
    upright = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    if not (right > left and bottom > top and np.allclose(tag.corners_mm, upright, atol=1e-3)):
        raise InputError(f"tag {tag.id} is rotated, expected an upright tag; use a chart of acquire chart")
    size = np.array([right - left, bottom - top]) / TAG_MODULES
    rim = np.array([left, top, right, bottom]) + np.concatenate([-size, size])
    rows, columns = np.nonzero(tag_modules(tag))
    corner = np.array([left, top]) + np.stack([columns, rows], axis=1) * size
    rectangles = np.concatenate([[rim], [[left, top, right, bottom]], np.concatenate([corner, corner + size], axis=1)])
    rgb = np.full((len(rectangles), 3), PAPER_WHITE, dtype=np.uint8)
    rgb[1] = 0
    return rectangles, rgb


def label_lines(chart: Chart) -> tuple[str, str]:
    """Return the two lines of text in the margin: identity of the sheet, and print instruction."""
    width, height = chart.page_mm
    bits = "1 bit" if chart.bits == 1 else f"{chart.bits} bits"
    facts = [f"CroP chart, {bits}, {width:g} x {height:g} mm", f"chart.json {chart.sha256[:16]}"]
    facts += [] if chart.seed is None else [f"seed {chart.seed}"]
    facts += [] if chart.software is None else [chart.software.encode("ascii", "replace").decode()]
    return ", ".join(facts), "Print at 100 %, colour management off, on matte paper; the rulers are in millimetres."


def label(chart: Chart) -> str:
    """Return both lines of `label_lines` as one line."""
    return ". ".join(label_lines(chart))


def _bands(
    sheet: Drawing, pixels_per_mm: float, size: tuple[int, int]
) -> Iterator[tuple[int, int, npt.NDArray[np.uint8]]]:
    """Yield bands of equal rows from top to bottom: first row, end row, and the pixels (width, 3) uint8 of one row.

    `size`: width and height of the image in pixels. Edges are rounded to pixels.
    """
    width, height = size
    boxes = np.rint(sheet.rectangles_mm * pixels_per_mm).astype(np.int64)
    boxes = np.clip(boxes, 0, [width, height, width, height])
    xs, ys = (np.unique(np.append(boxes[:, axis::2], [0, end])) for axis, end in enumerate(size))
    (left, right), (top, bottom) = np.searchsorted(xs, boxes[:, 0::2]).T, np.searchsorted(ys, boxes[:, 1::2]).T
    # All rows between two adjacent edges are equal, so a rectangle is painted once for many rows.
    for first in range(0, len(ys) - 1, _BANDS):
        band_edges = ys[first : first + _BANDS + 1].tolist()
        band_rows = np.full((len(band_edges) - 1, len(xs) - 1, 3), PAPER_WHITE, dtype=np.uint8)
        for k in np.flatnonzero((top < first + len(band_rows)) & (bottom > first)).tolist():
            band_rows[max(top[k] - first, 0) : bottom[k] - first, left[k] : right[k]] = sheet.rgb[k]
        for (start, end), row in zip(pairwise(band_edges), band_rows, strict=True):
            yield start, end, np.repeat(row, np.diff(xs), axis=0)


def _packed_strips(bands: Iterator[tuple[int, int, npt.NDArray[np.uint8]]], height: int) -> Iterator[bytes]:
    rows: list[npt.NDArray[np.uint8]] = []
    for top, bottom, row in bands:
        for y in range(top, bottom):
            rows.append(row)
            if len(rows) == _STRIP_ROWS or y == height - 1:
                # Fast compression is sufficient, because rows are repeated so often.
                yield zlib.compress(np.stack(rows).tobytes(), 1)
                rows = []


def _require_whole_pixels(chart: Chart, dpi: int) -> None:
    lengths = [*chart.cell_mm, *(float(np.ptp(tag.corners_mm[:, 0])) / TAG_MODULES for tag in chart.tags)]
    for length in lengths:
        pixels = length * dpi / MM_PER_INCH
        if dpi < 1 or round(pixels) < 1 or abs(pixels - round(pixels)) > 1e-3:
            raise InputError(
                f"at {dpi} dpi a patch or tag module of {length:.3f} mm has {pixels:.2f} px, expected a whole number; "
                f"choose {_whole_pixel_resolutions(lengths)} dpi, or print the PDF"
            )


def _whole_pixel_resolutions(lengths: list[float]) -> str:
    pixels = {dpi: [length * dpi / MM_PER_INCH for length in lengths] for dpi in (1200, 600, 360)}
    whole = [f"{dpi}" for dpi, sizes in pixels.items() if all(abs(size - round(size)) <= 1e-3 for size in sizes)]
    return " or ".join(whole) or "another number of"


def save_tiff(chart: Chart, path: Path, dpi: int = DESIGN_DPI, tagged: bool = False) -> None:
    """Write the sheet as an RGB TIFF of true size: 8 bits, deflate.

    Parameters
    ----------
    dpi
        Resolution at which patches and tag modules are whole pixels. 600 and 1200 are suitable for every chart of
        `experiment.chart.layout`, and any multiple of 24 for a chart on A0.
    tagged
        Whether the codes are tagged as sRGB, for a print shop that uses the colour profile of its printer.
    """
    import tifffile

    _require_whole_pixels(chart, dpi)
    sheet = drawing(chart)
    width, height = (round(side * dpi / MM_PER_INCH) for side in chart.page_mm)
    bands = _bands(sheet, dpi / MM_PER_INCH, (width, height))
    with atomic_file(path) as stream, tifffile.TiffWriter(stream) as writer:
        writer.write(
            _packed_strips(bands, height),
            shape=(height, width, 3),
            dtype=np.uint8,
            photometric="rgb",
            compression="adobe_deflate",
            rowsperstrip=_STRIP_ROWS,
            resolution=(dpi, dpi),
            resolutionunit="inch",
            description=label(chart),
            software="CroP",
            metadata=None,
            iccprofile=srgb_display_profile() if tagged else None,
        )


def save_pdf(chart: Chart, path: Path) -> None:
    """Write the sheet as PDF/X-4: one page of filled rectangles in DeviceRGB."""
    save_drawing(drawing(chart), path, label(chart), f"chart.json has SHA-256 {chart.sha256}")


def save_drawing(sheet: Drawing, path: Path, title: str, subject: str, operators: bytes = b"") -> None:
    """Write a drawing as PDF/X-4 with one page. `operators`: further PDF operators at the end of the page."""
    width, height = (side * POINTS_PER_MM for side in sheet.page_mm)
    corners = sheet.rectangles_mm * POINTS_PER_MM
    # Renderers paint every pixel that a rectangle touches. A slightly smaller rectangle does not touch the next pixel
    # after rounding.
    inset, overlap = _INSET_PX * PX_MM * POINTS_PER_MM, _OVERLAP_PX * PX_MM * POINTS_PER_MM
    corners += np.array([inset, inset, -inset, -inset])
    corners[len(corners) - sheet.tiles :, 2:] += overlap
    left, top, right, bottom = corners.T
    boxes = np.stack([left, height - bottom, right - left, bottom - top], axis=1)
    changes = np.flatnonzero((np.diff(sheet.rgb.astype(np.int64), axis=0) != 0).any(axis=1)) + 1
    # Successive rectangles of the same colour share one path, which saves bytes.
    paths: list[bytes] = []
    for first, last in zip([0, *changes.tolist()], [*changes.tolist(), len(corners)], strict=True):
        red, green, blue = (int(code) for code in sheet.rgb[first])
        rows = ((box[0], box[1], box[2], box[3]) for box in boxes[first:last].tolist())
        paths.append(filled(rows, (red, green, blue)))
    save_page(path, (width, height), b"".join([*paths, operators]), title, subject)


def preview(chart: Chart, width_px: int) -> npt.NDArray[np.uint8]:
    """Return a small image of the sheet, (height, width_px, 3) uint8 RGB, with area-averaged pixels."""
    import cv2
    from scipy import sparse

    if width_px < 1:
        raise InputError(f"a preview of {width_px} pixels is requested, expected 1 or more; give a larger width")
    height_px = max(1, round(width_px * chart.page_mm[1] / chart.page_mm[0]))
    fine_size = (width_px * _SUPERSAMPLING, height_px * _SUPERSAMPLING)
    bands = list(_bands(drawing(chart), fine_size[0] / chart.page_mm[0], fine_size))
    # Means along the rows. OpenCV calculates them much faster than numpy.
    means = np.stack(
        [
            cv2.resize(row[None].astype(np.float32), (width_px, 1), interpolation=cv2.INTER_AREA)[0]
            for _, _, row in bands
        ]
    )
    band_tops, band_bottoms = np.array([[top, bottom] for top, bottom, _ in bands]).T
    tops = np.arange(height_px)[:, None] * _SUPERSAMPLING
    shared = np.minimum(band_bottoms, tops + _SUPERSAMPLING) - np.maximum(band_tops, tops)
    weights = sparse.csr_array(np.maximum(shared, 0) / _SUPERSAMPLING)
    picture = np.asarray(weights @ means.reshape(len(bands), -1), dtype=np.float64)
    return np.rint(picture).reshape(height_px, width_px, 3).astype(np.uint8)


def save_preview(chart: Chart, path: Path, width_px: int = 2400) -> None:
    """Write `preview` as a PNG."""
    import cv2

    _, png = cv2.imencode(".png", np.ascontiguousarray(preview(chart, width_px)[:, :, ::-1]))
    write_atomic(path, png.tobytes())
