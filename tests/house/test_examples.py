"""The examples in the docstrings do what they say; those of generator and evaluation have tests beside them."""

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
    # colour-science, which other tests import, makes numpy print arrays as its version 1.13 did.
    with np.printoptions(legacy=False):
        done = doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS)
    assert done.attempted > 0
    assert done.failed == 0


def test_there_are_examples() -> None:
    assert len(MODULES) >= 14
