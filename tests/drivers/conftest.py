"""Where the real raw files are."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def raw_folder() -> Path:
    folder = Path(__file__).parents[2].parent / "shared" / "data" / "raw"
    if not folder.is_dir():
        pytest.skip("the real raw files are not on this machine")
    return folder
