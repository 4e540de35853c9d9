"""Machine code from Python functions: compiled for the processor at hand at the first call, kept on disk for the next.

A fresh machine needs no compiler: numba brings LLVM with it (`docs/decisions/0010-compiled-kernel.md`).
Compiled functions hold no state and no lock and release the interpreter's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile `function`, keeping the machine code on disk where a folder for it can be written."""
    try:
        return numba.njit(nogil=True, error_model="numpy", cache=True)(function)
    except RuntimeError:
        # Neither the package's folder nor the home folder is writable; compiling anew costs a second a start.
        return numba.njit(nogil=True, error_model="numpy")(function)
