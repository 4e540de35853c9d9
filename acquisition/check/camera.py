"""The camera: lens sharp all over, straight, near enough; what its sensor and body do to frames; battery, card, disk.

The blur of every tag's edges is a map; a chart without tags has one of its field's outline. Noise is measured by pairs
of frames (EMVA 1288, release 4.0, section 6.6): what differs between two frames of one light is noise, whatever print,
lens and the photosites' unequal response do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, Grade, amount, judged, not_checked, percent, worst
from acquisition.check.light_and_print import AREAS, area_name, areas_of
from acquisition.check.places import ChartMap, smallest_cell_px
from acquisition.run.plan import bytes_text, free_bytes_at, needed_bytes
from calibration.figures.light import LINEARITY
from calibration.sampling import bleed, largest_blur_px
from drivers.camera import Camera, ReportsSupplies, Supplies
from drivers.raw.rawfile import CHANNELS, CLIPPING_SHARE, Mosaic, frame_black, phases
from experiment.chart.model import Chart
from experiment.framing.finding import MIN_MODULE_PX, Framing
from experiment.framing.homography import project
from experiment.framing.sharpness import edge_blurs
from experiment.measures.sensor import HIGHEST, LOWEST, deviations
from foundation.errors import DeviceError, StorageError, counted
from foundation.robust import sigma_of

USUAL_FOCAL_DIAGONALS = 1.3
"""Focal length over the frame's diagonal where the file states none: 35 mm on APS-C (chosen)."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BlurMap:
    """How soft the picture is from place to place: `points_mm` (N, 2) on the print, `sigma_px` (N,) half-size px."""

    points_mm: _Array
    sigma_px: _Array


def measure_blur(framing: Framing) -> BlurMap:
    """Return the blur of every tag (median of its edges), or of places along the outline of a field without tags."""
    places, sigma = edge_blurs(framing)
    back = np.asarray(np.linalg.inv(framing.homography), dtype=np.float64)
    return BlurMap(project(back, places), sigma)


def judge_sharpness(blur: BlurMap, chart: Chart, module_px: float, cell_px: float) -> Finding:
    """Return the finding on sharpness: the worst area of the chart counts, for a fault the median of all places.

    `module_px`: of the tags, half-size px; too small ones are not looked at. `cell_px`: shorter side of the smallest
    cell, half-size px.
    """
    if module_px < MIN_MODULE_PX:
        return not_checked(
            "sharpness", f"a tag module is {module_px:.1f} px wide, {MIN_MODULE_PX:g} needed to see its edges",
            "bring the camera nearer",
        )  # fmt: skip
    if not len(blur.sigma_px):
        return not_checked("sharpness", "no printed edge lies whole in the picture", "bring the chart into the picture")
    area = areas_of(blur.points_mm, chart)
    found = {int(number): float(np.median(blur.sigma_px[area == number])) for number in np.unique(area)}
    softest, sharpest = max(found, key=lambda each: found[each]), min(found, key=lambda each: found[each])
    names = {number: area_name(number) for number in found}
    middle = float(np.median(blur.sigma_px))
    worst_bleed, usual_bleed = (bleed(cell_px, sigma) for sigma in (found[softest], middle))
    aside = found[softest] - found[sharpest] > 0.25
    remedy = (
        f"turn the camera so that the sensor is parallel to the print ({names[softest]} is farther out of focus), stop "
        "down to f/8"
        if aside
        else "focus the lens by hand on a magnified live view, stop down to f/8, and see that nothing shakes the camera"
    )
    limit = LIMITS["sharpness"]
    judgement = judged(
        limit,
        worst_bleed,
        f"blur σ {found[softest]:.2f} px at {names[softest]}, {found[sharpest]:.2f} px at {names[sharpest]}, "
        f"{middle:.2f} px on the whole, so that the worst sample of a cell of {cell_px:.1f} px has "
        f"{percent(worst_bleed)} of its neighbours' light there and {percent(usual_bleed)} on the whole",
        remedy,
        {"areas_px": {names[number]: sigma for number, sigma in found.items()}, "median_px": middle,
         "cell_px": cell_px, "median_bleed": usual_bleed},
    )  # fmt: skip
    # A table is judged by the median; one soft corner is worth a remark.
    refused = limit.grade(usual_bleed) == "fault" or middle > largest_blur_px(cell_px)
    grade: Grade = "fault" if refused else "remark" if judgement.grade == "fault" else judgement.grade
    if refused and judgement.grade == "good":
        most = largest_blur_px(cell_px)
        why = f"at most σ {most:.2f} px wanted: build-lut does not find cells so soft to parts of a pixel"
        return replace(judgement, grade=grade, reason=why, remedy=remedy)
    return replace(judgement, grade=grade)


def judge_turn(framing: Framing) -> Finding:
    """Return the finding on how the chart is turned in the picture; quarter turns are named and do no harm."""
    turned = (framing.rotation_deg + 180) % 360 - 180
    quarters = round(turned / 90)
    off = turned - 90 * quarters
    name = {0: "upright", 1: "turned by 90° clockwise", -1: "turned by 90° counter-clockwise"}.get(
        quarters, "upside down, turned by 180°"
    )
    found = judged(
        LIMITS["turn"],
        off,
        f"the chart is {name}, its rows {off:+.1f}° to the picture's",
        "turn the camera until they are level",
        {"turned_deg": turned, "quarter_turns": quarters},
    )
    if quarters == 0:
        return found
    reason = "the table is the same either way; a landscape chart fills an upright picture badly"
    remedy = found.remedy or "see that it hangs as it was meant to"
    return replace(found, grade=worst((found.grade, "remark")), reason=found.reason or reason, remedy=remedy)


def judge_tilt(framing: Framing, chart: Chart, focal_px: float | None) -> Finding:
    """Return the finding on keystone: by the sides' lengths, which need no focal length, and in degrees.

    `focal_px`: focal length, half-size px; None where it is not known: degrees then hold for a usual lens.
    """
    width, height = chart.page_mm
    corners = project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)])
    top, right, bottom, left = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    across, down = max(left / right, right / left) - 1, max(top / bottom, bottom / top) - 1
    rows, columns = framing.plane.values.shape
    focal = focal_px if focal_px is not None else USUAL_FOCAL_DIAGONALS * float(np.hypot(rows, columns))
    pan, tilt = tilt_deg(framing.homography, focal, ((columns - 1) / 2, (rows - 1) / 2))
    nearer = " and ".join(
        [
            *(["left" if left > right else "right"] if across > 0.01 else []),
            *(["top" if top > bottom else "bottom"] if down > 0.01 else []),
        ]
    )
    known = "" if focal_px is not None else f", if the lens has {USUAL_FOCAL_DIAGONALS:g} diagonals of focal length"
    return judged(
        LIMITS["tilt"],
        float(max(across, down)),
        f"keystone {percent(float(across))} across, {percent(float(down))} down"
        f"{f', {nearer} nearer' if nearer else ''}: the print is turned by {pan:+.1f}° about the upright and "
        f"{tilt:+.1f}° about the level axis{known}",
        "set the camera square to the middle of the print: the same distance to all four corners",
        {"across": float(across), "down": float(down), "pan_deg": pan, "tilt_deg": tilt, "focal_px": focal_px},
    )


def tilt_deg(homography: _Array, focal_px: float, centre_px: tuple[float, float]) -> tuple[float, float]:
    """Return how a plane is turned against the sensor about the upright and about the level axis, degrees.

    From the homography (3, 3) float64 of a pinhole, mm to px, K [r₁ r₂ t]: the columns of the rotation give the plane's
    normal (R. Hartley and A. Zisserman, "Multiple View Geometry", 2nd ed., section 8.1.1). Positive where the right,
    and the lower, side is nearer.
    """
    x, y = centre_px
    camera = np.array([[focal_px, 0, x], [0, focal_px, y], [0, 0, 1.0]])
    turned = np.linalg.solve(camera, homography)
    first, second = (turned[:, k] / np.linalg.norm(turned[:, k]) for k in (0, 1))
    if turned[2, 2] < 0:
        first, second = -first, -second
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    return float(np.degrees(np.arctan2(normal[0], normal[2]))), float(np.degrees(np.arctan2(normal[1], normal[2])))


def judge_size(framing: Framing, chart: Chart, place: ChartMap) -> Finding:
    """Return the finding on how large cells and tags are, and whether the sheet lies in the picture."""
    cell = smallest_cell_px(chart, place)
    module = "" if framing.field is not None else f", a tag module {framing.module_px:.1f} px"
    found = judged(
        LIMITS["size"],
        cell,
        f"the chart fills {percent(framing.fill)} of the picture, its smallest cell has {amount(cell, 'px')}{module} "
        "(half-size pixels)",
        "bring the camera nearer or take a longer lens",
        {"fill": framing.fill, "cell_px": cell, "module_px": framing.module_px},
    )
    wrong: list[tuple[str, str]] = []
    if not framing.inside:
        wrong.append(("the sheet does not lie in the picture with all four corners", "move the camera back or turn it"))
    if framing.module_px < MIN_MODULE_PX:
        wrong.append((f"tags need {MIN_MODULE_PX:g} px a module", "bring the camera nearer"))
    if not wrong:
        return found
    reasons, remedies = ("; ".join(part) for part in zip(*wrong, strict=True))
    # What is cut off, or not found for it, is judged by the cells and tags that are lacking.
    return replace(
        found,
        grade=worst((found.grade, "remark")),
        reason="; ".join(filter(None, (found.reason, reasons))),
        remedy="; ".join(filter(None, (found.remedy, remedies))),
    )


def judge_chart(framing: Framing, chart: Chart) -> Finding:
    """Return the finding on whether all of the chart was found."""
    total = len(chart.tags)
    if framing.field is not None:
        return Finding("chart", "good", "no tags, the field of cells was found")
    said = f"{len(framing.tags)} of {total} tags found"
    if framing.complete:
        return Finding("chart", "good", said)
    return Finding(
        "chart", "remark", f"{said}; missing: {', '.join(str(number) for number in framing.missing[:8])}",
        reason="where a tag is missing, the place of the cells around it rests on the cells alone",
        remedy="bring all of the chart into the picture, uncover it, and light all of it",
    )  # fmt: skip


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


def judge_clipping(
    mosaic: Mosaic, shutter_s: float, saturation: float, allowed_percent: float, place: ChartMap | None
) -> Finding:
    """Return the finding on clipped photosites of a white frame, and where on the chart most of them lie."""
    full = mosaic.counts >= CLIPPING_SHARE * saturation
    share = float(np.count_nonzero(full) / full.size)
    where = ""
    blocks = mosaic.block_planes() >= CLIPPING_SHARE * saturation
    letters = [letter for letter in CHANNELS if any(blocks[p].any() for p in phases(mosaic)[letter])]
    if share > 0 and place is not None:
        where = f", most of them at {_densest(np.asarray(blocks.any(axis=(0, 1))), place)} of the chart"
    described = f" in {', '.join(letters)}" if letters else ""
    limit = LIMITS["clipping"]
    allowed = allowed_percent / 100
    found = judged(
        limit,
        share,
        f"{percent(share)} of a white frame's photosites at {shutter_s:.4g} s reach {percent(CLIPPING_SHARE)} "
        f"of saturation{described}{where}",
        "expose less, and keep reflections off the chart",
        {"channels": letters},
    )
    grade: Grade = "fault" if share > allowed else ("remark" if found.grade == "fault" else found.grade)
    return replace(found, grade=grade, tolerable=(None, allowed))


def _densest(full: npt.NDArray[np.bool_], place: ChartMap) -> str:
    rows, columns = AREAS
    width, height = place.page_mm
    counts = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            corners = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
            outline = place.to_pixels(np.array(corners) * (width / columns, height / rows))
            mask = np.zeros(full.shape, dtype=np.uint8)
            cv2.fillConvexPoly(mask, outline.round().astype(np.int32), 1)
            counts[row, column] = np.count_nonzero(full[mask > 0])
    return area_name(int(np.argmax(counts)))


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
        f"{counted(count, 'photosite stands', 'photosites stand')} out in the dark by {HOT_COUNTS:g} counts and more, "
        f"{rate:.0f} of a million",
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
            for name in (LINEARITY.name, "photon transfer")
        ]
    level, deviation = deviations(seen, np.asarray(times_s, dtype=np.float64))
    if np.isnan(deviation).all():
        return [not_checked(LINEARITY.name, "no patch is bright enough in two frames of the series")]
    off = float(np.nanmax(np.abs(deviation)))
    channel, node = np.unravel_index(int(np.nanargmax(np.abs(deviation))), deviation.shape)
    straight = judged(
        LIMITS[LINEARITY.name],
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
    described = ", ".join(
        f"{letter} {one:.2f} e⁻ a count and {two:.1f} counts ({one * two:.1f} e⁻) of read noise"
        for letter, one, two in zip(CHANNELS, gain, read, strict=True)
    )
    noise = Finding(
        "photon transfer", "good", described, float(np.median(gain)), "e⁻ a count",
        details={"gain_e": gain.tolist(), "read_noise_counts": read.tolist()},
    )  # fmt: skip
    return [straight, noise]


CHARGE = 440
"""Frames to a charge: the least of the paper's cameras (EOS 550D, the maker's figure at 23 °C)."""

SPARE = 1.5
"""How many times the plan's frames a battery must hold to be enough: it ages, and waits between frames count, too."""


def judge_disk(folder: Path, frames: int, frame_bytes: int) -> Finding:
    """Return the finding on the disk of a folder, or of the nearest folder above that exists."""
    needed = needed_bytes(frames, frame_bytes)
    try:
        free = free_bytes_at(folder)
    except StorageError as error:
        return Finding("disk", "fault", str(error))
    return judged(
        LIMITS["disk"],
        free / max(needed, 1),
        f"{bytes_text(free)} free at {folder}, {bytes_text(needed, up=True)} needed for {frames} frames of "
        f"{bytes_text(frame_bytes)} (as one that was taken here), some of them taken again",
        "free space, or put the session on another disk (acquire run --dry-run checks the disk of a session's folder)",
        {"free_bytes": free, "needed_bytes": needed, "frames": frames, "frame_bytes": frame_bytes},
    )


def judge_supplies(camera: Camera, frames: int, frame_bytes: int) -> list[Finding]:
    """Return the findings on battery and card, as far as the body tells."""
    silent = "this camera does not tell"
    if not isinstance(camera, ReportsSupplies):
        return [not_checked("battery", silent, "look at its display"), not_checked("card", silent)]
    try:
        found = camera.supplies()
    except DeviceError as error:
        return [not_checked("battery", str(error)), not_checked("card", str(error))]
    return [_battery(found, frames), _card(found, needed_bytes(frames, frame_bytes))]


def _battery(found: Supplies, frames: int) -> Finding:
    if found.mains:
        return Finding("battery", "good", "the camera runs on mains power")
    if found.battery is None:
        why = "the camera does not tell its battery's charge"
        return not_checked("battery", why, f"use a mains adapter: the plan has {frames} frames")
    charged = f"{percent(found.battery)} charged, and the plan has {frames} frames"
    if found.battery * CHARGE >= SPARE * frames:
        return Finding("battery", "good", f"the camera's battery is {charged}", found.battery, "share")
    if found.mains is None and found.battery >= 1:
        why = f"{charged}: a battery, or a mains adapter, which this body does not tell apart"
        return not_checked("battery", why, "see that it is a mains adapter")
    limit = LIMITS["battery"]
    low = limit.tolerable[0] or 0.0
    return Finding(
        "battery", "remark" if found.battery >= low else "fault", f"the camera runs on its battery, {charged}",
        found.battery, limit.unit, limit.good, limit.tolerable, limit.why, "use a mains adapter",
    )  # fmt: skip


def _card(found: Supplies, needed: int) -> Finding:
    if found.saves_to_host:
        return Finding("card", "good", "frames go to this machine, the card is not used")
    if found.card_free_bytes is None:
        return not_checked("card", "frames go by the camera's card, and it does not tell its free space")
    return judged(
        LIMITS["card"],
        found.card_free_bytes / max(needed, 1),
        f"frames go by the card: {bytes_text(found.card_free_bytes)} free, {bytes_text(needed, up=True)} needed",
        "put in an empty card",
        {"free_bytes": found.card_free_bytes, "needed_bytes": needed},
    )
