"""There are no import cycles. Contracts of import-linter in `pyproject.toml` separate the packages."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import grimp
import pytest

from foundation.version import PACKAGES


@pytest.mark.slow
def test_has_no_import_cycles() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    cycle: list[str] = []
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        cycle = error.args[1]
    assert not cycle, f"import cycle: {' <- '.join(cycle)}; move the common code to a lower module"
