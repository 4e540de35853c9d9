"""Python functions to machine code, by numba, which is imported for that alone."""

from __future__ import annotations

import dis
import inspect
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, Final

from foundation.machine_code.kept import Code

OPTIONS: Final[Mapping[str, Any]] = {"nogil": True, "error_model": "numpy"}
"""Of all compiled functions: they release the interpreter's lock, and divide by zero as numpy does."""

_COMPILING: Final = "compiling for this processor, which is done once and takes half a minute at most …"

_LIBRARY: Final = frozenset({"malloc", "free", "memcpy", "memmove", "memset"})
"""What code may refer to beside itself: functions of the C library, which LLVM finds in every process."""

_OWNER: Final = "{i64, i8*, i8*, i8*, i64}"
"""How numba's memory of an array begins; the code below is right for that."""

_MEMORY: Final = """
declare ptr @malloc(i64)
declare void @free(ptr)

define linkonce_odr ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
  %step = zext i32 %align to i64
  %room = add i64 %step, 64
  %all = add i64 %size, %room
  %owner = call ptr @malloc(i64 %all)
  %none = icmp eq ptr %owner, null
  br i1 %none, label %end, label %made
made:
  %begin = ptrtoint ptr %owner to i64
  %behind = add i64 %begin, 63
  %least = add i64 %behind, %step
  %mask = sub i64 0, %step
  %place = and i64 %least, %mask
  %data = inttoptr i64 %place to ptr
  store i64 1, ptr %owner
  %destructor = getelementptr i8, ptr %owner, i64 8
  store ptr null, ptr %destructor
  %more = getelementptr i8, ptr %owner, i64 16
  store ptr null, ptr %more
  %first = getelementptr i8, ptr %owner, i64 24
  store ptr %data, ptr %first
  %bytes = getelementptr i8, ptr %owner, i64 32
  store i64 %size, ptr %bytes
  %allocator = getelementptr i8, ptr %owner, i64 40
  store ptr null, ptr %allocator
  br label %end
end:
  ret ptr %owner
}

define linkonce_odr void @NRT_MemInfo_call_dtor(ptr %owner) {
  call void @free(ptr %owner)
  ret void
}

define linkonce_odr ptr @NRT_Allocate(i64 %size) {
  %memory = call ptr @malloc(i64 %size)
  ret ptr %memory
}

define linkonce_odr void @NRT_Free(ptr %memory) {
  call void @free(ptr %memory)
  ret void
}

define linkonce_odr i32 @numba_attempt_nocopy_reshape(
    i64 %dims, ptr %shape, ptr %strides, i64 %newdims, ptr %newshape, ptr %newstrides, i64 %itemsize, i32 %fortran) {
  br label %look
look:
  %behind = phi i64 [ %dims, %0 ], [ %place, %on ]
  %wanted = phi i64 [ %itemsize, %0 ], [ %further, %on ]
  %seen = icmp eq i64 %behind, 0
  br i1 %seen, label %loop, label %hold
hold:
  %place = sub i64 %behind, 1
  %length_at = getelementptr i64, ptr %shape, i64 %place
  %length = load i64, ptr %length_at
  %found_at = getelementptr i64, ptr %strides, i64 %place
  %found = load i64, ptr %found_at
  %further = mul i64 %wanted, %length
  %single = icmp eq i64 %length, 1
  %as_wanted = icmp eq i64 %found, %wanted
  %right = or i1 %single, %as_wanted
  br i1 %right, label %on, label %refused
on:
  br label %look
refused:
  ret i32 0
loop:
  %left = phi i64 [ %newdims, %look ], [ %at, %step ]
  %stride = phi i64 [ %itemsize, %look ], [ %next, %step ]
  %done = icmp eq i64 %left, 0
  br i1 %done, label %end, label %step
step:
  %at = sub i64 %left, 1
  %to = getelementptr i64, ptr %newstrides, i64 %at
  store i64 %stride, ptr %to
  %from = getelementptr i64, ptr %newshape, i64 %at
  %count = load i64, ptr %from
  %next = mul i64 %stride, %count
  br label %loop
end:
  ret i32 1
}
"""
"""What numba's library does for code that makes arrays of its own, and gives those in C's order another shape: its code
is in a module of Python's that does not load without numba. Arrays in another order are refused here, where numba sees
whether they can have the shape without a copy."""

_log: Final = logging.getLogger(__name__)


def translated(function: FunctionType, ready: Callable[[Any], Any], digest: str) -> FunctionType:
    """Return a function as numba takes it."""
    code = function.__code__
    if code.co_freevars:
        raise ValueError(f"{function.__qualname__} closes over {code.co_freevars}; compile module functions only")
    known = function.__globals__
    named = {name: ready(known[name]) for name in _names(code) if name in known}
    made = FunctionType(
        code.replace(co_freevars=("sources",)),
        {**known, **named},
        function.__name__,
        function.__defaults__,
        (CellType(digest),),
    )
    made.__module__, made.__qualname__, made.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return made


def _names(code: CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


def numba() -> ModuleType:
    """Return numba, which says when it compiles and leaves SciPy alone."""
    import numba as library

    _prepare()
    return library


def dispatcher(function: FunctionType) -> Any:
    """Return numba's own callable of a translated function; it keeps machine code where a folder can be written."""
    library = numba()
    try:
        return library.njit(**OPTIONS, cache=True)(function)
    except RuntimeError:
        # Neither the package's folder nor the home folder is writable; compiling anew costs seconds a start.
        return library.njit(**OPTIONS)(function)


def code_of(function: FunctionType, arguments: Sequence[Any]) -> Code:
    """Return the machine code of a translated function for arguments of those kinds.

    Without bytes where the code needs numba beside it: it returns an array, raises, or calls into numba's libraries.
    """
    library = numba()
    from llvmlite import binding
    from numba.core import compiler, registry
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.runtime import nrtdynmod

    from foundation.machine_code.loading import target_machine

    announce()
    target: Any = registry.cpu_target
    flags: Any = compiler.Flags()
    target.options.parse_as_flags(flags, {"nopython": True, **OPTIONS})
    # Only the function itself: no wrapper for Python, none for C, and nothing made executable.
    flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
    with global_compiler_lock:
        kinds = tuple(library.typeof(argument) for argument in arguments)
        made: Any = compiler.compile_extra(
            target.typing_context, target.target_context, function, kinds, None, flags, {}
        )
        returned = _returned(made.signature.return_type)
        if returned is ... or _raises(function):
            return Code(None)
        made.library.finalize()
        module = binding.parse_assembly(made.library.get_llvm_str())
        if str(nrtdynmod.__dict__["_meminfo_struct_type"]) == _OWNER:
            module.link_in(binding.parse_assembly(_MEMORY))
        missing = {
            one.name for one in module.functions if one.is_declaration and not one.name.startswith("llvm.")
        } - _LIBRARY
        if missing:
            _log.debug("%s is left to numba: it calls %s", function.__qualname__, ", ".join(sorted(missing)))
            return Code(None)
        return Code(target_machine().emit_object(module), made.fndesc.llvm_func_name, returned)


def _raises(function: FunctionType) -> bool:
    """Return whether a function, or one that is compiled into it, has a `raise` or an `assert`.

    numba makes Python's exception of the status that its code returns.
    """
    if any(step.opname == "RAISE_VARARGS" for step in dis.get_instructions(function)):
        return True
    named = (function.__globals__.get(name) for name in _names(function.__code__))
    inner = (getattr(one, "py_func", None) for one in named)
    return any(_raises(one) for one in inner if isinstance(one, FunctionType) and one is not function)


def _returned(kind: Any) -> Any:
    """Return numba's type of what is returned as `arguments.caller` takes it; an ellipsis if it does not."""
    from numba import types

    core: Any = types
    if isinstance(kind, core.NoneType):
        return None
    if isinstance(kind, core.Boolean):
        return "bool"
    if isinstance(kind, core.Integer | core.Float) and str(kind) != "float16":
        return str(kind)
    if isinstance(kind, core.BaseTuple) and not isinstance(kind, core.BaseNamedTuple):
        parts = [_returned(part) for part in kind]
        if all(isinstance(part, str) for part in parts):
            return parts
    return ...


_said: Final[list[str]] = []


def announce() -> None:
    """Say on a terminal, once, why the first start takes long."""
    if _said or not sys.stderr.isatty() or not logging.getLogger().isEnabledFor(logging.WARNING):
        return
    _said.append(_COMPILING)
    print(_COMPILING, file=sys.stderr)


@cache
def _prepare() -> None:
    """Once: hear of what numba did not find on the disk, and keep it from SciPy."""
    from numba.core import event

    class Announcement(event.Listener):
        def on_start(self, event: event.Event) -> None:
            announce()

        def on_end(self, event: event.Event) -> None:
            pass

    event.register("numba:compile", Announcement())
    _without_linear_algebra()


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
