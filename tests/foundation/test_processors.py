"""The processors that this process may use, which may be fewer than the machine has."""

from __future__ import annotations

import os

import pytest

from foundation.processors import processor_count


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
