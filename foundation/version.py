"""The name and version of this software, as files record what wrote them."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version

DISTRIBUTION = "croplab"
"""Name of the installed distribution."""


@lru_cache
def software() -> str:
    """Return the name and version of the installed software, such as ``"croplab 0.1.0"``."""
    return f"{DISTRIBUTION} {version(DISTRIBUTION)}"
