"""What is on a simulated camera's pictures, apart from how its body behaves.

`sim.camera.eos` has settings, names and time; a `Film` makes the picture: the `World` as it is lit now (`WorldFilm`),
or the frames of a recorded session (`sim.camera.replay`). Nothing here draws a picture.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import BinaryIO, Protocol

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from foundation.errors import DeviceRefused
from sim.camera.dng import write_dng
from sim.clock import OPENING
from sim.world.world import World


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


class WorldFilm:
    """Pictures of a `World` lit by what the projector shows.

    Parameters
    ----------
    look
        Holds the colour that is shown now.
    light
        Tells the share of its light that leaves the projector now, 0 … 1.
    exposed
        How many pictures of each colour have been taken before: with it a lab that is taken up again goes on with
        the very noise it would have had.
    """

    suffix = ".dng"

    def __init__(
        self,
        world: World,
        look: Callable[[], Colour],
        light: Callable[[], float],
        serial: str,
        exposed: Mapping[Colour, int],
    ) -> None:
        self._world = world
        self._look = look
        self._light = light
        self._serial = serial
        self._exposed = Counter(dict(exposed))

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse what no such body has."""
        for name, value, low, high in (
            ("iso", settings.iso, 100, 6400),
            ("aperture", settings.aperture, 1.0, 32.0),
            ("shutter_s", settings.shutter_s, 1 / 8000, 30.0),
        ):
            if not low <= value <= high:
                raise DeviceRefused(f"the simulated camera offers {name} {low:g} … {high:g}, not {value:g}")

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> int:
        """Photograph the world as it is lit now."""
        colour = self._look()
        hours = (released_at - OPENING).total_seconds() / 3600
        lamp = self._light() * (1 - self._world.room.lamp_drift_per_hour * hours)
        key = (colour.red, colour.green, colour.blue, self._exposed[colour])
        counts = self._world.expose(colour, settings, key=key, lamp=lamp)
        self._exposed[colour] += 1
        start = into.tell()
        write_dng(into, counts, self._world.body, settings=settings, taken_at=released_at, serial=self._serial)
        return into.seek(0, 2) - start
