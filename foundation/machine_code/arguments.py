"""How Python's values are handed to machine code, and what it hands back.

numba's functions take each value as its numbers: an array as two addresses for its owner, which are none here, then
the number of its elements, their bytes, the address of the first, and shape and strides. They return a status, 0 or
-2 where all went well, and write their value at an address that they are given first; where the second points they say
which exception was raised.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

_CTYPES: Final[dict[str, Any]] = {
    "bool": ctypes.c_bool,
    "int8": ctypes.c_int8,
    "int16": ctypes.c_int16,
    "int32": ctypes.c_int32,
    "int64": ctypes.c_int64,
    "uint8": ctypes.c_uint8,
    "uint16": ctypes.c_uint16,
    "uint32": ctypes.c_uint32,
    "uint64": ctypes.c_uint64,
    "float32": ctypes.c_float,
    "float64": ctypes.c_double,
}
"""What stands for each kind of number; numba names them like numpy."""

_RESULTS: Final[dict[str, Callable[[Any], Any]]] = {"bool": bool, "float32": float, "float64": float}
"""What numba makes of a number that it returns; of all others `int`."""

_DONE: Final = (0, -2)
"""Statuses of a function that returned: with a value, and with none."""

_NAMES: Final = {np.dtype(name): name for name in _CTYPES}
"""Names of numpy's types; numpy itself takes longer to tell one than a small kernel runs. Others' orders of bytes are
none of them."""

_ARRAY: Final[Any] = np.ndarray
_OF_NUMPY: Final[Any] = (np.ndarray, np.generic)

_LARGEST: Final = (1 << 63) - 1
"""Python's integers are 64 bits with a sign in machine code, and without one above this."""


def kind_of(value: Any) -> str | None:
    """Return the kind by which machine code for a value is known; None of what only numba can hand over.

    Examples
    --------
    >>> kind_of(3), kind_of(np.uint32(3)), kind_of(np.zeros((2, 3), np.uint8)), kind_of("three")
    ('int64', 'uint32', 'uint8 2 C', None)
    """
    if isinstance(value, _OF_NUMPY):
        name = _NAMES.get(value.dtype)
        return _array_kind(name, value) if name and isinstance(value, _ARRAY) else name
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int64" if -_LARGEST - 1 <= value <= _LARGEST else "uint64" if 0 < value >> 63 < 2 else None
    return "float64" if isinstance(value, float) else None


def _array_kind(name: str, array: npt.NDArray[Any]) -> str | None:
    flags = array.flags
    layout = "C" if flags.c_contiguous else "F" if flags.f_contiguous else "A"
    return f"{name} {array.ndim} {layout}{'' if flags.writeable else ' read-only'}" if flags.aligned else None


def caller(address: int, kinds: Sequence[str], returned: str | Sequence[str] | None) -> Callable[..., Any]:
    """Return a Python function that calls machine code without the interpreter's lock.

    `returned`: the kind of number that it returns, those of a tuple, or None where it returns nothing.
    """
    taken: list[Any] = []
    arrays: list[bool] = []
    for kind in kinds:
        name, _, more = kind.partition(" ")
        arrays.append(bool(more))
        if more:
            dimensions = int(more.split()[0])
            taken += [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_ssize_t, ctypes.c_void_p]
            taken += 2 * dimensions * [ctypes.c_ssize_t]
        else:
            taken.append(_CTYPES[name])
    function = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *taken)(address)
    value_type, value_of = _result(returned)

    def call(*values: Any) -> Any:
        flat: list[Any] = []
        for value, is_array in zip(values, arrays, strict=True):
            if is_array:
                flat += (None, None, value.size, value.itemsize, value.__array_interface__["data"][0])
                flat += value.shape
                flat += value.strides
            else:
                flat.append(value.item() if isinstance(value, np.generic) else value)
        result, fault = value_type(), ctypes.c_void_p()
        if function(ctypes.addressof(result), ctypes.addressof(fault), *flat) not in _DONE:
            raise MemoryError(
                "compiled code ended with a fault instead of a value: no memory for its arrays, or an array that is "
                "not in C's order was to get another shape"
            )
        return value_of(result)

    return call


def _result(returned: str | Sequence[str] | None) -> tuple[Any, Callable[[Any], Any]]:
    """Return the memory of what is returned, and what makes Python's value of it."""
    if returned is None:
        return ctypes.c_void_p, lambda _: None
    if isinstance(returned, str):
        made = _RESULTS.get(returned, int)
        return _CTYPES[returned], lambda result: made(result.value)
    fields = [(f"part{place}", _CTYPES[kind]) for place, kind in enumerate(returned)]
    tuple_type = type("Returned", (ctypes.Structure,), {"_fields_": fields})
    makers = [(name, _RESULTS.get(kind, int)) for (name, _), kind in zip(fields, returned, strict=True)]
    return tuple_type, lambda result: tuple(made(getattr(result, name)) for name, made in makers)
