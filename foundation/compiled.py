"""Compile functions with numba, cache their machine code on disk, and run functions in several threads.

Compiled functions have no state and release Python's interpreter lock (GIL). Cached code is used only if the source
code, numba's settings, the processor and the library versions are unchanged. The cache is in `NUMBA_CACHE_DIR`, or else
in the first folder that can be written: `__pycache__` next to the source, or the user's cache (decisions 0010, 0039).
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

_SOURCE_ROOT: Final = Path(__file__).parents[1]
_IMPORT_STATEMENT: Final = re.compile(r"^from ([a-z_][.\w]*) import (\([^)]*\)|.*)", re.MULTILINE)
_COMPILING_MESSAGE: Final = "compiling functions for this processor; this is done once and takes at most 30 s …"
_HASH_BYTES: Final = hashlib.sha256().digest_size
_compile_lock: Final = RLock()  # Prevents several threads from compiling the same function


class _LazyFunction:
    """Function that is compiled at its first call, because the import of numba alone takes 0.5 s."""

    def __init__(self, function: Callable[..., Any], compiler: Callable[[FunctionType], Any]) -> None:
        self._function = cast("FunctionType", function)
        self._compiler = compiler
        self._compiled: Any = None
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return (self._compiled or self.compile())(*arguments)

    def __reduce__(self) -> str:
        # Pickle stores only the name, as for other functions. Objects that refer to this function are sent to other
        # processes.
        return self._function.__qualname__

    @property
    def py_func(self) -> Callable[..., Any]:
        """Python function before compilation; numba has the same attribute."""
        return self._function

    def compile(self) -> Any:
        """Return the compiled function."""
        with _compile_lock:
            if self._compiled is None:
                self._compiled = self._compiler(self._function)
            return self._compiled


def compiled(function: _Function) -> _Function:
    """Return a compiled `function`, for positional arguments; its code is cached if a cache folder is writable."""
    return cast("_Function", _LazyFunction(function, _make_dispatcher))


def inlined(function: _Function) -> _Function:
    """Return `function` for use in compiled functions; its code is copied into them."""
    return cast("_Function", _LazyFunction(function, lambda f: _numba().njit(inline="always")(_numba_input(f))))


def intrinsic(function: Callable[..., Any]) -> Any:
    """Return a function that emits LLVM instructions, for use in compiled functions (`numba.extending.intrinsic`)."""
    return _LazyFunction(function, lambda f: _numba().extending.intrinsic(f))


def _make_dispatcher(function: FunctionType) -> Any:
    dispatcher = _numba().njit(nogil=True, error_model="numpy")(_numba_input(function))
    cache_class = _checked_cache()
    try:
        dispatcher._cache = cache_class(dispatcher.py_func)  # noqa: SLF001 - as numba itself sets it
    except RuntimeError:
        # No cache folder can be written, so each start of a program compiles again, which takes seconds.
        logging.getLogger(__name__).debug("no writable folder for the compiled code of %s", function.__qualname__)
    return dispatcher


def _numba_input(function: FunctionType) -> FunctionType:
    """Return a copy of a function with compiled callees; its variable `origin` holds source hash and settings."""
    # numba's cache key contains closure variables, such as `origin`. So code from other sources or settings is not
    # used.
    code = function.__code__
    if code.co_freevars:
        raise ValueError(f"{function.__qualname__} uses outer variables {code.co_freevars}; pass them as arguments")
    scope = function.__globals__
    callees = {name: scope[name].compile() for name in _used_names(code) if isinstance(scope.get(name), _LazyFunction)}
    origin = (_digest_of(Path(code.co_filename)), *_settings())
    copy = FunctionType(
        code.replace(co_freevars=("origin",)),
        {**scope, **callees},
        function.__name__,
        function.__defaults__,
        (CellType(origin),),
    )
    copy.__module__, copy.__qualname__, copy.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return copy


def _used_names(code: CodeType) -> set[str]:
    inner_codes = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_used_names, inner_codes))


@cache
def _settings() -> tuple[str, ...]:
    # Compiled code depends on these versions and variables, and also on the sources and the processor.
    import llvmlite

    variables = {name: value for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_")}
    variables.pop("NUMBA_CACHE_DIR", None)
    return (_numba().__version__, llvmlite.__version__, *(f"{name}={value}" for name, value in variables.items()))


@cache
def _digest_of(file: Path) -> str:
    """Return the SHA-256 (hexadecimal) of `file` and all files of CroP that it imports directly or indirectly."""
    sources, queue = {file}, [file]
    while queue:
        new = set(_source(queue.pop())[1]) - sources
        sources |= new
        queue += new
    digest = hashlib.sha256()
    for source in sorted(sources):
        digest.update(_source(source)[0])
    return digest.hexdigest()


@cache
def _source(file: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return a file's bytes and the files of CroP that it imports; cached, because many functions share these files."""
    data = file.read_bytes() if file.is_file() else b""
    imported: list[Path] = []
    for module, names in _IMPORT_STATEMENT.findall(data.decode("utf-8")):
        folder = _SOURCE_ROOT.joinpath(*module.split("."))
        submodules = (folder / f"{name}.py" for name in re.findall(r"\w+", names))
        imported += [path for path in (folder.with_suffix(".py"), *submodules) if path.is_file()]
    return data, tuple(imported)


@cache
def _numba() -> Any:
    import numba
    from numba.core import event

    class Announcement(event.Listener):
        was_printed = False

        def on_start(self, event: event.Event) -> None:
            if not self.was_printed and sys.stderr.isatty() and logging.getLogger().isEnabledFor(logging.WARNING):
                self.was_printed = True
                print(_COMPILING_MESSAGE, file=sys.stderr)

        def on_end(self, event: event.Event) -> None:
            pass

    # This event occurs only if the code of a function is not in the cache.
    event.register("numba:compile", Announcement())
    return numba


@cache
def _checked_cache() -> Any:
    """Return a subclass of numba's cache that stores a hash and the code of each signature in a file."""
    # numba's own cache raises an error if a file is damaged. This class lets numba compile again.
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
            # The file name does not depend on the source code, so new code of a function replaces old code.
            function, (_, processor, _) = self._py_func, codegen.magic_tuple()
            target = "|".join((function.__module__, str(sig), processor, sys.implementation.cache_tag))
            name = hashlib.sha256(target.encode()).hexdigest()[:12]
            return Path(self._cache_path) / f"{function.__qualname__}-{name}.code"

        def _hash(self, sig: Any, codegen: Any, code: bytes) -> bytes:
            return hashlib.sha256(repr(self._index_key(sig, codegen)).encode() + code).digest()

    return CheckedCache


_In = TypeVar("_In")
_Out = TypeVar("_Out")


def processor_count() -> int:
    """Return the number of processors that this process may use, at least 1."""
    # A scheduler or container may allow fewer processors than the machine has. Quotas of processor time are ignored.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_map(function: Callable[[_In], _Out], items: Iterable[_In], workers: int) -> Iterator[_Out]:
    """Yield `function(item)` in the order of the items, from `workers` threads; 1 means the calling thread.

    Examples
    --------
    >>> list(ordered_map(abs, [-3, 2, -1], workers=2))
    [3, 2, 1]
    """
    if workers <= 1:
        yield from map(function, items)
        return
    futures: deque[Future[_Out]] = deque()
    pool = ThreadPoolExecutor(workers)
    try:
        for item in items:
            futures.append(pool.submit(function, item))
            # A short queue limits the memory for results that were not yielded yet.
            if len(futures) >= 2 * workers:
                yield futures.popleft().result()
        while futures:
            yield futures.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
