"""Folds: published, drawn or read from a file; groups stay together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evaluation.experiments.folds import (
    choose_folds,
    draw_scene_folds,
    folds_to_csv,
    group_of,
    read_folds,
    require_groups_together,
)
from evaluation.scene import SceneSet
from foundation.errors import FormatError, InputError

NAMES = ["a.png", "b.png", "c.png", "d, e.png"]


def test_uses_published_folds_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scenes: Any = tuple(SimpleNamespace(name=name, truth=np.ones(3), saturation=None) for name in NAMES)
    data = SceneSet("Four", "plain", "four", scenes, folds=(1, 0, 1, 0))
    assert [item if isinstance(item, str) else item.tolist() for item in choose_folds(data)] == [
        [1, 0, 1, 0],
        "the data set's own",
    ]
    drawn, origin = choose_folds(data, "2", seed=3)
    assert (drawn.tolist(), origin) == (draw_scene_folds(scenes, 2, 3).tolist(), "drawn by seed 3")
    assert set(choose_folds(replace(data, folds=None))[0].tolist()) == {0, 1, 2}
    # A word without extension is a file if it exists.
    Path("folds").write_text(folds_to_csv(NAMES, np.array([0, 1, 1, 1])))
    assert choose_folds(data, "folds")[0].tolist() == [0, 1, 1, 1]
    assert choose_folds(data, "folds")[1] == "from folds"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("-2", "expected 2 to 4"),
        ("+-2", "'[+]-2', expected a number"),
        ("²", "'²', expected a number"),
        ("two.csv", "cannot read folds from two.csv"),
    ],
)
def test_refuses_invalid_folds_option(text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scenes: Any = tuple(SimpleNamespace(name=name, truth=np.ones(3), saturation=None) for name in NAMES)
    with pytest.raises((InputError, FormatError), match=message):
        choose_folds(SceneSet("Four", "plain", "four", scenes), text)


def test_fold_file_round_trip(tmp_path: Path) -> None:
    path, folds = tmp_path / "folds.csv", np.array([2, 0, 1, 2])
    path.write_text(folds_to_csv(NAMES, folds))
    np.testing.assert_array_equal(read_folds(path, NAMES), folds)
    path.write_text('fold,light,image\nval,1,b.png\ntrain,1,a.png\nval,2,c.png\ntrain,3,"d, e.png"\n')
    np.testing.assert_array_equal(read_folds(path, NAMES), [0, 1, 1, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('image,fold\na.png,0\nb.png,1\nc.png\n"d, e.png",1\n', "without a fold: c.png"),
        ('image,fold\na.png,7\nb.png,7\nc.png,7\n"d, e.png",7\n', "only the fold 7"),
    ],
)
def test_refuses_invalid_fold_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "folds.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        read_folds(path, NAMES)


def test_refuses_folds_that_separate_groups() -> None:
    scenes: Any = [SimpleNamespace(name=f"{number}.png", group=f"picture {number // 2}") for number in range(4)]
    require_groups_together(scenes, np.array([0, 0, 1, 1]))
    with pytest.raises(InputError, match=r"picture 1 .*folds 0 and 1"):
        require_groups_together(scenes, np.array([0, 0, 0, 1]))
    same_names: Any = [SimpleNamespace(name="same.png"), SimpleNamespace(name="same.png")]
    assert group_of(same_names[0]) == "same.png"
    with pytest.raises(InputError, match=r"same\.png"):
        require_groups_together(same_names, np.array([0, 1]))
