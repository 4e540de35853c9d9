"""The interface of a projector's control port: its lamp, its faults, its name.

What the projector *shows* is set elsewhere; see `drivers.presenter`. A question that a projector does not know is
answered as one that it cannot tell, never as an error: few know all that their standard has.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol, runtime_checkable


class Power(Enum):
    """The four states of a lamp projector (PJLink 1.04, POWR)."""

    STANDBY = "standby"
    ON = "on"
    COOLING = "cooling"
    WARMING = "warm-up"


class Severity(Enum):
    """How bad a reported fault is (PJLink 1.04, ERST)."""

    WARNING = "warning"
    ERROR = "error"


# The parts of which a projector can report faults, in the order of PJLink 1.04, ERST.
FAULT_PARTS: Final = ("fan", "lamp", "temperature", "cover", "filter", "other")


@dataclass(frozen=True)
class Fault:
    """One fault that a projector reports: `part` is one of `FAULT_PARTS`."""

    part: str
    severity: Severity


@dataclass(frozen=True)
class Lamp:
    """One lamp: its accumulated hours and whether it is lit."""

    hours: int
    lit: bool


@dataclass(frozen=True)
class ProjectorIdentity:
    """Which projector answers, as it names itself; empty where it reports none."""

    maker: str
    model: str
    name: str


class Projector(Protocol):
    """A projector whose control port has been opened."""

    @abstractmethod
    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name."""

    @abstractmethod
    def power(self) -> Power:
        """Return the power state now."""

    @abstractmethod
    def switch_on(self) -> None:
        """Begin to switch on; returns at once, `power` shows when it is done."""

    @abstractmethod
    def switch_off(self) -> None:
        """Begin to switch off; returns at once, `power` shows when it is done."""

    @abstractmethod
    def muted(self) -> bool | None:
        """Return whether the picture is blanked by mute; None where the projector is on and cannot tell."""

    @abstractmethod
    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it."""

    @abstractmethod
    def faults(self) -> tuple[Fault, ...]:
        """Return every fault reported now; empty when healthy, and where the projector cannot tell."""

    @abstractmethod
    def lamps(self) -> tuple[Lamp, ...]:
        """Return every lamp; empty for a lampless projector, and for one that does not count hours."""

    @abstractmethod
    def close(self) -> None:
        """Release the control port; a second call does nothing. The power state stays."""


@runtime_checkable
class ReportsPictureFault(Protocol):
    """A projector that can report, beyond `Projector`, that its picture is not the one that is sent to it."""

    def picture_fault(self) -> str | None:
        """Return why the picture does not follow the signal (frozen, no signal); None if it does, or is not known."""
