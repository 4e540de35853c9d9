"""The public API under one name: `import croplab`, then `croplab.open_lut`, `croplab.render` and the others.

It exports the public names of `generator`, `generator.training` and `evaluation.metrics`, which docs/library.md
describes. Each is loaded at its first use. A user's file `generator.py` would hide our package of that name; this
module and each command check that, and the error names the file.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

# Module of each command.
COMMANDS = {
    "acquire": "acquisition.cli",
    "build-lut": "calibration.cli",
    "generate": "generator.cli",
    "evaluate": "evaluation.cli",
    "sim": "synthesis.cli",
}

# Modules with public names; `__all__` of each lists them.
_API_MODULES = "generator", "generator.training", "evaluation.metrics"


def __getattr__(name: str) -> Any:
    modules: list[ModuleType] = []
    # Python itself looks up names such as __path__, which must not load the packages.
    if name == "__all__" or not name.startswith("__"):
        _require_own_packages()
        modules = [import_module(module_name) for module_name in _API_MODULES]
    if name == "__all__":
        return [public_name for module in modules for public_name in module.__all__]
    for module in modules:
        if name in module.__all__:
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__getattr__("__all__"))


def _require_own_packages() -> None:
    # The check itself is in the package foundation, so whether a file hides that one is checked first.
    foundation = import_module("foundation")
    if Path(foundation.__file__ or "").resolve().parent != Path(__file__).resolve().parent / "foundation":
        raise ImportError(f"{foundation.__file__} hides the package foundation of CroP; rename this file")
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
