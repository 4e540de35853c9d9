"""Minimal colour profiles of ICC.1:2001-04 (version 2.4): matrix and gamma, or grey and gamma."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


def _fixed(*numbers: float) -> bytes:
    return struct.pack(f">{len(numbers)}i", *(round(number * 65536) for number in numbers))


def _xyz(numbers: object) -> bytes:
    return b"XYZ \0\0\0\0" + _fixed(*np.asarray(numbers, dtype=float).tolist())


D50 = np.array([0.9642, 1.0, 0.8249])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass(frozen=True)
class Space:
    """Chromaticities x, y of red, green, blue and white."""

    primaries: tuple[tuple[float, float], ...]
    white: tuple[float, float]

    def columns(self) -> npt.NDArray[np.float64]:
        """Return XYZ of red, green and blue, (3, 3) rows, adapted to D50 by Bradford."""
        *rgb, white = (np.array([x, y, 1 - x - y]) / y for x, y in (*self.primaries, self.white))
        lights = np.array(rgb).T
        adapt = np.linalg.inv(BRADFORD) @ np.diag(BRADFORD @ D50 / (BRADFORD @ white)) @ BRADFORD
        return np.asarray((adapt @ (lights * np.linalg.solve(lights, white))).T, dtype=np.float64)


# Adobe RGB (1998) Color Image Encoding, 4.3.2; ISO 22028-2, 4.2.
ADOBE_RGB = Space(((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)), (0.3127, 0.329))
PROPHOTO_RGB = Space(((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), (0.3457, 0.3585))


def gamma_profile(name: str, gamma: float, space: Space | None) -> bytes:
    """Return a display profile of the primaries of `space`, or a grey one; white is adapted to D50 by Bradford."""
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256))
    text = name.encode() + b"\0"
    described = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    tags = {
        b"desc": described,
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": _xyz(D50),
    }
    if space is None:
        tags[b"kTRC"] = curve
    else:
        for tag, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), space.columns(), strict=True):
            tags[tag] = _xyz(column)
        for tag in (b"rTRC", b"gTRC", b"bTRC"):
            tags[tag] = curve
    body, table = b"", b""
    for tag, data in tags.items():
        offset = 128 + 4 + 12 * len(tags) + len(body)
        table += tag + struct.pack(">II", offset, len(data))
        body += data + bytes(-len(data) % 4)
    head = bytearray(128)
    head[8:12] = bytes([2, 0x40, 0, 0])
    head[12:24] = b"mntr" + (b"GRAY" if space is None else b"RGB ") + b"XYZ "
    head[36:40] = b"acsp"
    head[68:80] = _fixed(*D50)
    profile = bytes(head) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(profile)) + profile[4:]
