"""Manual pages of the five commands, made of their help: `python -m docs.manpages` writes docs/man/*.1.

The wheel has them under share/man/man1, where `man` finds them beside an environment's bin folder. A test holds the
files against the help. Source of the macros: groff_man(7).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from typer.main import get_command

from croplab import COMMANDS
from foundation.console import COMMON

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
FOLDER = ROOT / "docs" / "man"

_COMPLETION = ("install_completion", "show_completion")


def pages() -> dict[Path, str]:
    """Return every page by the file that it belongs into."""
    scripts: dict[str, str] = PROJECT["scripts"]
    return {FOLDER / f"{name}.1": page(name, _command_of(name), sorted(scripts)) for name in scripts}


def page(name: str, command: Any, names: list[str]) -> str:
    """Return the page of a command.

    Parameters
    ----------
    name
        What it is called by.
    command
        As typer makes it.
    names
        Of all commands, which are named at the end.
    """
    first, *others = _paragraphs(command)
    parts = [
        f'.TH {_dashed(name).upper()} 1 "" "croplab {PROJECT["version"]}" "CroP"\n',
        f".SH NAME\n{_dashed(name)} \\- {_text(first.rstrip('.'))}\n",
        f".SH SYNOPSIS\n{_synopsis((name,), command)}",
        ".SH DESCRIPTION\n" + "".join(f".PP\n{_text(text)}\n" for text in (first, *others)),
        ".SH OPTIONS\n" + _parameters(command),
    ]
    below = list(_below((name,), command))
    if below:
        parts.append(".SH COMMANDS\n")
        for words, found in below:
            texts = "".join(f".PP\n{_text(text)}\n" for text in _paragraphs(found) if not text.startswith("Exit codes"))
            parts.append(f".SS {_text(' '.join(words))}\n{_synopsis(words, found)}{texts}{_parameters(found, COMMON)}")
    parts.append('.SH "SEE ALSO"\n' + ",\n".join(f".BR {_dashed(other)} (1)" for other in names if other != name))
    return "".join(parts).replace(",\n.BR", "\n.BR") + "\n"


def _command_of(name: str) -> Any:
    return get_command(import_module(COMMANDS[name]).app)


def _below(words: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the commands below one, at any depth, with the words that call them."""
    for name, found in getattr(command, "commands", {}).items():
        if not hasattr(found, "commands"):
            yield (*words, name), found
        yield from _below((*words, name), found)


def _paragraphs(command: Any) -> list[str]:
    text = "\n\n".join(filter(None, (command.help, command.epilog)))
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n") if paragraph.strip()]


def _synopsis(words: tuple[str, ...], command: Any) -> str:
    """Return the line that shows how a command is called."""
    shown = [f".B {_text(' '.join(words))}\n", "[\\fIoptions\\fR]\n"]
    takes = any(parameter.param_type_name == "argument" for parameter in command.params)
    if hasattr(command, "commands") and not takes:
        shown.append("\\fIcommand\\fR \\&...\n")
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            named = f"\\fI{_text(_name_of(parameter))}\\fR" + (" \\&..." if parameter.nargs == -1 else "")
            shown.append(f"{named}\n" if parameter.required else f"[{named}]\n")
    return "".join(shown)


def _parameters(command: Any, without: Collection[str] = ()) -> str:
    """Return the arguments and options of a command, each with its help; `without` those that stand elsewhere."""
    parts: list[str] = []
    for parameter in command.params:
        if parameter.name in without:
            continue
        help_text = _text(" ".join((getattr(parameter, "help", None) or "").replace("\\[", "[").split()))
        if parameter.param_type_name == "argument":
            parts.append(f".TP\n\\fI{_text(_name_of(parameter))}\\fR\n{help_text}\n")
            continue
        if parameter.name in _COMPLETION and parts:
            help_text = help_text.rstrip(".") + "."
        names = ", ".join(f"\\fB{_text(name)}\\fR" for name in (*parameter.opts, *parameter.secondary_opts))
        value = parameter.metavar or ("" if parameter.metavar == "" else _choices(parameter))
        shown = f"{names} \\fI{_text(value)}\\fR" if value else names
        parts.append(f".TP\n{shown}\n{help_text}{_default(parameter, help_text)}\n")
    return "".join(parts)


def _name_of(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _choices(parameter: Any) -> str:
    """Return the values that an option takes, where it takes named ones."""
    described = getattr(parameter, "type_descriptor", None)
    choices = getattr(described, "choices", None) or getattr(getattr(parameter, "type", None), "choices", None)
    return "|".join(str(getattr(choice, "value", choice)) for choice in choices or ())


def _default(parameter: Any, help_text: str) -> str:
    value = parameter.default
    value = getattr(value, "value", value)
    if value is None or value in ("", False, (), []) or parameter.metavar == "" or "[default" in help_text:
        return ""
    return "" if callable(value) else f" [default: {_text(str(value))}]"


def _dashed(name: str) -> str:
    return name.replace("-", "\\-")


def _text(text: str) -> str:
    """Return a text for groff in ASCII: backslashes and hyphens as they are, no line that is taken for a request."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    escaped = re.sub(r"[^\x00-\x7f]", lambda match: f"\\[u{ord(match[0]):04X}]", escaped)
    return re.sub(r"^([.'])", r"\\&\1", escaped, flags=re.MULTILINE)


def write() -> None:
    """Write every page."""
    FOLDER.mkdir(exist_ok=True)
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    write()
