"""Working folders of command tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def work_folder(made_place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working folder: a copy of the folder made by the module's fixture `made_place`."""
    shutil.copytree(made_place, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
