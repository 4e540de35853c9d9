"""What is on a simulated camera's pictures, apart from how its body behaves.

`sim.camera.eos` has settings, names and time; a `Film` makes the picture: the `World` as it is lit now (`WorldFilm`) or
by a real screen (`WatchedFilm`), or the frames of a recorded session (`sim.camera.replay`). Nothing here draws.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, Colour
from foundation.errors import DeviceRefused
from sim.camera.dng import write_dng
from sim.clock import OPENING
from sim.world.disturbances import CALM, Disturbances, Moment
from sim.world.world import World

_WATCHED = 256
"""First part of the key of a watched frame's noise: no code, so that it is no other frame's."""


class Film(Protocol):
    """Where a simulated camera's pictures come from."""

    @property
    def suffix(self) -> str:
        """Suffix of the raw files, with its dot."""
        ...

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse settings that no picture can be had with (DeviceRefused)."""
        ...

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        """Write the raw file of a picture taken now; return its size in bytes."""
        ...


class WatchedFilm:
    """Pictures of a `World` lit by what falls on it from outside while the shutter is open, in real time.

    `gather`: called with the number of the exposure, from 0, and its seconds; waits for them and returns the light that
    fell on the chart meanwhile: the projected picture (h, w, 3) float32, 0 … 1 of each primary's full light, and the
    share of the lamp's light.
    """

    suffix = ".dng"

    def __init__(
        self,
        world: World,
        gather: Callable[[int, float], tuple[NDArray[np.float32], float]],
        serial: str,
        disturbances: Disturbances,
        opened: datetime,
    ) -> None:
        self._world = world
        self._gather = gather
        self._serial = serial
        self._disturbances = disturbances
        self._opened = opened
        self._frames = itertools.count()

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse what no such body has."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        """Photograph the world as it is lit from now on, for the exposure's time."""
        seconds = (released_at - self._opened).total_seconds()
        moment = Moment(next(self._frames), seconds)
        picture, lamp = self._gather(moment.frame, settings.shutter_s)
        situation = replace(self._disturbances.situation(moment), picture=picture)
        lamp *= 1 - self._world.room.lamp_drift_per_hour * seconds / 3600
        key = (_WATCHED, moment.frame)
        counts = self._world.expose(BLACK, settings, key=key, lamp=lamp, situation=situation)
        counts = self._disturbances.counted(counts, moment)
        start = into.tell()
        write_dng(into, counts, self._world.body, settings=settings, taken_at=released_at, serial=self._serial)
        return into.seek(0, 2) - start


class WorldFilm:
    """Pictures of a `World` lit by what the projector shows.

    `light`: tells the share of its light that leaves the projector now, 0 … 1.
    """

    suffix = ".dng"

    def __init__(
        self,
        world: World,
        look: Callable[[], Colour],
        light: Callable[[], float],
        serial: str,
        exposed: Mapping[Colour, int],
        disturbances: Disturbances = CALM,
        before: Sequence[tuple[float, Colour]] = (),
    ) -> None:
        self._world = world
        self._look = look
        self._light = light
        self._serial = serial
        self._exposed = Counter(dict(exposed))
        self._disturbances = disturbances
        self._before = list(before)
        self._last: tuple[datetime, NDArray[np.uint16]] | None = None

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse what no such body has."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        """Photograph the world as it is lit now."""
        colour = self._look()
        seconds = (released_at - OPENING).total_seconds()
        moment = Moment(len(self._before), seconds, colour, tuple(self._before))
        lamp = self._light() * (1 - self._world.room.lamp_drift_per_hour * seconds / 3600)
        # The noise is that of the frame that was ordered, whatever there is to see.
        key = (*colour.codes, self._exposed[colour])
        self._exposed[colour] += 1
        self._before.append((seconds, colour))
        stale = self._disturbances.stale(moment)
        if stale is None or self._last is None:
            shown, situation = self._disturbances.shown(moment), self._disturbances.situation(moment)
            counts = self._world.expose(shown, settings, key=key, lamp=lamp, situation=situation)
            taken_at, counts = released_at, self._disturbances.counted(counts, moment)
        else:
            taken_at, counts = self._last
            taken_at = released_at if stale.new_header else taken_at
        if self._disturbances.repeats_files:
            self._last = taken_at, counts
        start = into.tell()
        write_dng(into, counts, self._world.body, settings=settings, taken_at=taken_at, serial=self._serial)
        return into.seek(0, 2) - start


def _accept(settings: ExposureSettings) -> None:
    for name, value, low, high in (
        ("iso", settings.iso, 100, 6400),
        ("aperture", settings.aperture, 1.0, 32.0),
        ("shutter_s", settings.shutter_s, 1 / 8000, 30.0),
    ):
        if not low <= value <= high:
            raise DeviceRefused(f"the simulated camera offers {name} {low:g} … {high:g}, not {value:g}")
