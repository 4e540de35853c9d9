"""Requirements of `make demo` and `make test`, and README on a package index."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def names(requirements: list[str]) -> set[str]:
    """Return the normalised names of requirements, without versions and markers."""
    matches = (re.match(r"[\w.-]+", line) for line in requirements)
    return {re.sub(r"[-_.]+", "-", match[0]).lower() for match in matches if match}


def locked(text: str) -> set[str]:
    return names(re.findall(r"^\S+==.*$", text, re.MULTILINE))


def test_first_part_of_lock_fits_demo() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    rest = re.search(r"^REST := \\(# .*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert rest is not None
    first, marker, second = (ROOT / "requirements.lock").read_text(encoding="utf-8").partition(f"\n{rest[1]}\n")
    assert marker
    demo_names = names([*project["dependencies"], *extras["demo"]])
    assert demo_names <= locked(first)
    work_names = names([*extras["dev"], *extras["docs"]]) - demo_names
    assert work_names <= locked(second)
    assert not work_names & locked(first)


@pytest.mark.slow
def test_long_description_has_no_broken_links() -> None:
    script = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")
    text = script["long_description"]((ROOT / "README.md").read_text(encoding="utf-8"))
    assert re.findall(r"\]\((?!https?:)", text) == []
    assert "![" not in text
    # The texts of links and complete links remain.
    assert "computed LUT" in text
    assert script["long_description"]("[a](https://b.org) [c](d.md)").startswith("[a](https://b.org) c\n")
    assert 'dynamic = ["readme"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
