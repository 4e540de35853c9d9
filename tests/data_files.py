"""Find measured data for tests: what the repository ships, and what a developer may have beside it.

`tests/data` holds the files that a licence lets us ship; its README names source, licence and hash of each. Files that
no licence lets us ship are looked for under the same names in the folders of `LOCAL`. A test never needs one of those:
where one is found, it is a further case of a test that has a case without it, so nothing skips where it is missing.
"""

from __future__ import annotations

from pathlib import Path

# Data in the repository.
SHIPPED = Path(__file__).parent / "data"

# Folders outside the repository's history: one that git ignores, and one beside the checkout.
LOCAL = (SHIPPED / "local", Path(__file__).parents[2] / "shared" / "data")


def shipped(name: str) -> Path:
    """Return the path of a shipped file, such as ``raw/dcraw_D4T.sha256``."""
    path = SHIPPED / name
    assert path.is_file(), f"{name} is missing from tests/data: restore it from the repository"
    return path


def available(*names: str) -> list[Path]:
    """Return the paths of those files of `names` that are shipped or found locally, in the order of `names`."""
    folders = (SHIPPED, *LOCAL)
    places = ([folder / name for folder in folders if (folder / name).is_file()] for name in names)
    return [found[0] for found in places if found]
