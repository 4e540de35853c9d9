"""Bright and dark pixels alone decide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evaluation.methods import BrightDark
from evaluation.metrics import recovery_error

if TYPE_CHECKING:
    pass


LIGHT = np.array([0.5, 1.0, 0.7])


def test_bright_and_dark_pixels_alone_decide() -> None:
    image = np.random.default_rng(1).uniform(400, 600, (50, 50, 3))
    image[:2] = 2000 * LIGHT
    image[-2:] = 20 * LIGHT
    assert recovery_error(BrightDark().estimate(image), LIGHT) < 1e-6
