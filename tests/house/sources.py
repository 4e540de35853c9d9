"""The product's modules as read and parsed, once for all tests of the house that ask."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, eq=False)
class Source:
    """A module: its path from the repository's root, its text and its tree."""

    path: Path
    text: str
    tree: ast.Module


@cache
def sources(package: str) -> tuple[Source, ...]:
    """Return each module of a package."""
    texts = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / package).rglob("*.py"))}
    return tuple(Source(path.relative_to(ROOT), text, ast.parse(text)) for path, text in texts.items())
