"""Six runs are killed at random operations and times; `python -m benchmarks.session_kills` kills ten thousand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.session_kills import KilledSessions

KILLS = 6

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="runs are killed in forked processes"),
]


def test_killed_sessions_end_with_same_frames(tmp_path: Path) -> None:
    sessions = KilledSessions(tmp_path, seed=17)
    while sessions.kills < KILLS:
        sessions.session()
    assert sessions.differing == 0
    assert sessions.strays > 0, "some runs were killed between renaming the file and writing its row"
