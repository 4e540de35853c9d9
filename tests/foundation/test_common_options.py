"""What all commands take, at every command."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.console import common_first, is_common, progress, run, shows_progress
from foundation.version import software

COMMANDS = ("acquisition", "calibration", "generator", "evaluation", "synthesis")


@pytest.fixture(params=COMMANDS)
def main(request: pytest.FixtureRequest) -> Callable[[list[str]], int]:
    """Return a command's `main`."""
    return import_module(f"{request.param}.cli").main


def test_every_command_tells_its_version(main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    name, version = capsys.readouterr().out.split()
    assert name == "croplab"
    assert version in str(software())


@pytest.mark.parametrize("option", ["-h", "--help"])
def test_every_command_helps(main: Callable[[list[str]], int], option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("--version", "--verbose", "--quiet", "--install-completion"))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_leaves_logging_as_it_was(name: str) -> None:
    before = logging.getLogger().level, list(logging.getLogger().handlers)
    words = ["-v", "--version"] if name != "generator" else ["--verbose", "--version"]
    assert import_module(f"{name}.cli").main(words) == 0
    assert (logging.getLogger().level, list(logging.getLogger().handlers)) == before


def test_errors_alone_means_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    from foundation import console as command_line

    seen: list[bool] = []

    def quiet() -> None:
        command_line._tell_errors(True)  # pyright: ignore[reportPrivateUsage]
        seen.append(shows_progress())
        with progress("frames") as tell:
            tell(1, 2)
        logging.getLogger("drivers").warning("not heard")
        logging.getLogger("drivers").error("heard")

    assert run(quiet) == 0
    assert seen == [False]
    assert shows_progress()
    printed = capsys.readouterr().err
    assert printed.endswith("ERROR drivers: heard\n")
    assert printed.count("\n") == 1


def test_the_flags_may_stand_behind_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from acquisition.cli import main

    out = tmp_path / "lights.csv"
    assert main(["illuminations", str(out), "--grid", "2", "-q"]) == 0
    assert out.is_file()
    assert "no such option" not in capsys.readouterr().err.lower()


@given(st.lists(st.sampled_from(["-v", "-q", "-vv", "run", "--out", "x", "--quiet", "a-v"])), st.booleans())
def test_arguments_keep_their_order(words: list[str], ended: bool) -> None:
    rest = ["--", "-v"] if ended else []
    moved = common_first([*words, *rest])
    assert [word for word in moved[: len(words)] if not is_common(word)] == [w for w in words if not is_common(w)]
    assert sorted(moved) == sorted([*words, *rest])
    assert moved[len(words) :] == rest


def test_the_short_form_of_evaluate_takes_them_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from evaluation.cli import main

    assert main(["-q", str(tmp_path / "none")]) == 2
    assert str(tmp_path / "none") in capsys.readouterr().err
