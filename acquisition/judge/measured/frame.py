"""A frame as the judge keeps it: what was measured, where the chart was, and the bytes that the journal keeps of it.

Format of the bytes (version 1): a zip archive of arrays as `numpy.savez` writes it, without pickled objects. `facts` is
UTF-8 JSON as uint8; `tiles` (T, 3) float32; `strips` (S, 3) float32 or empty; an anchor's arrays begin with `anchor_`.
Samples of noise are not kept: the digest knows a frame again. Bytes of another version are passed over: the judge then
begins anew, as at a session's start.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.judge.measured.anchor import Anchor
from acquisition.judge.measured.measuring import FramePlaces, Measured, Noise
from experiment.framing.field import FoundField
from experiment.framing.finding import FoundTag, Framing
from experiment.framing.planes import CHANNELS, Channel, Plane

VERSION = 1
"""Of the format of the bytes."""

_Array = npt.NDArray[np.float64]


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
        np.savez(stream, **arrays)  # pyright: ignore[reportArgumentType]
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
    if framing.field is not None:
        field = framing.field
        arrays |= {
            "anchor_field": field.homography,
            "anchor_field_corners": field.corners_px,
            "anchor_outline": np.stack([field.outline_mm, field.outline_px, field.normals]),
            "anchor_explained": np.array([field.explained]),
        }
    return arrays


def _anchor(arrays: Any, facts: list[Any], shape: tuple[int, int]) -> Anchor:
    field: FoundField | None = None
    if "anchor_field" in arrays:
        outline_mm, outline_px, normals = arrays["anchor_outline"]
        field = FoundField(
            arrays["anchor_field_corners"], arrays["anchor_field"], outline_mm, outline_px, normals,
            float(arrays["anchor_explained"][0]),
        )  # fmt: skip
    tags = tuple(
        FoundTag(int(number), corners, 0.0)
        for number, corners in zip(arrays["anchor_ids"], arrays["anchor_corners"], strict=True)
    )
    residual, module, fill, turned = arrays["anchor_pose"].tolist()
    of_chart, searched = facts
    gauges: dict[Channel, Plane] = {
        channel: Plane(channel, np.zeros(shape, dtype=np.float32), (float(offset[0]), float(offset[1])))
        for channel, offset in zip(CHANNELS, arrays["anchor_offsets"], strict=True)
    }
    framing = Framing(
        gauges[searched], tags, (), arrays["anchor_homography"], residual, module, fill,
        bool(arrays["anchor_inside"][0]), turned, field,
    )  # fmt: skip
    anchor = Anchor(framing, gauges, arrays["anchor_paper"], of_chart)
    for channel in CHANNELS:
        values, crops, begin = gauges[channel].values, arrays[f"anchor_{channel}"], 0
        for x0, y0, x1, y1 in anchor.boxes():
            size = (y1 - y0) * (x1 - x0)
            values[y0:y1, x0:x1] = crops[begin : begin + size].reshape(y1 - y0, x1 - x0)
            begin += size
    return anchor
