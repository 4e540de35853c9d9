"""What is written as JSON or TOML and read again: typed, frozen records, made and checked by pydantic.

A record's fields are the file's keys. Files of later versions may have more keys, those of earlier ones fewer: what was
added has a default. Arrays are lists in the file, numbers that are not finite are null.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from pydantic import (
    BaseModel,
    ConfigDict,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    ValidationError,
)

from foundation.errors import ConfigurationError, FormatError, nearest_names

T = TypeVar("T")


def _as_lists(values: npt.NDArray[Any]) -> Any:
    return _finite(values.tolist())


def _finite(value: Any) -> Any:
    """Return lists and numbers with None in place of what JSON cannot say."""
    if isinstance(value, list):
        return [_finite(item) for item in cast("list[Any]", value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _as_floats(value: Any) -> npt.NDArray[np.float64]:
    return np.asarray(value, dtype=np.float64)


FloatArray = Annotated[npt.NDArray[np.float64], PlainValidator(_as_floats), PlainSerializer(_as_lists)]
"""A float64 array of any shape as nested lists; NaN is null in the file."""


class Record(BaseModel):
    """A frozen record; a key that is not known is passed over, as later versions may have more."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True, use_attribute_docstrings=True)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def to_plain(record: Any, kind: Any = None) -> Any:
    """Return a record, or a dataclass with typed fields, as JSON's objects, lists and numbers.

    `kind` is its type, where it is not that of the object alone (`tuple[Frame, ...]`).
    """
    return _adapter(kind or cast("Any", type(record))).dump_python(record, mode="json")


def from_plain(kind: type[T], value: Any, about: object, remedy: str) -> T:
    """Return the record of a type, or a dataclass, from JSON or TOML objects; a FormatError says which key is wrong.

    `about`: the file; `remedy`: what helps.
    """
    try:
        return _adapter(kind).validate_python(value)
    except ValidationError as error:
        raise damaged(error, about, remedy) from error


def from_json(kind: type[T], text: bytes | str, about: object, remedy: str) -> T:
    """Return the record of a type, or a dataclass, from the text of a JSON file; errors as of `from_plain`."""
    try:
        return _adapter(kind).validate_json(text)
    except ValidationError as error:
        raise damaged(error, about, remedy) from error


def damaged(error: ValidationError, about: object, remedy: str) -> FormatError:
    """Return what to tell a user of a file that pydantic refused: the first key that is wrong, its value, and why."""
    first = error.errors(include_url=False)[0]
    key = ".".join(map(str, first["loc"]))
    reason = first["msg"].removeprefix("Value error, ")
    return FormatError(
        f"damaged: {f'{key}: ' if key else ''}{reason}",
        about=about,
        remedy=remedy,
        value=first["input"],
        expected=reason,
    )


def known_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> Iterable[str]:
    """Return the keys of the table that lies at a location of a model: names of tables, and places in lists."""
    for part in location:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        options = [option for option in (annotation, *getattr(annotation, "__args__", ())) if isinstance(option, type)]
        model = next(option for option in options if issubclass(option, BaseModel))
    return model.model_fields


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Return that a key is unknown, and the nearest one that is known."""
    names = sorted(known)
    hint = nearest_names(key.rsplit(".", 1)[-1], names) or f"known are {', '.join(names)}"
    return f"unknown key {key!r}; {hint}"


def from_settings(
    kind: type[T], given: Mapping[str, Any], where: str, key: str, known: Collection[str], **fixed: Any
) -> T:
    """Return a dataclass of what a user gives for some of its fields; a ConfigurationError says what cannot be used.

    `given`: by names that are `known`, of the table `key` of a file, or a command line, `where`. `fixed`: other fields.
    """
    for name in given:
        if name not in known:
            raise ConfigurationError(f"{where}: {unknown_key(f'{key}.{name}', known)}")
    try:
        return _adapter(kind).validate_python({**fixed, **given})
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join([key, *(str(part) for part in first["loc"][:1])])
        raise ConfigurationError(f"{where}: {at}: {first['msg']}, got {first['input']!r}") from error
