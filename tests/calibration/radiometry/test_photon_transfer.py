"""The photon-transfer curve, from cells whose noise is made to order."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.radiometry.table_noise import noise_curve
from calibration.sampling import photon_transfer
from foundation.errors import InputError


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


def stored(samples: np.ndarray[Any, Any], unfit: tuple[int, ...] = ()) -> Any:
    """Return of a table (L, C, S, 3) what its noise is read from."""
    return SimpleNamespace(
        folder="a table",
        samples=samples,
        white=np.ones((len(samples), 3)),
        light_samples=samples.__getitem__,
        provenance=SimpleNamespace(unfit=[SimpleNamespace(colour=colour) for colour in unfit]),
    )


def test_a_table_s_noise_is_that_of_its_samples_however_little() -> None:
    level = np.linspace(100, 9000, 64)[None, :, None, None]
    noise = np.random.default_rng(3).normal(0, 0.5, (2, 64, 25, 3))
    quiet = np.rint(level + noise).astype(np.uint16)
    assert quiet.var(axis=2, ddof=1).max() < 1
    found = noise_curve(stored(quiet))
    assert found is not None
    # Rounding adds a twelfth.
    assert found.read_noise == pytest.approx(np.sqrt(0.25 + 1 / 12), rel=0.1)
    assert noise_curve(stored(np.rint(level + 0 * noise).astype(np.uint16))) is None


def test_a_table_of_too_few_cells_has_no_known_noise() -> None:
    noisy = np.random.default_rng(3).normal(1000, 30, (1, 33, 25, 3)).astype(np.uint16)
    assert noise_curve(stored(noisy, unfit=(7,))) is not None
    # Samples that are 0 are cut, and their cell is no longer as noisy as its level.
    noisy[0, 5, 3, 1] = 0
    assert noise_curve(stored(noisy)) is not None
    with pytest.raises(InputError, match="31 cells"):
        noise_curve(stored(noisy, unfit=(7,)))
    with pytest.raises(InputError, match="0 cells"):
        noise_curve(stored(noisy[:, :, :1]))


def test_samples_that_follow_no_curve_have_no_known_noise() -> None:
    level = np.repeat([500.0, 1000, 2000, 4000], 16)[None, :, None, None]
    spread = np.repeat([60.0, 5, 60, 5], 16)[None, :, None, None]
    wild = level + spread * np.random.default_rng(3).normal(0, 1, (1, 64, 25, 3))
    with pytest.raises(InputError, match="do not follow"):
        noise_curve(stored(wild.astype(np.uint16)))
