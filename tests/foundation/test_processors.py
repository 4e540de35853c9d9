"""The processors that this process may use, which may be fewer than the machine has."""

from __future__ import annotations

import os
from collections.abc import Iterator
from threading import Event

import pytest

from foundation.compiled import ordered_map, processor_count


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system binds no process to processors")
def test_a_process_bound_to_one_processor_counts_one() -> None:
    before = os.sched_getaffinity(0)
    assert processor_count() == len(before)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert processor_count() == 1
    finally:
        os.sched_setaffinity(0, before)


def test_where_nobody_can_say_all_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert processor_count() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert processor_count() == 1


def test_order_and_memory_are_bounded() -> None:
    taken: list[int] = []

    def things() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number

    for number, value in enumerate(ordered_map(lambda thing: thing**2, things(), 3)):
        assert value == number**2
        assert len(taken) <= number + 7


def test_what_has_not_begun_is_dropped_when_one_fails() -> None:
    begun: list[int] = []
    release = Event()

    def work(thing: int) -> int:
        begun.append(thing)
        if thing == 0:
            raise KeyError(thing)
        release.wait()
        return thing

    pulling = ordered_map(work, range(1000), 2)
    release.set()
    with pytest.raises(KeyError):
        list(pulling)
    assert len(begun) <= 5
