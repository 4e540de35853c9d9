"""A series of exposures of the chart, under one light, in its place: how linear the sensor is.

What the patches show is computed by `experiment.measures.sensor`.

Rules that hold inside:

- The series is no part of a table: no sample depends on it, and its figures are in the report alone.
- A frame that is not of the series (another camera, ISO speed or aperture, the chart elsewhere) is refused by name.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration.measurements import LinearityMeasurements
from calibration.pipeline.frames import Baseline
from drivers.raw.rawfile import CLIPPING_SHARE, Mosaic, frame_black, read_raw, strongest_channel
from experiment.framing.pictures import REREGISTER_PX, Shift
from experiment.measures.sensor import HIGHEST, LOWEST, deviations
from foundation.errors import FormatError, InputError

LEAST_FRAMES = 4
"""Frames of different exposure times (judgement): with fewer, errors of the stated times look like nonlinearity."""

_Array = npt.NDArray[np.float64]


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
        times.append(_exposure_s(mosaic, path))
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


def _exposure_s(mosaic: Mosaic, path: Path) -> float:
    if not mosaic.shutter_s:
        raise FormatError(f"{path} does not state its exposure time; take the series with a camera that writes it")
    return mosaic.shutter_s


def _require_in_place(shift: Shift, path: Path) -> None:
    if shift.gauges == 0 or shift.largest_px > REREGISTER_PX:
        moved = f"it has moved by {shift.largest_px:.2f} px, {REREGISTER_PX:g} allowed"
        if shift.gauges == 0:
            moved = "its tags, or the outline of its field, are not seen"
        raise FormatError(
            f"{path}: the chart is not where the session has it ({moved}); take the series with camera and print as "
            "they stand in the session, before it or after it"
        )
