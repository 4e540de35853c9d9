"""The cable that is none keeps the contract too."""

from __future__ import annotations

import pytest

from sim.buses.ptp import MemoryTransport
from tests.contracts.transport import Bench, Echo, TransportContract


class TestMemory(TransportContract):
    @pytest.fixture
    def bench(self) -> Bench:
        device = Echo()
        transport = MemoryTransport(device)
        return Bench(transport, device, transport.pull)
