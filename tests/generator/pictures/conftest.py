"""A small picture of many colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest


@pytest.fixture
def colours() -> npt.NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 256, (5, 7, 3)).astype(np.uint8)
