"""Performance and accuracy benchmarks: `python -m benchmarks.NAME` prints one JSON object per line."""

from __future__ import annotations

import argparse
from collections.abc import Sequence


def parse_words(about: str | None, allowed: Sequence[str] = (), arguments: Sequence[str] | None = None) -> list[str]:
    """Parse the words on the command line.

    `--help` prints `about`, the docstring of a module. A word that is not in `allowed_words` ends the program.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if allowed:
        parser.add_argument("words", nargs="*", metavar="WORD", help=f"any of {', '.join(allowed)}")
    words: list[str] = getattr(parser.parse_args(arguments), "words", [])
    unknown = [word for word in words if word not in allowed]
    if unknown:
        parser.error(f"{', '.join(unknown)}: expected {', '.join(allowed)}")
    return words
