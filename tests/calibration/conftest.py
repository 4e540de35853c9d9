"""The small lab of these tests, rendered once: the Test body before 512 colours, a session taken in it, its table."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from calibration.pipeline.build import build
from calibration.report.report import write_report
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from tests.calibration.lab import LIGHTS, Lab, blank_pictures, hang, lens_unmeasured, rendered_once, take

__all__ = ["built", "lab", "lens_unmeasured", "rendered_once", "session"]


@pytest.fixture(scope="session")
def lab() -> Lab:
    return hang()


@pytest.fixture(scope="session")
def session(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Generator[Session]:
    with take(lab, tmp_path_factory.mktemp("lab") / "session", LIGHTS, every=6) as taken:
        yield taken


@pytest.fixture(scope="session")
def built(session: Session, tmp_path_factory: pytest.TempPathFactory) -> BuildResult:
    """Return the table of the session with its report, whose pictures are blank; to be read, not changed."""
    with blank_pictures():
        return build(session, tmp_path_factory.mktemp("table") / "lut", report=write_report)
