"""The examples in the docstrings do what they say."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import generator

ROOT = Path(generator.__file__).parent
MODULES = sorted(
    ".".join(("generator", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
    for path in ROOT.rglob("*.py")
    if ">>> " in path.read_text()
)


@pytest.mark.slow
@pytest.mark.usefixtures("table_and_picture")
@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    """They run in a folder that holds a table of four lights, `lut`, and a picture of 50 x 40 px, `cat.png`."""
    # colour-science, which other tests import, makes numpy print arrays as its version 1.13 did.
    with np.printoptions(legacy=False):
        assert doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS).failed == 0


def test_the_examples_leave_nothing_behind(table_and_picture: Path) -> None:
    test_examples("generator.dataset.making")
    assert sorted(path.name for path in table_and_picture.iterdir()) == ["cat.png", "lut"]
