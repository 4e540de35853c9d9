"""Names of files: sort them with numbers by value, and compare them in any normal form of Unicode."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Return sorted names; numbers in them are sorted by value.

    Examples
    --------
    >>> in_natural_order(["a10", "10", "9", "a2"])
    ['9', '10', 'a2', 'a10']
    """
    listed_names = list(names)
    if len({name.translate(_ZERO_DIGITS) for name in listed_names}) <= 1:
        # All numbers have the same length and position, so plain sorting is correct. It is much faster.
        return sorted(listed_names)
    return sorted(listed_names, key=natural_sort_key)


_ZERO_DIGITS = str.maketrans("0123456789", "0" * 10)


def natural_sort_key(name: str) -> list[str | int]:
    """Return a sort key for which numbers in names are sorted by value.

    Examples
    --------
    >>> sorted(["a10", "10.png", "9.png", "a2"], key=natural_sort_key)
    ['9.png', '10.png', 'a2', 'a10']
    """
    segments: list[str | int] = list(re.split(r"([0-9]+)", name))  # text and digits alternate, text first
    segments[1::2] = [int(digits) for digits in segments[1::2]]
    return segments


def comparable(name: str) -> str:
    """Return a name in normal form C of Unicode (UAX #15).

    macOS programs write an accented letter as two characters, other programs as one. Such names look equal, so they
    are compared in this form.

    Examples
    --------
    >>> comparable("Bu\u0308ro.png") == "Büro.png"
    True
    """
    return unicodedata.normalize("NFC", name)
