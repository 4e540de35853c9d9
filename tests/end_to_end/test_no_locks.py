"""A disk without locks, as some network file systems are: every command goes on, and says so once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.slow

WARNING = "this file system has no locks; see to it that no other program works there"
COMMAND = """
import errno, fcntl, importlib, sys

def flock(handle, operation):
    raise OSError(errno.EOPNOTSUPP, "Operation not supported")

fcntl.flock = flock
module, *arguments = sys.argv[1:]
sys.exit(importlib.import_module(module).main(arguments))
"""


def warnings_of(module: str, *arguments: object) -> int:
    """Run a command where `flock` is not supported; return how often it warned."""
    command = [sys.executable, "-c", COMMAND, module, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr.replace("\n", " ").count(WARNING)


def test_every_command_goes_on_without_locks(lab: Path) -> None:
    session, table, dataset = lab.parent / "session", lab.parent / "lut", lab.parent / "dataset"
    pictures = lab.parent / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / "plain.png"), np.full((40, 60, 3), 90, dtype=np.uint8))
    assert warnings_of("acquisition.cli", "run", lab, session) == 1
    assert warnings_of("calibration.cli", session, table) == 1
    assert warnings_of("generator.cli", table, dataset, "--sources", pictures, "--seed", 1) == 1
    assert (dataset / "dataset.json").is_file()
    assert [path for folder in (session, table, dataset) for path in folder.rglob(".lock")] == []
