"""The functions of OpenGL that fill a window with plain colours and read it back, found at run time.

Source: OpenGL 2.1, clauses 4.2.3 (Clear) and 4.3.2 (ReadPixels); numbers from its header, gl.h.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from foundation.errors import DeviceError

if TYPE_CHECKING:
    from types import ModuleType

# Numbers from gl.h: the two buffers of a window, the bit of Clear, and what would change a plain colour or its area.
FRONT: Final = 0x0404
BACK: Final = 0x0405
COLOUR_BIT: Final = 0x4000
DITHER: Final = 0x0BD0
SCISSOR: Final = 0x0C11

BGRA: Final = 0x80E1
"""The order of channels that the next number is read with (gl.h)."""
UNSIGNED_INT_8_8_8_8_REVERSED: Final = 0x8367
"""Read so, a pixel is the number 0xAARRGGBB, which is how drivers keep it: nothing needs converting."""


class OpenGl:
    """The functions of the current context."""

    def __init__(self, glfw: ModuleType) -> None:
        kind: Callable[..., Any] = ctypes.WINFUNCTYPE if sys.platform == "win32" else ctypes.CFUNCTYPE
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
