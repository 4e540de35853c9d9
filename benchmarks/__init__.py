"""What each part costs: `python -m benchmarks.NAME` prints one JSON object a line for each figure."""

from __future__ import annotations

import argparse
from collections.abc import Sequence


def words_given(about: str | None, known: Sequence[str] = (), arguments: Sequence[str] | None = None) -> list[str]:
    """Return the words of the command line, each one of `known`; ``--help`` prints `about`, a module's docstring."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if known:
        parser.add_argument("words", nargs="*", metavar="WORD", help=f"any of {', '.join(known)}")
    words: list[str] = getattr(parser.parse_args(arguments), "words", [])
    unknown = [word for word in words if word not in known]
    if unknown:
        parser.error(f"{', '.join(unknown)}: expected {', '.join(known)}")
    return words
