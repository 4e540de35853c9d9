"""Calculate the measurements of a LUT or of `build-lut check` from the accumulated frames, with uncertainty budget.

If a session does not show an effect, the usual size of the effect is assumed, never 0. The linearity measured with a
series of exposures (`read_linearity`) does not change the samples.

Shapes: L illuminants, C patches in the order of colour indices.
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
from experiment.lights import Illuminant
from experiment.measures.sensor import HIGHEST, LOWEST, deviations
from foundation.colorimetry import angles_deg
from foundation.errors import FormatError, InputError, counted

_Array = npt.NDArray[np.float64]

# Standard uncertainty of the black level, counts, in addition to the scatter of frames. Chosen by judgement, because
# masked photosites give 0.03 counts.
_BLACK_COUNTS = 0.05

# Relative standard deviation of photosite response that is always assumed, because noise may hide it.
_RESPONSE_SD = 0.003

_DARK_CHANGE = 0.2  # Relative change of dark light over a session with a single dark frame; chosen by judgement

# Relative difference between the dark light in dark frames and in other frames, if not measured. Chosen by judgement.
_USUAL_OVERSUBTRACTION = 0.2

# Relative error due to lamp flicker or an incomplete turn of the colour wheel in an exposure of 0.5 s (Heinz et al.
# 2018). Chosen by judgement.
_FLICKER_ERROR = 5e-5

_STRAY_ERROR = 1e-4  # Light from outside the print relative to the illuminant, if not measured; chosen by judgement

# Fraction of the mean square errors of flicker and of stray light that all channels have in common. Chosen by
# judgement: most flicker changes all channels alike. Channels differ if an exposure ends within one colour of the
# wheel, or if walls reflect light in their own colour.
_COMMON_FRACTION = 0.75


def budget_of(table: TableMeasurements) -> Budget:
    """Return the uncertainty budget of the measurements."""
    white = np.maximum(table.lights.white, 1e-9)
    cells = np.maximum(table.cells.levels, LEAST_LEVEL)
    return Budget(
        (
            _noise_component(table, white, cells),
            _lens_component(table, white),
            _darkness_component(table, white, cells),
            _linearity_component(table, white, cells),
            _added_light_component(table, white, cells),
            _flicker_component(white, cells),
            _geometry_component(table, white, cells),
        ),
        white,
    )


def _diagonal(squares: _Array) -> _Array:
    """Return covariances (L, 3, 3) of errors that are independent in each channel, from mean squares (L, 3)."""
    return squares[:, :, None] * np.eye(3)


def _partly_common(size: float, lights: int) -> _Array:
    """Return covariances (L, 3, 3) of a relative error; `_COMMON_FRACTION` of it is common to all channels."""
    square = size**2 * (_COMMON_FRACTION * np.ones((3, 3)) + (1 - _COMMON_FRACTION) * np.eye(3))
    return np.broadcast_to(square, (lights, 3, 3))


def _noise_component(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    # The variance of the flat field at a patch is the variance of white times the number of its coefficients.
    square = (table.lights.white_error / white) ** 2
    coefficients = max(len(factor) for frame in table.frames for factor in frame.paper.field.coefficients[0])
    response = (table.sensor.transfer.response**2 + _RESPONSE_SD**2) / table.cells.window**2
    return Component(
        "noise", "noise of the white references", False,
        "scatter of the white references about each frame's flat field, and photosite response within a patch; noise "
        "of the samples is not included",
        _diagonal(square), np.broadcast_to(coefficients * square.min(axis=0) + response, cells.shape),
    )  # fmt: skip


def _lens_component(table: TableMeasurements, white: _Array) -> Component:
    lens = table.lens
    source = "measured with the light around each patch, with its uncertainty" if lens.measured else lens.why_not
    return Component(
        "lens", "light spread and veiling glare of the lens", not lens.measured, source,
        np.broadcast_to(lens.white_covariance, (len(white), 3, 3)), lens.cells_error**2,
    )  # fmt: skip


def _darkness_component(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    # Without subtraction, the ground truth includes all light, so that dark light is no error.
    lights, dark = table.lights, table.dark_frames
    black = np.array([frame.black.mean() for frame in table.frames])
    error = np.full(3, _BLACK_COUNTS**2 + float(np.var(black)) / max(len(black), 1))
    source, assumed = "black level of masked photosites", False
    if lights.subtracted is not None and dark.lights:
        light = np.maximum(dark.light, 0)
        changes = np.var(dark.lights, axis=0, ddof=1) if len(dark.lights) > 1 else (_DARK_CHANGE * light) ** 2
        error = error + dark.error**2 + changes + _oversubtracted_counts(table, light) ** 2
        source = "scatter of the dark frames; difference between mixtures and the sum of their primaries"
        assumed = lights.additivity is None or len(dark.lights) < 2
    at_cells = error / np.maximum(lights.brightest, 1e-9) ** 2
    return Component(
        "darkness", "black level and dark light", assumed, source, _diagonal(error / white**2), at_cells / cells**2 * (
            1.0 if lights.subtracted is None else np.minimum(cells, 1.0) ** 2
        ),
    )  # fmt: skip


def _oversubtracted_counts(table: TableMeasurements, dark: _Array) -> _Array:
    # If `dark` (3,) counts are too high, white lacks the excess once, and the primaries' sum three times. White then
    # exceeds the sum by twice the excess. A projector with a white segment has the same effect.
    additivity = table.lights.additivity
    if additivity is None:
        return _USUAL_OVERSUBTRACTION * dark
    excess = np.sqrt(additivity.off**2 + additivity.error**2 + table.white_scatter**2) * table.lights.brightest
    return np.minimum(excess / 2, dark)


def _linearity_component(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    superposition = table.sensor.superposition
    paper = np.maximum(table.lights.brightest, 1e-9)
    level = np.maximum(cells, LEAST_LEVEL) * paper
    source = (
        "red, green and blue alone, compared with an illuminant that combines them"
        if superposition.unmeasured is None
        else f"usual for cameras: 1 % at saturation, 0.05 % of saturation near black; {superposition.unmeasured.why}"
    )
    return Component(
        "linearity", "deviation of counts from proportionality", not superposition.measured, source,
        superposition.white_covariance(white), superposition.errors(level, np.broadcast_to(paper, level.shape)),
    )  # fmt: skip


def _added_light_component(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    measured_share = 0.0 if table.lights.stray is None else table.lights.stray.share
    lights = _partly_common(_STRAY_ERROR, len(white)) + measured_share**2 * np.eye(3)
    at_cells = (_STRAY_ERROR**2 + measured_share**2 + table.cells.added.mean_square) / cells**2
    return Component(
        "added light", "reflections, and light in single frames", table.lights.stray is None,
        "light added equally to dark and bright patches; light of primaries with code 0; white minus all primaries",
        lights, at_cells,
    )  # fmt: skip


def _flicker_component(white: _Array, cells: _Array) -> Component:
    return Component(
        "flicker", "flicker within an exposure", True,
        "usual for lamps and colour wheels; drift between frames is part of the ground truths and no error",
        _partly_common(_FLICKER_ERROR, len(white)), np.broadcast_to(_FLICKER_ERROR**2, cells.shape),
    )  # fmt: skip


def _geometry_component(table: TableMeasurements, white: _Array, cells: _Array) -> Component:
    # On average, an uncertain position acts like a blur with σ equal to the uncertainty.
    registration, window = table.registration, table.cells.window
    blur_px = np.hypot(registration.blur_px, registration.uncertainty_px(table.cells.stains.places_mm))
    neighbour_share = mean_bleed(registration.cell_px, blur_px, window)[:, None]
    contrast = np.sqrt(((cells - cells.mean(axis=0)) ** 2 + cells.var(axis=0)) / cells**2)
    no_error = np.zeros((len(white), 3, 3))
    return Component(
        "geometry", "positions of patches, and blur", False,
        "blur and uncertainty of position from the registration; neighbours are assumed to have average contrast",
        no_error, (neighbour_share * contrast) ** 2,
    )  # fmt: skip


_MIN_BITS = 3  # Bits per channel needed to predict a patch from its neighbours in colour

# Minimum number of different exposure times. With fewer, errors of recorded times look like nonlinearity. Chosen by
# judgement.
MIN_EXPOSURES = 4


def read_linearity(folder: Path, baseline: Baseline) -> LinearityMeasurements:
    """Return the linearity measured with a series of exposures.

    `folder`: raw files of the chart at its position in the session, under one steady illuminant, with one ISO speed and
    aperture, from dim to almost saturated; eight files are usual. Hidden files are ignored.
    """
    try:
        paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            f"cannot read the series of exposures {folder}: {error.strerror}; give a folder of raw files"
        ) from error
    if len(paths) < MIN_EXPOSURES:
        raise InputError(
            f"{folder} contains {counted(len(paths), 'file')}, expected at least {MIN_EXPOSURES}; take raw files of "
            "the chart with different exposure times, preferably 8, from dim to almost saturated"
        )
    means_by_file: list[_Array] = []
    times: list[float] = []
    settings: list[tuple[int | None, float | None]] = []
    limits: list[float] = []
    for path in paths:
        mosaic = read_raw(path)
        if not mosaic.shutter_s:
            raise FormatError(f"{path} has no exposure time; take the series with a camera that records it")
        times.append(mosaic.shutter_s)
        settings.append((mosaic.iso, mosaic.aperture))
        if settings[-1] != settings[0]:
            raise FormatError(
                f"{path} was taken with ISO {mosaic.iso}, f/{mosaic.aperture}, expected ISO {settings[0][0]}, "
                f"f/{settings[0][1]} as in {paths[0].name}; take the series again and change only the exposure time"
            )
        black = frame_black(mosaic)
        limit = mosaic.saturation()
        _require_in_place(baseline.movement(mosaic, black, strongest_channel(mosaic, black), str(path)), path)
        means, highest = baseline.patches(mosaic, black)
        means[highest >= CLIPPING_SHARE * limit] = np.nan
        means_by_file.append(means)
        limits.append(limit - float(black.mean()))
    if len(set(times)) < MIN_EXPOSURES:
        raise InputError(
            f"{folder}: {len(set(times))} different exposure times, expected at least {MIN_EXPOSURES}; "
            "take the series with times from dim to almost saturated"
        )
    order: list[int] = np.argsort(times, kind="stable").tolist()
    level, deviation = deviations(np.stack(means_by_file)[order] / min(limits), np.array(times)[order])
    if np.isnan(deviation).all():
        raise InputError(
            f"{folder}: no patch is between {LOWEST:.0%} and {HIGHEST:.0%} of saturation in two frames; "
            "take the series with smaller steps, from dim to almost saturated"
        )
    return LinearityMeasurements(tuple(paths[number].name for number in order), level, deviation)


def _require_in_place(shift: Shift, path: Path) -> None:
    if shift.gauges == 0 or shift.largest_px > REREGISTER_PX:
        fault = f"it has moved by {shift.largest_px:.2f} px, expected at most {REREGISTER_PX:g} px"
        if shift.gauges == 0:
            fault = "its tags, or the outline of its patches, are not visible"
        raise FormatError(
            f"{path}: the chart is not at its position in the session ({fault}); take the series directly before or "
            "after the session, without moving camera or print"
        )


# Lower limit of the ground truth, counts, so that its chromaticity is defined even without light.
_MIN_WHITE = 1e-3

# Largest differences between white frames that lamp drift explains, relative and in degrees.
_MAX_DRIFT, _MAX_DRIFT_DEG = 0.15, 2.0

_FULL_CODE = 255  # Code of a primary at full brightness


def table_figures(accumulator: Accumulator, linearity: LinearityMeasurements | None) -> TableMeasurements:
    """Return the measurements of a LUT with all frames added. `linearity`: result of a series of exposures, if any."""
    frames = accumulator.frames
    evenly_lit = next((frame for frame in frames if accumulator.selected.is_evenly_lit(frame.record)), frames[0])
    frame_by_light = {frame.record.illumination: frame for frame in frames if frame.record.kind == "light"}
    by_light = [frame_by_light[light.index] for light in accumulator.session.illuminations]
    greys = np.array([frame.greys for frame in by_light]), np.array([frame.grey_errors for frame in by_light])
    lights = _light_figures(accumulator, by_light)
    return _table_measurements(accumulator, evenly_lit, len(by_light), lights, greys, linearity)


def check_figures(accumulator: Accumulator, linearity: LinearityMeasurements | None) -> TableMeasurements:
    """Return the measurements of `build-lut check`, from the registered frame and a dark frame, if there is one."""
    (frame,) = accumulator.frames
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
    light_count = len(accumulator.session.illuminations) - len(accumulator.selected.missing_lights)
    greys = frame.greys[None], frame.grey_errors[None]
    return _table_measurements(accumulator, frame, light_count, lights, greys, linearity)


def _table_measurements(
    accumulator: Accumulator,
    evenly_lit: FrameMeasurements,
    lights_taken: int,
    lights: LightMeasurements,
    greys: tuple[_Array, _Array],
    linearity: LinearityMeasurements | None,
) -> TableMeasurements:
    # `evenly_lit`: frame for measuring the uniformity of patches.
    session, baseline, saturation = accumulator.session, accumulator.baseline, accumulator.saturation
    stated = stated_origin(session)
    origins = [frame.origin for frame in accumulator.figures]
    published = with_published_serials(origins, stated.citation.camera_serial)
    stains, dark = accumulator.stains(_field_at_cells(baseline, evenly_lit)), accumulator.dark_summary()
    frames = _without_hot(accumulator.frames, dark.hottest, stains.places_mm)
    added = _added_light_of_first(baseline)
    table = TableMeasurements(
        session=SessionMeasurements(
            folder=session.folder,
            camera=baseline.camera,
            lights=lights_taken,
            registered_file=accumulator.selected.registered.file,
            white_references=len(session.chart.white_references),
            codes=tuple(light.colour for light in session.illuminations),
        ),
        registration=baseline.first.registration,
        frames=frames,
        lights=lights,
        greys=GreyMeasurements(baseline.points.levels.names, *greys),
        sensor=SensorMeasurements(
            saturation_counts=saturation,
            saturation_measured=bool((accumulator.highest >= saturation).any()),
            white_level=round(saturation - float(np.mean([frame.black.mean() for frame in accumulator.frames]))),
            noise=accumulator.noise(),
            transfer=baseline.transfer,
            linearity=linearity,
            superposition=baseline.superposition,
        ),
        dark_frames=dark,
        cells=CellMeasurements(
            baseline.options.window, accumulator.unfit(stains, frames, added), stains, baseline.levels, added
        ),
        origins=origin_figures(
            list(zip(accumulator.records, published, strict=True)), None if stated.camera is None else stated.camera.iso
        ),
        origin=origin_record(stated, accumulator.records, origins),
        primaries=baseline.primaries,
        lens=_lens_figures(baseline),
        point_spread=None if baseline.lens is None else baseline.lens.spread,
        budget=Budget.none(),
    )
    return replace(table, budget=budget_of(table))


def _added_light_of_first(baseline: Baseline) -> AddedLight:
    """Return the light added to parts of the print in the first frame, independent of colour."""
    chart, levels, cells_mm = baseline.chart, baseline.levels, baseline.points.cells_mm
    if chart.bits < _MIN_BITS:
        return AddedLight.zero(len(cells_mm))
    paper, _ = baseline.paper.read(baseline.whites, baseline.first.file)
    white = np.maximum(paper.white, 1e-9)
    noise = baseline.transfer.variance(levels * white) / baseline.options.samples / white**2
    usable = compared_cells(chart, baseline.first)
    with threadpool_limits(limits=1, user_api="blas"):
        return added_light(levels, noise, usable, cells_mm, chart.page_mm, chart.bits)


def _lens_figures(baseline: Baseline) -> LensFigures:
    if baseline.lens is None:
        reason = unsuitable(baseline.chart) or f"no channel of paper reaches {LEAST_COUNTS:g} counts; expose longer"
        return LensFigures.unknown(reason, baseline.reflectances()[: baseline.chart.colour_count])
    return baseline.lens.figures


def _field_at_cells(baseline: Baseline, evenly_lit: FrameMeasurements) -> _Array:
    """Return the flat field (C, 3) float64 of a frame at the patches, for the colour of each."""
    field = evenly_lit.paper.field.at(baseline.points.cells_mm)
    return field if baseline.primaries is None else field * baseline.primaries.field_ratio(evenly_lit.paper.white)


def _without_hot(
    frames: tuple[FrameMeasurements, ...], hottest: _Array, cells_mm: _Array
) -> tuple[FrameMeasurements, ...]:
    # Patches that deviate because of a hot photosite are not regarded as covered. `hottest`: (C,) counts, or (0,)
    # without dark frames.
    if not len(hottest):
        return frames
    hot = hottest > 0
    return tuple(replace(frame, consistency=frame.consistency.without_hot(hot, cells_mm)) for frame in frames)


def _light_figures(accumulator: Accumulator, by_light: Sequence[FrameMeasurements]) -> LightMeasurements:
    illuminations, options = accumulator.session.illuminations, accumulator.baseline.options
    error = np.array([frame.paper.error for frame in by_light])
    # A channel without light may be measured at or below 0. It then gets its standard error as the value.
    white = np.maximum([frame.paper.white for frame in by_light], np.maximum(error, _MIN_WHITE))
    whites = [frame for frame in accumulator.frames if frame.record.kind == "white"]
    paper = np.array([frame.paper.white for frame in whites]).reshape(-1, 3)
    gains = drift_gains(*_times_s(by_light, whites), paper)
    dark = np.zeros(3) if options.subtract_dark else accumulator.dark_summary().light
    full_white = whites[0].paper.white if whites else None
    compared = whites[:1] if _differ_only_by_drift(whites) else whites
    agreement = _code_agreement(
        illuminations, by_light, compared, dark, gains if len(compared) < 2 else np.ones_like(gains)
    )
    return LightMeasurements(
        white=white,
        white_error=error,
        gains=gains,
        subtracted=np.array([frame.dark for frame in by_light]) if options.subtract_dark else None,
        share_at_zero=np.array([frame.share_at_zero for frame in by_light]),
        additivity=additivity(illuminations, white, full_white, dark, gains, accumulator.baseline.superposition),
        codes=agreement.rows(slice(len(by_light))),
        white_frames=agreement.rows(slice(len(by_light), None)) if whites else None,
        stray=_stray_light(illuminations, by_light, whites, dark, gains),
        drift=drift_correction(*_times_s(by_light, whites), paper) if options.correct_drift else None,
    )


def _differ_only_by_drift(whites: Sequence[FrameMeasurements]) -> bool:
    # White frames of another illuminant or exposure differ by more than lamp drift.
    levels = np.array([frame.paper.white for frame in whites]).reshape(-1, 3)
    if len(levels) < 2:
        return True
    middle = np.median(levels, axis=0)
    largest_deg = angles_deg(levels, np.broadcast_to(middle, levels.shape)).max()
    return bool(np.abs(levels / np.maximum(middle, _MIN_WHITE) - 1).max() < _MAX_DRIFT and largest_deg < _MAX_DRIFT_DEG)


def _code_agreement(
    illuminations: Sequence[Illuminant],
    by_light: Sequence[FrameMeasurements],
    whites: Sequence[FrameMeasurements],
    dark: _Array,
    gains: _Array,
) -> CodeAgreement:
    """Return the agreement with the codes, at equal exposures: rows of illuminants, then rows of white frames."""
    frames = [*by_light, *whites]
    codes = np.array([*(light.colour for light in illuminations), *((255, 255, 255) for _ in whites)])
    factor = _to_one_exposure(frames)
    drift = np.concatenate([gains, np.ones((len(whites), 3))])
    error = np.array([frame.paper.error for frame in frames])
    is_known = np.isfinite(dark)
    white = np.array([frame.paper.white for frame in frames]) - np.where(is_known, dark, 0)
    return code_agreement(
        codes,
        white * factor / drift,
        error * factor / drift,
        dark_known=bool(is_known.all()),
        drift_known=len(whites) == 1,
    )


def _to_one_exposure(frames: Sequence[FrameMeasurements]) -> _Array:
    """Return the median exposure divided by the exposure of each frame, (N, 1) float64; 1 if not recorded."""
    exposures = np.array([frame.origin.exposure for frame in frames])
    median = float(np.median(exposures[exposures > 0])) if (exposures > 0).any() else 1.0
    return np.where(exposures > 0, median / np.maximum(exposures, 1e-12), 1.0)[:, None]


def _stray_light(
    illuminations: Sequence[Illuminant],
    by_light: Sequence[FrameMeasurements],
    whites: Sequence[FrameMeasurements],
    dark: _Array,
    gains: _Array,
) -> StrayLight | None:
    frames, lights = [*by_light, *whites], len(by_light)
    factor = _to_one_exposure(frames) / np.concatenate([gains, np.ones((len(whites), 3))])
    white = (np.array([frame.paper.white for frame in frames]) - dark) * factor
    error = np.array([frame.paper.error for frame in frames]) * factor
    codes = np.array([light.colour for light in illuminations], dtype=np.int64)
    # Illuminants of full white count as white frames, so that the flicker of the lamp is measured more accurately.
    full = np.concatenate([white[lights:], white[:lights][(codes == _FULL_CODE).all(axis=1)]])
    return stray_light(codes, white[:lights], error[:lights], full, pure_lights(illuminations))


def _times_s(by_light: Sequence[FrameMeasurements], whites: Sequence[FrameMeasurements]) -> tuple[_Array, _Array]:
    """Return the times of illuminants (L,) and white frames (W,), s since the first white frame, if any."""
    start = (*whites, *by_light)[0].record.taken_at
    at_s, white_at_s = (
        np.array([(frame.record.taken_at - start).total_seconds() for frame in frames]) for frames in (by_light, whites)
    )
    return at_s, white_at_s
