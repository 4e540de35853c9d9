"""Manual pages of the five commands from their help: `python -m docs.manpages` writes docs/man/*.1.

The wheel installs them in share/man/man1, where `man` finds them next to the bin folder of an environment. A test
compares the files with the help. Source of the macros: groff_man(7).
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
    """Return the text of every page by file."""
    scripts: dict[str, str] = PROJECT["scripts"]
    return {FOLDER / f"{name}.1": page(name, _command_of(name), sorted(scripts)) for name in scripts}


def page(name: str, command: Any, names: list[str]) -> str:
    """Return the page of a typer command; `names` of all commands are listed at its end."""
    first, *paragraphs = _paragraphs(command)
    sections = [
        f'.TH {_dashed(name).upper()} 1 "" "croplab {PROJECT["version"]}" "CroP"\n',
        f".SH NAME\n{_dashed(name)} \\- {_text(first.rstrip('.'))}\n",
        f".SH SYNOPSIS\n{_synopsis((name,), command)}",
        ".SH DESCRIPTION\n" + "".join(f".PP\n{_text(text)}\n" for text in (first, *paragraphs)),
        ".SH OPTIONS\n" + _parameters(command),
    ]
    subcommands = list(_subcommands((name,), command))
    if subcommands:
        sections.append(".SH COMMANDS\n")
        for words, subcommand in subcommands:
            texts = "".join(
                f".PP\n{_text(text)}\n" for text in _paragraphs(subcommand) if not text.startswith("Exit codes")
            )
            sections.append(
                f".SS {_text(' '.join(words))}\n{_synopsis(words, subcommand)}{texts}{_parameters(subcommand, COMMON)}"
            )
    sections.append('.SH "SEE ALSO"\n' + ",\n".join(f".BR {_dashed(other)} (1)" for other in names if other != name))
    return "".join(sections).replace(",\n.BR", "\n.BR") + "\n"


def _command_of(name: str) -> Any:
    return get_command(import_module(COMMANDS[name]).app)


def _subcommands(words: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the subcommands at any depth, with their words."""
    for name, subcommand in getattr(command, "commands", {}).items():
        if not hasattr(subcommand, "commands"):
            yield (*words, name), subcommand
        yield from _subcommands((*words, name), subcommand)


def _paragraphs(command: Any) -> list[str]:
    text = "\n\n".join(filter(None, (command.help, command.epilog)))
    return [" ".join(paragraph.split()) for paragraph in text.split("\n\n") if paragraph.strip()]


def _synopsis(words: tuple[str, ...], command: Any) -> str:
    lines = [f".B {_text(' '.join(words))}\n", "[\\fIoptions\\fR]\n"]
    has_arguments = any(parameter.param_type_name == "argument" for parameter in command.params)
    if hasattr(command, "commands") and not has_arguments:
        lines.append("\\fIcommand\\fR \\&...\n")
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            argument = f"\\fI{_text(_name_of(parameter))}\\fR" + (" \\&..." if parameter.nargs == -1 else "")
            lines.append(f"{argument}\n" if parameter.required else f"[{argument}]\n")
    return "".join(lines)


def _parameters(command: Any, without: Collection[str] = ()) -> str:
    """Return arguments and options with their help, except those in `without`."""
    entries: list[str] = []
    for parameter in command.params:
        if parameter.name in without:
            continue
        help_text = _text(" ".join((getattr(parameter, "help", None) or "").replace("\\[", "[").split()))
        if parameter.param_type_name == "argument":
            entries.append(f".TP\n\\fI{_text(_name_of(parameter))}\\fR\n{help_text}\n")
            continue
        if parameter.name in _COMPLETION and entries:
            help_text = help_text.rstrip(".") + "."
        names = ", ".join(f"\\fB{_text(name)}\\fR" for name in (*parameter.opts, *parameter.secondary_opts))
        value = parameter.metavar or ("" if parameter.metavar == "" else _choices(parameter))
        signature = f"{names} \\fI{_text(value)}\\fR" if value else names
        entries.append(f".TP\n{signature}\n{help_text}{_default(parameter, help_text)}\n")
    return "".join(entries)


def _name_of(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _choices(parameter: Any) -> str:
    """Return the allowed values of an option, if they are listed."""
    descriptor = getattr(parameter, "type_descriptor", None)
    choices = getattr(descriptor, "choices", None) or getattr(getattr(parameter, "type", None), "choices", None)
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
    """Escape a text for groff, in ASCII; no line becomes a request."""
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
