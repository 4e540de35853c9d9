"""Lamp drift between white frames: gains, uncertainty, and exact recovery of counts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.radiometry.drift import as_measured, corrected, drift_correction, drift_uncertainty

WHITE = np.array([3000.0, 7000.0, 4000.0])
EVERY_S = np.arange(0.0, 3601.0, 600.0)
LIGHTS_S = np.linspace(10, 3590, 200)


def test_removes_linear_drift_completely() -> None:
    channels = np.array([0.01, 0.02, 0.03])
    correction = drift_correction(LIGHTS_S, EVERY_S, WHITE * (1 - np.outer(EVERY_S / 3600, channels)))
    assert correction.gains == pytest.approx(1 - np.outer(LIGHTS_S / 3600, channels), abs=1e-6)
    assert correction.uncertainty < 1e-9


def test_scales_to_brightest_lamp() -> None:
    correction = drift_correction(LIGHTS_S, EVERY_S, WHITE * (0.9 + 0.1 * EVERY_S / 3600)[:, None])
    assert correction.gains.max() <= 1
    assert correction.gains[-1] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("jump", [0.004, 0.01, 0.02])
def test_jump_leaves_half_undetermined(jump: float) -> None:
    lamp = np.where(EVERY_S < 1500, 1.0, 1 - jump)
    assert drift_uncertainty(LIGHTS_S, EVERY_S, WHITE * lamp[:, None]) == pytest.approx(jump / 2, rel=0.02)


def test_smooth_warm_up_leaves_little_undetermined() -> None:
    lamp = 1 - 0.02 * np.exp(-EVERY_S / 1800)
    uncertainty = drift_uncertainty(LIGHTS_S, EVERY_S, WHITE * lamp[:, None])
    gains = drift_correction(LIGHTS_S, EVERY_S, WHITE * lamp[:, None]).gains
    true = (1 - 0.02 * np.exp(-LIGHTS_S / 1800)) / lamp.max()
    error = float(np.abs(gains[:, 0] / true - 1).max())
    assert error < uncertainty < 0.002


def test_two_white_frames_may_hide_full_jump() -> None:
    both = np.array([0.0, 3600.0])
    assert drift_uncertainty(LIGHTS_S, both, WHITE * np.array([[1.0], [0.98]])) == pytest.approx(0.02)


def test_extrapolation_adds_uncertainty() -> None:
    white = WHITE * (1 - 0.02 * EVERY_S / 3600)[:, None]
    late = np.append(LIGHTS_S, 3600.0 + 1800.0)
    assert drift_uncertainty(late, EVERY_S, white) == pytest.approx(0.01, rel=0.03)
    assert drift_uncertainty(np.append(LIGHTS_S, -600.0), EVERY_S, white) == pytest.approx(0.02 / 6, rel=0.03)


def test_refuses_one_white_frame() -> None:
    with pytest.raises(ValueError, match="1 white frames"):
        drift_correction(LIGHTS_S, EVERY_S[:1], WHITE[None])


@pytest.mark.parametrize("samples", [9, 25, 49, 81])
@pytest.mark.parametrize("level", [30, 201, 9000])
def test_mean_of_patch_is_not_rounded(level: int, samples: int) -> None:
    counts = level + np.arange(samples, dtype=np.uint16)[None, :, None] % 5 * np.ones((1, 1, 3), dtype=np.uint16)
    for gain in (0.97, 0.998, 0.9985, 0.9999):
        mean = corrected(counts, np.array([gain] * 3)).mean(axis=1)
        # Plain rounding would be off by up to half a count.
        assert mean == pytest.approx(counts.mean(axis=1) / gain, abs=0.12), gain


def test_clips_to_sixteen_bits() -> None:
    counts = np.full((1, 9, 3), 60_000, dtype=np.uint16)
    scaled = corrected(counts, np.array([1.0, 0.95, 0.5]))
    assert scaled[0].max(axis=0).tolist() == [60_000, 63_158, 65_535]
    assert scaled[0, :, 2].min() == 65_535


@given(st.lists(st.floats(0.5, 1.0), min_size=3, max_size=3), st.integers(0, 2**32 - 1))
def test_recovers_counts_exactly(gain: list[float], seed: int) -> None:
    stored = np.array([float(f"{value:.6f}") for value in gain])
    counts = np.random.default_rng(seed).integers(0, 16384, (40, 25, 3), dtype=np.uint16)
    counts[0, :, :] = np.arange(25)[:, None]
    assert np.array_equal(as_measured(corrected(counts, stored), stored), counts)


@pytest.mark.slow
def test_recovers_all_counts_at_critical_gains() -> None:
    counts = np.arange(16384, dtype=np.uint16)[:, None, None] * np.ones((1, 25, 3), dtype=np.uint16)
    for gain in (0.5, 0.666667, 0.999999, 0.9, 0.75, 1.0):
        stored = np.array([gain] * 3)
        assert np.array_equal(as_measured(corrected(counts, stored), stored), counts), gain
