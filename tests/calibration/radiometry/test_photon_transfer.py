"""The photon-transfer curve, from cells whose noise is made to order."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.sampling import photon_transfer


@pytest.mark.slow
def test_gain_and_read_noise_are_found() -> None:
    random = np.random.default_rng(4)
    level = random.uniform(20, 9000, (6000, 3))
    variance = np.array([36.0, 18, 36]) + level / [1.8, 3.6, 1.8] + (0.003 * level) ** 2
    samples = level[:, None] + np.sqrt(variance)[:, None] * random.standard_normal((6000, 25, 3))
    found = photon_transfer(samples.mean(axis=1), samples.var(axis=1, ddof=1))
    assert found.gain_e == pytest.approx([1.8, 3.6, 1.8], rel=0.06)
    assert found.read_noise == pytest.approx(np.sqrt([36, 18, 36]), rel=0.4)
    assert found.response == pytest.approx(0.003, rel=0.35)
    assert (found.misfit < 0.1).all()
    assert not found.noisy.any()


def test_cells_that_are_not_of_one_colour_are_listed() -> None:
    random = np.random.default_rng(5)
    level = random.uniform(500, 9000, (3000, 3))
    samples = level[:, None] + np.sqrt(level / 1.8)[:, None] * random.standard_normal((3000, 25, 3))
    samples[7, :13] *= 1.15
    found = photon_transfer(samples.mean(axis=1), samples.var(axis=1, ddof=1))
    assert np.flatnonzero(found.noisy).tolist() == [7]
