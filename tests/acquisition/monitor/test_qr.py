"""The QR code in the terminal is read by a reader of such codes."""

from __future__ import annotations

import re

import cv2
import numpy as np

from acquisition.monitor.server import qr_text

ADDRESS = "http://192.168.178.123:8707/abcdefghijklmnopqrstuv/"


def test_a_reader_finds_the_address_in_what_is_printed() -> None:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in qr_text(ADDRESS).splitlines()]
    assert len({len(line) for line in lines}) == 1
    light = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [[light[character][half] for character in line] for line in lines for half in (0, 1)]
    picture = np.kron(np.array(rows, np.uint8) * 255, np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == ADDRESS
    # ISO/IEC 18004, 6.3.8: four light modules on each side.
    assert all(all(row[:4]) and all(row[-4:]) for row in rows)
    assert all(all(row) for row in rows[:4] + rows[-4:])


def test_it_fits_a_terminal_of_80_columns() -> None:
    assert max(len(re.sub(r"\x1b\[[0-9;]*m", "", line)) for line in qr_text(ADDRESS).splitlines()) <= 80
