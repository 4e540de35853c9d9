"""The command `evaluate`: evaluate methods on data sets, and repeat the experiments of the paper."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from evaluation.commands import compare as compare_command
from evaluation.commands import cv as cv_command
from evaluation.commands import paper as paper_command
from evaluation.commands import run as run_command
from evaluation.commands import train as train_command
from evaluation.commands import transfer as transfer_command
from evaluation.commands import tune as tune_command
from foundation.console import EXIT_CODES, is_common_option, new_app, run

if TYPE_CHECKING:
    from collections.abc import Sequence

app = new_app(
    f"""Evaluate methods of illumination estimation.

`evaluate DATA` is short for `evaluate run DATA`.

{EXIT_CODES}
"""
)
app.command("run", help=run_command.HELP)(run_command.run)
app.add_typer(paper_command.app, name="paper", help=paper_command.HELP)
app.command("compare", help=compare_command.HELP)(compare_command.compare)
app.command("train", help=train_command.HELP)(train_command.train)
app.command("cv", help=cv_command.HELP)(cv_command.cv)
app.command("transfer", help=transfer_command.HELP)(transfer_command.transfer)
app.command("tune", help=tune_command.HELP)(tune_command.tune)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with `argv`, by default the arguments of the process; return an exit code (`EXIT_CODES`)."""
    arguments = _with_command(sys.argv[1:] if argv is None else argv)
    return run(lambda: app(arguments, prog_name="evaluate"), is_resumable=False)


def _with_command(arguments: Sequence[str]) -> list[str]:
    # Options that all commands share may precede the name of the command.
    commands = {command.name for command in app.registered_commands} | {group.name for group in app.registered_groups}
    app_options = ("-h", "--help", "--version", "--install-completion", "--show-completion")
    index = next((index for index, word in enumerate(arguments) if not is_common_option(word)), len(arguments))
    is_shortened = index < len(arguments) and arguments[index] not in (*commands, *app_options)
    return [*arguments[:index], *(["run"] if is_shortened else []), *arguments[index:]]


if __name__ == "__main__":
    raise SystemExit(main())
