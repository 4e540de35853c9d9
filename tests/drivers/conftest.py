"""Conversations of a host with an EOS body, for the tests of what reads and leads them."""

from __future__ import annotations

import pytest

from tests.drivers.ptp.conversations import Recorded, conversations

CONVERSATIONS = conversations()


@pytest.fixture(scope="session", params=CONVERSATIONS)
def body(request: pytest.FixtureRequest) -> str:
    """Give the name of the body that answered in `recording`."""
    return request.param


@pytest.fixture(scope="session")
def recording(body: str) -> list[Recorded]:
    return CONVERSATIONS[body]()
