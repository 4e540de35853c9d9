"""Run the examples in docstrings."""

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
    # colour-science, which other tests import, sets the print format of arrays to that of numpy 1.13.
    with np.printoptions(legacy=False):
        assert doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS).failed == 0


def test_examples_leave_no_files(table_and_picture: Path) -> None:
    test_examples("generator.dataset.making")
    assert sorted(path.name for path in table_and_picture.iterdir()) == ["cat.png", "lut"]
