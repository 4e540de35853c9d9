"""The small lab of these tests, rendered once: the Test body before 512 colours, and a session taken in it."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from experiment.session.folder import Session
from tests.calibration.lab import LIGHTS, Lab, hang, take


@pytest.fixture(scope="session")
def lab() -> Lab:
    return hang()


@pytest.fixture(scope="session")
def session(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Generator[Session]:
    with take(lab, tmp_path_factory.mktemp("lab") / "session", LIGHTS, every=6) as taken:
        yield taken
