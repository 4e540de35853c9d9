"""A real run is seen from outside: at work while it is, stopped once it is killed, complete in the end."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.monitor.view import Head, SessionWatch

pytestmark = pytest.mark.slow

# How long a frame of the simulated lab may take on a machine that does other things.
LIMIT_S = 120.0


def seen(watch: SessionWatch, frames: int) -> Head:
    """Return how the session stands as soon as so many frames are accepted."""
    end = time.monotonic() + LIMIT_S
    while (head := watch.head()).done < frames:
        assert time.monotonic() < end, head
        time.sleep(0.01)
    return head


def test_a_run_is_seen_at_work_then_stopped_then_complete(lab: Path) -> None:
    folder = lab.parent / "session"
    watch = SessionWatch(folder)
    assert watch.head().state == "absent"
    command = [sys.executable, "-m", "acquisition.cli", "run", str(lab), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        try:
            # The sign of life follows the row of its frame.
            head = seen(watch, 2)
        finally:
            run.kill()
    assert head.state == "running"
    head = watch.head()
    assert head.state == "stopped"
    assert "killed or power lost: run the same command again" in head.sentence
    assert not (folder / "report.html").exists()
    assert main(["run", str(lab), str(folder)]) == 0
    head = watch.head()
    assert (head.state, head.done) == ("complete", head.total)
    assert "complete" in (folder / "report.html").read_text()
