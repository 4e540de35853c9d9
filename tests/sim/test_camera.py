"""The simulated camera that needs no cable keeps the contract too."""

from __future__ import annotations

import pytest

from drivers.camera import CameraIdentity
from sim.camera import SimulatedCamera
from sim.clock import SimulatedClock
from tests.contracts.camera import Bench, CameraContract, SeededFilm


class TestSimulatedCamera(CameraContract):
    @pytest.fixture
    def bench(self) -> Bench:
        clock, film = SimulatedClock(), SeededFilm()
        identity = CameraIdentity("Canon", "EOS 550D", "0000000001", "simulated")
        return Bench(SimulatedCamera(identity, film, clock), film, identity, clock.now)
