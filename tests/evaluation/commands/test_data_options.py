"""The options that every command has which reads a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from evaluation.cli import main
from evaluation.commands.options import DataReading, with_data_options
from evaluation.datasets import LAYOUTS, DataOptions
from foundation.errors import InputError
from tests.evaluation.datasets.made_up import nus8


def app(seen: list[object]) -> typer.Typer:
    made = typer.Typer()

    @made.command()
    @with_data_options
    def read(place: Annotated[str, typer.Argument()], *, count: int = 3, reading: DataReading) -> None:
        seen.extend([place, count, reading])

    return made


def test_what_is_given_arrives() -> None:
    seen: list[object] = []
    words = [
        "set",
        "--layout",
        "nus8",
        "--camera",
        "SonyA57",
        "--black",
        "128",
        "--saturation",
        "4000.5",
        "--count",
        "5",
    ]
    done = CliRunner().invoke(app(seen), [*words, "--subset", "test", "--truth", "left", "--partial"])
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


def test_a_command_without_the_parameter_is_a_mistake() -> None:
    def read(place: str) -> None:
        del place

    with pytest.raises(ValueError, match="read has no parameter 'reading'"):
        with_data_options(read)


def test_levels_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match=r"saturation 100 is not above the black level 128"):
        _ = DataReading(black=128, saturation=100).options


def test_the_command_reads_one_camera_and_states_what_it_applied(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nus8(tmp_path)
    words = ("--camera", "sonya57", "--saturation", "20000", "--method", "white-patch")
    assert main(["run", str(tmp_path), *words]) == 0
    printed = capsys.readouterr().out
    assert "NUS SonyA57: reproduction angular error of 2 images" in printed
    assert "saturation: 20000, as the user gave it" in printed
    assert "black level: darkness_level of the camera's .mat, subtracted: SonyA57 128" in printed
    assert main(["run", str(tmp_path), "--truth", "left"]) == 2
    assert "--truth has no meaning for" in capsys.readouterr().err
