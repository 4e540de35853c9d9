"""What is said of a lens: assumed of one that is not measured, left in on purpose or by its errors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from calibration.spread import correction
from calibration.spread.correction import LensFigures

MEASURED = LensFigures(
    rms=0.004, worst=0.03, residual=0.003, residual_worst=0.04, worst_level=0.1, veil=0.01, veil_error=0.002,
    beyond_cell=0.02, left_in_worst=0.005, white_covariance=np.eye(3) * 1e-6, cells_error=np.full((4, 3), 0.01),
)  # fmt: skip


def test_of_a_lens_that_is_not_measured_a_veil_of_a_hundredth_is_assumed() -> None:
    levels = np.array([[0.8, 0.6, 0.4], [0.2, 0.2, 1e-5], [np.nan, 0.4, np.nan]])
    found = LensFigures.unknown("too few cells", levels)
    mean = np.array([0.5, 0.4, 0.200005])
    known = np.array([[0.8, 0.6, 0.4], [0.2, 0.2, 1e-3], [0.5, 0.4, 0.200005]])
    # White has 1 - mean less of the veil than an even print; channels are alike but for a third of it.
    alike = np.full((3, 3), 1 - 1 / 9) + np.eye(3) / 9
    np.testing.assert_allclose(found.white_covariance, 1e-4 * alike * np.outer(1 - mean, 1 - mean))
    # A cell has as much of it as others, over its own level, less what white has.
    np.testing.assert_allclose(found.cells_error, 0.01 * np.abs(mean / known - mean))
    assert (found.measured, found.corrected, found.why_not) == (False, False, "too few cells")
    assert (found.rms, found.veil_at_most, found.is_left_in) == (0, 0, False)
    assert found.to_json()["assumed"]


def test_what_is_left_is_the_residual_and_without_correction_what_it_would_change_as_well() -> None:
    assert (MEASURED.left, MEASURED.left_worst) == (0.003, 0.04)
    assert MEASURED.veil_at_most == pytest.approx(0.014)
    assert (MEASURED.uncorrected_in_worst, MEASURED.is_left_in) == (0.005, False)
    assert replace(MEASURED, left_in_worst=-0.1).uncorrected_in_worst == 0
    left_in = replace(MEASURED, corrected=False)
    assert (left_in.left, left_in.left_worst) == pytest.approx((0.005, 0.05))
    assert (left_in.uncorrected_in_worst, left_in.is_left_in) == (0.02, True)
    # A lens that spreads nothing has nothing to leave in.
    sharp = replace(left_in, beyond_cell=0.0)
    assert (sharp.left, sharp.left_worst, sharp.is_left_in) == (0.003, 0.04, False)
    written = MEASURED.to_json()
    assert written["residual_worst"] == 0.04
    assert np.array(written["white_covariance"]) == pytest.approx(np.eye(3) * 1e-6)


@pytest.mark.parametrize(("references", "order"), [(0, 0), (8, 0), (9, 1), (17, 1), (18, 2), (29, 2), (30, 3)])
def test_white_references_show_a_change_of_a_third_as_many_terms(references: int, order: int) -> None:
    # A polynomial of order n over the page has (n + 1) (n + 2) / 2 terms.
    assert correction._white_order(references) == order


def test_a_kernel_brings_the_tails_beyond_a_cell_half_a_pixel_off_its_middle() -> None:
    around: Any = SimpleNamespace(pitch_px=np.array([[10.0, 11], [9.0, 12]]), window=5)
    worst, mean = correction._beyond_cell(around)
    for kernel, sigma in enumerate((1.5, 3.0, 6.0)):
        at = np.array([-2.0, -1, 0, 1, 2]) + 0.5
        inside = np.asarray(stats.norm(at, sigma).cdf(4.5) - stats.norm(at, sigma).cdf(-4.5), dtype=np.float64)
        assert worst[kernel] == pytest.approx(1 - inside[-1] ** 2)
        assert mean[kernel] == pytest.approx(1 - float(np.outer(inside, inside).mean()))
