"""Plain colours on a display of the desktop: exact codes, read back from the screen before a frame is taken.

The picture fills one whole display in the mode that the desktop set. `show` returns when the drawn frame and what the
display's server shows are exactly the colour, in every pixel: on X, the screen is read over another connection, as a
screenshot program does; on macOS, the front buffer. A display that was away for a while is filled again by the next
`show`, if it comes back in the mode that it had; one that the window of another process fills is not filled.

Rules that hold inside:

- One thread owns the window: the one that opened it. OpenGL contexts and GLFW want it so.
- The window belongs to this process: however that ends, killed included, the window goes with it.
- GLFW and OpenGL are used here and nowhere else; GLFW runs while anything here is open.

On Linux the window is an X window. Under Wayland that is XWayland, whose compositor may scale and tint behind our back:
`FullScreen.warnings` reports it. Gamma ramps, which night light and colour management load, lie behind everything that
can be read back; `warnings` looks at them, too.

Sources: GLFW 3.4 reference; OpenGL 2.1, clauses 4.2.3 (Clear) and 4.3.2 (ReadPixels), numbers from its header, gl.h;
ICC Profiles in X Specification 0.4.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from drivers.display.x11 import XScreen, is_dark, is_lost, outlive
from drivers.presenter import BLACK, Colour
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, ConfigurationError, DeviceError
from foundation.holds import hold

if TYPE_CHECKING:
    from types import ModuleType

_users = 0  # How many need GLFW now


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
                f"no desktop to show a picture on ({_server_named()}); run this on the machine that the projector is "
                "connected to, logged in there, with DISPLAY set on Linux, and XAUTHORITY where it is no shell of the "
                "desktop's"
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


def _server_named() -> str:
    """Return which desktop was looked for; what GLFW says of it is a number and a text for programmers."""
    if sys.platform != "linux":
        return "none is there for this user"
    display = os.environ.get("DISPLAY")
    return f"DISPLAY={display} does not answer" if display else "DISPLAY is not set"


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


# Numbers from gl.h: the two buffers of a window, the bit of Clear, and what would change a plain colour or its area.
FRONT: Final = 0x0404
BACK: Final = 0x0405
COLOUR_BIT: Final = 0x4000
DITHER: Final = 0x0BD0
SCISSOR: Final = 0x0C11

BGRA: Final = 0x80E1  # The order of channels that the next number is read with (gl.h)
# Read so, a pixel is the number 0xAARRGGBB, which is how drivers keep it: nothing needs converting.
UNSIGNED_INT_8_8_8_8_REVERSED: Final = 0x8367


class OpenGl:
    """The functions of the current context."""

    def __init__(self, glfw: ModuleType) -> None:
        kind: Callable[..., Any] = ctypes.CFUNCTYPE
        number, enum, real = ctypes.c_int, ctypes.c_uint, ctypes.c_float

        def function(name: str, *arguments: type) -> Callable[..., None]:
            address = glfw.get_proc_address(name)
            if not address:
                raise DeviceError(f"OpenGL has no {name} here; install the graphics driver (Debian: libgl1-mesa-dri)")
            return kind(None, *arguments)(address)

        self.clear = function("glClear", enum)
        self.clear_colour = function("glClearColor", real, real, real, real)
        self.disable = function("glDisable", enum)
        self.enable = function("glEnable", enum)
        self.finish = function("glFinish")
        self.read_buffer = function("glReadBuffer", enum)
        self.read_pixels = function("glReadPixels", number, number, number, number, enum, enum, ctypes.c_void_p)
        self.scissor = function("glScissor", number, number, number, number)
        self.viewport = function("glViewport", number, number, number, number)


OPENING_S: Final = 5.0  # How long a window may take to fill its display; window managers animate

CONFIRMING_S: Final = 1.0  # How long a frame may take from the swap to the screen; a compositor adds a frame or two

RAMP_TOLERANCE: Final = 1.5 / 255  # How far a gamma ramp may be from a straight line: drivers end it at 255/256 or at 1

_LOOK_AGAIN_S: Final = 0.002  # Pause between two looks at the screen: a frame lasts eight of them

# 0 … 9 in 3×5 blocks, rows from the top.
_DIGITS: Final = (
    "111101101101111", "010110010010111", "111001111100111", "111001111001111", "101101111001001",
    "111100111001111", "111100111101111", "111001001001001", "111101111101111", "111101111001111",
)  # fmt: skip

_LOOK: Final = "look for a window or notification in front, desktop scaling, or a colour filter"


class FullScreen:
    """A `drivers.presenter.Presenter` on a display; black from the moment it opens.

    Use it from the thread that opened it. It takes no keys: it ends by `close`, or with the process.
    """

    def __init__(self, display: str | int | None = None, clock: Clock = SYSTEM_CLOCK) -> None:
        self._clock = clock
        self._thread = threading.get_ident()
        self._closing = contextlib.ExitStack()
        with contextlib.ExitStack() as opening:
            self._glfw = glfw = opening.enter_context(running_glfw())
            found = displays_of(glfw)
            self.display = choose_display(tuple(one for one, _ in found), display)
            """The display that it fills."""
            self._monitor: Any = next(monitor for one, monitor in found if one == self.display)
            self._screen: XScreen | None = None
            if glfw.get_platform() == glfw.PLATFORM_X11:
                self._screen = XScreen()
                opening.callback(self._screen.close)
            opening.enter_context(_held(self.display))
            self._window: Any = self._open_window()
            opening.callback(glfw.destroy_window, self._window)
            self._gl = OpenGl(glfw)
            self._drawn: npt.NDArray[np.uint32] = np.empty((self.display.height, self.display.width), np.uint32)
            glfw.swap_interval(1)
            self._wait_until_full()
            self._present(BLACK)
            self._closing = opening.pop_all()
        self._open = True

    def show(self, colour: Colour) -> None:
        """Fill the display with exactly `colour`; returns when every pixel has been read back from the screen."""
        self._require_usable()
        self._require_server()
        if not self._is_full():
            self._fill_again()
        self._require_lit()
        self._present(colour)

    def verify(self, colour: Colour) -> None:
        """Return if every pixel of the screen is exactly `colour` now, read once; see `drivers.presenter.ReadsBack`.

        On X what the server shows is read, whoever drew it, and a window in front is named. On macOS it is the window's
        own front buffer, which knows nothing of a window in front.
        """
        self._require_usable()
        self._require_server()
        self._require_full()
        self._require_lit()
        self._glfw.make_context_current(self._window)
        self._require(self._read_screen(), colour, "the screen shows")

    def identify(self) -> None:
        """Show the display's number in big white blocks on black, to identify it among the others."""
        self._require_usable()
        self._glfw.make_context_current(self._window)
        self._fill(BLACK)
        digits = [_DIGITS[int(digit)] for digit in str(self.display.number)]
        columns, rows = 4 * len(digits) + 1, 7
        block = min(self.display.width // columns, self.display.height // rows)
        left = (self.display.width - columns * block) // 2
        top = (self.display.height + rows * block) // 2
        self._gl.enable(SCISSOR)
        self._gl.clear_colour(1.0, 1.0, 1.0, 1.0)
        for place, digit in enumerate(digits):
            for cell in (cell for cell, lit in enumerate(digit) if lit == "1"):
                row, column = divmod(cell, 3)
                # OpenGL counts from the bottom.
                x, y = left + (1 + 4 * place + column) * block, top - (2 + row) * block
                self._gl.scissor(x, y, block, block)
                self._gl.clear(COLOUR_BIT)
        self._gl.disable(SCISSOR)
        self._glfw.swap_buffers(self._window)
        self._gl.finish()
        self._glfw.poll_events()

    def warnings(self) -> tuple[str, ...]:
        """Return what may change the light behind the codes that were read back; empty when nothing does."""
        self._require_usable()
        return _warnings_of(self._glfw, self.display, self._monitor, self._screen)

    def close(self) -> None:
        """Leave the display black and give it back to the desktop; a second call does nothing."""
        if not self._open:
            return
        self._require_usable()
        self._open = False
        # What cannot be shown any more, the end of the window darkens.
        with self._closing, contextlib.suppress(DeviceError):
            self._present(BLACK)

    def _open_window(self) -> Any:
        glfw, display = self._glfw, self.display
        on_x = glfw.get_platform() == glfw.PLATFORM_X11
        # Which ask for 8 bits a channel, and for codes that are shown as they are: no blending of samples, no sRGB.
        glfw.default_window_hints()
        if on_x:
            glfw.window_hint(glfw.POSITION_X, display.x)
            glfw.window_hint(glfw.POSITION_Y, display.y)
        for hint, value in (
            (glfw.VISIBLE, not on_x),
            (glfw.DECORATED, False),
            (glfw.AUTO_ICONIFY, False),  # or it goes away when the operator clicks on another display
            (glfw.CENTER_CURSOR, False),
            (glfw.ALPHA_BITS, 0),
            (glfw.DEPTH_BITS, 0),
            (glfw.STENCIL_BITS, 0),
            (glfw.REFRESH_RATE, display.refresh_hz),
        ):
            glfw.window_hint(hint, value)
        try:
            window = glfw.create_window(display.width, display.height, "CroP", None if on_x else self._monitor, None)
            if on_x:
                self._place(window)
        except glfw.GLFWError as error:
            raise DeviceError(
                f"no picture on display {display}: {error}; check that OpenGL works (Debian: libgl1-mesa-dri)"
            ) from error
        glfw.set_input_mode(window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        glfw.make_context_current(window)
        return window

    def _place(self, window: Any) -> None:
        """Let a window that lies on the display fill it.

        A window manager that knows no ``_NET_WM_FULLSCREEN_MONITORS``, such as Openbox, fills the display on which the
        window lies: one that is made full from the start would come out on the first.
        """
        display = self.display
        refresh_hz = display.refresh_hz or self._glfw.DONT_CARE
        self._glfw.set_window_monitor(window, self._monitor, 0, 0, display.width, display.height, refresh_hz)

    def _wait_until_full(self) -> None:
        deadline = self._clock.monotonic() + OPENING_S
        self._glfw.poll_events()
        while not self._is_full():
            if self._clock.monotonic() > deadline:
                size = "×".join(str(side) for side in self._glfw.get_framebuffer_size(self._window))
                raise DeviceError(
                    f"the window came out as {size} at {self._glfw.get_window_pos(self._window)}, not as display "
                    f"{self.display}; switch off desktop scaling for it"
                )
            self._clock.sleep(_LOOK_AGAIN_S)
            self._glfw.poll_events()

    def _fill_again(self) -> None:
        """Fill the display anew after it was away, switched off or in another mode; it must be as it was."""
        glfw = self._glfw
        for found, monitor in self._displays_now():
            if (found.name, found.width, found.height) == (
                self.display.name,
                self.display.width,
                self.display.height,
            ):
                self.display, self._monitor = found, monitor
                place = found.x, found.y, found.width, found.height
                # A display may go again while this happens.
                with contextlib.suppress(DeviceError, glfw.GLFWError):
                    # As a window it goes where it is put; see `_place`.
                    glfw.set_window_monitor(self._window, None, *place, glfw.DONT_CARE)
                    self._place(self._window)
                    self._wait_until_full()
                break
        self._require_full()

    def _require_server(self) -> None:
        self._glfw.poll_events()
        if self._screen is not None and is_lost(self._glfw.get_x11_display()):
            raise DeviceError(
                f"the X server of display {self.display} is gone: somebody logged out, or it crashed; log in, "
                f"{RUN_AGAIN}"
            )

    def _require_full(self) -> None:
        if not self._is_full():
            there = "; ".join(str(found) for found, _ in self._displays_now()) or "none"
            raise DeviceError(
                f"the window no longer fills display {self.display}; displays now: {there}; check its cable and the "
                "desktop's display settings, until it is as it was"
            )

    def _displays_now(self) -> list[tuple[Display, Any]]:
        try:
            return displays_of(self._glfw)
        except self._glfw.GLFWError:
            return []  # they change this very moment

    def _require_lit(self) -> None:
        if self._screen is not None and is_dark(self._glfw.get_x11_display()):
            raise DeviceError(
                f"power saving keeps display {self.display} dark; move the mouse, and switch it off (xset -dpms)"
            )

    def _is_full(self) -> bool:
        glfw, display = self._glfw, self.display
        if not glfw.get_window_monitor(self._window):
            return False
        size = (display.width, display.height)
        return glfw.get_window_pos(self._window) == (display.x, display.y) and (
            tuple(glfw.get_framebuffer_size(self._window)) == size
        )

    def _present(self, colour: Colour) -> None:
        self._glfw.make_context_current(self._window)
        self._fill(colour)
        self._require(self._read_buffer(BACK), colour, "OpenGL drew", on_screen=False)
        self._glfw.swap_buffers(self._window)
        self._gl.finish()
        deadline = self._clock.monotonic() + CONFIRMING_S
        while True:
            try:
                self._require(self._read_screen(), colour, "the screen shows")
            except DeviceError:
                if self._clock.monotonic() > deadline:
                    raise
                self._clock.sleep(_LOOK_AGAIN_S)
            else:
                return

    def _fill(self, colour: Colour) -> None:
        gl = self._gl
        gl.viewport(0, 0, self.display.width, self.display.height)
        gl.disable(DITHER)
        # Fixed point keeps round(255 · c / 255), which single precision gives back as the code (OpenGL 2.1, 2.14.9).
        gl.clear_colour(colour.red / 255, colour.green / 255, colour.blue / 255, 1.0)
        gl.clear(COLOUR_BIT)

    def _read_screen(self) -> npt.NDArray[np.uint32]:
        if self._screen is None:
            return self._read_buffer(FRONT)
        display = self.display
        return self._screen.read(display.x, display.y, display.width, display.height)

    def _read_buffer(self, buffer: int) -> npt.NDArray[np.uint32]:
        """Return a buffer of the window as (height, width) uint32, 0xRRGGBB, bottom row first."""
        display = self.display
        self._gl.read_buffer(buffer)
        pixels, kind = self._drawn.ctypes.data, UNSIGNED_INT_8_8_8_8_REVERSED
        self._gl.read_pixels(0, 0, display.width, display.height, BGRA, kind, pixels)
        np.bitwise_and(self._drawn, np.uint32(0xFFFFFF), out=self._drawn)
        return self._drawn

    def _require(self, pixels: npt.NDArray[np.uint32], colour: Colour, subject: str, *, on_screen: bool = True) -> None:
        expected = colour.red << 16 | colour.green << 8 | colour.blue
        wrong = pixels != expected
        if wrong.any():
            rows, columns = np.flatnonzero(wrong.any(axis=1)), np.flatnonzero(wrong.any(axis=0))
            top, left = int(rows[0]), int(columns[0])
            first_column = int(np.flatnonzero(wrong[top])[0])
            first = int(pixels[top, first_column])
            found = f"({first >> 16}, {first >> 8 & 255}, {first & 255})"
            size = f"{int(columns[-1]) - left + 1}×{int(rows[-1]) - top + 1} px"
            raise DeviceError(
                f"{subject} {found} in place of ({colour.red}, {colour.green}, {colour.blue}) in "
                f"{np.count_nonzero(wrong)} of {wrong.size} pixels of display {self.display}, within {size} at "
                f"{left:+d}{top:+d}; {self._what_covers(first_column, top) if on_screen else _LOOK}"
            )

    def _what_covers(self, column: int, row: int) -> str:
        """Return what lies in front of a pixel, as far as it can be known, and what to do."""
        cover = None
        if self._screen is not None:
            own: int = self._glfw.get_x11_window(self._window)
            cover = self._screen.cover(self.display.x + column, self.display.y + row, own)
        if cover is not None:
            return f"in front of it lies {cover}: close it, and switch such windows and notifications off"
        return _LOOK

    def _require_usable(self) -> None:
        if not self._open:
            raise DeviceError(f"display {self.display} was closed; open it again")
        if threading.get_ident() != self._thread:
            raise DeviceError(f"display {self.display} belongs to the thread that opened it; use it from there")


@contextlib.contextmanager
def _held(display: Display) -> Generator[None]:
    """Hold a display against other processes; a server's screens (``:0.0``) share their displays."""
    server = re.sub(r"\.\d+$", "", os.environ.get("DISPLAY", ""))
    with hold(f"display {display}", f"display {server} {display.place}"):
        yield


def display_warnings(wanted: str | int | None = None) -> tuple[str, ...]:
    """Return what `FullScreen.warnings` does, of a display that `choose_display` finds, and open no window on it."""
    with contextlib.ExitStack() as opened:
        glfw = opened.enter_context(running_glfw())
        found = displays_of(glfw)
        display = choose_display(tuple(one for one, _ in found), wanted)
        opened.enter_context(_held(display))
        screen: XScreen | None = None
        if glfw.get_platform() == glfw.PLATFORM_X11:
            screen = XScreen()
            opened.callback(screen.close)
        return _warnings_of(glfw, display, next(monitor for one, monitor in found if one == display), screen)


def _warnings_of(glfw: Any, display: Display, monitor: Any, screen: XScreen | None) -> tuple[str, ...]:
    """Return what may change the light of a display; `screen`: the X server's, None where there is none."""
    found: list[str] = []
    bent = _bent_ramp(glfw, monitor)
    if bent:
        found.append(
            f"the gamma ramp of {display.name} is not straight ({bent}): switch off night light and colour management "
            "for this display"
        )
    if screen is not None and (screen.has_extension("XWAYLAND") or display.name.startswith("XWAYLAND")):
        found.append(
            "the desktop is Wayland, whose compositor may scale and tint unseen: log in to an X session (Xorg)"
        )
    if screen is not None and not screen.stays_awake:
        found.append("power saving may darken the display: install libxcb-screensaver0, or switch it off (xset -dpms)")
    if screen is not None and screen.has_root_property(_profile_of(glfw, monitor)):
        found.append(
            f"a colour profile is set for {display.name}, which desktops may apply to what they show: remove it in the "
            "desktop's colour settings (colormgr, dispwin -U)"
        )
    twins = [str(one) for one, _ in displays_of(glfw) if one.place == display.place]
    if len(twins) > 1:
        found.append(f"the same picture goes to several displays ({'; '.join(twins)}): extend, do not mirror")
    return tuple(found)


def _bent_ramp(glfw: Any, monitor: Any) -> str:
    try:
        ramp = glfw.get_gamma_ramp(monitor)
    except glfw.GLFWError:
        # This display has none.
        return ""
    channels = [np.asarray(channel) for channel in ramp]
    if any(_is_noise(values) for values in channels):
        return ""
    for name, values in zip(("red", "green", "blue"), channels, strict=True):
        if not values.any():
            # A server without a ramp of its own keeps zeros; a real one of zeros would be a black picture.
            continue
        off = values - np.linspace(0, 1, values.size)
        worst = int(np.argmax(np.abs(off)))
        if abs(off[worst]) > RAMP_TOLERANCE:
            return f"{name} {worst / (values.size - 1):.2f} becomes {values[worst]:.2f}"
    return ""


def _profile_of(glfw: Any, monitor: Any) -> str:
    """Return the root window's property for a display's profile (ICC Profiles in X Specification 0.4, section 2)."""
    addresses = [ctypes.addressof(one.contents) for one in glfw.get_monitors()]
    number = addresses.index(ctypes.addressof(monitor.contents))
    return "_ICC_PROFILE" if number == 0 else f"_ICC_PROFILE_{number}"


def _is_noise(ramp: npt.NDArray[np.float64]) -> bool:
    """Return whether a gamma ramp goes up and down as none that somebody set: some X servers never write theirs."""
    travel = float(np.abs(np.diff(ramp)).sum())
    return travel > 2 * float(np.ptp(ramp)) and travel > 0.1


def identify_displays(seconds: float, clock: Clock = SYSTEM_CLOCK) -> tuple[Display, ...]:
    """Show on every display its number for a while, and return them."""
    with contextlib.ExitStack() as opened:
        displays = list_displays()
        for display in displays:
            screen = FullScreen(display.number, clock)
            opened.callback(screen.close)
            screen.identify()
        clock.sleep(seconds)
    return displays
