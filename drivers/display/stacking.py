"""Which window of an X server lies over a place of the screen, and what it calls itself.

Rules that hold inside:

- Through libxcb, on the connection of `drivers.display.x11.XScreen`; a window may vanish at any moment, and a reply
  that does not come is a window that is not there.
- Windows are asked from the top of the stack down; input-only and unmapped ones show nothing and are passed over.
- A window manager puts each window into a frame of its own, so that the name stands on a descendant.

Sources: X Window System Protocol, QueryTree, GetWindowAttributes, GetGeometry and GetProperty; Extended Window Manager
Hints 1.5, _NET_WM_NAME; Inter-Client Communication Conventions 2.0, 4.1.2 (WM_NAME, WM_CLASS).
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterator
from dataclasses import dataclass

INPUT_ONLY = 2
"""Window class of what shows nothing (X protocol, CreateWindow)."""
VIEWABLE = 2
"""Map state of a window that is mapped, with all above it (X protocol, GetWindowAttributes)."""
MAX_TEXT = 256
"""Bytes of a name that are read: enough to tell one window from another."""
MAX_DEPTH = 4
"""Levels below a top window at which its name is looked for; window managers frame a window in one or two."""
MAX_WINDOWS = 200
"""Windows looked at for one name, so that a program with thousands of them costs no more than the rest."""

_ANY_TYPE = 0
"""AnyPropertyType of GetProperty: a name is wanted in whatever encoding it has."""
_FOUR = 4
"""GetProperty counts in words of four bytes (X protocol, GetProperty)."""


class Cookie(ctypes.Structure):
    """What libxcb gives for a request under way."""

    _fields_ = (("sequence", ctypes.c_uint),)


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


class WindowStack:
    """The windows of a server, by a connection of libxcb that stays the caller's."""

    def __init__(self, xcb: ctypes.CDLL, connection: int, root: int) -> None:
        self._xcb = xcb
        self._connection = connection
        self._root = root
        self._free = ctypes.CDLL(None).free
        self._free.argtypes = [ctypes.c_void_p]
        _declare(xcb)

    def cover(self, x: int, y: int, own: int) -> Cover | None:
        """Return the topmost window that shows something at a place, None where that is `own`, or none does."""
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
        """Return the child of the root that holds a window."""
        for _ in range(2 * MAX_DEPTH):
            parent, _children = self._tree(window)
            if parent in (0, self._root):
                return window
            window = parent
        return window

    def _name(self, top: int) -> str:
        """Return the name of a window or of the first named one in it, with its program's."""
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
        """Yield a window and what is in it, level by level."""
        level = [top]
        seen = 0
        for _ in range(MAX_DEPTH):
            for window in level:
                yield window
                seen += 1
                if seen >= MAX_WINDOWS:
                    return
            level = [child for window in level for child in self._tree(window)[1]]

    def _tree(self, window: int) -> tuple[int, list[int]]:
        """Return a window's parent, 0 where it has none, and its children from the lowest to the topmost."""
        with self._reply("xcb_query_tree", window) as reply:
            if not reply:
                return 0, []
            count: int = self._xcb.xcb_query_tree_children_length(reply.address)
            children = ctypes.string_at(self._xcb.xcb_query_tree_children(reply.address), _FOUR * count)
            (parent,) = struct.unpack("=I", reply.bytes(12, 4))
            return parent, list(struct.unpack(f"={count}I", children))

    def _place(self, window: int) -> tuple[int, int, int, int] | None:
        """Return left, top, width and height with the border, None for a window that shows nothing."""
        with self._reply("xcb_get_window_attributes", window) as reply:
            if not reply:
                return None
            (kind,) = struct.unpack("=H", reply.bytes(12, 2))
            if kind == INPUT_ONLY or reply.bytes(26, 1)[0] != VIEWABLE:
                return None
        with self._reply("xcb_get_geometry", window) as reply:
            if not reply:
                return None
            x, y, width, height, border = struct.unpack("=hhHHH", reply.bytes(12, 10))
            return x, y, width + 2 * border, height + 2 * border

    def _text(self, window: int, name: str) -> str:
        with self._reply("xcb_intern_atom", 1, len(name), name.encode("ascii")) as reply:
            atom = struct.unpack("=I", reply.bytes(8, 4))[0] if reply else 0
        if not atom:
            return ""
        with self._reply("xcb_get_property", 0, window, atom, _ANY_TYPE, 0, MAX_TEXT // _FOUR) as reply:
            if not reply:
                return ""
            size: int = self._xcb.xcb_get_property_value_length(reply.address)
            text = ctypes.string_at(self._xcb.xcb_get_property_value(reply.address), size).decode("utf-8", "replace")
        return "".join(sign for sign in text if sign.isprintable() or sign == "\0").strip()

    def _reply(self, request: str, *arguments: object) -> _Reply:
        cookie = getattr(self._xcb, request)(self._connection, *arguments)
        return _Reply(getattr(self._xcb, f"{request}_reply")(self._connection, cookie, None), self._free)


class _Reply:
    """A reply of libxcb, false where none came; freed at the end of its ``with``."""

    def __init__(self, address: int | None, free: object) -> None:
        self.address = address or 0
        self._free = free

    def __enter__(self) -> _Reply:
        return self

    def __exit__(self, *_: object) -> None:
        if self.address and callable(self._free):
            self._free(self.address)

    def __bool__(self) -> bool:
        return bool(self.address)

    def bytes(self, offset: int, size: int) -> bytes:
        """Return `size` bytes of it at `offset`."""
        return ctypes.string_at(self.address + offset, size)


def _declare(xcb: ctypes.CDLL) -> None:
    pointer, integer = ctypes.c_void_p, ctypes.c_uint32
    for name, arguments in (
        ("xcb_query_tree", [integer]),
        ("xcb_get_geometry", [integer]),
        ("xcb_get_window_attributes", [integer]),
        ("xcb_intern_atom", [ctypes.c_uint8, ctypes.c_uint16, ctypes.c_char_p]),
        ("xcb_get_property", [ctypes.c_uint8, integer, integer, integer, integer, integer]),
    ):
        request, reply = getattr(xcb, name), getattr(xcb, f"{name}_reply")
        request.restype, request.argtypes = Cookie, [pointer, *arguments]
        reply.restype, reply.argtypes = pointer, [pointer, Cookie, pointer]
    for name, answer in (
        ("xcb_query_tree_children", pointer),
        ("xcb_query_tree_children_length", ctypes.c_int),
        ("xcb_get_property_value", pointer),
        ("xcb_get_property_value_length", ctypes.c_int),
    ):
        function = getattr(xcb, name)
        function.restype, function.argtypes = answer, [pointer]
