"""Where the chart is in a picture: its tags, or the field of a chart without tags, found and its pose measured.

One linear colour plane at a time is searched, the strongest of the frame: a square root moves a tag's corner by a
quarter pixel, a sum of planes under deep red or blue by a fifth. Places are half-size pixels (`drivers.raw.rawfile`).
Faults of the picture are a `RegistrationError` that says what was looked for, what was found, and what helps.

Sources of the tags: E. Olson, "AprilTag: A robust and flexible visual fiducial system", ICRA 2011; J. Wang and E.
Olson, "AprilTag 2: Efficient and robust fiducial detection", IROS 2016; detected by the AprilTag authors' library
(pyapriltags).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CHANNELS, Mosaic, Plane, frame_black, plane_of, strongest_plane
from experiment.chart.model import TAG_MODULES, Chart
from experiment.framing.field import MIN_SIGNAL, FoundField, corners_text, find_field, paper_level
from experiment.framing.homography import project, rms, robust_homography
from foundation.errors import InputError, RegistrationError

MIN_TAGS = 2  # Tags without which no homography is looked for: two give eight points, twice as many as one needs

# Share of the chart's tags that must be found; fewer mean that part of the chart is covered, dark or outside.
MIN_TAG_SHARE = 0.75

MIN_MODULE_PX = 3.0  # Half-size pixels a tag module must have; below, detectors fail one tag after another

_CORNERS = [1, 0, 3, 2]  # pyapriltags' corners in the order clockwise from the printed top-left

_Points = npt.NDArray[np.float64]


_detectors = threading.local()


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


@dataclass(frozen=True, eq=False)
class Framing:
    """The place and the pose of the chart in a picture.

    - `plane`: the colour plane that was searched.
    - `tags`: tags of the chart that were found, by id.
    - `missing`: ids of the chart's tags that were not found.
    - `homography`: (3, 3) float64, millimetres on the print to half-size px, lens distortion not included.
    - `residual_px`: RMS distance of the tags' corners, or the field's outline, from the homography: distortion and
      waviness included, some pixels.
    - `module_px`: half-size pixels per tag module, the smallest tag's; NaN without tags.
    - `fill`: share of the picture's height or width that the page takes, the larger of the two; 1 is full.
    - `inside`: whether all four corners of the page lie in the picture.
    - `rotation_deg`: of the page's x axis against the picture's, clockwise as seen.
    - `field`: outline of the field of cells, by which a chart without tags is found; None for one with tags.
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
    field: FoundField | None = None

    @property
    def complete(self) -> bool:
        """Whether every tag of the chart was found."""
        return not self.missing


def find_chart(
    frame: Mosaic | Plane,
    chart: Chart,
    what: str = "the frame",
    corners: npt.ArrayLike | None = None,
    near: Framing | None = None,
) -> Framing:
    """Return the place and the pose of `chart` in a picture.

    `corners`: (4, 2) float half-size px, corners of the field of cells, clockwise from the printed top-left, for a
    chart without tags. `near`: the chart in another frame of the session, by which a chart without tags is found.
    """
    if chart.tags and corners is not None:
        raise InputError(
            f"corners are given ({corners_text(corners)}), and this chart has {len(chart.tags)} tags by which it is "
            "found; leave the corners out, or name the chart.json of the print that hangs before the camera"
        )
    if not chart.tags and isinstance(frame, Mosaic):
        return _find_field(frame, chart, what, corners, near)
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
    homography, fits = robust_homography(chart_points, frame_points, 0.01 * plane.values.shape[1])
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
    residual = project(homography, chart_points[fits]) - frame_points[fits]
    return Framing(plane, tags, missing, homography, rms(residual), module, *_pose(homography, chart, plane))


def _pose(homography: npt.NDArray[np.float64], chart: Chart, plane: Plane) -> tuple[float, bool, float]:
    """Return how much of the picture the page fills, whether it lies inside, and how it is turned, degrees."""
    height, width = plane.values.shape
    page_w, page_h = chart.page_mm
    corners = project(homography, [(0, 0), (page_w, 0), (page_w, page_h), (0, page_h)])
    axis = project(homography, [(0, page_h / 2), (page_w, page_h / 2)])
    spans = np.ptp(corners, axis=0) / (width, height)
    inside = bool((corners >= -0.5).all() and (corners <= (width - 0.5, height - 0.5)).all())
    return float(spans.max()), inside, float(np.degrees(np.arctan2(*(axis[1] - axis[0])[::-1])))


def _find_field(
    mosaic: Mosaic, chart: Chart, what: str, corners: npt.ArrayLike | None, near: Framing | None
) -> Framing:
    black = frame_black(mosaic)
    planes = [plane_of(mosaic, channel, black) for channel in CHANNELS]
    before = None if near is None or near.field is None else near.field.corners_px
    field = find_field(planes, chart, what, corners, before)
    off = ((project(field.homography, field.outline_mm) - field.outline_px) * field.normals).sum(axis=1)
    plane = max(planes, key=paper_level)
    pose = _pose(field.homography, chart, plane)
    return Framing(plane, (), (), field.homography, float(np.sqrt((off**2).mean())), float("nan"), *pose, field=field)


def _not_found(
    plane: Plane, found: tuple[FoundTag, ...], tags: tuple[FoundTag, ...], looked_for: str, what: str
) -> RegistrationError:
    """Return the likeliest reason, from what the picture shows, why too few of the chart's tags were found."""
    white = paper_level(plane)
    if white < MIN_SIGNAL:
        return RegistrationError(
            f"{what} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, at least "
            f"{MIN_SIGNAL:.0f} expected; switch the projector on, open its shutter, expose longer"
        )
    turned = np.ascontiguousarray(plane.values[:, ::-1])
    if len(find_tags(Plane(plane.channel, turned, (0.0, 0.0)))) > max(1, len(found)):
        return RegistrationError(
            f"{what} is mirrored: none of {looked_for} is found, but mirrored they are; "
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


# BGR codes: of page and tags; of outlines that place them and of what deviates; of texts and candidates; of ticks.
GREEN, RED, AMBER, _GREY = (60, 200, 60), (40, 40, 255), (40, 200, 255), (200, 200, 200)

FONT = cv2.FONT_HERSHEY_SIMPLEX

# Raw pixels from tick to tick along the border: about ten on the longer side of an 18-megapixel frame.
_TICK_RAW_PX = 500

_Image = npt.NDArray[np.uint8]


def annotated_png(mosaic: Mosaic, chart: Chart, framing: Framing | None) -> bytes:
    """Return a frame, stretched to be seen, as PNG bytes: half-size, with what was found, or looked for, drawn on it.

    Found are the page's outline and tags, or the outline of the field. If tags were not found, the picture
    shows tags of any number, and which were looked for; of a chart without tags, it says how to give corners.
    """
    black = frame_black(mosaic)
    plane = framing.plane if framing is not None else strongest_plane(mosaic, black)
    white = max(float(np.percentile(plane.values[::4, ::4], 99.5)), 1.0)
    grey = np.clip(plane.values / white, 0, 1) ** (1 / 2.2) * 255
    image: _Image = cv2.cvtColor(grey.astype(np.uint8), cv2.COLOR_GRAY2BGR).astype(np.uint8)
    _draw_ticks(image)
    if framing is not None:
        width, height = chart.page_mm
        _draw_outline(image, project(framing.homography, [(0, 0), (width, 0), (width, height), (0, height)]), GREEN)
        _draw_tags(image, framing)
        if framing.field is not None:
            for place in framing.field.outline_px.round().astype(int).tolist():
                cv2.circle(image, place, 2, RED, -1)
    elif chart.tags:
        _draw_missing_tags(image, plane, chart)
    else:
        _draw_text(
            image,
            "this chart has no tags: give the corners of its field of cells by --corners,",
            "X,Y as the ticks at the border count, clockwise from the printed top-left",
        )
    return cv2.imencode(".png", image)[1].tobytes()


def _draw_missing_tags(image: _Image, plane: Plane, chart: Chart) -> None:
    ids = sorted(tag.id for tag in chart.tags)
    found = find_tags(plane)
    for tag in found:
        _draw_outline(image, tag.corners_px, AMBER)
    _draw_text(
        image,
        f"looked for: {len(ids)} AprilTags 36h11, ids {ids[0]} to {ids[-1]}",
        f"found: {', '.join(str(tag.id) for tag in found[:12]) or 'none'}",
    )


def _draw_tags(image: _Image, framing: Framing) -> None:
    for tag in framing.tags:
        _draw_outline(image, tag.corners_px, RED)
        place = tag.corners_px[0].round().astype(int).tolist()
        cv2.putText(image, str(tag.id), place, FONT, 0.8, AMBER, 2, cv2.LINE_AA)


def _draw_outline(image: _Image, corners_px: _Points, colour: tuple[int, int, int], width: int = 2) -> None:
    cv2.polylines(image, [corners_px.round().astype(np.int32)], True, colour, width, cv2.LINE_AA)


def _draw_ticks(image: _Image) -> None:
    height, width = image.shape[:2]
    for raw in range(_TICK_RAW_PX, 2 * max(height, width), _TICK_RAW_PX):
        at = raw // 2
        if at < width:
            cv2.line(image, (at, 0), (at, 12), _GREY, 1)
            cv2.putText(image, str(raw), (at + 3, 14), FONT, 0.45, _GREY, 1, cv2.LINE_AA)
        if at < height:
            cv2.line(image, (0, at), (12, at), _GREY, 1)
            cv2.putText(image, str(raw), (3, at - 4), FONT, 0.45, _GREY, 1, cv2.LINE_AA)


def _draw_text(image: _Image, *lines: str) -> None:
    height, width = image.shape[:2]
    scale = max(0.4, width / 1600)
    step = round(36 * scale)
    image[height - step * len(lines) - step // 3 :] = 0
    for number, line in enumerate(lines):
        place = (step // 2, height - step * (len(lines) - number - 1) - step // 2)
        cv2.putText(image, line, place, FONT, scale, AMBER, 1, cv2.LINE_AA)


# Half-size pixels a cell must have for 25 of them to lie safely inside: 5, rounding and registration, and the blur.
# 8.6 already bleeds 1 % at σ = 0.7.
MIN_CELL_PX = 8.0

# Width and height of the paper's cameras' half-size images (section 3.3 names them).
HALF_SIZE_PX = {"EOS 550D": (2601, 1732), "EOS 6D Mark II": (3132, 2090)}

FILL = 0.94  # Share of the frame that a sheet fills along its tighter axis


@dataclass(frozen=True)
class _ApparentSize:
    """What a camera sees of a chart: pixels of a cell's shorter side and of a tag's module (None without tags)."""

    camera: str
    cell_px: float
    module_px: float | None

    @property
    def enough(self) -> bool:
        """Whether 25 pixels of a cell can be sampled and tags be found."""
        return self.cell_px >= MIN_CELL_PX and (self.module_px is None or self.module_px >= MIN_MODULE_PX)

    def __str__(self) -> str:
        """Return "EOS 550D: 6.1 px a cell, 2.4 px a tag module"."""
        module = "" if self.module_px is None else f", {self.module_px:.1f} px a tag module"
        return f"{self.camera}: {self.cell_px:.1f} px a cell{module}"


def apparent_sizes(chart: Chart) -> list[_ApparentSize]:
    """Return what each of the paper's cameras sees of a chart that fills 94 % of its frame, turned as it fits best."""
    module_mm = min((float(np.ptp(tag.corners_mm[:, 0])) / TAG_MODULES for tag in chart.tags), default=None)
    page = sorted(chart.page_mm)
    seen: list[_ApparentSize] = []
    for camera, frame in HALF_SIZE_PX.items():
        px_per_mm = FILL * min(pixels / side for pixels, side in zip(sorted(frame), page, strict=True))
        seen.append(_ApparentSize(camera, min(chart.cell_mm) * px_per_mm, module_mm and module_mm * px_per_mm))
    return seen


def small_parts_warning(chart: Chart) -> str | None:
    """Return a sentence when a camera cannot separate the chart's cells or read its tags, else None."""
    seen = apparent_sizes(chart)
    if all(size.enough for size in seen):
        return None
    least = "" if seen[0].module_px is None else f" and {MIN_MODULE_PX:g} px a tag module"
    return (
        f"cells of {min(chart.cell_mm):.2f} mm are small for a camera: at {FILL:.0%} of the frame (half-size) "
        f"{'; '.join(map(str, seen))}; {MIN_CELL_PX:g} px a cell{least} are needed: fewer bits, larger cells, or a "
        "page nearer to 3 : 2"
    )
