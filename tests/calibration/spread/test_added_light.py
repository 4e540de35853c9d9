"""Added light on part of a print: position, amount and uncertainty."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.spread.added_light import AddedLight, added_light

_Array = npt.NDArray[np.float64]

PAGE_MM = (240.0, 160.0)
NOISE = 5e-4


def levels() -> _Array:
    """Return levels (512, 3) of inks with square roots that mix linearly."""
    ink = 1 - np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / 7
    mix = np.array([[0.55, 0.15, 0.05], [0.1, 0.55, 0.12], [0.05, 0.2, 0.5]])
    return (0.95 - ink @ mix.T) ** 2


def positions() -> _Array:
    """Return a grid of 512 patches of 6 mm in random order."""
    y, x = np.mgrid[:16, :32]
    grid = np.stack([x.ravel(), y.ravel()], axis=1) * 6.0 + (24, 35)
    return np.random.default_rng(8).permutation(grid)


@pytest.mark.slow
def test_measures_reflection() -> None:
    random = np.random.default_rng(2)
    level, cells = levels(), positions()
    distance = np.linalg.norm(cells - (80.0, 80.0), axis=1)
    spot = 0.02 * np.exp(-0.5 * (distance / 25) ** 2)
    measured = level + spot[:, None] * [1.0, 0.5, 0.0] + NOISE * random.standard_normal(level.shape)
    # An unusable patch and a patch with dust must not influence others.
    usable = np.ones(512, np.bool_)
    usable[3] = False
    measured[3] = 5.0
    measured[np.argmin(distance)] -= 0.3
    result = added_light(measured, np.full_like(level, NOISE**2), usable, cells, PAGE_MM, 3)
    other_patches = [cell for cell in range(512) if cell not in (3, np.argmin(distance))]
    for channel, factor in enumerate((1.0, 0.5)):
        error = np.asarray(result.share[other_patches, channel] - factor * spot[other_patches], dtype=np.float64)
        assert np.abs(error).max() < 0.003
        # Most of the uncertainty is uniform light.
        assert 0.1 < float(np.sqrt(np.mean((error / result.error[other_patches, channel]) ** 2))) < 1
    assert np.abs(result.share[:, 2]).max() < 0.001
    # the least light is taken for zero
    assert np.quantile(result.share[usable], 0.05, axis=0) == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_needs_enough_patches() -> None:
    usable = np.arange(512) < 199
    few, enough = (
        added_light(levels(), np.full((512, 3), 1e-6), usable | extra, positions(), PAGE_MM, 3)
        for extra in (np.zeros(512, np.bool_), np.arange(512) == 300)
    )
    assert not few.share.any()
    assert not few.error.any()
    assert enough.error.all()


def test_certain_share_is_beyond_four_standard_uncertainties() -> None:
    light = AddedLight(np.array([[0.02, 0.004, 0.02]]), np.array([[0.001, 0.001, 0.002]]))
    # levels have a lower bound of 0.001
    assert light.certain_share_of(np.array([[0.1, 0.1, 1e-5]])) == pytest.approx(np.array([[0.16, 0, 12]]))
    assert light.mean_square == pytest.approx(np.array([[0.000401, 0.000017, 0.000404]]))
