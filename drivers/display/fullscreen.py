"""Fill a whole display with one colour of exact codes, and read the screen back.

The window fills one display in the mode that the desktop has set. `FullScreen.show` returns when every pixel has the
requested code, both in the drawn buffer and on the screen. With X, the screen is read like a screenshot, over another
connection. On macOS, the window's front buffer is read. After a disconnection, the next `show` fills the display again
if its mode is the same. A display that another process uses is refused.

- Only the thread that opened the window may use it, as OpenGL contexts and GLFW require.
- The window disappears when the process ends, even if the process is killed.
- GLFW and OpenGL are used only in this module.

On Linux the window is an X window. Under Wayland it is shown by XWayland, and the compositor may scale or tint the
image without notice. Gamma ramps (night light, colour management) change the image after it is read back.
`FullScreen.warnings` reports both problems.

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

from drivers.display.x11 import XScreen, is_dark, is_lost, survive_server_end
from drivers.presenter import BLACK, Colour
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, ConfigurationError, DeviceError
from foundation.holds import hold

if TYPE_CHECKING:
    from types import ModuleType

_user_count = 0  # Number of open `running_glfw` blocks


@dataclass(frozen=True)
class Display:
    """A display and its area on the desktop; `x`, `y`, `width` and `height` are px of the whole desktop, y down."""

    number: int
    name: str
    x: int
    y: int
    width: int
    height: int
    refresh_hz: int

    @property
    def position(self) -> str:
        """Position on the desktop, such as ``+1920+0``."""
        return f"{self.x:+d}{self.y:+d}"

    def __str__(self) -> str:
        return f"{self.number}: {self.name} {self.width}×{self.height} at {self.position}, {self.refresh_hz} Hz"


def list_displays() -> tuple[Display, ...]:
    """Return all displays from left to right, then top to bottom; `number` counts from 1."""
    with running_glfw() as glfw:
        return tuple(display for display, _ in displays_with_monitors(glfw))


def choose_display(displays: tuple[Display, ...], selection: str | int | None = None) -> Display:
    """Return the selected display.

    `selection` is a name (``"HDMI-1"``), a position (``"+1920+0"``), ``"left"``, ``"right"``, or a number. None selects
    the only display; with several displays it is an error.
    """
    present = "; ".join(str(display) for display in displays) or "none"
    if selection is None:
        matches = list(displays)
    elif isinstance(selection, int):
        matches = [display for display in displays if display.number == selection]
    elif selection in ("left", "right"):
        # A single display may be the wrong one, because the projector may be disconnected.
        x_positions = [display.x for display in displays]
        if len(set(x_positions)) < 2:
            raise ConfigurationError(
                f"display {selection!r} requires two displays side by side (present: {present})",
                remedy="connect the projector and extend the desktop to it",
            )
        x_position = min(x_positions) if selection == "left" else max(x_positions)
        matches = [display for display in displays if display.x == x_position]
    elif re.fullmatch(r"[+-]\d+[+-]\d+", selection):
        matches = [display for display in displays if display.position == selection]
    else:
        matches = [display for display in displays if display.name == selection]
        if not matches and selection.isdecimal():
            return choose_display(displays, int(selection))
    if len(matches) == 1:
        return matches[0]
    subject = "display (not set)" if selection is None else f"display {selection!r}"
    if matches:
        raise ConfigurationError(
            f"{subject}: {len(matches)} displays match, 1 expected; present: {present}; set a position such as +1920+0"
        )
    raise ConfigurationError(
        f"{subject} is not connected (present: {present})",
        remedy="connect and switch on the projector, or set another display",
    )


@contextlib.contextmanager
def running_glfw() -> Generator[ModuleType]:
    """Yield the initialised module of GLFW; GLFW is terminated when the last such block ends."""
    global _user_count
    glfw = _load_glfw()
    if not _user_count:
        if sys.platform == "linux":
            glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_X11)
        try:
            glfw.init()
        except glfw.GLFWError as error:
            raise DeviceError(
                f"no desktop is available ({_server_state()}); log in to the computer with the projector and run this "
                "there, and on Linux set DISPLAY, and XAUTHORITY in a shell outside the desktop"
            ) from error
        if sys.platform == "linux":
            survive_server_end(glfw.get_x11_display())
    _user_count += 1
    try:
        yield glfw
    finally:
        _user_count -= 1
        if not _user_count:
            glfw.terminate()


def _server_state() -> str:
    if sys.platform != "linux":
        return "none for this user"
    display = os.environ.get("DISPLAY")
    return f"DISPLAY={display} does not reply" if display else "DISPLAY is not set"


def _load_glfw() -> ModuleType:
    if sys.platform == "linux":
        # The wheel of glfw contains two libraries; only the one for X supports the platform X11.
        os.environ.setdefault("PYGLFW_LIBRARY_VARIANT", "x11")
    # The import is slow, because it starts another process to read the version of GLFW.
    try:
        import glfw
    except (ImportError, OSError) as error:
        raise DeviceError(
            f"GLFW cannot be loaded ({error}); reinstall with: pip install --force-reinstall glfw"
        ) from error
    glfw.ERROR_REPORTING = "exception"
    return glfw


def displays_with_monitors(glfw: ModuleType) -> list[tuple[Display, Any]]:
    """Return all displays with their GLFW monitors, in the order of `list_displays`."""
    monitors: list[tuple[int, int, str, Any]] = []
    for monitor in glfw.get_monitors():
        x, y = glfw.get_monitor_pos(monitor)
        name = glfw.get_monitor_name(monitor)
        monitors.append((x, y, name.decode("utf-8", "replace") if isinstance(name, bytes) else name, monitor))
    displays: list[tuple[Display, Any]] = []
    for number, (x, y, name, monitor) in enumerate(sorted(monitors, key=lambda monitor: monitor[:3]), 1):
        mode = glfw.get_video_mode(monitor)
        displays.append((Display(number, name, x, y, mode.size.width, mode.size.height, mode.refresh_rate), monitor))
    return displays


# Numbers from gl.h: buffers of a window, the colour bit of glClear, and two settings that can change the drawn image.
FRONT: Final = 0x0404
BACK: Final = 0x0405
COLOUR_BIT: Final = 0x4000
DITHER: Final = 0x0BD0
SCISSOR: Final = 0x0C11

BGRA: Final = 0x80E1  # Order of channels (gl.h)
# Type of pixels as numbers 0xAARRGGBB. Graphics drivers store them in this format, so no conversion is needed.
UNSIGNED_INT_8_8_8_8_REVERSED: Final = 0x8367


class OpenGl:
    """Functions of the current OpenGL context."""

    def __init__(self, glfw: ModuleType) -> None:
        prototype: Callable[..., Any] = ctypes.CFUNCTYPE
        number, enum, floating = ctypes.c_int, ctypes.c_uint, ctypes.c_float

        def function(name: str, *arguments: type) -> Callable[..., None]:
            address = glfw.get_proc_address(name)
            if not address:
                raise DeviceError(f"OpenGL does not have {name}; install the graphics driver (Debian: libgl1-mesa-dri)")
            return prototype(None, *arguments)(address)

        self.clear = function("glClear", enum)
        self.clear_colour = function("glClearColor", floating, floating, floating, floating)
        self.disable = function("glDisable", enum)
        self.enable = function("glEnable", enum)
        self.finish = function("glFinish")
        self.read_buffer = function("glReadBuffer", enum)
        self.read_pixels = function("glReadPixels", number, number, number, number, enum, enum, ctypes.c_void_p)
        self.scissor = function("glScissor", number, number, number, number)
        self.viewport = function("glViewport", number, number, number, number)


OPENING_S: Final = 5.0  # Time in which a window must fill its display, seconds; window managers animate new windows

# Time after the buffer swap in which the screen must show the colour, seconds. Compositors take one or two refreshes.
CONFIRMING_S: Final = 1.0

# Accepted deviation of a gamma ramp (0 to 1) from a straight line. Some drivers end the ramp at 255/256, others at 1.
RAMP_TOLERANCE: Final = 1.5 / 255

_POLL_S: Final = 0.002  # Pause between two readings of the screen, seconds; an eighth of a refresh period at 60 Hz

# Digits 0 to 9, drawn in 3 columns and 5 rows of blocks, row by row from the top.
_DIGITS: Final = (
    "111101101101111", "010110010010111", "111001111100111", "111001111001111", "101101111001001",
    "111100111001111", "111100111101111", "111001001001001", "111101111101111", "111101111001111",
)  # fmt: skip

_COVER_REMEDY: Final = "check for a window or notification in front, desktop scaling, or a colour filter"


class FullScreen:
    """A `drivers.presenter.Presenter` on a display, which is selected as in `choose_display`. It starts black.

    All calls must come from the thread that opened it. Keys have no effect; only `close` or the end of the process
    closes the window.
    """

    def __init__(self, display: str | int | None = None, clock: Clock = SYSTEM_CLOCK) -> None:
        self._clock = clock
        self._thread = threading.get_ident()
        self._closing = contextlib.ExitStack()
        with contextlib.ExitStack() as opening:
            self._glfw = glfw = opening.enter_context(running_glfw())
            displays = displays_with_monitors(glfw)
            self.display = choose_display(tuple(candidate for candidate, _ in displays), display)
            self._monitor: Any = next(monitor for candidate, monitor in displays if candidate == self.display)
            self._screen: XScreen | None = None
            if glfw.get_platform() == glfw.PLATFORM_X11:
                self._screen = XScreen()
                opening.callback(self._screen.close)
            opening.enter_context(_hold_display(self.display))
            self._window: Any = self._create_window()
            opening.callback(glfw.destroy_window, self._window)
            self._gl = OpenGl(glfw)
            self._pixels: npt.NDArray[np.uint32] = np.empty((self.display.height, self.display.width), np.uint32)
            glfw.swap_interval(1)
            self._wait_until_full()
            self._present(BLACK)
            self._closing = opening.pop_all()
        self._open = True

    def show(self, colour: Colour) -> None:
        """Fill the display with exactly `colour`, and return when every pixel has been read back."""
        self._require_usable()
        self._require_x_server()
        if not self._is_full():
            self._restore_window()
        self._require_awake()
        self._present(colour)

    def verify(self, colour: Colour) -> None:
        """Check once that every pixel of the screen is exactly `colour`; see `drivers.presenter.ReadsBack`.

        With X, the whole screen is read, and the name of a covering window is reported. On macOS, only the window's own
        front buffer is read, so covering windows are not detected.
        """
        self._require_usable()
        self._require_x_server()
        self._require_full()
        self._require_awake()
        self._glfw.make_context_current(self._window)
        self._require_colour(self._read_screen(), colour, "the screen shows")

    def identify(self) -> None:
        """Show the number of the display, made of large white blocks on black."""
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
        for index, digit in enumerate(digits):
            for cell in (cell for cell, block_value in enumerate(digit) if block_value == "1"):
                row, column = divmod(cell, 3)
                # OpenGL counts from the bottom.
                x, y = left + (1 + 4 * index + column) * block, top - (2 + row) * block
                self._gl.scissor(x, y, block, block)
                self._gl.clear(COLOUR_BIT)
        self._gl.disable(SCISSOR)
        self._glfw.swap_buffers(self._window)
        self._gl.finish()
        self._glfw.poll_events()

    def warnings(self) -> tuple[str, ...]:
        """Return reasons why the light may be wrong although the codes on the screen are right; may be empty."""
        self._require_usable()
        return _find_warnings(self._glfw, self.display, self._monitor, self._screen)

    def close(self) -> None:
        """Leave the display black and release it; a second call does nothing."""
        if not self._open:
            return
        self._require_usable()
        self._open = False
        # If black cannot be shown, the window is closed anyway.
        with self._closing, contextlib.suppress(DeviceError):
            self._present(BLACK)

    def _create_window(self) -> Any:
        glfw, display = self._glfw, self.display
        is_x11 = glfw.get_platform() == glfw.PLATFORM_X11
        # The defaults are 8 bits per channel, no multisampling and no sRGB conversion.
        glfw.default_window_hints()
        if is_x11:
            glfw.window_hint(glfw.POSITION_X, display.x)
            glfw.window_hint(glfw.POSITION_Y, display.y)
        for hint, value in (
            (glfw.VISIBLE, not is_x11),
            (glfw.DECORATED, False),
            (glfw.AUTO_ICONIFY, False),  # the window must not disappear after a click on another display
            (glfw.CENTER_CURSOR, False),
            (glfw.ALPHA_BITS, 0),
            (glfw.DEPTH_BITS, 0),
            (glfw.STENCIL_BITS, 0),
            (glfw.REFRESH_RATE, display.refresh_hz),
        ):
            glfw.window_hint(hint, value)
        try:
            window = glfw.create_window(display.width, display.height, "CroP", None if is_x11 else self._monitor, None)
            if is_x11:
                self._make_full_screen(window)
        except glfw.GLFWError as error:
            raise DeviceError(
                f"cannot open a window on display {display}: {error}; check that OpenGL works (Debian: libgl1-mesa-dri)"
            ) from error
        glfw.set_input_mode(window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        glfw.make_context_current(window)
        return window

    def _make_full_screen(self, window: Any) -> None:
        # Window managers without ``_NET_WM_FULLSCREEN_MONITORS`` (e.g. Openbox) fill the display where the window is
        # now. If it were created as full screen, it would open on the first display.
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
                    f"the window has {size} px at {self._glfw.get_window_pos(self._window)}, expected display "
                    f"{self.display}; switch off desktop scaling for it"
                )
            self._clock.sleep(_POLL_S)
            self._glfw.poll_events()

    def _restore_window(self) -> None:
        glfw = self._glfw
        for display, monitor in self._displays_now():
            if (display.name, display.width, display.height) == (
                self.display.name,
                self.display.width,
                self.display.height,
            ):
                self.display, self._monitor = display, monitor
                area = display.x, display.y, display.width, display.height
                # The display may be disconnected again during these calls.
                with contextlib.suppress(DeviceError, glfw.GLFWError):
                    # A full-screen window cannot be moved to another display.
                    glfw.set_window_monitor(self._window, None, *area, glfw.DONT_CARE)
                    self._make_full_screen(self._window)
                    self._wait_until_full()
                break
        self._require_full()

    def _require_x_server(self) -> None:
        self._glfw.poll_events()
        if self._screen is not None and is_lost(self._glfw.get_x11_display()):
            raise DeviceError(
                f"the X server of display {self.display} has ended (logout or crash); log in again, {RUN_AGAIN}"
            )

    def _require_full(self) -> None:
        if not self._is_full():
            present = "; ".join(str(display) for display, _ in self._displays_now()) or "none"
            raise DeviceError(
                f"the window does not fill display {self.display} (present displays: {present})",
                remedy="check its cable, and restore the desktop's display settings",
            )

    def _displays_now(self) -> list[tuple[Display, Any]]:
        try:
            return displays_with_monitors(self._glfw)
        except self._glfw.GLFWError:
            return []  # the arrangement of the displays is just changing

    def _require_awake(self) -> None:
        if self._screen is not None and is_dark(self._glfw.get_x11_display()):
            raise DeviceError(
                f"power saving keeps display {self.display} dark; move the mouse, and disable power saving (xset -dpms)"
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
        self._require_colour(self._read_buffer(BACK), colour, "OpenGL drew", on_screen=False)
        self._glfw.swap_buffers(self._window)
        self._gl.finish()
        deadline = self._clock.monotonic() + CONFIRMING_S
        while True:
            try:
                self._require_colour(self._read_screen(), colour, "the screen shows")
            except DeviceError:
                if self._clock.monotonic() > deadline:
                    raise
                self._clock.sleep(_POLL_S)
            else:
                return

    def _fill(self, colour: Colour) -> None:
        gl = self._gl
        gl.viewport(0, 0, self.display.width, self.display.height)
        gl.disable(DITHER)
        # The buffer stores round(255 * value). With single precision, the value c / 255 gives exactly the code c
        # (OpenGL 2.1, 2.14.9).
        gl.clear_colour(colour.red / 255, colour.green / 255, colour.blue / 255, 1.0)
        gl.clear(COLOUR_BIT)

    def _read_screen(self) -> npt.NDArray[np.uint32]:
        if self._screen is None:
            return self._read_buffer(FRONT)
        display = self.display
        return self._screen.read(display.x, display.y, display.width, display.height)

    def _read_buffer(self, buffer: int) -> npt.NDArray[np.uint32]:
        """Return the content of a buffer of the window, (height, width) uint32, 0xRRGGBB, bottom row first."""
        display = self.display
        self._gl.read_buffer(buffer)
        pixels, pixel_type = self._pixels.ctypes.data, UNSIGNED_INT_8_8_8_8_REVERSED
        self._gl.read_pixels(0, 0, display.width, display.height, BGRA, pixel_type, pixels)
        np.bitwise_and(self._pixels, np.uint32(0xFFFFFF), out=self._pixels)
        return self._pixels

    def _require_colour(
        self, pixels: npt.NDArray[np.uint32], colour: Colour, subject: str, *, on_screen: bool = True
    ) -> None:
        expected = colour.red << 16 | colour.green << 8 | colour.blue
        is_wrong = pixels != expected
        if is_wrong.any():
            rows, columns = np.flatnonzero(is_wrong.any(axis=1)), np.flatnonzero(is_wrong.any(axis=0))
            top, left = int(rows[0]), int(columns[0])
            first_column = int(np.flatnonzero(is_wrong[top])[0])
            wrong_code = int(pixels[top, first_column])
            actual = f"({wrong_code >> 16}, {wrong_code >> 8 & 255}, {wrong_code & 255})"
            size = f"{int(columns[-1]) - left + 1}×{int(rows[-1]) - top + 1} px"
            raise DeviceError(
                f"{subject} {actual} instead of ({colour.red}, {colour.green}, {colour.blue}) in "
                f"{np.count_nonzero(is_wrong)} of {is_wrong.size} pixels of display {self.display}, within {size} at "
                f"{left:+d}{top:+d}; {self._describe_cover(first_column, top) if on_screen else _COVER_REMEDY}"
            )

    def _describe_cover(self, column: int, row: int) -> str:
        cover = None
        if self._screen is not None:
            own: int = self._glfw.get_x11_window(self._window)
            cover = self._screen.cover(self.display.x + column, self.display.y + row, own)
        if cover is not None:
            return f"{cover} covers it: close it, and switch such windows and notifications off"
        return _COVER_REMEDY

    def _require_usable(self) -> None:
        if not self._open:
            raise DeviceError(f"display {self.display} was closed; open it again")
        if threading.get_ident() != self._thread:
            raise DeviceError(f"display {self.display} belongs to the thread that opened it; call it from that thread")


@contextlib.contextmanager
def _hold_display(display: Display) -> Generator[None]:
    """Lock a display against other processes; screens of one X server (``:0.0``, ``:0.1``) share the lock."""
    server = re.sub(r"\.\d+$", "", os.environ.get("DISPLAY", ""))
    with hold(f"display {display}", f"display {server} {display.position}"):
        yield


def display_warnings(selection: str | int | None = None) -> tuple[str, ...]:
    """Return the same warnings as `FullScreen.warnings` for a selected display, without opening a window."""
    with contextlib.ExitStack() as opened:
        glfw = opened.enter_context(running_glfw())
        displays = displays_with_monitors(glfw)
        display = choose_display(tuple(candidate for candidate, _ in displays), selection)
        opened.enter_context(_hold_display(display))
        screen: XScreen | None = None
        if glfw.get_platform() == glfw.PLATFORM_X11:
            screen = XScreen()
            opened.callback(screen.close)
        monitor = next(monitor for candidate, monitor in displays if candidate == display)
        return _find_warnings(glfw, display, monitor, screen)


def _find_warnings(glfw: Any, display: Display, monitor: Any, screen: XScreen | None) -> tuple[str, ...]:
    warnings: list[str] = []
    ramp_fault = _describe_ramp_fault(glfw, monitor)
    if ramp_fault:
        warnings.append(
            f"the gamma ramp of {display.name} is not straight ({ramp_fault}): switch off night light and colour "
            "management for this display"
        )
    if screen is not None and (screen.has_extension("XWAYLAND") or display.name.startswith("XWAYLAND")):
        warnings.append(
            "the desktop uses Wayland, and its compositor may scale or tint the image without notice: log in to an X "
            "session (Xorg)"
        )
    if screen is not None and not screen.stays_awake:
        warnings.append(
            "power saving may darken the display: install libxcb-screensaver0, or disable power saving (xset -dpms)"
        )
    if screen is not None and screen.has_root_property(_profile_property(glfw, monitor)):
        warnings.append(
            f"a colour profile is set for {display.name}, which desktops may apply to the image: remove it in the "
            "desktop's colour settings (colormgr, dispwin -U)"
        )
    mirrors = [str(twin) for twin, _ in displays_with_monitors(glfw) if twin.position == display.position]
    if len(mirrors) > 1:
        warnings.append(f"several displays show the same image ({'; '.join(mirrors)}): extend the desktop instead")
    return tuple(warnings)


def _describe_ramp_fault(glfw: Any, monitor: Any) -> str:
    try:
        ramp = glfw.get_gamma_ramp(monitor)
    except glfw.GLFWError:
        # This display has no gamma ramp.
        return ""
    channels = [np.asarray(channel) for channel in ramp]
    if any(_is_noise(values) for values in channels):
        return ""
    for name, values in zip(("red", "green", "blue"), channels, strict=True):
        if not values.any():
            # A server without gamma ramps returns zeros, which are no real ramp.
            continue
        deviation = values - np.linspace(0, 1, values.size)
        worst_index = int(np.argmax(np.abs(deviation)))
        if abs(deviation[worst_index]) > RAMP_TOLERANCE:
            return f"{name} {worst_index / (values.size - 1):.2f} becomes {values[worst_index]:.2f}"
    return ""


def _profile_property(glfw: Any, monitor: Any) -> str:
    """Return the root window property that holds a display's colour profile (ICC Profiles in X 0.4, section 2)."""
    addresses = [ctypes.addressof(candidate.contents) for candidate in glfw.get_monitors()]
    number = addresses.index(ctypes.addressof(monitor.contents))
    return "_ICC_PROFILE" if number == 0 else f"_ICC_PROFILE_{number}"


def _is_noise(ramp: npt.NDArray[np.float64]) -> bool:
    """Return whether a gamma ramp goes up and down; it is then memory that the X server never set."""
    total_variation = float(np.abs(np.diff(ramp)).sum())
    return total_variation > 2 * float(np.ptp(ramp)) and total_variation > 0.1


def identify_displays(seconds: float, clock: Clock = SYSTEM_CLOCK) -> tuple[Display, ...]:
    """Show on each display its own number for `seconds`, and return all displays."""
    with contextlib.ExitStack() as opened:
        displays = list_displays()
        for display in displays:
            screen = FullScreen(display.number, clock)
            opened.callback(screen.close)
            screen.identify()
        clock.sleep(seconds)
    return displays
