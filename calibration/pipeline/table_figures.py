"""The figures of a whole table, or of a check, collected from its frames; and what is made of all of them.

- A series of exposures of the chart, in its place: how linear the sensor is (`read_linearity`). No sample depends on
  it.
- The components of the uncertainty budget (`budget_of`): what each cause may leave, from what a session shows of it.
  What it does not show is what is usual, and says so; nothing is taken to be 0.

L lights, C cells in the order of colour indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from calibration.budget import Budget, Component
from calibration.checks.frame_consistency import origin_figures
from calibration.checks.light_codes import CodeAgreement, code_agreement
from calibration.checks.stray_light import StrayLight, stray_light
from calibration.citation import origin_record, with_published_serials
from calibration.measurements import (
    CellMeasurements,
    FrameMeasurements,
    GreyMeasurements,
    LightMeasurements,
    LinearityMeasurements,
    SensorMeasurements,
    SessionMeasurements,
    TableMeasurements,
)
from calibration.pipeline.collecting import Accumulator
from calibration.pipeline.frames import stated_origin
from calibration.pipeline.measuring import Baseline, compared_cells
from calibration.radiometry.drift import drift_correction
from calibration.radiometry.primaries import additivity, drift_gains, pure_lights
from calibration.sampling import mean_bleed
from calibration.spread.added_light import LEAST_LEVEL, AddedLight, added_light
from calibration.spread.correction import LensFigures
from calibration.spread.fitting import LEAST_COUNTS
from calibration.spread.surroundings import unsuitable
from drivers.raw.rawfile import CLIPPING_SHARE, frame_black, read_raw, strongest_channel
from experiment.framing.pictures import REREGISTER_PX, Shift
from experiment.lights import Illumination
from experiment.measures.sensor import HIGHEST, LOWEST, deviations
from foundation.colorimetry import angles_deg
from foundation.errors import FormatError, InputError

_Array = npt.NDArray[np.float64]

# Standard uncertainty of a frame's black level, counts, beyond what its frames' scatter shows (judgement: masked
# photosites give .03).
_BLACK_COUNTS = 0.05

# Standard deviation of photosites' response that is not seen beside their noise (usual of cameras: 0.3 to 1 %).
_RESPONSE = 0.003

_SINGLE_DARK = 0.2  # Relative change of dark light over a session, where one dark frame does not show it (judgement)

# Share of the dark light by which dark frames differ from what is there in the lights', where no light shows it
# (judgement).
_USUAL_TOO_DARK = 0.2

# Relative: a lamp that flickers, or a wheel that is cut, within an exposure (judgement: half-second exposures; Heinz
# et al. 2018).
_FLICKER = 5e-5

_STRAY = 1e-4  # Relative: light from beside the print where no figure shows it (judgement)

# Share of the mean square of these two that all channels have in common: a lamp flickers as a whole, a wheel is cut
# in one primary; walls send back the light that is shown, in their own colour (judgement).
_COMMON = 0.75


def budget_of(table: TableMeasurements) -> Budget:
    """Return the budget of what was measured."""
    white = np.maximum(table.lights.white, 1e-9)
    cells = np.maximum(table.cells.levels, LEAST_LEVEL)
    return Budget(
        (
            _noise(table, white, cells),
            _lens(table, white),
            _darkness(table, white, cells),
            _linearity(table, white, cells),
            _added_light(table, white, cells),
            _flicker(white, cells),
            _geometry(table, white, cells),
        ),
        white,
    )


def _diagonal(squares: _Array) -> _Array:
    """Return errors that are independent in each channel, (L, 3, 3), of mean squares (L, 3)."""
    return squares[:, :, None] * np.eye(3)


def _partly_common(size: float, lights: int) -> _Array:
    """Return mean square relative errors (L, 3, 3) of a size that `_COMMON` of is in all channels alike."""
    square = size**2 * (_COMMON * np.ones((3, 3)) + (1 - _COMMON) * np.eye(3))
    return np.broadcast_to(square, (lights, 3, 3))


def _noise(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return the noise of white and, of cells, that of the field there and their own photosites' response.

    The field has as much of the references' noise as it has terms, white that of one.
    """
    square = (table.lights.white_error / white) ** 2
    field = max(len(factor) for frame in table.frames for factor in frame.paper.field.coefficients[0])
    response = (table.sensor.transfer.response**2 + _RESPONSE**2) / table.cells.window**2
    return Component(
        "noise", "noise of the white references", False,
        "scatter of the white references about each frame's field, and the photosites' response within a cell; its "
        "noise from frame to frame is the camera's and no error",
        _diagonal(square), np.broadcast_to(field * square.min(axis=0) + response, cells.shape),
    )  # fmt: skip


def _lens(table: TableMeasurements, white: _Array) -> Component:
    lens = table.lens
    source = "what the light about each cell says of the lens, and cannot say" if lens.measured else lens.why_not
    return Component(
        "lens", "spread and veil of the lens", not lens.measured, source,
        np.broadcast_to(lens.white_covariance, (len(white), 3, 3)), lens.cells_error**2,
    )  # fmt: skip


def _darkness(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return the errors of black level and, where dark light was subtracted, of what was.

    Without that, a light's ground truth is that of all light that was there.
    """
    lights, dark = table.lights, table.dark_frames
    black = np.array([frame.black.mean() for frame in table.frames])
    error = np.full(3, _BLACK_COUNTS**2 + float(np.var(black)) / max(len(black), 1))
    source, assumed = "the black level of masked photosites", False
    if lights.subtracted is not None and dark.lights:
        light = np.maximum(dark.light, 0)
        changes = np.var(dark.lights, axis=0, ddof=1) if len(dark.lights) > 1 else (_SINGLE_DARK * light) ** 2
        error = error + dark.error**2 + changes + _too_dark(table, light) ** 2
        source = "scatter of the dark frames; what lights of several primaries have beyond the primaries' sum"
        assumed = lights.additivity is None or len(dark.lights) < 2
    at_cells = error / np.maximum(lights.brightest, 1e-9) ** 2
    return Component(
        "darkness", "black level and dark light", assumed, source, _diagonal(error / white**2), at_cells / cells**2 * (
            1.0 if lights.subtracted is None else np.minimum(cells, 1.0) ** 2
        ),
    )  # fmt: skip


def _too_dark(table: TableMeasurements, dark: _Array) -> _Array:
    """Return how much too much dark light (3,) counts was perhaps subtracted, of `dark` (3,) counts that was.

    White then has twice as much beyond the sum of the primaries, each of which lacks it; a projector that adds light of
    its own to white looks the same.
    """
    found = table.lights.additivity
    if found is None:
        return _USUAL_TOO_DARK * dark
    beyond = np.sqrt(found.off**2 + found.error**2 + table.white_scatter**2) * table.lights.brightest
    return np.minimum(beyond / 2, dark)


def _linearity(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    found = table.sensor.superposition
    paper = np.maximum(table.lights.brightest, 1e-9)
    level = np.maximum(cells, LEAST_LEVEL) * paper
    source = (
        "red, green and blue alone against a light that is made of them"
        if found.unmeasured is None
        else f"usual of cameras: 1 % at saturation, 0.05 % of it near black; {found.unmeasured.why}"
    )
    return Component(
        "linearity", "deviation of counts from proportion", not found.measured, source,
        found.white_covariance(white), found.errors(level, np.broadcast_to(paper, level.shape)),
    )  # fmt: skip


def _added_light(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    shown = 0.0 if table.lights.stray is None else table.lights.stray.share
    lights = _partly_common(_STRAY, len(white)) + shown**2 * np.eye(3)
    at_cells = (_STRAY**2 + shown**2 + table.cells.added.mean_square) / cells**2
    return Component(
        "added light", "reflections and light of single frames", table.lights.stray is None,
        "light that lies on dark and bright cells alike; codes of 0, and white against the primaries", lights, at_cells,
    )  # fmt: skip


def _flicker(white: _Array, cells: _Array) -> Component:
    return Component(
        "flicker", "flicker within an exposure", True,
        "usual of lamps and wheels; a drift from frame to frame is in each light's own ground truth",
        _partly_common(_FLICKER, len(white)), np.broadcast_to(_FLICKER**2, cells.shape),
    )  # fmt: skip


def _geometry(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    """Return what reaches a cell's mean from its neighbours by the sharp core, and by where the cell was found.

    A place that is known to some error blurs the cell's rim by as much, in the mean.
    """
    registration, window = table.registration, table.cells.window
    blur_px = np.hypot(registration.blur_px, registration.uncertainty_px(table.cells.stains.places_mm))
    of_neighbours = mean_bleed(registration.cell_px, blur_px, window)[:, None]
    contrast = np.sqrt(((cells - cells.mean(axis=0)) ** 2 + cells.var(axis=0)) / cells**2)
    nothing = np.zeros((len(white), 3, 3))
    return Component(
        "geometry", "places of cells and sharp core", False,
        "blur and places as registered; neighbours as the print has them in the mean",
        nothing, (of_neighbours * contrast) ** 2,
    )  # fmt: skip


_LEAST_BITS = 3  # Bits of a channel from which on neighbours in colour predict a cell

# Frames of different exposure times (judgement): with fewer, errors of the stated times look like nonlinearity.
LEAST_FRAMES = 4


def read_linearity(folder: Path, baseline: Baseline) -> LinearityMeasurements:
    """Return what a series of exposures shows.

    `folder`: raw files of the chart where the session's first registered frame has it, under one steady light, with one
    ISO speed and aperture, from dim to the brink of saturation; eight are usual. Hidden files are passed over.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            f"cannot read the series of exposures {folder}: {error.strerror}; name a folder of raw files"
        ) from error
    if len(paths) < LEAST_FRAMES:
        raise InputError(
            f"{folder} holds {len(paths)} files, at least {LEAST_FRAMES} raw files of the chart with different "
            "exposure times expected, better 8 from dim to nearly saturated"
        )
    seen: list[_Array] = []
    times: list[float] = []
    settings: list[tuple[int | None, float | None]] = []
    limits: list[float] = []
    for path in paths:
        mosaic = read_raw(path)
        if not mosaic.shutter_s:
            raise FormatError(f"{path} does not state its exposure time; take the series with a camera that writes it")
        times.append(mosaic.shutter_s)
        settings.append((mosaic.iso, mosaic.aperture))
        if settings[-1] != settings[0]:
            raise FormatError(
                f"{path} was taken with ISO {mosaic.iso}, f/{mosaic.aperture}, {paths[0].name} with ISO "
                f"{settings[0][0]}, f/{settings[0][1]}; a series differs in its exposure time alone"
            )
        black = frame_black(mosaic)
        limit = mosaic.saturation()
        _require_in_place(baseline.movement(mosaic, black, strongest_channel(mosaic, black), str(path)), path)
        means, highest = baseline.patches(mosaic, black)
        means[highest >= CLIPPING_SHARE * limit] = np.nan
        seen.append(means)
        limits.append(limit - float(black.mean()))
    if len(set(times)) < LEAST_FRAMES:
        raise InputError(
            f"{folder}: {len(set(times))} different exposure times, at least {LEAST_FRAMES} expected; "
            "take the series with times from dim to nearly saturated"
        )
    order: list[int] = np.argsort(times, kind="stable").tolist()
    level, deviation = deviations(np.stack(seen)[order] / min(limits), np.array(times)[order])
    if np.isnan(deviation).all():
        raise InputError(
            f"{folder}: no patch is between {LOWEST:.0%} and {HIGHEST:.0%} of saturation in two frames; "
            "take the series with times less far apart, from dim to nearly saturated"
        )
    return LinearityMeasurements(tuple(paths[number].name for number in order), level, deviation)


def _require_in_place(shift: Shift, path: Path) -> None:
    if shift.gauges == 0 or shift.largest_px > REREGISTER_PX:
        moved = f"it has moved by {shift.largest_px:.2f} px, {REREGISTER_PX:g} allowed"
        if shift.gauges == 0:
            moved = "its tags, or the outline of its field, are not seen"
        raise FormatError(
            f"{path}: the chart is not where the session has it ({moved}); take the series with camera and print as "
            "they stand in the session, before it or after it"
        )


# Counts that a channel's ground truth has at least, so that it is a direction even where no light is measured.
_LEAST_WHITE = 1e-3

# Drift of white, as a share and in degrees, up to which white frames are believed: a table is refused beyond.
_MOST_DRIFT, _MOST_DRIFT_DEG = 0.15, 2.0

_FULL_CODE = 255  # Code of a primary at its brightest


def table_figures(done: Accumulator, linearity: LinearityMeasurements | None) -> TableMeasurements:
    """Return the figures of a table, all of whose frames have been taken in.

    `linearity`: what a series of exposures shows; None where none was given.
    """
    even = next((frame for frame in done.frames if done.selected.is_even(frame.record)), done.frames[0])
    lit = {frame.record.illumination: frame for frame in done.frames if frame.record.kind == "light"}
    by_light = [lit[light.index] for light in done.session.illuminations]
    greys = np.array([frame.greys for frame in by_light]), np.array([frame.grey_errors for frame in by_light])
    return _figures(done, even, len(by_light), _light_figures(done, by_light), greys, linearity)


def check_figures(done: Accumulator, linearity: LinearityMeasurements | None) -> TableMeasurements:
    """Return the figures of a check, which has taken in the frame that is registered, and a dark one where there is."""
    (frame,) = done.frames
    lights = LightMeasurements(
        white=frame.paper.white[None],
        white_error=frame.paper.error[None],
        gains=np.ones((1, 3)),
        subtracted=None,
        share_at_zero=np.zeros(0),
        additivity=None,
        codes=None,
        white_frames=None,
    )
    with_frame = len(done.session.illuminations) - len(done.selected.lights_without)
    return _figures(done, frame, with_frame, lights, (frame.greys[None], frame.grey_errors[None]), linearity)


def _figures(
    done: Accumulator,
    even: FrameMeasurements,
    lights_taken: int,
    lights: LightMeasurements,
    greys: tuple[_Array, _Array],
    linearity: LinearityMeasurements | None,
) -> TableMeasurements:
    """Return all figures; `even` is the frame that shows how even cells are."""
    session, baseline, saturation = done.session, done.baseline, done.saturation
    stated = stated_origin(session)
    origins = [one.origin for one in done.figures]
    published = with_published_serials(origins, stated.citation.camera_serial)
    stains, dark = done.stains(_field_at_cells(baseline, even)), done.dark_summary()
    frames = _without_hot(done.frames, dark.hottest, stains.places_mm)
    added = _added_light_of_first(baseline)
    table = TableMeasurements(
        session=SessionMeasurements(
            folder=session.folder,
            camera=baseline.camera,
            lights=lights_taken,
            registered_file=done.selected.registered.file,
            white_references=len(session.chart.white_references),
            codes=tuple(light.colour for light in session.illuminations),
        ),
        registration=baseline.first.registration,
        frames=frames,
        lights=lights,
        greys=GreyMeasurements(baseline.points.levels.names, *greys),
        sensor=SensorMeasurements(
            saturation_counts=saturation,
            saturation_measured=bool((done.highest >= saturation).any()),
            white_level=round(saturation - float(np.mean([frame.black.mean() for frame in done.frames]))),
            noise=done.noise(),
            transfer=baseline.transfer,
            linearity=linearity,
            superposition=baseline.superposition,
        ),
        dark_frames=dark,
        cells=CellMeasurements(
            baseline.options.window, done.unfit(stains, frames, added), stains, baseline.levels, added
        ),
        origins=origin_figures(
            list(zip(done.records, published, strict=True)), None if stated.camera is None else stated.camera.iso
        ),
        origin=origin_record(stated, done.records, origins),
        primaries=baseline.primaries,
        lens=_lens_figures(baseline),
        point_spread=None if baseline.lens is None else baseline.lens.spread,
        budget=Budget.none(),
    )
    return replace(table, budget=budget_of(table))


def _added_light_of_first(baseline: Baseline) -> AddedLight:
    """Return the light that lies on parts of the print in the first frame, whatever is printed there."""
    chart, levels, cells_mm = baseline.chart, baseline.levels, baseline.points.cells_mm
    if chart.bits < _LEAST_BITS:
        return AddedLight.zero(len(cells_mm))
    paper, _ = baseline.paper.read(baseline.whites, baseline.first.file)
    white = np.maximum(paper.white, 1e-9)
    noise = baseline.transfer.variance(levels * white) / baseline.options.samples / white**2
    usable = compared_cells(chart, baseline.first)
    with threadpool_limits(limits=1, user_api="blas"):
        return added_light(levels, noise, usable, cells_mm, chart.page_mm, chart.bits)


def _lens_figures(baseline: Baseline) -> LensFigures:
    """Return what is said of the lens of a session, measured or not, corrected or not."""
    if baseline.lens is None:
        why = unsuitable(baseline.chart) or f"no channel of paper has {LEAST_COUNTS:g} counts in a frame to measure on"
        return LensFigures.unknown(why, baseline.reflectances()[: baseline.chart.colour_count])
    return baseline.lens.figures


def _field_at_cells(baseline: Baseline, even: FrameMeasurements) -> _Array:
    """Return the field (C, 3) float64 by which the cells of a frame are evened, each by that of its own colour."""
    field = even.paper.field.at(baseline.points.cells_mm)
    return field if baseline.primaries is None else field * baseline.primaries.field_ratio(even.paper.white)


def _without_hot(
    frames: tuple[FrameMeasurements, ...], hottest: _Array, cells_mm: _Array
) -> tuple[FrameMeasurements, ...]:
    """Return frames in which no cell counts as covered for the hot photosite that it holds.

    `hottest` (C,) counts as of the dark frames, whenever these were taken; (0,) without any.
    """
    if not len(hottest):
        return frames
    hot = hottest > 0
    return tuple(replace(one, consistency=one.consistency.without_hot(hot, cells_mm)) for one in frames)


def _light_figures(done: Accumulator, by_light: Sequence[FrameMeasurements]) -> LightMeasurements:
    """Return what was measured of the lights, whose frames are `by_light`."""
    illuminations, options = done.session.illuminations, done.baseline.options
    error = np.array([frame.paper.error for frame in by_light])
    # A channel without light may be measured at or below 0; its standard error is what is known of it.
    white = np.maximum([frame.paper.white for frame in by_light], np.maximum(error, _LEAST_WHITE))
    whites = [frame for frame in done.frames if frame.record.kind == "white"]
    paper = np.array([frame.paper.white for frame in whites]).reshape(-1, 3)
    gains = drift_gains(*_times_s(by_light, whites), paper)
    dark = np.zeros(3) if options.subtract_dark else done.dark_summary().light
    full_white = whites[0].paper.white if whites else None
    compared = whites[:1] if _drift_is_one(whites) else whites
    agreement = _code_agreement(
        illuminations, by_light, compared, dark, gains if len(compared) < 2 else np.ones_like(gains)
    )
    return LightMeasurements(
        white=white,
        white_error=error,
        gains=gains,
        subtracted=np.array([frame.dark for frame in by_light]) if options.subtract_dark else None,
        share_at_zero=np.array([frame.share_at_zero for frame in by_light]),
        additivity=additivity(illuminations, white, full_white, dark, gains, done.baseline.superposition),
        codes=agreement.rows(slice(len(by_light))),
        white_frames=agreement.rows(slice(len(by_light), None)) if whites else None,
        stray=_stray_light(illuminations, by_light, whites, dark, gains),
        drift=drift_correction(*_times_s(by_light, whites), paper) if options.correct_drift else None,
    )


def _drift_is_one(whites: Sequence[FrameMeasurements]) -> bool:
    """Return whether white frames differ as a lamp drifts, and not as frames of other lights or exposures do."""
    levels = np.array([frame.paper.white for frame in whites]).reshape(-1, 3)
    if len(levels) < 2:
        return True
    middle = np.median(levels, axis=0)
    turned = angles_deg(levels, np.broadcast_to(middle, levels.shape)).max()
    return bool(np.abs(levels / np.maximum(middle, _LEAST_WHITE) - 1).max() < _MOST_DRIFT and turned < _MOST_DRIFT_DEG)


def _code_agreement(
    illuminations: Sequence[Illumination],
    by_light: Sequence[FrameMeasurements],
    whites: Sequence[FrameMeasurements],
    dark: _Array,
    gains: _Array,
) -> CodeAgreement:
    """Return how the lights, and white frames behind them, agree with their codes; stated exposures aside."""
    frames = [*by_light, *whites]
    codes = np.array([*(light.colour for light in illuminations), *((255, 255, 255) for _ in whites)])
    factor = _to_one_exposure(frames)
    drift = np.concatenate([gains, np.ones((len(whites), 3))])
    error = np.array([frame.paper.error for frame in frames])
    there = np.isfinite(dark)
    white = np.array([frame.paper.white for frame in frames]) - np.where(there, dark, 0)
    return code_agreement(
        codes,
        white * factor / drift,
        error * factor / drift,
        dark_known=bool(there.all()),
        drift_known=len(whites) == 1,
    )


def _to_one_exposure(frames: Sequence[FrameMeasurements]) -> _Array:
    """Return the usual exposure over that of each frame, (N, 1) float64, as files state them; 1 where they do not."""
    exposures = np.array([frame.origin.exposure for frame in frames])
    usual = float(np.median(exposures[exposures > 0])) if (exposures > 0).any() else 1.0
    return np.where(exposures > 0, usual / np.maximum(exposures, 1e-12), 1.0)[:, None]


def _stray_light(
    illuminations: Sequence[Illumination],
    by_light: Sequence[FrameMeasurements],
    whites: Sequence[FrameMeasurements],
    dark: _Array,
    gains: _Array,
) -> StrayLight | None:
    """Return what light is in frames that the dark ones do not show; None where it cannot be known."""
    frames, lights = [*by_light, *whites], len(by_light)
    factor = _to_one_exposure(frames) / np.concatenate([gains, np.ones((len(whites), 3))])
    white = (np.array([frame.paper.white for frame in frames]) - dark) * factor
    error = np.array([frame.paper.error for frame in frames]) * factor
    codes = np.array([light.colour for light in illuminations], dtype=np.int64)
    # Lights of full white are white frames, too: the more there are, the better the lamp's flicker is known.
    full = np.concatenate([white[lights:], white[:lights][(codes == _FULL_CODE).all(axis=1)]])
    return stray_light(codes, white[:lights], error[:lights], full, pure_lights(illuminations))


def _times_s(by_light: Sequence[FrameMeasurements], whites: Sequence[FrameMeasurements]) -> tuple[_Array, _Array]:
    """Return when lights (L,) and white frames (W,) were taken, seconds since the first of these, if any."""
    start = (*whites, *by_light)[0].record.taken_at
    at_s, white_at_s = (
        np.array([(frame.record.taken_at - start).total_seconds() for frame in frames]) for frames in (by_light, whites)
    )
    return at_s, white_at_s
