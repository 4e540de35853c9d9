"""Exposure is judged on counts: clipping, darkness, stray light."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from acquisition.config import LimitSettings
from acquisition.exposure import Exposure, measure_exposure, refusal
from drivers.camera import ExposureSettings
from drivers.rawfile import Mosaic, read_raw
from sim.bodies import BODIES
from sim.dng import write_dng

BODY = BODIES["Test"]
RANGE = BODY.saturation - BODY.black
LIMITS = LimitSettings()


def mosaic_of(tmp_path: Path, level: int, clipped: int = 0) -> Mosaic:
    """Return a frame of one level above black with `clipped` saturated photosites in the visible area."""
    counts = np.full(BODY.sensor, BODY.black, dtype=np.uint16)
    top, left, height, width = BODY.visible
    visible = counts[top : top + height, left : left + width]
    visible[:] = BODY.black + level
    places = np.random.default_rng(1).choice(height * width, clipped, replace=False)
    visible[places // width, places % width] = BODY.saturation
    stream = io.BytesIO()
    write_dng(stream, counts, BODY, settings=ExposureSettings(100, 8, 0.5), taken_at=datetime(2026, 1, 1, tzinfo=UTC))
    path = tmp_path / "frame.dng"
    path.write_bytes(stream.getvalue())
    return read_raw(path)


def test_the_measure_is_that_of_the_counts(tmp_path: Path) -> None:
    exposure = measure_exposure(mosaic_of(tmp_path, 4000, clipped=4456))
    photosites = BODY.visible.height * BODY.visible.width
    assert exposure.clipped == pytest.approx(4456 / photosites)
    exposure = measure_exposure(mosaic_of(tmp_path, 4000))
    assert exposure.clipped == 0
    assert exposure.brightest_dn == pytest.approx(4000, abs=1e-6)
    assert exposure.level == pytest.approx(4000 / RANGE, rel=1e-6)


@pytest.mark.parametrize(
    ("clipped", "brightest", "kind", "expected"),
    [
        (0.0, 8000, "light", None),
        (0.001, 8000, "light", None),
        (0.0011, 8000, "light", "0.1% of photosites clipped, 0.1 % allowed"),
        (0.031, 8000, "white", "3.1% of photosites clipped"),
        (0.0, 99, "light", "reach 99 counts above black, 100 expected"),
        (0.0, 100, "white", None),
        (0.0, 8, "dark", None),
        (0.0, 0.06 * RANGE, "dark", "6.0% of saturation, 5 % allowed"),
    ],
)
def test_a_refusal_says_value_and_limit(clipped: float, brightest: float, kind: str, expected: str | None) -> None:
    reason = refusal(Exposure(clipped, brightest, RANGE), kind, LIMITS)  # pyright: ignore[reportArgumentType]
    if expected is None:
        assert reason is None
    else:
        assert reason is not None
        assert expected in reason
