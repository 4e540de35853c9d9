"""An address as a QR code (ISO/IEC 18004) in the terminal, for a phone's camera; OpenCV makes the code."""

from __future__ import annotations

import numpy as np

QUIET_MODULES = 4
"""Light modules around a code, as ISO/IEC 18004 asks for."""


def qr_text(text: str) -> str:
    """Return a QR code of `text` as lines of half blocks, dark on light on any terminal: two rows of modules a line."""
    import cv2

    code = np.asarray(cv2.QRCodeEncoder.create().encode(text)) < 128
    rows, columns = np.flatnonzero(code.any(axis=1)), np.flatnonzero(code.any(axis=0))
    code = np.pad(code[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], QUIET_MODULES)
    if len(code) % 2:
        code = np.pad(code, ((0, 1), (0, 0)))
    # Light modules are drawn, in white on black, whatever the terminal's own colours are.
    blocks = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}
    lines = (
        "".join(blocks[bool(upper), bool(lower)] for upper, lower in zip(above, below, strict=True))
        for above, below in zip(code[::2], code[1::2], strict=True)
    )
    return "\n".join(f"\x1b[97;40m{line}\x1b[0m" for line in lines)
