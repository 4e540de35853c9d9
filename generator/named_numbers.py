"""Numbers in text: whether a word is one, and options spelled as ``name=number,name=number``.

Such options are the shape of a mask or of a distribution.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from foundation.errors import InputError

Range = tuple[float, float]


def is_number(text: str) -> bool:
    """Return whether a text is a number to Python's `float`, which takes nan and inf for numbers too."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_numbers(text: str, allowed: Mapping[str, Range], what: str) -> dict[str, float]:
    """Return the numbers of a text such as ``r=.3,b=.25``; empty text gives none."""
    found: dict[str, float] = {}
    for entry in text.split(",") if text.strip() else ():
        match = re.fullmatch(r"\s*(\w+)\s*=\s*(\S+)\s*", entry)
        name = match[1].lower() if match else ""
        if not match or name not in allowed:
            raise InputError(f"{entry.strip()!r} is no option of {what}; known are {', '.join(allowed) or 'none'}")
        if name in found:
            raise InputError(f"{name} is given twice for {what}; give it once")
        least, greatest = allowed[name]
        try:
            number = float(match[2])
        except ValueError:
            number = math.nan
        if not least <= number <= greatest:
            raise InputError(f"{entry.strip()!r} of {what}: expected a number from {least:g} to {greatest:g}")
        found[name] = number
    return found
