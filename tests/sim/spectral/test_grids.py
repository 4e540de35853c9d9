"""Spectra come to another grid without losing light, and without being smoothed where nothing need be gathered."""

from __future__ import annotations

import numpy as np
import pytest

from foundation.errors import FormatError
from sim.spectral import regridded, require_grid

NODES = np.arange(380.0, 781.0, 5.0)


def test_a_coarser_grid_is_joined_by_straight_lines() -> None:
    coarse = np.arange(390.0, 731.0, 10.0)
    found = regridded(coarse, coarse[:, None] ** 1, NODES)[:, 0]
    inside = (NODES >= 390) & (NODES <= 730)
    assert found[inside] == pytest.approx(NODES[inside])
    assert np.count_nonzero(found[~inside]) == 0


@pytest.mark.parametrize("at", [545.3, 546.1, 547.0, 549.9])
def test_a_narrow_line_between_the_nodes_keeps_its_light_and_its_place(at: float) -> None:
    fine = np.arange(380.0, 780.05, 0.1)
    line = np.exp(-0.5 * ((fine - at) / 0.3) ** 2)[:, None]
    found = regridded(fine, line, NODES)[:, 0]
    light = float(line.sum()) * 0.1
    assert found.sum() * 5 == pytest.approx(light, rel=1e-3)
    assert (found * NODES).sum() * 5 / light == pytest.approx(at, abs=0.02)


def test_a_line_among_coarse_steps_leaves_the_rest_smooth() -> None:
    # Measured every 10 nm, and every 1 nm about a line: nodes between the coarse steps must not stay dark.
    grid = np.unique(np.concatenate([np.arange(380.0, 781.0, 10.0), np.arange(540.0, 551.0)]))
    found = regridded(grid, grid[:, None] / 500, NODES)[:, 0]
    assert found[1:-1] == pytest.approx(NODES[1:-1] / 500, rel=1e-3)


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ([], "its wavelengths are none"),
        ([410, 700], "410 to 700, 400 to 700 nm at least"),
        ([400, 420, 420, *range(440, 701, 20)], "420 nm stands there twice"),
        ([400, *range(425, 701, 5)], "a gap from 400 to 425 nm"),
    ],
)
def test_a_grid_that_does_not_cover_the_visible_range_is_refused(grid: list[float], message: str) -> None:
    with pytest.raises(FormatError, match=f"lamp: .*{message}"):
        require_grid(np.array(grid, dtype=np.float64), "lamp")
