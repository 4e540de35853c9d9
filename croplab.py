"""CroP under one name of its own: `import croplab`, then `croplab.open_lut`, `croplab.render` and the rest.

The names are those of `generator` and `evaluation` that docs/library.md is about, loaded when they are first used. The
packages have short names, so a file `generator.py` in a user's folder would hide one: here, and at the start of each
command, that is told by the name of the file.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

COMMANDS = {
    "acquire": "acquisition.cli",
    "build-lut": "calibration.cli",
    "generate": "generator.cli",
    "evaluate": "evaluation.cli",
    "sim": "synthesis.cli",
}
"""The commands, and the module of each."""

_HOMES = "generator", "generator.training", "evaluation.metrics"
"""Where the names are; each says in `__all__` which are public."""


def __getattr__(name: str) -> object:
    homes: list[ModuleType] = []
    # Python asks modules for names of its own, such as __path__.
    if name == "__all__" or not name.startswith("__"):
        _require_own_packages()
        homes = [import_module(home) for home in _HOMES]
    if name == "__all__":
        return [public for home in homes for public in home.__all__]
    for home in homes:
        if name in home.__all__:
            return getattr(home, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__getattr__("__all__")]


def _require_own_packages() -> None:
    """Raise an ImportError that names the file by which one of the packages is hidden."""
    # The lowest package, which has the check, may be the hidden one.
    lowest = import_module("foundation")
    if Path(lowest.__file__ or "").resolve().parent != Path(__file__).resolve().parent / "foundation":
        raise ImportError(f"{lowest.__file__} hides the package foundation of CroP; rename it")
    from foundation.errors import InputError
    from foundation.version import require_own_packages

    try:
        require_own_packages()
    except InputError as error:
        raise ImportError(str(error)) from error


def _run(command: str) -> int:
    try:
        _require_own_packages()
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return int(import_module(COMMANDS[command]).main())


def acquire() -> int:
    """Run the command `acquire`."""
    return _run("acquire")


def build_lut() -> int:
    """Run the command `build-lut`."""
    return _run("build-lut")


def generate() -> int:
    """Run the command `generate`."""
    return _run("generate")


def evaluate() -> int:
    """Run the command `evaluate`."""
    return _run("evaluate")


def sim() -> int:
    """Run the command `sim`."""
    return _run("sim")
