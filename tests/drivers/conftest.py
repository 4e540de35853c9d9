"""Fixtures with recorded and simulated conversations of a host with an EOS body."""

from __future__ import annotations

import pytest

from tests.drivers.ptp.conversations import Recorded, conversations

CONVERSATIONS = conversations()


@pytest.fixture(scope="session", params=CONVERSATIONS)
def body(request: pytest.FixtureRequest) -> str:
    """Name of the body in `recording`."""
    return request.param


@pytest.fixture(scope="session")
def recording(body: str) -> list[Recorded]:
    return CONVERSATIONS[body]()
