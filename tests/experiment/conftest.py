"""Charts and illuminants for the tests of this package."""

from __future__ import annotations

import pytest

from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.lights import Illuminant, plan_illuminants


@pytest.fixture(scope="session")
def plan() -> tuple[Illuminant, ...]:
    """Return the 707 illuminants, made once because colour-science takes seconds to import."""
    return plan_illuminants()


@pytest.fixture(scope="session")
def a0() -> Chart:
    """Return the chart of the paper: 32 768 colours on A0."""
    return design_chart()


@pytest.fixture(scope="session")
def a7() -> Chart:
    """Return a chart of 64 colours on A7."""
    return design_chart(2)
