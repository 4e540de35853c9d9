"""The public API under one name: `import croplab`, then `croplab.open_lut`, `croplab.render` and the others.

It exports the public names of `generator`, `generator.training` and `evaluation.metrics`, which docs/library.md
describes. Each is loaded at its first use. A user's file `generator.py` would hide our package of that name; this
module and each command check that, and the error names the file.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from importlib import import_module
from math import inf
from types import FrameType, ModuleType
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
    from pathlib import Path

    if Path(foundation.__file__ or "").resolve().parent != Path(__file__).resolve().parent / "foundation":
        raise ImportError(f"{foundation.__file__} hides the package foundation of CroP; rename this file")
    from foundation.errors import InputError
    from foundation.version import require_own_packages

    try:
        require_own_packages()
    except InputError as error:
        raise ImportError(str(error)) from error


# A second Ctrl-C within this time repeats the first, s. It must not interrupt the report of the first.
_REPEAT_S = 1.0


class _Interruption:
    """Handler of Ctrl-C that ends a command with one line and the exit code 130, also while its modules are imported.

    Python's own handler prints a traceback during imports and at a second Ctrl-C.
    """

    def __init__(self) -> None:
        self.is_running = False  # Whether the command handles KeyboardInterrupt
        self._raised_s = -inf

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if not self.is_running:
            self.report()
            # Nothing was started that must be closed. An exception could be caught by a module.
            os._exit(128 + number)
        now_s = time.monotonic()
        if now_s - self._raised_s >= _REPEAT_S:
            self._raised_s = now_s
            raise KeyboardInterrupt

    @staticmethod
    def report() -> None:
        os.write(2, b"error: interrupted; run the same command again\n")


def _run(command: str) -> int:
    interruption = _Interruption()
    # A shell ignores the signal for a command in the background.
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, interruption)
    try:
        _require_own_packages()
        module = import_module(COMMANDS[command])
        interruption.is_running = True
        return int(module.main())
    except ImportError as error:
        if interruption.is_running:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        interruption.report()
        return 128 + signal.SIGINT
    finally:
        # The interpreter ends now, and a signal would change the exit code.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


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
