"""The recorded EOS 60D."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypedDict

import pytest


class Recorded(TypedDict):
    """One transaction of the recording; numbers and bytes as hex."""

    code: str
    tid: int
    params: list[int]
    data: str | None
    dir: str | None
    rc: str
    rparams: list[int]


@pytest.fixture(scope="session")
def recording() -> list[Recorded]:
    file = Path(__file__).parents[3].parent / "shared" / "data" / "ptp" / "eos60d_transactions.json"
    if not file.is_file():
        pytest.skip("the recording of the EOS 60D is not on this machine")
    return json.loads(file.read_text())
