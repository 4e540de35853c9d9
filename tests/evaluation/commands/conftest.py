"""Working folders of commands, each a copy of what a module has made once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def place(made_place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder that is a copy of what the fixture `made_place` of a module has made."""
    shutil.copytree(made_place, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
