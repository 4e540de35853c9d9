"""The interface of whatever fills the projector's picture with one plain colour."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable


class Colour(NamedTuple):
    """The codes of a plain frame as the projector receives them, each 0 … 255; readers of files check that."""

    red: int
    green: int
    blue: int


BLACK = Colour(0, 0, 0)
WHITE = Colour(255, 255, 255)


class Presenter(Protocol):
    """A full-screen plain colour."""

    def show(self, colour: Colour) -> None:
        """Fill the picture with exactly `colour`; returns when it is known to be on the screen.

        Raises
        ------
        DeviceError
            The colour is not, or not exactly, on the screen.
        """

    def close(self) -> None:
        """Leave the screen black and release it; a second call does nothing."""


@runtime_checkable
class ReadsBack(Protocol):
    """A presenter that can read what the screen shows, at any time after `Presenter.show`."""

    def verify(self, colour: Colour) -> None:
        """Return if the screen shows exactly `colour` everywhere now.

        Raises
        ------
        DeviceError
            It does not, or cannot be read; with what covers it where that is known.
        """


@runtime_checkable
class ReportsWarnings(Protocol):
    """A presenter that can report what changes, or may change, the light behind the codes that it shows."""

    def warnings(self) -> tuple[str, ...]:
        """Return a sentence with its remedy for each such cause, a gamma ramp for one; empty when there is none."""
