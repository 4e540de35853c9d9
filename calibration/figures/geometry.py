"""Figures of where the chart was found, whether each sample lies in its cell, and what the lens brings into cells."""

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

_LEAST_CELLS = 8**4  # Cells from which on a veil is told from other smooth light

_FLATTEN = "hang the print flatter"
_LESS_VEIL = (
    "take frames of red, green and blue alone and a chart of more colours, use the lens's hood, hang black cloth "
    "around the print, and keep lights and bright walls out of its view"
)


def _tags_found(table: TableMeasurements) -> float | None:
    framing = table.registration.framing
    return None if framing.field is not None else len(framing.tags) / max(len(framing.tags) + len(framing.missing), 1)


def _tags_row(table: TableMeasurements) -> SummaryRow:
    framing = table.registration.framing
    count = len(framing.tags)
    described = f"{count} of {count + len(framing.missing)}" if framing.field is None else "the chart has none"
    return SummaryRow("Tags found", described, "", brief=True)


TAGS_FOUND = Figure(
    "tags_found", "Tags found", "geometry", "share", "at least", 1.0, MIN_TAG_SHARE,
    why="where a tag is missing, the place of the cells around it rests on the cells alone", source=JUDGEMENT,
    remedy="bring all of the chart into the picture, and uncover it",
    measure=_tags_found, of_one_frame="known",
    cause=Explanation("chart", chart_evidence), drawing="chart", lines=(Line(30, _tags_row),),
)  # fmt: skip


def _cell_row(table: TableMeasurements) -> SummaryRow:
    note = f"of the half-size frame; {MIN_CELL_PX:g} or more for 25 pixels inside it"
    return SummaryRow("Shorter side of a cell", f"{table.registration.cell_px:.1f} px", note)


CELL_PX = Figure(
    "cell_px", "Shorter side of a cell", "geometry", "px", "at least", 8.6, MIN_CELL_PX,
    why="25 pixels reach 3.25 px from a cell's centre, rounding and registration included",
    source="geometry: half of 5 px, 0.5 px rounding, 0.25 px registration; 8.6 px bleeds 1.3 % at a blur of 0.7 px",
    remedy="bring the camera nearer or take a longer lens",
    measure=lambda table: table.registration.cell_px, of_one_frame="known",
    drawing="chart", lines=(Line(40, _cell_row),),
)  # fmt: skip


def _bleed(table: TableMeasurements) -> float:
    registration, window = table.registration, table.cells.window
    return bleed(registration.cell_px, registration.blur_px, window) + table.lens.uncorrected_in_worst


def _window_row(table: TableMeasurements) -> SummaryRow:
    registration, window = table.registration, table.cells.window
    largest = largest_window(registration.cell_px, registration.blur_px)
    safe = f"{100 * SAFE_BLEED:g} %"
    note = f"up to {largest}×{largest}, at most {safe} of a sample's light is from beyond its cell"
    if window > largest:
        share = bleed(registration.cell_px, registration.blur_px, window)
        allowed = f"{largest}×{largest} has less than {safe}" if largest else f"no window has less than {safe}"
        note = f"too large: {100 * share:.2g} % of the worst sample's light is from beyond its cell; {allowed}"
    return SummaryRow("Window", f"{window}×{window} samples", note)


BLEED = Figure(
    "bleed", "Light of neighbouring cells in the worst sample", "geometry", "share", "at most", 0.01, 0.03,
    why="the lens's blur mixes neighbouring cells into the outermost of the window's pixels",
    source="normal integral beyond the cell's edge at 0.75 px misplacement: of a sharp lens 0.2 % at 10 px a cell, "
    "0.6 % at 8.6 px; of a cell's mean a thirtieth as much, which is in its uncertainty",
    remedy="focus on the print, stop down to f/8, bring the camera nearer, or take a smaller window "
    "(build-lut --window)",
    measure=_bleed, of_one_frame="known", drawing="chart",
    lines=(
        Line(50, _window_row),
        Line(60, lambda table: SummaryRow("Blur", f"σ {table.registration.blur_px:.2f} px", "about 0.6 is sharp")),
    ),
)  # fmt: skip


def _left_by_lens(table: TableMeasurements) -> float | None:
    # What few cells cannot show of a lens is in the uncertainty of each light and cell; nothing can be done about it.
    shown = len(table.registration.mismatched_cells) >= _LEAST_CELLS or table.lens.is_left_in
    return table.lens.left if table.lens.measured and shown else None


def _left_in_worst_cell(table: TableMeasurements) -> float | None:
    """Return the same of the worst cells, which the remark on all cells speaks of, too, where there is one."""
    left = _left_by_lens(table)
    return None if left is None or left > CORRECTION_RESIDUAL.accept else table.lens.left_worst


def _veil(table: TableMeasurements, accepted: float) -> str:
    """Return how large a veil may be, and which cells are furthest off by what the lens may have left."""
    lens = table.lens
    found = f"{100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    return (
        f"a veil of {found} was found, so that up to {100 * lens.veil_at_most:.2g} % is not excluded; cells of "
        f"{100 * lens.worst_level:.2g} % of paper may be off by {100 * lens.left_worst:.2g} %"
    )


def _lens_row(table: TableMeasurements) -> SummaryRow:
    """Return what the lens spreads beside its sharp core, and what is done about it."""
    name, lens = "Spread of the lens", table.lens
    if not lens.measured:
        return SummaryRow(name, "not measured", lens.why_not)
    veil = f"a veil of {100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    dark = f"{100 * lens.left_worst:.2g} % in cells of {100 * lens.worst_level:.2g} % of paper"
    left = f"{100 * lens.left:.2g} % RMS, {dark},"
    if not lens.corrected and not lens.beyond_cell:
        note = f"{lens.why_not}; {veil} is likeliest, and {left} is what may be in cells' means"
        return SummaryRow(name, "none", note)
    done = f"subtracted, {left} may be left" if lens.corrected else f"not subtracted: {lens.why_not}"
    size = f"{100 * lens.rms:.2g} % RMS, {100 * lens.worst:.2g} % at most"
    note = f"of cells' means above 300 counts, relative to paper, {veil} in it; {done}"
    return SummaryRow(name, size, note)


CORRECTION_RESIDUAL = Figure(
    "correction_residual", "Light of surroundings that may be left in cells' means", "radiometry", "share", "at most",
    0.01, 0.03,
    why="what the lens spreads, or may spread as a veil that an evenly lit print cannot show, is in the samples",
    source=SIMULATED + ": 0.3 to 0.5 % where light falls off towards the corners, and the means twice as good; 1.4 % "
    "in even light or on a chart of 512 colours, which do not show a veil of the usual 1 %",
    remedy=_LESS_VEIL,
    before_session=False, measure=_left_by_lens, where=_veil, lines=(Line(70, _lens_row),),
)  # fmt: skip

CORRECTION_WORST = Figure(
    "correction_worst", "The same in the cell that it is largest of", "radiometry", "share", "at most", 0.03, None,
    why="a veil adds as much to dark cells as to bright ones, so that dark ones are off by several times the mean",
    source="geometry: by a cell of a twentieth of paper six times the veil's error; 3 % is three standard deviations "
    "of a mean of 300 counts; " + SIMULATED + ": 0.3 to 1.9 % where the mean is accepted",
    remedy=_LESS_VEIL,
    before_session=False, measure=_left_in_worst_cell, where=_veil,
)  # fmt: skip


def _marks(table: TableMeasurements) -> str:
    return "corners of the tags" if table.registration.framing.field is None else "outline of the field, across"


def _final_row(table: TableMeasurements) -> SummaryRow:
    plain = table.registration.framing.field is not None
    name = "Residual of the outline" if plain else "Residual of tags"
    usual = "" if plain else "; the detector's own error is 0.09"
    value = f"{table.registration.marks_rms_px:.3f} px RMS"
    return SummaryRow(name, value, f"{_marks(table)} against the final map{usual}")


def _plane_row(table: TableMeasurements) -> SummaryRow:
    note = f"{_marks(table)} against a plane seen through a lens: the waviness of the sheet"
    return SummaryRow("Residual of plane and lens", f"{table.registration.lens_residual_px:.2f} px RMS", note)


TAG_RESIDUAL_PX = Figure(
    "tag_residual_px", "Residual of tags, plane and lens", "geometry", "px RMS", "at most", 2.5, MAX_TAG_RESIDUAL_PX,
    why="the place of a sheet that waves more rests on its cells alone",
    source=SIMULATED + ": 6 mm of waves and 10 mm of curl give 2.3", remedy=_FLATTEN,
    measure=lambda table: table.registration.lens_residual_px, of_one_frame="known", drawing="residuals",
    lines=(Line(90, _plane_row),),
)  # fmt: skip

TAG_FINAL_PX = Figure(
    "tag_final_px", "Residual of tags, final map", "geometry", "px RMS", "at most", 0.4, 2.0,
    why="cells and tags disagree about where the print is; the limits are for cells of 10 px and rise with their size",
    source=SIMULATED + ": 0.05 to 0.2, the detector's own error 0.09",
    remedy="check that chart.json is that of the print, and that the print is one flat sheet",
    measure=lambda table: table.registration.marks_rms_px / table.registration.clearance, of_one_frame="known",
    drawing="residuals", lines=(Line(80, _final_row),),
)  # fmt: skip


def _blocks_row(table: TableMeasurements) -> SummaryRow:
    value, note = f"{table.registration.block_rms_px:.3f} px RMS", "displacement of blocks of cells that the final map"
    return SummaryRow("Residual of cell blocks", value, f"{note} leaves", brief=True)


BLOCK_RESIDUAL_PX = Figure(
    "block_residual_px", "Residual of cell blocks", "geometry", "px RMS", "at most", 0.1, MAX_BLOCK_RESIDUAL_PX,
    why="cells are sampled beside their centres; the limits are for cells of 10 px and rise with their size",
    source=SIMULATED + ": 0.01 to 0.06", remedy=_FLATTEN,
    measure=lambda table: table.registration.block_rms_px / table.registration.clearance, of_one_frame="known",
    drawing="residuals", lines=(Line(100, _blocks_row),),
)  # fmt: skip

BLOCKS_GOOD = Figure(
    "blocks_good", "Cell blocks that match the chart", "geometry", "share", "at least", 0.98, MIN_GOOD_BLOCKS,
    why="part of the print is covered, damaged, or another print", source=JUDGEMENT,
    remedy="uncover the print, or print it anew",
    measure=lambda table: float(table.registration.blocks.good.mean()), of_one_frame="known",
    cause=Explanation("chart", chart_evidence), drawing="residuals",
)  # fmt: skip


def _agreement_row(table: TableMeasurements) -> SummaryRow:
    note = "of the cells' colours with the chart's; with another chart's about 0"
    return SummaryRow("Correlation with the chart", f"{table.registration.agreement:.4f}", note, brief=True)


AGREEMENT = Figure(
    "agreement", "Correlation of cells and chart", "geometry", "", "at least", 0.97, MIN_AGREEMENT,
    why="the colours are not those of the chart",
    source=SIMULATED + ": 0.99 and more; another order of the cells has about 0",
    remedy="name the chart.json of this print, and print without colour management",
    measure=lambda table: table.registration.agreement, of_one_frame="known",
    cause=Explanation("chart", chart_evidence), drawing="chart", lines=(Line(110, _agreement_row),),
)  # fmt: skip
