"""A recorded session as film: each raw file again when its light is shown.

This is how a lab's own recordings become tests. The files are handed out byte for byte, in the order in which they
were taken under each colour; nothing is decoded.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from foundation.errors import DeviceError, DeviceRefused


@dataclass(frozen=True)
class RecordedFrame:
    """One raw file of a recording: under which colour, at which shutter time (0 if unknown) it was taken."""

    colour: Colour
    path: Path
    shutter_s: float


class ReplayFilm:
    """Pictures from a recording; see `sim.camera.film.Film`."""

    def __init__(
        self, frames: Sequence[RecordedFrame], look: Callable[[], Colour], exposed: Mapping[Colour, int]
    ) -> None:
        self._frames: dict[Colour, list[RecordedFrame]] = {}
        for frame in frames:
            self._frames.setdefault(frame.colour, []).append(frame)
        self._look = look
        self._exposed = Counter(dict(exposed))
        self._suffix = frames[0].path.suffix.lower()

    @property
    def suffix(self) -> str:
        """Suffix of the recorded files."""
        return self._suffix

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse a shutter time that the recording was not taken with."""
        times = {frame.shutter_s for frames in self._frames.values() for frame in frames if frame.shutter_s > 0}
        if times and all(abs(settings.shutter_s - time) > 1e-6 * time for time in times):
            known = ", ".join(f"{time:g} s" for time in sorted(times))
            raise DeviceRefused(
                f"the recording was taken with {known}, not with shutter_s = {settings.shutter_s:g}; "
                "set camera.shutter_s in LAB.toml to the recording's"
            )

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        """Hand out the next recorded file of the colour on the screen."""
        del settings, released_at
        colour = self._look()
        frames = self._frames.get(colour, [])
        number = self._exposed[colour]
        if number >= len(frames):
            codes = colour.codes
            raise DeviceRefused(
                f"the recording has {len(frames)} frames under the colour {codes}, frame {number + 1} was asked for; "
                "replay it with the illuminations and sequence settings it was taken with"
            )
        path = frames[number].path
        start = into.tell()
        try:
            with path.open("rb") as recorded:
                shutil.copyfileobj(recorded, into, 1 << 20)
        except FileNotFoundError as error:
            raise DeviceError(f"the recording lacks {path}; restore the file") from error
        self._exposed[colour] += 1
        return into.tell() - start
