"""Machine code from Python functions: compiled for the processor at hand at the first call, kept on disk for the next.

A fresh machine needs no compiler: numba brings LLVM with it (`docs/decisions/0010-compiled-kernel.md`). Code that is
kept is loaded by LLVM alone, without numba (`docs/decisions/0037-code-without-numba.md`). Compiled functions hold no
state and no lock and release the interpreter's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from pathlib import Path
from threading import RLock
from types import FunctionType
from typing import Any, Final, TypeVar, cast

from foundation.machine_code.arguments import caller, kind_of
from foundation.machine_code.kept import Origin, keep_code, load_code
from foundation.machine_code.loading import Loaded, load
from foundation.machine_code.sources import digest_of

_Function = TypeVar("_Function", bound=Callable[..., Any])

_making: Final = RLock()
"""Held where code is loaded or made, so that several threads do so once."""


class _Later:
    """A function whose compiled form is made when it is first asked for: what makes it takes long to import."""

    def __init__(self, function: Callable[..., Any], make: Callable[[FunctionType], Any]) -> None:
        self._function = cast("FunctionType", function)
        self._make = make
        self._made: list[Any] = []
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return self.made()(*arguments)

    def __reduce__(self) -> str:
        """Pickle it as a function: by its name. Without this what holds one could not be sent to another process."""
        return self._function.__qualname__

    @property
    def py_func(self) -> Callable[..., Any]:
        """The function in Python, by the name under which numba has it."""
        return self._function

    def made(self) -> Any:
        """Return what numba makes of the function."""
        with _making:
            if not self._made:
                self._made.append(self._make(self._function))
            return self._made[0]


class _Compiled(_Later):
    """A function of which there is machine code for each kind of arguments that it was called with."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function, _dispatcher)
        self._callers: dict[tuple[str | None, ...], Callable[..., Any]] = {}
        self._loaded: list[Loaded] = []

    def __call__(self, *arguments: Any) -> Any:
        kinds = tuple(map(kind_of, arguments))
        call = self._callers.get(kinds)
        if call is None:
            call = self._caller(kinds, arguments)
        return call(*arguments)

    def _caller(self, kinds: tuple[str | None, ...], arguments: tuple[Any, ...]) -> Callable[..., Any]:
        known = tuple(kind for kind in kinds if kind is not None)
        with _making:
            if kinds not in self._callers:
                whole = len(known) == len(kinds) == self._function.__code__.co_argcount
                self._callers[kinds] = (self._kept(known, arguments) if whole else None) or self.made()
            return self._callers[kinds]

    def _kept(self, kinds: tuple[str, ...], arguments: tuple[Any, ...]) -> Callable[..., Any] | None:
        """Return what calls the machine code that is kept, or is made and kept now; None where numba is to call it."""
        function = self._function
        file = Path(function.__code__.co_filename)
        origin = Origin(function.__module__, function.__qualname__, file, digest_of(file), kinds)
        code = load_code(origin)
        if code is None:
            from foundation.machine_code.translating import code_of

            code = code_of(_translated(function), arguments)
            keep_code(origin, code)
        if code.bytes is None:
            return None
        self._loaded.append(load(code.bytes, code.symbol))
        return caller(self._loaded[-1].address, kinds, code.returned)


def compiled(function: _Function) -> _Function:
    """Compile `function`, keeping the machine code on disk where a folder for it can be written.

    It takes positional arguments.
    """
    return cast("_Function", _Compiled(function))


def inlined(function: _Function) -> _Function:
    """Return `function` for compiled functions to call, into which it is copied."""
    return cast("_Function", _Later(function, _inlined))


def intrinsic(function: Callable[..., Any]) -> Any:
    """Return a step in LLVM's terms for compiled functions to call; see `numba.extending.intrinsic`."""
    return _Later(function, _intrinsic)


def _translated(function: FunctionType) -> FunctionType:
    from foundation.machine_code.translating import translated

    return translated(
        function,
        lambda thing: thing.made() if isinstance(thing, _Later) else thing,
        digest_of(Path(function.__code__.co_filename)),
    )


def _dispatcher(function: FunctionType) -> Any:
    from foundation.machine_code.translating import dispatcher

    return dispatcher(_translated(function))


def _inlined(function: FunctionType) -> Any:
    from foundation.machine_code.translating import numba

    return numba().njit(inline="always")(_translated(function))


def _intrinsic(function: FunctionType) -> Any:
    from foundation.machine_code.translating import numba

    return numba().extending.intrinsic(function)
