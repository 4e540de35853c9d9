"""Whether counts are proportional to light: a series of exposures of the chart, under one light, in its place.

EMVA 1288 (release 4.0) plots a sensor's mean against exposure and asks how far it strays from a line between 5 and 95 %
of saturation. Here every patch of the chart is such a curve, and since patches are of all brightnesses, a frame's own
exposure need not be believed: from one frame to the next all patches must grow by one and the same factor. What grows
otherwise at another level is the sensor's bend. One bend alone is not seen so, a power of the light, and for it the
exposure times are needed: stated to some per cent only, as cameras write 0.3 s for 0.315 s, they enter together.

Laws that hold inside:

- The series is no part of a table: it decides nothing about samples, and is told in the report.
- A frame that is not of the series (another camera, ISO speed or aperture, the chart elsewhere) is refused by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.framing.planes import frame_black
from calibration.pipeline.frames import strongest_channel
from calibration.pipeline.measuring import STILL_PX, Measurement
from calibration.radiometry.fitting import least_squares
from calibration.radiometry.paper import CLIPPED, saturation
from calibration.registration.movement import Shift
from drivers.raw.rawfile import Mosaic, read_raw
from foundation.errors import FormatError, InputError

LEAST_FRAMES = 4
LOWEST, HIGHEST = 0.05, 0.95
"""Between which shares of saturation a sensor has to be linear (EMVA 1288)."""

_NODES = 10
_LEAST_PATCHES = 50.0
_STOPS = 3
_LEAST_POWER = 0.1
"""Below, the frames did not follow their times at all, and the figure is as bad as can be."""
_HARD, _SOFT = 1e2, 0.1
_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Linearity:
    """How counts follow the light.

    Attributes
    ----------
    files
        The frames, by rising exposure.
    exposure_s
        (K,) float64, as the files state them.
    level
        (B,) float64, shares of saturation.
    deviation
        (3, B) float64, relative, of the counts from the line that fits best; NaN where no patch tells.
    """

    files: tuple[str, ...]
    exposure_s: _Array
    level: _Array
    deviation: _Array

    @property
    def worst(self) -> float:
        """The largest deviation, a share."""
        return float(np.nanmax(np.abs(self.deviation)))

    @property
    def covered(self) -> tuple[float, float]:
        """The lowest and the highest share of saturation that a patch of any channel told of."""
        told = np.flatnonzero(np.isfinite(self.deviation).any(axis=0))
        return float(self.level[told[0]]), float(self.level[told[-1]])


def read_linearity(folder: Path, work: Measurement) -> Linearity:
    """Return what a series of exposures says.

    Parameters
    ----------
    folder
        Raw files of the chart where the session's first registered frame has it, under one steady light, with one ISO
        speed and aperture, from dim to the brink of saturation; eight are usual. Hidden files are passed over.
    work
        The measurement of the session, which knows where the patches are.

    Raises
    ------
    InputError
        The folder is missing, or holds too few frames.
    FormatError
        A frame is no raw file, does not state its exposure, or is not of the series.
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
        limit = saturation(mosaic)
        _require_in_place(work.movement(mosaic, black, strongest_channel(mosaic, black), str(path)), path)
        means, highest = work.patches(mosaic, black)
        means[highest >= CLIPPED * limit] = np.nan
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
    return Linearity(tuple(paths[number].name for number in order), np.array(times)[order], level, deviation)


def _exposure_s(mosaic: Mosaic, path: Path) -> float:
    if not mosaic.shutter_s:
        raise FormatError(f"{path} does not state its exposure time; take the series with a camera that writes it")
    return mosaic.shutter_s


def _require_in_place(shift: Shift, path: Path) -> None:
    if shift.tags == 0 or shift.largest_px > 5 * STILL_PX:
        moved = "its tags are not seen" if shift.tags == 0 else f"it lies {shift.largest_px:.2f} px further"
        raise FormatError(
            f"{path}: the chart is not where the session has it ({moved}); take the series with camera and print as "
            "they stand in the session, before it or after it"
        )


def deviations(seen: _Array, exposure_s: _Array) -> tuple[_Array, _Array]:
    """Return levels (B,) and by how much counts deviate there from proportion to the light (3, B), relative.

    Parameters
    ----------
    seen
        (K, P, 3) mean counts of patches, shares of saturation; NaN where one cannot be used.
    exposure_s
        (K,) stated exposure times, rising.
    """
    nodes = np.geomspace(LOWEST, HIGHEST, _NODES)
    found = np.full((3, _NODES), np.nan)
    for channel in range(3):
        fits = [_bend(seen[..., channel], np.log(times), nodes) for times in (exposure_s, _stops(exposure_s))]
        # Cameras write 0.3 s for a third of a stop, and some mean it: what the frames follow is believed.
        found[channel] = min(fits, key=lambda fit: fit[1])[0]
    return nodes, found


def _stops(exposure_s: _Array) -> _Array:
    """Return the times that a camera means by its nominal ones: powers of two in thirds of a stop."""
    return np.asarray(2.0 ** (np.round(_STOPS * np.log2(exposure_s)) / _STOPS), dtype=np.float64)


def _bend(seen: _Array, log_times: _Array, nodes: _Array) -> tuple[_Array, float]:
    """Return the deviation at nodes (B,), and how far the frames' factors are from their times, RMS."""
    frames = len(seen)
    rows: list[_Array] = []
    grown: list[_Array] = []
    hats = np.zeros(len(nodes))
    for number in range(frames - 1):
        before, after = seen[number], seen[number + 1]
        with np.errstate(invalid="ignore"):
            used = (before >= LOWEST) & (before <= HIGHEST) & (after >= LOWEST) & (after <= HIGHEST)
        if not used.any():
            continue
        row = np.zeros((int(used.sum()), frames - 1 + len(nodes)))
        row[:, number] = 1
        low, high = _hat(before[used], nodes), _hat(after[used], nodes)
        row[:, frames - 1 :] = high - low
        hats += low.sum(axis=0) + high.sum(axis=0)
        rows.append(row)
        grown.append(np.log(after[used] / before[used]))
    told = hats >= _LEAST_PATCHES
    if not rows or told.sum() < 2:
        return np.full(len(nodes), np.nan), np.inf
    # A power of the light is a slope here, and each patch's noise, which stands on both sides, would be taken for one;
    # a pattern that repeats with the frames' steps is seen by none. Both are held at 0, hard and softly.
    at = np.where(told, np.log(nodes) - np.log(nodes)[told].mean(), 0)
    held = np.zeros((2 + len(nodes), frames - 1 + len(nodes)))
    held[0, frames - 1 :], held[1, frames - 1 :] = _HARD * told, _HARD * at
    held[2:, frames - 1 :] = _SOFT * np.eye(len(nodes))
    design = np.concatenate([*rows, held])
    values = np.concatenate([*grown, np.zeros(len(held))])
    solution = least_squares(design, values, np.ones(len(values)))
    # The frames' factors against their times tell the power.
    seen_frames = np.array([row[:, : frames - 1].any(axis=0) for row in rows]).any(axis=0)
    steps, factors = np.diff(log_times)[seen_frames], solution[: frames - 1][seen_frames]
    course, stated = (np.concatenate([[0.0], np.cumsum(each)]) for each in (factors, steps))
    course, stated = course - course.mean(), stated - stated.mean()
    power = max(float(course @ stated) / max(float(stated @ stated), 1e-12), _LEAST_POWER)
    bend = np.where(told, solution[frames - 1 :] + (1 - 1 / power) * at, np.nan)
    off = course - power * stated
    return np.asarray(bend - np.nanmean(bend), dtype=np.float64), float(np.sqrt((off**2).mean()))


def _hat(level: _Array, nodes: _Array) -> _Array:
    """Return the weights (N, B) of nodes for linear interpolation in the logarithm of a level."""
    at = (np.log(level) - np.log(nodes[0])) / (np.log(nodes[1]) - np.log(nodes[0]))
    return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(len(nodes))), 0), dtype=np.float64)


def curve(linearity: Linearity) -> list[tuple[float, list[float | None]]]:
    """Return each level with the deviations of R, G and B there, None where no patch tells; for `report.json`."""

    def told(values: _Array) -> list[float | None]:
        return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]

    levels = linearity.level.tolist()
    return [(float(f"{level:.4g}"), told(linearity.deviation[:, number])) for number, level in enumerate(levels)]
