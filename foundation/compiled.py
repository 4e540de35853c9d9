"""Machine code from Python functions: compiled for the processor at hand at the first call, kept on disk for the next.

A fresh machine needs no compiler: numba brings LLVM with it (`docs/decisions/0010-compiled-kernel.md`). Compiled
functions hold no state and no lock and release the interpreter's.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import re
import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import CellType, FunctionType
from typing import Any, Final, TypeVar, cast

import numba
from numba.core import event

_ROOT: Final = Path(__file__).parents[1]
_IMPORT: Final = re.compile(r"^from ([a-z_][.\w]*) import (\([^)]*\)|.*)", re.MULTILINE)

_COMPILING: Final = "compiling for this processor, which is done once and takes half a minute at most …"

_Function = TypeVar("_Function", bound=Callable[..., Any])


class _Announcement(event.Listener):
    """Says on a terminal, once, why the first start takes long; numba tells of what it did not find on the disk."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: event.Event) -> None:
        if self._said or not sys.stderr.isatty() or not logging.getLogger().isEnabledFor(logging.WARNING):
            return
        self._said = True
        print(_COMPILING, file=sys.stderr)

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Announcement())


def compiled(function: _Function) -> _Function:
    """Compile `function`, keeping the machine code on disk where a folder for it can be written."""
    marked = _marked(function)
    try:
        return numba.njit(nogil=True, error_model="numpy", cache=True)(marked)
    except RuntimeError:
        # Neither the package's folder nor the home folder is writable; compiling anew costs seconds a start.
        return numba.njit(nogil=True, error_model="numpy")(marked)


def _marked(function: _Function) -> _Function:
    """Return `function` with a digest of all code it may contain as its closure.

    numba knows kept machine code again by the function's own file and by what it closes over, not by the functions of
    other files that were compiled into it. An unused cell with the digest of those files makes good for that.
    """
    code = function.__code__
    if code.co_freevars:
        raise ValueError(f"{function.__qualname__} closes over {code.co_freevars}; compile module functions only")
    digest = hashlib.sha256()
    for file in sorted(_files_behind(Path(code.co_filename), set())):
        digest.update(_source(file)[0])
    marked = FunctionType(
        code.replace(co_freevars=("sources",)),
        function.__globals__,
        function.__name__,
        function.__defaults__,
        (CellType(digest.hexdigest()),),
    )
    marked.__module__, marked.__qualname__ = function.__module__, function.__qualname__
    marked.__doc__ = function.__doc__
    return cast("_Function", marked)


def _files_behind(file: Path, found: set[Path]) -> set[Path]:
    """Return `file` and the files of this software that it imports from, and so on."""
    if file in found or not file.is_file():
        return found
    found.add(file)
    for behind in _source(file)[1]:
        _files_behind(behind, found)
    return found


@cache
def _source(file: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return a file's bytes, and those files of this software that it imports from: many functions share them."""
    data = file.read_bytes()
    behind: list[Path] = []
    for module, names in _IMPORT.findall(data.decode("utf-8")):
        folder = _ROOT.joinpath(*module.split("."))
        named = (folder / f"{name}.py" for name in re.findall(r"\w+", names))
        behind += [path for path in (folder.with_suffix(".py"), *named) if path.is_file()]
    return data, tuple(behind)


def _without_linear_algebra() -> None:
    """Keep numba from loading SciPy's linear algebra when the first function is called, which takes .2 s.

    When it loads what it can compile, numba asks once whether BLAS is there (`numba.np.arraymath`), by importing
    `scipy.linalg`. It is, where SciPy is installed; who compiles a product of matrices asks again. Where numba is made
    otherwise, nothing changes.
    """
    if "numba.np.arraymath" in sys.modules or find_spec("scipy") is None:
        return
    try:
        from numba.np import linalg
    except ImportError:
        return
    module: Any = linalg
    asks: Callable[[], None] | None = getattr(module, "ensure_blas", None)
    if asks is None:
        return

    def answer() -> None:
        caller = inspect.currentframe()
        asking = None if caller is None or caller.f_back is None else caller.f_back.f_code.co_name
        # Only the question at loading is answered without looking.
        if asking != "_check_blas":
            asks()

    module.ensure_blas = answer


_without_linear_algebra()
