"""The small lab of these tests, rendered once: Test body, 512 colours, one session and its table."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from calibration.pipeline.build import build
from calibration.report.report import write_report
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from tests.calibration.lab import LIGHTS, Lab, blank_pictures, hang, lens_unmeasured, rendered_once, take
from tests.calibration.whole import LIMITS, told
from tests.pinned import Pinned

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
    """Return the table of the session, with a report of blank pictures; read only."""
    with blank_pictures():
        return build(session, tmp_path_factory.mktemp("table") / "lut", report=write_report)


@pytest.fixture
def pinned_builds(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, pinned: Pinned) -> Iterator[None]:
    """Pin the numbers of every table that a test builds with `build` of its module."""
    module: Any = request.module
    known: Callable[..., BuildResult] = module.build
    detected: list[Any] = []

    def kept(session: Session, out: Path, *given: Any, report: Any = None, **named: Any) -> BuildResult:
        def seen(result: BuildResult, session: Session, folder: Path) -> None:
            detected.append(told(result))
            if report is not None:
                report(result, session, folder)

        return known(session, out, *given, report=seen, **named)

    monkeypatch.setattr(module, "build", kept)
    yield
    if detected:
        pinned(f"build, {words_of_test(request)}", detected, **LIMITS)


def words_of_test(request: pytest.FixtureRequest) -> str:
    """Return a test's name in words, which names its pins."""
    return re.sub(r"[^a-z0-9.-]+", " ", request.node.name.removeprefix("test_").lower()).strip()
