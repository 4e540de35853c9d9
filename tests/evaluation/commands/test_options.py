"""Selection of methods and learners by name, and options for reading data."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from evaluation.cli import main
from evaluation.commands.options import (
    choose_learners,
    choose_methods,
    reading_options,
)
from evaluation.learning.standard import standard_learners
from evaluation.methods import standard_methods
from evaluation.methods.standard import STANDARD
from foundation.errors import InputError

pytestmark = pytest.mark.slow


def test_all_contains_each_method_once() -> None:
    names = [method.name for method in choose_methods(["pca", "all", "evaluation.methods.pca:BrightDark"])]
    assert names[0] == names[-1] == "PCA bright and dark"  # By two names it is two.
    assert sorted(names[:-1]) == sorted(method.name for method in standard_methods().values())
    assert [learner.name for learner in choose_learners(["all"])] == [
        learner.name for learner in standard_learners().values()
    ]


def test_default_methods_are_the_seven_standard_ones(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    methods = choose_methods([" Standard"])
    assert [method.name for method in methods] == [standard_methods()[name].name for name in STANDARD]
    assert len(methods) == 7
    assert len(choose_methods(["standard", "all", "pca"])) == len(standard_methods())
    assert main(["run", str(dataset), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["errors"]
    assert list(dict.fromkeys(row["method"] for row in rows)) == [method.name for method in methods]


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


def test_separates_methods_and_learners(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(LEARNER)
    assert choose_learners([f"{file}:Learns"])[0].name == "Learns"
    assert choose_methods([f"{file}:Estimates"])[0].name == "Estimates"
    with pytest.raises(InputError):
        choose_methods([f"{file}:Learns"])
    with pytest.raises(InputError):
        choose_learners([f"{file}:Estimates"])
    with pytest.raises(InputError):
        choose_learners(["gray-world"])
    with pytest.raises(InputError, match="'magic'"):
        choose_learners(["magic"])


def test_run_suggests_cv_for_untrained_class(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "class Own:\n    name = 'Own'\n\n    def fit(self, scenes, seed=0):\n        self.light = scenes[0].truth\n"
        "        return self\n\n    def estimate(self, image, saturation=None, mask=None):\n        return self.light\n"
    )
    assert main(["run", str(dataset), "--method", f"{file}:Own"]) == 2
    error = capsys.readouterr().err
    assert "AttributeError" in error
    assert "use evaluate cv" in error


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["camra=SonyA57"], "did you mean 'camera'?"),
        (["black=dark"], "expected a number"),
        (["black"], "KEY=VALUE"),
        (["partial=no"], "partial alone"),
        (["camera=a", "camera=b"], "twice"),
        (["black=128", "saturation=100"], "100"),
    ],
)
def test_refuses_invalid_read_options(texts: list[str], words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        reading_options(texts)
