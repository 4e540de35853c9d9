"""What a method was, for a results folder: its class, its settings, its file.

The record says whether two runs had the same method, so nothing in it may differ from process to process. What a class
reads while it runs, such as the weights of a network, is seen where the object holds it as an array.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from evaluation.results.files import GivenEstimates
from foundation.files import file_sha256, sha256_of

# Levels of values within values that are followed: settings are flat, and a graph of objects may have a circle.
_DEEPEST = 6


def describe_method(method: object) -> dict[str, Any]:
    """Return a JSON object of a method: its name, class and settings, and the file of a class that is not this suite's.

    Examples
    --------
    >>> from evaluation.methods.standard import standard_methods
    >>> found = describe_method(standard_methods()["white-patch"])
    >>> found["name"], found["class"], found["settings"]["p"]
    ('White-Patch', 'evaluation.methods.gray_edge:GrayEdge', 'inf')
    """
    if isinstance(method, GivenEstimates):
        return {"name": method.name, "estimates": {"file": method.file, "sha256": method.sha256}}
    kind = type(method)
    found: dict[str, Any] = {"name": getattr(method, "name", ""), "class": f"{kind.__module__}:{kind.__qualname__}"}
    settings = _settings(method, 0)
    settings.pop("name", None)
    if settings:
        found["settings"] = settings
    if not kind.__module__.startswith("evaluation."):
        # The name under which a file was loaded comes from its whole path; the file's own name says more.
        found |= _source(kind)
    return found


def _source(kind: type) -> dict[str, Any]:
    try:
        path = Path(inspect.getfile(kind)).resolve()
        found = {"class": f"{path.name}:{kind.__qualname__}", "file_sha256": file_sha256(path)}
    except (OSError, TypeError):
        return {}
    return found


def _settings(thing: object, depth: int) -> dict[str, Any]:
    if is_dataclass(thing):
        return {part.name: _value(getattr(thing, part.name), depth + 1) for part in fields(thing)}
    return {name: _value(value, depth + 1) for name, value in sorted(getattr(thing, "__dict__", {}).items())}


def _value(value: object, depth: int) -> Any:
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value if math.isfinite(value) else str(value)
        case np.generic():
            return _value(cast("object", value.item()), depth)
        case np.ndarray():
            array = cast("npt.NDArray[Any]", value)
            return {"shape": list(array.shape), "dtype": str(array.dtype), "sha256": _hash(array)}
        case _ if depth >= _DEEPEST:
            return type(value).__qualname__
        case Mapping():
            return {str(key): _value(one, depth + 1) for key, one in cast("Mapping[Any, Any]", value).items()}
        case bytes():
            return {"bytes": len(value), "sha256": sha256_of(value)}
        case Sequence():
            return [_value(one, depth + 1) for one in cast("Sequence[Any]", value)]
        case _ if is_dataclass(value) and not isinstance(value, type):
            return {"class": type(value).__qualname__, **_settings(value, depth)}
        case _:
            return type(value).__qualname__


def _hash(array: npt.NDArray[Any]) -> str:
    return sha256_of(repr(array.tolist()).encode() if array.dtype.hasobject else np.ascontiguousarray(array))
