"""A LUT of a print, and pictures."""

from __future__ import annotations

import cv2
import numpy as np

from tests.generator.rendering.conftest import make_table as make_table_of_a_print

make_table = make_table_of_a_print


def png(seed: int, width: int = 90, height: int = 50) -> bytes:
    """Return a PNG of random colours in squares of 10×10 px."""
    codes = np.random.default_rng(seed).integers(0, 256, (height // 10, width // 10, 3)).astype(np.uint8)
    return cv2.imencode(".png", codes.repeat(10, axis=0).repeat(10, axis=1))[1].tobytes()
