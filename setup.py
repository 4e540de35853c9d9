"""The long description: README.md without links into the repository. All other settings are in pyproject.toml."""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import setup

NOTE = "The pages and folders named here are in the source distribution: `docs/`, `examples/`, `CONTRIBUTING.md`."


def long_description(readme: str) -> str:
    """Return README for a package index, without pictures and without links to pages of the repository.

    The address of the repository is not known, so links cannot lead there.
    """
    readme = re.sub(r"^!\[[^\]]*\]\((?!https?:)[^)]*\)\n+(?:\*.*\*\n+)?", "", readme, flags=re.MULTILINE)
    readme = re.sub(r"\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", readme)
    return f"{readme}\n{NOTE}\n"


if __name__ == "__main__":
    setup(
        long_description=long_description(Path("README.md").read_text(encoding="utf-8")),
        long_description_content_type="text/markdown",
    )
