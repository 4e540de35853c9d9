"""What a check looks at: frames taken, the chart found, what white shows of it; nothing of it is judged here.

The frames that the other verdicts rest on are taken at the shutter time of the settings, or, where white is clipped or
dark at that, at the best one that was found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from acquisition.check.exposure import (
    USABLE,
    Saturation,
    Trial,
    best_of,
    fitting_times,
    level_of,
    measure_saturation,
    search,
)
from acquisition.check.light import SmoothLight, measure_light
from acquisition.check.optics import BlurMap, measure_blur
from acquisition.check.places import ChartMap, Levels, levels, place_chart, window_px
from acquisition.check.print_state import PrintState, measure_print
from acquisition.check.sensor import Transfer, fit_transfer, pair_noise, series_times
from acquisition.check.taking import Photographer, Shot
from drivers.presenter import BLACK, WHITE, Colour
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.framing.field import Corners
from experiment.framing.finding import Framing, find_chart
from experiment.framing.planes import frame_black
from experiment.measures.sensor import saturation as shown_saturation
from foundation.errors import DeviceError, RegistrationError

REPEATS = 6
"""Frames of white whose spread is the light's flicker, and whose mean shows the print: five freedoms state a standard
deviation to a third, and one that is four times the limit passes as tolerable in one of 400 checks."""

PRIMARIES = {"red": Colour(255, 0, 0), "green": Colour(0, 255, 0), "blue": Colour(0, 0, 255)}
"""The projector's primaries in full: no light of a plan has more of a code."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlacedChart:
    """The chart in the frames of a check, which all have it in one place.

    - `framing`: where it was found.
    - `place`: the map from the print to the frames.
    - `window`: side of the windows that patches are read in, px.
    """

    framing: Framing
    place: ChartMap
    window: int


@dataclass(frozen=True, eq=False)
class Series:
    """Pairs of white frames at rising shutter times: `seen` (K, P, 3) shares of saturation, and the noise of pairs."""

    times_s: tuple[float, ...]
    seen: _Array
    transfer: Transfer


@dataclass(frozen=True, eq=False)
class CheckFrames:
    """What a check looked at.

    - `first`: white at the shutter time of the settings.
    - `trials`: shutter times tried, that of the settings first.
    - `times_s`: those that can be used.
    - `saturation`: the sensor's.
    - `chart`: where the chart is; None where it was not found.
    - `trouble`: why not.
    - `whites`: frames of white at `used_s`; one of a recording.
    - `dark`: A frame of black there.
    - `muted`: the same with the projector muted; None where it could not be.
    - `why_not_muted`: why not.
    - `primaries`: levels of paper, (3,) counts above black, under "white", "red", "green", "blue" and "black"; None of
      a recording.
    - `series`: exposures for linearity; None where not asked for.
    - `focal_px`: the focal length that files state, half-size px.
    """

    first: Shot
    trials: tuple[Trial, ...]
    times_s: tuple[float, ...]
    saturation: Saturation
    chart: PlacedChart | None
    trouble: str
    whites: tuple[Shot, ...]
    dark: Shot
    muted: Shot | None
    why_not_muted: str
    primaries: dict[str, _Array] | None
    series: Series | None
    focal_px: float | None

    @property
    def usable(self) -> bool:
        """Whether white is not clipped in the frames that the verdicts rest on."""
        return not next(trial for trial in self.trials if trial.shutter_s == self.used_s).clipped

    @property
    def used_s(self) -> float:
        """The shutter time of the frames that the verdicts rest on."""
        return self.whites[0].shutter_s


class _Look:
    """The chart and where it was found, as frames come."""

    def __init__(self, chart: Chart, corners: Corners | None) -> None:
        self.chart = chart
        self._corners = corners
        self.placed: PlacedChart | None = None
        self.trouble = ""

    def find(self, shot: Shot) -> None:
        """Find the chart in a frame, if it was not found in one before."""
        if self.placed is not None:
            return
        try:
            framing = find_chart(shot.mosaic, self.chart, "the white frame", self._corners)
        except RegistrationError as error:
            self.trouble = str(error)
            return
        place = place_chart(framing, self.chart)
        self.placed = PlacedChart(framing, place, window_px(self.chart, place))

    def level(self, shot: Shot, saturation: Saturation) -> Trial:
        """Return how bright white is in a frame."""
        return level_of(shot, saturation, self.brightest_paper(shot, saturation))

    def brightest_paper(self, shot: Shot, saturation: Saturation) -> _Array | None:
        """Return (3,) counts of the brightest white references; None where there are none, or the chart is unknown."""
        whites = [reference.centre_mm for reference in self.chart.white_references]
        if self.placed is None or not whites:
            return None
        seen = levels(shot.mosaic, self.placed.place, whites, self.placed.window, saturation.counts).mean
        known = seen[np.isfinite(seen).all(axis=1)]
        return np.percentile(known, 98, axis=0) if len(known) else None

    def paper(self, shot: Shot, saturation: Saturation) -> _Array:
        """Return (3,) counts of the chart's patches, their mean, or of a frame's brightest places without a chart."""
        if self.placed is None:
            return shot.brightest(99.0)
        points = points_of(self.chart)
        seen = levels(shot.mosaic, self.placed.place, points, self.placed.window, saturation.counts).mean
        return np.nanmean(seen, axis=0)


def look(
    camera: Photographer,
    settings: LabSettings,
    chart: Chart,
    offered_s: tuple[float, ...],
    period_s: float,
    corners: Corners | None,
    linearity: bool,
    announce: Callable[[str], None],
) -> CheckFrames:
    """Take the frames of a check and find the chart in them."""
    first = camera.take(WHITE)
    found = _Look(chart, corners)
    if settings.rig == "replay":
        found.find(first)
        return _recorded(camera, first, found)
    # A time that the body does not list was taken all the same, so it counts among them.
    times = fitting_times(sorted({*offered_s, settings.camera.shutter_s}) if offered_s else (), period_s)
    announce("measuring the sensor's saturation: frames of white, longer and longer")
    saturation = measure_saturation(first, lambda seconds: camera.take(WHITE, seconds), times)
    if not found.level(first, saturation).clipped:
        found.find(first)
    shots: dict[float, Shot] = {}

    def measure(seconds: float) -> Trial:
        shot = camera.take(WHITE, seconds)
        shots.clear()
        shots[seconds] = shot
        return found.level(shot, saturation)

    trials = search(found.level(first, saturation), measure, times)
    best = best_of(trials)
    if found.placed is None and best.shutter_s != first.shutter_s:
        shot = shots.get(best.shutter_s) or camera.take(WHITE, best.shutter_s)
        found.find(shot)
        if found.placed is not None:
            # Until now the brightest places of the frame stood for paper.
            again = search(found.level(shot, saturation), measure, times)
            trials = (found.level(first, saturation), *again)
            best = best_of(trials)
    usable = USABLE[0] <= trials[0].highest <= USABLE[1] and not trials[0].clipped
    used_s = first.shutter_s if usable else best.shutter_s
    whites = tuple(camera.take(WHITE, used_s) for _ in range(REPEATS))
    dark = camera.take(BLACK, used_s)
    primaries = {
        "white": np.mean([found.paper(shot, saturation) for shot in whites], axis=0),
        "black": found.paper(dark, saturation),
        **{name: found.paper(camera.take(colour, used_s), saturation) for name, colour in PRIMARIES.items()},
    }
    series = None
    if linearity and found.placed is not None:
        announce("taking a series of exposures for linearity")
        series = _series(camera, found.placed, chart, saturation, series_times(times, best.shutter_s, best.highest))
    # Last, for a projector that stays muted spoils what comes after.
    muted, why_not = _muted(camera, used_s)
    focal_px = camera.focal_px
    camera.restore()
    return CheckFrames(
        first, trials, tuple(times), saturation, found.placed, found.trouble, whites, dark, muted, why_not, primaries,
        series, focal_px,
    )  # fmt: skip


def _recorded(camera: Photographer, first: Shot, found: _Look) -> CheckFrames:
    """Return what a recording shows: one white frame and one dark one, as they were exposed."""
    dark = camera.take(BLACK)
    stated = float(first.mosaic.white_level)
    counts = float(shown_saturation(first.mosaic))
    saturation = Saturation(counts, counts < stated, stated)
    why = "a recording has no picture to mute"
    trials = (found.level(first, saturation),)
    return CheckFrames(
        first, trials, (), saturation, found.placed, found.trouble, (first,), dark, None, why, None, None,
        camera.focal_px,
    )  # fmt: skip


def _muted(camera: Photographer, shutter_s: float) -> tuple[Shot | None, str]:
    """Return a frame of black with the picture muted; or None, and why there is none."""
    try:
        with camera.muted():
            return camera.take(BLACK, shutter_s), ""
    except DeviceError as error:
        return None, str(error)


def _series(
    camera: Photographer, placed: PlacedChart, chart: Chart, saturation: Saturation, times_s: list[float]
) -> Series:
    points = points_of(chart)
    seen: list[_Array] = []
    noise: list[tuple[_Array, _Array]] = []
    black = 0.0
    for seconds in times_s:
        pair = [camera.take(WHITE, seconds) for _ in range(2)]
        both = [levels(shot.mosaic, placed.place, points, placed.window, saturation.counts) for shot in pair]
        black = float(frame_black(pair[0].mosaic).mean())
        mean = (both[0].mean + both[1].mean) / 2
        clipped = both[0].clipped | both[1].clipped
        mean[clipped] = np.nan
        seen.append(mean)
        level, variance = pair_noise(pair[0].mosaic, pair[1].mosaic, placed.place, points)
        level[clipped] = np.nan
        noise.append((level, variance))
    if not seen:
        return Series((), np.zeros((0, len(points), 3)), fit_transfer(np.zeros((0, 3)), np.zeros((0, 3))))
    top = saturation.counts - black
    transfer = fit_transfer(*(np.concatenate(part) for part in zip(*noise, strict=True)))
    return Series(tuple(times_s), np.stack(seen) / top, transfer)


def points_of(chart: Chart) -> _Array:
    """Return the middles (N, 2) mm of a chart's cells, then of its references."""
    return np.concatenate(
        [chart.centres_mm, np.array([each.centre_mm for each in chart.references], dtype=np.float64).reshape(-1, 2)]
    )


def mean_levels(shots: tuple[Shot, ...], placed: PlacedChart, points_mm: _Array, saturation: float) -> Levels:
    """Return what patches about points (N, 2) float64 mm show in the mean of frames; clipped where they are in one."""
    each = [levels(shot.mosaic, placed.place, points_mm, placed.window, saturation) for shot in shots]
    first = each[0]
    clipped = np.any([one.clipped for one in each], axis=0)
    return replace(first, mean=np.mean([one.mean for one in each], axis=0), clipped=clipped)


@dataclass(frozen=True, eq=False)
class ChartFigures:
    """What was measured of the chart, where it was found.

    - `placed`: where it is.
    - `blur`: its sharpness from place to place.
    - `cells`, `references`: what white shows of it, in the chart's order.
    - `light`: the light on it; None where it has too few white references.
    - `state`: stains on it; None likewise.
    """

    placed: PlacedChart
    blur: BlurMap
    cells: Levels
    references: Levels
    light: SmoothLight | None
    state: PrintState | None


def measure_chart(seen: CheckFrames, placed: PlacedChart, chart: Chart) -> ChartFigures:
    """Return what the white frames show of the chart."""
    levels = mean_levels(seen.whites, placed, points_of(chart), seen.saturation.counts)
    count = len(chart.centres_mm)
    cells, references = (Levels(levels.mean[part], levels.clipped[part]) for part in (slice(count), slice(count, None)))
    light = measure_light(chart, references)
    state = None if light is None else measure_print(chart, cells, references, light)
    return ChartFigures(placed, measure_blur(placed.framing), cells, references, light, state)
