"""Interface of a projector's control port: power, mute, lamp and faults.

`drivers.presenter` sets the displayed image. Many projectors implement only part of their protocol. A query that a
projector does not support returns None or an empty value, and raises no error.
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


# Components with a fault state, in the order of PJLink 1.04, ERST.
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
        True if the lamp is on.
    """

    hours: int
    lit: bool


@dataclass(frozen=True)
class ProjectorIdentity:
    """Identity as the projector reports it; empty texts if it reports none."""

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
        """Start to switch on; returns at once. `power` shows the progress."""

    @abstractmethod
    def switch_off(self) -> None:
        """Start to switch off; returns at once. `power` shows the progress."""

    @abstractmethod
    def muted(self) -> bool | None:
        """Return whether mute blanks the image; None if the projector is on and does not report it."""

    @abstractmethod
    def set_muted(self, muted: bool) -> None:
        """Blank the image (True) or show it (False)."""

    @abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """Return all present faults; empty if there are none or the projector does not report faults."""

    @abstractmethod
    def lamps(self) -> tuple[Lamp, ...]:
        """Return all lamps; empty for a lampless projector, or if it does not count hours."""

    @abstractmethod
    def close(self) -> None:
        """Release the control port and keep the power state; a second call does nothing."""


@runtime_checkable
class ReportsPictureFault(Protocol):
    """A projector that reports if it does not display the signal it receives."""

    def picture_fault(self) -> str | None:
        """Return the reason of a difference between image and signal (frozen, no signal); None if none is reported."""
