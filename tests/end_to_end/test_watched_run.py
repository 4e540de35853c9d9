"""A real run observed from outside: running, stopped after a kill, complete at the end."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.monitor.view import Head, SessionWatch

pytestmark = pytest.mark.slow

# Time limit for a simulated frame on a busy machine.
LIMIT_S = 120.0


def wait_for_frames(watch: SessionWatch, frames: int) -> Head:
    """Wait for `frames` accepted frames and return the state."""
    end = time.monotonic() + LIMIT_S
    while (head := watch.head()).done < frames:
        assert time.monotonic() < end, head
        time.sleep(0.01)
    return head


def test_observes_running_stopped_and_complete_run(lab: Path) -> None:
    folder = lab.parent / "session"
    watch = SessionWatch(folder)
    assert watch.head().state == "absent"
    command = [sys.executable, "-m", "acquisition.cli", "run", str(lab), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        try:
            # The heartbeat follows the row of its frame.
            head = wait_for_frames(watch, 2)
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
