"""The values that are judged, by the names of their thresholds, from the figures of a build or a check."""

from __future__ import annotations

import numpy as np

from calibration.checks.frame_consistency import has_enough_cells
from calibration.figures.table_figures import TableFigures
from calibration.sampling import bleed
from calibration.spread.fitting import MOST_MISFIT
from calibration.verdict.retaking import added_bleed
from calibration.verdict.thresholds import THRESHOLDS
from experiment.measures.reflections import added_light
from foundation.angles import angles_deg

_LEAST_CELLS = 8**4
"""Cells from which on a veil is told from other smooth light."""

_MOST_LEFT = next(limit.accept for limit in THRESHOLDS if limit.name == "correction_residual")
"""RMS error left by the lens from which on its remark speaks of the worst cells, too."""


def judged_values(figures: TableFigures) -> dict[str, float]:
    """Return the values that are judged, by name; in the units of `calibration.verdict.thresholds`.

    Left out is what could not be measured: from one frame, on a chart without tags or with few colours, without dark
    frames or a series of exposures.
    """
    return {
        **_registration_values(figures),
        **_cell_values(figures),
        **_frame_values(figures),
        **_light_values(figures),
        **_dark_values(figures),
        **_sensor_values(figures),
    }


def _registration_values(figures: TableFigures) -> dict[str, float]:
    """Return how well the chart was found in the frame that was registered first."""
    registration = figures.registration
    values = {
        "cell_px": registration.cell_px,
        "bleed": bleed(registration.cell_px, registration.blur_px, figures.cells.window)
        + figures.lens.uncorrected_in_worst,
        "tag_residual_px": registration.lens_residual_px,
        "tag_final_px": registration.marks_rms_px / registration.clearance,
        "block_residual_px": registration.block_rms_px / registration.clearance,
        "blocks_good": float(registration.blocks.good.mean()),
        "agreement": registration.agreement,
    }
    spread = figures.point_spread
    # Smooth light that is no lens's, as a reflection, has figures of its own; few cells cannot tell it from a veil.
    told = spread is None or spread.misfit <= MOST_MISFIT or _cell_count(figures) >= _LEAST_CELLS
    if figures.lens.measured and told:
        values["correction_residual"] = figures.lens.left
        if figures.lens.left <= _MOST_LEFT:
            values["correction_worst"] = figures.lens.left_worst
    if registration.framing.field is None:
        found = len(registration.framing.tags)
        values["tags_found"] = found / max(found + len(registration.framing.missing), 1)
    return values


def _cell_values(figures: TableFigures) -> dict[str, float]:
    """Return how many cells are unfit, or doubtful."""
    cells = figures.cells
    values = {"unfit_share": len(cells.unfit) / max(_cell_count(figures), 1)}
    if cells.stains.known:
        values["doubtful_share"] = float(cells.stains.doubtful.mean())
        values["added_light"] = added_light(cells.stains)
    return values


def _frame_values(figures: TableFigures) -> dict[str, float]:
    """Return the worst values over all frames, and how frames differ from each other."""
    frames, registration = figures.frames, figures.registration
    used = min((frame.paper.references for frame in frames), default=0)
    values = {
        "softer_bleed": max(
            (added_bleed(registration, frame.blur_px, figures.cells.window) for frame in frames), default=0.0
        ),
        "black_drift_counts": figures.black_drift,
        "other_camera": float(len(figures.origins.other_camera)),
        "other_lens": float(len(figures.origins.other_lens)),
        "other_exposure": figures.origins.exposure_difference,
        "other_iso": float(len(figures.origins.other_iso)),
        "references_used": used / max(figures.session.white_references, 1),
    }
    if len(frames) > 1:
        values["white_frames"] = float(len(figures.white_frames))
        values["moved_anew"] = float(sum(frame.reregistered for frame in frames))
    if has_enough_cells(_cell_count(figures)):
        values["unlike_scatter"] = max((frame.consistency.scatter for frame in frames), default=0.0)
        values["unlike_block"] = max((frame.consistency.block for frame in frames), default=0.0)
        lights = [frame for frame in frames if frame.record.kind == "light"]
        values["disturbed_cells"] = float(len({cell for one in lights for cell, _ in one.consistency.disturbed}))
    whites = [frame.paper for frame in figures.white_frames]
    if whites:
        values["reference_spread"] = max(float(paper.spread[int(np.argmax(paper.white))]) for paper in whites)
    if len(whites) > 1:
        white = np.array([paper.white for paper in whites])
        if (drift := figures.lights.drift) is None:
            values["white_drift"] = figures.white_drift
        else:
            values["drift_left"] = drift.left
        values["white_drift_deg"] = float(angles_deg(white, np.broadcast_to(white[0], white.shape)).max())
    return values


def _light_values(figures: TableFigures) -> dict[str, float]:
    """Return how well the lights are known."""
    lights = figures.lights
    paper = lights.white.max(axis=1)
    values = {
        "truth_median_deg": float(np.median(lights.white_error_deg)),
        "truth_worst_deg": float(lights.white_error_deg.max()),
        "brightest_share": float(paper.max()) / figures.sensor.white_level,
        "darkest_counts": float(paper.min()),
    }
    if lights.additivity is not None and _white_is_white(figures):
        more, less = -lights.additivity.min(), lights.additivity.max()
        values["additivity"] = max(float(more), 0.0)
        values["white_short"] = max(float(less), 0.0)
    if lights.stray is not None and _frames_are_alike(figures):
        values["stray_share"] = lights.stray.share
    off, codes = lights.off_codes_deg, lights.codes
    if off is not None and codes is not None:
        values["off_codes_deg"] = float(off.max())
        values["off_brightness"] = float(codes.off_brightness.max())
        values["exchanged_lights"] = float(len(codes.exchanges))
        values["code_misfit"] = codes.misfit
        values["held_share"] = float(codes.held.mean())
        values["exchange_deg"] = codes.exchange_deg
        alone = {light.index(max(light)) for light in figures.session.codes if max(light) == sum(light) > 0}
        values["primaries_lacking"] = float(3 - len(alone)) if alone else 0.0
    if lights.white_frames is not None:
        values["white_frame_deg"] = float(lights.white_frames.off_deg.max())
        values["white_frame_brightness"] = float(lights.white_frames.off_brightness.max())
    if (tint := figures.greys.tints_deg(lights.white)).size and np.isfinite(tint).any():
        values["grey_tint_deg"] = float(np.nanmax(tint))
    return values


def _white_is_white(figures: TableFigures) -> bool:
    """Return whether white and the primaries are what they are called, so that they may be added up."""
    off, white = figures.lights.off_codes_deg, figures.lights.white_frames
    named = (off is None or not (off > 0).any()) and (white is None or not (white.off_deg > 0).any())
    return named and _frames_are_alike(figures)


def _frames_are_alike(figures: TableFigures) -> bool:
    """Return whether no names are exchanged and files tell of one camera and exposure, so that frames may be added."""
    exchanged = figures.lights.codes is not None and len(figures.lights.codes.exchanges) > 0
    return not exchanged and not figures.origins.other_camera and not figures.origins.other_exposure


def _dark_values(figures: TableFigures) -> dict[str, float]:
    """Return what light there is while the projector shows black, and how it changes."""
    dark, white, lights = figures.dark_frames, [frame.paper.white for frame in figures.white_frames], figures.lights
    full = np.mean(white, axis=0) if white else lights.white[int(np.argmax(lights.white.sum(axis=1)))]
    values: dict[str, float] = {}
    if np.isfinite(dark.light).all() and lights.subtracted is None:
        values["leak_share"] = float(np.abs(dark.light / full).max())
    if len(dark.lights) > 1:
        values["dark_drift"] = float((np.ptp(dark.lights, axis=0) / full).max())
    return values


def _sensor_values(figures: TableFigures) -> dict[str, float]:
    """Return how the sensor answers to light."""
    sensor = figures.sensor
    values = {
        "noise_misfit": float(sensor.transfer.misfit.max()),
        "noisy_share": float(sensor.transfer.noisy.mean()),
    }
    if sensor.linearity is not None:
        values["linearity"] = sensor.linearity.worst
    return values


def _cell_count(figures: TableFigures) -> int:
    return len(figures.registration.mismatched_cells)
