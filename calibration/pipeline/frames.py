"""The frames that a table is made of: which, in what order, and each read once, its hash checked, and decoded.

Laws that hold inside:

- Every frame is read once, its SHA-256 checked against the journal before one of its counts is believed.
- The last accepted frame of a light counts.
- Dark frames stand where they were taken: what is learnt from one holds for those after it.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from acquisition.framing.planes import CHANNELS, Channel, frame_black, phases
from acquisition.session.folder import FrameRecord, Session
from calibration.radiometry.paper import saturation
from calibration.radiometry.primaries import pure_lights
from calibration.table.lut import Frame, Lut, frames_sha256
from drivers.raw.rawfile import Mosaic, decode_raw
from foundation.errors import FormatError
from foundation.files import read_whole
from foundation.hashing import file_sha256
from foundation.processors import processor_count

MOST_THREADS = 8
"""Each thread holds a raw file and its counts, 110 MB for a 6D Mark II: more would not stay below 2 GB."""

_Array = npt.NDArray[np.float64]
_Result = TypeVar("_Result")
Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and what is being done."""


@dataclass(frozen=True, eq=False)
class Decoded:
    """A frame as read.

    Attributes
    ----------
    record
        The frame.
    mosaic
        Its counts.
    black
        (2, 2) float64 counts, black level of each position of the block.
    strongest
        The colour with the brightest paper.
    saturation
        Raw count of saturation, as far as this frame tells.
    """

    record: FrameRecord
    mosaic: Mosaic
    black: _Array
    strongest: Channel
    saturation: int


def threads() -> int:
    """Return how many frames are read and measured at a time: one a processor, as far as memory allows."""
    return min(processor_count(), MOST_THREADS)


def chosen_frames(session: Session) -> tuple[list[FrameRecord], list[int]]:
    """Return the frames a table is made of, and the lights that have none.

    The frames are every light's last accepted, and the white and dark ones, in the order taken.

    Raises
    ------
    FormatError
        Two lights have the same raw file.
    """
    last: dict[int, FrameRecord] = {}
    for record in accepted_lights(session):
        if record.illumination is not None:
            last[record.illumination] = record
    lights_of: dict[str, int] = {}
    for light, record in last.items():
        other = lights_of.setdefault(record.sha256, light)
        if other != light:
            raise FormatError(
                f"{session.folder}: lights {other} and {light} have the same raw file, {record.file}, SHA-256 "
                f"{record.sha256[:16]}…; each light has its own, so correct the list of frames and import it again"
            )
    missing = [light.index for light in session.illuminations if light.index not in last]
    others = [record for record in session.frames() if record.kind in ("white", "dark") and record.accepted]
    return sorted([*last.values(), *others], key=lambda record: (record.taken_at, record.file)), missing


def accepted_lights(session: Session) -> list[FrameRecord]:
    """Return the accepted frames of lights."""
    return [record for record in session.frames() if record.kind == "light" and record.accepted]


def best_frame(session: Session) -> FrameRecord:
    """Return the frame to register: the first accepted white one, or else the brightest light's.

    Raises
    ------
    FormatError
        No frame is accepted.
    """
    whites = [record for record in session.frames() if record.kind == "white" and record.accepted]
    if whites:
        return whites[0]
    lights = accepted_lights(session)
    if not lights:
        raise FormatError(
            f"{session.folder} holds no accepted frame; take the session with acquire run, then build the table"
        )

    def brightness(record: FrameRecord) -> int:
        if record.illumination is None or record.illumination >= len(session.illuminations):
            return -1
        colour = session.illuminations[record.illumination].colour
        return min(colour.red, colour.green, colour.blue)

    return max(lights, key=brightness)


def pure_frames(session: Session, chosen: Sequence[FrameRecord]) -> list[FrameRecord]:
    """Return those of the chosen frames that show red, green and blue alone; none where one of the three is lacking."""
    lights = pure_lights(session.illuminations) or ()
    found = {record.illumination: record for record in chosen if record.kind == "light"}
    return [found[light] for light in lights] if all(light in found for light in lights) else []


def decode(session: Session, record: FrameRecord) -> Decoded:
    """Read a frame.

    Raises
    ------
    FormatError
        Its file is missing, not what the journal says, or no raw file.
    """
    path = session.folder / record.file
    try:
        data = read_whole(path)
    except FileNotFoundError as error:
        raise FormatError(
            f"{path} is missing, but the session's journal counts it; restore the file from a copy, "
            "or take the light again with acquire run"
        ) from error
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
    found = hashlib.sha256(data).hexdigest()
    if found != record.sha256:
        raise FormatError(
            f"{path} is not the file that was taken: its SHA-256 is {found[:16]}…, the journal says "
            f"{record.sha256[:16]}…; restore the file from a copy, or take the light again with acquire run"
        )
    mosaic = decode_raw(data, path)
    black = frame_black(mosaic)
    return Decoded(record, mosaic, black, strongest_channel(mosaic, black), saturation(mosaic))


def strongest_channel(mosaic: Mosaic, black: _Array) -> Channel:
    """Return the colour with the brightest paper, from every sixteenth block."""
    blocks = mosaic.block_planes()[:, :, ::16, ::16]
    levels = [
        max(float(np.percentile(blocks[place], 98) - black[place]) for place in places)
        for places in phases(mosaic).values()
    ]
    return CHANNELS[int(np.argmax(levels))]


def ahead(
    work: Callable[[FrameRecord], _Result], records: Sequence[FrameRecord], waits: Callable[[FrameRecord], bool]
) -> Generator[tuple[FrameRecord, _Result]]:
    """Yield each frame with what `work` made of it, in order, while threads work on those that follow.

    Parameters
    ----------
    work
        Called in a thread of its own.
    records
        The frames.
    waits
        Whether those after a frame cannot be worked on until it has been taken in.
    """
    count = threads()
    with ThreadPoolExecutor(count) as pool:
        waiting: deque[tuple[FrameRecord, Future[_Result]]] = deque()
        todo = deque(records)
        try:
            while todo or waiting:
                while todo and len(waiting) <= count and not any(waits(record) for record, _ in waiting):
                    record = todo.popleft()
                    waiting.append((record, pool.submit(work, record)))
                record, future = waiting[0]
                result = future.result()
                yield record, result
                waiting.popleft()
        finally:
            for _, future in waiting:
                future.cancel()


def session_sha256(records: Sequence[FrameRecord]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    return frames_sha256(listed(records))


def listed(records: Sequence[FrameRecord]) -> list[Frame]:
    """Return frames as a table lists them."""
    return [Frame(record.kind, record.illumination, record.file, record.sha256) for record in records]


def lost_frames(lut: Lut, session: Session, progress: Progress | None = None) -> list[str]:
    """Return which of the frames that a table was made of are not in a session, or not as they were, each in words.

    Raises
    ------
    FormatError
        The table lists no frames, as those made before they were recorded.
    """
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
