"""Manual pages are what the help says, are written as groff reads them, and go with the wheel."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Any

import pytest
from typer.main import get_command

from croplab import COMMANDS
from docs.manpages import FOLDER, PROJECT, ROOT, pages

every_page = cache(pages)


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_a_page_is_made_of_what_the_help_says(name: str) -> None:
    path = FOLDER / f"{name}.1"
    assert path.read_text(encoding="utf-8") == every_page()[path], "out of date; run python -m docs.manpages and commit"


def test_every_command_has_a_page_and_no_other_is_there() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(PROJECT["scripts"])


def every(command: Any) -> Iterator[Any]:
    """Yield a command and all below it."""
    yield command
    for below in getattr(command, "commands", {}).values():
        yield from every(below)


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_every_option_stands_on_its_page(name: str) -> None:
    text = (
        every_page()[FOLDER / f"{name}.1"]
        .replace("\\-", "-")
        .replace("\\fB", "")
        .replace("\\fR", "")
        .replace("\\fI", "")
    )
    for command in every(get_command(import_module(COMMANDS[name]).app)):
        for option in command.params:
            for word in option.opts if option.param_type_name == "option" else ():
                assert f"\n{word}" in text or f", {word}" in text, word


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_groff_reads_a_page_without_a_warning(name: str) -> None:
    path = FOLDER / f"{name}.1"
    done = subprocess.run(["groff", "-man", "-Tutf8", "-ww", str(path)], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert "OOPPTTIIOONNSS" in done.stdout.replace("\b", "") or "OPTIONS" in done.stdout


def test_pages_go_with_the_wheel() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert settings["tool"]["setuptools"]["data-files"] == {"share/man/man1": ["docs/man/*.1"]}
    assert "graft docs" in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
