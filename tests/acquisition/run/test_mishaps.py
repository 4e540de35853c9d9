"""Sessions in which several things go wrong once each end complete, or with a named cause; nothing is lost or doubled.

`python -m tests.fuzz.fuzz_mishaps` takes as many as one likes.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.acquisition.run.mishaps import MISHAPS, TroubledLab, take_all

SEEDS = range(10, 30)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_mishaps_cost_no_frame(tmp_path: Path, seed: int) -> None:
    take_all(tmp_path / "session", seed)


@pytest.mark.slow
def test_twenty_sessions_of_twenty_lights_with_mishaps_of_every_kind(tmp_path: Path) -> None:
    happened = Counter(name for seed in SEEDS for name in TroubledLab(seed).mishaps)
    assert set(happened) == {mishap.__name__ for mishap in MISHAPS}, "every kind of mishap came up"
    complete = sum(take_all(tmp_path / f"{seed}", seed) for seed in SEEDS)
    assert complete > 14, "most of what happens once is lived with"
