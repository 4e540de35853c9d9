"""What the options of commands name as methods, learners and estimates.

The options that every command has which reads a data set.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from evaluation.cli import main
from evaluation.commands.options import (
    DataReading,
    choose_estimates,
    choose_learners,
    choose_methods,
)
from evaluation.datasets import LAYOUTS, DataOptions
from evaluation.learning.standard import standard_learners
from evaluation.methods import standard_methods
from evaluation.methods.standard import STANDARD
from foundation.console import grouped
from foundation.errors import FormatError, InputError

pytestmark = pytest.mark.slow


def test_all_are_all_and_each_is_chosen_once() -> None:
    names = [method.name for method in choose_methods(["pca", "all", "evaluation.methods.pca:BrightDark"])]
    assert names[0] == names[-1] == "PCA bright and dark"  # By two names it is two.
    assert sorted(names[:-1]) == sorted(method.name for method in standard_methods().values())
    assert [learner.name for learner in choose_learners(["all"])] == [
        learner.name for learner in standard_learners().values()
    ]


def test_the_standard_ones_are_seven_and_what_a_run_takes_unasked(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = choose_methods([" Standard"])
    assert [method.name for method in chosen] == [standard_methods()[name].name for name in STANDARD]
    assert len(chosen) == 7
    assert len(choose_methods(["standard", "all", "pca"])) == len(standard_methods())
    assert main(["run", str(dataset), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["errors"]
    assert list(dict.fromkeys(row["method"] for row in rows)) == [method.name for method in chosen]


def test_the_help_names_every_method(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "1000")
    assert main(["run", "--help"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"standard: {', '.join(STANDARD)}. all: these and " in printed
    assert ", ".join(name for name in standard_methods() if name not in STANDARD) in printed


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
    with pytest.raises(InputError, match=r"gray-world .*regression-trees"):
        choose_learners(["gray-world"])
    with pytest.raises(InputError, match="'magic'"):
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


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("cv --method kernel-ridge DATA", "evaluate cv kernel-ridge DATA"),
        ("cv DATA --methods=kernel-ridge", "evaluate cv kernel-ridge DATA"),
        ("train DATA --method", "evaluate train METHOD DATA"),
        ("run gray-world DATA", "evaluate run DATA --method gray-world"),
        ("DATA gray-world --csv x.csv", "evaluate run DATA --method gray-world"),
    ],
)
def test_a_method_in_the_place_of_another_command_is_answered_with_the_right_form(
    words: str, right: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("DATA").mkdir()
    assert main(words.split()) == 2
    assert capsys.readouterr().err.endswith(f": {right}\n")


def test_a_class_that_has_to_learn_before_it_estimates_is_sent_to_cv(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "class Own:\n    name = 'Own'\n\n    def fit(self, scenes, seed=0):\n        self.light = scenes[0].truth\n"
        "        return self\n\n    def estimate(self, image, saturation=None, mask=None):\n        return self.light\n"
    )
    assert main(["run", str(dataset), "--method", f"{file}:Own"]) == 2
    said = capsys.readouterr().err
    assert "AttributeError" in said
    assert "give it to evaluate cv" in said


@pytest.mark.parametrize(
    ("command", "whole"),
    [
        (["transfer"], "gray-world, shades-of-gray, gray-edge-1"),
        (["paper", "table2"], "smart-color-cat, regression-trees, color-beaver"),
    ],
)
def test_defaults_are_whole_in_a_narrow_help(
    command: list[str], whole: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*command, "--help"]) == 0
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert whole in printed


def app(seen: list[object]) -> typer.Typer:
    made = typer.Typer()

    @made.command()
    @grouped
    def read(place: Annotated[str, typer.Argument()], *, count: int = 3, reading: DataReading) -> None:
        seen.extend([place, count, reading])

    return made


def test_what_is_given_arrives() -> None:
    seen: list[object] = []
    words = "set --layout nus8 --camera SonyA57 --black 128 --saturation 4000.5 --count 5"
    done = CliRunner().invoke(app(seen), f"{words} --subset test --truth left --partial".split())
    assert done.exit_code == 0, done.output
    assert seen == ["set", 5, DataReading("nus8", "SonyA57", "test", "left", 128.0, 4000.5, True)]
    reading = seen[2]
    assert isinstance(reading, DataReading)
    assert reading.options == DataOptions("SonyA57", "test", "left", 128.0, 4000.5, True)


def test_what_is_not_given_is_left_to_the_layout() -> None:
    seen: list[object] = []
    assert CliRunner().invoke(app(seen), ["set"]).exit_code == 0
    assert seen == ["set", 3, DataReading()]
    assert DataReading().options == DataOptions()


def test_the_help_names_every_layout_and_option() -> None:
    help_text = CliRunner().invoke(app([]), ["--help"], env={"COLUMNS": "300", "TERM": "dumb"}).output
    layouts = help_text.partition("--layout")[2].partition("--camera")[0]
    assert [name for name in LAYOUTS if name not in layouts] == []
    for option in ("--layout", "--camera", "--subset", "--truth", "--black", "--saturation", "--partial"):
        assert option in help_text
    assert "--reading" not in help_text


def test_two_groups_with_an_option_of_one_name_are_a_mistake() -> None:
    def read(one: DataReading, other: DataReading) -> None:
        del one, other

    with pytest.raises(ValueError, match="duplicate parameter name: 'layout'"):
        grouped(read)


def test_levels_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match=r"saturation 100.*128"):
        _ = DataReading(black=128, saturation=100).options
