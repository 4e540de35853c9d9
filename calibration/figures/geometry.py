"""Figures of the registration, of the position of samples in their patches, and of light spread by the lens."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibration.causes.gathering import chart_evidence
from calibration.figures.figure import (
    JUDGEMENT,
    SIMULATED,
    Explanation,
    Figure,
    Line,
    SummaryRow,
)
from calibration.registration.register import (
    MAX_BLOCK_RESIDUAL_PX,
    MAX_TAG_RESIDUAL_PX,
    MIN_AGREEMENT,
    MIN_GOOD_BLOCKS,
)
from calibration.sampling import SAFE_BLEED, bleed, largest_window
from experiment.framing.finding import MIN_CELL_PX, MIN_TAG_SHARE

if TYPE_CHECKING:
    from calibration.measurements import TableMeasurements

_MIN_CELLS_FOR_GLARE = 8**4  # With fewer patches, veiling glare cannot be distinguished from other light

_HANG_FLATTER = "hang the print flatter"
_REDUCE_GLARE = (
    "take frames of red, green and blue alone with a chart of more colours, use a lens hood, hang black cloth around "
    "the print, and keep lamps and bright walls out of the lens's view"
)


def _tag_fraction(table: TableMeasurements) -> float | None:
    framing = table.registration.framing
    return None if framing.field is not None else len(framing.tags) / max(len(framing.tags) + len(framing.missing), 1)


def _tags_row(table: TableMeasurements) -> SummaryRow:
    framing = table.registration.framing
    detected_count = len(framing.tags)
    count_text = "chart without tags"
    if framing.field is None:
        count_text = f"{detected_count} of {detected_count + len(framing.missing)}"
    return SummaryRow("Detected tags", count_text, "", brief=True)


TAGS_FOUND = Figure(
    "tags_found", "Detected tags", "geometry", "share", "at least", 1.0, MIN_TAG_SHARE,
    why="near a missing tag, registration uses the patches alone", source=JUDGEMENT,
    remedy="bring the whole chart into the frame, and uncover it", measure=_tag_fraction, from_one_frame="yes",
    cause=Explanation("chart", chart_evidence), drawing="chart", lines=(Line(30, _tags_row),),
)  # fmt: skip


def _cell_row(table: TableMeasurements) -> SummaryRow:
    note = f"half-size px; at least {MIN_CELL_PX:g} px so that 25 pixels lie inside the patch"
    return SummaryRow("Shorter side of a patch", f"{table.registration.cell_px:.1f} px", note)


CELL_PX = Figure(
    "cell_px", "Shorter side of a patch", "geometry", "px", "at least", 8.6, MIN_CELL_PX,
    why="the outermost samples contain light from outside their patch",
    source="calculated: with 8.6 px and a blur of σ = 0.7 px, this light is 1.3 % of the worst sample",
    remedy="move the camera closer or use a longer lens",
    measure=lambda table: table.registration.cell_px, from_one_frame="yes",
    drawing="chart", lines=(Line(40, _cell_row),),
)  # fmt: skip


def _worst_sample_bleed(table: TableMeasurements) -> float:
    registration, window = table.registration, table.cells.window
    return bleed(registration.cell_px, registration.blur_px, window) + table.lens.uncorrected_in_worst


def _window_row(table: TableMeasurements) -> SummaryRow:
    registration, window = table.registration, table.cells.window
    largest = largest_window(registration.cell_px, registration.blur_px)
    safe = f"{100 * SAFE_BLEED:g} %"
    note = f"in windows up to {largest}×{largest}, at most {safe} of a sample's light comes from outside its patch"
    if window > largest:
        worst_share = bleed(registration.cell_px, registration.blur_px, window)
        alternative = f"{largest}×{largest} has less than {safe}" if largest else f"no window has less than {safe}"
        note = f"{100 * worst_share:.2g} % of the worst sample's light comes from outside its patch; {alternative}"
    return SummaryRow("Window", f"{window}×{window} samples", note)


BLEED = Figure(
    "bleed", "Light of neighbouring patches in the worst sample", "geometry", "share", "at most", 0.01, 0.03,
    why="the blur of the lens adds light of neighbouring patches to the outermost samples",
    source="calculated: a sharp lens gives 0.2 % in patches of 10 px. A patch mean contains a thirtieth of it",
    remedy="focus on the print, stop down to f/8, move the camera closer, or use a smaller window (build-lut "
    "--window)", measure=_worst_sample_bleed, from_one_frame="yes", drawing="chart",
    lines=(
        Line(50, _window_row),
        Line(60, lambda table: SummaryRow("Blur", f"σ {table.registration.blur_px:.2f} px", "about 0.6 px is sharp")),
    ),
)  # fmt: skip


def _uncorrected_lens_light(table: TableMeasurements) -> float | None:
    # With few patches, light spread by the lens cannot be measured. It is then part of the uncertainty and not judged.
    is_detectable = len(table.registration.mismatched_cells) >= _MIN_CELLS_FOR_GLARE or table.lens.is_uncorrected
    return table.lens.remaining_rms if table.lens.measured and is_detectable else None


def _uncorrected_in_worst_cell(table: TableMeasurements) -> float | None:
    # If there is a remark on all patches, a remark on the worst patch would repeat it.
    residual = _uncorrected_lens_light(table)
    return None if residual is None or residual > CORRECTION_RESIDUAL.accept else table.lens.remaining_worst


def _glare_text(table: TableMeasurements, accepted: float) -> str:
    lens = table.lens
    glare = f"{100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    return (
        f"measured veiling glare: {glare}; up to {100 * lens.veil_at_most:.2g} % is not excluded; the error of "
        f"patches with {100 * lens.worst_level:.2g} % of paper white may reach {100 * lens.remaining_worst:.2g} %"
    )


def _lens_row(table: TableMeasurements) -> SummaryRow:
    name, lens = "Light spread by the lens", table.lens
    if not lens.measured:
        return SummaryRow(name, "not measured", lens.why_not)
    glare = f"veiling glare of {100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    darkest = f"{100 * lens.remaining_worst:.2g} % in patches of {100 * lens.worst_level:.2g} % of paper white"
    residual = f"{100 * lens.remaining_rms:.2g} % RMS, {darkest},"
    if not lens.corrected and not lens.beyond_cell:
        note = f"{lens.why_not}; most likely {glare}; patch means may contain {residual[:-1]}"
        return SummaryRow(name, "none", note)
    treatment = f"subtracted; residual up to {residual[:-1]}" if lens.corrected else f"not subtracted: {lens.why_not}"
    spread_light = f"{100 * lens.rms:.2g} % RMS, {100 * lens.worst:.2g} % at most"
    note = f"of patch means above 300 counts, relative to paper; includes {glare}; {treatment}"
    return SummaryRow(name, spread_light, note)


CORRECTION_RESIDUAL = Figure(
    "correction_residual", "Light spread by the lens that may remain in patch means", "radiometry", "share",
    "at most", 0.01, 0.03,
    why="patch means may contain light that the lens spreads from other parts of the print (veiling glare)",
    source=SIMULATED + ": 0.3 to 0.5 %. In even light or on a chart of 512 colours, veiling glare cannot be measured, "
    "and the value is 1.4 %",
    remedy=_REDUCE_GLARE,
    before_session=False, measure=_uncorrected_lens_light, where=_glare_text, lines=(Line(70, _lens_row),),
)  # fmt: skip

CORRECTION_WORST = Figure(
    "correction_worst", "Light spread by the lens that may remain in the worst patch", "radiometry", "share",
    "at most", 0.03, None,
    why="dark patches get as much veiling glare as bright patches, so that their relative error is larger",
    source=SIMULATED + ": 0.3 to 1.9 %. The noise of 25 samples of 300 counts is 1 %", remedy=_REDUCE_GLARE,
    before_session=False, measure=_uncorrected_in_worst_cell, where=_glare_text,
)  # fmt: skip


def _marks_text(table: TableMeasurements) -> str:
    return "corners of the tags" if table.registration.framing.field is None else "outline of the patch area"


def _final_residual_row(table: TableMeasurements) -> SummaryRow:
    has_no_tags = table.registration.framing.field is not None
    name = "Residual of the outline" if has_no_tags else "Residual of tags"
    detector_note = "" if has_no_tags else "; the error of the tag detector is 0.09 px"
    value = f"{table.registration.marks_rms_px:.3f} px RMS"
    return SummaryRow(name, value, f"{_marks_text(table)} relative to the final registration{detector_note}")


def _plane_residual_row(table: TableMeasurements) -> SummaryRow:
    note = f"{_marks_text(table)} relative to a plane sheet; it shows waves of the print"
    return SummaryRow("Residual of plane and lens", f"{table.registration.lens_residual_px:.2f} px RMS", note)


TAG_RESIDUAL_PX = Figure(
    "tag_residual_px", "Distance of tags from a plane sheet", "geometry", "px RMS", "at most", 2.5, MAX_TAG_RESIDUAL_PX,
    why="the sheet is so wavy that only the patches show its shape",
    source=SIMULATED + ": waves of 6 mm with a curl of 10 mm give 2.3 px", remedy=_HANG_FLATTER,
    measure=lambda table: table.registration.lens_residual_px, from_one_frame="yes", drawing="residuals",
    lines=(Line(90, _plane_residual_row),),
)  # fmt: skip

TAG_FINAL_PX = Figure(
    "tag_final_px", "Distance of tags from the final registration, scaled to patches of 10 px", "geometry",
    "px RMS", "at most", 0.4, 2.0,
    why="patches and tags give different positions of the print",
    source=SIMULATED + ": 0.05 to 0.2 px. The error of the tag detector is 0.09 px",
    remedy="check that chart.json belongs to this print, and that the print is one flat sheet",
    measure=lambda table: table.registration.marks_rms_px / table.registration.clearance, from_one_frame="yes",
    drawing="residuals", lines=(Line(80, _final_residual_row),),
)  # fmt: skip


def _blocks_row(table: TableMeasurements) -> SummaryRow:
    value, note = f"{table.registration.block_rms_px:.3f} px RMS", "distance of blocks from the final registration"
    return SummaryRow("Residual of patch blocks", value, note, brief=True)


BLOCK_RESIDUAL_PX = Figure(
    "block_residual_px", "Residual of patch blocks, scaled to patches of 10 px", "geometry", "px RMS", "at most", 0.1,
    MAX_BLOCK_RESIDUAL_PX, why="patches are not sampled at their centres",
    source=SIMULATED + ": 0.01 to 0.06 px", remedy=_HANG_FLATTER,
    measure=lambda table: table.registration.block_rms_px / table.registration.clearance, from_one_frame="yes",
    drawing="residuals", lines=(Line(100, _blocks_row),),
)  # fmt: skip

BLOCKS_GOOD = Figure(
    "blocks_good", "Patch blocks that match the chart", "geometry", "share", "at least", 0.98, MIN_GOOD_BLOCKS,
    why="part of the print is covered, damaged, or from another print", source=JUDGEMENT,
    remedy="uncover the print, or print it again",
    measure=lambda table: float(table.registration.blocks.good.mean()), from_one_frame="yes",
    cause=Explanation("chart", chart_evidence), drawing="residuals",
)  # fmt: skip


def _agreement_row(table: TableMeasurements) -> SummaryRow:
    note = "correlation of the colours of patches and chart; another chart has about 0"
    return SummaryRow("Correlation with the chart", f"{table.registration.agreement:.4f}", note, brief=True)


AGREEMENT = Figure(
    "agreement", "Correlation of patches and chart", "geometry", "", "at least", 0.97, MIN_AGREEMENT,
    why="the colours of the patches differ from the chart",
    source=SIMULATED + ": at least 0.99. A chart with another order of patches has about 0",
    remedy="use the chart.json of this print, and print without colour management",
    measure=lambda table: table.registration.agreement, from_one_frame="yes",
    cause=Explanation("chart", chart_evidence), drawing="chart", lines=(Line(110, _agreement_row),),
)  # fmt: skip
