"""Interface of a presenter, which fills the projector's image with one uniform colour."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable


class Colour(NamedTuple):
    """Codes of a uniform image that is sent to the projector.

    Attributes
    ----------
    red, green, blue
        0 to 255. The class does not check this range.
    """

    red: int
    green: int
    blue: int


BLACK = Colour(0, 0, 0)
WHITE = Colour(255, 255, 255)


class Presenter(Protocol):
    """A full-screen display of one uniform colour."""

    def show(self, colour: Colour) -> None:
        """Display `colour` on the whole screen, and return when it is there.

        Raises
        ------
        DeviceError
            The screen does not show exactly these codes.
        """

    def close(self) -> None:
        """Leave the screen black and release it; a second call does nothing."""


@runtime_checkable
class ReadsBack(Protocol):
    """A presenter that can read back the screen at any time after `Presenter.show`."""

    def verify(self, colour: Colour) -> None:
        """Check that the whole screen shows exactly `colour` now.

        Raises
        ------
        DeviceError
            The screen shows other codes or cannot be read. The message names the covering window if it is known.
        """


@runtime_checkable
class ReportsWarnings(Protocol):
    """A presenter that reports settings that change the displayed colour although the codes are right."""

    def warnings(self) -> tuple[str, ...]:
        """Return one sentence with a remedy for each such setting, such as a gamma ramp; empty if there is none."""
