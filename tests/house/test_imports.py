"""The plan of the house, measured: no import circles, one home for each class name.

The product is the packages that `pyproject.toml` names to import-linter. The walls between rooms are contracts there;
here are the rules that no contract can state.
"""

from __future__ import annotations

import ast
import tomllib
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest

from tests.house.sources import ROOT, sources

PACKAGES: list[str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]


@pytest.mark.slow
def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    circle: list[str] = []
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        circle = error.args[1]
    assert not circle, f"imports go round: {' <- '.join(circle)}; move what both need to a module below them"


@pytest.mark.slow
def test_no_module_imports_a_private_name_of_another() -> None:
    taken = [
        f"{source.path}: {name.name} of {node.module}"
        for package in PACKAGES
        for source in sources(package)
        for node in ast.walk(source.tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in PACKAGES
        for name in node.names
        if name.name.startswith("_")
    ]
    assert not taken


@pytest.mark.slow
def test_a_public_class_name_has_one_home() -> None:
    homes: defaultdict[str, list[str]] = defaultdict(list)
    for source in (source for package in PACKAGES for source in sources(package)):
        for node in source.tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(str(source.path))
    shared = {name: files for name, files in homes.items() if len(files) > 1}
    assert not shared
