"""Interface of a projector's control port: power, mute, lamp and faults.

The displayed image is set elsewhere, in `drivers.presenter`. Many projectors implement only a part of their protocol. A
query that a projector does not support raises no error, but returns None or an empty value.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol, runtime_checkable


class Power(Enum):
    """Power states of a lamp projector (PJLink 1.04, POWR)."""

    STANDBY = "standby"
    ON = "on"
    COOLING = "cooling"
    WARMING = "warm-up"


class Severity(Enum):
    """Severity of a reported fault (PJLink 1.04, ERST)."""

    WARNING = "warning"
    ERROR = "error"


# Components that can report a fault, in the order of PJLink 1.04, ERST.
FAULT_PARTS: Final = ("fan", "lamp", "temperature", "cover", "filter", "other")


@dataclass(frozen=True)
class Fault:
    """One reported fault.

    Attributes
    ----------
    part
        One of `FAULT_PARTS`.
    severity
        Warning or error.
    """

    part: str
    severity: Severity


@dataclass(frozen=True)
class Lamp:
    """One lamp.

    Attributes
    ----------
    hours
        Accumulated hours of operation.
    lit
        True if the lamp is on; None if the projector does not report it.
    """

    hours: int
    lit: bool | None


@dataclass(frozen=True)
class ProjectorIdentity:
    """Identity that the projector reports; an empty text if it does not report the value."""

    maker: str
    model: str
    name: str


class Projector(Protocol):
    """A projector with an open control port."""

    @abstractmethod
    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name."""

    @abstractmethod
    def power(self) -> Power:
        """Return the current power state."""

    @abstractmethod
    def switch_on(self) -> None:
        """Start to switch on, and return at once; `power` returns the progress."""

    @abstractmethod
    def switch_off(self) -> None:
        """Start to switch off, and return at once; `power` returns the progress."""

    @abstractmethod
    def muted(self) -> bool | None:
        """Return whether the image is muted (black); None if the projector is on and does not report this."""

    @abstractmethod
    def set_muted(self, muted: bool) -> None:
        """Mute the image (True), so that it is black, or show it (False)."""

    @abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """Return all present faults; empty if there are none, or if the projector does not report faults."""

    @abstractmethod
    def lamps(self) -> tuple[Lamp, ...]:
        """Return all lamps; empty for a projector without a lamp (laser, LED), or if it reports no hours."""

    @abstractmethod
    def close(self) -> None:
        """Release the control port and keep the power state; a second call does nothing."""


@runtime_checkable
class ReportsPictureFault(Protocol):
    """A projector that reports if it does not display the image that it receives."""

    def picture_fault(self) -> str | None:
        """Return why the received image is not displayed (frozen, no signal); None if no fault is reported."""
