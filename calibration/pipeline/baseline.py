"""Create the baseline that all frames of a LUT share, from the first frame, the primaries and further white frames.

The flat fields of all frames are based on the flat field of the first frame, and their patches are compared with the
patches of the first frame. The frames of the primaries are used to measure two effects: the flat field of coloured
patches relative to paper, and the light spread by the lens.

C patches, W white and N grey references. Positions are in mm on the print, and in half-size px in frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from calibration.pipeline.frames import PAPER_OPTIONS, BuildOptions
from calibration.pipeline.measuring import (
    Baseline,
    ChartPoints,
    DecodedFrame,
    RegisteredFrame,
    background_counts,
    compared_cells,
    locate,
    register_frame,
    sample,
    sensor_layout,
    usable_means,
)
from calibration.radiometry.primaries import Primaries
from calibration.radiometry.superposition import MOVED, Superposition, printed_predictors, superposition
from calibration.sampling import gather, patch_means, photon_transfer
from calibration.spread.correction import (
    FrameCorrection,
    LensCorrection,
    PrintView,
    SpreadFrame,
    measure_spread,
)
from calibration.spread.fitting import DARK_LEVEL, LEAST_COUNTS, LOOSE_UNEVENNESS, USUAL_UNEVENNESS
from calibration.spread.predicting import VARYING_BITS
from calibration.spread.surroundings import FrameLevels, photosite_offsets_px, printed_grid, unsuitable
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.chart.model import Chart
from experiment.framing.pictures import STILL_PX
from experiment.measures.least_squares import code_polynomial, code_powers, least_squares, page_polynomial
from experiment.measures.paper import MAX_ORDER, MAX_ORDER_AROUND, FlatField, Paper, PaperReader
from foundation.errors import RegistrationError
from foundation.robust import huber_weights, robust_sigma

_Array = npt.NDArray[np.float64]
_Frames = Iterable[DecodedFrame]

# Degree of the polynomial in the codes, if there are enough patches. It describes inks with errors below 1 %.
CODE_DEGREE = 8

LIGHT_ORDER = 4  # Order of the polynomial over the page, if there are enough patches

_MIN_CELLS_PER_TERM = 5  # Patches per term of the polynomial in the codes; with fewer, its degree is lowered

_MIN_COUNTS = 10.0  # With fewer counts above black, a patch is not used, because its logarithm is mostly noise

# Counts at which the weight of a patch is half of its maximum. With more counts, errors of the polynomial exceed noise.
_HALF_WEIGHT_COUNTS = 300.0

# Weight of a white reference relative to a patch. It is higher, because the level of paper needs no polynomial.
_PAPER_WEIGHT = 10.0

_ROUNDS = 5  # Number of reweighted solutions, after which squared Huber weights have converged


def baseline_of(
    chart: Chart,
    first: DecodedFrame,
    options: BuildOptions = PAPER_OPTIONS,
    primaries: Sequence[DecodedFrame] = (),
    more_whites: Iterable[DecodedFrame] = (),
    *,
    measures_lens: bool = True,
) -> Baseline:
    """Return the baseline of a session.

    `first`: frame to register first. `primaries`: frames of red, green and blue alone; the chart may have moved in
    them. `more_whites`: more frames of the same illuminant as `first`, to reduce noise of the lens measurement.
    `measures_lens`: measure the light spread by the lens, which takes a minute.
    """
    points = ChartPoints.of(chart)
    registered = register_frame(first, chart, points, options)
    baseline = _baseline_of_first(chart, points, options, first, registered)
    baseline = replace(baseline, superposition=_measure_superposition(baseline, first, primaries))
    if measures_lens:
        baseline = with_lens(baseline, first, primaries, more_whites)
    return _with_primaries(baseline, primaries)


def _baseline_of_first(
    chart: Chart, points: ChartPoints, options: BuildOptions, first: DecodedFrame, registered: RegisteredFrame
) -> Baseline:
    """Return the baseline of a registered frame, with the lens correction of `registered`, if any."""
    cells = gather(first.mosaic, first.black, registered.cells)[0].astype(np.float64)
    references, highest = gather(first.mosaic, first.black, registered.references)
    variance = cells.var(axis=1, ddof=1)
    if registered.lens is not None:
        means = np.concatenate([cells.mean(axis=1), references.mean(axis=1, dtype=np.float64)])
        added = registered.lens.added(FrameLevels(means, background_counts(first, registered.lens.background)))
        cells -= added[: len(cells), None]
        references = references - added[len(cells) :, None].astype(np.float32)
    level = cells.mean(axis=1)
    whites = usable_means(references, highest, registered.references, first.saturation)[: len(points.whites_mm)]
    base = PaperReader(points.whites_mm, points.cells_mm, chart.page_mm).read(whites, first.record.file)[0].field
    if not chart.tags:
        # On a chart without tags, all references are in the margin, and do not show the light in the centre.
        usable, codes = compared_cells(chart, registered), chart.rgb[chart.cell_of_colour]
        base = field_of_cells(codes, points.cells_mm, level, usable, points.whites_mm, whites, chart.page_mm)
    order = MAX_ORDER if chart.tags else MAX_ORDER_AROUND
    return Baseline(
        chart=chart,
        points=points,
        options=options,
        camera=first.mosaic.camera,
        layout=sensor_layout(first.mosaic),
        first=registered,
        whites=whites,
        means=np.concatenate([level, references.mean(axis=1, dtype=np.float64)]),
        paper=PaperReader(points.whites_mm, points.cells_mm, chart.page_mm, base, order),
        transfer=photon_transfer(level, variance, options.samples),
        superposition=Superposition.usual(first.saturation - float(first.black.mean())),
    )


def _measure_superposition(baseline: Baseline, first: DecodedFrame, primaries: Sequence[DecodedFrame]) -> Superposition:
    usual, frames = baseline.superposition, [first, *primaries]
    if not primaries:
        return usual
    if not all(_is_still(baseline, decoded) for decoded in frames):
        return Superposition.usual(usual.full, MOVED)
    means, peaks = zip(*(baseline.patches(decoded.mosaic, decoded.black) for decoded in frames), strict=True)
    clipped = [peak >= CLIPPING_SHARE * decoded.saturation for peak, decoded in zip(peaks, frames, strict=True)]
    usable = np.isfinite(means).all(axis=(0, 2)) & ~np.any(clipped, axis=0)
    chart, points = baseline.chart, baseline.points
    usable[: chart.colour_count] &= compared_cells(chart, baseline.first)
    return superposition(
        means[1:],
        means[0],
        usual.full,
        usable,
        printed_predictors(chart.rgb[chart.cell_of_colour], points.printed),
        white=first.record.kind == "white",
    )


def with_lens(
    baseline: Baseline, first: DecodedFrame, primaries: Sequence[DecodedFrame], more_whites: Iterable[DecodedFrame]
) -> Baseline:
    """Return the baseline with the measured light spread, and corrected for this light if it is significant."""
    chart, points = baseline.chart, baseline.points
    if unsuitable(chart):
        return baseline
    registered = baseline.first
    view = PrintView.of(
        printed_grid(chart),
        points.white_patches,
        photosite_offsets_px(first.mosaic),
        baseline.paper.base,
        registered.registration,
        first.shape,
        baseline.options.window,
    )
    around = view.around(registered.registration, registered.cells, registered.references)
    candidates = [_spread_frame(baseline, [decoded], view, is_mixed=False) for decoded in primaries]
    if not any(candidates) or chart.bits < VARYING_BITS:
        # With few patches, noise limits the measurement of the lens. The mean of white frames has less noise.
        candidates.append(_spread_frame(baseline, chain([first], more_whites), view, is_mixed=True))
    frames = [frame for frame in candidates if frame is not None]
    reason = "" if baseline.options.lens_correction else "disabled by --no-lens-correction"
    # On a busy machine, several threads would be slower.
    with threadpool_limits(limits=1, user_api="blas"):
        measurement = measure_spread(frames, around, chart.page_mm, chart.bits, LEAST_COUNTS, reason)
    if measurement is None:
        return baseline
    lens = LensCorrection(view, *measurement)
    measured = replace(baseline, lens=lens)
    if not measured.corrects_lens:
        return measured
    correction = FrameCorrection.of(lens.spread, view, around)
    corrected = _baseline_of_first(chart, points, baseline.options, first, replace(registered, lens=correction))
    return replace(corrected, lens=lens, superposition=baseline.superposition)


def _is_still(baseline: Baseline, decoded: DecodedFrame) -> bool:
    shift = baseline.movement(decoded.mosaic, decoded.black, decoded.strongest, decoded.record.file)
    return shift.gauges > 0 and shift.length_px <= STILL_PX and shift.largest_px <= 2 * STILL_PX


def _spread_frame(baseline: Baseline, frames: _Frames, view: PrintView, is_mixed: bool) -> SpreadFrame | None:
    # Mean of the frames of one illuminant in which the chart has not moved. `is_mixed`: the illuminant has several
    # primaries.
    chart, points = baseline.chart, baseline.points
    usable = ~np.concatenate(
        [
            baseline.first.registration.mismatched_cells[chart.cell_of_colour],
            np.zeros(len(points.whites_mm) + len(points.greys_mm), dtype=np.bool_),
        ]
    )
    total, beyond, count, file = np.zeros((len(usable), 3)), np.zeros(3), 0, ""
    for decoded in frames:
        if not _is_still(baseline, decoded):
            continue
        means, highest = baseline.patches(decoded.mosaic, decoded.black)
        usable &= np.isfinite(means).all(axis=1) & (highest < CLIPPING_SHARE * decoded.saturation)
        total += np.nan_to_num(means)
        beyond += background_counts(decoded, view.background)
        count, file = count + 1, file or decoded.record.file
    if not count:
        return None
    whites, sensor = points.white_patches, baseline.superposition
    # Correct for nonlinearity near black, because lost counts would hide veiling glare.
    means, beyond = (values / count for values in (total, beyond))
    usual = np.median(means[whites], axis=0)
    means, beyond = (values * (1 - sensor.difference(np.maximum(values, 0), usual)[0]) for values in (means, beyond))
    paper, _ = baseline.paper.read(np.where(usable[whites, None], means[whites], np.nan), file)
    red, green, blue = np.sqrt(sensor.difference(DARK_LEVEL * paper.white, paper.white)[1]).tolist()
    return SpreadFrame(
        levels=FrameLevels(means, beyond),
        field=paper.field.at(view.grid.points_mm),
        white=paper.white,
        usable=usable,
        unevenness=LOOSE_UNEVENNESS if is_mixed else USUAL_UNEVENNESS,
        frames=count,
        bend=(red, green, blue),
        printed=np.concatenate([np.full(chart.colour_count, -1), points.printed]),
    )


def _with_primaries(baseline: Baseline, frames: Sequence[DecodedFrame]) -> Baseline:
    """Return the baseline with the primaries; unchanged if they are missing or unusable."""
    lights: list[int] = []
    papers: list[Paper] = []
    cells: list[_Array] = []
    for decoded in frames:
        try:
            located = locate(baseline, decoded, baseline.first, register_again=True)
        except RegistrationError:
            return baseline
        assert located is not None
        sampled = sample(baseline, located, dark=None, keep_samples=False)
        light = decoded.record.illumination
        assert light is not None
        lights.append(light)
        papers.append(sampled.paper)
        cells.append(patch_means(sampled.values))
    if not lights:
        return baseline
    primaries = Primaries.of(lights, papers, cells, baseline.points.cells_mm)
    return replace(baseline, primaries=primaries)


def field_of_cells(
    rgb: npt.ArrayLike,
    cells_mm: _Array,
    level: _Array,
    usable: npt.NDArray[np.bool_],
    paper_mm: _Array,
    paper: _Array,
    page_mm: tuple[float, float],
) -> FlatField:
    """Return the flat field of a frame from its patches.

    `rgb`: (C, 3) int printed codes, 0 … 255. `cells_mm`: (C, 2) float64 mm, centres. `level`: (C, 3) float64 mean
    counts above black. `usable`: (C,) bool, patches inside the frame and not covered. `paper_mm`: (N, 2) mm, white
    references. `paper`: (N, 3) their mean counts above black; NaN if unusable.
    """
    degree = CODE_DEGREE
    while degree > 1 and len(cells_mm) < _MIN_CELLS_PER_TERM * len(code_powers(degree)):
        degree -= 1
    # With few patches, higher orders of the light cannot be separated from the interaction of inks.
    order = LIGHT_ORDER if degree == CODE_DEGREE else min(2, degree)
    codes = code_polynomial(rgb, degree)
    light, at_paper = page_polynomial(cells_mm, page_mm, order), page_polynomial(paper_mm, page_mm, order)
    # The polynomials of light and codes share one constant. Bare paper has its own, because code 255 may print ink.
    design = np.block(
        [
            [codes, light[:, 1:], np.zeros((len(codes), 1))],
            [np.zeros((len(paper), codes.shape[1])), at_paper[:, 1:], np.ones((len(paper), 1))],
        ]
    )
    factors: list[tuple[_Array, ...]] = []
    for channel in range(3):
        counts = np.concatenate([level[:, channel], paper[:, channel]])
        is_used = np.concatenate([usable, np.ones(len(paper), dtype=np.bool_)]) & (np.nan_to_num(counts) > _MIN_COUNTS)
        if is_used.sum() < 2 * design.shape[1]:
            factors.append(())
            continue
        logs, rows = np.log(counts[is_used]), np.ascontiguousarray(design[is_used])
        base_weights = counts[is_used] / (counts[is_used] + _HALF_WEIGHT_COUNTS)
        base_weights *= np.where(np.arange(len(counts))[is_used] < len(codes), 1.0, _PAPER_WEIGHT)
        weights, solution = base_weights, np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            solution = least_squares(rows, logs, weights)
            residual = np.abs(logs - rows @ solution)
            sigma = max(robust_sigma(residual), 1e-6)
            weights = base_weights * huber_weights(residual, sigma) ** 2
        shape = np.exp(light[:, 1:] @ solution[codes.shape[1] : -1])
        smooth = least_squares(np.ascontiguousarray(light), shape, np.ones(len(shape)))
        factors.append((smooth / float((light @ smooth).mean()),))
    red, green, blue = factors
    return FlatField(page_mm, (red, green, blue))
