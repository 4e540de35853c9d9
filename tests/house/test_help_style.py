"""One style of help for all commands, NO_COLOR, and a byte order mark in LAB.toml."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from experiment.config import LabSettings, load_lab

ROOMS = ("acquisition", "calibration", "generator", "evaluation", "synthesis")
COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-7]|4[0-7]|9[0-7]|10[0-7])(?:;\d+)*m")
"""Escape sequences that choose a colour (ECMA-48, SGR)."""


def commands(words: tuple[str, ...], command: Any) -> Iterator[tuple[str, Any]]:
    """Yield a command and all below it, with their words."""
    yield " ".join(words), command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands((*words, name), below)


EVERY = dict(found for room in ROOMS for found in commands((room,), get_command(import_module(f"{room}.cli").app)))


@pytest.mark.parametrize("name", EVERY)
def test_help_begins_with_a_sentence_and_has_no_line_ends_of_its_own(name: str) -> None:
    help_text = EVERY[name].help
    assert help_text
    first = help_text.split("\n\n")[0]
    assert first[0].isupper()
    assert first.endswith(".")
    assert not re.search(r"[^\n]\n[^\n]", help_text)


@pytest.mark.parametrize("name", EVERY)
def test_every_option_says_what_it_takes_in_the_same_way(name: str) -> None:
    """Values in capitals or as the choice that there is, never a type of Python; help begins with a capital letter."""
    for parameter in EVERY[name].params:
        shown = parameter.metavar
        assert shown is None or not re.fullmatch(r"<?(int|str|bool|float|path)>?( range)?", shown), parameter.name
        if parameter.param_type_name == "argument":
            assert shown == str(shown).upper(), parameter.name
        text = parameter.help or ""
        assert text.rstrip("]").rstrip(), parameter.name
        assert text.endswith((".", "]")), f"{parameter.name}: {text}"


@pytest.mark.slow
def test_no_color_is_obeyed() -> None:
    """https://no-color.org: any value that is not empty; colours there are without it."""
    wish = [sys.executable, "-m", "acquisition.cli", "--help"]
    for more, coloured in (({}, True), ({"NO_COLOR": "1"}, False)):
        settings = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "TERM")}
        settings |= {"FORCE_COLOR": "1", "TERM": "xterm-256color", **more}
        shown = subprocess.run(wish, env=settings, capture_output=True, text=True, check=True).stdout
        assert bool(COLOUR.search(shown)) == coloured


def test_settings_of_a_windows_editor_are_read(tmp_path: Path) -> None:
    """Notepad begins a file with the byte order mark of UTF-8."""
    text = 'rig = "simulated"\nchart = "chart.json"\nilluminations = "lights.csv"\n[simulated]\nbody = "Test"\n'
    read: list[LabSettings] = []
    for mark in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "LAB.toml").write_bytes(mark + text.encode())
        read.append(load_lab(tmp_path / "LAB.toml"))
    assert read[0] == read[1]
