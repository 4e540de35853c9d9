"""Sessions in which several things go wrong once each end complete, or with a named cause; nothing is lost or doubled.

`python -m tests.fuzz.fuzz_mishaps` takes as many as one likes.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.acquisition.run.mishaps import MISHAPS, TroubledLab, take_all

# Few in which every kind of mishap comes up.
SEEDS = (27, 33, 129, 40, 220)


@pytest.mark.slow
def test_five_sessions_of_twenty_lights_with_mishaps_of_every_kind(tmp_path: Path) -> None:
    happened = Counter(name for seed in SEEDS for name in TroubledLab(seed).mishaps)
    assert set(happened) == {mishap.__name__ for mishap in MISHAPS}, "every kind of mishap came up"
    complete = sum(take_all(tmp_path / f"{seed}", seed) for seed in SEEDS)
    assert complete > 2, "most of what happens once is lived with"
