"""The frames that a table is made of: which, in what order, and each read once, its hash checked, and decoded.

Rules that hold inside:

- A frame's SHA-256 is checked against the journal before one of its counts is used.
- The last accepted frame of a light counts.
- Dark frames stand where they were taken: what is measured in one holds for the frames after it.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from calibration.citation import Rig, StatedOrigin
from calibration.radiometry.primaries import pure_lights
from calibration.table.lut import Lut, SourceFrame
from drivers.raw.rawfile import Mosaic, decode_raw
from experiment.config import CameraSettings, CitationSettings
from experiment.framing.planes import Channel, frame_black, strongest_channel
from experiment.measures.sensor import saturation
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from foundation.errors import CropError, FormatError
from foundation.files import read_whole
from foundation.hashing import file_sha256

_Array = npt.NDArray[np.float64]
_TAKEN_AGAIN = "or take it again: acquire run LAB.toml SESSION finds such frames by itself"

ReportProgress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""


class ChangedFrame(FormatError):
    """A frame's file is gone, or is not what was taken; the next run of the session takes it again by itself."""


_RIGS: tuple[Rig, ...] = ("lab", "simulated", "replay", "imported")

_SETTING_RIGS = ("lab", "simulated")
"""Rigs whose settings set the camera; of others they say nothing of the exposure."""


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """A frame as read.

    `mosaic`: its counts.

    - `black`: (2, 2) float64 counts, black level of each position of the block.
    - `strongest`: the channel with the brightest paper.
    - `saturation`: raw count of saturation, as far as it can be seen in this frame.
    """

    record: FrameRecord
    mosaic: Mosaic
    black: _Array
    strongest: Channel
    saturation: int


@dataclass(frozen=True, eq=False)
class SelectedFrames:
    """The frames that a table is made of.

    - `records`: every light's last accepted frame, and the accepted white and dark ones, in the order taken.
    - `lights_without`: lights that have no accepted frame.
    - `registered`: the frame in which the chart is registered first.
    - `primaries`: the frames of red, green and blue alone; () where one of the three is lacking.
    """

    records: tuple[FrameRecord, ...]
    lights_without: tuple[int, ...]
    registered: FrameRecord
    primaries: tuple[FrameRecord, ...]

    @cached_property
    def first_lit(self) -> FrameRecord:
        """The first frame that is not dark."""
        return next(record for record in self.records if record.kind != "dark")

    @property
    def newest(self) -> FrameRecord:
        """The frame that was taken last, dark ones apart."""
        lit = (record for record in self.records if record.kind != "dark")
        return max(lit, key=lambda record: record.attempt)

    def is_even(self, record: FrameRecord) -> bool:
        """Return whether a frame's samples show how even cells are: the white ones, or the first with any light."""
        return record.kind == "white" or record is self.first_lit


def select_frames(session: Session) -> SelectedFrames:
    """Return the frames that a table of a session is made of, so far."""
    accepted = [record for record in session.frames() if record.accepted]
    if not any(record.kind in ("white", "light") for record in accepted):
        raise FormatError(
            f"{session.folder} holds no accepted frame; take the session with acquire run, then build the table"
        )
    last = _last_of_each_light(session, accepted)
    others = [record for record in accepted if record.kind in ("white", "dark")]
    pure = pure_lights(session.illuminations) or ()
    return SelectedFrames(
        records=_in_order_taken(session, [*last.values(), *others]),
        lights_without=tuple(light.index for light in session.illuminations if light.index not in last),
        registered=_frame_to_register(session, accepted),
        primaries=tuple(last[light] for light in pure) if all(light in last for light in pure) else (),
    )


def _in_order_taken(session: Session, records: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
    """Return frames in the order taken, by the journal, with times that go on.

    White frames are interpolated in time: where a clock was set back between two frames (sessions of older software),
    what follows counts as taken the usual interval later. Frames that were taken by other means have their times alone.
    """
    if any(event.what == "import" for event in session.journal.events()):
        return tuple(sorted(records, key=lambda record: (record.taken_at, record.file)))
    ordered = sorted(records, key=lambda record: record.attempt)
    gaps = [after.taken_at - before.taken_at for before, after in pairwise(ordered)]
    nothing = timedelta(0)
    forward = [gap.total_seconds() for gap in gaps if gap > nothing]
    usual = timedelta(seconds=median(forward)) if forward else nothing
    moved, behind = ordered[:1], timedelta(0)
    for record, gap in zip(ordered[1:], gaps, strict=True):
        behind += usual - gap if gap < nothing else nothing
        moved.append(replace(record, taken_at=record.taken_at + behind))
    return tuple(moved)


def _last_of_each_light(session: Session, accepted: Sequence[FrameRecord]) -> dict[int, FrameRecord]:
    last = {
        record.illumination: record for record in accepted if record.kind == "light" and record.illumination is not None
    }
    lights_of: dict[str, int] = {}
    for light, record in last.items():
        other = lights_of.setdefault(record.sha256, light)
        if other != light:
            raise FormatError(
                f"{session.folder}: lights {other} and {light} have the same raw file, {record.file}, SHA-256 "
                f"{record.sha256[:16]}…; each light has its own, so correct the list of frames and import it again"
            )
    return last


def _frame_to_register(session: Session, accepted: Sequence[FrameRecord]) -> FrameRecord:
    """Return the first white frame, or else the brightest light's."""
    white = next((record for record in accepted if record.kind == "white"), None)
    if white is not None:
        return white

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        return min(session.illuminations[record.illumination].codes)

    return max((record for record in accepted if record.kind == "light"), key=brightness)


def decode_frame(session: Session, record: FrameRecord) -> DecodedFrame:
    """Return a frame as read from its file, whose SHA-256 is checked first."""
    path = session.folder / record.file
    try:
        data = read_whole(path)
    except FileNotFoundError as error:
        raise ChangedFrame(
            f"{path} is missing, but the session's journal counts it; restore the file from a copy, {_TAKEN_AGAIN}"
        ) from error
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise ChangedFrame(
            f"{path} is not the file that was taken: its SHA-256 is {found[:16]}…, the journal says "
            f"{record.sha256[:16]}…; restore the file from a copy, {_TAKEN_AGAIN}"
        )
    mosaic = decode_raw(data, path)
    black = frame_black(mosaic)
    return DecodedFrame(record, mosaic, black, strongest_channel(mosaic, black), saturation(mosaic))


def stated_origin(session: Session) -> StatedOrigin:
    """Return what a session states; what older software did not write, or is damaged, is not known."""
    try:
        document: dict[str, Any] = tomllib.loads(session.settings_text())
        rig: Rig | None = next((known for known in _RIGS if known == document.get("rig")), None)
        citation = CitationSettings.model_validate(document.get("citation", {}))
        set_by = CameraSettings.model_validate(document["camera"]) if rig in _SETTING_RIGS else None
    except (CropError, ValidationError, ValueError, KeyError, RecursionError):
        return StatedOrigin(CitationSettings(), None, None, session.journal.records())
    return StatedOrigin(citation, rig, set_by, session.journal.records())


def source_frames(records: Sequence[FrameRecord]) -> list[SourceFrame]:
    """Return frames as `frames.csv` of a table lists them."""
    return [SourceFrame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def frame_faults(lut: Lut, session: Session, progress: ReportProgress | None = None) -> list[str]:
    """Return which of the frames that a table was made of are missing or changed, each fault in words."""
    if lut.provenance.computed is not None:
        raise FormatError(f"{lut.folder} was computed, no frame was taken for it; verify it without a session")
    if not lut.frames:
        raise FormatError(f"{lut.folder} lists no frames; build it again from its session to have them listed")
    faults: list[str] = []
    if session.chart.sha256 != lut.provenance.chart_sha256:
        faults.append(f"{session.folder / 'chart.json'} is not the chart of the table")
    for done, frame in enumerate(lut.frames, 1):
        path = session.folder / frame.file
        try:
            found = file_sha256(path)
        except OSError as error:
            faults.append(f"{path} cannot be read: {error.strerror}")
        else:
            if found != frame.sha256:
                faults.append(f"{path} has changed: its SHA-256 is {found[:16]}…, the table's {frame.sha256[:16]}…")
        if progress is not None:
            progress(done, len(lut.frames), frame.file)
    return faults
