"""Half a dozen runs killed at random operations and times; `python -m benchmarks.session_kills` kills ten thousand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.session_kills import KilledSessions

KILLS = 6

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="a run is killed in a process of its own"),
]


def test_killed_sessions_end_in_the_same_frames(tmp_path: Path) -> None:
    sessions = KilledSessions(tmp_path, seed=17)
    while sessions.kills < KILLS:
        sessions.session()
    assert sessions.differing == 0
    assert sessions.strays > 0, "some were killed between the file's name and its row"
