"""Read the screen of an X server, detect covering windows and the end of the server, and suspend the screen saver.

The screen is read over a separate connection, not over that of our window, so that the result is what the server
shows. This connection uses libxcb, which returns errors. Our window needs Xlib, which ends the process if the server
ends; `survive_server_end` prevents this. Windows may disappear at any time, so a missing reply is treated as a missing
window. Window managers put frames around windows, so the name of a window may be that of an inner window.

Sources: X Window System Protocol, GetImage, QueryExtension, QueryTree, GetWindowAttributes, GetGeometry and
GetProperty; MIT-SCREEN-SAVER extension 1.1, Suspend; DPMS extension 1.2; Xlib, XSetIOErrorHandler(3) and
XSetIOErrorExitHandler(3), the latter from libX11 1.7 on; Extended Window Manager Hints 1.5, _NET_WM_NAME; Inter-Client
Communication Conventions 2.0, 4.1.2 (WM_NAME, WM_CLASS).
"""

from __future__ import annotations

import contextlib
import ctypes
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from foundation.errors import RUN_AGAIN, DeviceError

INPUT_ONLY = 2  # Window class without visible content (X protocol, CreateWindow)
VIEWABLE = 2  # Map state of a window that is shown on the screen (X protocol, GetWindowAttributes)
MAX_TEXT = 256  # Longest name that is read, bytes
MAX_DEPTH = 4  # Levels of inner windows that are searched for a name; window managers add one or two levels
# Most windows that are searched for one name, because some programs have thousands of windows.
MAX_WINDOWS = 200

_ANY_TYPE = 0  # AnyPropertyType of GetProperty, because names have several encodings
_WORD_BYTES = 4  # Bytes of a word, in which GetProperty counts lengths (X protocol, GetProperty)


_Z_PIXMAP = 2  # Format of GetImage: complete pixels in sequence (X protocol, GetImage; XYPixmap is 1)
_ALL_PLANES = 0xFFFFFFFF  # Plane mask of GetImage: every bit of a pixel
_DPMS_ON = 0  # Power level of an active display (DPMS extension 1.2, DPMSInfo; 1 standby, 2 suspend, 3 off)


_lost_displays: set[int] = set()  # Addresses of Xlib connections whose server has ended


@ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
def _ignore_loss(display: int | None) -> int:
    # The default handler writes to stderr and exits.
    return 0


@ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
def _record_loss(display: int | None, data: int | None) -> None:
    _lost_displays.add(display or 0)


def survive_server_end(display: int) -> None:
    """Keep the process alive if the server of an Xlib connection ends; without effect before libX11 1.7."""
    with contextlib.suppress(OSError, AttributeError):
        xlib = ctypes.CDLL("libX11.so.6")
        set_exit_handler = xlib.XSetIOErrorExitHandler
        set_exit_handler.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        set_exit_handler.restype = None
        set_exit_handler(display, ctypes.cast(_record_loss, ctypes.c_void_p), None)
        xlib.XSetIOErrorHandler(_ignore_loss)
        # A new connection may have the same address in memory as a lost one.
        _lost_displays.discard(display)


def is_lost(display: int) -> bool:
    """Return whether the server of an Xlib connection has ended; `survive_server_end` must have been called."""
    return display in _lost_displays


def is_dark(display: int) -> bool:
    """Return whether power saving keeps the displays of an X server dark; False if this cannot be determined."""
    with contextlib.suppress(OSError, AttributeError):
        extension = ctypes.CDLL("libXext.so.6")
        event_base, error_base = ctypes.c_int(), ctypes.c_int()
        extension.DPMSQueryExtension.argtypes = [ctypes.c_void_p] * 3
        if not extension.DPMSQueryExtension(display, ctypes.byref(event_base), ctypes.byref(error_base)):
            return False
        level, enabled = ctypes.c_uint16(), ctypes.c_uint8()
        extension.DPMSInfo.argtypes = [ctypes.c_void_p] * 3
        has_reply = extension.DPMSInfo(display, ctypes.byref(level), ctypes.byref(enabled))
        return bool(has_reply and enabled.value and level.value != _DPMS_ON)
    return False


class _Cookie(ctypes.Structure):
    """Number by which libxcb identifies a request whose reply is pending."""

    _fields_ = (("sequence", ctypes.c_uint),)


class _Screens(ctypes.Structure):
    """xcb_screen_iterator_t of libxcb; `data` points to the number of the root window."""

    _fields_ = (("data", ctypes.POINTER(ctypes.c_uint32)), ("rem", ctypes.c_int), ("index", ctypes.c_int))


_POINTER, _WORD, _HALF, _BYTE, _COORDINATE = (
    ctypes.c_void_p,
    ctypes.c_uint32,
    ctypes.c_uint16,
    ctypes.c_uint8,
    ctypes.c_int16,
)
# Argument types of requests, by their names in libxcb.
_REQUESTS: dict[str, list[type]] = {
    "get_geometry": [_WORD],
    "get_image": [_BYTE, _WORD, _COORDINATE, _COORDINATE, _HALF, _HALF, _WORD],
    "get_property": [_BYTE, _WORD, _WORD, _WORD, _WORD, _WORD],
    "get_window_attributes": [_WORD],
    "intern_atom": [_BYTE, _HALF, ctypes.c_char_p],
    "query_extension": [_HALF, ctypes.c_char_p],
    "query_tree": [_WORD],
}
# Other functions of libxcb: return type and argument types.
_CALLS: dict[str, tuple[type | None, list[type]]] = {
    "connect": (_POINTER, [ctypes.c_char_p, ctypes.POINTER(ctypes.c_int)]),
    "connection_has_error": (ctypes.c_int, [_POINTER]),
    "get_setup": (_POINTER, [_POINTER]),
    "setup_roots_iterator": (_Screens, [_POINTER]),
    "screen_next": (None, [ctypes.POINTER(_Screens)]),
    "get_image_data": (_POINTER, [_POINTER]),
    "get_image_data_length": (ctypes.c_int, [_POINTER]),
    "get_property_value": (_POINTER, [_POINTER]),
    "get_property_value_length": (ctypes.c_int, [_POINTER]),
    "query_tree_children": (_POINTER, [_POINTER]),
    "query_tree_children_length": (ctypes.c_int, [_POINTER]),
    "request_check": (_POINTER, [_POINTER, _Cookie]),
    "disconnect": (None, [_POINTER]),
}


def _load_xcb() -> ctypes.CDLL:
    try:
        xcb = ctypes.CDLL("libxcb.so.1")
    except OSError as error:
        raise DeviceError("libxcb.so.1 is not installed and is required to read the screen; install libxcb1") from error
    signatures = dict(_CALLS)
    for name, arguments in _REQUESTS.items():
        signatures[name] = (_Cookie, [_POINTER, *arguments])
        signatures[f"{name}_reply"] = (_POINTER, [_POINTER, _Cookie, _POINTER])
    for name, (result_type, arguments) in signatures.items():
        function = getattr(xcb, f"xcb_{name}")
        function.restype, function.argtypes = result_type, arguments
    return xcb


class _Reply:
    """A reply of libxcb, freed at the end of its ``with`` block; it is false if no reply arrived."""

    def __init__(self, address: int | None, libc: ctypes.CDLL) -> None:
        self.address = address or 0
        self._libc = libc

    def __enter__(self) -> _Reply:
        return self

    def __exit__(self, *_: object) -> None:
        if self.address:
            self._libc.free(self.address)

    def __bool__(self) -> bool:
        return bool(self.address)

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes at `offset`."""
        return ctypes.string_at(self.address + offset, size)


@dataclass(frozen=True)
class Cover:
    """Name and area of a window that covers ours, in px of the whole screen, y down."""

    name: str
    x: int
    y: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.name}, {self.width}×{self.height} px at {self.x:+d}{self.y:+d}"


class XScreen:
    """The screen of an X server and the windows on it; `display` None means the server in DISPLAY.

    With `keep_awake`, screen saver and power saving are suspended while the connection is open.
    """

    def __init__(self, display: str | None = None, *, keep_awake: bool = True) -> None:
        self._xcb = _load_xcb()
        self._libc = ctypes.CDLL(None)
        self._libc.free.argtypes = [ctypes.c_void_p]
        number = ctypes.c_int()
        self._connection: int | None = self._xcb.xcb_connect(
            None if display is None else display.encode(), ctypes.byref(number)
        )
        if self._xcb.xcb_connection_has_error(self._connection):
            self.close()
            setting = "DISPLAY" if display is None else display
            raise DeviceError(f"the X server cannot be reached; check {setting}, and that this user may open it")
        screens = self._xcb.xcb_setup_roots_iterator(self._xcb.xcb_get_setup(self._connection))
        for _ in range(number.value):
            self._xcb.xcb_screen_next(ctypes.byref(screens))
        self._root: int = screens.data[0]
        self._pixels: npt.NDArray[np.uint32] = np.empty((0, 0), np.uint32)
        # Whether screen saver and power saving are suspended.
        self.stays_awake = keep_awake and self._suspend_saver()

    def size(self) -> tuple[int, int]:
        """Return the present width and height of the whole screen, px."""
        self._require_open()
        with self._request("get_geometry", self._root) as reply:
            if not reply:
                raise DeviceError(f"the X server has ended (logout or crash); log in again, {RUN_AGAIN}")
            width, height = struct.unpack("=HH", reply.read(16, 4))
        return width, height

    def read(self, x: int, y: int, width: int, height: int) -> npt.NDArray[np.uint32]:
        """Return the screen content, (height, width) uint32, 0xRRGGBB; the next call overwrites the array."""
        self._require_open()
        with self._request("get_image", _Z_PIXMAP, self._root, x, y, width, height, _ALL_PLANES) as reply:
            if not reply:
                raise DeviceError(
                    f"the X screen has no area of {width}×{height} px at +{x}+{y}; "
                    "check the display's cable and the desktop's display settings"
                )
            size: int = self._xcb.xcb_get_image_data_length(reply.address)
            depth = reply.read(1, 1)[0]
            if depth not in (24, 32) or size != 4 * width * height:
                raise DeviceError(f"the X screen has a depth of {depth} bits, expected 24; set 24 for unchanged codes")
            raw = (ctypes.c_uint8 * size).from_address(self._xcb.xcb_get_image_data(reply.address))
            if self._pixels.shape != (height, width):
                self._pixels = np.empty((height, width), np.uint32)
            pixels = np.frombuffer(memoryview(raw), dtype="<u4").reshape(height, width)
            return np.bitwise_and(pixels, np.uint32(0xFFFFFF), out=self._pixels)

    def has_extension(self, name: str) -> bool:
        """Return whether the server has an extension of the X protocol."""
        with self._request("query_extension", len(name), name.encode("ascii")) as reply:
            return bool(reply) and reply.read(8, 1) != b"\0"

    def has_root_property(self, name: str) -> bool:
        """Return whether the root window has a property that is not empty."""
        return self._property(self._root, name) != b""

    def cover(self, x: int, y: int, own_window: int) -> Cover | None:
        """Return the topmost visible window at a position; None if it is `own_window`, or if there is none."""
        if self._connection is None:
            return None
        own_top = self._top_window(own_window)
        for window in reversed(self._query_tree(self._root)[1]):
            if window == own_top:
                return None
            area = self._visible_area(window)
            if area is None:
                continue
            left, top, width, height = area
            if left <= x < left + width and top <= y < top + height:
                return Cover(self._window_name(window), *area)
        return None

    def _top_window(self, window: int) -> int:
        for _ in range(2 * MAX_DEPTH):
            parent, _children = self._query_tree(window)
            if parent in (0, self._root):
                return window
            window = parent
        return window

    def _window_name(self, top: int) -> str:
        title, program = "", ""
        for window in self._descendants(top):
            title = title or self._text_property(window, "_NET_WM_NAME") or self._text_property(window, "WM_NAME")
            program = program or self._text_property(window, "WM_CLASS").rstrip("\0").rpartition("\0")[2]
            if title and program:
                break
        if title:
            return f"“{title}” ({program})" if program and program.lower() != title.lower() else f"“{title}”"
        return f"a window of {program}" if program else f"a window without a name (0x{top:x})"

    def _descendants(self, top: int) -> Iterator[int]:
        level = [top]
        count = 0
        for _ in range(MAX_DEPTH):
            for window in level:
                yield window
                count += 1
                if count >= MAX_WINDOWS:
                    return
            level = [child for window in level for child in self._query_tree(window)[1]]

    def close(self) -> None:
        """Disconnect, and enable the screen saver again; a second call does nothing."""
        connection, self._connection = self._connection, None
        if connection is not None:
            self._xcb.xcb_disconnect(connection)

    def _suspend_saver(self) -> bool:
        # A request of an extension that the server does not have would end the connection.
        if not self.has_extension("MIT-SCREEN-SAVER"):
            return False
        with contextlib.suppress(OSError, AttributeError):
            saver = ctypes.CDLL("libxcb-screensaver.so.0")
            saver.xcb_screensaver_suspend_checked.argtypes = [ctypes.c_void_p, ctypes.c_uint32]
            saver.xcb_screensaver_suspend_checked.restype = _Cookie
            cookie = saver.xcb_screensaver_suspend_checked(self._connection, 1)
            failure = self._xcb.xcb_request_check(self._connection, cookie)
            self._libc.free(failure)
            return not failure
        return False

    def _require_open(self) -> None:
        if self._connection is None:
            raise DeviceError("the screen was closed; open it again")

    def _query_tree(self, window: int) -> tuple[int, list[int]]:
        """Return a window's parent (0 if none) and its children from the lowest to the topmost."""
        with self._request("query_tree", window) as reply:
            if not reply:
                return 0, []
            count: int = self._xcb.xcb_query_tree_children_length(reply.address)
            children = ctypes.string_at(self._xcb.xcb_query_tree_children(reply.address), _WORD_BYTES * count)
            (parent,) = struct.unpack("=I", reply.read(12, 4))
            return parent, list(struct.unpack(f"={count}I", children))

    def _visible_area(self, window: int) -> tuple[int, int, int, int] | None:
        with self._request("get_window_attributes", window) as reply:
            if not reply:
                return None
            (window_class,) = struct.unpack("=H", reply.read(12, 2))
            if window_class == INPUT_ONLY or reply.read(26, 1)[0] != VIEWABLE:
                return None
        with self._request("get_geometry", window) as reply:
            if not reply:
                return None
            x, y, width, height, border = struct.unpack("=hhHHH", reply.read(12, 10))
            return x, y, width + 2 * border, height + 2 * border

    def _text_property(self, window: int, name: str) -> str:
        text = self._property(window, name).decode("utf-8", "replace")
        return "".join(character for character in text if character.isprintable() or character == "\0").strip()

    def _property(self, window: int, name: str) -> bytes:
        """Return the first `MAX_TEXT` bytes of a window's property; empty if it is missing."""
        with self._request("intern_atom", 1, len(name), name.encode("ascii")) as reply:
            (atom,) = struct.unpack("=I", reply.read(8, 4)) if reply else (0,)
        if not atom:
            return b""
        with self._request("get_property", 0, window, atom, _ANY_TYPE, 0, MAX_TEXT // _WORD_BYTES) as reply:
            if not reply:
                return b""
            size: int = self._xcb.xcb_get_property_value_length(reply.address)
            return ctypes.string_at(self._xcb.xcb_get_property_value(reply.address), size)

    def _request(self, request: str, *arguments: object) -> _Reply:
        """Return the reply to a request; it is false if no reply arrives, or if the screen was closed."""
        if self._connection is None:
            return _Reply(None, self._libc)
        cookie = getattr(self._xcb, f"xcb_{request}")(self._connection, *arguments)
        return _Reply(getattr(self._xcb, f"xcb_{request}_reply")(self._connection, cookie, None), self._libc)
