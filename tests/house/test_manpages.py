"""Manual pages equal the help, are valid for groff, and are part of the wheel."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from functools import cache

import pytest

from docs.manpages import FOLDER, PROJECT, ROOT, pages

every_page = cache(pages)


@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_page_equals_help(name: str) -> None:
    path = FOLDER / f"{name}.1"
    assert path.read_text(encoding="utf-8") == every_page()[path], "out of date; run python -m docs.manpages and commit"


def test_has_one_page_per_command() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(PROJECT["scripts"])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
@pytest.mark.parametrize("name", PROJECT["scripts"])
def test_groff_reads_page_without_warning(name: str) -> None:
    path = FOLDER / f"{name}.1"
    process = subprocess.run(["groff", "-man", "-Tutf8", "-ww", str(path)], capture_output=True, text=True, check=True)
    assert process.stderr == ""
    assert "OOPPTTIIOONNSS" in process.stdout.replace("\b", "") or "OPTIONS" in process.stdout


def test_wheel_contains_pages() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert settings["tool"]["setuptools"]["data-files"] == {"share/man/man1": ["docs/man/*.1"]}
    assert "graft docs" in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
