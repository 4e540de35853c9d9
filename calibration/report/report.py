"""The report of a LUT: `report.html` for people and `report.json` for programs (docs/formats.md).

`report.html` is one file. It starts with the verdict, the remedies and the most important plots. Then all figures
follow in groups; each group has its own plots (`Figure.drawing`).
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
    LabelledPosition,
    cell_noise,
    draw_budget,
    draw_chromaticities,
    draw_errors,
    draw_field,
    draw_frame_values,
    draw_noise,
    draw_positions,
    draw_registration,
    draw_residuals,
    half_size,
    numbered_labels,
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
    position_text,
    positions_text,
    retake_command,
    retake_json,
    retaken_frames,
)
from drivers.raw.rawfile import read_raw
from experiment.session.folder import Session
from foundation.errors import counted, first_few
from foundation.files import write_atomic
from foundation.pages import render
from foundation.plots import PANEL, draw_panels

# Number of points across and down the page in `chart_places`. They describe the pose of the sheet and most of its curl.
GRID_POINTS = (7, 5)

_Array = npt.NDArray[np.float64]


def report_json(result: BuildResult) -> dict[str, Any]:
    """Return the content of `report.json`: verdict, figures and limits."""
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
        "channels": _channels_json(table),
        "chart_places": _grid_json(table),
        "geometry": _geometry_json(table),
        "uncertainty": table.budget.to_json(),
        "superposition": table.sensor.superposition.to_json(),
        "lens": table.lens.to_json() | ({} if table.point_spread is None else table.point_spread.to_json()),
        "off_codes_deg": None if off_codes_deg is None else _rounded_values(off_codes_deg),
        "codes": None if table.lights.codes is None else _codes_json(table.lights.codes),
        "origin": table.origin.model_dump(mode="json"),
        "origins": _foreign_frames(table),
        "primaries_differ": None if primaries is None else float(f"{primaries.difference:.3g}"),
        "figures": {name: _rounded(value) for name, value in judged_values(table).items()},
        "causes": _causes_json(result),
        **retake_json(retaken_frames(verdict, table), table.registered_frame.record.sha256, newest.sha256),
        "limits": [row.figure.limit_json() | {"outcome": row.outcome} for row in verdict.rows],
    }


def _causes_json(result: BuildResult) -> list[dict[str, Any]]:
    return [
        {
            "figure": name,
            "cause": cause.decision.cause.name,
            "follows": cause.decision.follows,
            "why": "" if cause.decision.rule is None else cause.decision.rule.why,
            "remedy": cause.decision.cause.remedy,
            "mends": cause.decision.cause.repeats,
            "command": retake_command(cause.frames) if cause.is_of_frames else "",
            "files": [frame.file for frame in cause.frames],
            "places": [
                {
                    "file": position.file,
                    "x_mm": _rounded(position.x_mm),
                    "y_mm": _rounded(position.y_mm),
                    "size_mm": _rounded(position.size_mm),
                }
                for position in cause.positions
            ],
            "evidence": {key: _rounded(value) for key, value in cause.evidence.measured_values().items()},
        }
        for name, cause in findings(result.verdict, result.figures).items()
    ]


def _grid_json(table: TableMeasurements) -> dict[str, Any]:
    """Return the positions of a grid of points of the page in the registered frame, half-size px."""
    registration = table.registration
    width, height = registration.colours.page_mm
    across, down = GRID_POINTS
    points = [(x, y) for y in np.linspace(0.05, 0.95, down) * height for x in np.linspace(0.05, 0.95, across) * width]
    return {
        "frame": table.session.registered_file,
        "mm": np.round(points, 3).tolist(),
        "px": np.round(registration.to_pixels(points), 3).tolist(),
    }


def _geometry_json(table: TableMeasurements) -> dict[str, Any]:
    registration = table.registration
    inner_px, rim_px = registration.position_uncertainty_px
    lateral = registration.lateral
    return {
        "uncertainty_px": _rounded(inner_px),
        "rim_uncertainty_px": _rounded(rim_px),
        "lateral_corner_px": {channel: _rounded(lateral.corner_px(channel)) for channel in ("R", "B")},
        "lateral_error_px": {channel: _rounded(lateral.corner_error_px(channel)) for channel in ("R", "B")},
    }


def _codes_json(codes: CodeAgreement) -> dict[str, Any]:
    return {
        "angle_deg": _rounded_values(codes.angle_deg),
        "error_deg": _rounded_values(codes.error_deg),
        "brightness": _rounded_values(codes.brightness),
        "off_brightness": _rounded_values(codes.off_brightness),
        "seen_as": {str(light): int(codes.seen_as[light]) for light in np.flatnonzero(codes.seen_as >= 0).tolist()},
        "exchanges": [asdict(pair) for pair in codes.exchanges],
        "held": int(codes.is_verified.sum()),
        "exchange_deg": _rounded(codes.exchange_deg),
        "misfit": _rounded(codes.misfit),
    }


def _foreign_frames(table: TableMeasurements) -> dict[str, Any]:
    return {
        name: [
            {"file": frame.record.file, "found": frame.found, "expected": frame.expected}
            for frame in getattr(table.origins, name)
        ]
        for name in ("other_camera", "other_lens", "other_exposure")
    }


def _rounded_values(values: _Array) -> list[float]:
    return [float(f"{value:.3g}") for value in values.tolist()]


def _channels_json(table: TableMeasurements) -> dict[str, Any]:
    """Return the values of each channel; null if not measured."""
    transfer, dark, lights = table.sensor.transfer, table.dark_frames, table.lights
    linearity, registration = table.sensor.linearity, table.registration
    return {
        "window": table.cells.window,
        "largest_window": largest_window(registration.cell_px, registration.blur_px),
        LINEARITY.name: None if linearity is None else linearity.to_json(),
        "dark_frames": len(dark.files),
        "dark_subtracted": lights.subtracted is not None,
        "dark_counts": _finite_values(dark.light),
        "dark_error": _finite_values(dark.error),
        "dark_noise": _finite_values(dark.noise),
        ADDITIVITY.name: None if lights.additivity is None else _finite_values(lights.additivity.off),
        "stray": None if lights.stray is None else lights.stray.to_json(),
        "gain_e_per_count": _finite_values(transfer.gain_e),
        "read_noise_counts": _finite_values(transfer.read_noise),
        "response_spread": _finite_values(transfer.response),
        "noisy_colours": np.flatnonzero(transfer.noisy).tolist(),
        "grey_tint_deg": dict(zip(table.greys.names, _finite_values(table.greys.tints_deg(lights.white)), strict=True)),
    }


def _finite_values(values: _Array) -> list[float | None]:
    """Return values (N,) with six significant digits; None for NaN and infinity, which JSON cannot contain."""
    return [_rounded(value) if np.isfinite(value) else None for value in values.tolist()]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


MAX_FRAMES = 4  # Largest number of frames drawn with marked positions; each frame must be read from disk again


def write_report(result: BuildResult, session: Session, folder: Path) -> None:
    """Write `report.html` and `report.json` into a LUT's folder."""
    pictures = _pictures(result, session)
    write_atomic(folder / REPORT_PAGE, page(result, pictures, _position_pictures(result, session)))
    write_atomic(folder / REPORT_JSON, json.dumps(report_json(result), indent=2) + "\n")


def _pictures(result: BuildResult, session: Session) -> list[_Picture]:
    """Return all plots: first the main plots, then the plots of the groups."""
    table = result.figures
    chart, registration = session.chart, table.registration
    frame = half_size(read_raw(session.folder / table.session.registered_file))
    primaries = "Flat fields of the primaries were not measured, because frames of red, green or blue are missing."
    if table.primaries is not None:
        primaries = (
            f"The flat fields of red, green and blue light differ by up to {100 * table.primaries.difference:.1f} %; "
            "the correction of each patch depends on its colour."
        )
    return [
        *_main_pictures(result, session, frame),
        _Picture(
            "Residuals of the registration",
            "First: distance of the patches from their positions on a flat sheet, caused by waves of the paper. "
            "Second: residual of each block of patches, magnified. Short arrows in random directions are noise.",
            draw_panels(draw_residuals, chart, registration, inches=[PANEL] * 2),
            "geometry",
            "residuals",
        ),
        _Picture(
            "Light on the print",
            "Flat field of the registered frame, from its white references. Samples and ground truth are divided by "
            f"the flat field. Contour lines are 2 % apart. {primaries}",
            draw_panels(draw_field, chart, table.registered_frame.paper.field, inches=[PANEL] * 3),
            "light",
            "field",
        ),
        _Picture(
            "Values of each frame",
            "Black level, movement and blur of the chart, counts of bare paper under white, deviation of patches from "
            "patches with similar codes, and number of used white references. Circles mark the worst frames. A loss of "
            "focus affects all patches; a hand or a shadow affects a block of patches.",
            draw_panels(draw_frame_values, table, inches=[(3.3, 2.4)] * 6),
            "radiometry",
            "frames",
        ),
        _Picture(
            "Uncertainty of the ground truth",
            f"First: expanded uncertainty (k = {COVERAGE:g}) of each ground truth, the largest first. Each bar is "
            "divided in proportion to the squares of its components. Second: expanded uncertainty of each patch mean "
            "against its level, "
            "without noise. " + "; ".join(f"{item.title}: {item.source}" for item in table.budget.components) + ".",
            draw_panels(draw_budget, table.budget, table.cells.levels, inches=[PANEL] * 2),
            "truth",
            "budget",
        ),
    ]


def _main_pictures(result: BuildResult, session: Session, frame: npt.NDArray[np.float32]) -> list[_Picture]:
    table, chart = result.figures, session.chart
    registration, window = table.registration, table.cells.window
    codes = np.array([light.colour for light in session.illuminations])
    kelvins = np.array([light.cct_k or np.nan for light in session.illuminations], dtype=np.float64)
    expanded = table.budget.expanded_deg
    worst = int(np.argmax(expanded)) if len(expanded) > 1 else None
    ring_text = "" if worst is None else f" A circle marks illuminant {worst}, with the largest uncertainty."
    return [
        _Picture(
            "The registered chart",
            f"{table.session.registered_file} with the detected tags and increased contrast. Below, magnified: "
            f"outlines of patches and windows of their {window**2} samples, in the corners and in the centre.",
            draw_panels(draw_registration, frame, chart, registration, window, inches=[PANEL, *[(1.75, 2.0)] * 5]),
            name="chart",
            is_photograph=True,
        ),
        _Picture(
            "The illuminants",
            f"Chromaticities of the illuminants as projected, and as recorded by the {table.session.camera} on bare "
            f"paper, which are the ground truths. The line joins the black bodies.{ring_text}",
            draw_panels(draw_chromaticities, codes, kelvins, table.lights.white, worst, inches=[(4.4, 4.5)] * 2),
            name="lights",
        ),
        _Picture(
            "Errors of patches",
            "First: deviation of the neighbourhood of each patch from patches with similar codes elsewhere. "
            "Second: uncertainty of the position of each patch. Rings mark the worst patches.",
            draw_panels(draw_errors, table, chart, inches=[PANEL] * 2),
            name="errors",
        ),
        _Picture(
            "Noise",
            "First: variance of one sample against its level, and fitted curve (read noise, photon noise and response "
            "of photosites). Points are medians of patches with similar levels. Second: signal-to-noise ratio.",
            draw_panels(
                draw_noise,
                cell_noise(frame, chart, registration, window),
                table.sensor.transfer,
                window**2,
                inches=[PANEL] * 2,
            ),
            name="noise",
        ),
    ]


def _position_pictures(result: BuildResult, session: Session) -> list[_Picture]:
    by_file: dict[str, list[LabelledPosition]] = {}
    for name, finding in findings(result.verdict, result.figures).items():
        cause = finding.decision.cause.name if finding.is_known else "cause unknown"
        for position in finding.positions:
            by_file.setdefault(position.file, []).append((f"{BY_NAME[name].title}: {cause}", position))
    pictures: list[_Picture] = []
    for file, positions in list(by_file.items())[:MAX_FRAMES]:
        picture = half_size(read_raw(session.folder / file))
        drawings = draw_panels(
            draw_positions, picture, session.chart, result.figures.registration, positions, inches=[PANEL]
        )
        caption = (
            f"{file} with increased contrast. Circles mark deviations beyond their limits, at their positions in the "
            "frame registered first. "
        ) + "; ".join(f"{number}: {label}" for label, number in numbered_labels(positions).items())
        pictures.append(_Picture(f"Position: {Path(file).stem}", caption, drawings, is_photograph=True))
    return pictures


MAX_UNFIT = 200  # Largest number of unfit patches listed on the page; lut.json lists all

# Words for the outcomes on the page, the worst outcome first.
_OUTCOME_WORDS: dict[Outcome, str] = {"refuse": "refuse", "accept with remarks": "remark", "accept": "accept"}

_OUTCOME_ORDER: tuple[Outcome, ...] = tuple(_OUTCOME_WORDS)


@dataclass(frozen=True)
class _Picture:
    """A plot of the report, one SVG for each panel, with heading and caption."""

    heading: str
    caption: str
    drawings: tuple[bytes, ...]
    group: Group | None = None  # Group that contains the plot; None for plots at the top
    name: Drawing | None = None  # As in `Figure.drawing`
    is_photograph: bool = False  # As in `pages.figure`


@dataclass(frozen=True)
class _Row:
    """A judged value. Remedy and position are empty if it is within its limit."""

    judged: JudgedValue
    remedy: str
    position: str


def page(
    result: BuildResult,
    pictures: Sequence[_Picture],
    position_pictures: Sequence[_Picture] = (),
) -> str:
    """Return the text of `report.html`; `position_pictures` are frames with marked deviations."""
    table, verdict = result.figures, result.verdict
    causes, beyond_count = findings(verdict, table), len(verdict.refused) + len(verdict.remarks)
    rows = [
        _Row(
            row,
            _remedy(row, causes.get(row.figure.name), table),
            "" if row.outcome == "accept" else position_text(row.figure, table),
        )
        for row in sorted(verdict.rows, key=lambda row: _OUTCOME_ORDER.index(row.outcome))
    ]
    simulated = ", taken in the simulated laboratory" if table.origin.rig == "simulated" else ""
    return render(
        "calibration.report",
        "report.html",
        title=f"Look-up table (LUT) of {table.session.lights} illuminants, {table.session.camera}",
        taken=f"Session {table.session.folder.name}{simulated}",
        words=_OUTCOME_WORDS,
        outcome=verdict.outcome,
        sentence={
            "accept": "Accepted: every figure is within its limit.",
            "accept with remarks": f"Accepted with remarks on {len(verdict.remarks)} of {len(verdict.rows)} figures.",
            "refuse": f"Refused because of {len(verdict.refused)} of {len(verdict.rows)} figures.",
        }[verdict.outcome],
        usable=not verdict.refused,
        todo=rows[:beyond_count],
        retake=_retake(result),
        causes=[_cause_row(cause) for cause in causes.values()],
        first=[*position_pictures, *(picture for picture in pictures if picture.group is None)],
        drawn={picture.name for picture in pictures if picture.name is not None},
        groups=[_group_content(group, rows, table, pictures) for group in QUESTIONS],
        origin=origin_lines(table.origin),
        unfit=table.cells.unfit,
        most_unfit=MAX_UNFIT,
    ).text


def summary(table: TableMeasurements, group: Group | None = None) -> list[SummaryRow]:
    """Return the summary rows of all figures or of a group; a table of one frame lacks figures of several frames."""
    session = table.session
    figures = [figure for figure in FIGURES if not table.is_of_one_frame or figure.from_one_frame != "no"]
    lines = (line for figure in figures if group in (None, figure.group) for line in figure.lines)
    candidates = (line.row(table) for line in sorted(lines, key=lambda line: line.position))
    rows = [row for row in candidates if row is not None]
    if group not in (None, "geometry"):
        return rows
    return [
        SummaryRow("Illuminants", str(session.lights), "with an accepted frame"),
        SummaryRow("Registered frame", session.registered_file, ""),
        *rows,
    ]


def _group_content(
    group: Group, rows: Sequence[_Row], table: TableMeasurements, pictures: Sequence[_Picture]
) -> dict[str, Any]:
    group_rows = [row for row in rows if row.judged.figure.group == group]
    beyond_count = sum(row.judged.outcome != "accept" for row in group_rows)
    outcome_text = f"{beyond_count} beyond their limits" if beyond_count else "all within their limits"
    return {
        "name": group,
        "question": QUESTIONS[group],
        "beyond": beyond_count,
        "summary": f"{counted(len(group_rows), 'figure')}, {outcome_text}",
        "rows": group_rows,
        "lines": summary(table, group),
        "pictures": [picture for picture in pictures if picture.group == group],
    }


def _retake(result: BuildResult) -> dict[str, Any] | None:
    """Return the frames to take again, and the command; None if there are no such frames."""
    records = retaken_frames(result.verdict, result.figures)
    if not records:
        return None
    return {
        "count": counted(len(records), "frame"),
        "files": first_few([record.file for record in records]),
        "command": COMMAND,
        "is_sufficient": is_mended_by_retaking(result.verdict, result.figures),
    }


def _remedy(row: JudgedValue, cause: ProbableCause | None, table: TableMeasurements) -> str:
    """Return the remedy for a value beyond its limit, or ""."""
    if row.outcome == "accept":
        return ""
    _, remedy = detail_and_remedy(row.figure, table)
    if cause is None or not remedy:
        return remedy
    return cause.decision.cause.remedy if cause.is_known else f"possible remedy: {remedy}"


def _cause_row(cause: ProbableCause) -> dict[str, Any]:
    return {
        "title": BY_NAME[cause.figure].title,
        "cause": cause.decision.cause.name,
        "rule": cause.decision.rule,
        "command": retake_command(cause.frames) if cause.is_of_frames else "",
        "positions": positions_text(cause),
        "evidence": ", ".join(f"{name} {value:.3g}" for name, value in cause.evidence.measured_values().items()),
    }
