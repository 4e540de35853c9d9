"""Make a proof page on A4, and instructions for the print shop.

The proof shows a part of the sheet at true size. Before the sheet is ordered, it reveals errors of scale, sharpness and
colour management. A strip of greys is printed twice, as rectangles and as an image. If colour management is on,
printers convert rectangles and images differently, and a seam becomes visible between them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiment.chart.margins import DESIGN_DPI, MM_PER_INCH, PX_MM, Boxes, margin_marks, text_boxes, whole_px
from experiment.chart.model import Chart
from experiment.chart.pdf_x import row_of_pixels
from experiment.chart.printing import POINTS_PER_MM, Drawing, field_drawing, field_px, label_lines, save_drawing
from foundation.files import write_atomic

PAGE_MM = (297.0, 210.0)  # A4, landscape (ISO 216), which every printer has

# Largest width and height of the area with patches on the proof page.
WINDOW_MM = (262.0, 107.0)

CORNER_PX = (360, 330)  # Left and top of the area with patches, px at 600 dpi

# Top, height and step width of the strip of greys below the patches.
WEDGE_TOP_MM, WEDGE_HEIGHT_MM, WEDGE_STEP_MM = 137.0, 12.0, 8.0

WEDGE_CODES = (*range(0, 256, 8), 255)  # Codes of the greys: the 32 levels of a channel of the chart, and bare paper

# Top, line distance and dot size of the text.
TEXT_TOP_MM, TEXT_LINE_MM, TEXT_DOT_PX = 154.0, 4.8, 3

# Text on the proof page.
LOOK_FOR = (
    "1 Scale: 100 mm on each printed ruler are 100 mm on a steel ruler, within 0.3 mm. Otherwise the page was scaled.",
    "2 Colour management: each grey step has two halves with the same code. The lower half is printed as an image.",
    "  If a seam or a colour difference is visible between the halves, colour management is on: switch it off.",
    "3 Range: adjacent steps look different at both ends. The steps become lighter from left to right without a",
    "  jump. The last step is bare paper. No patch is mottled or striped.",
    "4 Sharpness: the spokes of the star are separate down to 1 mm from its centre, and the bars up to the seventh",
    "  group (2 line pairs per millimetre). The edges of the black squares are straight, without a halo.",
    "5 Surface: matte from every side, no varnish, no lamination. Let the page dry for a day before you judge colours.",
    "Keep this page: the sheet must be printed with the same paper, ink and settings.",
)


def proof_drawing(chart: Chart) -> Drawing:
    """Return the proof page: the top-left part of the chart with rulers and targets, a strip of greys, and text."""
    left, top, right, bottom = field_px(chart).tolist()
    cell = [side / PX_MM for side in chart.cell_mm]
    # The window contains whole patches. Tags and references that it would cut are omitted.
    sides = [
        min(high - low, round(math.floor(room / PX_MM / size) * size))
        for low, high, room, size in zip((left, top), (right, bottom), WINDOW_MM, cell, strict=True)
    ]
    window = np.array([left, top, left + sides[0], top + sides[1]]) * PX_MM
    cutout = field_drawing(chart, (window[0], window[1], window[2], window[3]))
    shift = (np.array(CORNER_PX) - (left, top)) * PX_MM
    box = np.array([*CORNER_PX, CORNER_PX[0] + sides[0], CORNER_PX[1] + sides[1]], dtype=np.int64)
    page_px = (int(PAGE_MM[0] / PX_MM), int(PAGE_MM[1] / PX_MM))
    text_area = whole_px([[0, WEDGE_TOP_MM, PAGE_MM[0], PAGE_MM[1]]])
    title = f"PROOF of a piece of {label_lines(chart)[0]}"
    marks = margin_marks(box, page_px, text_area, (title, label_lines(chart)[1]))
    text = [_line(line, row) for row, line in enumerate(LOOK_FOR)]
    black = np.concatenate([marks, *text]).astype(np.float64) * PX_MM
    wedge = _wedge_boxes()
    wedge[:, 3] -= WEDGE_HEIGHT_MM / 2
    shades = np.repeat(np.array(WEDGE_CODES, dtype=np.uint8)[:, None], 3, axis=1)
    return Drawing(
        PAGE_MM,
        np.concatenate([black, wedge, cutout.rectangles_mm + np.tile(shift, 2)]),
        np.concatenate([np.zeros((len(black), 3), dtype=np.uint8), shades, cutout.rgb]),
        cutout.tiles,
    )


def _line(text: str, row: int) -> Boxes:
    x, y = CORNER_PX[0], round((TEXT_TOP_MM + row * TEXT_LINE_MM) / PX_MM)
    return text_boxes(text, TEXT_DOT_PX) + np.array([x, y, x, y])


def _wedge_boxes() -> npt.NDArray[np.float64]:
    boxes = np.array([0.0, WEDGE_TOP_MM, WEDGE_STEP_MM, WEDGE_TOP_MM + WEDGE_HEIGHT_MM])
    left = CORNER_PX[0] * PX_MM + WEDGE_STEP_MM * np.arange(len(WEDGE_CODES), dtype=np.float64)
    return boxes + left[:, None] * np.array([1.0, 0.0, 1.0, 0.0])


def _image_half() -> bytes:
    boxes = _wedge_boxes() * POINTS_PER_MM
    left, right = float(boxes[0, 0]), float(boxes[-1, 2])
    bottom = PAGE_MM[1] * POINTS_PER_MM - float(boxes[0, 3])
    height = WEDGE_HEIGHT_MM / 2 * POINTS_PER_MM
    return row_of_pixels([(code, code, code) for code in WEDGE_CODES], (left, bottom, right - left, height))


def save_proof(chart: Chart, path: Path) -> None:
    """Write `proof_drawing` as a PDF/X-4 of one A4 page, landscape."""
    title = f"Proof page of {label_lines(chart)[0]}"
    save_drawing(proof_drawing(chart), path, title, f"chart.json has SHA-256 {chart.sha256}", _image_half())


def instructions(chart: Chart, tiff: bool = True) -> str:
    """Return instructions for the print shop; `tiff`: whether the sheet is also available as a TIFF."""
    width, height = chart.page_mm
    left, top, right, bottom = (field_px(chart) * PX_MM).tolist()
    across, down = (math.floor((end - start) / 100) * 100 for start, end in ((left, right), (top, bottom)))
    pixels = " × ".join(f"{round(side / MM_PER_INCH * DESIGN_DPI)}" for side in chart.page_mm)
    raster = f" or chart.tif ({pixels} pixels, {DESIGN_DPI} dpi, untagged); both show the same" if tiff else ""
    scale = (
        f"Marks 0 and {across} below the patches are {across} mm apart, marks 0 and {down} on the left {down} mm."
        if min(across, down) > 0
        else "The numbers on the rulers are distances from mark 0, in mm."
    )
    return f"""How to print this chart
=======================

{label_lines(chart)[0]}

Send chart.pdf (vector){raster}.
First print proof.pdf on A4 with the same printer, paper and settings, and check it as its text describes.

For the print shop
------------------
Page            {width:g} × {height:g} mm on one sheet, not tiled. The margins contain marks: print them too.
Scale           100 %, "actual size"; never "fit to page". On a roll, cut along the corner marks.
File            chart.pdf is PDF/X-4: vector, trim box = sheet, no fonts, no transparency, no bleed. Its page is
                untagged RGB (DeviceRGB).
Colours         NO COLOUR MANAGEMENT. Print the file like a profiling target: its RGB values must reach the printer
                driver unchanged. Only the driver converts RGB to inks.
In the RIP      Colour management: off / "none" / "as target (profiling chart)". Input profile for RGB: none. Embedded
                profiles and the PDF's output intent: IGNORE. Rendering intent, black point compensation, grey balance,
                "pure hues", spot colour replacement, "enhancement", ink saving: off. Calibration (linearisation) of the
                printer: as usual.
In a driver     "No colour adjustment" / "application manages colours", from a program that does not convert colours
                (Adobe Color Printer Utility, ColorSync Utility "print as colour target").
Profile         Use no profile, and do not convert to CMYK. The output intent of the PDF is sRGB only because PDF/X
                requires an output intent. Do not convert to it.
Quality         The best of the printer, at least 600 dpi; no smoothing, sharpening or interpolation of the image.
Paper           Matte, white, heavy enough to hang flat (180 g/m² or more). If possible, no optical brighteners.
Finish          None: no varnish, no lamination, no mounting under film or glass.
Drying          One day, flat and unrolled, before anything is measured.

When it comes back
------------------
Scale           {scale}
                Check with a steel ruler. An error of 3 mm per metre is allowed, because paper changes with humidity.
Sharpness       The stars and bars in the margin are as sharp as on the proof.
Colours         All squares of the same grey look equal everywhere on the sheet.
Mounting        Flat on a board or wall, fixed on all sides, no glass, waves below 3 mm. Do not trim the margins.
Keep            This folder. chart.json is needed to read the photographs; its hash is printed above the patches.
"""


def save_instructions(chart: Chart, path: Path, tiff: bool = True) -> None:
    """Write `instructions` as text, UTF-8."""
    write_atomic(path, instructions(chart, tiff))
