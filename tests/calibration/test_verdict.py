"""Values against limits, and the frames to take again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from calibration import verdict as module
from calibration.causes.rules import DEFOCUS, HOT_PHOTOSITES, RULES, Cause, Decision, Evidence
from calibration.figures.figure import Figure, Sense
from calibration.figures.radiometry import FRAME_SCATTER, OTHER_EXPOSURE
from calibration.verdict import JudgedValue, ProbableCause, Verdict, is_mended_by_retaking, judge, retaken_frames

LIMIT = replace(
    FRAME_SCATTER, name="x", title="A figure", unit="px", accept=1.0, refuse=2.0, why="why", source="s", remedy="r"
)


@pytest.mark.parametrize(
    ("sense", "accept", "refuse", "value", "outcome"),
    [
        ("at most", 1.0, 2.0, 1.0, "accept"),
        ("at most", 1.0, 2.0, 1.1, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.0, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.1, "refuse"),
        ("at most", 1.0, None, 1e9, "accept with remarks"),
        ("at least", 2.0, 1.0, 2.0, "accept"),
        ("at least", 2.0, 1.0, 1.5, "accept with remarks"),
        ("at least", 2.0, 1.0, 0.9, "refuse"),
        ("at least", 2.0, 1.0, float("nan"), "refuse"),
        ("at most", 2.0, None, float("nan"), "accept with remarks"),
    ],
)
def test_judges_by_both_limits(sense: Sense, accept: float, refuse: float | None, value: float, outcome: str) -> None:
    limit = replace(LIMIT, sense=sense, accept=accept, refuse=refuse)
    assert judge({"x": value}, [limit]).outcome == outcome


def test_verdict_is_worst_row() -> None:
    rows = [replace(LIMIT, name=name) for name in "abc"]
    assert judge({"a": 0, "b": 3, "c": 1.5}, rows).outcome == "refuse"
    assert judge({"a": 0, "c": 1.5}, rows).outcome == "accept with remarks"
    assert judge({}, rows).outcome == "accept"


def test_row_text_has_value_expectation_consequence() -> None:
    (row,) = judge({"x": 1.5}, [LIMIT]).remarks
    assert row.text() == "A figure: 1.5 px, expected at most 1 px, refused above 2 px; why"


def record(number: int, kind: str = "light") -> Any:
    return SimpleNamespace(sha256=f"{number}", kind=kind, illumination=number, attempt=number)


def refused(figure: Figure, limit: float) -> Verdict:
    """Return a verdict with one refusal."""
    return Verdict((JudgedValue(replace(figure, refuse=limit), 2 * limit, "refuse"),))


def measured(scatters: Sequence[float], exposures: Sequence[Any] = ()) -> Any:
    frames = [
        SimpleNamespace(record=record(number), consistency=SimpleNamespace(scatter=scatter))
        for number, scatter in enumerate(scatters)
    ]
    return SimpleNamespace(frames=frames, origins=SimpleNamespace(other_camera=(), other_exposure=tuple(exposures)))


@pytest.fixture
def nothing_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def findings(*_: object) -> dict[str, Any]:
        return {}

    monkeypatch.setattr(module, "findings", findings)


@pytest.mark.usefixtures("nothing_explained")
@pytest.mark.parametrize(("scatters", "again"), [((1, 3, 1), [1]), ((3, 1, 4), [0, 2]), ((3, 3, 3), [])])
def test_fault_of_all_frames_asks_for_none(scatters: tuple[float, ...], again: list[int]) -> None:
    verdict, result = refused(FRAME_SCATTER, 2.0), measured(scatters)
    assert [frame.attempt for frame in retaken_frames(verdict, result)] == again
    assert is_mended_by_retaking(verdict, result) is bool(again)


@pytest.mark.usefixtures("nothing_explained")
def test_retakes_shorter_and_longer_exposures() -> None:
    exposed = [
        SimpleNamespace(record=record(number, kind), ratio=ratio)
        for number, kind, ratio in ((0, "light", 0.5), (1, "light", 2.0), (2, "light", 1.01), (3, "dark", 0.5))
    ]
    result = measured((0, 0, 0), exposed)
    # Dark frames are not among those with figures, and are taken again all the same.
    retaken = retaken_frames(refused(OTHER_EXPOSURE, 0.1), result)
    assert [frame.attempt for frame in retaken] == [0, 1, 3]


@pytest.mark.parametrize(("cause", "again"), [(HOT_PHOTOSITES, []), (DEFOCUS, [1])])
def test_does_not_retake_for_persistent_cause(cause: Cause, again: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    def findings(*_: object) -> dict[str, ProbableCause]:
        decision = Decision(cause, RULES[0])
        return {FRAME_SCATTER.name: ProbableCause(FRAME_SCATTER.name, decision, Evidence(), (), ())}

    monkeypatch.setattr(module, "findings", findings)
    verdict, result = refused(FRAME_SCATTER, 2.0), measured((1, 3, 1))
    assert [frame.attempt for frame in retaken_frames(verdict, result)] == again
    assert is_mended_by_retaking(verdict, result) is bool(again)
