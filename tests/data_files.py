"""Find measured data for tests: shipped files and optional local files.

`tests/data` holds the files with a licence for redistribution; its README lists source, licence and hash. Other files
are searched under the same names in the folders of `LOCAL`. No test needs them: each is an additional case of a test
that also has a case without it, so no test is skipped.
"""

from __future__ import annotations

from pathlib import Path

# Folder of the shipped data.
SHIPPED = Path(__file__).parent / "data"

# Folders that are not in git: an ignored one, and one next to the checkout.
LOCAL = (SHIPPED / "local", Path(__file__).parents[2] / "shared" / "data")


def shipped(name: str) -> Path:
    """Return the path of a shipped file, such as ``raw/dcraw_D4T.sha256``."""
    path = SHIPPED / name
    assert path.is_file(), f"{name} is missing from tests/data: restore it from the repository"
    return path


def available(*names: str) -> list[Path]:
    """Return the paths of the files that are shipped or exist locally, in the order of `names`."""
    folders = (SHIPPED, *LOCAL)
    paths_by_name = ([folder / name for folder in folders if (folder / name).is_file()] for name in names)
    return [paths[0] for paths in paths_by_name if paths]
