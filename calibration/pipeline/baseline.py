"""Which frames a table is made of, and what holds for all of them, from the first: the shape of light, cells, the lens.

The shape of the first frame's light is the base of all others', and its cells are what those of every frame are
compared with; the frames of the primaries show how the field of a coloured cell differs from that of paper. What comes
of it is a `frames.Baseline`, with which `calibration.pipeline.frames` measures every frame.

C cells, W white references, N grey references; places on the print in millimetres, in frames in half-size pixels.
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import timedelta
from itertools import chain, pairwise
from statistics import median
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError
from threadpoolctl import threadpool_limits

from calibration.checks.frame_consistency import ConsistencyCheck
from calibration.citation import Rig, StatedOrigin
from calibration.pipeline.frames import (
    PAPER_OPTIONS,
    Baseline,
    BuildOptions,
    ChartPoints,
    DecodedFrame,
    RegisteredFrame,
    SelectedFrames,
    beyond_print,
    compared_cells,
    register_frame,
    sensor_layout,
    usable_means,
)
from calibration.radiometry.primaries import Primaries, pure_lights
from calibration.radiometry.superposition import MOVED, NO_PRIMARIES, Superposition, printed_predictors, superposition
from calibration.sampling import PhotonTransfer, gather, photon_transfer
from calibration.spread.correction import (
    FrameCorrection,
    LensCorrection,
    LensFigures,
    PrintView,
    SpreadFrame,
    measure_spread,
)
from calibration.spread.fitting import DARK_LEVEL, LEAST_COUNTS, LOOSE_UNEVENNESS, USUAL_UNEVENNESS
from calibration.spread.predicting import VARYING_BITS
from calibration.spread.surroundings import FrameLevels, photosite_offsets_px, printed_grid, unsuitable
from calibration.table.lut import Lut, SourceFrame
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.chart.model import Chart
from experiment.config import CameraSettings, CitationSettings
from experiment.framing.pictures import STILL_PX
from experiment.measures.least_squares import code_polynomial, code_powers, least_squares, page_polynomial
from experiment.measures.paper import MAX_ORDER, MAX_ORDER_AROUND, FlatField, PaperReader
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import CropError, FormatError
from foundation.files import file_sha256
from foundation.robust import huber_weights, sigma_of

_log = logging.getLogger(__name__)

_Array = npt.NDArray[np.float64]

CODE_DEGREE = 8
"""Of the polynomial in the codes, where there are cells enough: describes inks to a fraction of a per cent."""

LIGHT_ORDER = 4
"""Of the polynomial over the page, where there are cells enough."""

_LEAST_CELLS_A_TERM = 5
"""Cells for each term of the polynomial in the codes; with fewer its degree is lowered."""

_LEAST_COUNTS = 10.0
"""Counts above black below which a cell's logarithm is mostly noise."""

_EVEN_COUNTS = 300.0
"""Counts from which on a cell weighs no more by being brighter: the polynomial's own error exceeds the noise."""

_PAPER_WORTH = 10.0
"""Cells that a white reference counts for: its colour needs no polynomial."""

_MORE_WHITES = 3
"""White frames beside the first that a lens is measured on, where the noise of few cells matters."""

_ROUNDS = 5
"""Reweighted solutions in a row; Huber's weights, squared, have settled by then."""


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


def baseline_of(chart: Chart, first: DecodedFrame, options: BuildOptions = PAPER_OPTIONS) -> Baseline:
    """Return what holds for all frames, from the one that is registered first; still without primaries and lens."""
    points = ChartPoints.of(chart)
    return _baseline(chart, points, options, first, register_frame(first, chart, points, options))


def with_lens(
    baseline: Baseline,
    first: DecodedFrame,
    primaries: Sequence[DecodedFrame] = (),
    whites: Iterable[DecodedFrame] = (),
) -> Baseline:
    """Return the baseline with the lens measured, and corrected where the print proves that it spreads light.

    `whites`: more frames of the first one's light, which show the same with other noise.
    """
    chart, points = baseline.chart, baseline.points
    if unsuitable(chart):
        return baseline
    cells = len(points.cells_mm)
    registered = baseline.first
    view = PrintView.of(
        printed_grid(chart),
        slice(cells, cells + len(points.whites_mm)),
        photosite_offsets_px(first.mosaic),
        baseline.paper.base,
        registered.registration,
        first.mosaic.block_planes().shape[2:],
        baseline.options.window,
    )
    around = view.around(registered.registration, registered.cells, registered.references)
    frames = [frame for decoded in primaries if (frame := _spread_frame(baseline, [decoded], view, False))]
    if not frames or chart.bits < VARYING_BITS:
        # Few cells show so little of the lens that their noise matters.
        frames += [frame for frame in (_spread_frame(baseline, chain([first], whites), view, True),) if frame]
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
    corrected = _baseline(chart, points, baseline.options, first, replace(registered, lens=correction))
    return replace(corrected, lens=lens, superposition=baseline.superposition)


def with_primaries(baseline: Baseline, primaries: Primaries | None) -> Baseline:
    """Return the baseline with what frames of the primaries alone show; as it is where there are none.

    Cells of later frames are divided by the field of their own colour, and so are those that they are compared with.
    """
    if primaries is None:
        return baseline
    paper, shape = baseline.paper.read(baseline.whites, baseline.first.file)
    cells = len(baseline.points.cells_mm)
    evened = baseline.means[:cells] / (shape * primaries.field_ratio(paper.white))
    check = _consistency_check(
        baseline.chart, baseline.points, evened, baseline.transfer, baseline.options, baseline.first
    )
    return replace(baseline, primaries=primaries, consistency_check=check)


def with_superposition(baseline: Baseline, first: DecodedFrame, primaries: Sequence[DecodedFrame]) -> Baseline:
    """Return the baseline with what the first frame shows of linearity beside the primaries."""
    frames, full = [first, *primaries], float(first.saturation - first.black.mean())
    if not primaries or not all(_is_still(baseline, decoded) for decoded in frames):
        return replace(baseline, superposition=Superposition.usual(full, MOVED if primaries else NO_PRIMARIES))
    seen, peaks = zip(*(baseline.patches(one.mosaic, one.black) for one in frames), strict=True)
    clipped = [peak >= CLIPPING_SHARE * one.saturation for peak, one in zip(peaks, frames, strict=True)]
    usable = np.isfinite(seen).all(axis=(0, 2)) & ~np.any(clipped, axis=0)
    chart, points = baseline.chart, baseline.points
    usable[: chart.colour_count] &= compared_cells(chart, baseline.first)
    printed = np.concatenate([np.zeros(len(points.whites_mm), dtype=np.int64), 1 + points.levels.level])
    found = superposition(
        seen[1:],
        seen[0],
        full,
        usable,
        printed_predictors(chart.rgb[chart.cell_of_colour], printed),
        white=first.record.kind == "white",
    )
    return replace(baseline, superposition=found)


def lens_figures(baseline: Baseline) -> LensFigures:
    """Return what is said of the lens of a session, measured or not, corrected or not."""
    if baseline.lens is None:
        why = unsuitable(baseline.chart) or f"no channel of paper has {LEAST_COUNTS:g} counts in a frame to measure on"
        return LensFigures.unknown(why, baseline.reflectances()[: baseline.chart.colour_count])
    return baseline.lens.figures


def _is_still(baseline: Baseline, decoded: DecodedFrame) -> bool:
    """Return whether the chart lies in a frame where it was registered."""
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
    total, beyond, count, file, full = np.zeros((len(usable), 3)), np.zeros(3), 0, "", 0.0
    for decoded in same:
        if not _is_still(baseline, decoded):
            continue
        means, highest = baseline.patches(decoded.mosaic, decoded.black)
        usable &= np.isfinite(means).all(axis=1) & (highest < CLIPPING_SHARE * decoded.saturation)
        total += np.nan_to_num(means)
        beyond += beyond_print(decoded, view.beyond)
        count, file = count + 1, file or decoded.record.file
        full = decoded.saturation - float(decoded.black.mean())
    if not count:
        return None
    whites = slice(len(points.cells_mm), len(points.cells_mm) + len(points.whites_mm))
    sensor = baseline.superposition or Superposition.usual(full)
    # Counts that are lost near black would look like a lack of light that the lens spreads, and hide a veil.
    means, beyond = (seen / count for seen in (total, beyond))
    usual = np.median(means[whites], axis=0)
    means, beyond = (seen * (1 - sensor.beside(np.maximum(seen, 0), usual)[0]) for seen in (means, beyond))
    paper, _ = baseline.paper.read(np.where(usable[whites, None], means[whites], np.nan), file)
    red, green, blue = np.sqrt(sensor.beside(DARK_LEVEL * paper.white, paper.white)[1]).tolist()
    return SpreadFrame(
        levels=FrameLevels(means, beyond),
        field=paper.field.at(view.grid.points_mm),
        white=paper.white,
        usable=usable,
        unevenness=LOOSE_UNEVENNESS if mixed else USUAL_UNEVENNESS,
        frames=count,
        bend=(red, green, blue),
        printed=np.concatenate(
            [np.full(chart.colour_count, -1), np.zeros(len(points.whites_mm), dtype=np.int64), 1 + points.levels.level]
        ),
    )


def _baseline(
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
    transfer = photon_transfer(level, spread, options.samples)
    evened = level / base.at(points.cells_mm)
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
        transfer=transfer,
        consistency_check=_consistency_check(chart, points, evened, transfer, options, registered),
    )


def _consistency_check(
    chart: Chart,
    points: ChartPoints,
    evened: _Array,
    transfer: PhotonTransfer,
    options: BuildOptions,
    registered: RegisteredFrame,
) -> ConsistencyCheck:
    """Return the check of frames against cells' levels `evened` (C, 3) counts, in the frame `registered`."""
    variance = transfer.variance(evened) / options.samples
    codes = chart.rgb[chart.cell_of_colour]
    return ConsistencyCheck(codes, points.cells_mm, evened, variance, compared_cells(chart, registered))


ReportProgress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""

_SETTING_RIGS = ("lab", "simulated")
"""Rigs whose settings set the camera; of others they say nothing of the exposure."""


def select_frames(session: Session) -> SelectedFrames:
    """Return the frames that a table of a session is made of, so far."""
    accepted = [record for record in session.frames() if record.accepted]
    if not any(record.kind in ("white", "light") for record in accepted):
        raise FormatError(
            f"{session.folder} holds no accepted frame; take the session with acquire run, then build the table"
        )
    last = _last_of_each_light(session, accepted)
    others = [record for record in accepted if record.kind in ("white", "dark")]
    whites = list({record.sha256: record for record in others if record.kind == "white"}.values())
    pure = pure_lights(session.illuminations) or ()
    return SelectedFrames(
        records=_in_order_taken(session, [*last.values(), *others]),
        lights_without=tuple(light.index for light in session.illuminations if light.index not in last),
        registered=_frame_to_register(session, accepted),
        primaries=tuple(last[light] for light in pure) if all(light in last for light in pure) else (),
        more_whites=tuple(whites[1 : 1 + _MORE_WHITES]) if session.chart.bits < VARYING_BITS else (),
    )


def _in_order_taken(session: Session, records: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
    """Return frames in the order taken, by the journal, with times that go on.

    White frames are interpolated in time: where a clock was set back between two frames,
    what follows counts as taken the usual interval later. Frames that were taken by other means have their times alone.
    """
    if any(event.what == "import" for event in session.journal.events()):
        return tuple(sorted(records, key=lambda record: (record.taken_at, record.file)))
    ordered = sorted(records, key=lambda record: record.attempt)
    gaps = [after.taken_at - before.taken_at for before, after in pairwise(ordered)]
    nothing = timedelta(0)
    forward = [gap.total_seconds() for gap in gaps if gap > nothing]
    usual = timedelta(seconds=median(forward)) if forward else nothing
    moved, behind = ordered[:1], timedelta(0)
    for record, gap in zip(ordered[1:], gaps, strict=True):
        behind += usual - gap if gap < nothing else nothing
        moved.append(replace(record, taken_at=record.taken_at + behind))
    return tuple(moved)


def _last_of_each_light(session: Session, accepted: Sequence[FrameRecord]) -> dict[int, FrameRecord]:
    last = {
        record.illumination: record for record in accepted if record.kind == "light" and record.illumination is not None
    }
    lights_of: dict[str, int] = {}
    for light, record in last.items():
        other = lights_of.setdefault(record.sha256, light)
        if other != light:
            raise FormatError(
                f"{session.folder}: lights {other} and {light} have the same raw file, {record.file}, SHA-256 "
                f"{record.sha256[:16]}…; each light has its own, so correct the list of frames and import it again"
            )
    return last


def _frame_to_register(session: Session, accepted: Sequence[FrameRecord]) -> FrameRecord:
    """Return the first white frame, or else the brightest light's."""
    white = next((record for record in accepted if record.kind == "white"), None)
    if white is not None:
        return white

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        return min(session.illuminations[record.illumination].colour)

    return max((record for record in accepted if record.kind == "light"), key=brightness)


def stated_origin(session: Session) -> StatedOrigin:
    """Return what a session states; what is damaged, is not known."""
    try:
        document: dict[str, Any] = tomllib.loads(session.settings_text())
        rig: Rig | None = next((known for known in get_args(Rig) if known == document.get("rig")), None)
        citation = CitationSettings.model_validate(document.get("citation", {}))
        set_by = CameraSettings.model_validate(document["camera"]) if rig in _SETTING_RIGS else None
    except (CropError, ValidationError, ValueError, KeyError, RecursionError) as error:
        if isinstance(error, CropError | tomllib.TOMLDecodeError):
            why = error if isinstance(error, CropError) else f"{session.folder / 'session.toml'} is not TOML: {error}"
            _log.warning("%s; the table states neither its origin nor its authors, exposure and licence", why)
        return StatedOrigin(CitationSettings(), None, None, session.journal.records())
    return StatedOrigin(citation, rig, set_by, session.journal.records())


def source_frames(records: Sequence[FrameRecord]) -> list[SourceFrame]:
    """Return frames as `frames.csv` of a table lists them."""
    return [SourceFrame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def frame_faults(lut: Lut, session: Session, progress: ReportProgress | None = None) -> list[str]:
    """Return which of the frames that a table was made of are missing or changed, each fault in words."""
    if lut.provenance.computed is not None:
        raise FormatError(f"{lut.folder} was computed, no frame was taken for it; verify it without a session")
    faults: list[str] = []
    if session.chart.sha256 != lut.provenance.chart_sha256:
        faults.append(f"{session.folder / 'chart.json'} is not the chart of the table")
    for done, frame in enumerate(lut.frames, 1):
        path = session.folder / frame.file
        try:
            found = file_sha256(path)
        except OSError as error:
            faults.append(f"{path} cannot be read: {error.strerror}")
        else:
            if found != frame.sha256:
                faults.append(f"{path} has changed: its SHA-256 is {found[:16]}…, the table's {frame.sha256[:16]}…")
        if progress is not None:
            progress(done, len(lut.frames), frame.file)
    return faults
