"""The AprilTags of a chart in one colour plane of a picture.

Source: E. Olson, "AprilTag: A robust and flexible visual fiducial system", ICRA 2011; J. Wang and E. Olson,
"AprilTag 2: Efficient and robust fiducial detection", IROS 2016; detected by the AprilTag authors' library
(pyapriltags). Places are half-size pixels (`experiment.framing.planes`).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.framing.planes import MIN_SIGNAL, Plane, paper_level

MIN_MODULE_PX = 3.0
"""Half-size pixels a tag module must have; below, detectors fail one tag after another."""

_CORNERS = [1, 0, 3, 2]
"""pyapriltags' corners in the order clockwise from the printed top-left."""

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
