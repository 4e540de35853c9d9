"""What the tests of the acquisition share: the paper's chart and lights, made once, and a small chart."""

from __future__ import annotations

import pytest

from experiment.chart.layout import design_chart
from experiment.chart.model import Chart
from experiment.lights import Illumination, plan_illuminations


@pytest.fixture(scope="session")
def plan() -> tuple[Illumination, ...]:
    """Plan the 707 lights once: colour-science takes seconds to import."""
    return plan_illuminations()


@pytest.fixture(scope="session")
def a0() -> Chart:
    """Design the paper's chart: 32 768 colours on A0."""
    return design_chart()


@pytest.fixture(scope="session")
def a7() -> Chart:
    """Design a chart of 64 colours on A7."""
    return design_chart(2)
