"""Statistics of the choices (`benchmarks/choices.py`): the kernel passes, a weaker rule fails."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import choices

pytestmark = pytest.mark.slow

HEIGHT = 256


@pytest.fixture(autouse=True)
def small_height(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choices, "HEIGHT", HEIGHT)


def test_choices_are_uniform_and_independent() -> None:
    # 72 statistics of 2 million draws; by chance alone one seed in 10^5 would fail, and the seeds are fixed.
    # `python -m benchmarks.choices` does the same with 10^8.
    assert choices.main(choices.WIDTH * HEIGHT) == 0


def choices_of_one_round(seed: int, image: int, first_row: int) -> choices.Choices:
    """Return the choices of one round of multiplying and shifting over index xor key."""
    y, x = np.arange(first_row, first_row + HEIGHT, dtype=np.uint64)[:, None], np.arange(choices.WIDTH)
    h = (y << np.uint64(13) | x.astype(np.uint64)) ^ np.uint64(seed * 0x9E3779B9 + image * 0x85EBCA6B & 0xFFFFFFFF)
    h = (h ^ (h >> np.uint64(16))) * np.uint64(0x21F0AAAD) & np.uint64(0xFFFFFFFF)
    return (h * np.uint64(choices.SAMPLES) >> np.uint64(32)).astype(np.uint8)


def test_statistics_detect_single_round_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choices, "choices", choices_of_one_round)
    assert choices.main(choices.WIDTH * HEIGHT) == 1
