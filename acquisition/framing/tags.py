"""Where the chart is in a picture: its tags found or its field, its pose judged.

Laws that hold inside:

- One linear colour plane at a time, the strongest of the frame: a square root moves a tag's corner by a quarter pixel,
  a sum of planes under deep red or blue by a fifth.
- Places are half-size pixels (`acquisition.framing.planes`).
- Faults of the picture are a `RegistrationError` that says what was looked for, what was found, and what helps.

Knows the chart and a mosaic of counts; nothing of sessions, cells' colours or lenses
(`calibration.registration.register`).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from acquisition.chart.model import Chart
from acquisition.framing.corners import corners_text
from acquisition.framing.homography import project, rms, robust_homography
from acquisition.framing.planes import CHANNELS, MIN_SIGNAL, Plane, frame_black, paper_level, plane_of, strongest_plane
from acquisition.framing.tagless_field import Field, find_field
from drivers.raw.rawfile import Mosaic
from foundation.errors import InputError, RegistrationError

MIN_MODULE_PX = 3.0
"""Half-size pixels a tag module must have; below, detectors fail one tag after another."""

TAG_MODULES = 8
"""Modules along a 36h11 tag's black square."""

MIN_TAGS = 2
MIN_TAG_SHARE = 0.8
"""Share of the chart's tags that must be found."""

_CORNERS = [1, 0, 3, 2]
"""pyapriltags' corners in the order clockwise from the printed top-left."""

_Float = npt.NDArray[np.float32]
_Points = npt.NDArray[np.float64]


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
        RMS distance of the tags' corners, or the field's outline, from the homography: distortion and waviness
        included, some pixels.
    module_px
        Half-size pixels per tag module, the smallest tag's; NaN without tags.
    fill
        Share of the picture's height or width that the page takes, the larger of the two; 1 is full.
    inside
        Whether all four corners of the page lie in the picture.
    rotation_deg
        Of the page's x axis against the picture's, clockwise as seen.
    field
        Outline of the field of cells, by which a chart without tags is found; None for one with tags.
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
    field: Field | None = None

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
    """Return how `chart` stands in a picture.

    Parameters
    ----------
    frame
        A mosaic, of which the strongest colour is searched, or one plane; a chart without tags needs the mosaic.
    chart
        The chart expected.
    what
        The frame's name for messages.
    corners
        (4, 2) half-size px, corners of the field of cells, clockwise from the printed top-left, for a chart without
        tags; found by themselves if not given.
    near
        How the chart stands in another frame of the session: without tags, it then hangs the same way up.

    Raises
    ------
    InputError
        Corners are told that cannot be, or of a chart with tags.
    RegistrationError
        None of the chart is seen; it is mirrored, too small, another chart, or too little of it fits.
    """
    if chart.tags and corners is not None:
        raise InputError(
            f"corners are told ({corners_text(corners)}), and this chart has {len(chart.tags)} tags by which it is "
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
    return Framing(plane, tags, missing, homography, rms(residual), module, *_stand(homography, chart, plane))


def _stand(homography: npt.NDArray[np.float64], chart: Chart, plane: Plane) -> tuple[float, bool, float]:
    """Return how much of the picture the page fills, whether it lies inside, and how it is turned, degrees."""
    height, width = plane.values.shape
    page_w, page_h = chart.page_mm
    corners = project(homography, [(0, 0), (page_w, 0), (page_w, page_h), (0, page_h)])
    axis = project(homography, [(0.4 * page_w, page_h / 2), (0.6 * page_w, page_h / 2)])
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
    stand = _stand(field.homography, chart, plane)
    return Framing(plane, (), (), field.homography, float(np.sqrt((off**2).mean())), float("nan"), *stand, field=field)


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
