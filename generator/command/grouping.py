"""Options of a command in groups: frozen dataclasses whose fields are annotated as typer's parameters are."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, get_type_hints

import typer


def grouped(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for typer with one parameter for each field of the groups that `function` takes.

    `function`: each of its parameters is annotated with a frozen dataclass, whose fields are ``Annotated`` with typer's
    ``Option`` or ``Argument`` and have defaults. No two groups share a field's name.
    """
    groups = {name: hint for name, hint in get_type_hints(function).items() if name != "return"}
    parameters: dict[str, inspect.Parameter] = {}
    members: dict[str, list[str]] = {}
    for name, group in groups.items():
        hints = get_type_hints(group, include_extras=True)
        members[name] = [field.name for field in dataclasses.fields(group)]
        for field in dataclasses.fields(group):
            if field.name in parameters:
                raise TypeError(f"two groups of options have a field {field.name}; rename one of them")
            parameters[field.name] = inspect.Parameter(
                field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
            )

    @functools.wraps(function)
    def command(**options: Any) -> None:
        function(**{name: groups[name](**{field: options[field] for field in members[name]}) for name in groups})

    command.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
    command.__annotations__ = {name: parameter.annotation for name, parameter in parameters.items()}
    return command


def option(metavar: str | None, text: str, panel: str, **more: Any) -> Any:
    """Return typer's option with its help; a default of None is not shown, since the help says what it means."""
    return typer.Option(metavar=metavar, help=text, rich_help_panel=panel, **more)
