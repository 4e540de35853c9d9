"""Records of methods: the same for the same method in any process, another for any other."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.methods.naming import find_method
from evaluation.results.method_records import describe_method

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Inner:
    weights: Any = field(default_factory=lambda: np.arange(4.0))


class Own:
    """A stranger's method with all kinds of settings."""

    name = "Own"

    def __init__(self, **settings: Any) -> None:
        self.settings: dict[str, Any] = {
            "p": np.float32(2),
            "inner": Inner(),
            "raw": b"ab",
            "shape": (1, 2),
            **settings,
        }
        self.network = object()


def test_a_record_is_json_without_anything_of_this_process() -> None:
    record = describe_method(Own())
    assert json.loads(json.dumps(record)) == json.loads(json.dumps(describe_method(Own())))
    assert " at 0x" not in json.dumps(record)
    assert record["class"] == "test_method_records.py:Own"
    assert record["settings"]["network"] == "object"
    assert record["settings"]["settings"]["p"] == 2.0


def test_another_setting_is_another_record() -> None:
    others: list[dict[str, Any]] = [
        {}, {"p": 3}, {"inner": Inner(np.arange(4.0) + 1e-12)}, {"raw": b"ac"}, {"shape": (2, 1)}, {"new": None},
    ]  # fmt: skip
    records = [json.dumps(describe_method(Own(**settings))) for settings in others]
    assert len(set(records)) == len(records)


def test_a_circle_of_objects_ends() -> None:
    method = Own()
    method.settings["self"] = method.settings
    assert json.dumps(describe_method(method))


def test_a_changed_file_is_another_method(tmp_path: Path) -> None:
    text = "class Own:\n    name = 'Own'\n\n    def estimate(self, *given):\n        return 1, 1, 1\n"
    records: list[dict[str, Any]] = []
    for number, content in enumerate((text, text, text + "# changed\n")):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "own.py").write_text(content)
        records.append(describe_method(find_method(f"{tmp_path}/{number}/own.py:Own")))
    assert records[0] == records[1] != records[2]
    assert records[0]["class"] == "own.py:Own"


def test_what_a_file_imports_from_beside_it_belongs_to_its_method(tmp_path: Path) -> None:
    (tmp_path / "curve_of_own.py").write_text("GAMMA = 2\n")
    file = tmp_path / "own_with_curve.py"
    file.write_text(
        "from curve_of_own import GAMMA\n\n\nclass Own:\n    name = 'Own'\n\n"
        "    def estimate(self, image, saturation=None, mask=None):\n        return (image**GAMMA).mean((0, 1))\n"
    )
    method = find_method(f"{file}:Own")
    record = describe_method(method)
    assert list(record["imports"]) == ["curve_of_own.py"]
    (tmp_path / "curve_of_own.py").write_text("GAMMA = 3\n")
    assert describe_method(method) != record
