"""X servers without a monitor, and screenshots that are independent of the code under test.

`virtual_screen` stores its image in an XWD file (X11's XWDFile.h). `screenshot` sends its own request byte by byte (X
Window System Protocol, clauses 8 and 9).
"""

from __future__ import annotations

import contextlib
import ctypes.util
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

Picture = npt.NDArray[np.uint32]
"""(height, width) uint32, 0xRRGGBB."""

_SETTINGS = """
Section "Device"
    Identifier "card"
    Driver "dummy"
    VideoRam 65536
    Option "Monitor-DUMMY0" "desk"
    Option "Monitor-DUMMY1" "projector"
EndSection
Section "Monitor"
    Identifier "desk"
    HorizSync 1-1000
    VertRefresh 1-200
    Modeline "640x360" 20 640 660 680 700 360 364 368 380
    Option "PreferredMode" "640x360"
EndSection
Section "Monitor"
    Identifier "projector"
    HorizSync 1-1000
    VertRefresh 1-200
    Modeline "480x270" 12 480 490 500 520 270 274 278 290
    Option "PreferredMode" "480x270"
    Option "Enable" "true"
    Option "RightOf" "desk"
EndSection
Section "Screen"
    Identifier "screen"
    Device "card"
    DefaultDepth 24
    SubSection "Display"
        Depth 24
        Virtual 1280 720
    EndSubSection
EndSection
"""


@dataclass(frozen=True)
class VirtualScreen:
    """A running Xvfb; `display` is the value of DISPLAY."""

    display: str
    memory: Path
    process: subprocess.Popen[bytes]

    def end(self) -> None:
        """Terminate the server."""
        self.process.kill()
        self.process.wait()

    def picture(self) -> Picture:
        """Return the frame buffer of the server."""
        content = self.memory.read_bytes()
        header = struct.unpack_from(">25I", content)
        size, width, height, stride, colours = header[0], header[4], header[5], header[12], header[19]
        assert (header[1], header[7], header[11]) == (7, 0, 32), "XWD 7, little endian, 32 bits a pixel"
        assert header[14:17] == (0xFF0000, 0xFF00, 0xFF)
        rows = np.frombuffer(content, "<u4", height * stride // 4, size + 12 * colours)
        return rows.reshape(height, stride // 4)[:, :width] & np.uint32(0xFFFFFF)


@contextlib.contextmanager
def virtual_screen(folder: Path, size: str, *, cursor: bool = False) -> Generator[VirtualScreen]:
    """Run Xvfb with one screen of `size`, such as ``800x600``; black, or grey with a cursor; skip without Xvfb."""
    arguments = ["-screen", "0", f"{size}x24", "-fbdir", str(folder), "-nolisten", "tcp", "-noreset"]
    # Without -retro, a cursor appears only after a program has set one.
    arguments += ["-retro"] if cursor else ["-br", "-nocursor"]
    with _running("Xvfb", arguments, folder) as (display, process):
        yield VirtualScreen(display, folder / "Xvfb_screen0", process)


@contextlib.contextmanager
def two_outputs(folder: Path) -> Generator[str]:
    """Run Xorg with outputs of 640×360 and, to its right, 480×270; yield its DISPLAY; skip without Xorg."""
    settings = folder / "xorg.conf"
    settings.write_text(_SETTINGS)
    log = folder / "xorg.log"
    arguments = ["-config", str(settings), "-logfile", str(log), "-noreset", "-nolisten", "tcp", "-novtswitch"]
    with _running("Xorg", [*arguments, "-sharevts", "vt7"], folder) as (display, _):
        yield display


def screenshot(display: str, width: int, height: int) -> Picture:
    """Return the top left `width` × `height` pixels of a server's screen."""
    with socket.socket(socket.AF_UNIX) as server:
        root, _ = _greeted(server, display)
        server.sendall(struct.pack("<BBHIhhHHI", 73, 2, 5, root, 0, 0, width, height, 0xFFFFFFFF))
        kind, depth, length = struct.unpack("<BB2xI24x", _exactly(server, 32))
        assert (kind, depth) == (1, 24)
        pixels = np.frombuffer(_exactly(server, 4 * length), "<u4")
    return pixels.reshape(height, width) & np.uint32(0xFFFFFF)


@contextlib.contextmanager
def notification(display: str, place: tuple[int, int, int, int], code: int) -> Generator[None]:
    """Show a uniform window at x, y, width, height without the window manager, like a notification; 0xRRGGBB.

    X protocol: CreateWindow (1) with background-pixel and override-redirect, MapWindow (8), GetInputFocus (43), whose
    reply confirms all earlier requests.
    """
    with socket.socket(socket.AF_UNIX) as server:
        root, own = _greeted(server, display)
        window = struct.pack("<BBHIIhhHHHHIIII", 1, 0, 10, own, root, *place, 0, 1, 0, 0x0202, code, 1)
        server.sendall(window + struct.pack("<BxHI", 8, 2, own) + struct.pack("<BxH", 43, 1))
        while (kind := _exactly(server, 32)[0]) != 1:
            assert kind != 0, "the X server refuses the window"
        yield
    # The window closes with its connection.


def _greeted(server: socket.socket, display: str) -> tuple[int, int]:
    """Connect; return the root window and the first free window number."""
    server.connect(f"/tmp/.X11-unix/X{display.removeprefix(':')}")
    server.sendall(struct.pack("<BxHHHHxx", ord("l"), 11, 0, 0, 0))
    accepted, length = struct.unpack("<B5xH", _exactly(server, 8))
    assert accepted == 1
    setup = _exactly(server, 4 * length)
    (own,), (vendor,), formats = struct.unpack_from("<I", setup, 4), struct.unpack_from("<H", setup, 16), setup[21]
    (root,) = struct.unpack_from("<I", setup, 32 + (vendor + 3) // 4 * 4 + 8 * formats)
    return root, own


def _exactly(server: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        piece = server.recv(size - len(data))
        assert piece, "the X server disconnected"
        data += piece
    return bytes(data)


@contextlib.contextmanager
def _running(server: str, arguments: list[str], folder: Path) -> Generator[tuple[str, subprocess.Popen[bytes]]]:
    if sys.platform != "linux":
        pytest.skip("the window is an X window on Linux only")
    program = shutil.which(server)
    if program is None:
        package = {"Xvfb": "xvfb", "Xorg": "xserver-xorg-core and xserver-xorg-video-dummy"}[server]
        pytest.skip(f"{server} is not installed (Debian: {package})")
    if ctypes.util.find_library("GL") is None:
        pytest.skip("there is no OpenGL here (Debian: libgl1 and libgl1-mesa-dri)")
    with (folder / f"{server}.err").open("wb") as complaints:
        process = subprocess.Popen(
            [program, "-displayfd", "1", *arguments],
            stdout=subprocess.PIPE,
            stderr=complaints,
            stdin=subprocess.DEVNULL,
        )
    try:
        assert process.stdout is not None
        # The number is printed when the server is ready; a server that cannot start ends without output.
        number = process.stdout.readline().decode().strip()
        if not number:
            pytest.skip(f"{server} does not start here: {(folder / f'{server}.err').read_text()[-300:]}")
        yield f":{number}", process
    finally:
        process.terminate()
        process.communicate()
