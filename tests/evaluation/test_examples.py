"""Examples in docstrings."""

from __future__ import annotations

import doctest
import pkgutil
from importlib import import_module

import numpy as np
import pytest

import evaluation

MODULES = [info.name for info in pkgutil.walk_packages(evaluation.__path__, "evaluation.")]


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    # colour-science, which other tests import, makes numpy print arrays as its version 1.13 did.
    with np.printoptions(legacy=False):
        assert doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS).failed == 0


@pytest.mark.slow
def test_finds_examples() -> None:
    modules = [test for name in MODULES for test in doctest.DocTestFinder().find(import_module(name)) if test.examples]
    assert len(modules) >= 12
