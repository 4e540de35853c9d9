"""Measure the saturation level of the sensor, and find a shutter time at which white is bright but not clipped.

A shutter time is proposed only after a frame was taken with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import Finding, judge_value
from acquisition.run.devices import Devices, holds_whole_turns
from calibration.figures.figure import format_value
from calibration.figures.truth import BRIGHTEST_SHARE
from drivers.camera import CapturedFrame, capture
from drivers.presenter import Colour
from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, PAPER_PERCENTILE, Mosaic, frame_black, phases, read_raw
from experiment.config import LabSettings


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame with its shutter time, s, its counts and the size of its file, bytes."""

    shutter_s: float
    mosaic: Mosaic
    size: int

    def brightest(self, percentile: float) -> npt.NDArray[np.float64]:
        """Return (3,) float64: a percentile of the counts above black of R, G and B."""
        black, blocks = frame_black(self.mosaic), self.mosaic.block_planes()[:, :, ::2, ::2]
        positions = phases(self.mosaic)
        return np.array(
            [
                max(float(np.percentile(blocks[phase], percentile) - black[phase]) for phase in positions[channel])
                for channel in CHANNELS
            ]
        )


class Photographer:
    """Takes frames with the devices of the laboratory; never changes ISO speed or aperture."""

    def __init__(self, devices: Devices, settings: LabSettings, scratch: Path) -> None:
        self._devices = devices
        self._settings = settings
        self._file = scratch / "frame"
        self._shutter_s = settings.camera.shutter_s
        # For every frame, the shutter time, s, and the time from release to the end of the download, s.
        self.timings: list[tuple[float, float]] = []

    def capture(self, colour: Colour, shutter_s: float, into: BinaryIO) -> CapturedFrame:
        """Show a plain colour, take a frame of it, and write its file."""
        devices = self._devices
        self._set(shutter_s)
        devices.presenter.show(colour)
        devices.clock.sleep(self._settings.sequence.settle_s)
        started = devices.clock.monotonic()
        captured = capture(devices.camera, into)
        self.timings.append((shutter_s, devices.clock.monotonic() - started))
        return captured

    def take(self, colour: Colour, shutter_s: float | None = None) -> Shot:
        """Return a frame, by default at the shutter time of the settings; its file is deleted."""
        seconds = self._settings.camera.shutter_s if shutter_s is None else shutter_s
        with self._file.open("wb") as stream:
            size = self.capture(colour, seconds, stream).size
        mosaic = read_raw(self._file)
        self._file.unlink()
        return Shot(seconds, mosaic, size)

    def now(self) -> datetime:
        """Return the time of the clock of the laboratory."""
        return self._devices.clock.now()

    def restore(self) -> None:
        """Set the shutter time of the settings again."""
        self._set(self._settings.camera.shutter_s)

    def _set(self, shutter_s: float) -> None:
        if shutter_s != self._shutter_s:
            self._devices.camera.configure(replace(self._settings.camera.exposure, shutter_s=shutter_s))
            self._shutter_s = shutter_s


TARGET = 0.7  # Best level of white, as a share of saturation.

# Levels of white, as shares of saturation, at which no other time is proposed. Chosen by judgement, because brighter
# white clips after a drift of the lamp, and darker white makes dark patches noisier.
SUITABLE = (0.6, 0.8)

TRIALS = 8  # Maximum number of tried times. A step may be a factor of 16, so six usually suffice.

# Factor by which the exposure is increased to saturate the sensor. The weakest channel of white is at about a quarter
# of saturation in a good exposure.
LONGER = 8.0

LONGEST_S = 30.0  # Longest shutter time to try, s. Longer exposures have more hot photosites.

# A photosite is saturated if it has less than this share of the counts that a shorter exposure predicts. The prediction
# may be wrong by 8 %, because cameras report nominal shutter times (0.3 s for 0.315 s).
PROPORTIONAL = 0.9

# Counts above black below this share of the saturation level in the file cannot be saturation. They may be noise, and
# noise does not follow the exposure.
LEAST_RANGE = 0.25

_Array = npt.NDArray[np.float64]


# Saturation is measured, because the level in the file can be wrong: LibRaw states 15 831 for an EOS 550D that
# saturates at 13 584. Counts are proportional to exposure unless the photosite is saturated.
@dataclass(frozen=True)
class Saturation:
    """Saturation level of the sensor.

    - `counts`: saturation level, raw counts; the lowest of the four positions of the 2×2 block.
    - `measured`: whether a frame was saturated; if not, `counts` is the level in the file.
    - `stated`: saturation level in the file.
    """

    counts: float
    measured: bool
    stated: float

    def __str__(self) -> str:
        return f"{self.counts:.0f} counts, {'measured' if self.measured else 'from the file, not measured'}"


@dataclass(frozen=True)
class TriedTime:
    """A tried shutter time: white levels of R, G and B (shares of saturation), and whether white was clipped."""

    shutter_s: float
    level: tuple[float, float, float]
    clipped: bool

    @property
    def highest(self) -> float:
        """White level of the strongest channel."""
        return max(self.level)


def fitting_times(offered_s: Sequence[float], period_s: float | None) -> list[float]:
    """Return the offered times up to 30 s, in rising order; if the light has a period, only whole periods."""
    return [
        time
        for time in sorted(offered_s)
        if time <= LONGEST_S and (period_s is None or holds_whole_turns(time, period_s))
    ]


def measure_saturation(first: Shot, take: Callable[[float], Shot], times_s: Sequence[float]) -> Saturation:
    """Measure the saturation level with white frames of increasing shutter time.

    `take`: takes a frame of white at a shutter time, s.
    """
    stated_counts = float(first.mosaic.white_level)
    longer = first
    while True:
        longer_s = next((time for time in times_s if time >= LONGER * longer.shutter_s), max(times_s, default=0.0))
        if longer_s < 1.5 * first.shutter_s or longer_s <= longer.shutter_s:
            return Saturation(stated_counts, False, stated_counts)
        # Each frame is compared with the previous one, because the brightest counts of a dim first frame are noise.
        shorter, longer = longer, take(longer_s)
        saturated_counts = _saturated_levels(shorter, longer)
        if saturated_counts:
            return Saturation(min(saturated_counts), True, stated_counts)


def _saturated_levels(shorter: Shot, longer: Shot) -> list[float]:
    """Return the counts of all saturated positions of the 2×2 block in the longer frame."""
    shorter_counts, longer_counts = _paper_counts(shorter.mosaic), _paper_counts(longer.mosaic)
    black = frame_black(shorter.mosaic)
    expected = (shorter_counts - black) * longer.shutter_s / shorter.shutter_s
    least_counts = LEAST_RANGE * (shorter.mosaic.white_level - black)
    is_saturated = (longer_counts - black < PROPORTIONAL * expected) & (longer_counts - black > least_counts)
    return [float(value) for value in longer_counts[is_saturated]]


def _paper_counts(mosaic: Mosaic) -> _Array:
    """Return (2, 2) float64: raw counts of white paper at each position of the 2×2 block."""
    return np.asarray(np.percentile(mosaic.block_planes()[:, :, ::2, ::2], PAPER_PERCENTILE, axis=(2, 3)))


def measure_level(shot: Shot, saturation: Saturation, white: _Array | None = None) -> TriedTime:
    """Return the white level of a frame.

    `white`: (3,) float64 counts above black of the brightest paper; None if the chart was not detected. The brightest
    hundredth of the frame is used then.
    """
    black = frame_black(shot.mosaic)
    positions = phases(shot.mosaic)
    ranges = np.array([saturation.counts - np.mean([black[at] for at in positions[channel]]) for channel in CHANNELS])
    white = shot.brightest(99.0) if white is None else white
    red, green, blue = (white / ranges).tolist()
    return TriedTime(shot.shutter_s, (red, green, blue), max(red, green, blue) >= CLIPPING_SHARE)


def search(first: TriedTime, measure: Callable[[float], TriedTime], times_s: Sequence[float]) -> tuple[TriedTime, ...]:
    """Try shutter times until the best offered time has been tried; return all trials, including `first`.

    `measure`: takes a frame at a shutter time, s, and returns its white level.
    """
    trials = [first]
    while len(trials) < TRIALS:
        next_s = _next_time(trials, times_s)
        if next_s is None:
            break
        trials.append(measure(next_s))
    return tuple(trials)


def best_trial(trials: Sequence[TriedTime]) -> TriedTime:
    """Return the trial nearest to the target, or the shortest if all are clipped."""
    unclipped = [trial for trial in trials if not trial.clipped]
    if not unclipped:
        return min(trials, key=lambda trial: trial.shutter_s)
    suitable = [trial for trial in unclipped if _is_suitable(trial)]
    return min(suitable or unclipped, key=lambda trial: abs(math.log(max(trial.highest, 1e-6) / TARGET)))


def _next_time(trials: Sequence[TriedTime], times_s: Sequence[float]) -> float | None:
    tried_s = {trial.shutter_s for trial in trials}
    unclipped = [trial for trial in trials if not trial.clipped]
    if not unclipped:
        shortest = min(tried_s)
        much_shorter = [time for time in times_s if time <= shortest / 4]
        next_s = much_shorter[-1] if much_shorter else next((time for time in times_s if time < shortest), None)
        return None if next_s in tried_s else next_s
    brightest = max(unclipped, key=lambda trial: trial.highest)
    # The time changes by at most a factor of 16, because the level of a very dark frame is inaccurate.
    gain = min(TARGET / max(brightest.highest, 1e-6), 16.0)
    ceiling = min((trial.shutter_s for trial in trials if trial.clipped), default=math.inf)
    low, high = SUITABLE
    shorter = [time for time in times_s if time < ceiling]
    target_s = brightest.shutter_s * gain
    suitable = [time for time in shorter if low <= brightest.highest * time / brightest.shutter_s <= high]
    next_s = min(suitable or shorter, key=lambda time: abs(math.log(time / target_s)), default=None)
    if next_s is None or next_s in tried_s:
        return None
    predicted = brightest.highest * next_s / brightest.shutter_s
    if low <= brightest.highest <= high and abs(math.log(predicted / TARGET)) > abs(
        math.log(brightest.highest / TARGET)
    ):
        return None
    return next_s


def judge_exposure(
    trials: Sequence[TriedTime],
    saturation: Saturation,
    times_s: Sequence[float],
    period_s: float | None,
) -> Finding:
    """Judge the exposure of the settings, which is the first trial.

    `period_s`: period of the light, s; None if the light is steady.
    """
    first, best = trials[0], best_trial(trials)
    channel = CHANNELS[int(np.argmax(first.level))]
    level = "saturates" if first.clipped else f"is at {format_value(first.highest, 'share')} of saturation"
    measurement = f"white {level} ({saturation}) in {channel} at {first.shutter_s:.4g} s"
    details = {
        "shutter_s": first.shutter_s,
        "level": list(first.level),
        "saturation_counts": saturation.counts,
        "saturation_measured": saturation.measured,
        "saturation_stated": saturation.stated,
        "trials": [[trial.shutter_s, trial.highest, trial.clipped] for trial in trials],
    }
    if not times_s:
        remedy = "the camera lists no shutter times: set another camera.shutter_s and repeat the check"
    elif _is_suitable(best):
        remedy = f"set camera.shutter_s = {best.shutter_s:.4g} (measured: {format_value(best.highest, 'share')})"
        details["proposed_shutter_s"] = best.shutter_s
    else:
        remedy = _remedy_if_no_time_fits(best, period_s)
    finding = judge_value(BRIGHTEST_SHARE, 1.0 if first.clipped else first.highest, measurement, remedy, details)
    if finding.grade != "good":
        return finding
    if not _is_suitable(first):
        reason = (
            f"{100 * SUITABLE[0]:.0f} to {100 * SUITABLE[1]:.0f} % expected: above, patches clip; below, noise grows"
        )
        return replace(finding, grade="remark", reason=reason, remedy=remedy)
    if not saturation.measured:
        reason = "no frame saturated the sensor, so that the saturation level of the file was used"
        return replace(finding, grade="remark", reason=reason, remedy="make the projector brighter if possible")
    return finding


def _is_suitable(trial: TriedTime) -> bool:
    return SUITABLE[0] <= trial.highest <= SUITABLE[1] and not trial.clipped


def _remedy_if_no_time_fits(best: TriedTime, period_s: float | None) -> str:
    turns = f" and that is a multiple of {format_value(period_s, 's')}" if period_s else ""
    nearest = (
        f"even the shortest, {best.shutter_s:.4g} s, saturates"
        if best.clipped
        else f"the nearest, camera.shutter_s = {best.shutter_s:.4g}, gives {format_value(best.highest, 'share')}"
    )
    is_bright = best.clipped or best.highest > TARGET
    aperture, speed = ("higher", "lower") if is_bright else ("lower", "higher")
    return (
        f"no shutter time that the camera offers{turns} reaches this level, {nearest}: set a {aperture} f-number or a "
        f"{speed} ISO speed, or {'dim the projector' if is_bright else 'use a brighter projector'}"
    )
