"""What this software is: its name and version, as files record what wrote them, and its packages.

The packages' names are short and common: a file `generator.py` beside a user's program is imported in place of the
package, and whether one is hidden is said here.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Final

from foundation.errors import InputError

DISTRIBUTION = "croplab"  # Name of the installed distribution


@lru_cache
def software() -> str:
    """Return the name and version of the installed software, such as ``"croplab 0.1.0"``."""
    return f"{DISTRIBUTION} {version(DISTRIBUTION)}"


# From the lowest to the highest.
PACKAGES: Final = (
    "foundation",
    "drivers",
    "sim",
    "experiment",
    "calibration",
    "acquisition",
    "synthesis",
    "generator",
    "evaluation",
)

_ROOT: Final = Path(__file__).resolve().parents[1]


def require_own_packages() -> None:
    """Import each package, so that no file that is found later can hide it; an InputError names one that does."""
    for name in PACKAGES:
        module = import_module(name)
        found = module.__file__ or next(iter(getattr(module, "__path__", [])), "something without a file")
        if Path(found).resolve().parent != _ROOT / name:
            raise InputError(
                f"{found} hides the package {name} of CroP, expected {_ROOT / name}; rename it, or start from another "
                "folder"
            )
