"""The exposure that suits: where the sensor saturates, and the shutter time at which white is bright and not clipped.

- Saturation is measured, not looked up: exposed longer, a photosite that is not saturated counts in proportion more,
  one that is does not. LibRaw states 15 831 for an EOS 550D that saturates at 13 584.
- The search goes by measurement as well: each shutter time that is proposed has been tried.
- Trial frames are taken at the shutter time of the settings, or, if white is clipped or dark at that, at the best one
  that was found.
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

from acquisition.check.findings import Finding, judged
from acquisition.run.devices import Devices, holds_whole_turns
from calibration.figures.figure import format_value
from calibration.figures.truth import BRIGHTEST_SHARE
from drivers.camera import CapturedFrame, capture
from drivers.presenter import Colour
from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, PAPER_PERCENTILE, Mosaic, frame_black, phases, read_raw
from experiment.config import LabSettings


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame: the shutter time that was set, seconds, its counts, and the bytes of its file."""

    shutter_s: float
    mosaic: Mosaic
    size: int

    def brightest(self, percentile: float) -> npt.NDArray[np.float64]:
        """Return (3,) float64: counts above black of R, G and B at a percentile of their photosites."""
        black, blocks = frame_black(self.mosaic), self.mosaic.block_planes()[:, :, ::2, ::2]
        found = phases(self.mosaic)
        return np.array(
            [
                max(float(np.percentile(blocks[place], percentile) - black[place]) for place in found[channel])
                for channel in CHANNELS
            ]
        )


class Photographer:
    """Takes frames with the devices of a rig; ISO speed and aperture of the settings are never changed."""

    def __init__(self, devices: Devices, settings: LabSettings, scratch: Path) -> None:
        self._devices = devices
        self._settings = settings
        self._file = scratch / "frame"
        self._shutter_s = settings.camera.shutter_s
        self.timings: list[tuple[float, float]] = []
        """Of every frame taken: shutter time and the time until its file was here, seconds."""

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
        """Return a frame, at the shutter time of the settings if no other is given; its file is not kept."""
        seconds = self._settings.camera.shutter_s if shutter_s is None else shutter_s
        with self._file.open("wb") as stream:
            size = self.capture(colour, seconds, stream).size
        mosaic = read_raw(self._file)
        self._file.unlink()
        return Shot(seconds, mosaic, size)

    def now(self) -> datetime:
        """Return the time of the clock by which frames are taken."""
        return self._devices.clock.now()

    def restore(self) -> None:
        """Set the shutter time of the settings again."""
        self._set(self._settings.camera.shutter_s)

    def _set(self, shutter_s: float) -> None:
        if shutter_s != self._shutter_s:
            self._devices.camera.configure(replace(self._settings.camera.exposure, shutter_s=shutter_s))
            self._shutter_s = shutter_s


TARGET = 0.7  # White as a share of saturation that is looked for

# White's share of saturation at which no other time is suggested (judgement): above, brighter places and the lamp's
# drift clip; below, each stop doubles the noise of dark cells.
SUITABLE = (0.6, 0.8)

TRIALS = 8  # Shutter times that are tried at most: from any time to any other are five steps of 16 and a last one

# How much longer a frame is exposed to see the sensor saturate: white's weakest channel has a third of the strongest,
# and a good exposure is at 0.7.
LONGER = 8.0

LONGEST_S = 30.0  # No longer time is tried: the wait, and hot photosites

# Of the counts that a longer time should give; what counts less is saturated. Times are stated as engraved, 0.3 s for
# 0.315 s, which makes a ratio of two wrong by 8 % at most.
PROPORTIONAL = 0.9

# Share of the stated range from which on counts may be saturation: noise in the dark is not proportional either.
LEAST_RANGE = 0.25

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Saturation:
    """Where the sensor saturates.

    - `counts`: raw count, the lowest of the positions of the 2×2 block.
    - `measured`: whether a frame showed it; else it is what the file states.
    - `stated`: what the file states.
    """

    counts: float
    measured: bool
    stated: float

    def __str__(self) -> str:
        """Return "13584 counts, measured"."""
        return f"{self.counts:.0f} counts, {'measured' if self.measured else 'as the file states, not measured'}"


@dataclass(frozen=True)
class TriedTime:
    """A shutter time that was tried: white's share of saturation in R, G and B, and whether it overflowed."""

    shutter_s: float
    level: tuple[float, float, float]
    clipped: bool

    @property
    def highest(self) -> float:
        """White in the strongest channel."""
        return max(self.level)


def fitting_times(offered_s: Sequence[float], period_s: float | None) -> list[float]:
    """Return those of the offered times, rising, that hold whole periods of the light, if it has one, up to 30 s."""
    return [
        time
        for time in sorted(offered_s)
        if time <= LONGEST_S and (period_s is None or holds_whole_turns(time, period_s))
    ]


def measure_saturation(first: Shot, take: Callable[[float], Shot], times_s: Sequence[float]) -> Saturation:
    """Return where the sensor saturates, by frames of white exposed longer and longer.

    `take`: takes a frame of white at a shutter time, seconds.
    """
    stated = float(first.mosaic.white_level)
    longer = first
    while True:
        longer_s = next((time for time in times_s if time >= LONGER * longer.shutter_s), max(times_s, default=0.0))
        if longer_s < 1.5 * first.shutter_s or longer_s <= longer.shutter_s:
            return Saturation(stated, False, stated)
        # Against the frame before: in a dim first one the brightest hundredths are noise.
        before, longer = longer, take(longer_s)
        found = _plateaus(before, longer)
        if found:
            return Saturation(min(found), True, stated)


def _plateaus(shorter: Shot, longer: Shot) -> list[float]:
    """Return the counts at which positions of the block saturate in the longer of two frames; none where none does."""
    before, after = _paper_counts(shorter.mosaic), _paper_counts(longer.mosaic)
    black = frame_black(shorter.mosaic)
    expected = (before - black) * longer.shutter_s / shorter.shutter_s
    enough = LEAST_RANGE * (shorter.mosaic.white_level - black)
    full = (after - black < PROPORTIONAL * expected) & (after - black > enough)
    return [float(value) for value in after[full]]


def _paper_counts(mosaic: Mosaic) -> _Array:
    """Return (2, 2) float64: the raw counts of bare paper at each position of the block."""
    return np.asarray(np.percentile(mosaic.block_planes()[:, :, ::2, ::2], PAPER_PERCENTILE, axis=(2, 3)))


def level_of(shot: Shot, saturation: Saturation, white: _Array | None = None) -> TriedTime:
    """Return how bright white is in a frame.

    `white`: (3,) float64 counts above black of the brightest paper; None where the chart's place is not known: then the
    brightest hundredth of the frame stands for it.
    """
    black = frame_black(shot.mosaic)
    found = phases(shot.mosaic)
    ranges = np.array([saturation.counts - np.mean([black[place] for place in found[channel]]) for channel in CHANNELS])
    white = shot.brightest(99.0) if white is None else white
    red, green, blue = (white / ranges).tolist()
    return TriedTime(shot.shutter_s, (red, green, blue), max(red, green, blue) >= CLIPPING_SHARE)


def search(first: TriedTime, measure: Callable[[float], TriedTime], times_s: Sequence[float]) -> tuple[TriedTime, ...]:
    """Return the times that were tried until the best of those offered was among them; the first is `first`.

    `measure`: takes a frame at a shutter time, seconds, and says how bright white is.
    """
    trials = [first]
    while len(trials) < TRIALS:
        wanted = _next_time(trials, times_s)
        if wanted is None:
            break
        trials.append(measure(wanted))
    return tuple(trials)


def best_of(trials: Sequence[TriedTime]) -> TriedTime:
    """Return the trial nearest to the target: the darkest where all overflow."""
    whole = [trial for trial in trials if not trial.clipped]
    if not whole:
        return min(trials, key=lambda trial: trial.shutter_s)
    inside = [trial for trial in whole if _is_suitable(trial)]
    return min(inside or whole, key=lambda trial: abs(math.log(max(trial.highest, 1e-6) / TARGET)))


def _next_time(trials: Sequence[TriedTime], times_s: Sequence[float]) -> float | None:
    tried = {trial.shutter_s for trial in trials}
    whole = [trial for trial in trials if not trial.clipped]
    if not whole:
        shortest = min(tried)
        below = [time for time in times_s if time <= shortest / 4]
        wanted = below[-1] if below else next((time for time in times_s if time < shortest), None)
        return None if wanted in tried else wanted
    brightest = max(whole, key=lambda trial: trial.highest)
    # Too dark a frame tells little more than that it is dark.
    gain = min(TARGET / max(brightest.highest, 1e-6), 16.0)
    ceiling = min((trial.shutter_s for trial in trials if trial.clipped), default=math.inf)
    low, high = SUITABLE
    able = [time for time in times_s if time < ceiling]
    target_s = brightest.shutter_s * gain
    suited = [time for time in able if low <= brightest.highest * time / brightest.shutter_s <= high]
    wanted = min(suited or able, key=lambda time: abs(math.log(time / target_s)), default=None)
    if wanted is None or wanted in tried:
        return None
    predicted = brightest.highest * wanted / brightest.shutter_s
    if low <= brightest.highest <= high and abs(math.log(predicted / TARGET)) > abs(
        math.log(brightest.highest / TARGET)
    ):
        return None
    return wanted


def judge_exposure(
    trials: Sequence[TriedTime],
    saturation: Saturation,
    times_s: Sequence[float],
    period_s: float | None,
) -> Finding:
    """Return the finding on the exposure of the settings, which is that of the first trial.

    `period_s`: after which the light repeats, seconds; None where it is steady.
    """
    first, best = trials[0], best_of(trials)
    channel = CHANNELS[int(np.argmax(first.level))]
    seen = "saturates" if first.clipped else f"is at {format_value(first.highest, 'share')} of saturation"
    said = f"white {seen} ({saturation}) in {channel} at {first.shutter_s:.4g} s"
    details = {
        "shutter_s": first.shutter_s,
        "level": list(first.level),
        "saturation_counts": saturation.counts,
        "saturation_measured": saturation.measured,
        "saturation_stated": saturation.stated,
        "trials": [[trial.shutter_s, trial.highest, trial.clipped] for trial in trials],
    }
    if not times_s:
        remedy = "the camera lists no shutter times; set another camera.shutter_s and check again"
    elif _is_suitable(best):
        remedy = f"set camera.shutter_s = {best.shutter_s:.4g} (tried: {format_value(best.highest, 'share')})"
        details["proposed_shutter_s"] = best.shutter_s
    else:
        remedy = _no_time(best, period_s)
    found = judged(BRIGHTEST_SHARE, 1.0 if first.clipped else first.highest, said, remedy, details)
    if found.grade != "good":
        return found
    if not _is_suitable(first):
        why = (
            f"{100 * SUITABLE[0]:.0f} to {100 * SUITABLE[1]:.0f} % suits: above, other places clip; below, noise grows"
        )
        return replace(found, grade="remark", reason=why, remedy=remedy)
    if not saturation.measured:
        why = "no frame saturates the sensor: the share is of what the file states"
        return replace(found, grade="remark", reason=why, remedy="brighten the light if you can")
    return found


def _is_suitable(trial: TriedTime) -> bool:
    return SUITABLE[0] <= trial.highest <= SUITABLE[1] and not trial.clipped


def _no_time(best: TriedTime, period_s: float | None) -> str:
    turns = f" and holds whole turns of {format_value(period_s, 's')}" if period_s else ""
    nearest = (
        f"even the shortest, {best.shutter_s:.4g} s, saturates"
        if best.clipped
        else f"the nearest, camera.shutter_s = {best.shutter_s:.4g}, gives {format_value(best.highest, 'share')}"
    )
    bright = best.clipped or best.highest > TARGET
    aperture, speed = ("higher", "lower") if bright else ("lower", "higher")
    return (
        f"no shutter time that the camera offers{turns} leads there, {nearest}: set a {aperture} f-number or a {speed} "
        f"ISO speed{', or dim the projector' if bright else ', or a brighter projector'}"
    )
