"""Philox4x32-10 against the published test vectors, and random choices made with it."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.errors import InputError
from generator import philox

# "philox4x32 10" of tests/kat_vectors in Random123 1.14.0: counter, key, words.
KNOWN_ANSWERS = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_words_match_published_vectors(counter: str, key: str, answer: str) -> None:
    a, b, number, purpose = (int(word, 16) for word in counter.split())
    low, high = (int(word, 16) for word in key.split())
    result = philox.words(high << 32 | low, a, b, number, purpose)
    assert [int(word) for word in result] == [int(word, 16) for word in answer.split()]


@pytest.mark.parametrize("seed", [-1, 1 << 64])
def test_refuses_seed_out_of_range(seed: int) -> None:
    with pytest.raises(InputError):
        philox.key_of(seed)


@given(st.integers(1, 60), st.data())
def test_distinct_numbers(total: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, total))
    numbers = philox.distinct(data.draw(st.integers(0, 2**64 - 1)), count, total, 3, philox.LIGHTS)
    assert len(set(numbers)) == count
    assert set(numbers) <= set(range(total))


@pytest.mark.slow
def test_orders_are_equally_likely() -> None:
    # 12 orders of 2 out of 4, 4800 draws: chi-square with 11 degrees of freedom exceeds 37.4 once in 10 000 seeds.
    draws = Counter(philox.distinct(7, 2, 4, number, philox.LIGHTS) for number in range(4800))
    orders = list(itertools.permutations(range(4), 2))
    assert sum((draws[order] - 400) ** 2 / 400 for order in orders) < 37.4
