"""What is kept of a frame: its measurements (`experiment.measures.frame`), and where the chart lay.

`Anchor` is the chart's place in the first white frame, from which later
frames tell how far it has moved, and blurred: its gauges are the chart's tags or, where
no chart is looked for, the places of most texture (`experiment.framing.pictures`); the frame is kept around them alone.
`Frame` is both, and the bytes that the journal keeps of it.

Format of the bytes (version 1): a zip archive of arrays as `numpy.savez` writes it, without pickled objects. `facts` is
UTF-8 JSON as uint8; `tiles` (T, 3) float32; `strips` (S, 3) float32 or empty; an anchor's arrays begin with `anchor_`.
Samples of noise are not kept: the digest knows a frame again. Bytes of another version are passed over: the judge then
begins anew, as at a session's start.

Places are in 2×2 blocks of the mosaic ("half-size pixels"). T = 384 tiles, S strips of rows (four a row of blocks).
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

_TEXTURE_PX = 32  # Side of a textured place that stands for a tag

_TEXTURES = (4, 2)  # Textured places along the frame's width and height: as many as gauges are measured

# How far from where a plane print would have it a white reference is looked for: lens and waves move it as far.
_PAPER_REACH_PX = 4

# Share of the brightest references' light that a place must have to be paper: the field falls off to about that.
_PAPER_LEVEL = 0.7

# Side of the square that is brightest in the middle of a reference of 10 px. Of the 3×3 pixels that are measured the
# brightest would be those whose noise was high in this frame, and all later frames would seem darker by 0.2 %.
_PAPER_PX = 7

_MOST_PAPER = 300  # White references that are looked at: their mean is good to 0.1 % where one is to 2 %


@dataclass(frozen=True, eq=False)
class Anchor:
    """The chart's place in a white frame.

    - `framing`: its tags, or places of texture that stand for tags.
    - `gauges`: the frame around them, of each channel, counts above black; 0 elsewhere.
    - `paper`: (N, 2) int64, columns and rows of blocks in the middle of bare paper.
    - `of_chart`: whether the chart was found; else the places are just textured ones.
    """

    framing: ChartPose
    gauges: dict[Channel, Plane]
    paper: npt.NDArray[np.int64]
    of_chart: bool

    @classmethod
    def of(cls, mosaic: Mosaic, black: _Array, chart: Chart | None) -> Anchor:
        """Return the anchor of a white frame; `black` (2, 2) float64 counts, `chart` None if none is looked for."""
        if chart is None:
            plane = strongest_plane(mosaic, black)
            framing = _textures(plane)
            paper = _brightest(plane.values)
        else:
            framing = find_chart(mosaic, chart, "the white frame")
            whites = np.array([reference.centre_mm for reference in chart.white_references]).reshape(-1, 2)
            paper = _paper(framing.plane.values, project(framing.homography, whites[:_MOST_PAPER]))
        gauges: dict[Channel, Plane] = {c: gauges_of(mosaic, c, black, framing) for c in CHANNELS}
        # The whole plane is let go: only the gauges' surroundings are ever looked at again.
        kept = replace(framing, plane=gauges[framing.plane.channel])
        return cls(kept, gauges, paper, chart is not None)

    def shift(self, mosaic: Mosaic, black: _Array, channel: Channel) -> Shift:
        """Return how far the chart has moved, and how much softer it is, in a later frame's colour.

        `black` (2, 2) float64 counts, of that frame.
        """
        return shift_between(self.gauges[channel], self.framing, gauges_of(mosaic, channel, black, self.framing))

    def displacement(self, mosaic: Mosaic, black: _Array, channel: Channel) -> tuple[float, float] | None:
        """Return how far the tags have moved however far that is, px right and down; None where they are not seen.

        `black` (2, 2) float64 counts, of the frame.
        """
        if not self.of_chart or not self.framing.tags:
            return None
        found = {tag.id: tag.centre_px for tag in detect_tags(plane_of(mosaic, channel, black))}
        moved = [found[tag.id] - tag.centre_px for tag in self.framing.tags if tag.id in found]
        if len(moved) < max(2, len(self.framing.tags) // 4):
            return None
        dx, dy = np.median(np.array(moved), axis=0).tolist()
        return dx, dy

    def paper_level(self, mosaic: Mosaic, black: _Array, phases: dict[Channel, tuple[tuple[int, int], ...]]) -> _Array:
        """Return (3,) float64: camera RGB of bare paper above `black` (2, 2), mean of the middle half of its places.

        All NaN where no place is known.
        """
        blocks = mosaic.block_planes()
        x, y = self.paper.T
        around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        if not len(x):
            return np.full(3, np.nan)
        level, quarter = np.empty(3), len(x) // 4
        for number, channel in enumerate(CHANNELS):
            seen = [
                np.mean([blocks[place][y + dy, x + dx] for dy, dx in around], axis=0) - black[place]
                for place in phases[channel]
            ]
            # A hand before some of the places does not count. The light falls off by a quarter over them, so that
            # their median would rest on the few near it, and on the noise of those.
            level[number] = np.sort(np.mean(seen, axis=0))[quarter : len(x) - quarter].mean()
        return level

    @property
    def outlines(self) -> tuple[_Array, ...]:
        """(K, 2) float64 each, px: outlines of the tags; none where no chart is looked for."""
        if not self.of_chart:
            return ()
        return tuple(tag.corners_px for tag in self.framing.tags)

    def boxes(self) -> list[tuple[int, int, int, int]]:
        """Return what of the gauges' planes is not 0: left, top, right, bottom (exclusive)."""
        height, width = self.framing.plane.values.shape
        return [(x0, y0, min(x1, width), min(y1, height)) for x0, y0, x1, y1 in gauge_boxes(self.framing)]


def _paper(values: npt.NDArray[np.float32], places: _Array) -> npt.NDArray[np.int64]:
    """Return (N, 2) the middles of the brightest squares near places (N, 2) px, if they are as bright as paper."""
    height, width = values.shape
    reach, half = _PAPER_REACH_PX, _PAPER_PX // 2
    seen = reach + half
    at = places.round().astype(np.int64)
    inside = ((at >= seen) & (at < (width - seen, height - seen))).all(axis=1)
    found: list[tuple[int, int]] = []
    levels: list[float] = []
    for x, y in at[inside].tolist():
        around = values[y - seen : y + seen + 1, x - seen : x + seen + 1]
        crop = cv2.blur(around, (_PAPER_PX, _PAPER_PX))[half:-half, half:-half]
        row, column = divmod(int(crop.argmax()), crop.shape[1])
        found.append((x - reach + column, y - reach + row))
        levels.append(float(crop[row, column]))
    if not found:
        return _brightest(values)
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(found, dtype=np.int64)[bright]


def _brightest(values: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Return (N, 2) the brightest 3×3 neighbourhoods of the parts of a plane, those as bright as the brightest.

    Their noise is high in this frame, too: without a chart, a few tenths of a percent of a drift of white are none.
    """
    smooth = cv2.blur(values, (3, 3))
    height, width = smooth.shape
    found: list[tuple[int, int]] = []
    levels: list[float] = []
    for top in range(2, height - height // 12, height // 12):
        for left in range(2, width - width // 16, width // 16):
            part = smooth[top : top + height // 12 - 2, left : left + width // 16 - 2]
            row, column = divmod(int(part.argmax()), part.shape[1])
            found.append((left + column, top + row))
            levels.append(float(part[row, column]))
    bright = np.array(levels) > _PAPER_LEVEL * np.percentile(levels, 90)
    return np.array(found, dtype=np.int64)[bright]


def _textures(plane: Plane) -> ChartPose:
    values = plane.values
    height, width = values.shape
    energy = cv2.boxFilter(cv2.Laplacian(values, cv2.CV_32F) ** 2, -1, (_TEXTURE_PX, _TEXTURE_PX))
    tags: list[DetectedTag] = []
    margin = 2 * _TEXTURE_PX
    half = _TEXTURE_PX / 2
    across, down = _TEXTURES
    for row in range(down):
        for column in range(across):
            top, bottom = (max(margin, row * height // down), min(height - margin, (row + 1) * height // down))
            left, right = (max(margin, column * width // across), min(width - margin, (column + 1) * width // across))
            part = energy[top:bottom, left:right]
            if not part.size:
                continue
            y, x = divmod(int(part.argmax()), part.shape[1])
            middle = np.array([left + x, top + y]) + plane.offset_px
            corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
            tags.append(DetectedTag(len(tags), corners + middle, 0.0))
    return ChartPose(plane, tuple(tags), (), np.eye(3), 0.0, float("nan"), 1.0, True, 0.0)


VERSION = 1  # Of the format of the bytes


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame that was measured.

    - `measured`: its light; `strips` may be empty where they were not kept.
    - `paper`: (3,) float64, camera RGB of bare paper above black; NaN where no paper is known.
    - `moved_px`: (2,) how far the chart lay from the anchor, right and down; NaN where it could not be told.
    - `anchor`: the chart's place, if this frame is the one to compare with from now on.
    """

    measured: Measured
    paper: _Array
    moved_px: _Array
    anchor: Anchor | None = None

    def to_bytes(self, with_strips: bool) -> bytes:
        """Return the bytes that `of_bytes` reads; strips are kept for frames that others are compared with."""
        frame = self.measured
        facts: dict[str, Any] = {
            "version": VERSION,
            "places": [frame.places.rows, frame.places.columns],
            "digest": frame.digest.hex(),
            "noise": [frame.noise.floor, frame.noise.slope],
            "black": [frame.black, frame.black_measured],
            "levels": [frame.range_dn, frame.brightest_dn, frame.clipped, frame.empty],
            "camera": [frame.camera, frame.serial],
            "paper": self.paper.tolist(),
            "moved_px": self.moved_px.tolist(),
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            "tiles": frame.tiles.astype(np.float32),
            "strips": (frame.strips if with_strips else frame.strips[:0]).astype(np.float32),
        }
        if self.anchor is not None:
            arrays |= _anchor_arrays(self.anchor)
            facts["anchor"] = [self.anchor.of_chart, self.anchor.framing.plane.channel]
        arrays["facts"] = np.frombuffer(json.dumps(facts).encode(), dtype=np.uint8)
        stream = io.BytesIO()
        np.savez(stream, **arrays)  # pyrefly: ignore[bad-argument-type]  # no array has the name of an option
        return stream.getvalue()

    @classmethod
    def of_bytes(cls, data: bytes) -> Frame | None:
        """Return the frame of bytes that `to_bytes` made; None where they are of another version, or damaged."""
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
    of_chart, searched = facts
    gauges: dict[Channel, Plane] = {
        channel: Plane(channel, np.zeros(shape, dtype=np.float32), (float(offset[0]), float(offset[1])))
        for channel, offset in zip(CHANNELS, arrays["anchor_offsets"], strict=True)
    }
    framing = ChartPose(
        gauges[searched], tags, (), arrays["anchor_homography"], residual, module, fill,
        bool(arrays["anchor_inside"][0]), turned,
    )  # fmt: skip
    anchor = Anchor(framing, gauges, arrays["anchor_paper"], of_chart)
    for channel in CHANNELS:
        values, crops, begin = gauges[channel].values, arrays[f"anchor_{channel}"], 0
        for x0, y0, x1, y1 in anchor.boxes():
            size = (y1 - y0) * (x1 - x0)
            values[y0:y1, x0:x1] = crops[begin : begin + size].reshape(y1 - y0, x1 - x0)
            begin += size
    return anchor


# How far a file's exposure may lie from the one asked for. Nominal values are rounded, and files state either: 0.3 s
# stands for 0.354 s on a dial of half stops, which is 0.24 stops. A dial turned by one third differs by 0.2 to 0.5
# stops in what the file states, so that most such turns are seen, and every one of more.
EXPOSURE_TOLERANCE_STOPS = 0.25


def disagreement(mosaic: Mosaic, asked: ExposureSettings) -> str | None:
    """Return how the exposure that a raw file states differs from the one asked for, or None where it does not.

    A value that the file does not state is passed over, and so is 0, the aperture of a lens without contacts.
    """
    differing = [
        f"{name} {stated:g} instead of {'none' if wanted is None else f'{wanted:g}'}"
        for name, stated, wanted, stops in (
            ("ISO speed", mosaic.iso, asked.iso, 1),
            ("aperture", mosaic.aperture, asked.aperture, 2),
            ("shutter time in s", mosaic.shutter_s, asked.shutter_s, 1),
        )
        if stated and (wanted is None or abs(stops * math.log2(stated / wanted)) >= EXPOSURE_TOLERANCE_STOPS)
    ]
    if not differing:
        return None
    return f"the file states {', '.join(differing)}; was a dial of the camera turned?"


def refusal(exposure: Exposure, kind: FrameKind, limits: LimitSettings) -> str | None:
    """Return why a frame cannot be used, or None when it can."""
    if kind == "dark":
        if exposure.level * 100 > limits.stray_light_percent:
            return (
                f"the dark frame reaches {exposure.level:.1%} of saturation, {limits.stray_light_percent:g} % allowed; "
                "is another light on, or the projector's picture not black?"
            )
        return None
    if exposure.clipped * 100 > limits.clipped_percent:
        return (
            f"{exposure.clipped:.1%} of the photosites are clipped, {limits.clipped_percent:g} % allowed; "
            "dim the projector, or set a shorter exposure (acquire check recommends one) and begin a new session"
        )
    # Of the greys by which the projector's curve is known the darkest are meant to be dark.
    if kind != "response" and exposure.brightest_dn < limits.too_dark_dn:
        return (
            f"the brightest photosites are {exposure.brightest_dn:.0f} counts above black, "
            f"at least {limits.too_dark_dn:g} expected; is the projector on, its picture not muted, the lens cap off? "
            "If so, expose longer, in a new session"
        )
    return None


def whole_frame(path: Path) -> Mosaic | str:
    """Return the frame of a raw file, or why there is none, or none that is whole."""
    try:
        mosaic = read_raw(path)
    except FormatError as error:
        return str(error)
    fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
    return mosaic if fault is None else f"{path}: {fault}"


def judge_file(path: Path, kind: FrameKind, settings: LabSettings) -> str | None:
    """Decode a raw file and return why it cannot be used, or None when it can."""
    mosaic = whole_frame(path)
    if isinstance(mosaic, str):
        return mosaic
    # What was asked for is not known of frames taken by other means.
    differs = None if settings.rig == "imported" else disagreement(mosaic, settings.camera.exposure)
    return differs or refusal(measure_exposure(mosaic), kind, settings.limits)


class ExposureJudge:
    """A `experiment.session.records.FrameJudge` that looks at the exposure of each frame alone."""

    def __init__(self, settings: LabSettings) -> None:
        self._settings = settings

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return whether the frame can be read and is exposed as it should be."""
        return Judgement.of_reason("exposure", judge_file(file, step.kind, self._settings))

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Do nothing: no frame is held against another."""
