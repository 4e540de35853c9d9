"""What ``--json`` prints, as a test reads it: one JSON object and nothing else on standard output."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any, cast

import pytest


def json_of(
    main: Callable[[list[str]], int], arguments: Sequence[object], capsys: pytest.CaptureFixture[str], code: int = 0
) -> dict[str, Any]:
    """Return the object that a command prints with ``--json``, which ends with `code`.

    Infinities and NaN, which JSON does not have, make it no object.
    """
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code

    def refuse(text: str) -> float:
        raise ValueError(f"{text} is no JSON")

    found: Any = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert isinstance(found, dict)
    return cast("dict[str, Any]", found)
