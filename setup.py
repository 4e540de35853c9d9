"""The long description: README.md without what leads into the repository. All else is in pyproject.toml."""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import setup

WHERE = "Pages and folders that are named here are in the source distribution: `docs/`, `examples/`, `CONTRIBUTING.md`."


def long_description(readme: str) -> str:
    """Return README for a package index, which shows neither its pictures nor the pages that it links to.

    A repository's address is not known; were it, links could lead there.
    """
    readme = re.sub(r"^!\[[^\]]*\]\((?!https?:)[^)]*\)\n+(?:\*.*\*\n+)?", "", readme, flags=re.MULTILINE)
    readme = re.sub(r"\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", readme)
    return f"{readme}\n{WHERE}\n"


if __name__ == "__main__":
    setup(
        long_description=long_description(Path("README.md").read_text(encoding="utf-8")),
        long_description_content_type="text/markdown",
    )
