"""Find the chart in an image and estimate its pose.

A chart is located by its AprilTags, or by the outline of its patch area if it has no tags. `find_chart` returns a
`ChartPose` or raises `RegistrationError`. Positions are half-size pixels (`drivers.raw.rawfile`).

Sources of the tags: E. Olson, "AprilTag: A robust and flexible visual fiducial system", ICRA 2011; J. Wang and E.
Olson, "AprilTag 2: Efficient and robust fiducial detection", IROS 2016. They are detected by the library of the
AprilTag authors (pyapriltags).
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
from experiment.framing.field import MIN_SIGNAL, DetectedField, corners_text, find_field, paper_level
from experiment.framing.homography import project, rms, robust_homography
from foundation.errors import InputError, RegistrationError

MIN_TAGS = 2  # Smallest number of tags for a homography: two tags have eight corners, and four points are needed.

# At least this fraction of the tags must be detected. If not, a part of the chart is covered, dark or outside the
# image.
MIN_TAG_SHARE = 0.75

MIN_MODULE_PX = 3.0  # Smallest module of a tag, half-size px; tags with smaller modules are often missed

_CORNERS = [1, 0, 3, 2]  # Reorders the corners of pyapriltags clockwise from the printed top-left

_Points = npt.NDArray[np.float64]


_detectors = threading.local()


@dataclass(frozen=True, eq=False)
class DetectedTag:
    """One tag detected in an image."""

    id: int
    corners_px: _Points  # (4, 2), half-size px, clockwise from the printed top-left
    margin: float  # decision margin of the detector; higher is more certain

    @property
    def centre_px(self) -> _Points:
        """(2,) float64 half-size px, mean of the corners."""
        return self.corners_px.mean(axis=0)

    @property
    def side_px(self) -> float:
        """Mean side of the black square, half-size px."""
        return float(np.linalg.norm(self.corners_px - np.roll(self.corners_px, 1, axis=0), axis=1).mean())


@dataclass(frozen=True, eq=False)
class ChartPose:
    """Pose of the chart in one image, in half-size pixels."""

    plane: Plane  # colour plane in which the chart was detected
    tags: tuple[DetectedTag, ...]  # detected tags of the chart, sorted by id
    missing: tuple[int, ...]  # ids of the tags that were not detected
    homography: npt.NDArray[np.float64]  # (3, 3), print (mm) to image (px), without lens distortion
    residual_px: float  # RMS residual of tag corners or outline; includes lens distortion and waves of the paper
    module_px: float  # module of the smallest tag; NaN without tags
    fill: float  # page width / image width, or page height / image height, whichever is larger
    inside: bool  # whether all four page corners are in the image
    rotation_deg: float  # rotation of the x axis of the page, clockwise from the x axis of the image
    field: DetectedField | None = None  # patch area of a chart without tags, else None

    @property
    def complete(self) -> bool:
        """Whether every tag of the chart was detected."""
        return not self.missing


def find_chart(
    frame: Mosaic | Plane,
    chart: Chart,
    image_name: str = "the frame",
    corners: npt.ArrayLike | None = None,
    near: ChartPose | None = None,
) -> ChartPose:
    """Find the chart in an image and return its pose.

    Parameters
    ----------
    frame
        A raw frame, or one of its colour planes. A chart without tags needs the frame.
    image_name
        Name of the image in error messages.
    corners
        (4, 2) float, half-size px: corners of the patch area, clockwise from the printed top-left. Only for a chart
        without tags.
    near
        Pose in another frame of the session. A chart without tags is searched for near this pose.

    Raises
    ------
    InputError
        If corners are given for a chart with tags.
    RegistrationError
        If the chart is not found. The message gives the expected tags, the detected tags and a remedy.
    """
    if chart.tags and corners is not None:
        raise InputError(
            f"corners are given ({corners_text(corners)}), but this chart is located by its {len(chart.tags)} tags; "
            "omit the corners, or give the chart.json of the print in front of the camera"
        )
    if not chart.tags and isinstance(frame, Mosaic):
        return _find_field(frame, chart, image_name, corners, near)
    if len(chart.tags) < MIN_TAGS:
        raise RegistrationError(
            f"{image_name}: the chart has {len(chart.tags)} tags, expected at least {MIN_TAGS}; "
            "print a chart made by acquire chart"
        )
    # Detect the tags in one plane of linear counts. A tone curve or the sum of the planes would shift their corners by
    # 0.2 px.
    plane = strongest_plane(frame) if isinstance(frame, Mosaic) else frame
    detected_tags = detect_tags(plane)
    printed_tags = {tag.id: tag for tag in chart.tags}
    ids = sorted(printed_tags)
    expected_tags = f"{len(ids)} tags 36h11 with ids {ids[0]}–{ids[-1]}"
    tags = tuple(tag for tag in detected_tags if tag.id in printed_tags)
    missing_ids = tuple(tag_id for tag_id in ids if tag_id not in {tag.id for tag in tags})
    if len(tags) < max(MIN_TAGS, len(ids) // 4):
        raise _missing_tags_error(plane, detected_tags, tags, expected_tags, image_name)
    chart_points = np.concatenate([printed_tags[tag.id].corners_mm for tag in tags])
    frame_points = np.concatenate([tag.corners_px for tag in tags])
    homography, fits = robust_homography(chart_points, frame_points, 0.01 * plane.values.shape[1])
    misplaced = [tag.id for index, tag in enumerate(tags) if not fits[4 * index : 4 * index + 4].all()]
    if len(misplaced) > 0.2 * len(tags):
        raise RegistrationError(
            f"{image_name}: {len(misplaced)} of {len(tags)} tags with ids of the chart are in other positions than in "
            "chart.json; this is another chart: give the chart.json of the print in front of the camera"
        )
    tags = tuple(tag for tag in tags if tag.id not in misplaced)
    missing_ids = tuple(sorted({*missing_ids, *misplaced}))
    module = min(tag.side_px for tag in tags) / TAG_MODULES
    if len(tags) < MIN_TAG_SHARE * len(ids):
        is_small = module < MIN_MODULE_PX
        raise RegistrationError(
            f"{image_name}: {len(tags)} of {expected_tags} detected, expected at least "
            f"{int(np.ceil(MIN_TAG_SHARE * len(ids)))} (missing: {_first_ids(missing_ids)}); "
            + (
                f"move the camera closer: a tag module is {module:.1f} px, expected at least {MIN_MODULE_PX:g} px"
                if is_small
                else "uncover the chart, light all of it, and bring all of it into the frame and into focus"
            )
        )
    residual = project(homography, chart_points[fits]) - frame_points[fits]
    return ChartPose(plane, tags, missing_ids, homography, rms(residual), module, *_page_pose(homography, chart, plane))


def _page_pose(homography: npt.NDArray[np.float64], chart: Chart, plane: Plane) -> tuple[float, bool, float]:
    height, width = plane.values.shape
    page_w, page_h = chart.page_mm
    corners = project(homography, [(0, 0), (page_w, 0), (page_w, page_h), (0, page_h)])
    axis = project(homography, [(0, page_h / 2), (page_w, page_h / 2)])
    spans = np.ptp(corners, axis=0) / (width, height)
    inside = bool((corners >= -0.5).all() and (corners <= (width - 0.5, height - 0.5)).all())
    return float(spans.max()), inside, float(np.degrees(np.arctan2(*(axis[1] - axis[0])[::-1])))


def _find_field(
    mosaic: Mosaic, chart: Chart, image_name: str, corners: npt.ArrayLike | None, near: ChartPose | None
) -> ChartPose:
    black = frame_black(mosaic)
    planes = [plane_of(mosaic, channel, black) for channel in CHANNELS]
    near_px = None if near is None or near.field is None else near.field.corners_px
    field = find_field(planes, chart, image_name, corners, near_px)
    distances = ((project(field.homography, field.outline_mm) - field.outline_px) * field.normals).sum(axis=1)
    plane = max(planes, key=paper_level)
    page_pose = _page_pose(field.homography, chart, plane)
    residual_px = float(np.sqrt((distances**2).mean()))
    return ChartPose(plane, (), (), field.homography, residual_px, float("nan"), *page_pose, field=field)


def _missing_tags_error(
    plane: Plane, detected: tuple[DetectedTag, ...], tags: tuple[DetectedTag, ...], expected: str, image_name: str
) -> RegistrationError:
    white = paper_level(plane)
    if white < MIN_SIGNAL:
        return RegistrationError(
            f"{image_name} is dark: its brightest parts are {max(white, 0.0):.0f} counts above black, expected at "
            f"least {MIN_SIGNAL:.0f} counts; switch the projector on, open its shutter, or expose longer"
        )
    mirrored = np.ascontiguousarray(plane.values[:, ::-1])
    if len(detect_tags(Plane(plane.channel, mirrored, (0.0, 0.0)))) > max(1, len(detected)):
        return RegistrationError(
            f"{image_name} is mirrored: {expected} are detected only in the mirrored image; "
            "take the frame without a mirror, or print the chart unmirrored"
        )
    enlarged = cv2.resize(plane.values, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    magnified = detect_tags(Plane(plane.channel, np.asarray(enlarged, dtype=np.float32), (0.0, 0.0)))
    if len(magnified) > max(1, len(detected)):
        module = min(tag.side_px for tag in magnified) / 2 / TAG_MODULES
        return RegistrationError(
            f"{image_name}: the tags are too small: a module is {module:.1f} px, expected at least {MIN_MODULE_PX:g} "
            "px; move the camera closer or use a longer lens"
        )
    if detected and not tags:
        return RegistrationError(
            f"{image_name}: tags {_first_ids([tag.id for tag in detected])} detected, expected {expected}; "
            "this is another chart: give the chart.json of the print in front of the camera"
        )
    return RegistrationError(
        f"{image_name}: {len(tags)} of the {expected} detected; "
        "point the camera at the chart, focus it, and light all of it"
    )


def _first_ids(ids: Sequence[int]) -> str:
    text = ", ".join(str(tag_id) for tag_id in ids[:8])
    return text + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")


def detect_tags(plane: Plane) -> tuple[DetectedTag, ...]:
    """Return the 36h11 tags of a plane, sorted by id, each at most once (the most certain detection).

    Corners are accurate to about 0.09 px RMS with a blur of σ = 0.7 px and modules of 4 px.
    """
    white = paper_level(plane)
    if white < MIN_SIGNAL:
        return ()
    image = np.clip(plane.values * (255.0 / white), 0, 255)
    return _detect(np.rint(image).astype(np.uint8), plane.offset_px)


def _detect(image: npt.NDArray[np.uint8], offset_px: tuple[float, float]) -> tuple[DetectedTag, ...]:
    from pyapriltags import Detector

    # A detector keeps C state between calls, so each thread has its own.
    if not hasattr(_detectors, "detector"):
        _detectors.detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0, refine_edges=1)
    detector: Detector = _detectors.detector
    tags: dict[int, DetectedTag] = {}
    for detection in detector.detect(np.ascontiguousarray(image)):
        # In AprilTag, whole coordinates are corners of pixels. In our code, they are centres of pixels.
        corners = detection.corners[_CORNERS] - 0.5 + np.asarray(offset_px)
        tag = DetectedTag(detection.tag_id, corners, float(detection.decision_margin))
        if detection.hamming <= 1 and (tag.id not in tags or tags[tag.id].margin < tag.margin):
            tags[tag.id] = tag
    return tuple(tags[tag_id] for tag_id in sorted(tags))


# BGR codes: green for the page, red for tags and outlines, amber for texts, grey for ticks.
GREEN, RED, AMBER, _GREY = (60, 200, 60), (40, 40, 255), (40, 200, 255), (200, 200, 200)

FONT = cv2.FONT_HERSHEY_SIMPLEX

# Distance of the ticks on the border of a drawing, raw pixels.
_TICK_RAW_PX = 500

_Image = npt.NDArray[np.uint8]


def annotated_png(mosaic: Mosaic, chart: Chart, pose: ChartPose | None) -> bytes:
    """Draw the pose of the chart onto a frame of half size, and return the drawing as PNG bytes.

    The drawing shows the page and the tags, or the outline of the patch area. Without `pose`, it shows all detected
    tags and the expected ids. If the chart has no tags, it shows how to give the corners of the patch area.
    """
    black = frame_black(mosaic)
    plane = pose.plane if pose is not None else strongest_plane(mosaic, black)
    white = max(float(np.percentile(plane.values[::4, ::4], 99.5)), 1.0)
    grey = np.clip(plane.values / white, 0, 1) ** (1 / 2.2) * 255
    image: _Image = cv2.cvtColor(grey.astype(np.uint8), cv2.COLOR_GRAY2BGR).astype(np.uint8)
    _draw_ticks(image)
    if pose is not None:
        width, height = chart.page_mm
        _draw_outline(image, project(pose.homography, [(0, 0), (width, 0), (width, height), (0, height)]), GREEN)
        _draw_tags(image, pose)
        if pose.field is not None:
            for point in pose.field.outline_px.round().astype(int).tolist():
                cv2.circle(image, point, 2, RED, -1)
    elif chart.tags:
        _draw_missing_tags(image, plane, chart)
    else:
        _draw_text(
            image,
            "this chart has no tags: give the corners of its patch area with --corners,",
            "X,Y on the scale of the border ticks, clockwise from the printed top-left",
        )
    return cv2.imencode(".png", image)[1].tobytes()


def _draw_missing_tags(image: _Image, plane: Plane, chart: Chart) -> None:
    ids = sorted(tag.id for tag in chart.tags)
    detected_tags = detect_tags(plane)
    for tag in detected_tags:
        _draw_outline(image, tag.corners_px, AMBER)
    _draw_text(
        image,
        f"expected: {len(ids)} AprilTags 36h11, ids {ids[0]} to {ids[-1]}",
        f"detected: {', '.join(str(tag.id) for tag in detected_tags[:12]) or 'none'}",
    )


def _draw_tags(image: _Image, pose: ChartPose) -> None:
    for tag in pose.tags:
        _draw_outline(image, tag.corners_px, RED)
        corner = tag.corners_px[0].round().astype(int).tolist()
        cv2.putText(image, str(tag.id), corner, FONT, 0.8, AMBER, 2, cv2.LINE_AA)


def _draw_outline(image: _Image, corners_px: _Points, colour: tuple[int, int, int], width: int = 2) -> None:
    cv2.polylines(image, [corners_px.round().astype(np.int32)], True, colour, width, cv2.LINE_AA)


def _draw_ticks(image: _Image) -> None:
    height, width = image.shape[:2]
    for raw_position in range(_TICK_RAW_PX, 2 * max(height, width), _TICK_RAW_PX):
        position = raw_position // 2
        if position < width:
            cv2.line(image, (position, 0), (position, 12), _GREY, 1)
            cv2.putText(image, str(raw_position), (position + 3, 14), FONT, 0.45, _GREY, 1, cv2.LINE_AA)
        if position < height:
            cv2.line(image, (0, position), (12, position), _GREY, 1)
            cv2.putText(image, str(raw_position), (3, position - 4), FONT, 0.45, _GREY, 1, cv2.LINE_AA)


def _draw_text(image: _Image, *lines: str) -> None:
    height, width = image.shape[:2]
    scale = max(0.4, width / 1600)
    line_height = round(36 * scale)
    image[height - line_height * len(lines) - line_height // 3 :] = 0
    for index, line in enumerate(lines):
        origin = (line_height // 2, height - line_height * (len(lines) - index - 1) - line_height // 2)
        cv2.putText(image, line, origin, FONT, scale, AMBER, 1, cv2.LINE_AA)


# Smallest side of a patch, half-size px: 5 px for its 5 × 5 samples, and 3 px for rounding, registration and blur.
MIN_CELL_PX = 8.0

# Width and height of a half-size image, px, for both cameras of Banić et al. (2019, section 3.3).
HALF_SIZE_PX = {"EOS 550D": (2601, 1732), "EOS 6D Mark II": (3132, 2090)}

FILL = 0.94  # Assumed fraction of the image that the page fills in width or height, whichever is larger


@dataclass(frozen=True)
class _ApparentSize:
    """Size of a chart in the image of a camera: shorter side of a patch and module of a tag (None without tags), px."""

    camera: str
    cell_px: float
    module_px: float | None

    @property
    def is_sufficient(self) -> bool:
        """Whether patches are large enough for 25 samples, and tags for detection."""
        return self.cell_px >= MIN_CELL_PX and (self.module_px is None or self.module_px >= MIN_MODULE_PX)

    def __str__(self) -> str:
        """Return "EOS 550D: 6.1 px a patch, 2.4 px a tag module"."""
        module = "" if self.module_px is None else f", {self.module_px:.1f} px a tag module"
        return f"{self.camera}: {self.cell_px:.1f} px a patch{module}"


def apparent_sizes(chart: Chart) -> list[_ApparentSize]:
    """Return the size of a chart in the image of each camera in `HALF_SIZE_PX`, if it fills 94 % of the frame."""
    module_mm = min((float(np.ptp(tag.corners_mm[:, 0])) / TAG_MODULES for tag in chart.tags), default=None)
    page = sorted(chart.page_mm)
    sizes: list[_ApparentSize] = []
    for camera, frame_px in HALF_SIZE_PX.items():
        px_per_mm = FILL * min(length_px / side for length_px, side in zip(sorted(frame_px), page, strict=True))
        sizes.append(_ApparentSize(camera, min(chart.cell_mm) * px_per_mm, module_mm and module_mm * px_per_mm))
    return sizes


def small_parts_warning(chart: Chart) -> str | None:
    """Return a warning if a camera in `HALF_SIZE_PX` cannot separate the patches or read the tags, else None."""
    sizes = apparent_sizes(chart)
    if all(size.is_sufficient for size in sizes):
        return None
    smallest_module = "" if sizes[0].module_px is None else f" and {MIN_MODULE_PX:g} px a tag module"
    return (
        f"patches of {min(chart.cell_mm):.2f} mm are small for a camera: if the page fills {FILL:.0%} of the half-size "
        f"image, {'; '.join(map(str, sizes))}; at least {MIN_CELL_PX:g} px a patch{smallest_module} are expected: "
        "use fewer bits, larger patches, or a page closer to 3 : 2"
    )
