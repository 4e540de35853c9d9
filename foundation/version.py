"""Name, version and packages of this software, and a check that no file of the user hides one of the packages."""

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


# Packages from the lowest layer to the highest.
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
    """Import each package; raise an InputError if Python imports a file of the user instead."""
    # Our package names are common words. Python imports a user's generator.py before our package `generator`.
    for name in PACKAGES:
        module = import_module(name)
        location = module.__file__ or next(iter(getattr(module, "__path__", [])), "a module without a file")
        if Path(location).resolve().parent != _ROOT / name:
            raise InputError(
                f"{location} hides the package {name} of CroP, expected {_ROOT / name}; rename it, or start in another "
                "folder"
            )
