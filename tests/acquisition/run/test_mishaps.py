"""Sessions in which several things go wrong once each end complete, or with a named cause; nothing is lost or doubled.

`tests/end_to_end/test_many_mishaps.py` takes a hundred.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.acquisition.run.mishaps import take_all


@pytest.mark.parametrize("seed", range(10))
def test_mishaps_cost_no_frame(tmp_path: Path, seed: int) -> None:
    take_all(tmp_path / "session", seed)
