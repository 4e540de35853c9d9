"""The displays of the desktop, by GLFW: the list of them, and the choice of one.

On Linux GLFW speaks X; under Wayland that is XWayland.

Source: GLFW 3.4 reference, monitor guide.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.display.x11 import outlive
from foundation.errors import ConfigurationError, DeviceError

if TYPE_CHECKING:
    from types import ModuleType

_users = 0
"""How many need GLFW now."""


@dataclass(frozen=True)
class Display:
    """A display as the desktop arranged it; `x`, `y`, `width`, `height` in px of the whole desktop, y down."""

    number: int
    name: str
    x: int
    y: int
    width: int
    height: int
    refresh_hz: int

    @property
    def place(self) -> str:
        """Where it is, such as ``+1920+0``."""
        return f"{self.x:+d}{self.y:+d}"

    def __str__(self) -> str:
        return f"{self.number}: {self.name} {self.width}×{self.height} at {self.place}, {self.refresh_hz} Hz"


def list_displays() -> tuple[Display, ...]:
    """Return every display, from left to right, then from top to bottom; `number` counts them from 1."""
    with running_glfw() as glfw:
        return tuple(display for display, _ in displays_of(glfw))


def choose_display(displays: tuple[Display, ...], wanted: str | int | None = None) -> Display:
    """Return the display that `wanted` names.

    `wanted`: its name (``"HDMI-1"``), its place (``"+1920+0"``), ``"left"``, ``"right"``, or its number; None stands
    for the only one.
    """
    there = "; ".join(str(display) for display in displays) or "none"
    if wanted is None:
        fitting = list(displays)
    elif isinstance(wanted, int):
        fitting = [display for display in displays if display.number == wanted]
    elif wanted in ("left", "right"):
        # With one display, the other is the one that is missing: that is no time to guess.
        ends = [display.x for display in displays]
        if len(set(ends)) < 2:
            raise ConfigurationError(
                f"display {wanted!r}: there are not two displays side by side, but {there}; "
                "connect the projector and extend the desktop to it"
            )
        end = min(ends) if wanted == "left" else max(ends)
        fitting = [display for display in displays if display.x == end]
    elif re.fullmatch(r"[+-]\d+[+-]\d+", wanted):
        fitting = [display for display in displays if display.place == wanted]
    else:
        fitting = [display for display in displays if display.name == wanted]
        if not fitting and wanted.isdecimal():
            return choose_display(displays, int(wanted))
    if len(fitting) == 1:
        return fitting[0]
    named = "no display is named" if wanted is None else f"display {wanted!r}"
    if fitting:
        raise ConfigurationError(f"{named}: {len(fitting)} fit; name one by its place, such as +1920+0; found: {there}")
    raise ConfigurationError(
        f"{named} is not there; found: {there}; connect and switch on the projector, or name another"
    )


@contextlib.contextmanager
def running_glfw() -> Generator[ModuleType]:
    """Yield GLFW's module, running; it is terminated when the last block that needs it ends."""
    global _users
    glfw = _library()
    if not _users:
        if sys.platform == "linux":
            glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
        try:
            glfw.init()
        except glfw.GLFWError as error:
            raise DeviceError(
                f"no desktop to show a picture on ({error}); run this on the machine that the projector is connected "
                "to, logged in there, with DISPLAY set on Linux"
            ) from error
        if sys.platform == "linux":
            outlive(glfw.get_x11_display())
    _users += 1
    try:
        yield glfw
    finally:
        _users -= 1
        if not _users:
            glfw.terminate()


def _library() -> ModuleType:
    """Return GLFW's module, imported late: to load it asks another process for its version."""
    if sys.platform == "linux":
        # The wheel holds two libraries; only the one for X can be made to use it.
        os.environ.setdefault("PYGLFW_LIBRARY_VARIANT", "x11")
    try:
        import glfw
    except (ImportError, OSError) as error:
        raise DeviceError(
            f"GLFW cannot be loaded ({error}); reinstall with: pip install --force-reinstall glfw"
        ) from error
    glfw.ERROR_REPORTING = "exception"
    return glfw


def displays_of(glfw: ModuleType) -> list[tuple[Display, Any]]:
    """Return every display with GLFW's handle on it, in the order of `list_displays`."""
    found: list[tuple[int, int, str, Any]] = []
    for monitor in glfw.get_monitors():
        x, y = glfw.get_monitor_pos(monitor)
        name = glfw.get_monitor_name(monitor)
        found.append((x, y, name.decode("utf-8", "replace") if isinstance(name, bytes) else name, monitor))
    displays: list[tuple[Display, Any]] = []
    for number, (x, y, name, monitor) in enumerate(sorted(found, key=lambda one: one[:3]), 1):
        mode = glfw.get_video_mode(monitor)
        displays.append((Display(number, name, x, y, mode.size.width, mode.size.height, mode.refresh_rate), monitor))
    return displays
