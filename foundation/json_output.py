"""What a command found as one JSON object on standard output, for programs: ``--json`` of every command with figures.

Nothing else stands there then: what the command prints for a reader goes to standard error. `docs/reference/json.md`
says which keys each command has; later versions add keys and keep those that there are. Numbers that are not known,
or not finite, are null.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import Annotated, Any, TextIO, cast, get_type_hints

import typer

from foundation.errors import CropError

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object, for programs; all else goes to stderr.")]
"""The option ``--json``."""


class JsonOutput:
    """Figures of a command, gathered for the object that is printed at its end."""

    def __init__(self, command: str, asked: bool) -> None:
        self.asked = asked
        self._command = command
        self._values: dict[str, Any] = {}

    def add(self, **values: Any) -> None:
        """Add values; any that `plain` takes."""
        self._values.update(values)

    def append(self, key: str, value: Any) -> None:
        """Add a value to the end of the list `key`, which is begun where it is not there."""
        self._values.setdefault(key, []).append(value)

    def write(self, stream: TextIO) -> None:
        """Print the object, if there is anything in it."""
        if self._values:
            whole = plain({"command": self._command, **self._values})
            print(json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False), file=stream)


@contextmanager
def json_output(command: str, asked: bool) -> Generator[JsonOutput]:
    """Gather figures in the block, and print them at its end if asked; what the block prints is for a reader.

    What was gathered is printed also where data are not good enough or something else ends the command: the exit code
    says so, and standard error why.
    """
    output = JsonOutput(command, asked)
    if not asked:
        yield output
        return
    stdout = sys.stdout
    with redirect_stdout(sys.stderr):
        try:
            yield output
        except CropError:
            output.write(stdout)
            raise
    output.write(stdout)


def with_json(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator of a typer command whose parameter `told: JsonOutput` is replaced by the option ``--json``."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(function)
        if "told" not in signature.parameters:
            raise ValueError(f"{command} has no parameter 'told' to put the option in the place of")
        given = getattr(function, "__annotations__", {})
        hints = given if "__signature__" in vars(function) else get_type_hints(function, include_extras=True)
        option = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=AsJson)
        others = [
            parameter.replace(annotation=hints.get(name, Any))
            for name, parameter in signature.parameters.items()
            if name != "told"
        ]

        @functools.wraps(function)
        def with_option(*arguments: Any, as_json: bool = False, **named: Any) -> None:
            with json_output(command, as_json) as told:
                function(*arguments, **named, told=told)

        with_option.__signature__ = signature.replace(parameters=[*others, option])  # type: ignore[attr-defined]
        with_option.__annotations__ = {
            **{parameter.name: parameter.annotation for parameter in (*others, option)},
            "return": None,
        }
        return with_option

    return decorate


def plain(value: Any) -> Any:
    """Return a value as JSON has it: paths and other objects as text, numbers of numpy as numbers, no infinities.

    Examples
    --------
    >>> from pathlib import Path
    >>> plain({"place": Path("lut"), "angles": (0.5, float("nan"))})
    {'place': 'lut', 'angles': [0.5, None]}
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in cast("list[Any]", value)]
    listed: Callable[[], Any] | None = getattr(value, "tolist", None)
    return str(value) if listed is None else plain(listed())
