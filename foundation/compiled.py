"""Python functions compiled by numba, kept on disk for the processor at hand; and work spread over its threads.

A fresh machine needs no compiler: numba brings LLVM with it (`docs/decisions/0010-compiled-kernel.md`). numba itself is
imported when a compiled function is first called, since that takes half a second
(`docs/decisions/0039-numba-loads-its-own-code.md`). Compiled functions hold no state and no lock and release the
interpreter's. What lies on disk is used for the very sources, settings, processor and libraries that it was made with,
and where its bytes are those that were written; it lies where numba keeps code: in `NUMBA_CACHE_DIR`, else beside the
source in `__pycache__`, else in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import re
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache, update_wrapper
from pathlib import Path
from threading import RLock
from types import CellType, CodeType, FunctionType
from typing import Any, Final, TypeVar, cast

from foundation.errors import CropError
from foundation.files import atomic_file

_Function = TypeVar("_Function", bound=Callable[..., Any])

_ROOT: Final = Path(__file__).parents[1]
_IMPORT: Final = re.compile(r"^from ([a-z_][.\w]*) import (\([^)]*\)|.*)", re.MULTILINE)
_COMPILING: Final = "compiling for this processor, which is done once and takes half a minute at most …"
_HASH_BYTES: Final = hashlib.sha256().digest_size
_making: Final = RLock()  # Held where compiled forms are made, so that several threads do so once


class _Later:
    """A function whose compiled form is made when it is first asked for."""

    def __init__(self, function: Callable[..., Any], make: Callable[[FunctionType], Any]) -> None:
        self._function = cast("FunctionType", function)
        self._make = make
        self._made: Any = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return (self._made or self.made())(*arguments)

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
            if self._made is None:
                self._made = self._make(self._function)
            return self._made


def compiled(function: _Function) -> _Function:
    """Compile `function`, keeping the machine code on disk where a folder for it can be written.

    It takes positional arguments.
    """
    return cast("_Function", _Later(function, _dispatcher))


def inlined(function: _Function) -> _Function:
    """Return `function` for compiled functions to call, into which it is copied."""
    return cast("_Function", _Later(function, lambda one: _numba().njit(inline="always")(_translated(one))))


def intrinsic(function: Callable[..., Any]) -> Any:
    """Return a step in LLVM's terms for compiled functions to call; see `numba.extending.intrinsic`."""
    return _Later(function, lambda one: _numba().extending.intrinsic(one))


def _dispatcher(function: FunctionType) -> Any:
    """Return numba's callable: it releases the interpreter's lock, and divides by zero as numpy does."""
    made = _numba().njit(nogil=True, error_model="numpy")(_translated(function))
    cache_of_code = _checked_cache()
    try:
        made._cache = cache_of_code(made.py_func)  # noqa: SLF001 - as numba itself sets it
    except RuntimeError:
        # No folder of numba's is writable; compiling anew costs seconds a start.
        logging.getLogger(__name__).debug("no folder to keep the code of %s in", function.__qualname__)
    return made


def _translated(function: FunctionType) -> FunctionType:
    """Return a function as numba takes it: the steps that it calls are numba's own, and it closes over its origin.

    numba knows code on disk again by the file of the function and by what it closes over.
    """
    code = function.__code__
    if code.co_freevars:
        raise ValueError(f"{function.__qualname__} closes over {code.co_freevars}; compile module functions only")
    known = function.__globals__
    steps = {name: known[name].made() for name in _names(code) if isinstance(known.get(name), _Later)}
    origin = (_digest_of(Path(code.co_filename)), *_settings())
    made = FunctionType(
        code.replace(co_freevars=("origin",)),
        {**known, **steps},
        function.__name__,
        function.__defaults__,
        (CellType(origin),),
    )
    made.__module__, made.__qualname__, made.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return made


def _names(code: CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


@cache
def _settings() -> tuple[str, ...]:
    """Return what code depends on beside sources and processor: numba's version, LLVM's, and numba's settings."""
    import llvmlite

    given = {name: value for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_")}
    given.pop("NUMBA_CACHE_DIR", None)
    return (_numba().__version__, llvmlite.__version__, *(f"{name}={value}" for name, value in given.items()))


@cache
def _digest_of(file: Path) -> str:
    """Return the SHA-256, hexadecimal, of `file` and of the files of this software that it imports from, and so on."""
    behind, waiting = {file}, [file]
    while waiting:
        new = set(_source(waiting.pop())[1]) - behind
        behind |= new
        waiting += new
    digest = hashlib.sha256()
    for one in sorted(behind):
        digest.update(_source(one)[0])
    return digest.hexdigest()


@cache
def _source(file: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return a file's bytes, and those files of this software that it imports from: many functions share them."""
    data = file.read_bytes() if file.is_file() else b""
    behind: list[Path] = []
    for module, names in _IMPORT.findall(data.decode("utf-8")):
        folder = _ROOT.joinpath(*module.split("."))
        named = (folder / f"{name}.py" for name in re.findall(r"\w+", names))
        behind += [path for path in (folder.with_suffix(".py"), *named) if path.is_file()]
    return data, tuple(behind)


@cache
def _numba() -> Any:
    """Return numba, which says on a terminal, once, why the first start takes long."""
    import numba
    from numba.core import event

    class Announcement(event.Listener):
        said = False

        def on_start(self, event: event.Event) -> None:
            if not self.said and sys.stderr.isatty() and logging.getLogger().isEnabledFor(logging.WARNING):
                self.said = True
                print(_COMPILING, file=sys.stderr)

        def on_end(self, event: event.Event) -> None:
            pass

    # It happens for what was not found on the disk.
    event.register("numba:compile", Announcement())
    return numba


@cache
def _checked_cache() -> Any:
    """Return numba's cache of a function, with one file for each signature, which is held against a hash.

    numba's own fails where a file is damaged.
    """
    from numba.core import caching, serialize

    class CheckedCache(caching.FunctionCache):
        def load_overload(self, sig: Any, target_context: Any) -> Any:
            target_context.refresh()
            codegen = target_context.codegen()
            try:
                data = self._path(sig, codegen).read_bytes()
            except OSError:
                return None
            if self._hash(sig, codegen, data[_HASH_BYTES:]) != data[:_HASH_BYTES]:
                return None
            return self._impl.rebuild(target_context, pickle.loads(data[_HASH_BYTES:]))

        def save_overload(self, sig: Any, data: Any) -> None:
            if not self._impl.check_cachable(data):
                return
            code = serialize.dumps(self._impl.reduce(data))
            with suppress(CropError, OSError), atomic_file(self._path(sig, data.codegen)) as file:
                file.write(self._hash(sig, data.codegen, code) + code)

        def _path(self, sig: Any, codegen: Any) -> Path:
            """Return the file of a signature on this kind of processor; new code of the function replaces the old."""
            function, (_, processor, _) = self._py_func, codegen.magic_tuple()
            told = "|".join((function.__module__, str(sig), processor, sys.implementation.cache_tag))
            name = hashlib.sha256(told.encode()).hexdigest()[:12]
            return Path(self._cache_path) / f"{function.__qualname__}-{name}.code"

        def _hash(self, sig: Any, codegen: Any, code: bytes) -> bytes:
            """Return the SHA-256 of code and of all that it was made from."""
            return hashlib.sha256(repr(self._index_key(sig, codegen)).encode() + code).digest()

    return CheckedCache


_In = TypeVar("_In")
_Out = TypeVar("_Out")


def processor_count() -> int:
    """Return the number of processors this process may run on, at least 1.

    A scheduler or a container may bind a process to fewer than the machine has; where the system binds none, all are
    counted. A container's share of processor time is not looked at.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_map(function: Callable[[_In], _Out], things: Iterable[_In], workers: int) -> Iterator[_Out]:
    """Yield the function's values in the order of the things; with one worker in the calling thread.

    Examples
    --------
    >>> list(ordered_map(abs, [-3, 2, -1], workers=2))
    [3, 2, 1]
    """
    if workers <= 1:
        yield from map(function, things)
        return
    waiting: deque[Future[_Out]] = deque()
    pool = ThreadPoolExecutor(workers)
    try:
        for thing in things:
            waiting.append(pool.submit(function, thing))
            if len(waiting) >= 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
