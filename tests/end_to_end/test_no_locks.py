"""A disk without locks, like some network file systems: every command continues and warns once."""

from __future__ import annotations

import errno
import fcntl
import importlib
from pathlib import Path

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn")]

WARNING = "this file system has no locks; make sure that no other program uses the folder"


def test_commands_continue_without_locks(
    lab: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def flock(handle: int, operation: int) -> None:
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    def warnings_of(module: str, *arguments: object) -> int:
        caplog.clear()
        assert importlib.import_module(module).main([str(argument) for argument in arguments]) == 0
        return sum(WARNING in record.getMessage() for record in caplog.records)

    monkeypatch.setattr(fcntl, "flock", flock)
    session, table, dataset = lab.parent / "session", lab.parent / "lut", lab.parent / "dataset"
    pictures = lab.parent / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / "plain.png"), np.full((40, 60, 3), 90, dtype=np.uint8))
    assert warnings_of("acquisition.cli", "run", lab, session) == 1
    assert warnings_of("calibration.cli", session, table) == 1
    assert warnings_of("generator.cli", table, dataset, "--sources", pictures, "--seed", 1) == 1
    assert (dataset / "dataset.json").is_file()
    assert [path for folder in (session, table, dataset) for path in folder.rglob(".lock")] == []
