"""Arithmetic of the uncertainty budget, against random draws."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.budget import COVERAGE, Budget, Component, direction_deg
from calibration.table.lut import CELL_COLUMNS, EXPANDED
from foundation.colorimetry import angles_deg

WHITE = np.array([[2400.0, 5200.0, 900.0], [300.0, 120.0, 4000.0]])


def correlated() -> np.ndarray:
    """Return relative errors (2, 3, 3) that are mostly common to all channels."""
    own = np.array([[1e-3, 2e-3, 4e-3], [2e-3, 5e-3, 1e-3]])
    return own[:, :, None] * np.eye(3) * own[:, None, :] + 1e-4


def component(lights: np.ndarray, name: str = "noise") -> Component:
    return Component(name, name, assumed=False, source="drawn", lights=lights, cells=np.full((8, 3), 1e-4))


def test_direction_error_matches_random_draws() -> None:
    random, covariance = np.random.default_rng(1), correlated()
    for light in range(2):
        errors = random.multivariate_normal(np.zeros(3), covariance[light], 20000)
        angles = angles_deg(WHITE[light] * (1 + errors), np.broadcast_to(WHITE[light], errors.shape))
        assert direction_deg(WHITE, covariance)[light] == pytest.approx(np.sqrt((angles**2).mean()), rel=0.03)


def test_expanded_uncertainty_covers_95_percent() -> None:
    random, covariance = np.random.default_rng(2), correlated()
    budget = Budget((component(covariance / 2), component(covariance / 2, "lens")), WHITE)
    for light in range(2):
        errors = random.multivariate_normal(np.zeros(3), covariance[light], 5000)
        angles = angles_deg(WHITE[light] * (1 + errors), np.broadcast_to(WHITE[light], errors.shape))
        assert 0.93 < (angles <= budget.expanded_deg[light]).mean() < 0.995


def test_common_error_does_not_change_direction() -> None:
    assert direction_deg(WHITE, np.full((2, 3, 3), 0.01)) == pytest.approx(0, abs=1e-6)


def test_components_add_in_squares() -> None:
    budget = Budget((component(correlated()), component(4 * correlated(), "lens")), WHITE)
    assert budget.expanded_deg == pytest.approx(COVERAGE * np.sqrt(5) * budget.lights_deg[0])
    assert budget.main_cause(0).name == "lens"
    assert budget.expanded_cells == pytest.approx(COVERAGE * np.sqrt(2e-4))


def test_files_have_column_names() -> None:
    budget = Budget((component(correlated(), "added light"),), WHITE)
    head, first, *_ = budget.lights_csv().splitlines()
    assert head == f"illumination,{EXPANDED},added_light_deg"
    assert float(first.split(",")[1]) == pytest.approx(budget.expanded_deg[0], rel=1e-3)
    assert budget.cells_csv().splitlines()[0] == ",".join(["colour", *CELL_COLUMNS])
    assert len(budget.cells_csv().splitlines()) == 9


def test_report_has_median_and_worst_cell() -> None:
    cells = np.full((9, 3), 1e-4)
    cells[4, 1] = 9e-4
    budget = Budget((Component("noise", "noise", False, "drawn", correlated(), cells),), WHITE)
    stated = budget.to_json()["cell_share"]
    assert stated["median"] == pytest.approx([COVERAGE * 1e-2] * 3, rel=1e-3)
    assert stated["worst"] == pytest.approx([COVERAGE * 1e-2, COVERAGE * 3e-2, COVERAGE * 1e-2], rel=1e-3)
