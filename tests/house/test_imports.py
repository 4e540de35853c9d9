"""No import circles. The walls between rooms are contracts of import-linter in `pyproject.toml`."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import grimp
import pytest

from foundation.version import PACKAGES


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
