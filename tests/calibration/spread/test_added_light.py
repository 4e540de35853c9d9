"""Light that lies on part of a print is found where it lies, and stated no larger than it is known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.spread.added_light import AddedLight, added_light

_Array = npt.NDArray[np.float64]

PAGE_MM = (240.0, 160.0)
NOISE = 5e-4


def levels() -> _Array:
    """Return levels (512, 3) of inks whose roots mix linearly."""
    ink = 1 - np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / 7
    mix = np.array([[0.55, 0.15, 0.05], [0.1, 0.55, 0.12], [0.05, 0.2, 0.5]])
    return (0.95 - ink @ mix.T) ** 2


def places() -> _Array:
    """Return a grid of 512 cells of 6 mm in an order that has nothing to do with their codes."""
    y, x = np.mgrid[:16, :32]
    grid = np.stack([x.ravel(), y.ravel()], axis=1) * 6.0 + (24, 35)
    return np.random.default_rng(8).permutation(grid)


@pytest.mark.slow
def test_a_reflection_is_found_where_it_lies() -> None:
    random = np.random.default_rng(2)
    level, cells = levels(), places()
    away = np.linalg.norm(cells - (80.0, 80.0), axis=1)
    spot = 0.02 * np.exp(-0.5 * (away / 25) ** 2)
    seen = level + spot[:, None] * [1.0, 0.5, 0.0] + NOISE * random.standard_normal(level.shape)
    # A cell that cannot be used, and one with dust, tell nothing of others.
    usable = np.ones(512, np.bool_)
    usable[3] = False
    seen[3] = 5.0
    seen[np.argmin(away)] -= 0.3
    found = added_light(seen, np.full_like(level, NOISE**2), usable, cells, PAGE_MM, 3)
    others = [cell for cell in range(512) if cell not in (3, np.argmin(away))]
    for channel, part in enumerate((1.0, 0.5)):
        off = np.asarray(found.share[others, channel] - part * spot[others], dtype=np.float64)
        assert np.abs(off).max() < 0.003
        # Most of the error is that of light which is the same everywhere.
        assert 0.1 < float(np.sqrt(np.mean((off / found.error[others, channel]) ** 2))) < 1
    assert np.abs(found.share[:, 2]).max() < 0.001
    # The least of it is no added light.
    assert np.quantile(found.share[usable], 0.05, axis=0) == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_few_cells_tell_of_no_added_light() -> None:
    usable = np.arange(512) < 199
    few, enough = (
        added_light(levels(), np.full((512, 3), 1e-6), usable | extra, places(), PAGE_MM, 3)
        for extra in (np.zeros(512, np.bool_), np.arange(512) == 300)
    )
    assert not few.share.any()
    assert not few.error.any()
    assert enough.error.all()


def test_what_is_certain_is_beyond_four_standard_errors_of_a_level() -> None:
    found = AddedLight(np.array([[0.02, 0.004, 0.02]]), np.array([[0.001, 0.001, 0.002]]))
    # A level below a thousandth counts as one.
    assert found.certain_share_of(np.array([[0.1, 0.1, 1e-5]])) == pytest.approx(np.array([[0.16, 0, 12]]))
    assert found.mean_square == pytest.approx(np.array([[0.000401, 0.000017, 0.000404]]))
