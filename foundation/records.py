"""Typed, frozen records that are written to JSON or TOML files and read again, with checks by pydantic.

The fields of a record are the keys of its file. Files of later versions may have more keys. Files of earlier versions
may have fewer keys, so a new field needs a default. The file holds arrays as lists, and NaN and infinity as null.
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
    return _replace_non_finite(values.tolist())


def _replace_non_finite(value: Any) -> Any:
    # JSON has no NaN and no infinite numbers.
    if isinstance(value, list):
        return [_replace_non_finite(item) for item in cast("list[Any]", value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _as_floats(value: Any) -> npt.NDArray[np.float64]:
    return np.asarray(value, dtype=np.float64)


# Type of a field that is a float64 array of any shape. The file holds nested lists, with null for NaN.
FloatArray = Annotated[npt.NDArray[np.float64], PlainValidator(_as_floats), PlainSerializer(_as_lists)]


class Record(BaseModel):
    """Frozen record; unknown keys in a file are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True, use_attribute_docstrings=True)


@cache
def _adapter(record_type: Any) -> TypeAdapter[Any]:
    return TypeAdapter(record_type)


def to_plain(record: Any, record_type: Any = None) -> Any:
    """Convert a record, or a dataclass with typed fields, to dictionaries, lists and numbers for JSON.

    `record_type` is needed if the class of the object does not define the types of its items, as in `tuple[Frame,
    ...]`.
    """
    return _adapter(record_type or cast("Any", type(record))).dump_python(record, mode="json")


def from_plain(record_type: type[T], value: Any, about: object, remedy: str) -> T:
    """Make a record or a dataclass from the objects of a JSON or TOML file; a wrong key raises a FormatError.

    The message of the error starts with `about` (the file) and ends with `remedy`.
    """
    try:
        return _adapter(record_type).validate_python(value)
    except ValidationError as error:
        raise damaged_error(error, about, remedy) from error


def from_json(record_type: type[T], text: bytes | str, about: object, remedy: str) -> T:
    """Make a record or a dataclass from the text of a JSON file; see `from_plain`."""
    try:
        return _adapter(record_type).validate_json(text)
    except ValidationError as error:
        raise damaged_error(error, about, remedy) from error


def damaged_error(error: ValidationError, about: object, remedy: str) -> FormatError:
    """Return the error for a file that pydantic refused, with the first wrong key, its value and the reason."""
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
    """Return the tables of a TOML text; messages name it `where`."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(
            f"{where} is not TOML: {error}; correct that line: texts need quotation marks"
        ) from error


def list_mistakes(mistakes: Collection[str]) -> str:
    """Return mistakes as the end of a message: a space and one mistake, or their number and a line for each of them."""
    lines = "".join(f"\n  {mistake}" for mistake in mistakes)
    return f" {next(iter(mistakes))}" if len(mistakes) == 1 else f" {len(mistakes)} mistakes:{lines}"


def find_mistakes(
    model: type[BaseModel],
    document: Mapping[str, Any],
    error: ValidationError,
    is_secret: Callable[[str], bool] = lambda key: False,
    hidden_choice: str = "",
) -> list[str]:
    """Return one text for each mistake in a settings file, with the key, the value found and the value expected.

    `is_secret(key)` returns whether the value of a key must be masked. `hidden_choice` is an allowed value that no
    message lists.
    """
    errors = error.errors()
    unknown = [detail["loc"] for detail in errors if detail["type"] == "extra_forbidden"]
    mistakes: dict[str, str] = {}
    for detail in errors:
        location, table = detail["loc"], _table_at(model, detail["loc"][:-1])
        key, value = _file_key(location, document), detail["input"]
        if detail["type"] == "extra_forbidden" and table is not None:
            mistakes[key] = unknown_key(key, table.model_fields)
        elif detail["type"] == "missing" and table is not None:
            # If a key is misspelt, the correct key is not reported as missing.
            questions = (
                nearest_names(str(loc[-1]), table.model_fields) for loc in unknown if loc[:-1] == location[:-1]
            )
            if f"did you mean {location[-1]!r}?" not in questions:
                mistakes[key] = _missing(key, _table_at(model, location))
        else:
            expected = _expectation(key, detail, is_secret(key), hidden_choice)
            # A whole table is too long for a message.
            value_text = "" if isinstance(value, dict) else f" = {MASK if is_secret(key) else repr(value)}"
            prefix = f"{key}{value_text}: " if key else ""
            # A value that may have several types has an error for each type.
            mistakes[key] = (
                f"{mistakes[key]}, or {expected.removeprefix('expected ')}"
                if key in mistakes
                else f"{prefix}{expected}"
            )
    return list(mistakes.values())


def _file_key(location: tuple[int | str, ...], document: Any) -> str:
    # Leave out components that pydantic adds: an index for a single value that is read as a list, the type for a field
    # with several types, and "[key]" for a wrong key.
    components: list[str] = []
    for component in location:
        if component == "[key]" or not isinstance(document, list if isinstance(component, int) else dict):
            break
        components.append(str(component))
        # After a missing key, the loop ends at the next component.
        document = cast("Any", document)[component] if isinstance(component, int) or component in document else None
    return ".".join(components)


def _missing(key: str, table: type[BaseModel] | None) -> str:
    if table is None:
        return f"{key} is missing; add it"
    required = [name for name, field in table.model_fields.items() if field.is_required()]
    optional = [name for name in table.model_fields if name not in required]
    option_text = f" (optional: {', '.join(optional)})" if optional else ""
    return f"the table [{key}] is missing; add it, with {', '.join(required) or 'at least one key'}{option_text}"


def _expectation(key: str, error: ErrorDetails, is_secret: bool = False, hidden_choice: str = "") -> str:
    """Describe the expected value of a key without the terms of pydantic."""
    value, limits = error["input"], error.get("ctx", {})
    match error["type"]:
        case "literal_error" | "enum":
            choices = [name for name in re.findall(r"'([^']+)'", error["msg"]) if name != hidden_choice]
            return f"expected one of {', '.join(map(repr, choices))}" if choices else error["msg"]
        case "tuple_type" | "list_type":
            if isinstance(value, dict):
                return f"expected a list of tables: write [[{key}]]"
            example = f": [{json.dumps(value, ensure_ascii=False)}]" if isinstance(value, str) and not is_secret else ""
            return f"expected a list, in square brackets{example}"
        case "float_parsing" | "float_type" | "int_parsing" | "int_type" | "int_from_float":
            noun = "a whole number" if error["type"].startswith("int") else "a number"
            unit = " of seconds" if key.endswith("_s") else ""
            is_number = isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d+)?", value) and not is_secret
            return f"expected {noun}{unit}{f', without quotation marks: {value}' if is_number else ''}"
        case "bool_parsing" | "bool_type":
            return "expected true or false, without quotation marks"
        case "string_type" | "path_type":
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            example = f': "{MASK if is_secret else value}"' if is_number else ""
            return f"expected a text, in quotation marks{example}"
        case "model_type" | "dict_type":
            return f"expected a table, as in {key.rsplit('.', 1)[-1]} = {{ … }} or [{key}]"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal":
            ((bound, limit),) = limits.items()
            return f"expected a number {_BOUNDS[bound]} {limit:g}"
        case "too_short" | "string_too_short":
            return f"expected at least {_length(value, limits['min_length'])}"
        case "too_long" | "string_too_long":
            return f"expected at most {_length(value, limits['max_length'])}"
        case _:
            return error["msg"].removeprefix("Value error, ")


# Words for a lower or upper limit of a number. The keys are the names of these limits in pydantic.
_BOUNDS: Final = {"gt": "above", "ge": "of at least", "lt": "below", "le": "of at most"}


def _length(value: Any, limit: int) -> str:
    return counted(limit, "character" if isinstance(value, str) else "value")


def _table_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel] | None:
    """Return the model of the table at a location (keys and list indices); None if no table is there."""
    for component in location:
        if isinstance(component, int):
            continue
        annotation = model.model_fields[component].annotation
        options = [option for option in (annotation, *getattr(annotation, "__args__", ())) if isinstance(option, type)]
        table = next((option for option in options if issubclass(option, BaseModel)), None)
        if table is None:
            return None
        model = table
    return model


def unknown_key(key: str, known_keys: Iterable[str]) -> str:
    """Return a message about an unknown key that suggests the most similar known key or lists all known keys."""
    names = sorted(known_keys)
    hint = nearest_names(key.rsplit(".", 1)[-1], names)
    return f"unknown key {key!r}; {hint}" if hint else f"unknown key {key!r}, expected one of {', '.join(names)}"


def from_settings(
    record_type: type[T], values: Mapping[str, Any], where: str, key: str, known_names: Collection[str], **fixed: Any
) -> T:
    """Make a dataclass from the `values` that a user set and the `fixed` values of the other fields.

    The user may set only the fields in `known_names`. The message of a ConfigurationError contains the file (`where`)
    and the table (`key`).
    """
    for name in values:
        if name not in known_names:
            raise ConfigurationError(f"{where}: {unknown_key(f'{key}.{name}', known_names)}")
    try:
        return _adapter(record_type).validate_python({**fixed, **values})
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join([key, *(str(component) for component in first["loc"][:1])])
        raise ConfigurationError(f"{where}: {path} = {first['input']!r}: {_expectation(path, first)}") from error
