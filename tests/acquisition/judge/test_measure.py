"""Limits of the exposure, comparison of the exposure with the settings, and white paper without a chart."""

from __future__ import annotations

import io
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from acquisition.judge import measure
from acquisition.judge.measure import disagreement, refusal
from drivers.camera import ExposureSettings
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.config import LimitSettings
from experiment.measures.exposure import Exposure
from sim.camera.film import write_dng
from sim.world.sensors import BODIES

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


@pytest.mark.parametrize(
    ("clipped", "brightest", "kind", "expected"),
    [
        (0.0, 8000, "light", None),
        (0.001, 8000, "light", None),
        (0.0011, 8000, "light", "0.1% of the photosites are clipped, at most 0.1 % allowed"),
        (0.031, 8000, "white", "3.1% of the photosites are clipped"),
        (0.0, 99, "light", "are 99 counts above black, at least 100 counts allowed"),
        (0.0, 100, "white", None),
        (0.0, 8, "dark", None),
        (0.0, 0.06 * RANGE, "dark", "6.0% of saturation, at most 5 % allowed"),
    ],
)
def test_refusal_reports_value_and_limit(clipped: float, brightest: float, kind: str, expected: str | None) -> None:
    reason = refusal(Exposure(clipped, brightest, RANGE), kind, LIMITS)  # pyrefly: ignore[bad-argument-type]
    if expected is None:
        assert reason is None
    else:
        assert reason is not None
        assert expected in reason


SETTINGS = ExposureSettings(iso=100, aperture=8, shutter_s=0.5)


@pytest.mark.parametrize(
    ("settings", "values"),
    [  # nominal value on the dial, exact value in the file: 2^(n/8) s, 2^(n/16), 100 · 2^(n/8)
        ({"shutter_s": 30.0}, {"shutter_s": 32.0}),
        ({"shutter_s": 1 / 60}, {"shutter_s": 1 / 64}),
        ({"shutter_s": 0.6}, {"shutter_s": 2**-0.625}),
        ({"shutter_s": 0.3}, {"shutter_s": 2**-1.5}),
        ({"aperture": 3.5}, {"aperture": 2 ** (29 / 16)}),
        ({"aperture": 1.8}, {"aperture": 2 ** (12 / 16)}),
        ({"iso": 1250}, {"iso": 1270}),
        ({}, {}),
        ({}, {"iso": None, "aperture": None, "shutter_s": None}),
        ({}, {"aperture": 0.0}),
        ({"aperture": None}, {"aperture": 0.0}),
        ({"aperture": None}, {"aperture": None}),
    ],
)
def test_accepts_rounded_exposure_values(
    tmp_path: Path, settings: dict[str, float | None], values: dict[str, float | None]
) -> None:
    mosaic = replace(mosaic_of(tmp_path, 4000), **values)  # pyrefly: ignore[bad-argument-type]
    assert disagreement(mosaic, replace(SETTINGS, **settings)) is None  # pyrefly: ignore[bad-argument-type]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"shutter_s": 0.4}, "the file has shutter time in s 0.4 instead of 0.5"),
        ({"shutter_s": 0.6}, "shutter time in s 0.6 instead of 0.5"),
        ({"aperture": 9.0}, "aperture 9 instead of 8"),
        ({"iso": 125}, "ISO speed 125 instead of 100"),
        ({"iso": 200, "shutter_s": 0.25}, "ISO speed 200 instead of 100, shutter time in s 0.25 instead of 0.5"),
    ],
)
def test_reports_dial_turned_by_third_of_stop(tmp_path: Path, values: dict[str, float], expected: str) -> None:
    mosaic = replace(mosaic_of(tmp_path, 4000), **values)  # pyrefly: ignore[bad-argument-type]
    assert expected in (disagreement(mosaic, SETTINGS) or "")


def test_reports_aperture_of_other_lens(tmp_path: Path) -> None:
    mosaic = replace(mosaic_of(tmp_path, 4000), aperture=5.6)
    assert "aperture 5.6 instead of none" in (disagreement(mosaic, replace(SETTINGS, aperture=None)) or "")


def test_paper_level_has_no_selection_bias() -> None:
    """Selecting the brightest noise would make the first frame 1.2 % brighter."""
    random = np.random.default_rng(4)
    scene = np.full((400, 600), 200.0)
    middles = [(x, y) for y in range(20, 380, 20) for x in range(20, 580, 20)]
    for x, y in middles:
        # Light falls off by a quarter, as it does over a frame.
        scene[y - 5 : y + 6, x - 5 : x + 6] = 1000 * (1 - 0.25 * np.hypot(x - 300, y - 200) / 360)
    first, later = (np.asarray(scene + random.normal(0, 15, scene.shape), dtype=np.float32) for _ in range(2))
    centres = measure._paper_centres(first, np.array(middles, dtype=np.float64))
    x, y = centres.T
    assert len(centres) == len(middles)
    assert np.abs(centres - middles).max() <= 2
    levels = [np.mean([frame[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]) for frame in (first, later)]
    assert levels[0] == pytest.approx(levels[1], rel=1.5e-3)
