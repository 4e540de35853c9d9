"""The table's report: one page that shows by eye what the figures claim, and the same figures for programs.

`report.json`, whose form is stated in docs/formats.md, holds figures, limits and verdict; `report.html`, one file to be
mailed, opens with the verdict, what to do, and the pictures that are looked at first. All figures follow in groups,
each with its pictures, by the names that figures give of them (`Figure.drawing`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.budget import COVERAGE
from calibration.checks.light_codes import CodeAgreement
from calibration.citation import origin_lines
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import QUESTIONS, Drawing, Group, Outcome, SummaryRow
from calibration.figures.light import ADDITIVITY, LINEARITY
from calibration.measurements import TableMeasurements
from calibration.report.plots import (
    LabelledPlace,
    cell_noise,
    draw_budget,
    draw_chromaticities,
    draw_course,
    draw_errors,
    draw_field,
    draw_noise,
    draw_places,
    draw_registration,
    draw_residuals,
    half_size,
)
from calibration.sampling import largest_window
from calibration.table.lut import REPORT_FORMAT, REPORT_JSON, REPORT_PAGE, REPORT_VERSION
from calibration.verdict import (
    COMMAND,
    BuildResult,
    JudgedValue,
    ProbableCause,
    detail_and_remedy,
    findings,
    is_mended_by_retaking,
    judged_values,
    place_of,
    places_text,
    retake_command,
    retake_json,
    retaken_frames,
)
from drivers.raw.rawfile import read_raw
from experiment.session.folder import Session
from foundation.errors import counted, first_of
from foundation.files import write_whole
from foundation.pages import render
from foundation.plots import png_of

# Points across and down the page whose places are told: enough to see how it hung, and how it bent, roughly.
PLACES = (7, 5)

_Array = npt.NDArray[np.float64]


def report_json(result: BuildResult) -> dict[str, Any]:
    """Return the content of `report.json`: verdict, figures, and every limit with its reason."""
    table, verdict = result.figures, result.verdict
    off_codes_deg, primaries = table.lights.off_codes_deg, table.primaries
    newest = max((frame.record for frame in table.frames), key=lambda record: record.attempt)
    return {
        "format": REPORT_FORMAT,
        "version": REPORT_VERSION,
        "verdict": verdict.outcome,
        "session": table.session.folder.name,
        "camera": table.session.camera,
        "lights": table.session.lights,
        "channels": _channels(table),
        "chart_places": _chart_places(table),
        "geometry": _geometry(table),
        "uncertainty": table.budget.to_json(),
        "superposition": table.sensor.superposition.to_json(),
        "lens": table.lens.to_json() | ({} if table.point_spread is None else table.point_spread.to_json()),
        "off_codes_deg": None if off_codes_deg is None else _short(off_codes_deg),
        "codes": None if table.lights.codes is None else _codes(table.lights.codes),
        "origin": table.origin.model_dump(mode="json"),
        "origins": _origins(table),
        "primaries_differ": None if primaries is None else float(f"{primaries.difference:.3g}"),
        "figures": {name: _rounded(value) for name, value in judged_values(table).items()},
        "causes": _causes(result),
        **retake_json(retaken_frames(verdict, table), table.registered_frame.record.sha256, newest.sha256),
        "limits": [row.figure.limit_json() | {"outcome": row.outcome} for row in verdict.rows],
    }


def _causes(result: BuildResult) -> list[dict[str, Any]]:
    return [
        {
            "figure": name,
            "cause": found.decision.cause.name,
            "follows": found.decision.follows,
            "why": "" if found.decision.rule is None else found.decision.rule.why,
            "remedy": found.decision.cause.remedy,
            "mends": found.decision.cause.mends,
            "command": retake_command(found.frames) if found.is_of_frames else "",
            "files": [frame.file for frame in found.frames],
            "places": [
                {
                    "file": place.file,
                    "x_mm": _rounded(place.x_mm),
                    "y_mm": _rounded(place.y_mm),
                    "size_mm": _rounded(place.size_mm),
                }
                for place in found.places
            ],
            "evidence": {known: _rounded(value) for known, value in found.evidence.known().items()},
        }
        for name, found in findings(result.verdict, result.figures).items()
    ]


def _chart_places(table: TableMeasurements) -> dict[str, Any]:
    """Return where points of the page lie in the frame that was registered first, half-size px.

    Of two tables of one chart these tell how it hung elsewhere.
    """
    registration = table.registration
    width, height = registration.colours.page_mm
    across, down = PLACES
    points = [(x, y) for y in np.linspace(0.05, 0.95, down) * height for x in np.linspace(0.05, 0.95, across) * width]
    return {
        "frame": table.session.registered_file,
        "mm": np.round(points, 3).tolist(),
        "px": np.round(registration.to_pixels(points), 3).tolist(),
    }


def _geometry(table: TableMeasurements) -> dict[str, Any]:
    registration = table.registration
    inner, outer = registration.position_uncertainty_px
    lateral = registration.lateral
    return {
        "uncertainty_px": _rounded(inner),
        "rim_uncertainty_px": _rounded(outer),
        "lateral_corner_px": {channel: _rounded(lateral.corner_px(channel)) for channel in ("R", "B")},
        "lateral_error_px": {channel: _rounded(lateral.corner_error_px(channel)) for channel in ("R", "B")},
    }


def _codes(codes: CodeAgreement) -> dict[str, Any]:
    return {
        "angle_deg": _short(codes.angle_deg),
        "error_deg": _short(codes.error_deg),
        "brightness": _short(codes.brightness),
        "off_brightness": _short(codes.off_brightness),
        "seen_as": {str(light): int(codes.seen_as[light]) for light in np.flatnonzero(codes.seen_as >= 0).tolist()},
        "exchanges": [asdict(pair) for pair in codes.exchanges],
        "held": int(codes.held.sum()),
        "exchange_deg": _rounded(codes.exchange_deg),
        "misfit": _rounded(codes.misfit),
    }


def _origins(table: TableMeasurements) -> dict[str, Any]:
    return {
        name: [
            {"file": frame.record.file, "found": frame.found, "expected": frame.expected}
            for frame in getattr(table.origins, name)
        ]
        for name in ("other_camera", "other_lens", "other_exposure")
    }


def _short(values: _Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values.tolist()]


def _channels(table: TableMeasurements) -> dict[str, Any]:
    """Return what is known for each channel; what could not be measured is null."""
    transfer, dark, lights = table.sensor.transfer, table.dark_frames, table.lights
    linearity, registration = table.sensor.linearity, table.registration
    return {
        "window": table.cells.window,
        "largest_window": largest_window(registration.cell_px, registration.blur_px),
        LINEARITY.name: None if linearity is None else linearity.to_json(),
        "dark_frames": len(dark.files),
        "dark_subtracted": lights.subtracted is not None,
        "dark_counts": _numbers(dark.light),
        "dark_error": _numbers(dark.error),
        "dark_noise": _numbers(dark.noise),
        ADDITIVITY.name: None if lights.additivity is None else _numbers(lights.additivity.off),
        "stray": None if lights.stray is None else lights.stray.to_json(),
        "gain_e_per_count": _numbers(transfer.gain_e),
        "read_noise_counts": _numbers(transfer.read_noise),
        "response_spread": _numbers(transfer.response),
        "noisy_colours": np.flatnonzero(transfer.noisy).tolist(),
        "grey_tint_deg": dict(zip(table.greys.names, _numbers(table.greys.tints_deg(lights.white)), strict=True)),
    }


def _numbers(values: _Array) -> list[float | None]:
    """Return values (N,) with six significant digits; None for what is not finite, which JSON cannot hold."""
    return [_rounded(value) if np.isfinite(value) else None for value in values.tolist()]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


MOST_FRAMES = 4  # Frames that are drawn with their places: each is read again, and more are looked at by nobody


def write_report(result: BuildResult, session: Session, folder: Path) -> None:
    """Write `report.html` and `report.json` into a table's folder; costs some seconds."""
    pictures = _pictures(result, session)
    write_whole(folder / REPORT_PAGE, page(result, pictures, _place_pictures(result, session)))
    write_whole(folder / REPORT_JSON, json.dumps(report_json(result), indent=2) + "\n")


def _pictures(result: BuildResult, session: Session) -> list[_Picture]:
    """Return the pictures: first chart, lights, errors and noise, then those of the groups."""
    table = result.figures
    chart, registration = session.chart, table.registration
    frame = half_size(read_raw(session.folder / table.session.registered_file))
    primaries = "No frames of red, green and blue alone show whether these light the print alike."
    if table.primaries is not None:
        primaries = (
            f"Red, green and blue differ by up to {100 * table.primaries.difference:.1f} % in how they light it; what "
            "that makes of each cell by its colour is divided out too."
        )
    return [
        *_first_pictures(result, session, frame),
        _Picture(
            "Residuals of the registration",
            "Left: how far the cells moved the map from what the tags and the lens alone give, which is the paper's "
            "waviness. Right: the residual of each block of cells, magnified; short arrows without order are noise.",
            png_of(draw_residuals, chart, registration),
            "geometry",
            "residuals",
        ),
        _Picture(
            "The light on the print",
            "Shape of the light under the frame that was registered, from its white references; it is divided out of "
            f"samples and ground truth. Contours are 2 % apart. {primaries}",
            png_of(draw_field, chart, table.registered_frame.paper.field),
            "light",
            "field",
        ),
        _Picture(
            "The course of the session",
            "Black level, movement and blur of the chart, bare paper under white, how far cells are off their codes' "
            "colours, and the white references used, frame by frame; the worst frame of each is ringed. All cells are "
            "off where the focus is lost, a block of them where a hand or a shadow lies on the print.",
            png_of(draw_course, table),
            "radiometry",
            "course",
        ),
        _Picture(
            "What the ground truth may be off by",
            f"Left: the expanded uncertainty (k = {COVERAGE:g}) of each light's direction, shared out among its causes "
            "by their squares; lights in the order of it, the worst first. Right: that of each cell's mean by its "
            "level, noise apart. " + "; ".join(f"{one.title}: {one.source}" for one in table.budget.components) + ".",
            png_of(draw_budget, table.budget, table.cells.levels),
            "truth",
            "budget",
        ),
    ]


def _first_pictures(result: BuildResult, session: Session, frame: npt.NDArray[np.float32]) -> list[_Picture]:
    """Return what a scientist looks at first: chart, lights, errors, noise."""
    table, chart = result.figures, session.chart
    registration, window = table.registration, table.cells.window
    codes = np.array([light.colour for light in session.illuminations])
    black_body = np.array([light.kind == "blackbody" for light in session.illuminations], dtype=np.bool_)
    seen = f"seen by the {table.session.camera}"
    expanded = table.budget.expanded_deg
    truth = int(np.argmax(expanded)) if len(expanded) > 1 else None
    ringed = "" if truth is None else f" Ringed is light {truth}, whose ground truth is known worst."
    return [
        _Picture(
            "The chart as registered",
            f"{table.session.registered_file}, contrast stretched, with the tags as found; below, magnified: the "
            f"outline of every cell and the pixels of its {window**2} samples, in the corners and in the middle.",
            png_of(draw_registration, frame, chart, registration, window),
            name="chart",
        ),
        _Picture(
            "The lights",
            "rb-chromaticities of the lights as projected, as the camera sees them on bare paper (the ground truth), "
            f"and the latter in their colours. Rings are black bodies.{ringed}",
            png_of(draw_chromaticities, codes, black_body, table.lights.white, seen, truth),
            name="lights",
        ),
        _Picture(
            "Where cells err",
            "Left: how far cells and their neighbours are off their codes' colours elsewhere on the sheet. Right: how "
            "well the place of each cell is known. The worst cell of each is ringed.",
            png_of(draw_errors, table, chart),
            name="errors",
        ),
        _Picture(
            "The noise",
            "Left: variance of one sample over its level, medians of cells of like levels and the fitted curve (read "
            "noise, photons, unequal photosites). Right: what that makes of signal over noise.",
            png_of(draw_noise, cell_noise(frame, chart, registration, window), table.sensor.transfer, window**2),
            name="noise",
        ),
    ]


def _place_pictures(result: BuildResult, session: Session) -> list[_Picture]:
    by_file: dict[str, list[LabelledPlace]] = {}
    for name, found in findings(result.verdict, result.figures).items():
        cause = found.decision.cause.name if found.is_known else "cause not known"
        for place in found.places:
            by_file.setdefault(place.file, []).append((f"{BY_NAME[name].title}: {cause}", place))
    pictures: list[_Picture] = []
    for file, places in list(by_file.items())[:MOST_FRAMES]:
        picture = half_size(read_raw(session.folder / file))
        drawn = png_of(draw_places, picture, session.chart, result.figures.registration, places)
        caption = (
            f"{file}, contrast stretched, with what is beyond its limits circled; places lie as in the frame that was "
            "registered first."
        )
        pictures.append(_Picture(f"Where it is: {Path(file).stem}", caption, drawn))
    return pictures


MOST_UNFIT = 200  # Unfit cells that are listed; all of them are in lut.json, and a page of thousands is read by nobody

# Outcomes, the worst first, as the page says them.
_WORDS: dict[Outcome, str] = {"refuse": "refuse", "accept with remarks": "remark", "accept": "accept"}

_ORDER: tuple[Outcome, ...] = tuple(_WORDS)


@dataclass(frozen=True)
class _Picture:
    """A picture of the report, PNG, with its heading and what it shows.

    `group` is the one it is folded with; None for those that stand open on top. `name` is what figures say of it.
    """

    heading: str
    caption: str
    png: bytes
    group: Group | None = None
    name: Drawing | None = None


@dataclass(frozen=True)
class _Row:
    """A judged value; beyond its limit with what helps, and where it is."""

    judged: JudgedValue
    remedy: str
    place: str


def page(
    result: BuildResult,
    pictures: Sequence[_Picture],
    places: Sequence[_Picture] = (),
) -> str:
    """Return the text of `report.html`: verdict, what to do, what to look at first, then all figures in groups.

    `places` are pictures of what is beyond a limit.
    """
    table, verdict = result.figures, result.verdict
    found, beyond = findings(verdict, table), len(verdict.refused) + len(verdict.remarks)
    rows = [
        _Row(
            row,
            _remedy(row, found.get(row.figure.name), table),
            "" if row.outcome == "accept" else place_of(row.figure, table),
        )
        for row in sorted(verdict.rows, key=lambda row: _ORDER.index(row.outcome))
    ]
    simulated = ", taken in the simulated laboratory" if table.origin.rig == "simulated" else ""
    return render(
        "calibration.report",
        "report.html",
        title=f"Table of {table.session.lights} lights, {table.session.camera}",
        taken=f"Session {table.session.folder.name}{simulated}",
        words=_WORDS,
        outcome=verdict.outcome,
        sentence={
            "accept": "Accepted: every figure is within its limit.",
            "accept with remarks": f"Accepted with remarks on {len(verdict.remarks)} of {len(verdict.rows)} figures.",
            "refuse": f"Refused: {len(verdict.refused)} of {len(verdict.rows)} figures are beyond what can be used.",
        }[verdict.outcome],
        usable=not verdict.refused,
        todo=rows[:beyond],
        again=_again(result),
        causes=[_cause(each) for each in found.values()],
        first=[*places, *(picture for picture in pictures if picture.group is None)],
        drawn={picture.name for picture in pictures if picture.name is not None},
        groups=[_group(group, rows, table, pictures) for group in QUESTIONS],
        origin=origin_lines(table.origin),
        unfit=table.cells.unfit,
        most_unfit=MOST_UNFIT,
    ).text


def summary(table: TableMeasurements, group: Group | None = None) -> list[SummaryRow]:
    """Return the lines that say how good a table is, in their order: of all figures, or of a group's.

    Of one frame, those of figures that it tells.
    """
    session = table.session
    told = [one for one in FIGURES if not table.is_of_one_frame or one.of_one_frame != "unknown"]
    lines = (line for one in told if group in (None, one.group) for line in one.lines)
    found = (line.row(table) for line in sorted(lines, key=lambda line: line.place))
    rows = [row for row in found if row is not None]
    if group not in (None, "geometry"):
        return rows
    return [
        SummaryRow("Lights", str(session.lights), "with an accepted frame"),
        SummaryRow("Frame registered", session.registered_file, ""),
        *rows,
    ]


def _group(
    group: Group, rows: Sequence[_Row], table: TableMeasurements, pictures: Sequence[_Picture]
) -> dict[str, Any]:
    own = [row for row in rows if row.judged.figure.group == group]
    beyond = sum(row.judged.outcome != "accept" for row in own)
    within = f"{beyond} beyond their limits" if beyond else "all within their limits"
    return {
        "name": group,
        "question": QUESTIONS[group],
        "beyond": beyond,
        "summary": f"{counted(len(own), 'figure')}, {within}",
        "rows": own,
        "lines": summary(table, group),
        "pictures": [picture for picture in pictures if picture.group == group],
    }


def _again(result: BuildResult) -> dict[str, Any] | None:
    """Return which frames are to be taken again and how; None where taking frames again does not help."""
    records = retaken_frames(result.verdict, result.figures)
    if not records:
        return None
    return {
        "count": counted(len(records), "frame"),
        "files": first_of([record.file for record in records]),
        "command": COMMAND,
        "mends": is_mended_by_retaking(result.verdict, result.figures),
    }


def _remedy(row: JudgedValue, found: ProbableCause | None, table: TableMeasurements) -> str:
    """Return what helps against what is beyond a limit; "" where nothing is."""
    if row.outcome == "accept":
        return ""
    _, remedy = detail_and_remedy(row.figure, table)
    if found is None or not remedy:
        return remedy
    return found.decision.cause.remedy if found.is_known else f"it may help to {remedy}"


def _cause(found: ProbableCause) -> dict[str, Any]:
    return {
        "title": BY_NAME[found.figure].title,
        "cause": found.decision.cause.name,
        "rule": found.decision.rule,
        "command": retake_command(found.frames) if found.is_of_frames else "",
        "places": places_text(found),
        "evidence": ", ".join(f"{name} {value:.3g}" for name, value in found.evidence.known().items()),
    }
