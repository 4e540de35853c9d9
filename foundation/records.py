"""What is written as JSON or TOML and read again: typed, frozen records, made and checked by pydantic.

A record's fields are the file's keys. Files of later versions may have more keys, those of earlier ones fewer: what was
added has a default. Arrays are lists in the file, numbers that are not finite are null.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar, cast

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

from foundation.errors import ConfigurationError, FormatError, counted, nearest_names
from foundation.secret_texts import MASK

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

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


# A float64 array of any shape as nested lists; NaN is null in the file.
FloatArray = Annotated[npt.NDArray[np.float64], PlainValidator(_as_floats), PlainSerializer(_as_lists)]


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


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Return the tables of a TOML text; `where` names it in errors."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"{where} is not TOML: {error}; correct that line: a text stands in quotation marks"
        ) from error


def list_mistakes(found: Collection[str]) -> str:
    """Return one mistake after a space, several on lines of their own."""
    lines = "".join(f"\n  {mistake}" for mistake in found)
    return f" {next(iter(found))}" if len(found) == 1 else f" {len(found)} mistakes:{lines}"


def find_mistakes(
    model: type[BaseModel],
    document: Mapping[str, Any],
    error: ValidationError,
    is_secret: Callable[[str], bool] = lambda key: False,
    not_to_choose: str = "",
) -> list[str]:
    """Return each mistake in a settings file: key, value and what was expected.

    `is_secret`: whether the value of a key is masked. `not_to_choose`: a word that is not named among the known ones.
    """
    errors = error.errors()
    unknown = [one["loc"] for one in errors if one["type"] == "extra_forbidden"]
    found: dict[str, str] = {}
    for one in errors:
        place, table = one["loc"], _table_at(model, one["loc"][:-1])
        key, value = _key_of(place, document), one["input"]
        if one["type"] == "extra_forbidden" and table is not None:
            found[key] = unknown_key(key, table.model_fields)
        elif one["type"] == "missing" and table is not None:
            # A key that is misspelt is not missing as well.
            near = (nearest_names(str(other[-1]), table.model_fields) for other in unknown if other[:-1] == place[:-1])
            if f"did you mean {place[-1]!r}?" not in near:
                found[key] = _missing(key, _table_at(model, place))
        else:
            expected = _expectation(key, one, is_secret(key), not_to_choose)
            # A whole table is too long for a message.
            shown = "" if isinstance(value, dict) else f" = {MASK if is_secret(key) else repr(value)}"
            begin = f"{key}{shown}: " if key else ""
            # A value that may be of several types has an error for each of them.
            found[key] = f"{found[key]}, or {expected}" if key in found else f"{begin}{expected}"
    return list(found.values())


def _key_of(place: tuple[int | str, ...], document: Any) -> str:
    """Return the key as it is in the file, without what pydantic adds.

    It adds a number if a single value is read as a list, the type if there are several, and "[key]" if the key of a
    table is wrong.
    """
    parts: list[str] = []
    for part in place:
        if part == "[key]" or not isinstance(document, list if isinstance(part, int) else dict):
            break
        parts.append(str(part))
        # A key that is missing ends the place.
        document = cast("Any", document)[part] if isinstance(part, int) or part in document else None
    return ".".join(parts)


def _missing(key: str, table: type[BaseModel] | None) -> str:
    if table is None:
        return f"{key} is missing; add it"
    needed = [name for name, field in table.model_fields.items() if field.is_required()]
    others = [name for name in table.model_fields if name not in needed]
    may = f"; it may also have {', '.join(others)}" if others else ""
    return f"the table [{key}] is missing; add it, with {', '.join(needed) or 'at least one key'}{may}"


def _expectation(key: str, error: ErrorDetails, secret: bool = False, not_to_choose: str = "") -> str:
    """Return what was expected of a key's value, in place of pydantic's words."""
    value, limits = error["input"], error.get("ctx", {})
    match error["type"]:
        case "literal_error" | "enum":
            known = [name for name in re.findall(r"'([^']+)'", error["msg"]) if name != not_to_choose]
            return f"expected one of {', '.join(map(repr, known))}" if known else error["msg"]
        case "tuple_type" | "list_type":
            if isinstance(value, dict):
                return f"a list of tables was expected: write [[{key}]]"
            meant = f": [{json.dumps(value, ensure_ascii=False)}]" if isinstance(value, str) and not secret else ""
            return f"a list was expected, in square brackets{meant}"
        case "float_parsing" | "float_type" | "int_parsing" | "int_type" | "int_from_float":
            what = "a whole number" if error["type"].startswith("int") else "a number"
            unit = " of seconds" if key.endswith("_s") else ""
            is_number = isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d+)?", value) and not secret
            return f"{what}{unit} was expected{f', without quotation marks: {value}' if is_number else ''}"
        case "bool_parsing" | "bool_type":
            return "true or false was expected, without quotation marks"
        case "string_type" | "path_type":
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            meant = f': "{MASK if secret else value}"' if is_number else ""
            return f"a text was expected, in quotation marks{meant}"
        case "model_type" | "dict_type":
            return f"a table was expected, as in {key.rsplit('.', 1)[-1]} = {{ … }} or [{key}]"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal":
            ((bound, limit),) = limits.items()
            return f"a number {_BOUNDS[bound]} {limit:g} was expected"
        case "too_short" | "string_too_short":
            return f"at least {_length(value, limits['min_length'])} expected"
        case "too_long" | "string_too_long":
            return f"at most {_length(value, limits['max_length'])} expected"
        case _:
            return error["msg"].removeprefix("Value error, ")


# What a number is to be, by the name of its bound in an error of pydantic.
_BOUNDS: Final = {"gt": "above", "ge": "of at least", "lt": "below", "le": "of at most"}


def _length(value: Any, limit: int) -> str:
    unit = "character" if isinstance(value, str) else "value"
    return counted(limit, f"{unit} was", f"{unit}s were")


def _table_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel] | None:
    """Return the table at a location of a model: names of keys, and places in lists; None if no table is there."""
    for part in location:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        options = [option for option in (annotation, *getattr(annotation, "__args__", ())) if isinstance(option, type)]
        table = next((option for option in options if issubclass(option, BaseModel)), None)
        if table is None:
            return None
        model = table
    return model


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
        raise ConfigurationError(f"{where}: {at}: {_expectation(at, first)}, got {first['input']!r}") from error
