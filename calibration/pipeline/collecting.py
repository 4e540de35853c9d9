"""The figures of a whole table, or of a check, collected from its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from calibration.budget import Budget
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
from calibration.pipeline.baseline import lens_figures, stated_origin
from calibration.pipeline.components import budget_of
from calibration.pipeline.frames import Accumulator, Baseline
from calibration.radiometry.drift import drift_correction
from calibration.radiometry.primaries import additivity, drift_gains, pure_lights
from calibration.radiometry.superposition import Superposition
from experiment.lights import Illumination
from foundation.colorimetry import angles_deg

_LEAST_WHITE = 1e-3
"""Counts that a channel's ground truth has at least, so that it is a direction even where no light is measured."""

_MOST_DRIFT, _MOST_DRIFT_DEG = 0.15, 2.0
"""Drift of white, as a share and in degrees, up to which white frames are believed: a table is refused beyond."""

_FULL_CODE = 255
"""Code of a primary at its brightest."""

_Array = npt.NDArray[np.float64]


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
    if baseline.options.citation is not None:
        # What was given for the build stands in place of the session's settings.
        stated = replace(stated, citation=baseline.options.citation)
    origins = [one.origin for one in done.figures]
    published = with_published_serials(origins, stated.citation.camera_serial)
    stains, dark = done.stains(_field_at_cells(baseline, even)), done.dark_summary()
    frames = _without_hot(done.frames, dark.hottest, stains.places_mm)
    added = baseline.added_light()
    table = TableMeasurements(
        session=SessionMeasurements(
            folder=session.folder,
            camera=baseline.camera,
            lights=lights_taken,
            registered_file=done.selected.registered.file,
            white_references=len(session.chart.white_references),
            codes=tuple(light.codes for light in session.illuminations),
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
            superposition=_superposition(done),
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
        lens=lens_figures(baseline),
        point_spread=None if baseline.lens is None else baseline.lens.spread,
        budget=Budget.none(),
    )
    return replace(table, budget=budget_of(table))


def _superposition(done: Accumulator) -> Superposition:
    """Return how counts deviate from proportion to light, as frames show it, else as is usual."""
    black = float(np.mean([frame.black.mean() for frame in done.frames]))
    return done.baseline.superposition or Superposition.usual(done.saturation - black)


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
    gains = _gains(by_light, whites)
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
        additivity=additivity(illuminations, white, full_white, dark, gains, _superposition(done)),
        codes=agreement.rows(slice(len(by_light))),
        white_frames=agreement.rows(slice(len(by_light), None)) if whites else None,
        stray=_stray_light(illuminations, by_light, whites, dark, gains),
        drift=drift_correction(*_times_s(by_light, whites), np.array([frame.paper.white for frame in whites]))
        if options.correct_drift
        else None,
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
    codes = np.array([*(light.codes for light in illuminations), *((255, 255, 255) for _ in whites)])
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
    codes = np.array([light.codes for light in illuminations], dtype=np.int64)
    # Lights of full white are white frames, too: the more there are, the better the lamp's flicker is known.
    full = np.concatenate([white[lights:], white[:lights][(codes == _FULL_CODE).all(axis=1)]])
    return stray_light(codes, white[:lights], error[:lights], full, pure_lights(illuminations))


def _gains(by_light: Sequence[FrameMeasurements], whites: Sequence[FrameMeasurements]) -> _Array:
    """Return the lamp's light at each light over that in the first white frame, (L, 3) float64; ones without one."""
    if not whites:
        return np.ones((len(by_light), 3))
    return drift_gains(*_times_s(by_light, whites), np.array([frame.paper.white for frame in whites]))


def _times_s(by_light: Sequence[FrameMeasurements], whites: Sequence[FrameMeasurements]) -> tuple[_Array, _Array]:
    """Return when lights (L,) and white frames (W,) were taken, seconds since the first white frame."""
    start = whites[0].record.taken_at
    at_s, white_at_s = (
        np.array([(frame.record.taken_at - start).total_seconds() for frame in frames]) for frames in (by_light, whites)
    )
    return at_s, white_at_s
