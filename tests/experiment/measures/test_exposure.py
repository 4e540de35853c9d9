"""Brightness and clipping of a frame."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.measures.exposure import measure_exposure


def mosaic(level: int, clipped: int = 0) -> Mosaic:
    """Return a frame of one level above black with clipped photosites."""
    counts = np.full((320, 480), 2048 + level, dtype=np.uint16)
    counts.ravel()[np.random.default_rng(1).choice(counts.size, clipped, replace=False)] = 15831
    return Mosaic(counts, "RGGB", np.full((2, 2), 2048.0), 15831, "a camera", counts, Area(0, 0, 320, 480), ())


def test_measures_level_and_clipping() -> None:
    assert measure_exposure(mosaic(4000, clipped=100)).clipped == pytest.approx(100 / (320 * 480))
    exposure = measure_exposure(mosaic(4000))
    assert exposure.clipped == 0
    assert exposure.brightest_dn == pytest.approx(4000, abs=1e-6)
    assert exposure.level == pytest.approx(4000 / (15831 - 2048), rel=1e-6)
