"""Values out of MATLAB files, checked: the data sets' ground truths come in them.

SciPy follows a damaged type out of its memory, so that a file of version 5 to 7 is checked before SciPy reads it.
Source: MathWorks, "MAT-File Format", R2019b, chapter 1: the header (table 1-1), data elements and their small form
(table 1-2, figure 1-3), data types (table 1-1 of the elements) and array classes (table 1-3). Names below are theirs.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError

_HEADER: Final = 128
"""Bytes of the header; its last two tell the order of bytes."""
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
"""Types miINT8, miINT32, miUINT32, miMATRIX and miCOMPRESSED."""
_SIZES: Final = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}
"""Bytes of a number of each numeric type, miINT8 to miUINT64."""
_TEXT: Final = {**_SIZES, 16: 1, 17: 2, 18: 4}
"""The same with miUTF8, miUTF16 and miUTF32."""
_CELL, _STRUCT, _CHAR, _SPARSE = 1, 2, 4, 5
"""Classes mxCELL_CLASS, mxSTRUCT_CLASS, mxCHAR_CLASS and mxSPARSE_CLASS."""
_NUMERIC: Final = frozenset(range(6, 16))
"""Classes mxDOUBLE_CLASS to mxUINT64_CLASS."""
_COMPLEX: Final = 0x0800
"""Flag of an array that has imaginary parts."""
_EMPTY_LINES: Final = 1000
"""Lines of text that may have no bytes: SciPy makes a string of each, and a damaged file may say billions."""
_DEEPEST: Final = 20
"""Deepest nesting of cells that is followed; ground truths have two."""
_LARGEST: Final = 1 << 28
"""Most bytes that a compressed variable may unfold to: a ground truth has some kilobytes."""


@dataclass(frozen=True)
class _Element:
    """A data element: its type, and where its bytes begin and end."""

    kind: int
    begin: int
    end: int


def check_mat5(data: bytes) -> None:
    """Check the structure of a MATLAB file of version 5 to 7; files of version 4 pass unseen.

    Examples
    --------
    >>> header = b"MATLAB 5.0 MAT-file".ljust(126) + b"IM"
    >>> check_mat5(header)
    >>> check_mat5(header + bytes([14, 0, 0, 0, 80, 0, 0, 0]))
    Traceback (most recent call last):
    ValueError: byte 128: an element of 80 bytes ends behind the file
    """
    if 0 in data[:4]:
        return
    if len(data) < _HEADER:
        raise ValueError(f"it has {len(data)} bytes, a header alone has {_HEADER}")
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise ValueError(f"the order of bytes is {data[126:128]!r}, expected b'IM' or b'MI'")
    for element in _elements(data, _HEADER, len(data), order, padded=False):
        if element.kind == _COMPRESSED:
            unfolded = _unfold(data[element.begin : element.end], element.begin)
            inner = list(_elements(unfolded, 0, len(unfolded), order))
            if len(inner) != 1 or inner[0].kind != _MATRIX:
                raise ValueError(f"byte {element.begin}: a compressed element does not hold one array")
            _check_array(unfolded, inner[0], order, 0)
        elif element.kind == _MATRIX:
            _check_array(data, element, order, 0)
        else:
            raise ValueError(f"byte {element.begin}: an element of type {element.kind}, expected an array")


def _unfold(packed: bytes, at: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unfolded = unpacker.decompress(packed, _LARGEST)
    except zlib.error as error:
        raise ValueError(f"byte {at}: {error}") from error
    if not unpacker.eof:
        raise ValueError(f"byte {at}: a compressed element ends early, or holds more than {_LARGEST} bytes")
    return unfolded


def _elements(data: bytes, begin: int, end: int, order: str, padded: bool = True) -> Iterator[_Element]:
    """Yield the elements of a part of the file; those of the file itself are not padded to eight bytes."""
    at = begin
    while at < end:
        if at + 8 > end:
            raise ValueError(f"byte {at}: {end - at} bytes are left, a tag has 8")
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise ValueError(f"byte {at}: a small element of {size} bytes, expected at most 4")
            first, at = at + 4, at + 8
        else:
            first = at + 8
            if first + size > end:
                raise ValueError(f"byte {at}: an element of {size} bytes ends behind the file")
            at = first + size
            if padded:
                at += -size % 8
        yield _Element(kind, first, first + size)


def _check_array(data: bytes, array: _Element, order: str, depth: int) -> None:
    if depth > _DEEPEST:
        raise ValueError(f"byte {array.begin}: cells are nested more than {_DEEPEST} deep")
    if array.begin == array.end:
        # An empty cell may be written as an array of no bytes.
        return
    parts = list(_elements(data, array.begin, array.end, order))
    if len(parts) < 3:
        raise ValueError(f"byte {array.begin}: an array of {len(parts)} parts, expected flags, dimensions and name")
    flags, dimensions, name = parts[:3]
    if (flags.kind, flags.end - flags.begin) != (_UINT32, 8):
        raise ValueError(f"byte {flags.begin}: no flags of an array")
    word = struct.unpack_from(order + "I", data, flags.begin)[0]
    kind, is_complex = word & 0xFF, bool(word & _COMPLEX)
    if dimensions.kind != _INT32 or (dimensions.end - dimensions.begin) % 4 or dimensions.end - dimensions.begin < 8:
        raise ValueError(f"byte {dimensions.begin}: no dimensions of an array")
    sides = struct.unpack_from(f"{order}{(dimensions.end - dimensions.begin) // 4}i", data, dimensions.begin)
    if min(sides) < 0:
        raise ValueError(f"byte {dimensions.begin}: the dimensions are {list(sides)}, expected none below 0")
    if name.kind != _INT8:
        raise ValueError(f"byte {name.begin}: no name of an array")
    count, values = math.prod(sides), parts[3:]
    if kind == _CELL:
        _check_arrays(data, values, count, order, depth)
    elif kind == _STRUCT:
        _check_struct(data, values, count, order, depth)
    elif kind == _SPARSE:
        _check_numbers(values[:2], 2, None, {_INT32: 4})
        _check_numbers(values[2:], 1 + is_complex, None, _SIZES)
    elif kind == _CHAR:
        _check_numbers(values, 1, None, _TEXT)
        rows, size = math.prod(sides[:-1]), values[0].end - values[0].begin
        if rows > size + _EMPTY_LINES:
            raise ValueError(f"byte {dimensions.begin}: {rows} lines of text in {size} bytes")
    elif kind in _NUMERIC:
        _check_numbers(values, 1 + is_complex, count, _SIZES)
    else:
        raise ValueError(f"byte {flags.begin}: an array of class {kind}, expected numbers, text, cells or structures")


def _check_numbers(parts: list[_Element], expected: int, count: int | None, sizes: dict[int, int]) -> None:
    if len(parts) != expected:
        raise ValueError(f"an array has {len(parts)} parts of values, expected {expected}")
    for part in parts:
        if part.kind not in sizes:
            raise ValueError(f"byte {part.begin}: values of type {part.kind}, expected numbers")
        size = part.end - part.begin
        if size % sizes[part.kind] or (count is not None and size != count * sizes[part.kind]):
            raise ValueError(f"byte {part.begin}: {size} bytes of values, expected {count} of {sizes[part.kind]} bytes")


def _check_struct(data: bytes, parts: list[_Element], count: int, order: str, depth: int) -> None:
    if len(parts) < 2 or parts[0].kind != _INT32 or parts[0].end - parts[0].begin != 4 or parts[1].kind != _INT8:
        raise ValueError("a structure lacks the names of its fields")
    length = struct.unpack_from(order + "i", data, parts[0].begin)[0]
    names = parts[1].end - parts[1].begin
    if length < 1 or names % length:
        raise ValueError(f"byte {parts[0].begin}: names of fields take {names} bytes, each {length}")
    _check_arrays(data, parts[2:], count * (names // length), order, depth)


def _check_arrays(data: bytes, parts: list[_Element], count: int, order: str, depth: int) -> None:
    if len(parts) != count:
        raise ValueError(f"cells or fields hold {len(parts)} arrays, expected {count}")
    for part in parts:
        if part.kind != _MATRIX:
            raise ValueError(f"byte {part.begin}: an element of type {part.kind} in a cell, expected an array")
        _check_array(data, part, order, depth + 1)


def read_mat(path: Path) -> Mapping[str, Any]:
    """Return the variables of a MATLAB file up to version 7 by name."""
    from scipy.io import loadmat

    try:
        check_mat5(path.read_bytes())
        return loadmat(path)
    except NotImplementedError as error:
        raise FormatError(f"{path} is of MATLAB's version 7.3, expected 7 at most; save it with -v7") from error
    except Exception as error:
        reason = (isinstance(error, OSError) and error.strerror) or str(error)
        raise FormatError(f"{path} cannot be read: {reason}; restore it from the data set's archive") from error


def table(content: Mapping[str, Any], name: str, path: Path, columns: int) -> npt.NDArray[np.float64]:
    """Return a variable as an array (N, columns) float64."""
    try:
        values = np.asarray(_get(content, name, path), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FormatError(f"{path}: {name} is not made of numbers; restore the file") from error
    if values.ndim != 2 or values.shape[1] != columns or not np.isfinite(values).all():
        raise FormatError(
            f"{path}: {name} is {values.shape}, expected (images, {columns}) finite numbers; restore the file"
        )
    return values


def scalar(content: Mapping[str, Any], name: str, path: Path) -> float:
    """Return a variable that is one number."""
    values = np.asarray(_get(content, name, path))
    if values.size != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all() or values.min() < 0:
        raise FormatError(f"{path}: {name} is {values.tolist()}, expected one number from 0; restore the file")
    return float(values.reshape(-1)[0])


def strings(content: Mapping[str, Any], name: str, path: Path) -> list[str] | None:
    """Return a variable that is a cell array of names, or None if there is none."""
    if name not in content:
        return None
    found: list[str] = []
    for cell in np.asarray(content[name], dtype=object).reshape(-1):
        value: Any = cell
        while isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        if not isinstance(value, str):
            raise FormatError(f"{path}: {name} holds {value!r}, expected names of images; restore the file")
        found.append(value.strip())
    return found


def _get(content: Mapping[str, Any], name: str, path: Path) -> Any:
    if name not in content:
        have = ", ".join(key for key in content if not key.startswith("__"))
        raise FormatError(f"{path} has {have or 'nothing'}, expected {name} among them; restore the file")
    return content[name]
