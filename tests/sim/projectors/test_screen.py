"""The simulated screen keeps to what every presenter keeps to."""

from __future__ import annotations

import pytest

from foundation.clock import SimulatedClock
from sim.projectors.projector import Screen, SimulatedPresenter
from tests.contracts.presenter import Bench, PresenterContract


class TestSimulatedPresenter(PresenterContract):
    @pytest.fixture
    def bench(self) -> Bench:
        screen = Screen()
        return Bench(SimulatedPresenter(screen, SimulatedClock()), lambda: screen.colour)
