"""Errors compared with known angles, statistics with MATLAB and hand calculation, maps with LSMI."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation import metrics as maps
from evaluation.metrics import measure_map, percentiles, recovery_error, reproduction_error, summarise

lights = st.tuples(*[st.floats(0.01, 100)] * 3)


def test_recovery_is_angle_between_illuminants() -> None:
    assert recovery_error([1, 0, 0], [0, 2, 0]) == pytest.approx(90)
    assert recovery_error([1, 1, 0], [1, 0, 0]) == pytest.approx(45)
    assert recovery_error([1, 1, 1], [1, 0, 0]) == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))


def test_reproduction_is_angle_of_corrected_white() -> None:
    # White (2, 1, 1) under an estimate of grey stays (2, 1, 1): cos = 4 / (sqrt 6 sqrt 3).
    assert reproduction_error([1, 1, 1], [2, 1, 1]) == pytest.approx(math.degrees(math.acos(4 / math.sqrt(18))))
    # One channel of the estimate at zero: the corrected white is that channel alone.
    assert reproduction_error([0, 1, 1], [1, 1, 1]) == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))


@pytest.mark.slow
@given(lights, lights, st.floats(0.001, 1000))
def test_errors_do_not_depend_on_brightness(
    estimate: tuple[float, ...], truth: tuple[float, ...], scale: float
) -> None:
    for error in (recovery_error, reproduction_error):
        angle = error(estimate, truth)
        assert error(np.multiply(estimate, scale), truth) == pytest.approx(float(angle), abs=1e-6)
        assert 0 <= angle <= 90
        assert error(estimate, estimate) == pytest.approx(0, abs=1e-6)


@given(lights, lights)
def test_reproduction_does_not_depend_on_illuminant(estimate: tuple[float, ...], truth: tuple[float, ...]) -> None:
    # Finlayson's argument for it: a change of light scales estimate and truth alike.
    light = np.array([3.0, 0.5, 1.7])
    moved = reproduction_error(np.multiply(estimate, light), np.multiply(truth, light))
    assert moved == pytest.approx(float(reproduction_error(estimate, truth)), abs=1e-6)


def test_small_angles_are_accurate() -> None:
    assert recovery_error([1, 1e-9, 0], [1, 0, 0]) == pytest.approx(math.degrees(1e-9), rel=1e-6)


RED, WHITE = np.array([1.0, 0.5, 0.5]), np.array([1.0, 1, 1])
LIGHTS = np.stack([RED, WHITE])


def halves(height: int = 6, width: int = 8, red_columns: int = 2) -> npt.NDArray[np.float64]:
    """Return weights (H, W, 2): red alone in the left columns, white alone in the others."""
    weights = np.zeros((height, width, 2))
    weights[:, :red_columns, 0] = weights[:, red_columns:, 1] = 1
    return weights


def test_one_illuminant_for_all_pixels() -> None:
    weights = halves()
    error = measure_map(WHITE, weights @ LIGHTS, weights, LIGHTS, image=weights @ LIGHTS)
    angle = float(recovery_error(WHITE, RED))
    assert error.recovery == pytest.approx(angle / 4)
    assert error.reproduction == pytest.approx(float(reproduction_error(WHITE, RED)) / 4)
    assert [(region.light, region.share) for region in error.regions] == [(0, 0.25), (1, 0.75)]
    assert [region.recovery for region in error.regions] == pytest.approx([angle, 0])


def test_perfect_map_has_no_error() -> None:
    weights = np.random.default_rng(3).dirichlet((1, 1, 1), (5, 7))
    lights = np.array([[1.0, 2, 1], [2, 2, 1], [1, 2, 3]])
    truth = weights @ lights
    image = truth * np.random.default_rng(4).random((5, 7, 1))
    error = measure_map(truth * 3, truth, weights, lights, image)
    assert (error.recovery, error.reproduction, error.rgb) == pytest.approx((0, 0, 0), abs=1e-9)
    # A pixel of more than half a light still has something of the others: its estimate is right, and not that light.
    assert all(region.recovery > 0 for region in error.regions)


def test_illuminant_without_dominance_has_no_region() -> None:
    weights = np.full((4, 4, 2), 0.5)
    assert measure_map(WHITE, weights @ LIGHTS, weights, LIGHTS, np.ones((4, 4, 3))).regions == ()


def test_excludes_masked_and_unknown_pixels() -> None:
    weights = halves()
    truth = weights @ LIGHTS
    mask = np.zeros(truth.shape[:2], bool)
    mask[:, 0] = True
    truth[:, 1] = np.nan
    image = np.ones(truth.shape)
    image[:, :2] = np.nan  # What is left out is not even looked at.
    error = measure_map(WHITE, truth, weights, LIGHTS, image, mask=mask)
    assert (error.recovery, error.reproduction, error.rgb) == (0, 0, 0)
    assert [(region.light, region.share) for region in error.regions] == [(1, 1.0)]
    nothing = measure_map(WHITE, np.full(truth.shape, np.nan), weights, LIGHTS, image)
    assert math.isnan(nothing.recovery)
    assert nothing.regions == ()


def test_bands_do_not_change_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)
    weights = random.dirichlet((1, 1), (30, 20))
    image, estimate = random.random((30, 20, 3)), random.random((30, 20, 3)) + 0.1
    unbanded = measure_map(estimate, weights @ LIGHTS, weights, LIGHTS, image, 0.8)
    monkeypatch.setattr(maps, "_PIXELS_AT_ONCE", 40)
    banded = measure_map(estimate, weights @ LIGHTS, weights, LIGHTS, image, 0.8)
    assert banded.recovery == pytest.approx(unbanded.recovery)
    assert banded.rgb == pytest.approx(unbanded.rgb)
    assert [region.reproduction for region in banded.regions] == pytest.approx(
        [region.reproduction for region in unbanded.regions]
    )


def test_rgb_error_follows_lsmi() -> None:
    # One pixel after the other: red and blue divided by the light's over its green, clipped, the angle between the two.
    random = np.random.default_rng(2)
    weights = random.dirichlet((1, 1), (9, 11))
    image = random.integers(0, 1023, (9, 11, 3)).astype(np.uint16)
    image[0, 0] = 0
    truth, estimate = weights @ LIGHTS, random.random((9, 11, 3)) + 0.2
    angles: list[float] = []
    for index in np.ndindex(9, 11):
        corrected: list[npt.NDArray[np.float64]] = []
        for light in (estimate[index], truth[index]):
            red, green, blue = image[index]
            colour = [red / (light[0] / light[1]), green, blue / (light[2] / light[1])]
            corrected.append(np.minimum(colour, 1023) + 1e-4)
        first, second = corrected
        cosine = first @ second / math.sqrt(float(first @ first) * float(second @ second))
        angles.append(math.degrees(math.acos(min(1.0, cosine))))
    error = measure_map(estimate, truth, weights, LIGHTS, image, saturation=1023)
    assert error.rgb == pytest.approx(np.mean(angles), abs=1e-4)
    assert error.rgb != pytest.approx(measure_map(estimate, truth, weights, LIGHTS, image).rgb, abs=1e-3)


def test_estimate_with_zero_channel() -> None:
    weights = halves()
    error = measure_map(np.array([1.0, 1, 0]), weights @ LIGHTS, weights, LIGHTS, weights @ LIGHTS)
    assert error.reproduction == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))
    assert np.isfinite(error.rgb)


def test_summary_matches_hand_calculation() -> None:
    # By MATLAB's prctile the errors stand at 6.25, 18.75, 31.25 ... percent: Q1 = 2.5, Q2 = 4.5, Q3 = 6.5.
    summary = summarise([8, 1, 7, 2, 6, 3, 5, 4])
    assert summary.as_tuple() == pytest.approx((4.5, 4.5, 4.5, 1.5, 7.5, (4.5**3 * 1.5 * 7.5) ** 0.2, 8))
    assert summary.maximum == 8
    assert summary.below3 == 2 / 8  # 3 itself is not below 3.

    # At 10, 30, 50, 70, 90 percent: Q1 = 1 + 0.75 = 1.75, Q3 = 4 + 0.25 * 6 = 5.5; with 1, 2, 3, 4, 10.
    summary = summarise([1, 2, 3, 4, 10])
    assert summary.as_tuple()[:5] == pytest.approx((4, 3, (1.75 + 6 + 5.5) / 4, 1, 10))

    # The 19th of 20 stands at 92.5 percent, the 20th at 97.5: half-way.
    assert summarise(np.arange(1, 21)).p95 == pytest.approx(19.5)


def test_worst_5_matches_program_of_c5() -> None:
    # `error_metrics` of evaluation/evaluation.py (github.com/mahmoudnafifi/C5). Of 40 errors, NumPy's and MATLAB's
    # percentiles select the same two.
    errors = np.random.default_rng(4).gamma(1.5, 2.0, (40, 1))
    limit = np.percentile(errors, [25, 50, 75, 95])[3]
    assert summarise(errors).worst5 == pytest.approx(np.mean(errors[np.argwhere(np.squeeze(errors) >= limit)]))


def test_percentiles_match_matlab() -> None:
    # prctile([1 2 3 4 5 6], [25 50 75]): 1.5 places in steps of 100 / 6 from 8.33 percent; the ends stay the ends.
    assert percentiles([6, 5, 4, 3, 2, 1], (25, 50, 75)) == pytest.approx((2, 3.5, 5))
    assert percentiles([6, 5, 4, 3, 2, 1], (0, 5, 100)) == pytest.approx((1, 1, 6))
