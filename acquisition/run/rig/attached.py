"""What is attached to this machine and reachable from it, for the operator to choose from."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass

from drivers.display.fullscreen import identify_displays, list_displays
from drivers.links.serial import list_serial_ports
from drivers.links.usb import list_devices
from drivers.pjlink.search import search
from foundation.errors import CropError

__all__ = ["Attached", "attached_devices", "identify_displays"]


@dataclass(frozen=True)
class Attached:
    """What of one kind is attached or reachable: `kind` in the plural, what was found, or why it could not be asked."""

    kind: str
    found: tuple[str, ...]
    trouble: str = ""


def attached_devices(search_s: float) -> Generator[Attached]:
    """Yield what is attached and reachable, kind by kind; a kind that cannot be asked says why."""
    yield _attached("cameras on USB", lambda: [str(device) for device in list_devices()])
    yield _attached("serial ports", list_serial_ports)
    yield _attached("displays", lambda: [str(display) for display in list_displays()])
    if search_s > 0:
        yield _attached(
            "projectors by PJLink", lambda: [f"{found.host}, MAC {found.mac}" for found in search(search_s)]
        )


def _attached(kind: str, ask: Callable[[], Iterable[str]]) -> Attached:
    try:
        return Attached(kind, tuple(ask()))
    except CropError as error:
        return Attached(kind, (), str(error))
