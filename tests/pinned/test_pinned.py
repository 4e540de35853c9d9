"""Tests of pins: a number that moves is noticed, a new one is not."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests import pinned as kit
from tests.pinned import FOLDER, TESTS, Pinned, numbers
from tests.pinned.drawn import drawn

MODULE = Path("room/test_x.py")


@dataclass(frozen=True)
class Run:
    name: str
    share: float
    samples: np.ndarray


def run(share: float = 0.125, at: int = 7, by: float = 0.0) -> Run:
    samples = np.random.default_rng(1).normal(size=(40, 30))
    samples.flat[at] += by
    return Run("bare", share, samples)


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pinned:
    monkeypatch.setattr(kit, "FOLDER", tmp_path)
    Pinned(MODULE, renew=True)("run", run())
    return Pinned(MODULE, renew=False)


def test_accepts_equal_numbers_and_other_words(kept: Pinned) -> None:
    kept("run", run())
    kept("run", replace(run(share=0.125 * (1 + 1e-8), by=1e-9), name="other"))


@pytest.mark.parametrize(
    "moved", [run(share=0.1250002), run(share=float("nan")), run(by=1e-3), run(by=float("nan"), at=1199)]
)
def test_refuses_changed_numbers(kept: Pinned, moved: Run) -> None:
    with pytest.raises(AssertionError, match=r"run, was and is:\n(share|samples): "):
        kept("run", moved)


def test_refuses_missing_numbers_and_accepts_new_ones(kept: Pinned) -> None:
    Pinned(MODULE, renew=True)("form", {"a": [1, 2], "b": {"c": True}})
    kept("form", {"new": 5, "b": {"c": True, "d": 7.5}, "a": [1, 2]})
    for other in ({"a": [1, 2]}, {"a": [1, 2, 3], "b": {"c": True}}, {"a": [1, 2], "b": {"c": "words"}}):
        with pytest.raises(AssertionError):
            kept("form", other)
    with pytest.raises(AssertionError, match="renew-pinned"):
        kept("other", 1)


def test_renews_only_numbers_that_moved(kept: Pinned, tmp_path: Path) -> None:
    renew, path = Pinned(MODULE, renew=True), tmp_path / "room" / "test_x.json"
    before = path.read_text()
    renew("run", run(share=0.125 * (1 + 1e-8), by=1e-9))
    assert path.read_text() == before
    renew("another", 1)
    renew("run", run(share=0.25, by=1e-9))
    pins = json.loads(path.read_text())
    assert pins == json.loads(before.replace("0.125", "0.25")) | {"another": {"value": 1}}


def test_names_records_by_name_and_joins_others() -> None:
    named = [{"name": "b", "x": 1.5}, {"name": "a", "x": True}]
    assert numbers({"r": named, "at": Path("/a"), "none": None}) == {"r.b.x": 1.5, "r.a.x": 1}
    assert numbers({"r": [{"x": 1, "y": "word"}, {"x": np.float32(2.5)}]}) == {"r.x": [1, 2.5]}
    assert numbers([np.zeros((2, 2)), b"ab"]) == {"0": [0, 0, 0, 0], "1.bytes": 2, "1.sha256": "fb8e20fc2e4c"}
    assert numbers({"image": np.arange(8.0).reshape(2, 4)})["image"][:4] == [2, 4, 0, 7]  # pyrefly: ignore[bad-index]


def test_every_file_belongs_to_a_test_module() -> None:
    modules = [(TESTS / path.relative_to(FOLDER)).with_suffix(".py") for path in FOLDER.rglob("*.json")]
    assert not [module for module in modules if not module.exists()], "move or delete these files of tests/pinned"


@pytest.mark.slow
def test_notices_a_line_that_is_drawn_elsewhere(kept: Pinned) -> None:
    def figure(y: float, width: float = 1.0) -> Figure:
        made: Any = Figure()
        made.subplots().plot([0, 1], [0, y], linewidth=width)
        return made

    Pinned(MODULE, renew=True)("figure", drawn(figure(1)))
    kept("figure", drawn(figure(1)))
    for other in (figure(1.01), figure(1, width=2)):
        with pytest.raises(AssertionError):
            kept("figure", drawn(other))
