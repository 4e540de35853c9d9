"""Which frames a refusal asks to be taken again, and when that is of no help."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from calibration.verdict import retaking


def record(number: int, kind: str = "light") -> Any:
    return SimpleNamespace(sha256=f"{number}", kind=kind, illumination=number, attempt=number)


def refused(name: str, limit: float) -> Any:
    """Return a verdict with one refusal."""
    return SimpleNamespace(refused=(SimpleNamespace(figure=SimpleNamespace(name=name, refuse=limit)),), remarks=())


def figures(scatters: Sequence[float], exposures: Sequence[Any] = ()) -> Any:
    frames = [
        SimpleNamespace(record=record(number), consistency=SimpleNamespace(scatter=scatter))
        for number, scatter in enumerate(scatters)
    ]
    return SimpleNamespace(frames=frames, origins=SimpleNamespace(other_camera=(), other_exposure=tuple(exposures)))


@pytest.fixture(autouse=True)
def nothing_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def findings(verdict: Any, found: Any) -> dict[str, Any]:
        del verdict, found
        return {}

    monkeypatch.setattr(retaking, "findings", findings)


@pytest.mark.parametrize(("scatters", "again"), [((1, 3, 1), [1]), ((3, 1, 4), [0, 2]), ((3, 3, 3), [])])
def test_a_fault_of_every_frame_is_none_of_single_ones(scatters: tuple[float, ...], again: list[int]) -> None:
    verdict, found = refused("unlike_scatter", 2.0), figures(scatters)
    assert [frame.attempt for frame in retaking.retaken_frames(verdict, found)] == again
    assert retaking.is_mended_by_retaking(verdict, found) is bool(again)


def test_a_frame_of_less_exposure_is_as_wrong_as_one_of_more() -> None:
    exposed = [
        SimpleNamespace(record=record(number, kind), ratio=ratio)
        for number, kind, ratio in ((0, "light", 0.5), (1, "light", 2.0), (2, "light", 1.01), (3, "dark", 0.5))
    ]
    found = figures((0, 0, 0), exposed)
    # Dark frames are not among those with figures, and are taken again all the same.
    again = retaking.retaken_frames(refused("other_exposure", 0.1), found)
    assert [frame.attempt for frame in again] == [0, 1, 3]
