"""What a check looks at: frames taken and thrown away, the exposure that suits, the chart found, what white shows.

- Saturation is measured, not looked up: exposed longer, a photosite that is not saturated counts in proportion more,
  one that is does not. LibRaw states 15 831 for an EOS 550D that saturates at 13 584.
- The search goes by measurement as well: each shutter time that is proposed has been tried.
- The frames that the other verdicts rest on are taken at the shutter time of the settings, or, where white is clipped
  or dark at that, at the best one that was found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.check.camera import BlurMap, Transfer, fit_transfer, measure_blur, pair_noise, series_times
from acquisition.check.findings import LIMITS, Finding, Grade, amount, judged, percent
from acquisition.check.light_and_print import PrintState, SmoothLight, measure_light, measure_print
from acquisition.check.places import ChartMap, Levels, levels, place_chart, window_px
from acquisition.run.devices import Devices, holds_whole_turns
from drivers.camera import capture
from drivers.presenter import BLACK, WHITE, Colour
from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, PAPER_PERCENTILE, Mosaic, frame_black, phases, read_raw
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.framing.field import Corners
from experiment.framing.finding import Framing, find_chart
from foundation.errors import DeviceError, RegistrationError


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
    """Takes frames with the devices of a rig; each is read and its file deleted.

    `settings`: the lab's; ISO speed and aperture are never changed.
    """

    def __init__(self, devices: Devices, settings: LabSettings, scratch: Path) -> None:
        self._devices = devices
        self._settings = settings
        self._file = scratch / "frame"
        self._shutter_s = settings.camera.shutter_s
        self.timings: list[tuple[float, float]] = []
        """Of every frame taken: shutter time and the time until its file was here, seconds."""
        self.focal_px: float | None = None
        """Focal length in half-size px, as the last frame's file states it; None where it does not."""

    def take(self, colour: Colour, shutter_s: float | None = None) -> Shot:
        """Return a frame of a plain colour, at the shutter time of the settings unless another is given."""
        devices, settings = self._devices, self._settings
        wanted = settings.camera.shutter_s if shutter_s is None else shutter_s
        self._set(wanted)
        devices.presenter.show(colour)
        devices.clock.sleep(settings.sequence.settle_s)
        begun = devices.clock.monotonic()
        with self._file.open("wb") as stream:
            size = capture(devices.camera, stream).size
        self.timings.append((wanted, devices.clock.monotonic() - begun))
        mosaic = read_raw(self._file)
        self.focal_px = stated_focal_px(self._file, mosaic.counts.shape[1])
        self._file.unlink()
        return Shot(wanted, mosaic, size)

    def restore(self) -> None:
        """Set the shutter time of the settings again."""
        self._set(self._settings.camera.shutter_s)

    def _set(self, shutter_s: float) -> None:
        if shutter_s != self._shutter_s:
            self._devices.camera.configure(replace(self._settings.camera.exposure, shutter_s=shutter_s))
            self._shutter_s = shutter_s

    @contextmanager
    def muted(self) -> Generator[None]:
        """Blank the projector's picture meanwhile."""
        projector = self._devices.projector
        if projector is None:
            raise DeviceError("the projector is not under control (lab.projector.control)")
        projector.set_muted(True)
        try:
            if not projector.muted():
                raise DeviceError("the projector does not mute its picture")
            yield
        finally:
            projector.set_muted(False)


def stated_focal_px(path: Path, columns: int) -> float | None:
    """Return the focal length in half-size px that a raw file of `columns` columns states; None where it states none.

    Exif 2.32: FocalLength in mm times FocalPlaneXResolution in pixels to the unit of FocalPlaneResolutionUnit, pixels
    of a picture of the size that Exif states, which is taken to be the visible one to a hundredth.
    """
    from drivers.tiff import TiffDamaged, TiffTag, is_tiff, read_directories
    from foundation.files import read_whole

    data = read_whole(path)
    if not is_tiff(data):
        return None
    try:
        directories = read_directories(data)
    except TiffDamaged:
        return None
    for directory in directories:
        focal, density = (directory.numbers(tag) for tag in (TiffTag.FOCAL_LENGTH, TiffTag.FOCAL_PLANE_X_RESOLUTION))
        unit = (directory.integers(TiffTag.FOCAL_PLANE_RESOLUTION_UNIT) or (2,))[0]
        mm = {2: 25.4, 3: 10.0, 4: 1.0}.get(unit)
        if focal and density and mm and focal[0] > 0 and density[0] > 0:
            pixels = focal[0] * density[0] / mm
            # A lens without contacts states 50 mm or 0; no picture is narrower than a twentieth of its focal length.
            return pixels / 2 if 0.1 * columns < pixels < 20 * columns else None
    return None


TARGET = 0.7
"""White as a share of saturation that is looked for: the middle of what is good."""

TRIALS = 8
"""Shutter times that are tried at most: from any time to any other are five steps of 16 and a last one."""

LONGER = 8.0
"""How much longer a frame is exposed to see the sensor saturate: white's weakest channel has a third of the strongest,
and a good exposure is at 0.7."""

LONGEST_S = 30.0
"""No longer time is tried: the wait, and hot photosites."""

PROPORTIONAL = 0.9
"""Of the counts that a longer time should give; what counts less is saturated. Times are stated as engraved, 0.3 s for
0.315 s, which makes a ratio of two wrong by 8 % at most."""

LEAST_RANGE = 0.25
"""Share of the stated range from which on counts may be saturation: noise in the dark is not proportional either."""

USABLE = (0.3, 0.9)
"""White's share of saturation at which what is not the exposure's matter is judged well enough; else it is judged at a
better time."""

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
class Trial:
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


def level_of(shot: Shot, saturation: Saturation, white: _Array | None = None) -> Trial:
    """Return how bright white is in a frame.

    `white`: (3,) float64 counts above black of the brightest paper; None where the chart's place is not known: then the
    brightest hundredth of the frame stands for it.
    """
    black = frame_black(shot.mosaic)
    found = phases(shot.mosaic)
    ranges = np.array([saturation.counts - np.mean([black[place] for place in found[channel]]) for channel in CHANNELS])
    white = shot.brightest(99.0) if white is None else white
    red, green, blue = (white / ranges).tolist()
    return Trial(shot.shutter_s, (red, green, blue), max(red, green, blue) >= CLIPPING_SHARE)


def search(first: Trial, measure: Callable[[float], Trial], times_s: Sequence[float]) -> tuple[Trial, ...]:
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


def best_of(trials: Sequence[Trial]) -> Trial:
    """Return the trial nearest to the target: the darkest where all overflow."""
    whole = [trial for trial in trials if not trial.clipped]
    if not whole:
        return min(trials, key=lambda trial: trial.shutter_s)
    inside = [trial for trial in whole if LIMITS["exposure"].grade(trial.highest) == "good"]
    return min(inside or whole, key=lambda trial: abs(math.log(max(trial.highest, 1e-6) / TARGET)))


def _next_time(trials: Sequence[Trial], times_s: Sequence[float]) -> float | None:
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
    low, high = LIMITS["exposure"].good
    assert low is not None
    assert high is not None
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
    trials: Sequence[Trial], saturation: Saturation, times_s: Sequence[float], period_s: float | None, recorded: bool
) -> Finding:
    """Return the finding on the exposure of the settings, which is that of the first trial.

    `period_s`: after which the light repeats, seconds; None where it is steady.
    """
    first, best = trials[0], best_of(trials)
    channel = CHANNELS[int(np.argmax(first.level))]
    seen = "saturates" if first.clipped else f"is at {percent(first.highest)} of saturation"
    said = f"white {seen} ({saturation}) in {channel} at {first.shutter_s:.4g} s"
    details = {
        "shutter_s": first.shutter_s,
        "level": list(first.level),
        "saturation_counts": saturation.counts,
        "saturation_measured": saturation.measured,
        "saturation_stated": saturation.stated,
        "trials": [[trial.shutter_s, trial.highest, trial.clipped] for trial in trials],
    }
    if recorded:
        remedy = "a recording cannot be exposed anew; take another session"
    elif not times_s:
        remedy = "the camera lists no shutter times; set another camera.shutter_s and check again"
    elif LIMITS["exposure"].grade(best.highest) == "good" and not best.clipped:
        remedy = f"set camera.shutter_s = {best.shutter_s:.4g} (tried: {percent(best.highest)})"
        details["proposed_shutter_s"] = best.shutter_s
    else:
        remedy = _no_time(best, period_s)
    found = judged(LIMITS["exposure"], 1.0 if first.clipped else first.highest, said, remedy, details)
    if found.grade == "good" and not saturation.measured:
        grade: Grade = "remark"
        why = "nothing that was tried saturates the sensor, so that the share is of what the file states"
        return replace(found, grade=grade, reason=why, remedy="" if recorded else "brighten the light if you can")
    return found


def _no_time(best: Trial, period_s: float | None) -> str:
    turns = f" and holds whole turns of {amount(period_s, 's')}" if period_s else ""
    nearest = (
        f"even the shortest, {best.shutter_s:.4g} s, saturates"
        if best.clipped
        else f"the nearest, camera.shutter_s = {best.shutter_s:.4g}, gives {percent(best.highest)}"
    )
    bright = best.clipped or best.highest > TARGET
    aperture, speed = ("higher", "lower") if bright else ("lower", "higher")
    return (
        f"no shutter time that the camera offers{turns} leads there, {nearest}: set a {aperture} f-number or a {speed} "
        f"ISO speed{', or dim the projector' if bright else ', or a brighter projector'}"
    )


REPEATS = 6
"""Frames of white whose spread is the light's flicker, and whose mean shows the print: five freedoms state a standard
deviation to a third, and one that is four times the limit passes as tolerable in one of 400 checks."""

PRIMARIES = {"red": Colour(255, 0, 0), "green": Colour(0, 255, 0), "blue": Colour(0, 0, 255)}
"""The projector's primaries in full: no light of a plan has more of a code."""


@dataclass(frozen=True, eq=False)
class PlacedChart:
    """The chart in the frames of a check, which all have it in one place; `window`: side, px, that patches have."""

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
    - `trials`, `times_s`: shutter times tried, that of the settings first, and those that can be used.
    - `chart`, `trouble`: where the chart is; None where it was not found, and why not.
    - `whites`: frames of white at `used_s`; one of a recording.
    - `white_levels`: levels of paper in each, (3,) counts above black; none of a recording.
    - `dark`, `muted`: a frame of black there, and with the projector muted; None where it could not be.
    - `primaries`: levels of paper, (3,) counts above black, under "white", "red", "green", "blue" and "black"; None of
      a recording.
    - `focal_px`: the focal length that files state, half-size px.
    """

    first: Shot
    trials: tuple[Trial, ...]
    times_s: tuple[float, ...]
    saturation: Saturation
    chart: PlacedChart | None
    trouble: str
    whites: tuple[Shot, ...]
    white_levels: tuple[_Array, ...]
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
    white_levels = tuple(found.paper(shot, saturation) for shot in whites)
    primaries = {
        "white": np.mean(white_levels, axis=0),
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
        first, trials, tuple(times), saturation, found.placed, found.trouble, whites, white_levels, dark, muted,
        why_not, primaries, series, focal_px,
    )  # fmt: skip


def _recorded(camera: Photographer, first: Shot, found: _Look) -> CheckFrames:
    """Return what a recording shows: one white frame and one dark one, as they were exposed."""
    dark = camera.take(BLACK)
    stated = float(first.mosaic.white_level)
    counts = float(first.mosaic.saturation())
    saturation = Saturation(counts, counts < stated, stated)
    why = "a recording has no picture to mute"
    trials = (found.level(first, saturation),)
    return CheckFrames(
        first, trials, (), saturation, found.placed, found.trouble, (first,), (), dark, None, why, None, None,
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


def chart_levels(
    shots: tuple[Shot, ...], placed: PlacedChart, chart: Chart, saturation: float
) -> tuple[Levels, Levels]:
    """Return what a chart's cells, and its references, show in the mean of frames."""
    both, count = mean_levels(shots, placed, points_of(chart), saturation), len(chart.centres_mm)
    return Levels(both.mean[:count], both.clipped[:count]), Levels(both.mean[count:], both.clipped[count:])


@dataclass(frozen=True, eq=False)
class ChartMeasurements:
    """What was measured of the chart, where it was found.

    - `cells`, `references`: what white shows of it, in the chart's order.
    - `light`, `state`: the light on it, and its stains; None where it has too few white references.
    """

    placed: PlacedChart
    blur: BlurMap
    cells: Levels
    references: Levels
    light: SmoothLight | None
    state: PrintState | None


def measure_chart(seen: CheckFrames, placed: PlacedChart, chart: Chart) -> ChartMeasurements:
    """Return what the white frames show of the chart."""
    cells, references = chart_levels(seen.whites, placed, chart, seen.saturation.counts)
    light = measure_light(chart, references)
    state = None if light is None else measure_print(chart, cells, references, light)
    return ChartMeasurements(placed, measure_blur(placed.framing), cells, references, light, state)
