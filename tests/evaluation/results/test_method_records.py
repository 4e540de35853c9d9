"""Records of methods: equal only for the same method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from evaluation.methods.naming import find_method
from evaluation.results.method_records import describe_method

pytestmark = pytest.mark.slow


def test_record_depends_on_source_file(tmp_path: Path) -> None:
    text = "class Own:\n    name = 'Own'\n\n    def estimate(self, *given):\n        return 1, 1, 1\n"
    records: list[dict[str, Any]] = []
    for number, content in enumerate((text, text, text + "# changed\n")):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "own.py").write_text(content)
        records.append(describe_method(find_method(f"{tmp_path}/{number}/own.py:Own")))
    assert records[0] == records[1] != records[2]
    assert records[0]["class"] == "own.py:Own"


def test_record_depends_on_settings() -> None:
    class Own:
        name = "Own"

        def __init__(self, strength: float) -> None:
            self.strength = strength

        def estimate(self, *given: Any) -> tuple[int, int, int]:
            return 1, 1, 1

    assert describe_method(Own(2)) == describe_method(Own(2)) != describe_method(Own(3))
