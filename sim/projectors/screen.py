"""The simulated screen: one plain colour that the simulated camera sees when it looks."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.presenter import BLACK, Colour
from foundation.clock import Clock
from foundation.errors import DeviceError

REFRESH_S = 1 / 60
"""60 Hz, the usual picture rate."""


@dataclass
class Screen:
    """The colour shown now; shared by the presenter, who writes, and the camera, who looks."""

    colour: Colour = BLACK


class SimulatedPresenter:
    """A `drivers.presenter.Presenter` on a `Screen`."""

    def __init__(self, screen: Screen, clock: Clock) -> None:
        self._screen = screen
        self._clock = clock
        self._open = True

    def show(self, colour: Colour) -> None:
        """Put `colour` on the screen, one refresh from now."""
        if not self._open:
            raise DeviceError("the simulated screen is closed; open the rig again")
        self._clock.sleep(REFRESH_S)
        self._screen.colour = colour

    def close(self) -> None:
        """Leave the screen black."""
        self._screen.colour = BLACK
        self._open = False
