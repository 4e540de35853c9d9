"""The examples in docstrings are correct; generator and evaluation have separate tests."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("foundation", "drivers", "sim", "experiment", "acquisition", "calibration", "synthesis")
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    # colour-science, imported by other tests, makes NumPy print arrays as version 1.13 did.
    with np.printoptions(legacy=False):
        result = doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0


def test_finds_examples() -> None:
    assert len(MODULES) >= 14
