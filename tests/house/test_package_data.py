"""Data files of packages are part of the wheel."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES: list[str] = PROJECT["tool"]["importlinter"]["root_packages"]
SHIPPED: dict[str, list[str]] = PROJECT["tool"]["setuptools"]["package-data"]


def shipped(package: str) -> set[Path]:
    """Return the files below a package that match the patterns of pyproject.toml, as setuptools does."""
    folders = {path.parent for path in (ROOT / package).rglob("__init__.py")}
    files = set[Path]()
    for folder in folders:
        name = ".".join(folder.relative_to(ROOT).parts)
        for pattern in (*SHIPPED.get("*", ()), *SHIPPED.get(name, ())):
            files |= set(folder.glob(pattern))
    return files


@pytest.mark.parametrize("package", PACKAGES)
def test_ships_every_data_file(package: str) -> None:
    files = {path for path in (ROOT / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {path for path in files if path.suffix != ".py"} - shipped(package) == set()


def test_patterns_name_existing_packages() -> None:
    assert {name for name in SHIPPED if name != "*" and not (ROOT / Path(*name.split("."))).is_dir()} == set()
