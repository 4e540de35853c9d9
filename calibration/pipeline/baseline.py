"""What all frames of a table share, made once from the first, those of the primaries, and more white ones.

The shape of the first frame's light is the base of all others', and its cells are what those of every frame are
compared with; the frames of the primaries show how the field of a coloured cell differs from that of paper, and what
the lens spreads.

C cells, W white references, N grey references; places on the print in millimetres, in frames in half-size pixels.
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
    beyond_print,
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
from foundation.robust import huber_weights, sigma_of

_Array = npt.NDArray[np.float64]

# Of the polynomial in the codes, where there are cells enough: describes inks to a fraction of a per cent.
CODE_DEGREE = 8

LIGHT_ORDER = 4  # Of the polynomial over the page, where there are cells enough

_LEAST_CELLS_A_TERM = 5  # Cells for each term of the polynomial in the codes; with fewer its degree is lowered

_LEAST_COUNTS = 10.0  # Counts above black below which a cell's logarithm is mostly noise

# Counts from which on a cell weighs no more by being brighter: the polynomial's own error exceeds the noise.
_EVEN_COUNTS = 300.0

_PAPER_WORTH = 10.0  # Cells that a white reference counts for: its colour needs no polynomial

_ROUNDS = 5  # Reweighted solutions in a row; Huber's weights, squared, have settled by then


def baseline_of(
    chart: Chart,
    first: DecodedFrame,
    options: BuildOptions = PAPER_OPTIONS,
    primaries: Sequence[DecodedFrame] = (),
    more_whites: Iterable[DecodedFrame] = (),
    *,
    measures_lens: bool = True,
) -> Baseline:
    """Return what all frames share.

    `first`: the frame that is registered first. `primaries`: those of red, green and blue alone; the chart may lie
    elsewhere in them. `more_whites`: more frames of the first one's light, which show the same of the lens with other
    noise. `measures_lens`: whether the light that the lens spreads is measured, which takes a minute.
    """
    points = ChartPoints.of(chart)
    registered = register_frame(first, chart, points, options)
    baseline = _of_first(chart, points, options, first, registered)
    baseline = replace(baseline, superposition=_superposition(baseline, first, primaries))
    if measures_lens:
        baseline = with_lens(baseline, first, primaries, more_whites)
    return _with_primaries(baseline, primaries)


def _of_first(
    chart: Chart, points: ChartPoints, options: BuildOptions, first: DecodedFrame, registered: RegisteredFrame
) -> Baseline:
    """Return the baseline of a frame in which the chart is registered, its lens corrected where that is said there."""
    cells = gather(first.mosaic, first.black, registered.cells)[0].astype(np.float64)
    references, highest = gather(first.mosaic, first.black, registered.references)
    spread = cells.var(axis=1, ddof=1)
    if registered.lens is not None:
        means = np.concatenate([cells.mean(axis=1), references.mean(axis=1, dtype=np.float64)])
        added = registered.lens.added(FrameLevels(means, beyond_print(first, registered.lens.beyond)))
        cells -= added[: len(cells), None]
        references = references - added[len(cells) :, None].astype(np.float32)
    level = cells.mean(axis=1)
    whites = usable_means(references, highest, registered.references, first.saturation)[: len(points.whites_mm)]
    base = PaperReader(points.whites_mm, points.cells_mm, chart.page_mm).read(whites, first.record.file)[0].field
    if not chart.tags:
        # Its references are in the margin, and do not show what light there is in the middle.
        there, codes = compared_cells(chart, registered), chart.rgb[chart.cell_of_colour]
        base = field_of_cells(codes, points.cells_mm, level, there, points.whites_mm, whites, chart.page_mm)
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
        transfer=photon_transfer(level, spread, options.samples),
        superposition=Superposition.usual(first.saturation - float(first.black.mean())),
    )


def _superposition(baseline: Baseline, first: DecodedFrame, primaries: Sequence[DecodedFrame]) -> Superposition:
    """Return what the first frame shows of linearity beside the primaries; what is usual without them."""
    usual, frames = baseline.superposition, [first, *primaries]
    if not primaries:
        return usual
    if not all(_is_still(baseline, decoded) for decoded in frames):
        return Superposition.usual(usual.full, MOVED)
    seen, peaks = zip(*(baseline.patches(one.mosaic, one.black) for one in frames), strict=True)
    clipped = [peak >= CLIPPING_SHARE * one.saturation for peak, one in zip(peaks, frames, strict=True)]
    usable = np.isfinite(seen).all(axis=(0, 2)) & ~np.any(clipped, axis=0)
    chart, points = baseline.chart, baseline.points
    usable[: chart.colour_count] &= compared_cells(chart, baseline.first)
    return superposition(
        seen[1:],
        seen[0],
        usual.full,
        usable,
        printed_predictors(chart.rgb[chart.cell_of_colour], points.printed),
        white=first.record.kind == "white",
    )


def with_lens(
    baseline: Baseline, first: DecodedFrame, primaries: Sequence[DecodedFrame], more_whites: Iterable[DecodedFrame]
) -> Baseline:
    """Return the baseline with the lens measured, and corrected where the print proves that it spreads light."""
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
    seen = [_spread_frame(baseline, [decoded], view, mixed=False) for decoded in primaries]
    if not any(seen) or chart.bits < VARYING_BITS:
        # Few cells show so little of the lens that their noise matters.
        seen.append(_spread_frame(baseline, chain([first], more_whites), view, mixed=True))
    frames = [frame for frame in seen if frame is not None]
    left_out = "" if baseline.options.lens_correction else "left out by --no-lens-correction"
    # Threads of linear algebra wait for one another on a busy machine for longer than it takes.
    with threadpool_limits(limits=1, user_api="blas"):
        found = measure_spread(frames, around, chart.page_mm, chart.bits, LEAST_COUNTS, left_out)
    if found is None:
        return baseline
    lens = LensCorrection(view, *found)
    measured = replace(baseline, lens=lens)
    if not measured.corrects_lens:
        return measured
    correction = FrameCorrection.of(lens.spread, view, around)
    corrected = _of_first(chart, points, baseline.options, first, replace(registered, lens=correction))
    return replace(corrected, lens=lens, superposition=baseline.superposition)


def _is_still(baseline: Baseline, decoded: DecodedFrame) -> bool:
    shift = baseline.movement(decoded.mosaic, decoded.black, decoded.strongest, decoded.record.file)
    return shift.gauges > 0 and shift.length_px <= STILL_PX and shift.largest_px <= 2 * STILL_PX


def _spread_frame(baseline: Baseline, same: Iterable[DecodedFrame], view: PrintView, mixed: bool) -> SpreadFrame | None:
    """Return the mean of frames of one light as the lens is measured on it; None where the chart has moved in all.

    `mixed` is whether several primaries light it.
    """
    chart, points = baseline.chart, baseline.points
    usable = ~np.concatenate(
        [
            baseline.first.registration.mismatched_cells[chart.cell_of_colour],
            np.zeros(len(points.whites_mm) + len(points.greys_mm), dtype=np.bool_),
        ]
    )
    total, beyond, count, file = np.zeros((len(usable), 3)), np.zeros(3), 0, ""
    for decoded in same:
        if not _is_still(baseline, decoded):
            continue
        means, highest = baseline.patches(decoded.mosaic, decoded.black)
        usable &= np.isfinite(means).all(axis=1) & (highest < CLIPPING_SHARE * decoded.saturation)
        total += np.nan_to_num(means)
        beyond += beyond_print(decoded, view.beyond)
        count, file = count + 1, file or decoded.record.file
    if not count:
        return None
    whites, sensor = points.white_patches, baseline.superposition
    # Counts that are lost near black would look like a lack of light that the lens spreads, and hide a veil.
    means, beyond = (seen / count for seen in (total, beyond))
    usual = np.median(means[whites], axis=0)
    means, beyond = (seen * (1 - sensor.difference(np.maximum(seen, 0), usual)[0]) for seen in (means, beyond))
    paper, _ = baseline.paper.read(np.where(usable[whites, None], means[whites], np.nan), file)
    red, green, blue = np.sqrt(sensor.difference(DARK_LEVEL * paper.white, paper.white)[1]).tolist()
    return SpreadFrame(
        levels=FrameLevels(means, beyond),
        field=paper.field.at(view.grid.points_mm),
        white=paper.white,
        usable=usable,
        unevenness=LOOSE_UNEVENNESS if mixed else USUAL_UNEVENNESS,
        frames=count,
        bend=(red, green, blue),
        printed=np.concatenate([np.full(chart.colour_count, -1), points.printed]),
    )


def _with_primaries(baseline: Baseline, frames: Sequence[DecodedFrame]) -> Baseline:
    """Return the baseline with what frames of the primaries show; as it is if there are none, or one cannot be used."""
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
    """Return the field of a frame from its cells.

    `rgb`: (C, 3) int printed codes, 0 … 255. `cells_mm`: (C, 2) float64 mm, the cells' centres. `level`: (C, 3) float64
    mean counts above black. `usable`: (C,) bool, cells that lie in the frame and are not covered. `paper_mm`, `paper`:
    (N, 2) mm, white references, and (N, 3) their mean counts above black; NaN where one cannot be used.
    """
    degree = CODE_DEGREE
    while degree > 1 and len(cells_mm) < _LEAST_CELLS_A_TERM * len(code_powers(degree)):
        degree -= 1
    # In few blocks of few cells a light of higher order cannot be separated from the inks' interaction.
    order = LIGHT_ORDER if degree == CODE_DEGREE else min(2, degree)
    codes = code_polynomial(rgb, degree)
    light, at_paper = page_polynomial(cells_mm, page_mm, order), page_polynomial(paper_mm, page_mm, order)
    # Light's constant is the colours' too; bare paper need not be what ink of code 255 is.
    design = np.block(
        [
            [codes, light[:, 1:], np.zeros((len(codes), 1))],
            [np.zeros((len(paper), codes.shape[1])), at_paper[:, 1:], np.ones((len(paper), 1))],
        ]
    )
    factors: list[tuple[_Array, ...]] = []
    for channel in range(3):
        seen = np.concatenate([level[:, channel], paper[:, channel]])
        there = np.concatenate([usable, np.ones(len(paper), dtype=np.bool_)]) & (np.nan_to_num(seen) > _LEAST_COUNTS)
        if there.sum() < 2 * design.shape[1]:
            factors.append(())
            continue
        value, rows = np.log(seen[there]), np.ascontiguousarray(design[there])
        trust = seen[there] / (seen[there] + _EVEN_COUNTS)
        trust *= np.where(np.arange(len(seen))[there] < len(codes), 1.0, _PAPER_WORTH)
        weights, solution = trust, np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            solution = least_squares(rows, value, weights)
            off = np.abs(value - rows @ solution)
            spread = max(sigma_of(off), 1e-6)
            weights = trust * huber_weights(off, spread) ** 2
        shape = np.exp(light[:, 1:] @ solution[codes.shape[1] : -1])
        smooth = least_squares(np.ascontiguousarray(light), shape, np.ones(len(shape)))
        factors.append((smooth / float((light @ smooth).mean()),))
    red, green, blue = factors
    return FlatField(page_mm, (red, green, blue))
