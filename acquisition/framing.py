"""Where the chart is in a picture: its tags found, its pose judged, its sharpness and its movement measured.

Laws that hold inside:

- One linear colour plane at a time, the strongest of the frame: a square root moves a tag's corner by a quarter pixel,
  a sum of planes under deep red or blue by a fifth.
- Places are half-size pixels. A plane of red or blue photosites lies a quarter pixel beside the blocks' centres, and
  `Plane.offset_px` puts its places right; green is the mean of its two photosites and lies in the middle.
- Faults of the picture are a `RegistrationError` that says what was looked for, what was found, and what helps.

Knows the chart and a mosaic of counts; nothing of sessions, cells' colours or lenses (`calibration.registration`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from acquisition.chart import Chart
from drivers.errors import RegistrationError
from drivers.rawfile import Mosaic

Channel = Literal["R", "G", "B"]
CHANNELS: tuple[Channel, Channel, Channel] = ("R", "G", "B")

MIN_MODULE_PX = 3.0
"""Half-size pixels a tag module must have; below, detectors fail one tag after another."""

TAG_MODULES = 8
"""Modules along a 36h11 tag's black square."""

MIN_TAGS = 2
MIN_TAG_SHARE = 0.8
"""Share of the chart's tags that must be found."""

MIN_SIGNAL = 12.0
"""Counts above black that the brightest parts of the strongest plane must have for tags to be looked for."""

MAX_SHIFT_PX = 3.0
_CORNERS = [1, 0, 3, 2]
"""pyapriltags' corners in the order clockwise from the printed top-left."""

_GAUGE_TAGS = 8
_STEPS = 5

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plane:
    """One colour of a mosaic: `values` (H // 2, W // 2) float32, counts above black; `offset_px` (x, y).

    The element [i, j] was measured at the half-size place x = j + offset_px[0], y = i + offset_px[1].
    """

    channel: Channel
    values: _Float
    offset_px: tuple[float, float]


def phases(mosaic: Mosaic) -> dict[Channel, tuple[tuple[int, int], ...]]:
    """Return which (row, column) of the 2×2 block carry each colour."""
    found: dict[Channel, tuple[tuple[int, int], ...]] = {}
    for channel in CHANNELS:
        found[channel] = tuple(divmod(place, 2) for place, letter in enumerate(mosaic.pattern) if letter == channel)
    return found


def channel_offset_px(places: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Return where photosites at `places` of the block lie from its centre, half-size px (x, y): 0 or ±0.25."""
    rows, columns = np.mean(np.asarray(places, dtype=np.float64), axis=0)
    return (float(columns) - 0.5) / 2, (float(rows) - 0.5) / 2


def frame_black(mosaic: Mosaic) -> npt.NDArray[np.float64]:
    """Return the black level (2, 2) float64 of each position of the block: measured in the masked border, or stated."""
    measured = mosaic.masked_black()
    return mosaic.black if measured is None else measured


def plane_of(mosaic: Mosaic, channel: Channel, black: npt.NDArray[np.float64] | None = None) -> Plane:
    """Return one colour of a mosaic above black; `black` (2, 2) counts is measured from the frame if not given."""
    black = frame_black(mosaic) if black is None else black
    places = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = float(np.mean([black[place] for place in places]))
    values = blocks[places[0]].astype(np.float32)
    for place in places[1:]:
        values += blocks[place]
    values /= len(places)
    values -= level
    return Plane(channel, values, channel_offset_px(places))


def strongest_plane(mosaic: Mosaic, black: npt.NDArray[np.float64] | None = None) -> Plane:
    """Return the colour with the brightest paper; `black` as in `plane_of`."""
    black = frame_black(mosaic) if black is None else black
    blocks = mosaic.block_planes()[:, :, ::8, ::8]
    levels = [
        max(float(np.percentile(blocks[place], 98) - black[place]) for place in places)
        for places in phases(mosaic).values()
    ]
    return plane_of(mosaic, CHANNELS[int(np.argmax(levels))], black)


@dataclass(frozen=True, eq=False)
class FoundTag:
    """One tag in a picture: `corners_px` (4, 2) float64 half-size px, clockwise from the printed top-left."""

    id: int
    corners_px: _Points
    margin: float

    @property
    def centre_px(self) -> _Points:
        """(2,) float64 half-size px, mean of the corners."""
        return self.corners_px.mean(axis=0)

    @property
    def side_px(self) -> float:
        """Mean length of the black square's sides, half-size px."""
        return float(np.linalg.norm(self.corners_px - np.roll(self.corners_px, 1, axis=0), axis=1).mean())


_detectors = threading.local()


def paper_level(plane: Plane) -> float:
    """Return how bright the brightest parts of a plane are, counts above black: means of 4×4 pixels, 99.5th percentile.

    Means, so that a dark frame's noise is not taken for light.
    """
    height, width = plane.values.shape
    size = (max(1, width // 4), max(1, height // 4))
    return float(np.percentile(cv2.resize(plane.values, size, interpolation=cv2.INTER_AREA), 99.5))


def find_tags(plane: Plane) -> tuple[FoundTag, ...]:
    """Return the 36h11 tags of a plane, sorted by id, each at most once (the surest).

    Corners are good to about 0.09 px RMS at 4 px a module and σ = 0.7 px blur.
    """
    white = paper_level(plane)
    if white < MIN_SIGNAL:
        return ()
    image = np.clip(plane.values * (255.0 / white), 0, 255)
    return _detect(np.rint(image).astype(np.uint8), plane.offset_px)


def _detect(image: npt.NDArray[np.uint8], offset_px: tuple[float, float]) -> tuple[FoundTag, ...]:
    from pyapriltags import Detector

    # A detector keeps C state between calls, so each thread has its own.
    if not hasattr(_detectors, "detector"):
        _detectors.detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0, refine_edges=1)
    detector: Detector = _detectors.detector
    found: dict[int, FoundTag] = {}
    for detection in detector.detect(np.ascontiguousarray(image)):
        # AprilTag puts a pixel's corner, not its centre, at integers.
        corners = detection.corners[_CORNERS] - 0.5 + np.asarray(offset_px)
        tag = FoundTag(detection.tag_id, corners, float(detection.decision_margin))
        if detection.hamming <= 1 and (tag.id not in found or found[tag.id].margin < tag.margin):
            found[tag.id] = tag
    return tuple(found[number] for number in sorted(found))


@dataclass(frozen=True, eq=False)
class Framing:
    """How the chart stands in a picture.

    Attributes
    ----------
    plane
        The colour plane that was searched.
    tags
        Tags of the chart that were found, by id.
    missing
        Ids of the chart's tags that were not found.
    homography
        (3, 3) float64, millimetres on the print to half-size px, lens distortion not included.
    residual_px
        RMS distance of the tags' corners from the homography: distortion and waviness included, some pixels.
    module_px
        Half-size pixels per tag module, the smallest tag's.
    fill
        Share of the picture's height or width that the page takes, the larger of the two; 1 is full.
    inside
        Whether all four corners of the page lie in the picture.
    rotation_deg
        Of the page's x axis against the picture's, clockwise as seen.
    """

    plane: Plane
    tags: tuple[FoundTag, ...]
    missing: tuple[int, ...]
    homography: npt.NDArray[np.float64]
    residual_px: float
    module_px: float
    fill: float
    inside: bool
    rotation_deg: float

    @property
    def complete(self) -> bool:
        """Whether every tag of the chart was found."""
        return not self.missing


def project(homography: npt.NDArray[np.float64], points: npt.ArrayLike) -> _Points:
    """Return points (N, 2) mapped by a homography (3, 3)."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def rms(vectors: npt.NDArray[np.float64]) -> float:
    """Return the root of the mean squared length of vectors (..., 2)."""
    return float(np.sqrt((vectors**2).sum() * vectors.shape[-1] / max(vectors.size, 1)))


def find_chart(frame: Mosaic | Plane, chart: Chart, what: str = "the frame") -> Framing:
    """Return how `chart` stands in a picture.

    Parameters
    ----------
    frame
        A mosaic, of which the strongest colour is searched, or one plane.
    chart
        The chart expected.
    what
        The frame's name for messages.

    Raises
    ------
    RegistrationError
        The chart has no tags; none is seen; they are mirrored, too small, not this chart's, too few, or their places
        do not fit it.
    """
    if len(chart.tags) < MIN_TAGS:
        raise RegistrationError(
            f"{what}: the chart has {len(chart.tags)} tags, and it is found by its tags, at least {MIN_TAGS}; "
            "print a chart made by acquire chart"
        )
    plane = strongest_plane(frame) if isinstance(frame, Mosaic) else frame
    found = find_tags(plane)
    expected = {tag.id: tag for tag in chart.tags}
    ids = sorted(expected)
    looked_for = f"{len(ids)} tags 36h11 with ids {ids[0]}–{ids[-1]}"
    tags = tuple(tag for tag in found if tag.id in expected)
    missing = tuple(number for number in ids if number not in {tag.id for tag in tags})
    if len(tags) < max(MIN_TAGS, len(ids) // 4):
        raise _not_found(plane, found, tags, looked_for, what)
    chart_points = np.concatenate([expected[tag.id].corners_mm for tag in tags])
    frame_points = np.concatenate([tag.corners_px for tag in tags])
    height, width = plane.values.shape
    homography, fits = _robust_homography(chart_points, frame_points, 0.01 * width)
    misplaced = [tag.id for number, tag in enumerate(tags) if not fits[4 * number : 4 * number + 4].all()]
    if len(misplaced) > 0.2 * len(tags):
        raise RegistrationError(
            f"{what}: {len(tags)} tags carry ids of the chart, but the places of {len(misplaced)} do not fit it; "
            "this is another chart: name the chart.json of the print that hangs before the camera"
        )
    tags = tuple(tag for tag in tags if tag.id not in misplaced)
    missing = tuple(sorted({*missing, *misplaced}))
    module = min(tag.side_px for tag in tags) / TAG_MODULES
    if len(tags) < MIN_TAG_SHARE * len(ids):
        small = module < MIN_MODULE_PX
        raise RegistrationError(
            f"{what}: {len(tags)} of {looked_for} found, at least {int(np.ceil(MIN_TAG_SHARE * len(ids)))} expected; "
            f"missing: {_some(missing)}; "
            + (
                f"a module is {module:.1f} px, at least {MIN_MODULE_PX:g} expected: bring the camera nearer"
                if small
                else "uncover the chart, light all of it, and bring all of it into the picture and into focus"
            )
        )
    page_w, page_h = chart.page_mm
    corners = project(homography, [(0, 0), (page_w, 0), (page_w, page_h), (0, page_h)])
    axis = project(homography, [(0.4 * page_w, page_h / 2), (0.6 * page_w, page_h / 2)])
    residual = project(homography, chart_points[fits]) - frame_points[fits]
    spans = np.ptp(corners, axis=0) / (width, height)
    return Framing(
        plane=plane,
        tags=tags,
        missing=missing,
        homography=homography,
        residual_px=rms(residual),
        module_px=module,
        fill=float(spans.max()),
        inside=bool((corners >= -0.5).all() and (corners <= (width - 0.5, height - 0.5)).all()),
        rotation_deg=float(np.degrees(np.arctan2(*(axis[1] - axis[0])[::-1]))),
    )


def _robust_homography(
    chart_points: _Points, frame_points: _Points, tolerance_px: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the homography and which points lie within the tolerance, wide enough for distortion and waviness."""
    homography = fit_homography(chart_points, frame_points, tolerance_px)
    if homography is None:
        return np.eye(3), np.zeros(len(chart_points), dtype=np.bool_)
    good = np.asarray(np.linalg.norm(project(homography, chart_points) - frame_points, axis=1) <= tolerance_px)
    if good.sum() >= 4:
        refined = fit_homography(chart_points[good], frame_points[good])
        homography = homography if refined is None else refined
    return homography, good


def fit_homography(points: _Points, places: _Points, tolerance: float | None = None) -> npt.NDArray[np.float64] | None:
    """Return the homography (3, 3) through point pairs (N, 2), or None where they have none.

    Parameters
    ----------
    points, places
        (N, 2) float64, from and to.
    tolerance
        In units of `places`; if given, pairs further off are left out (RANSAC), else all count (least squares).
    """
    # OpenCV answers None for degenerate pairs, which becomes an array without shape.
    method, threshold = (0, 3.0) if tolerance is None else (cv2.RANSAC, tolerance)
    found = np.asarray(cv2.findHomography(points, places, method, threshold)[0], dtype=np.float64)
    return found if found.shape == (3, 3) else None


def _not_found(
    plane: Plane, found: tuple[FoundTag, ...], tags: tuple[FoundTag, ...], looked_for: str, what: str
) -> RegistrationError:
    """Return why the chart is not there, as far as the picture tells."""
    white = paper_level(plane)
    if white < MIN_SIGNAL:
        return RegistrationError(
            f"{what} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, at least "
            f"{MIN_SIGNAL:.0f} expected; switch the projector on, open its shutter, expose longer"
        )
    turned = np.ascontiguousarray(plane.values[:, ::-1])
    if len(find_tags(Plane(plane.channel, turned, (0.0, 0.0)))) > max(1, len(found)):
        return RegistrationError(
            f"{what} is mirrored: none of {looked_for} reads true, but in a mirror they do; "
            "take the frame without a mirror, or print the chart unmirrored"
        )
    larger = cv2.resize(plane.values, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    magnified = find_tags(Plane(plane.channel, np.asarray(larger, dtype=np.float32), (0.0, 0.0)))
    if len(magnified) > max(1, len(found)):
        module = min(tag.side_px for tag in magnified) / 2 / TAG_MODULES
        return RegistrationError(
            f"{what}: the tags are too small: {module:.1f} px a module, at least {MIN_MODULE_PX:g} expected; "
            "bring the camera nearer or take a longer lens"
        )
    if found and not tags:
        return RegistrationError(
            f"{what}: {looked_for} were looked for, but the tags found are {_some([tag.id for tag in found])}; "
            "this is another chart: name the chart.json of the print that hangs before the camera"
        )
    count = f"only {len(tags)} of them found" if tags else "none found"
    return RegistrationError(
        f"{what}: {looked_for} were looked for, {count}; "
        "point the camera at the chart, focus it, and see that all of it is lit"
    )


def _some(ids: Sequence[int]) -> str:
    text = ", ".join(str(number) for number in ids[:8])
    return text + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")


def blur_px(framing: Framing) -> float:
    """Return how soft the picture is: σ of the Gaussian that the tags' black edges have been blurred with, px.

    Median over the tags' edges. Across an edge lie the tag's data, its black border, its white rim and what is beyond,
    the middle two one module wide: a staircase of four unknown levels and known steps, blurred. The σ whose staircase
    fits the pixels best, each at its own distance from the edge, is taken; nothing is interpolated, which would blur as
    well (a slanted edge, as in ISO 12233). Contained is what lens, focus and movement do, and the photosites' own size
    and spacing: 0.29 px for green (two photosites half a pixel apart), 0.14 px for red and blue. Good to 0.01 px up to
    a quarter of a module, beyond that read up to a tenth high, as the corners themselves are less sure.
    """
    found = np.concatenate([_edge_blurs(framing.plane, tag) for tag in framing.tags])
    return float(np.median(found)) if len(found) else float("nan")


_BLURS = np.geomspace(0.15, 4, 48)


def _edge_blurs(plane: Plane, tag: FoundTag) -> npt.NDArray[np.float64]:
    """Return the σ of each of a tag's four edges; none where the picture ends."""
    module = tag.side_px / TAG_MODULES
    corners = tag.corners_px - plane.offset_px
    left, top = np.floor(corners.min(axis=0) - module).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + module).astype(int) + 1
    height, width = plane.values.shape
    if left < 0 or top < 0 or right > width or bottom > height:
        return np.empty(0)
    values = plane.values[top:bottom, left:right].ravel().astype(np.float64)
    rows, columns = np.mgrid[top:bottom, left:right]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    sigma = _BLURS[:, None]
    found = np.empty(4)
    for edge, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        length = float(np.linalg.norm(end - start))
        tangent = (end - start) / length
        along = (pixels - start) @ tangent / length
        # Corners run clockwise with y down, so this points out of the tag.
        across = (pixels - start) @ np.array([tangent[1], -tangent[0]])
        # Clear of the corners, where another edge is near.
        near = (along > 0.2) & (along < 0.8) & (np.abs(across) < module)
        seen, aside = values[near], across[near]
        steps = [_normal_cdf((aside - at) / sigma) for at in (-module, 0.0, module)]
        # The slope of the middle step takes up what the corners are off.
        slope = np.exp(-0.5 * (aside / sigma) ** 2)
        basis = np.linalg.qr(np.stack([np.ones_like(slope), *steps, slope], axis=-1)).Q
        misfit = (seen**2).sum() - ((seen @ basis) ** 2).sum(axis=-1)
        best = int(np.clip(misfit.argmin(), 1, len(_BLURS) - 2))
        before, least, after = misfit[best - 1 : best + 2]
        part = 0.5 * (before - after) / max(before - 2 * least + after, 1e-12)
        found[edge] = _BLURS[best] * (_BLURS[1] / _BLURS[0]) ** float(np.clip(part, -1, 1))
    return found


def _normal_cdf(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    from scipy.special import ndtr

    return np.asarray(ndtr(x), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Shift:
    """How far the chart moved between two frames.

    Attributes
    ----------
    dx, dy
        Median over the tags measured, half-size px; positive when the chart lies further right or down.
    largest_px
        The largest movement of a tag, so that a rotation shows.
    tags
        Tags that could be measured; 0 leaves the rest 0 and means unknown.
    """

    dx: float
    dy: float
    largest_px: float
    tags: int

    @property
    def length_px(self) -> float:
        """Length of the median movement, half-size px."""
        return float(np.hypot(self.dx, self.dy))


def shift_between(reference: Plane, framing: Framing, plane: Plane) -> Shift:
    """Return how far the chart has moved in `plane` since `reference`, of the same channel.

    Two-parameter Lucas–Kanade on tag crops (Lucas and Kanade 1981), gain and offset free, up to about 3 px: below
    that, good to 0.005 px where paper has some hundred counts. Costs about a millisecond.

    Parameters
    ----------
    reference
        The plane to compare with.
    framing
        Where the tags are in `reference`; only tags and places are used, so its own plane may be another colour.
    plane
        The later plane.
    """
    tags = sorted(framing.tags, key=lambda tag: tag.id)
    shifts: list[_Points] = []
    last = len(tags) - 1
    for number in sorted({round(last * part / (_GAUGE_TAGS - 1)) for part in range(_GAUGE_TAGS)}):
        tag = tags[number]
        shift = _tag_shift(reference, plane, tag)
        if shift is not None:
            shifts.append(shift)
    if not shifts:
        return Shift(0.0, 0.0, 0.0, 0)
    table = np.array(shifts)
    median = np.median(table, axis=0)
    return Shift(float(median[0]), float(median[1]), float(np.linalg.norm(table, axis=1).max()), len(shifts))


def _tag_shift(reference: Plane, plane: Plane, tag: FoundTag) -> _Points | None:
    """Return the movement (2,) of one tag, or None where it cannot be told."""
    margin = int(np.ceil(MAX_SHIFT_PX)) + 2
    height, width = reference.values.shape
    corners = tag.corners_px - reference.offset_px
    x0, y0 = np.floor(corners.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 3
    if x0 < margin or y0 < margin or x1 > width - margin or y1 > height - margin:
        return None
    # Both crops are slightly smoothed, so that the gradient is one of the light and not of the noise.
    crop = np.s_[y0 - margin : y1 + margin, x0 - margin : x1 + margin]
    before = cv2.GaussianBlur(reference.values[crop], (0, 0), 0.7).astype(np.float64)
    after = cv2.GaussianBlur(plane.values[crop], (0, 0), 0.7)
    inner = np.s_[margin:-margin, margin:-margin]
    gy, gx = (np.asarray(gradient)[inner].ravel() for gradient in np.gradient(before))
    template = before[inner].ravel()
    now = template
    rows, columns = np.mgrid[margin : before.shape[0] - margin, margin : before.shape[1] - margin].astype(np.float32)
    shift = np.zeros(2)
    for _ in range(_STEPS):
        moved = cv2.remap(after, columns + np.float32(shift[0]), rows + np.float32(shift[1]), cv2.INTER_CUBIC)
        now = np.asarray(moved, dtype=np.float64).ravel()
        # now = gain · (template + g · step) + offset, linear in (gain, offset, gain · step).
        design = np.column_stack([template, np.ones_like(template), gx, gy])
        solution, _, rank, _ = np.linalg.lstsq(design, now, rcond=None)
        if rank < 4 or solution[0] <= 0:
            return None
        step = solution[2:] / solution[0]
        # The crop read at x + shift shows the tag as it was at x + shift − movement.
        shift -= np.clip(step, -1, 1)
        if np.abs(shift).max() > MAX_SHIFT_PX + 1:
            return None
        if np.abs(step).max() < 1e-3:
            break
    correlation = np.corrcoef(now, template)[0, 1]
    return shift if correlation > 0.5 else None
