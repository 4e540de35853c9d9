"""The camera's sensor and what its body does to frames: clipping, hot photosites, linearity and noise.

Noise is measured by pairs of frames (EMVA 1288, release 4.0, section 6.6): what differs between two frames of one light
is noise, whatever print, lens and the photosites' unequal response do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, Range, judged, not_checked, percent
from acquisition.check.light import area_name
from acquisition.check.places import ChartMap
from acquisition.check.taking import Shot
from drivers.raw.rawfile import Mosaic
from experiment.framing.planes import CHANNELS, CLIPPING_SHARE, frame_black, phases
from experiment.measures.sensor import HIGHEST, LOWEST, deviations
from foundation.robust import sigma_of

HOT_COUNTS = 30.0
"""Counts above its surroundings at which a dark photosite is hot: the limit of a table (`build-lut`)."""

HOT_SIGMAS = 6.0
"""Usual deviations that it must be, too: by chance one photosite in 10⁹."""

SERIES = 8
"""Exposure times of a series of linearity; pairs of frames each."""

LEAST_TIMES = 4
"""With fewer times, errors of the stated ones look like nonlinearity."""

NOISE_WINDOW = 5
"""Side of the windows whose variance is taken, px: a cell's 25 samples."""

_BINS = 24
"""Levels at which the variance is read."""

_Array = npt.NDArray[np.float64]


def judge_clipping(shot: Shot, saturation: float, allowed_percent: float, place: ChartMap | None) -> Finding:
    """Return the finding on clipped photosites of a white frame, and where on the chart most of them lie."""
    mosaic = shot.mosaic
    full = mosaic.counts >= CLIPPING_SHARE * saturation
    share = float(np.count_nonzero(full) / full.size)
    where = ""
    blocks = mosaic.block_planes() >= CLIPPING_SHARE * saturation
    letters = [letter for letter in CHANNELS if any(blocks[p].any() for p in phases(mosaic)[letter])]
    if share > 0 and place is not None:
        where = f", most of them at {_densest(np.asarray(blocks.any(axis=(0, 1))), place)} of the chart"
    told = f" in {', '.join(letters)}" if letters else ""
    limit = LIMITS["clipping"]
    allowed = allowed_percent / 100
    tolerable: Range = (None, allowed)
    found = judged(
        limit,
        share,
        f"{percent(share)} of a white frame's photosites at {shot.shutter_s:.4g} s reach {percent(CLIPPING_SHARE)} "
        f"of saturation{told}{where}",
        "expose less, and keep reflections off the chart",
        {"channels": letters},
    )
    grade = "fault" if share > allowed else ("remark" if found.grade == "fault" else found.grade)
    return Finding(
        found.name, grade, found.said, found.value, found.unit, found.good, tolerable, found.reason, found.remedy,
        found.details,
    )  # fmt: skip


def _densest(full: npt.NDArray[np.bool_], place: ChartMap) -> str:
    rows, columns = 3, 5
    width, height = place.page_mm
    counts = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            corners = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
            outline = place.to_pixels(np.array(corners) * (width / columns, height / rows))
            mask = np.zeros(full.shape, dtype=np.uint8)
            cv2.fillConvexPoly(mask, outline.round().astype(np.int32), 1)
            counts[row, column] = np.count_nonzero(full[mask > 0])
    row, column = np.unravel_index(int(np.argmax(counts)), counts.shape)
    return area_name(int(row), int(column))


def judge_hot(dark: Mosaic, share: float, white: Mosaic) -> Finding:
    """Return the finding on photosites that stand out in a dark frame."""
    sensor = dark.counts.astype(np.float32)
    count = 0
    for row in range(2):
        for column in range(2):
            shown = share * white.counts[row::2, column::2].astype(np.float32)
            plane = np.asarray(sensor[row::2, column::2] - shown, dtype=np.float32)
            above = np.asarray(plane - cv2.medianBlur(plane, 3), dtype=np.float32)
            count += sum(_standing_out(above[part]) for part in _of_like_light(shown))
    rate = 1e6 * count / sensor.size
    return judged(
        LIMITS["hot photosites"],
        rate,
        f"{count} photosites stand out in the dark by {HOT_COUNTS:g} counts and more, {rate:.0f} of a million",
        "expose for a shorter time at a lower f-number, let the camera cool, or map the photosites out by its menu "
        "(sensor cleaning)",
        {"count": count},
    )


def judge_noise_reduction(timings: Sequence[tuple[float, float]]) -> Finding:
    """Return the finding on whether the body takes a dark frame of its own after long exposures.

    `timings`: of every frame taken: shutter time and the time until its file was here, seconds.
    """
    times = sorted(timings)
    if not times or times[-1][0] < 1.0 or times[-1][0] < 4 * times[0][0]:
        return not_checked("noise reduction", "no two exposures differ enough, the longer 1 s or more, to see it")
    shortest = np.median([took - shutter for shutter, took in times if shutter == times[0][0]])
    longest = np.median([took - shutter for shutter, took in times if shutter == times[-1][0]])
    growth = float((longest - shortest) / (times[-1][0] - times[0][0]))
    return judged(
        LIMITS["noise reduction"],
        growth,
        f"a frame of {times[-1][0]:.4g} s takes {longest:.1f} s beyond its exposure, one of {times[0][0]:.4g} s "
        f"{shortest:.1f} s",
        "switch long exposure noise reduction off in the camera's menu",
    )


def _of_like_light(shown: npt.NDArray[np.float32]) -> list[npt.NDArray[np.bool_]]:
    """Return masks of photosites on which about as much light falls: light has noise of its own."""
    edges = np.quantile(shown[::4, ::4], np.linspace(0, 1, 9)[1:-1])
    level = np.digitize(shown, edges)
    return [level == number for number in range(8)]


def _standing_out(above: npt.NDArray[np.float32]) -> int:
    """Return how many of photosites' differences (N,) to their surroundings are those of hot ones."""
    if not len(above):
        return 0
    return int(np.count_nonzero(above > max(HOT_COUNTS, HOT_SIGMAS * sigma_of(above[::7]))))


@dataclass(frozen=True, eq=False)
class Transfer:
    """A sensor's noise: `gain_e` (3,) electrons to the count, `read_noise` (3,) counts, of R, G, B photosites."""

    gain_e: _Array
    read_noise: _Array


def series_times(times_s: Sequence[float], white_s: float, white_level: float) -> list[float]:
    """Return the shutter times of a series in which white goes from 6 to 94 % of saturation, rising.

    `white_s`, `white_level`: A shutter time, and white's share of saturation at it.
    """
    able = [time for time in times_s if 0.06 <= white_level * time / white_s <= 0.94]
    if len(able) <= SERIES:
        return able
    wanted = np.geomspace(able[0], able[-1], SERIES)
    return sorted({min(able, key=lambda time: abs(np.log(time / each))) for each in wanted.tolist()})


def pair_noise(one: Mosaic, other: Mosaic, place: ChartMap, points_mm: _Array) -> tuple[_Array, _Array]:
    """Return level and variance, (N, 3) float64 counts and counts², of single photosites at patches of two frames.

    One photosite of each colour in a block counts, so that green's is not the mean of two; NaN outside the frame.
    """
    black = frame_black(one)
    blocks = one.block_planes(), other.block_planes()
    columns, rows = np.rint(place.to_pixels(points_mm)).astype(int).T
    height, width = blocks[0].shape[2:]
    reach = NOISE_WINDOW // 2
    inside = (rows >= reach) & (rows < height - reach) & (columns >= reach) & (columns < width - reach)
    level, variance = np.full((len(rows), 3), np.nan), np.full((len(rows), 3), np.nan)
    size = (NOISE_WINDOW, NOISE_WINDOW)
    samples = NOISE_WINDOW**2
    for number, channel in enumerate(CHANNELS):
        phase = phases(one)[channel][0]
        first, second = (block[phase].astype(np.float64) for block in blocks)
        mean: _Array = np.asarray(cv2.blur((first + second) / 2, size), dtype=np.float64) - black[phase]
        gap = first - second
        spread: _Array = np.asarray(cv2.blur(gap**2, size) - cv2.blur(gap, size) ** 2, dtype=np.float64)
        level[inside, number] = mean[rows[inside], columns[inside]]
        variance[inside, number] = spread[rows[inside], columns[inside]] * samples / (samples - 1) / 2
    return level, variance


def fit_transfer(level: _Array, variance: _Array) -> Transfer:
    """Return the line through variances (N, 3) at levels (N, 3): read noise² + level / gain; NaN rows are left out.

    Means of patches of like levels, weighted by their own size, since a variance's error is proportional to it.
    """
    gain, read = np.full(3, np.nan), np.full(3, np.nan)
    for channel in range(3):
        there = np.isfinite(level[:, channel]) & np.isfinite(variance[:, channel])
        at, seen = level[there, channel], variance[there, channel]
        if len(at) < 4 * _BINS:
            continue
        order = np.argsort(at)
        bins: list[npt.NDArray[np.intp]] = np.array_split(order, _BINS)
        x = np.array([float(at[part].mean()) for part in bins])
        # Hot photosites and dust that moved are few and far off.
        y = np.array([float(np.sort(seen[part])[: max(1, round(0.98 * len(part)))].mean()) for part in bins])
        weight = 1 / np.maximum(y, 1e-9)
        design = np.column_stack([np.ones_like(x), x]) * weight[:, None]
        (floor, slope), *_ = np.linalg.lstsq(design, y * weight, rcond=None)
        if slope > 0:
            gain[channel], read[channel] = 1 / slope, max(float(floor), 0.0) ** 0.5
    return Transfer(gain, read)


def judge_linearity(seen: _Array, times_s: Sequence[float], transfer: Transfer) -> list[Finding]:
    """Return the findings of a series of exposures: proportion to light, and the sensor's noise.

    `seen`: (K, P, 3) float64 mean counts of patches, shares of saturation, NaN where one cannot be used. `times_s`:
    (K,) shutter times, rising.
    """
    if len(times_s) < LEAST_TIMES:
        return [
            not_checked(
                name, f"{len(times_s)} shutter times bring white between 6 and 94 % of saturation, {LEAST_TIMES} needed"
            )
            for name in ("linearity", "photon transfer")
        ]
    level, deviation = deviations(seen, np.asarray(times_s, dtype=np.float64))
    if np.isnan(deviation).all():
        return [not_checked("linearity", "no patch is bright enough in two frames of the series")]
    off = float(np.nanmax(np.abs(deviation)))
    channel, node = np.unravel_index(int(np.nanargmax(np.abs(deviation))), deviation.shape)
    straight = judged(
        LIMITS["linearity"],
        off,
        f"over {len(times_s)} times from {times_s[0]:.4g} to {times_s[-1]:.4g} s counts deviate from proportion to "
        f"light by {percent(off)} at most ({CHANNELS[int(channel)]} at {percent(float(level[node]))} of saturation; "
        f"{percent(LOWEST)} to {percent(HIGHEST)} looked at)",
        "expose less, switch the camera's highlight priority off, and check in steady light",
        {"level": level.tolist(), "deviation": deviation.tolist(), "times_s": list(times_s)},
    )
    gain, read = transfer.gain_e, transfer.read_noise
    if not np.isfinite(gain).all():
        return [
            straight,
            not_checked("photon transfer", "noise does not rise with light"),
        ]
    told = ", ".join(
        f"{letter} {one:.2f} e⁻ a count and {two:.1f} counts ({one * two:.1f} e⁻) of read noise"
        for letter, one, two in zip(CHANNELS, gain, read, strict=True)
    )
    noise = Finding(
        "photon transfer", "good", told, float(np.median(gain)), "e⁻ a count",
        details={"gain_e": gain.tolist(), "read_noise_counts": read.tolist()},
    )  # fmt: skip
    return [straight, noise]
