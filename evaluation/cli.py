"""The command `evaluate`: methods on data sets, and the paper's experiments."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from evaluation.commands import compare as compare_command
from evaluation.commands import cv as cv_command
from evaluation.commands import describe as describe_command
from evaluation.commands import paper as paper_command
from evaluation.commands import pool as pool_command
from evaluation.commands import run as run_command
from evaluation.commands import train as train_command
from evaluation.commands import transfer as transfer_command
from evaluation.commands import tune as tune_command
from foundation.console import EXIT_CODES, is_common, new_app, run
from foundation.errors import InputError

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
app.command("describe", help=describe_command.HELP)(describe_command.describe)
app.command("transfer", help=transfer_command.HELP)(transfer_command.transfer)
app.command("pool", help=pool_command.HELP)(pool_command.pool)
app.command("tune", help=tune_command.HELP)(tune_command.tune)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with `argv`, by default the process's own, and return one of `foundation.console.EXIT_CODES`."""
    whole = _with_command(sys.argv[1:] if argv is None else argv)

    def evaluate_words() -> None:
        name, *words = [word for word in whole if not is_common(word)] or [""]
        _require_methods_in_place(name, words)
        app(whole, prog_name="evaluate")

    return run(evaluate_words, keeps=_keeps(whole))


def _require_methods_in_place(command: str, words: Sequence[str]) -> None:
    """Refuse `cv --method METHOD` and `run METHOD DATA`, each of which is how the other is written, and `--model`."""
    for word, behind in pairwise([*words, "MODEL.npz"]):
        name, _, value = word.partition("=")
        if name == "--model":
            model = value or behind
            right = f"evaluate run DATA --method {model}"
            right += f", or evaluate train METHOD DATA --adapt {model}" if command == "train" else ""
            raise InputError(f"there is no --model: a model that evaluate train has made is a method: {right}")
    if command in ("cv", "train"):
        for word, behind in pairwise([*words, "METHOD"]):
            name, _, value = word.partition("=")
            if name in ("--method", "--methods"):
                right = f"evaluate {command} {value or behind} DATA"
                raise InputError(f"evaluate {command} takes METHOD and DATA in this order, without {name}: {right}")
    if command == "run" and len(words) > 1 and not any(word.startswith("-") for word in words[:2]):
        from evaluation.learning.standard import standard_learners

        data, method = words[:2]
        if data in standard_learners() or (Path(method).exists() and not Path(data).exists()):
            data, method = method, data
        right = f"evaluate run {data} --method {method}"
        if method in standard_learners():
            right = f"evaluate cv {method} {data}, or evaluate train {method} {data} --out MODEL.npz; it learns first"
        raise InputError(f"evaluate run takes one data set, and methods behind --method: {right}")


def _with_command(given: Sequence[str]) -> list[str]:
    """Return the arguments with the command that the short form leaves out."""
    commands = {command.name for command in app.registered_commands} | {group.name for group in app.registered_groups}
    own = ("-h", "--help", "--version", "--install-completion", "--show-completion")
    first = next((at for at, word in enumerate(given) if not is_common(word)), len(given))
    short = first < len(given) and given[first] not in commands and given[first] not in own
    return [*given[:first], *(["run"] if short else []), *given[first:]]


def _keeps(given: Sequence[str]) -> bool:
    """Whether an interrupted command goes on where it was: `run` does with a results folder, which has a journal."""
    command = next((word for word in given if not is_common(word)), "")
    return command == "run" and any(text == "--out" or text.startswith("--out=") for text in given)


if __name__ == "__main__":
    raise SystemExit(main())
