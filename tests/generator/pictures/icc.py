"""Colour profiles made by hand, after ICC.1:2001-04 (version 2.4): matrix and gamma, or grey and gamma."""

from __future__ import annotations

import struct

import colour
import numpy as np


def _fixed(*numbers: float) -> bytes:
    return struct.pack(f">{len(numbers)}i", *(round(number * 65536) for number in numbers))


def _xyz(numbers: object) -> bytes:
    return b"XYZ \0\0\0\0" + _fixed(*np.asarray(numbers, dtype=float).tolist())


def gamma_profile(name: str, gamma: float, space: colour.RGB_Colourspace | None) -> bytes:
    """Return a display profile of the primaries of `space`, or a grey one; white is adapted to D50 by Bradford."""
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256))
    text = name.encode() + b"\0"
    described = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    tags = {
        b"desc": described,
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": _xyz([0.9642, 1.0, 0.8249]),
    }
    if space is None:
        tags[b"kTRC"] = curve
    else:
        white = colour.xy_to_XYZ(space.whitepoint)
        adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, [0.9642, 1.0, 0.8249], "Bradford")
        columns = (adapt @ space.matrix_RGB_to_XYZ).T
        for tag, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True):
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
    head[68:80] = _fixed(0.9642, 1.0, 0.8249)
    profile = bytes(head) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(profile)) + profile[4:]
