"""What small places look like that are covered, and that are not."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.causes import gathering
from calibration.causes.gathering import PrintPlace, covered_deviation
from experiment.measures.paper import FieldResidual


@pytest.mark.parametrize(
    ("off", "expected"),
    [
        ([-0.05, -0.06, -0.04], -0.06),  # a thin shadow
        ([-0.7, 1.4, -0.2, 0.6], -0.7),  # a finger: dark colours become as bright as it
        ([0.04, 0.06, 0.05, 0.05], 0.05),  # a glint
        ([0.3, 0.2], np.nan),  # two dark cells under a finger, or a glint
        ([-0.049, 0.042, -0.03, 0.035, 0.02, -0.02], np.nan),  # neighbours' light
        ([-0.04, 0.0, 0.0], -0.04),  # two that are too dark to be compared
        ([], np.nan),
    ],
)
def test_covered_cells_are_darker_all_or_far_off(off: list[float], expected: float) -> None:
    assert covered_deviation(np.array(off)) == pytest.approx(expected, nan_ok=True)


def test_cells_about_a_place_that_hold_a_hot_photosite() -> None:
    places = np.array([[0.0, 0], [1, 0], [2, 0], [9, 9]])
    cells = SimpleNamespace(stains=SimpleNamespace(places_mm=places))

    def share(hottest: list[float], size_mm: float) -> float:
        table: Any = SimpleNamespace(dark_frames=SimpleNamespace(hottest=np.array(hottest)), cells=cells)
        return gathering._hot_share(table, places[0], size_mm)

    assert share([5, 0, 0, 7], 3.0) == 0.5
    assert share([5, 0, 0, 7], 5.0) == pytest.approx(1 / 3)
    # Nothing is known without dark frames of these cells, or where no cell lies.
    assert np.isnan(share([], 3.0))
    assert np.isnan(share([5, 0, 0, 7], 0.0))


@dataclass(frozen=True, eq=False)
class Frame:
    """What the references of a frame show, and its file."""

    paper: SimpleNamespace
    record: SimpleNamespace


def test_references_that_are_off_where_no_stain_lies_have_a_place_of_no_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def white(number: int, rim: float) -> Any:
        left = FieldResidual((30.0, 40.0), (-0.05, -0.05, -0.05), 0.1, rim, 0.6)
        paper = SimpleNamespace(left=left, spread=np.array([0.1, 0.01 * number, 0.1]), white=np.array([1.0, 9.0, 2.0]))
        return Frame(paper, SimpleNamespace(file=f"{number}.dng"))

    def no_spots(stains: object) -> list[object]:
        return []

    monkeypatch.setattr(gathering, "spots_of", no_spots)
    stains = SimpleNamespace(places_mm=np.array([[0.0, 0], [100, 80]]))
    whites = [white(number, rim) for number, rim in enumerate((0.0, -0.2, 0.0, 0.0))]
    table: Any = SimpleNamespace(white_frames=whites, cells=SimpleNamespace(stains=stains))
    gathered = gathering.reference_evidence(table, 0.02)
    assert gathered is not None
    # The frame whose strongest channel, green, is furthest off.
    assert gathered.places == (PrintPlace("3.dng", 30.0, 40.0, 0.0),)
    assert gathered.frames == ()
    known = gathered.evidence
    assert (known.frames, known.white_residual, known.rim, known.radial, known.rim_frames) == (4, 1, 0, 0.6, 0.25)
