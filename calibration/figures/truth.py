"""Figures of the noise of samples, and of how well each light's colour, the ground truth, is known."""

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
    return SummaryRow("Noise of a sample", percents(table.sensor.noise), "R, G, B, of paper under white")


def _at_zero_row(table: TableMeasurements) -> SummaryRow | None:
    share = table.lights.share_at_zero
    if not len(share):
        return None
    worst = int(np.argmax(share))
    value = f"{100 * share.mean():.3f} %, {percent(share[worst])} under light {worst}"
    note = "no light within the noise; negative values are cut to 0, which lifts the mean of such cells a little"
    return SummaryRow("Samples at 0", value, note)


NOISE_MISFIT = Figure(
    "noise_misfit", "Cells' noise about the photon-transfer curve", "noise", "share", "at most", 0.3, None,
    why="there is scatter that light and sensor do not explain: the camera smooths its raw files, or the light "
    "flickers",
    source="EMVA 1288 model; " + SIMULATED + ": 0.05 to 0.15", remedy="switch the camera's noise reduction off",
    measure=lambda table: float(table.sensor.transfer.misfit.max()), of_one_frame="known", drawing="noise",
    lines=(Line(170, _noise_row), Line(200, _at_zero_row)),
)  # fmt: skip


def _transfer_row(table: TableMeasurements) -> SummaryRow:
    transfer = table.sensor.transfer
    gain = " / ".join(f"{value:.2f}" for value in transfer.gain_e.tolist())
    read = " / ".join(f"{value:.1f}" for value in transfer.read_noise.tolist())
    note = f"R, G, B of half-size pixels; {int(transfer.noisy.sum())} cells are noisier than the curve"
    return SummaryRow("Photon transfer", f"{gain} e⁻ per count, {read} counts of read noise", note)


NOISY_SHARE = Figure(
    "noisy_share", "Cells noisier than their level explains", "noise", "share", "at most", 0.002, 0.1,
    why="they are not of one colour: dirt, a fold, a neighbour's edge", source="a variance 3.5 times the model's",
    remedy="clean the print, focus, and hang it flatter",
    measure=lambda table: float(table.sensor.transfer.noisy.mean()), of_one_frame="known",
    cause=Explanation("noisy cells", noisy_evidence), drawing="noise", lines=(Line(180, _transfer_row),),
)  # fmt: skip


def _references_used(table: TableMeasurements) -> float:
    used = min((frame.paper.references for frame in table.frames), default=0)
    return used / max(table.session.white_references, 1)


def _fewest_references(table: TableMeasurements, accepted: float) -> str:
    return f"in {min(table.frames, key=lambda frame: frame.paper.references).record.file}"


REFERENCES_USED = Figure(
    "references_used", "White references used, worst frame", "truth", "share", "at least", 0.9, 0.3,
    why="flat field and ground truth rest on few places", source=JUDGEMENT,
    remedy="uncover the print, bring all of it into the picture, expose so that bare paper stays below saturation",
    measure=_references_used, of_one_frame="bounded",
    where=_fewest_references, drawing="course",
)  # fmt: skip


def _spread(paper: Paper) -> float:
    return float(paper.spread[int(np.argmax(paper.white))])


def _spread_of(frame: FrameMeasurements) -> float:
    return _spread(frame.paper)


REFERENCE_SPREAD = Figure(
    "reference_spread", "White references about the flat field, under white", "truth", "share", "at most", 0.01, 0.05,
    why="what is not smooth, or falls off otherwise than lenses do, is left in the samples by the flat field",
    source=SIMULATED + ": 0.3 % of noise and photosites' response",
    remedy="clean or flatten the print, and look for shadows on it",
    measure=lambda table: max(map(_spread_of, table.white_frames), default=None),
    of_one_frame="bounded",
    cause=Explanation("references", reference_evidence), drawing="field",
)  # fmt: skip


def _error_row(table: TableMeasurements) -> SummaryRow:
    error = table.budget.expanded_deg
    value = f"{np.median(error):.2g}° median, {error.max():.2g}° worst light"
    note = f"k = {COVERAGE:g}; of the worst most is by {table.budget.main_cause(int(np.argmax(error))).title}"
    return SummaryRow("Uncertainty of the ground truth", value, note, brief=True)


_BY_CAUSE = (
    "see the largest of its causes: noise, expose longer or leave the darkest lights out; the lens, stop it down, "
    "clean it and keep light from beside the print; darkness, darken the room; linearity, expose less"
)

TRUTH_MEDIAN_DEG = Figure(
    "truth_median_deg", "Expanded uncertainty of the ground truth, median light", "truth", "°", "at most", 0.4, 1.0,
    why="a method's error cannot be measured finer than the ground truth is known",
    source=JUDGEMENT + ": a quarter of a good method's error; k = 2 (JCGM 100)", remedy=_BY_CAUSE,
    before_session=False, measure=lambda table: float(np.median(table.budget.expanded_deg)), drawing="budget",
    lines=(Line(190, _error_row),),
)  # fmt: skip


TRUTH_WORST_DEG = Figure(
    "truth_worst_deg", "Expanded uncertainty of the ground truth, worst light", "truth", "°", "at most", 0.5, 3.0,
    why="under that light a method's error cannot be measured finer than the ground truth is known",
    source=JUDGEMENT + "; k = 2 (JCGM 100)", remedy=_BY_CAUSE,
    before_session=False, measure=lambda table: float(table.budget.expanded_deg.max()), drawing="budget",
)  # fmt: skip


def _saturation_row(table: TableMeasurements) -> SummaryRow:
    sensor = table.sensor
    source = (
        "measured in cells"
        if sensor.saturation_measured
        else "as the raw files state it, which may be too high; no photosite of a cell reached it"
    )
    note = f"{source}; bare paper reaches {table.lights.white.max():.0f}"
    return SummaryRow("Saturation", f"{sensor.white_level} counts above black", note)


def _brightest(table: TableMeasurements, accepted: float) -> str:
    return f"under light {int(np.argmax(table.lights.white.max(axis=1)))}"


BRIGHTEST_SHARE = Figure(
    "brightest_share", "Bare paper under the brightest light, of saturation", "radiometry", "share", "at most", 0.9,
    CLIPPING_SHARE,
    why="the unevenness of the light carries cells into saturation",
    source=JUDGEMENT + ": 0.8 leaves room for 20 % unevenness", remedy="expose less",
    measure=lambda table: float(table.lights.white.max()) / table.sensor.white_level,
    of_one_frame="bounded", where=_brightest, drawing="lights",
    lines=(Line(150, _saturation_row),),
)  # fmt: skip


def _darkest_row(table: TableMeasurements) -> SummaryRow:
    darkest = table.lights.white.max(axis=1).min()
    return SummaryRow("Darkest light", f"{darkest:.0f} counts", "its strongest channel on bare paper")


def _darkest(table: TableMeasurements, accepted: float) -> str:
    return f"under light {int(np.argmin(table.lights.white.max(axis=1)))}"


DARKEST_COUNTS = Figure(
    "darkest_counts", "Bare paper under the darkest light", "radiometry", "counts", "at least", 300.0, MIN_SIGNAL,
    why="25 samples of 300 counts have a mean good to 1 %, a print's dark colours a thirtieth of that",
    source="photon noise at 1.8 electrons a count, 6 counts of read noise", remedy="expose longer",
    measure=lambda table: float(table.lights.white.max(axis=1).min()),
    of_one_frame="bounded", where=_darkest, drawing="lights", lines=(Line(160, _darkest_row),),
)  # fmt: skip
