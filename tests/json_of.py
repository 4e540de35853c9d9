"""Read the output of ``--json`` in a test: one JSON object and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any, cast

import pytest


def json_of(
    main: Callable[[list[str]], int], arguments: Sequence[object], capsys: pytest.CaptureFixture[str], code: int = 0
) -> dict[str, Any]:
    """Return the JSON object printed by a command that ends with `code`.

    Infinity and NaN are not valid JSON and cause an error.
    """
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code

    def refuse(text: str) -> float:
        raise ValueError(f"{text} is not valid JSON")

    output: Any = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert isinstance(output, dict)
    return cast("dict[str, Any]", output)
