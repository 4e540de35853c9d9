"""Figures of noise, white references, uncertainty of the ground truth, and brightness of illuminants."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.budget import COVERAGE
from calibration.causes.gathering import noisy_evidence, reference_evidence
from calibration.figures.figure import (
    JUDGEMENT,
    SIMULATED,
    Explanation,
    Figure,
    Line,
    SummaryRow,
)
from calibration.figures.light import percent, percents
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.framing.field import MIN_SIGNAL

if TYPE_CHECKING:
    from calibration.measurements import FrameMeasurements, TableMeasurements
    from experiment.measures.paper import Paper


def _noise_row(table: TableMeasurements) -> SummaryRow:
    return SummaryRow("Noise of a sample", percents(table.sensor.noise), "R, G, B, relative to paper under white")


def _at_zero_row(table: TableMeasurements) -> SummaryRow | None:
    share = table.lights.share_at_zero
    if not len(share):
        return None
    worst = int(np.argmax(share))
    value = f"{100 * share.mean():.3f} %, {percent(share[worst])} under illuminant {worst}"
    note = "negative values are stored as 0, which raises the means of patches without light slightly"
    return SummaryRow("Samples at 0", value, note)


NOISE_MISFIT = Figure(
    "noise_misfit", "Deviation of patch noise from the photon-transfer curve", "noise", "share", "at most", 0.3, None,
    why="photons and sensor do not explain the scatter: the camera smooths its raw files, or the lamp flickers",
    source=SIMULATED + ": 5 to 15 %. The curve is the model of EMVA 1288",
    remedy="switch the camera's noise reduction off",
    measure=lambda table: float(table.sensor.transfer.misfit.max()), from_one_frame="yes", drawing="noise",
    lines=(Line(170, _noise_row), Line(200, _at_zero_row)),
)  # fmt: skip


def _transfer_row(table: TableMeasurements) -> SummaryRow:
    transfer = table.sensor.transfer
    gain = " / ".join(f"{value:.2f}" for value in transfer.gain_e.tolist())
    read_noise = " / ".join(f"{value:.1f}" for value in transfer.read_noise.tolist())
    note = f"R, G, B of half-size pixels; patches noisier than the curve: {int(transfer.noisy.sum())}"
    return SummaryRow("Photon transfer", f"{gain} e⁻ per count, {read_noise} counts of read noise", note)


NOISY_SHARE = Figure(
    "noisy_share", "Patches noisier than expected for their level", "noise", "share", "at most", 0.002, 0.1,
    why="the patches are not uniform: dirt, a fold, or the edge of a neighbour",
    source=JUDGEMENT + ". A patch counts if its variance is more than 3.5 times the curve",
    remedy="clean the print, hang it flatter, and focus",
    measure=lambda table: float(table.sensor.transfer.noisy.mean()), from_one_frame="yes",
    cause=Explanation("noisy cells", noisy_evidence), drawing="noise", lines=(Line(180, _transfer_row),),
)  # fmt: skip


def _fraction_of_references(table: TableMeasurements) -> float:
    used_count = min((frame.paper.references for frame in table.frames), default=0)
    return used_count / max(table.session.white_references, 1)


def _fewest_references_text(table: TableMeasurements, accepted: float) -> str:
    return f"in {min(table.frames, key=lambda frame: frame.paper.references).record.file}"


REFERENCES_USED = Figure(
    "references_used", "Used white references, worst frame", "truth", "share", "at least", 0.9, 0.3,
    why="flat field and ground truth are based on few positions", source=JUDGEMENT,
    remedy="uncover the print, bring all of it into the frame, and expose so that bare paper stays below saturation",
    measure=_fraction_of_references, from_one_frame="beyond", where=_fewest_references_text, drawing="frames",
)  # fmt: skip


def _reference_spread(paper: Paper) -> float:
    return float(paper.spread[int(np.argmax(paper.white))])


def _frame_reference_spread(frame: FrameMeasurements) -> float:
    return _reference_spread(frame.paper)


REFERENCE_SPREAD = Figure(
    "reference_spread", "Scatter of white references about the flat field, under white", "truth", "share", "at most",
    0.01, 0.05,
    why="the flat field does not describe local changes or an unusual fall-off of light, which remain in the samples",
    source=SIMULATED + ": 0.3 %, from noise and from differences between photosites",
    remedy="clean or flatten the print, and look for shadows on it",
    measure=lambda table: max(map(_frame_reference_spread, table.white_frames), default=None), from_one_frame="beyond",
    cause=Explanation("references", reference_evidence), drawing="field",
)  # fmt: skip


def _error_row(table: TableMeasurements) -> SummaryRow:
    error = table.budget.expanded_deg
    value = f"{np.median(error):.2g}° median, {error.max():.2g}° worst illuminant"
    note = f"k = {COVERAGE:g}; largest component in the worst: {table.budget.main_cause(int(np.argmax(error))).title}"
    return SummaryRow("Uncertainty of the ground truth", value, note, brief=True)


_REDUCE_COMPONENT = (
    "reduce the largest component. Noise: expose longer or omit the darkest illuminants; lens: stop it down, clean it "
    "and shield it from light outside the print; dark light: darken the room; linearity: expose less"
)

TRUTH_MEDIAN_DEG = Figure(
    "truth_median_deg", "Expanded uncertainty (k = 2) of the ground truth, median illuminant", "truth", "°", "at most",
    0.4, 1.0,
    why="the error of a method cannot be measured more accurately than the ground truth",
    source=JUDGEMENT + ": a quarter of the angular error of a good method", remedy=_REDUCE_COMPONENT,
    before_session=False, measure=lambda table: float(np.median(table.budget.expanded_deg)), drawing="budget",
    lines=(Line(190, _error_row),),
)  # fmt: skip


TRUTH_WORST_DEG = Figure(
    "truth_worst_deg", "Expanded uncertainty (k = 2) of the ground truth, worst illuminant", "truth", "°", "at most",
    0.5, 3.0,
    why="under that illuminant, the error of a method cannot be measured more accurately than the ground truth",
    source=JUDGEMENT, remedy=_REDUCE_COMPONENT,
    before_session=False, measure=lambda table: float(table.budget.expanded_deg.max()), drawing="budget",
)  # fmt: skip


def _saturation_row(table: TableMeasurements) -> SummaryRow:
    sensor = table.sensor
    source = (
        "measured in patches"
        if sensor.saturation_measured
        else "from the raw files, possibly too high; no photosite of a patch reached it"
    )
    note = f"{source}; bare paper has at most {table.lights.white.max():.0f} counts"
    return SummaryRow("Saturation", f"{sensor.white_level} counts above black", note)


def _brightest_text(table: TableMeasurements, accepted: float) -> str:
    return f"under illuminant {int(np.argmax(table.lights.white.max(axis=1)))}"


BRIGHTEST_SHARE = Figure(
    "brightest_share", "Bare paper under the brightest illuminant, relative to saturation", "radiometry", "share",
    "at most", 0.9, CLIPPING_SHARE,
    why="patches saturate at positions with more light",
    source=JUDGEMENT + ", with a margin of 10 % for uneven light", remedy="expose less",
    measure=lambda table: float(table.lights.white.max()) / table.sensor.white_level,
    from_one_frame="beyond", where=_brightest_text, drawing="lights", lines=(Line(150, _saturation_row),),
)  # fmt: skip


def _darkest_row(table: TableMeasurements) -> SummaryRow:
    darkest = table.lights.white.max(axis=1).min()
    return SummaryRow("Darkest illuminant", f"{darkest:.0f} counts", "strongest channel on bare paper")


def _darkest_text(table: TableMeasurements, accepted: float) -> str:
    return f"under illuminant {int(np.argmin(table.lights.white.max(axis=1)))}"


DARKEST_COUNTS = Figure(
    "darkest_counts", "Bare paper under the darkest illuminant", "radiometry", "counts", "at least", 300.0, MIN_SIGNAL,
    why="patches under this illuminant are noisy, most of all dark colours, which have a thirtieth of these counts",
    source="calculated: the mean of 25 samples of 300 counts has an error of 1 %",
    remedy="expose longer",
    measure=lambda table: float(table.lights.white.max(axis=1).min()),
    from_one_frame="beyond", where=_darkest_text, drawing="lights", lines=(Line(160, _darkest_row),),
)  # fmt: skip
