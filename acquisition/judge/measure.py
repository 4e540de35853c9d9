"""Measurements of one frame for the live judge: light, position of the chart, and exposure.

`Anchor` is the position of the chart in the first white frame. Movement and blur of later frames are measured relative
to the anchor, in image areas called gauges. Gauges are the tags of the chart or, without a chart, the areas with most
texture (`experiment.framing.pictures`). `Frame` contains the measurements of a frame.

The journal stores a `Frame` as bytes (version 1): a zip archive of arrays as of `numpy.savez`, without pickled objects.
`facts` is UTF-8 JSON as uint8; `tiles` (T, 3) float32; `strips` (S, 3) float32 or empty; arrays of an anchor have the
prefix `anchor_`. Samples of noise are not stored, because the digest suffices to recognise a repeated file. Bytes of
another version are ignored, and the judge then starts without earlier frames.

Positions are in 2×2 blocks of the mosaic ("half-size pixels"). T = 384 tiles; S strips, four in each row of blocks.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from drivers.camera import ExposureSettings
from drivers.raw.rawfile import (
    CHANNELS,
    Channel,
    Mosaic,
    Plane,
    filled_fault,
    plane_of,
    read_raw,
    strongest_plane,
)
from experiment.chart.model import Chart
from experiment.config import LabSettings, LimitSettings
from experiment.framing.finding import ChartPose, DetectedTag, detect_tags, find_chart
from experiment.framing.homography import project
from experiment.framing.pictures import Shift, gauge_boxes, gauges_of, shift_between
from experiment.measures.exposure import Exposure, measure_exposure
from experiment.measures.frame import FramePlaces, Measured, Noise
from experiment.session.records import FrameKind, Judgement, SessionStep
from foundation.errors import FormatError

_Array = npt.NDArray[np.float64]

_TEXTURE_PX = 32  # Side of a textured area that replaces a tag, half-size px.

_TEXTURE_GRID = (4, 2)  # Number of textured areas along width and height.

# Search radius around the predicted position of a white reference, half-size px. Lens distortion and waves of the paper
# may shift references that far.
_PAPER_SEARCH_PX = 4

# Smallest level of paper, relative to the brightest references. The flat field falls off to about this level.
_PAPER_LEVEL = 0.7

# Side of the square that is measured in a reference of 10 px, half-size px. The brightest is selected. A smaller one
# would be bright by chance in this frame, and later frames would seem darker.
_PAPER_PX = 7

_MAX_REFERENCES = 300  # Number of measured white references. If each has an error of 2 %, their mean has 0.1 %.


@dataclass(frozen=True, eq=False)
class Anchor:
    """Position of the chart in a white frame.

    - `framing`: tags of the chart, or textured areas in place of tags.
    - `gauges`: counts above black of each channel around the tags; 0 elsewhere.
    - `paper`: (N, 2) int64, columns and rows of blocks on white paper.
    - `has_chart`: whether the chart was detected; if not, `framing` has textured areas.
    """

    framing: ChartPose
    gauges: dict[Channel, Plane]
    paper: npt.NDArray[np.int64]
    has_chart: bool

    @classmethod
    def from_white(cls, mosaic: Mosaic, black: _Array, chart: Chart | None) -> Anchor:
        """Return the anchor of a white frame; `black` (2, 2) float64 counts, `chart` None to use textured areas."""
        if chart is None:
            plane = strongest_plane(mosaic, black)
            framing = _textured_areas(plane)
            paper = _brightest_centres(plane.values)
        else:
            framing = find_chart(mosaic, chart, "the white frame")
            whites = np.array([reference.centre_mm for reference in chart.white_references]).reshape(-1, 2)
            paper = _paper_centres(framing.plane.values, project(framing.homography, whites[:_MAX_REFERENCES]))
        gauges: dict[Channel, Plane] = {c: gauges_of(mosaic, c, black, framing) for c in CHANNELS}
        # The full plane is dropped to save memory. Later frames are only compared around the gauges.
        small_framing = replace(framing, plane=gauges[framing.plane.channel])
        return cls(small_framing, gauges, paper, chart is not None)

    def shift(self, mosaic: Mosaic, black: _Array, channel: Channel) -> Shift:
        """Measure movement and blur of a later frame in one channel; `black` (2, 2) float64 counts of that frame."""
        return shift_between(self.gauges[channel], self.framing, gauges_of(mosaic, channel, black, self.framing))

    def displacement(self, mosaic: Mosaic, black: _Array, channel: Channel) -> tuple[float, float] | None:
        """Return a small or large movement, half-size px right and down; None if too few tags are detected.

        `black` (2, 2) float64 counts of the frame.
        """
        if not self.has_chart or not self.framing.tags:
            return None
        centres_px = {tag.id: tag.centre_px for tag in detect_tags(plane_of(mosaic, channel, black))}
        shifts_px = [centres_px[tag.id] - tag.centre_px for tag in self.framing.tags if tag.id in centres_px]
        if len(shifts_px) < max(2, len(self.framing.tags) // 4):
            return None
        dx, dy = np.median(np.array(shifts_px), axis=0).tolist()
        return dx, dy

    def paper_level(self, mosaic: Mosaic, black: _Array, phases: dict[Channel, tuple[tuple[int, int], ...]]) -> _Array:
        """Return the RGB counts (3,) float64 of white paper above black: the mean of the middle half of its places.

        `black`: (2, 2) float64 counts. The result is NaN without white references.
        """
        blocks = mosaic.block_planes()
        x, y = self.paper.T
        around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        if not len(x):
            return np.full(3, np.nan)
        level, quarter = np.empty(3), len(x) // 4
        for number, channel in enumerate(CHANNELS):
            planes = [
                np.mean([blocks[position][y + dy, x + dx] for dy, dx in around], axis=0) - black[position]
                for position in phases[channel]
            ]
            # A hand in front of some places does not change the middle half. A median would be noisier, because the
            # light falls off over the chart.
            level[number] = np.sort(np.mean(planes, axis=0))[quarter : len(x) - quarter].mean()
        return level

    @property
    def outlines(self) -> tuple[_Array, ...]:
        """(K, 2) float64 each, half-size px: outlines of the tags; empty without a chart."""
        if not self.has_chart:
            return ()
        return tuple(tag.corners_px for tag in self.framing.tags)

    def boxes(self) -> list[tuple[int, int, int, int]]:
        """Return the boxes outside of which the gauges are 0: left, top, right, bottom (exclusive)."""
        height, width = self.framing.plane.values.shape
        return [(x0, y0, min(x1, width), min(y1, height)) for x0, y0, x1, y1 in gauge_boxes(self.framing)]


def _paper_centres(values: npt.NDArray[np.float32], places: _Array) -> npt.NDArray[np.int64]:
    """Return (N, 2) centres of the brightest squares near `places` (N, 2) px that are as bright as paper."""
    height, width = values.shape
    reach, half = _PAPER_SEARCH_PX, _PAPER_PX // 2
    margin = reach + half
    rounded = places.round().astype(np.int64)
    inside = ((rounded >= margin) & (rounded < (width - margin, height - margin))).all(axis=1)
    centres: list[tuple[int, int]] = []
    levels: list[float] = []
    for x, y in rounded[inside].tolist():
        around = values[y - margin : y + margin + 1, x - margin : x + margin + 1]
        crop = cv2.blur(around, (_PAPER_PX, _PAPER_PX))[half:-half, half:-half]
        row, column = divmod(int(crop.argmax()), crop.shape[1])
        centres.append((x - reach + column, y - reach + row))
        levels.append(float(crop[row, column]))
    if not centres:
        return _brightest_centres(values)
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(centres, dtype=np.int64)[bright]


def _brightest_centres(values: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Return (N, 2) centres of the brightest 3×3 neighbourhoods in a grid of regions.

    They are partly bright by chance, so white seems to drift by some tenths of a percent in later frames.
    """
    smooth = cv2.blur(values, (3, 3))
    height, width = smooth.shape
    centres: list[tuple[int, int]] = []
    levels: list[float] = []
    for y0 in range(2, height - height // 12, height // 12):
        for x0 in range(2, width - width // 16, width // 16):
            region = smooth[y0 : y0 + height // 12 - 2, x0 : x0 + width // 16 - 2]
            row, column = divmod(int(region.argmax()), region.shape[1])
            centres.append((x0 + column, y0 + row))
            levels.append(float(region[row, column]))
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(centres, dtype=np.int64)[bright]


def _textured_areas(plane: Plane) -> ChartPose:
    values = plane.values
    height, width = values.shape
    energy = cv2.boxFilter(cv2.Laplacian(values, cv2.CV_32F) ** 2, -1, (_TEXTURE_PX, _TEXTURE_PX))
    tags: list[DetectedTag] = []
    margin = 2 * _TEXTURE_PX
    half = _TEXTURE_PX / 2
    across, down = _TEXTURE_GRID
    for row in range(down):
        for column in range(across):
            y0, y1 = (max(margin, row * height // down), min(height - margin, (row + 1) * height // down))
            x0, x1 = (max(margin, column * width // across), min(width - margin, (column + 1) * width // across))
            region = energy[y0:y1, x0:x1]
            if not region.size:
                continue
            y, x = divmod(int(region.argmax()), region.shape[1])
            middle = np.array([x0 + x, y0 + y]) + plane.offset_px
            corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
            tags.append(DetectedTag(len(tags), corners + middle, 0.0))
    return ChartPose(plane, tuple(tags), (), np.eye(3), 0.0, float("nan"), 1.0, True, 0.0)


VERSION = 1  # Version of the byte format


@dataclass(frozen=True, eq=False)
class Frame:
    """Measurements of a frame.

    - `measured`: measurements of the light; `strips` is empty if strips were not stored.
    - `paper`: (3,) float64, RGB counts of white paper above black; NaN without white references.
    - `moved_px`: (2,) displacement of the chart from the anchor, half-size px right and down; NaN if not measured.
    - `anchor`: position of the chart, if later frames are compared with this frame.
    """

    measured: Measured
    paper: _Array
    moved_px: _Array
    anchor: Anchor | None = None

    def to_bytes(self, with_strips: bool) -> bytes:
        """Return the bytes that `from_bytes` reads; `with_strips` for frames with which later frames are compared."""
        measured = self.measured
        facts: dict[str, Any] = {
            "version": VERSION,
            "places": [measured.places.rows, measured.places.columns],
            "digest": measured.digest.hex(),
            "noise": [measured.noise.floor, measured.noise.slope],
            "black": [measured.black, measured.black_measured],
            "levels": [measured.range_dn, measured.brightest_dn, measured.clipped, measured.empty],
            "camera": [measured.camera, measured.serial],
            "paper": self.paper.tolist(),
            "moved_px": self.moved_px.tolist(),
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            "tiles": measured.tiles.astype(np.float32),
            "strips": (measured.strips if with_strips else measured.strips[:0]).astype(np.float32),
        }
        if self.anchor is not None:
            arrays |= _anchor_arrays(self.anchor)
            facts["anchor"] = [self.anchor.has_chart, self.anchor.framing.plane.channel]
        arrays["facts"] = np.frombuffer(json.dumps(facts).encode(), dtype=np.uint8)
        stream = io.BytesIO()
        np.savez(stream, **arrays)  # pyrefly: ignore[bad-argument-type]  # no array has the name of an option
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Frame | None:
        """Return the frame of the bytes of `to_bytes`; None if they have another version or are damaged."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                facts = json.loads(bytes(arrays["facts"]))
                if facts["version"] != VERSION:
                    return None
                rows, columns = facts["places"]
                measured = Measured(
                    tiles=arrays["tiles"].astype(np.float64),
                    strips=arrays["strips"].astype(np.float64),
                    samples=np.empty((0, 2), dtype=np.uint16),
                    digest=bytes.fromhex(facts["digest"]),
                    noise=Noise(*facts["noise"]),
                    black=facts["black"][0],
                    black_measured=facts["black"][1],
                    range_dn=facts["levels"][0],
                    brightest_dn=facts["levels"][1],
                    clipped=facts["levels"][2],
                    empty=facts["levels"][3],
                    camera=facts["camera"][0],
                    serial=facts["camera"][1],
                    places=FramePlaces(rows, columns),
                )
                anchor = _anchor(arrays, facts["anchor"], (rows, columns)) if "anchor" in facts else None
                return cls(measured, np.array(facts["paper"]), np.array(facts["moved_px"]), anchor)
        except (KeyError, ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile):
            return None


def _anchor_arrays(anchor: Anchor) -> dict[str, npt.NDArray[Any]]:
    framing = anchor.framing
    arrays: dict[str, npt.NDArray[Any]] = {
        "anchor_paper": anchor.paper,
        "anchor_ids": np.array([tag.id for tag in framing.tags], dtype=np.int64),
        "anchor_corners": np.array([tag.corners_px for tag in framing.tags]).reshape(-1, 4, 2),
        "anchor_homography": framing.homography,
        "anchor_pose": np.array([framing.residual_px, framing.module_px, framing.fill, framing.rotation_deg]),
        "anchor_inside": np.array([framing.inside]),
        "anchor_offsets": np.array([anchor.gauges[channel].offset_px for channel in CHANNELS]),
    }
    for channel in CHANNELS:
        values = anchor.gauges[channel].values
        crops = [values[y0:y1, x0:x1].ravel() for x0, y0, x1, y1 in anchor.boxes()]
        arrays[f"anchor_{channel}"] = np.concatenate(crops) if crops else np.empty(0, dtype=np.float32)
    return arrays


def _anchor(arrays: Any, facts: list[Any], shape: tuple[int, int]) -> Anchor:
    tags = tuple(
        DetectedTag(int(number), corners, 0.0)
        for number, corners in zip(arrays["anchor_ids"], arrays["anchor_corners"], strict=True)
    )
    residual, module, fill, turned = arrays["anchor_pose"].tolist()
    has_chart, searched = facts
    gauges: dict[Channel, Plane] = {
        channel: Plane(channel, np.zeros(shape, dtype=np.float32), (float(offset[0]), float(offset[1])))
        for channel, offset in zip(CHANNELS, arrays["anchor_offsets"], strict=True)
    }
    framing = ChartPose(
        gauges[searched], tags, (), arrays["anchor_homography"], residual, module, fill,
        bool(arrays["anchor_inside"][0]), turned,
    )  # fmt: skip
    anchor = Anchor(framing, gauges, arrays["anchor_paper"], has_chart)
    for channel in CHANNELS:
        values, crops, begin = gauges[channel].values, arrays[f"anchor_{channel}"], 0
        for x0, y0, x1, y1 in anchor.boxes():
            size = (y1 - y0) * (x1 - x0)
            values[y0:y1, x0:x1] = crops[begin : begin + size].reshape(y1 - y0, x1 - x0)
            begin += size
    return anchor


# Largest difference between the exposure in a file and the requested exposure, stops. Files contain nominal or exact
# values: a nominal 0.3 s may be an exact 0.354 s, which is a difference of 0.24 stops. A dial that was turned by more
# than a third of a stop is always detected.
EXPOSURE_TOLERANCE_STOPS = 0.25


def disagreement(mosaic: Mosaic, settings: ExposureSettings) -> str | None:
    """Return how the exposure in a raw file differs from the settings, or None if it does not.

    Missing values are ignored, and also an aperture of 0, which a lens without contacts has.
    """
    differing = [
        f"{name} {value:g} instead of {'none' if setting is None else f'{setting:g}'}"
        for name, value, setting, stops in (
            ("ISO speed", mosaic.iso, settings.iso, 1),
            ("aperture", mosaic.aperture, settings.aperture, 2),
            ("shutter time in s", mosaic.shutter_s, settings.shutter_s, 1),
        )
        if value and (setting is None or abs(stops * math.log2(value / setting)) >= EXPOSURE_TOLERANCE_STOPS)
    ]
    if not differing:
        return None
    return f"the file has {', '.join(differing)}; check the dials of the camera"


def refusal(exposure: Exposure, kind: FrameKind, limits: LimitSettings) -> str | None:
    """Return why a frame cannot be used, or None if it can."""
    if kind == "dark":
        if exposure.level * 100 > limits.stray_light_percent:
            return (
                f"the dark frame reaches {exposure.level:.1%} of saturation, at most {limits.stray_light_percent:g} % "
                "allowed; switch other lamps off, and make sure that the projector shows black"
            )
        return None
    if exposure.clipped * 100 > limits.clipped_percent:
        return (
            f"{exposure.clipped:.1%} of the photosites are clipped, at most {limits.clipped_percent:g} % allowed; dim "
            "the projector, or set a shorter exposure (acquire check proposes one) and start a new session"
        )
    # Response frames may be dark, because they measure the tone curve of the projector with dark greys, too.
    if kind != "response" and exposure.brightest_dn < limits.too_dark_dn:
        return (
            f"the brightest photosites are {exposure.brightest_dn:.0f} counts above black, at least "
            f"{limits.too_dark_dn:g} counts allowed; make sure that the projector is on, its image is not muted and "
            "the lens cap is off, or start a new session with a longer exposure"
        )
    return None


def whole_frame(path: Path) -> Mosaic | str:
    """Return the mosaic of a raw file, or why it cannot be read or is incomplete."""
    try:
        mosaic = read_raw(path)
    except FormatError as error:
        return str(error)
    fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    return mosaic if fault is None else f"{path}: {fault}"


def judge_file(path: Path, kind: FrameKind, settings: LabSettings) -> str | None:
    """Decode a raw file and return why it cannot be used, or None if it can."""
    mosaic = whole_frame(path)
    if isinstance(mosaic, str):
        return mosaic
    # Imported frames were taken with other settings.
    difference = None if settings.rig == "imported" else disagreement(mosaic, settings.camera.exposure)
    return difference or refusal(measure_exposure(mosaic), kind, settings.limits)


class ExposureJudge:
    """An `experiment.session.records.FrameJudge` that judges only the exposure of each frame."""

    def __init__(self, settings: LabSettings) -> None:
        self._settings = settings

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Judge whether the file can be read and is well exposed."""
        return Judgement.of_reason("exposure", judge_file(file, step.kind, self._settings))

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Do nothing, because frames are judged independently."""
