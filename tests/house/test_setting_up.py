"""What `make demo` and `make test` install, and README on a package index."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def names(requirements: list[str]) -> set[str]:
    """Return the normalised names of requirements, without versions and markers."""
    found = (re.match(r"[\w.-]+", line) for line in requirements)
    return {re.sub(r"[-_.]+", "-", match[0]).lower() for match in found if match}


def locked(text: str) -> set[str]:
    return names(re.findall(r"^\S+==.*$", text, re.MULTILINE))


def test_the_first_part_of_the_lock_is_what_the_demo_needs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    rest = re.search(r"^REST := \\(# .*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert rest is not None
    first, mark, second = (ROOT / "requirements.lock").read_text(encoding="utf-8").partition(f"\n{rest[1]}\n")
    assert mark
    needed = names([*project["dependencies"], *extras["demo"]])
    assert needed <= locked(first)
    only_for_work = names([*extras["dev"], *extras["docs"]]) - needed
    assert only_for_work <= locked(second)
    assert not only_for_work & locked(first)


@pytest.mark.slow
def test_a_package_index_shows_no_link_that_leads_nowhere() -> None:
    script = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")
    shown = script["long_description"]((ROOT / "README.md").read_text(encoding="utf-8"))
    assert re.findall(r"\]\((?!https?:)", shown) == []
    assert "![" not in shown
    # The texts of links remain, and so do complete links.
    assert "computed LUT" in shown
    assert script["long_description"]("[a](https://b.org) [c](d.md)").startswith("[a](https://b.org) c\n")
    assert 'dynamic = ["readme"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
