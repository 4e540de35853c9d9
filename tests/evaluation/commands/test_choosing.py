"""What the options of commands name as methods, learners and estimates."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.commands.choosing import choose_estimates, choose_learners, choose_methods
from evaluation.learning.standard import standard_learners
from evaluation.methods import standard_methods
from foundation.errors import FormatError, InputError


def test_all_are_all_and_each_is_chosen_once() -> None:
    names = [method.name for method in choose_methods(["pca", "all", "evaluation.methods.pca:BrightDark"])]
    assert names[0] == names[-1] == "PCA bright and dark"  # By two names it is two.
    assert sorted(names[:-1]) == sorted(method.name for method in standard_methods().values())
    assert [learner.name for learner in choose_learners(["all"])] == [
        learner.name for learner in standard_learners().values()
    ]


LEARNER = """
class Learns:
    name = "Learns"

    def fit(self, scenes, seed=0):
        return self


class Estimates:
    name = "Estimates"

    def estimate(self, image, saturation=None, mask=None):
        return image.mean(axis=(0, 1))
"""


def test_what_learns_is_no_method_and_what_does_not_is_no_learner(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(LEARNER)
    assert choose_learners([f"{file}:Learns"])[0].name == "Learns"
    assert choose_methods([f"{file}:Estimates"])[0].name == "Estimates"
    with pytest.raises(InputError, match="Learns has no estimate"):
        choose_methods([f"{file}:Learns"])
    with pytest.raises(InputError, match="Estimates has no fit"):
        choose_learners([f"{file}:Estimates"])
    with pytest.raises(InputError, match="gray-world has nothing to learn; expected regression-trees"):
        choose_learners(["gray-world"])
    with pytest.raises(InputError, match="'magic' is no method that learns"):
        choose_learners(["magic"])


def test_a_file_that_is_no_model(tmp_path: Path) -> None:
    (tmp_path / "model.npz").write_bytes(b"nothing")
    with pytest.raises(FormatError, match=r"model\.npz"):
        choose_methods([str(tmp_path / "model.npz")])


def test_names_of_estimates(tmp_path: Path) -> None:
    for name in ("a.csv", "b=c.csv"):
        (tmp_path / name).write_text("one,1,1,1\n")
    given = [f"{tmp_path}/a.csv", f"My own={tmp_path}/a.csv", f"{tmp_path}/b=c.csv"]
    assert [found.name for found in choose_estimates(given, ["one"])] == ["a", "My own", "b=c"]
