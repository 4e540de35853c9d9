"""Manual pages are what the help says, are written as groff reads them, and go with the wheel."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from functools import cache

import pytest

from docs.manpages import FOLDER, PROJECT, ROOT, pages

every_page = cache(pages)


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_a_page_is_made_of_what_the_help_says(name: str) -> None:
    path = FOLDER / f"{name}.1"
    assert path.read_text(encoding="utf-8") == every_page()[path], "out of date; run python -m docs.manpages and commit"


def test_every_command_has_a_page_and_no_other_is_there() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(PROJECT["scripts"])


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
