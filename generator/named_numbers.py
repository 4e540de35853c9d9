"""Parse numbers, and options of the form ``name=number,name=number``, for example for masks and distributions."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from foundation.errors import InputError

Range = tuple[float, float]


def is_number(text: str) -> bool:
    """Return whether Python's `float` accepts the text, which includes nan and inf."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_numbers(text: str, allowed: Mapping[str, Range], subject: str) -> dict[str, float]:
    """Return the numbers of a text such as ``r=0.3,b=0.25`` by name; `allowed` has the range of each name."""
    numbers: dict[str, float] = {}
    for entry in text.split(",") if text.strip() else ():
        match = re.fullmatch(r"\s*(\w+)\s*=\s*(\S+)\s*", entry)
        name = match[1].lower() if match else ""
        if not match or name not in allowed:
            expected = f"NAME=NUMBER with the name {' or '.join(allowed)}" if allowed else "no option"
            raise InputError(f"{entry.strip()!r} is not an option of {subject}, expected {expected}; correct it")
        if name in numbers:
            raise InputError(f"{name} is given twice for {subject}, expected once; remove one")
        low, high = allowed[name]
        try:
            number = float(match[2])
        except ValueError:
            number = math.nan
        if not low <= number <= high:
            raise InputError(
                f"{entry.strip()!r} of {subject} is invalid, expected a number from {low:g} to {high:g}; correct it"
            )
        numbers[name] = number
    return numbers
