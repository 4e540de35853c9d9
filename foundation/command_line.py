"""What all commands take: -h, --version, -v and -q, and shell completion; in one style of help.

Log records go to stderr, warnings and above unless asked otherwise. ``-v`` adds what is done (``INFO``), ``-vv`` every
exchange with a device (``DEBUG``), and ``-q`` leaves errors alone: no warnings and no progress bars.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer

_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
"""Of a log record on stderr, with the time to the millisecond: answers of devices are matched with what was asked."""


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"croplab {version('croplab')}")
        raise typer.Exit


def _tell_more(times: int) -> None:
    if times:
        _log_from(logging.INFO if times == 1 else logging.DEBUG)


def _tell_errors(asked: bool) -> None:
    if asked:
        _log_from(logging.ERROR)


def _log_from(level: int) -> None:
    root, handler = logging.getLogger(), logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter(_FORMAT))
    root.addHandler(handler)
    root.setLevel(level)


Version = Annotated[
    bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
]
"""The option ``--version``."""

Verbose = Annotated[
    int,
    typer.Option(
        "-v", "--verbose", count=True, callback=_tell_more, show_default=False, metavar="",
        help="Tell on stderr what is done; -vv each exchange with a device too.",
    ),
]  # fmt: skip
"""The option ``-v``."""

Quiet = Annotated[
    bool, typer.Option("-q", "--quiet", callback=_tell_errors, help="No progress bars and no warnings: errors alone.")
]
"""The option ``-q``."""

_COMMON = re.compile(r"-v+|-q|--verbose|--quiet")


def is_common(word: str) -> bool:
    """Return whether an argument is one of those that stand before the command."""
    return _COMMON.fullmatch(word) is not None


def new_app(help_text: str | None = None, **more: Any) -> typer.Typer:
    """Return an app in the style of all commands.

    Parameters
    ----------
    help_text
        What ``--help`` says of it; that of its only command if None.
    more
        Further arguments of `typer.Typer`.
    """
    return typer.Typer(
        help=help_text,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        **more,
    )


def common_first(argv: Sequence[str] | None) -> list[str]:
    """Return arguments, the process's own if None, with ``-v`` and ``-q`` before the command that they follow.

    A command with others below it takes them before these alone; users write them anywhere. What stands behind ``--``
    is left where it is.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    end = given.index("--") if "--" in given else len(given)
    common = [word for word in given[:end] if is_common(word)]
    return [*common, *(word for word in given[:end] if not is_common(word)), *given[end:]]


@contextmanager
def logging_as_before() -> Generator[None]:
    """Leave logging as it was found: a program may call several commands, each with options of its own."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    try:
        yield
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers


def shows_progress() -> bool:
    """Return whether progress is shown: it is not where errors alone are wanted."""
    return logging.getLogger().isEnabledFor(logging.WARNING)
