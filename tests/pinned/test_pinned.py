"""What is pinned is seen to move, and by no less than what a processor moves it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests import pinned as kit
from tests.pinned import Pinned, plain, written
from tests.pinned.drawn import drawn


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
    Pinned(renew=True)("run", run())
    return Pinned(renew=False)


def test_what_is_kept_is_found_again(kept: Pinned) -> None:
    kept("run", run())
    kept("run", run(share=0.125 * (1 + 1e-8), by=1e-9))


@pytest.mark.parametrize(
    "moved", [run(share=0.1250002), run(share=float("nan")), run(by=1e-3), run(by=float("nan"), at=1199)]
)
def test_what_moved_is_told(kept: Pinned, moved: Run) -> None:
    with pytest.raises(AssertionError, match=r"run\.json, was and is"):
        kept("run", moved)


@pytest.mark.parametrize("other", [{"a": 1}, {"a": [1, 2]}, {"a": "1"}, {"b": [1]}, {"a": [True]}])
def test_another_form_is_told(kept: Pinned, other: Any) -> None:
    Pinned(renew=True)("form", {"a": [1]})
    with pytest.raises(AssertionError):
        kept("form", other)


def test_what_is_renewed_differs_where_it_moved(kept: Pinned, tmp_path: Path) -> None:
    renew = Pinned(renew=True)
    before = (tmp_path / "run.json").read_text()
    renew("run", run(share=0.125 * (1 + 1e-8), by=1e-9))
    assert (tmp_path / "run.json").read_text() == before
    renew("run", run(share=0.25, by=1e-9))
    assert (tmp_path / "run.json").read_text() == before.replace("0.125", "0.25")
    renew("run", {"name": "bare"})
    kept("run", {"name": "bare"})


def test_nothing_is_written_unless_asked(kept: Pinned, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        kept("other", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.slow
def test_a_line_that_is_drawn_elsewhere_is_told(kept: Pinned) -> None:
    def figure(y: float, width: float = 1.0) -> Figure:
        made = Figure()
        made.subplots().plot([0, 1], [0, y], linewidth=width)
        return made

    Pinned(renew=True)("figure", drawn(figure(1)))
    kept("figure", drawn(figure(1)))
    for other in (figure(1.01), figure(1, width=2)):
        with pytest.raises(AssertionError):
            kept("figure", drawn(other))


def test_every_value_is_one_of_json() -> None:
    found = plain({1: (b"ab", np.float32(0.5), Path("/a/b"), {"b", "a"}, float("inf"), None, np.arange(3))})
    assert json.loads(json.dumps(found))["1"][1:] == [0.5, "b", ["a", "b"], "inf", None, [0, 1, 2]]


@pytest.mark.parametrize(
    "value", [1, [], {}, [1, [2, "a"], {"b": [], "c": {"d": [[1.5]]}}], {"a": None, "b": {"c": True}}]
)
def test_what_is_written_is_json_of_the_same_value(value: Any) -> None:
    assert json.loads(written(value)) == value
    assert "\n" not in written([1, "a", None])
