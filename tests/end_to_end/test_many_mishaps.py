"""Fifty sessions of twenty lights with mishaps of every kind: most complete at once, all of them in the end.

`python -m tests.fuzz.fuzz_mishaps` takes as many as one likes.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.acquisition.run.mishaps import MISHAPS, TroubledLab, take_all

pytestmark = pytest.mark.slow

SEEDS = range(10, 60)


def test_fifty_sessions_with_mishaps(tmp_path: Path) -> None:
    happened = Counter(name for seed in SEEDS for name in TroubledLab(seed).mishaps)
    assert set(happened) == {mishap.__name__ for mishap in MISHAPS}, "every kind of mishap came up"
    complete = sum(take_all(tmp_path / f"{seed}", seed) for seed in SEEDS)
    assert complete > 37, "most of what happens once is lived with"
