"""The table's report: one page that shows by eye what the figures claim, and the same figures for programs.

`report.json` holds figures, limits and verdict; `report.html` opens with the verdict, what to do, and the pictures that
are looked at first: the registered grid over the frame, the lights as planned and as the camera saw them (the paper's
three figures of chromaticities), where cells err, and the noise. All figures follow in groups, each with its pictures.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.figures.table_figures import TableFigures
from calibration.report.first_plots import cell_noise, draw_errors, draw_noise
from calibration.report.half_size import half_size
from calibration.report.page import Picture, page
from calibration.report.places import (
    LabelledPlace,
    draw_places,
    draw_reference_residuals,
    reference_residuals,
)
from calibration.report.plots import (
    WORST_CELLS,
    draw_chromaticities,
    draw_course,
    draw_field,
    draw_print,
    draw_registration,
    draw_residuals,
    draw_worst_cells,
    png_of,
)
from calibration.report.report_json import report_json
from calibration.report.worsts import Worst, worst_of
from calibration.table.lut import REPORT_JSON, REPORT_PAGE
from calibration.verdict.result import BuildResult
from calibration.verdict.retaking import findings
from drivers.raw.rawfile import read_raw
from experiment.chart.model import Chart
from experiment.measures.flat_field import FlatField
from experiment.measures.stains import Stains
from experiment.session.folder import Session
from foundation.files import write_whole

MOST_FRAMES = 4
"""Frames that are drawn with their places: each is read again, and more are looked at by nobody."""


def write_report(result: BuildResult, session: Session, folder: Path) -> None:
    """Write `report.html` and `report.json` into a table's folder; costs some seconds."""
    worsts = worst_of(result.figures, session.chart)
    pictures = _pictures(result, session, worsts)
    write_whole(folder / REPORT_PAGE, page(result, pictures, _place_pictures(result, session), worsts))
    write_whole(folder / REPORT_JSON, json.dumps(report_json(result), indent=2) + "\n")


def _pictures(result: BuildResult, session: Session, worsts: Sequence[Worst]) -> list[Picture]:
    """Return the pictures: first chart, lights, errors and noise, then those of the groups."""
    figures = result.figures
    chart, registration = session.chart, figures.registration
    frame = half_size(read_raw(session.folder / figures.session.registered_file))
    return [
        *_first_pictures(result, session, frame, worsts),
        Picture(
            "Residuals of the registration",
            "Left: how far the cells moved the map from what the tags and the lens alone give, which is the paper's "
            "waviness. Right: the residual of each block of cells, magnified; short arrows without order are noise.",
            png_of(draw_residuals, chart, registration),
            "geometry",
        ),
        *_worst_pictures(chart, figures, frame, worsts),
        Picture(
            "The light on the print",
            "Shape of the light under the frame that was registered, from its white references; it is divided out of "
            f"samples and ground truth. Contours are 2 % apart. {_primaries_caption(figures)}",
            png_of(draw_field, chart, _registered_field(figures)),
            "light",
        ),
        *_print_picture(chart, figures.cells.stains),
        Picture(
            "The course of the session",
            "Black level, movement and blur of the chart, bare paper under white, how far cells are off their codes' "
            "colours, and the white references used, frame by frame; the worst frame of each is ringed. All cells are "
            "off where the focus is lost, a block of them where a hand or a shadow lies on the print.",
            png_of(draw_course, figures),
            "radiometry",
        ),
        Picture(
            "The worst cells",
            f"The {WORST_CELLS} cells whose rim and middle differ most under white, in standard deviations, each "
            "between its neighbours; the frame is the samples.",
            png_of(draw_worst_cells, frame, chart, registration, figures.cells.window),
            "noise",
        ),
        *_residual_picture(chart, figures, frame),
    ]


def _first_pictures(
    result: BuildResult, session: Session, frame: npt.NDArray[np.float32], worsts: Sequence[Worst]
) -> list[Picture]:
    """Return what a scientist looks at first: chart, lights, errors, noise."""
    figures, chart = result.figures, session.chart
    registration, window = figures.registration, figures.cells.window
    codes = np.array([light.codes for light in session.illuminations])
    black_body = np.array([light.kind == "blackbody" for light in session.illuminations], dtype=np.bool_)
    seen = f"seen by the {figures.session.camera}"
    truth = next((worst.light for worst in worsts if worst.figure == "truth_worst_deg"), None)
    ringed = "" if truth is None else f" Ringed is light {truth}, whose ground truth is known worst."
    return [
        Picture(
            "The chart as registered",
            f"{figures.session.registered_file}, contrast stretched, with the tags as found; below, magnified: the "
            f"outline of every cell and the pixels of its {window**2} samples, in the corners and in the middle.",
            png_of(draw_registration, frame, chart, registration, window),
        ),
        Picture(
            "The lights",
            "rb-chromaticities of the lights as projected, as the camera sees them on bare paper (the ground truth), "
            f"and the latter in their colours. Rings are black bodies.{ringed}",
            png_of(draw_chromaticities, codes, black_body, figures.lights.white, seen, truth),
        ),
        Picture(
            "Where cells err",
            "Left: how far cells and their neighbours are off their codes' colours elsewhere on the sheet. Right: how "
            "well the place of each cell is known. The worst cell of each is ringed.",
            png_of(draw_errors, figures, chart),
        ),
        Picture(
            "The noise",
            "Left: variance of one sample over its level, medians of cells of like levels and the fitted curve (read "
            "noise, photons, unequal photosites). Right: what that makes of signal over noise.",
            png_of(draw_noise, cell_noise(frame, chart, registration, window), figures.sensor.transfer, window**2),
        ),
    ]


def _worst_pictures(
    chart: Chart, figures: TableFigures, frame: npt.NDArray[np.float32], worsts: Sequence[Worst]
) -> list[Picture]:
    """Return the picture of the places where figures are worst."""
    places = [(worst.label, worst.place) for worst in worsts if worst.place is not None]
    if not places:
        return []
    caption = (
        "The place of the worst of each figure that has one, on the frame that was registered, whether or not it is "
        "beyond a limit. Worst frames are ringed in the course of the session, the worst light among the lights."
    )
    drawn = png_of(draw_places, frame, chart, figures.registration, places)
    return [Picture("Where the worst is", caption, drawn, "geometry")]


def _place_pictures(result: BuildResult, session: Session) -> list[Picture]:
    """Return a picture of each frame in which something is beyond its limit at a place, which is circled."""
    by_file: dict[str, list[LabelledPlace]] = {}
    titles = {row.threshold.name: row.threshold.title for row in result.verdict.rows}
    for name, found in findings(result.verdict, result.figures).items():
        cause = found.decision.cause.name if found.is_known else "cause not known"
        for place in found.places:
            by_file.setdefault(place.file, []).append((f"{titles[name]}: {cause}", place))
    pictures: list[Picture] = []
    for file, places in list(by_file.items())[:MOST_FRAMES]:
        picture = half_size(read_raw(session.folder / file))
        drawn = png_of(draw_places, picture, session.chart, result.figures.registration, places)
        caption = (
            f"{file}, contrast stretched, with what is beyond its limits circled; places lie as in the frame that was "
            "registered first."
        )
        pictures.append(Picture(f"Where it is: {Path(file).stem}", caption, drawn))
    return pictures


def _residual_picture(chart: Chart, figures: TableFigures, picture: npt.NDArray[np.float32]) -> list[Picture]:
    """Return the picture of what the field leaves of the references, none where there are none."""
    places_mm = np.array([reference.centre_mm for reference in chart.white_references], dtype=np.float64).reshape(-1, 2)
    residual = reference_residuals(picture, places_mm, figures.registration, figures.registered_frame)
    if not np.isfinite(residual).any():
        return []
    caption = (
        "White references about the field, in the frame that was registered. Left, on the print: noise has no order, "
        "what lies or shines on the print is one place. Right, by the distance from the middle: a bend at its end is "
        "fall-off that the field does not follow."
    )
    return [
        Picture("What the field leaves", caption, png_of(draw_reference_residuals, chart, places_mm, residual), "truth")
    ]


def _registered_field(figures: TableFigures) -> FlatField:
    """Return the flat field of the frame that was registered first."""
    named = [frame for frame in figures.frames if frame.record.file == figures.session.registered_file]
    return (named or figures.frames)[0].paper.field


def _primaries_caption(figures: TableFigures) -> str:
    if figures.primaries is None:
        return "No frames of red, green and blue alone show whether these light the print alike."
    return (
        f"Red, green and blue differ by up to {100 * figures.primaries.difference:.1f} % in how they light it; what "
        "that makes of each cell by its colour is divided out too."
    )


def _print_picture(chart: Chart, stains: Stains) -> list[Picture]:
    """Return the picture of the print, or none where nothing is known of it: a clean sheet would be a claim."""
    if not stains.known:
        return []
    caption = (
        "How far cells and their surroundings deviate from their codes' colours elsewhere on the sheet, in the channel "
        "that deviates most. Noise is a fine grain of some tenths of a per cent; stains, folds and shadows have a "
        "shape. Crosses are cells listed for it."
    )
    return [Picture("The print", caption, png_of(draw_print, chart, stains), "radiometry")]
