"""What a package reads beside its code is in the wheel: a checkout has it in any case, an installation has not."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES: list[str] = PROJECT["tool"]["importlinter"]["root_packages"]
SHIPPED: dict[str, list[str]] = PROJECT["tool"]["setuptools"]["package-data"]


def shipped(package: str) -> set[Path]:
    """Return the files below a package that the patterns of pyproject.toml name, as setuptools reads them."""
    folders = {path.parent for path in (ROOT / package).rglob("__init__.py")}
    found = set[Path]()
    for folder in folders:
        name = ".".join(folder.relative_to(ROOT).parts)
        for pattern in (*SHIPPED.get("*", ()), *SHIPPED.get(name, ())):
            found |= set(folder.glob(pattern))
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_every_file_beside_the_code_is_shipped(package: str) -> None:
    ours = {path for path in (ROOT / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {path for path in ours if path.suffix != ".py"} - shipped(package) == set()


def test_patterns_name_packages_that_are_there() -> None:
    assert {name for name in SHIPPED if name != "*" and not (ROOT / Path(*name.split("."))).is_dir()} == set()
