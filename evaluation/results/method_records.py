"""Records of methods for a results folder: class, settings and source file.

Two runs used the same method if its records are equal, so a record must not depend on the process. Data that a class
reads from files, such as the weights of a network, are recorded only if the object holds them as an array.
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

# Deepest level of nested values that is recorded. Settings are flat, and objects may refer to each other in a cycle.
_MAX_DEPTH = 6


def describe_method(method: object) -> dict[str, Any]:
    """Return a JSON object with name, class and settings of a method, and the file of a class outside this suite.

    Examples
    --------
    >>> from evaluation.methods.standard import standard_methods
    >>> record = describe_method(standard_methods()["white-patch"])
    >>> record["name"], record["class"], record["settings"]["p"]
    ('White-Patch', 'evaluation.methods.gray_edge:GrayEdge', 'inf')
    """
    if isinstance(method, GivenEstimates):
        return {"name": method.name, "estimates": {"file": method.file, "sha256": method.sha256}}
    method_class = type(method)
    class_name = f"{method_class.__module__}:{method_class.__qualname__}"
    record: dict[str, Any] = {"name": getattr(method, "name", ""), "class": class_name}
    settings = _settings(method, 0)
    settings.pop("name", None)
    if settings:
        record["settings"] = settings
    if not method_class.__module__.startswith("evaluation."):
        # The module name of a loaded file is made from its whole path; the file name is clearer.
        record |= _source_file(method_class)
    return record


def _source_file(method_class: type) -> dict[str, Any]:
    try:
        path = Path(inspect.getfile(method_class)).resolve()
        return {"class": f"{path.name}:{method_class.__qualname__}", "file_sha256": file_sha256(path)}
    except (OSError, TypeError):
        return {}


def _settings(instance: object, depth: int) -> dict[str, Any]:
    if is_dataclass(instance):
        return {item.name: _value(getattr(instance, item.name), depth + 1) for item in fields(instance)}
    return {name: _value(value, depth + 1) for name, value in sorted(getattr(instance, "__dict__", {}).items())}


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
        case _ if depth >= _MAX_DEPTH:
            return type(value).__qualname__
        case Mapping():
            return {str(key): _value(item, depth + 1) for key, item in cast("Mapping[Any, Any]", value).items()}
        case bytes():
            return {"bytes": len(value), "sha256": sha256_of(value)}
        case Sequence():
            return [_value(item, depth + 1) for item in cast("Sequence[Any]", value)]
        case _ if is_dataclass(value) and not isinstance(value, type):
            return {"class": type(value).__qualname__, **_settings(value, depth)}
        case _:
            return type(value).__qualname__


def _hash(array: npt.NDArray[Any]) -> str:
    return sha256_of(repr(array.tolist()).encode() if array.dtype.hasobject else np.ascontiguousarray(array))
