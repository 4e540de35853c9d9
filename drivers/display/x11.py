"""What an X server has on its screen, and which window lies in front; a hold on its screen saver; its end.

It has a connection of its own, so that what it reads is what the server shows, whoever drew it; through libxcb, which
returns errors to its caller. Xlib, which the window needs, ends the process when its server goes; `outlive` prevents
that. A window may vanish at any moment, and a reply that does not come is a window that is not there. A window manager
frames each, so that its name stands on a descendant.

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

INPUT_ONLY = 2  # Window class of what shows nothing (X protocol, CreateWindow)
VIEWABLE = 2  # Map state of a window that is mapped, with all above it (X protocol, GetWindowAttributes)
MAX_TEXT = 256  # Bytes of a name that are read: enough to tell one window from another
MAX_DEPTH = 4  # Levels below a top window at which its name is looked for; window managers frame a window in one or two
# Windows looked at for one name, so that a program with thousands of them costs no more than the rest.
MAX_WINDOWS = 200

_ANY_TYPE = 0  # AnyPropertyType of GetProperty: a name is wanted in whatever encoding it has
_FOUR = 4  # GetProperty counts in words of four bytes (X protocol, GetProperty)


_Z_PIXMAP = 2  # Format of GetImage: whole pixels one after the other (X protocol, GetImage; XYPixmap is 1)
_ALL_PLANES = 0xFFFFFFFF  # Plane mask of GetImage: every bit of a pixel
_DPMS_ON = 0  # Power level of a display that is lit (DPMS extension 1.2, DPMSInfo; 1 standby, 2 suspend, 3 off)


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


class _Cookie(ctypes.Structure):
    """What libxcb gives for a request under way."""

    _fields_ = (("sequence", ctypes.c_uint),)


class _Screens(ctypes.Structure):
    """xcb_screen_iterator_t: the root window's number stands first in what `data` points to."""

    _fields_ = (("data", ctypes.POINTER(ctypes.c_uint32)), ("rem", ctypes.c_int), ("index", ctypes.c_int))


_POINTER, _WORD, _HALF, _BYTE, _PLACE = (
    ctypes.c_void_p,
    ctypes.c_uint32,
    ctypes.c_uint16,
    ctypes.c_uint8,
    ctypes.c_int16,
)
# The requests that are sent, by their names in libxcb, and the types of what they are given.
_REQUESTS: dict[str, list[type]] = {
    "get_geometry": [_WORD],
    "get_image": [_BYTE, _WORD, _PLACE, _PLACE, _HALF, _HALF, _WORD],
    "get_property": [_BYTE, _WORD, _WORD, _WORD, _WORD, _WORD],
    "get_window_attributes": [_WORD],
    "intern_atom": [_BYTE, _HALF, ctypes.c_char_p],
    "query_extension": [_HALF, ctypes.c_char_p],
    "query_tree": [_WORD],
}
# What else of libxcb is called: what it returns and takes.
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


def _library() -> ctypes.CDLL:
    try:
        xcb = ctypes.CDLL("libxcb.so.1")
    except OSError as error:
        raise DeviceError("libxcb.so.1 is not installed, so the screen cannot be read; install libxcb1") from error
    signatures = dict(_CALLS)
    for name, arguments in _REQUESTS.items():
        signatures[name] = (_Cookie, [_POINTER, *arguments])
        signatures[f"{name}_reply"] = (_POINTER, [_POINTER, _Cookie, _POINTER])
    for name, (answer, arguments) in signatures.items():
        function = getattr(xcb, f"xcb_{name}")
        function.restype, function.argtypes = answer, arguments
    return xcb


class _Reply:
    """A reply of libxcb, false where none came; freed at the end of its ``with``."""

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
        """Return `size` bytes of it at `offset`."""
        return ctypes.string_at(self.address + offset, size)


@dataclass(frozen=True)
class Cover:
    """A window over a place: its name, and where it is, px of the whole screen, y down."""

    name: str
    x: int
    y: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.name}, {self.width}×{self.height} px at {self.x:+d}{self.y:+d}"


class XScreen:
    """The screen of an X server, and the windows on it.

    `display`: the server's name, such as ``:1``; None: what DISPLAY names.
    """

    def __init__(self, display: str | None = None, *, keep_awake: bool = True) -> None:
        self._xcb = _library()
        self._libc = ctypes.CDLL(None)
        self._libc.free.argtypes = [ctypes.c_void_p]
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
        self._require_open()
        with self._ask("get_geometry", self._root) as reply:
            if not reply:
                raise DeviceError(f"the X server is gone: somebody logged out, or it crashed; log in, {RUN_AGAIN}")
            width, height = struct.unpack("=HH", reply.read(16, 4))
        return width, height

    def read(self, x: int, y: int, width: int, height: int) -> npt.NDArray[np.uint32]:
        """Return what the server shows there, (height, width) uint32, 0xRRGGBB; the next call writes over it."""
        self._require_open()
        with self._ask("get_image", _Z_PIXMAP, self._root, x, y, width, height, _ALL_PLANES) as reply:
            if not reply:
                raise DeviceError(
                    f"the X server shows no {width}×{height} pixels at +{x}+{y} any more; "
                    "check the display's cable and the desktop's display settings"
                )
            size: int = self._xcb.xcb_get_image_data_length(reply.address)
            depth = reply.read(1, 1)[0]
            if depth not in (24, 32) or size != 4 * width * height:
                raise DeviceError(f"the X screen has a depth of {depth} bits; set 24, so that codes arrive as they are")
            raw = (ctypes.c_uint8 * size).from_address(self._xcb.xcb_get_image_data(reply.address))
            if self._seen.shape != (height, width):
                self._seen = np.empty((height, width), np.uint32)
            pixels = np.frombuffer(memoryview(raw), dtype="<u4").reshape(height, width)
            return np.bitwise_and(pixels, np.uint32(0xFFFFFF), out=self._seen)

    def has_extension(self, name: str) -> bool:
        """Return whether the server has the extension `name`."""
        with self._ask("query_extension", len(name), name.encode("ascii")) as reply:
            return bool(reply) and reply.read(8, 1) != b"\0"

    def has_root_property(self, name: str) -> bool:
        """Return whether the root window has a property `name` that is not empty."""
        return self._property(self._root, name) != b""

    def cover(self, x: int, y: int, own: int) -> Cover | None:
        """Return the topmost window that shows something at a place, None where that is `own`, or none does."""
        if self._connection is None:
            return None
        ours = self._top_of(own)
        for window in reversed(self._tree(self._root)[1]):
            if window == ours:
                return None
            place = self._place(window)
            if place is None:
                continue
            left, top, width, height = place
            if left <= x < left + width and top <= y < top + height:
                return Cover(self._name(window), *place)
        return None

    def _top_of(self, window: int) -> int:
        for _ in range(2 * MAX_DEPTH):
            parent, _children = self._tree(window)
            if parent in (0, self._root):
                return window
            window = parent
        return window

    def _name(self, top: int) -> str:
        title, program = "", ""
        for window in self._family(top):
            title = title or self._text(window, "_NET_WM_NAME") or self._text(window, "WM_NAME")
            program = program or self._text(window, "WM_CLASS").rstrip("\0").rpartition("\0")[2]
            if title and program:
                break
        if title:
            return f"“{title}” ({program})" if program and program.lower() != title.lower() else f"“{title}”"
        return f"a window of {program}" if program else f"a window without a name (0x{top:x})"

    def _family(self, top: int) -> Iterator[int]:
        level = [top]
        seen = 0
        for _ in range(MAX_DEPTH):
            for window in level:
                yield window
                seen += 1
                if seen >= MAX_WINDOWS:
                    return
            level = [child for window in level for child in self._tree(window)[1]]

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
            saver.xcb_screensaver_suspend_checked.restype = _Cookie
            cookie = saver.xcb_screensaver_suspend_checked(self._connection, 1)
            failure = self._xcb.xcb_request_check(self._connection, cookie)
            self._libc.free(failure)
            return not failure
        return False

    def _require_open(self) -> None:
        if self._connection is None:
            raise DeviceError("the screen was closed; open it again")

    def _tree(self, window: int) -> tuple[int, list[int]]:
        """Return a window's parent, 0 where it has none, and its children from the lowest to the topmost."""
        with self._ask("query_tree", window) as reply:
            if not reply:
                return 0, []
            count: int = self._xcb.xcb_query_tree_children_length(reply.address)
            children = ctypes.string_at(self._xcb.xcb_query_tree_children(reply.address), _FOUR * count)
            (parent,) = struct.unpack("=I", reply.read(12, 4))
            return parent, list(struct.unpack(f"={count}I", children))

    def _place(self, window: int) -> tuple[int, int, int, int] | None:
        with self._ask("get_window_attributes", window) as reply:
            if not reply:
                return None
            (kind,) = struct.unpack("=H", reply.read(12, 2))
            if kind == INPUT_ONLY or reply.read(26, 1)[0] != VIEWABLE:
                return None
        with self._ask("get_geometry", window) as reply:
            if not reply:
                return None
            x, y, width, height, border = struct.unpack("=hhHHH", reply.read(12, 10))
            return x, y, width + 2 * border, height + 2 * border

    def _text(self, window: int, name: str) -> str:
        text = self._property(window, name).decode("utf-8", "replace")
        return "".join(sign for sign in text if sign.isprintable() or sign == "\0").strip()

    def _property(self, window: int, name: str) -> bytes:
        """Return the first `MAX_TEXT` bytes of a window's property, none where it has not got it."""
        with self._ask("intern_atom", 1, len(name), name.encode("ascii")) as reply:
            (atom,) = struct.unpack("=I", reply.read(8, 4)) if reply else (0,)
        if not atom:
            return b""
        with self._ask("get_property", 0, window, atom, _ANY_TYPE, 0, MAX_TEXT // _FOUR) as reply:
            if not reply:
                return b""
            size: int = self._xcb.xcb_get_property_value_length(reply.address)
            return ctypes.string_at(self._xcb.xcb_get_property_value(reply.address), size)

    def _ask(self, request: str, *arguments: object) -> _Reply:
        """Return what the server answers to a request; false where it does not, or the screen was closed."""
        if self._connection is None:
            return _Reply(None, self._libc)
        cookie = getattr(self._xcb, f"xcb_{request}")(self._connection, *arguments)
        return _Reply(getattr(self._xcb, f"xcb_{request}_reply")(self._connection, cookie, None), self._libc)
