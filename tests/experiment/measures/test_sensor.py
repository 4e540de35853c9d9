"""Saturation level of a frame, and drift of the black level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from drivers.camera import ExposureSettings
from drivers.presenter import WHITE
from experiment.measures.sensor import black_drift
from tests.calibration.lab import hang


@pytest.mark.slow
def test_measures_saturation_in_the_frame(tmp_path: Path) -> None:
    lab = hang()
    normal = lab.mosaic(tmp_path)
    assert normal.saturation() == normal.white_level == lab.world.body.saturation
    # A sensor that saturates below the value of its file, as in LibRaw's table for the EOS 550D.
    plateau = 12_800

    def saturate(counts: npt.NDArray[np.uint16]) -> None:
        np.minimum(counts, plateau, out=counts)

    bright = lab.mosaic(tmp_path, WHITE, settings=ExposureSettings(100, 8.0, 2.0), paint=saturate)
    assert bright.white_level > plateau
    assert bright.saturation() == plateau


def test_black_drift_is_the_largest_of_all_positions() -> None:
    assert black_drift([]) == 0
    assert black_drift([np.zeros((2, 2)), np.array([[0, 0.2], [-0.3, 0.1]])]) == pytest.approx(0.3)
