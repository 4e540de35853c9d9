"""Sessions with several faults are completed or end with a named cause; no frame is lost or doubled.

`python -m tests.fuzz.fuzz_mishaps` takes any number of them.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.acquisition.run.mishaps import MISHAPS, TroubledLab, take_all

# Few seeds in which every kind of fault occurs.
SEEDS = (27, 33, 129, 40, 220)


@pytest.mark.slow
def test_sessions_survive_mishaps_of_every_kind(tmp_path: Path) -> None:
    mishap_counts = Counter(name for seed in SEEDS for name in TroubledLab(seed).mishaps)
    assert set(mishap_counts) == {mishap.__name__ for mishap in MISHAPS}, "every kind of mishap occurred"
    complete = sum(take_all(tmp_path / f"{seed}", seed) for seed in SEEDS)
    assert complete > 2, "most single mishaps are tolerated"
