"""Real images for the tests of methods."""

from __future__ import annotations

import pytest

from tests.evaluation.real_images import Collection, collections

MAKERS = collections()


@pytest.fixture(scope="session", params=MAKERS)
def collection(request: pytest.FixtureRequest) -> Collection:
    return MAKERS[request.param]()
