"""What an X server has on its screen, read as a screenshot program reads it; a hold on its screen saver; its end.

Rules that hold inside:

- A connection of its own, beside that of the window: what it reads is what the server shows, whoever drew it.
- Through libxcb, which returns errors to its caller. Xlib, which the window needs, ends the process when its server
  goes; `outlive` prevents that.
- The hold on screen saver and power saving ends with the connection, hence with the process, however that ends.

Sources: X Window System Protocol, GetImage, QueryExtension and GetProperty; MIT-SCREEN-SAVER extension 1.1, Suspend;
DPMS extension 1.2;
Xlib, XSetIOErrorHandler(3) and XSetIOErrorExitHandler(3), the latter from libX11 1.7 on.
"""

from __future__ import annotations

import contextlib
import ctypes

import numpy as np
import numpy.typing as npt

from drivers.display.stacking import Cookie, Cover, WindowStack
from foundation.errors import DeviceError

_Z_PIXMAP = 2
"""Format of GetImage: whole pixels one after the other (X protocol, GetImage; XYPixmap is 1)."""
_ALL_PLANES = 0xFFFFFFFF
"""Plane mask of GetImage: every bit of a pixel."""
_REPLY_PRESENT = 8
"""Offset of `present` in a QueryExtension reply."""
_REPLY_ATOM = 8
"""Offset of `atom` in an InternAtom reply."""
_REPLY_SIZE = (16, 18)
"""Offsets of `width` and `height` in a GetGeometry reply."""
_ANY_TYPE = 0
"""AnyPropertyType of GetProperty: the value is wanted whatever its type."""
_DPMS_ON = 0
"""Power level of a display that is lit (DPMS extension 1.2, DPMSInfo; 1 standby, 2 suspend, 3 off)."""


_lost: set[int] = set()


@ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
def _go_on(display: int | None) -> int:
    # The usual one writes to stderr and exits.
    return 0


@ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
def _note_loss(display: int | None, data: int | None) -> None:
    _lost.add(display or 0)


def outlive(display: int) -> None:
    """Let the process go on when the server of an Xlib connection is gone; old libraries end it all the same."""
    with contextlib.suppress(OSError, AttributeError):
        xlib = ctypes.CDLL("libX11.so.6")
        leave = xlib.XSetIOErrorExitHandler
        leave.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        leave.restype = None
        leave(display, ctypes.cast(_note_loss, ctypes.c_void_p), None)
        xlib.XSetIOErrorHandler(_go_on)
        # A new connection may stand where a lost one stood.
        _lost.discard(display)


def is_lost(display: int) -> bool:
    """Return whether the server of an Xlib connection that was to be outlived is gone."""
    return display in _lost


def is_dark(display: int) -> bool:
    """Return whether power saving keeps the displays of an Xlib connection dark now; False where it cannot tell."""
    with contextlib.suppress(OSError, AttributeError):
        extension = ctypes.CDLL("libXext.so.6")
        first, second = ctypes.c_int(), ctypes.c_int()
        extension.DPMSQueryExtension.argtypes = [ctypes.c_void_p] * 3
        if not extension.DPMSQueryExtension(display, ctypes.byref(first), ctypes.byref(second)):
            return False
        level, enabled = ctypes.c_uint16(), ctypes.c_uint8()
        extension.DPMSInfo.argtypes = [ctypes.c_void_p] * 3
        answered = extension.DPMSInfo(display, ctypes.byref(level), ctypes.byref(enabled))
        return bool(answered and enabled.value and level.value != _DPMS_ON)
    return False


class _Screens(ctypes.Structure):
    """xcb_screen_iterator_t: the root window's number stands first in what `data` points to."""

    _fields_ = (("data", ctypes.POINTER(ctypes.c_uint32)), ("rem", ctypes.c_int), ("index", ctypes.c_int))


class XScreen:
    """The screen of an X server.

    `display`: the server's name, such as ``:1``; None: what DISPLAY names.
    """

    def __init__(self, display: str | None = None, *, keep_awake: bool = True) -> None:
        try:
            self._xcb = ctypes.CDLL("libxcb.so.1")
        except OSError as error:
            raise DeviceError("libxcb.so.1 is not installed, so the screen cannot be read; install libxcb1") from error
        self._libc = ctypes.CDLL(None)
        self._libc.free.argtypes = [ctypes.c_void_p]
        _declare(self._xcb)
        number = ctypes.c_int()
        self._connection: int | None = self._xcb.xcb_connect(
            None if display is None else display.encode(), ctypes.byref(number)
        )
        if self._xcb.xcb_connection_has_error(self._connection):
            self.close()
            named = "DISPLAY" if display is None else display
            raise DeviceError(f"the X server cannot be reached; check {named} and that this user may open it")
        screens = self._xcb.xcb_setup_roots_iterator(self._xcb.xcb_get_setup(self._connection))
        for _ in range(number.value):
            self._xcb.xcb_screen_next(ctypes.byref(screens))
        self._root: int = screens.data[0]
        self._seen: npt.NDArray[np.uint32] = np.empty((0, 0), np.uint32)
        self.stays_awake = keep_awake and self._suspend_saver()
        """Whether screen saver and power saving are held off while this is open."""

    def size(self) -> tuple[int, int]:
        """Return width and height of the whole screen now, px; a change of mode changes them."""
        if self._connection is None:
            raise DeviceError("the screen was closed; open it again")
        cookie = self._xcb.xcb_get_geometry(self._connection, self._root)
        failure = ctypes.c_void_p()
        reply = self._xcb.xcb_get_geometry_reply(self._connection, cookie, ctypes.byref(failure))
        if not reply:
            self._libc.free(failure)
            raise DeviceError("the X server is gone: somebody logged out, or it crashed; log in, then run again")
        width, height = (ctypes.c_uint16.from_address(reply + at).value for at in _REPLY_SIZE)
        self._libc.free(reply)
        return width, height

    def read(self, x: int, y: int, width: int, height: int) -> npt.NDArray[np.uint32]:
        """Return what the server shows there, (height, width) uint32, 0xRRGGBB; the next call writes over it."""
        if self._connection is None:
            raise DeviceError("the screen was closed; open it again")
        cookie = self._xcb.xcb_get_image(
            self._connection, _Z_PIXMAP, self._root, x, y, width, height, _ALL_PLANES
        )  # fmt: skip
        failure = ctypes.c_void_p()
        reply = self._xcb.xcb_get_image_reply(self._connection, cookie, ctypes.byref(failure))
        if not reply:
            self._libc.free(failure)
            raise DeviceError(
                f"the X server shows no {width}×{height} pixels at +{x}+{y} any more; "
                "check the display's cable and the desktop's display settings"
            )
        try:
            size: int = self._xcb.xcb_get_image_data_length(reply)
            depth = ctypes.string_at(reply + 1, 1)[0]
            if depth not in (24, 32) or size != 4 * width * height:
                raise DeviceError(f"the X screen has a depth of {depth} bits; set 24, so that codes arrive as they are")
            raw = (ctypes.c_uint8 * size).from_address(self._xcb.xcb_get_image_data(reply))
            if self._seen.shape != (height, width):
                self._seen = np.empty((height, width), np.uint32)
            pixels = np.frombuffer(memoryview(raw), dtype="<u4").reshape(height, width)
            return np.bitwise_and(pixels, np.uint32(0xFFFFFF), out=self._seen)
        finally:
            self._libc.free(reply)

    def cover(self, x: int, y: int, own: int) -> Cover | None:
        """Return the window that lies over the window `own` at a place of the screen; None where none does."""
        if self._connection is None:
            return None
        return WindowStack(self._xcb, self._connection, self._root).cover(x, y, own)

    def has_extension(self, name: str) -> bool:
        """Return whether the server has the extension `name`."""
        if self._connection is None:
            return False
        cookie = self._xcb.xcb_query_extension(self._connection, len(name), name.encode("ascii"))
        reply = self._xcb.xcb_query_extension_reply(self._connection, cookie, None)
        if not reply:
            return False
        present = ctypes.string_at(reply + _REPLY_PRESENT, 1)[0]
        self._libc.free(reply)
        return bool(present)

    def has_root_property(self, name: str) -> bool:
        """Return whether the root window has a property `name` that is not empty."""
        if self._connection is None:
            return False
        cookie = self._xcb.xcb_intern_atom(self._connection, 1, len(name), name.encode("ascii"))
        reply = self._xcb.xcb_intern_atom_reply(self._connection, cookie, None)
        if not reply:
            return False
        atom = ctypes.c_uint32.from_address(reply + _REPLY_ATOM).value
        self._libc.free(reply)
        if not atom:
            return False
        cookie = self._xcb.xcb_get_property(self._connection, 0, self._root, atom, _ANY_TYPE, 0, 1)
        reply = self._xcb.xcb_get_property_reply(self._connection, cookie, None)
        if not reply:
            return False
        size: int = self._xcb.xcb_get_property_value_length(reply)
        self._libc.free(reply)
        return size > 0

    def close(self) -> None:
        """Hang up, and let the screen saver run again; a second call does nothing."""
        connection, self._connection = self._connection, None
        if connection is not None:
            self._xcb.xcb_disconnect(connection)

    def _suspend_saver(self) -> bool:
        # A request of an extension that the server lacks would end the connection.
        if not self.has_extension("MIT-SCREEN-SAVER"):
            return False
        with contextlib.suppress(OSError, AttributeError):
            saver = ctypes.CDLL("libxcb-screensaver.so.0")
            saver.xcb_screensaver_suspend_checked.argtypes = [ctypes.c_void_p, ctypes.c_uint32]
            saver.xcb_screensaver_suspend_checked.restype = Cookie
            cookie = saver.xcb_screensaver_suspend_checked(self._connection, 1)
            failure = self._xcb.xcb_request_check(self._connection, cookie)
            self._libc.free(failure)
            return not failure
        return False


def _declare(xcb: ctypes.CDLL) -> None:
    pointer, integer, half = ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int16
    signatures: dict[str, tuple[type | None, list[type]]] = {
        "xcb_connect": (pointer, [ctypes.c_char_p, ctypes.POINTER(ctypes.c_int)]),
        "xcb_connection_has_error": (ctypes.c_int, [pointer]),
        "xcb_get_setup": (pointer, [pointer]),
        "xcb_setup_roots_iterator": (_Screens, [pointer]),
        "xcb_screen_next": (None, [ctypes.POINTER(_Screens)]),
        "xcb_get_image": (
            Cookie,
            [pointer, ctypes.c_uint8, integer, half, half, ctypes.c_uint16, ctypes.c_uint16, integer],
        ),
        "xcb_get_geometry": (Cookie, [pointer, integer]),
        "xcb_get_geometry_reply": (pointer, [pointer, Cookie, pointer]),
        "xcb_get_image_reply": (pointer, [pointer, Cookie, ctypes.POINTER(pointer)]),
        "xcb_get_image_data": (pointer, [pointer]),
        "xcb_get_image_data_length": (ctypes.c_int, [pointer]),
        "xcb_query_extension": (Cookie, [pointer, ctypes.c_uint16, ctypes.c_char_p]),
        "xcb_query_extension_reply": (pointer, [pointer, Cookie, pointer]),
        "xcb_intern_atom": (Cookie, [pointer, ctypes.c_uint8, ctypes.c_uint16, ctypes.c_char_p]),
        "xcb_intern_atom_reply": (pointer, [pointer, Cookie, pointer]),
        "xcb_get_property": (Cookie, [pointer, ctypes.c_uint8, integer, integer, integer, integer, integer]),
        "xcb_get_property_reply": (pointer, [pointer, Cookie, pointer]),
        "xcb_get_property_value_length": (ctypes.c_int, [pointer]),
        "xcb_request_check": (pointer, [pointer, Cookie]),
        "xcb_disconnect": (None, [pointer]),
    }
    for name, (answer, arguments) in signatures.items():
        function = getattr(xcb, name)
        function.restype = answer
        function.argtypes = arguments
