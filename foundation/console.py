"""The terminal's side of every command: errors become one sentence and an exit code, figures one JSON object.

Commands are thin: parse, build, call, print. `run` is the one place where an error turns into text.

Each command of an app takes -h, --version, -v and -q, in one style of help; `new_app` adds them, and a command's
signature has none of them. Log records go to stderr, warnings and above unless the options say otherwise. ``-v`` adds
each step (``INFO``), ``-vv`` every exchange with a device (``DEBUG``), and ``-q`` leaves errors alone: no warnings and
no progress bars.

Commands with figures take ``--json`` (`with_json`): the figures are then one JSON object, alone on standard output, and
text for a reader goes to standard error. `docs/reference/json.md` says which keys each command has; later versions
add keys and keep those that there are. Numbers that are not known, or not finite, are null.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import gc
import inspect
import json
import logging
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from functools import cached_property
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol, TextIO, cast, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from foundation.errors import EXIT_INTERRUPTED, CropError, InputError, StorageError
from foundation.files import disk_remedy, path_remedy
from foundation.secret_texts import masked, printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

EXIT_CODES = (
    "Exit codes: 0 done; 2 something given cannot be used; 3 a device failed; 4 the data are not good enough; "
    "5 the disk is full or read-only; 130 interrupted."
)

# Said in place of what it causes: every path of a user depends on that folder.
_LOST = "the folder in which this was started is gone; change to one that is there (cd), then run it again"
_WRITING_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def say_error(message: str) -> None:
    """Print one error line to stderr, secrets of addresses masked; where nobody reads it, the exit code says enough.

    Names of foreign files may hold what a terminal obeys, or what is no text: both are printed as escapes.
    """
    with suppress(OSError):
        print(f"error: {printable(masked(message))}", file=sys.stderr)


def run(command: Callable[[], object], *, is_resumable: bool = True, pause_gc: bool = False) -> int:
    """Call `command` and return the exit code; a foreseeable fault is one line on stderr, no traceback."""
    _make_printable()
    collects = gc.isenabled()
    if pause_gc:
        gc.disable()
    try:
        with logging_as_before():
            code = _outcome(command, is_resumable)
    finally:
        if collects:
            gc.enable()
    try:
        # What is still to be printed fails here, where it can be judged, and not while the interpreter ends.
        sys.stdout.flush()
    except OSError as error:
        say_error(f"cannot print: {error.strerror}; give the output another place and run again")
        _abandon(sys.stdout.fileno())
        return code or StorageError.exit_code
    return code


def _make_printable() -> None:
    """Have output say what it can: closed streams take it silently, and what their encoding lacks becomes a mark."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # The interpreter found the descriptor closed; what is opened now lives as long as the process.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
        elif isinstance(stream, TextIOWrapper):
            if stream.errors == "strict":
                stream.reconfigure(errors="replace")
            # Unbuffered (python -u), its buffer is the descriptor's own.
            buffer: Any = cast("Any", stream).buffer
            if type(getattr(buffer, "raw", buffer)) is FileIO:
                setattr(sys, name, _patient(stream))


# What the descriptors are called where they cannot take what is printed.
_OUTPUTS = {1: "standard output", 2: "standard error"}


class _Output(FileIO):
    """A descriptor that takes what is printed also when the reader has left (head, a closed pager).

    That is no fault, and no reason to leave a job half done that ends with 0. Where it is full the error names it.
    """

    def write(self, data: ReadableBuffer) -> int:
        """Write bytes; return their number."""
        try:
            return super().write(data)
        except BrokenPipeError:
            _abandon(self.fileno())
            return super().write(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, _OUTPUTS.get(self.fileno())) from error


def _patient(stream: Any) -> TextIOWrapper:
    stream.flush()
    output = _Output(stream.fileno(), "w", closefd=False)
    return TextIOWrapper(
        cast("Any", output) if type(stream.buffer) is FileIO else BufferedWriter(output),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def resume_gc() -> None:
    """Say that the modules of a command that `loads` are there: from here on garbage is looked for, if new."""
    if not gc.isenabled():
        _set_apart()
    gc.enable()


@functools.cache
def _set_apart() -> None:
    """Set what is there apart from what is looked through for garbage: once a process, so that garbage is not kept."""
    gc.freeze()


def _outcome(command: Callable[[], object], is_resumable: bool) -> int:
    try:
        command()
    except CropError as error:
        say_error(_LOST if error.exit_code == InputError.exit_code and _has_lost_its_folder() else str(error))
        return error.exit_code
    except KeyboardInterrupt:
        return _interrupted(is_resumable)
    except OSError as error:
        named = isinstance(error.filename, str | bytes)
        remedy = disk_remedy(error)
        # A file that is not there, and a socket that is not connected, are no fault of a disk.
        if remedy is not None and error.errno not in (errno.ENOENT, errno.ENOTCONN):
            about = os.fsdecode(error.filename) if named else "the disk"
            if about in _OUTPUTS.values():
                _abandon(next(number for number, name in _OUTPUTS.items() if name == about))
            doing = "write" if error.errno in _WRITING_FAULTS else "use"
            say_error(f"cannot {doing} {about}: {error.strerror}; {remedy}")
            return StorageError.exit_code
        if _has_lost_its_folder():
            say_error(_LOST)
            return InputError.exit_code
        remedy = path_remedy(error)
        if remedy is None or not named:
            raise
        say_error(f"cannot use {os.fsdecode(error.filename)}: {error.strerror}; {remedy}")
        return InputError.exit_code
    except MemoryError as error:
        say_error(f"not enough memory ({str(error) or 'none is left'}); use fewer --workers, or smaller pictures")
        return InputError.exit_code
    except SystemExit as error:
        if error.code == EXIT_INTERRUPTED:
            return _interrupted(is_resumable)
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    return 0


def _has_lost_its_folder() -> bool:
    try:
        os.getcwd()  # noqa: PTH109  the same, without an object
    except OSError:
        return True
    return False


def _abandon(descriptor: int) -> None:
    """Print into nothing from now on: what is printed there cannot be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def _interrupted(is_resumable: bool) -> int:
    say_error(f"interrupted; {'run the same command again to go on' if is_resumable else 'nothing of it was kept'}")
    return EXIT_INTERRUPTED


def _say(sentence: str) -> None:
    # A signal may come while a line is being printed; Python's own streams cannot be used then.
    with suppress(OSError):
        os.write(2, f"\n{sentence}\n".encode())


class EndRequest:
    """Whether the process was asked to end, and whether it may end at once.

    A request comes as a signal, in the midst of anything. A block of work that must not be cut says so with
    `postponed`; a request that comes meanwhile is noted, answered with a sentence, and seen by the block where it can
    end. A second request ends it at once.
    """

    def __init__(self, say: Callable[[str], object] = _say) -> None:
        self._say = say
        self._promise = ""
        self.is_requested = False
        """Whether somebody asked for the end."""

    def request(self) -> None:
        """Ask for the end, as a signal does."""
        first, self.is_requested = not self.is_requested, True
        if not (first and self._promise):
            raise KeyboardInterrupt
        self._say(self._promise)

    @contextmanager
    def postponed(self, promise: str) -> Generator[None]:
        """Let the first request wait for the end of the block; the block ends early where `is_requested` says so."""
        before, self._promise = self._promise, promise
        try:
            yield
        finally:
            self._promise = before

    @contextmanager
    def at_once(self) -> Generator[None]:
        """Let the first request end the block at once: nothing has begun in it that could be finished."""
        before, self._promise = self._promise, ""
        try:
            if self.is_requested:
                raise KeyboardInterrupt
            yield
        finally:
            self._promise = before


@contextmanager
def orderly_end() -> Generator[EndRequest]:
    """End as by Ctrl-C, devices closed, where the process is asked to end: by `kill`, or by a terminal that went away.

    A signal that is ignored already, as a hang-up is under `nohup`, stays ignored.
    """
    ending = EndRequest()
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return

    from_outside = False

    def end(number: int, frame: object) -> None:
        nonlocal from_outside
        from_outside = from_outside or number != signal.SIGINT
        ending.request()

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    taken = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}
    for number in taken:
        signal.signal(number, end)
    try:
        yield ending
    except OSError as error:
        if not from_outside:
            raise
        # A terminal that went away does not take the last state of a bar either.
        raise KeyboardInterrupt from error
    finally:
        for number, handler in taken.items():
            signal.signal(number, handler)


class ReportProgress(Protocol):
    """What is called with the numbers done and in all, and perhaps the present work."""

    def __call__(self, done: int, total: int, work: str = ..., /) -> None:
        """Show the numbers."""


@contextmanager
def progress(unit: str) -> Generator[ReportProgress]:
    """Show a progress bar with the time left on stderr, from the first number reported to the end of the block.

    `unit`: what is counted, or done at first; each report may name the present work in its place.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # What is printed meanwhile appears above the bar, but not on the terminal where standard output goes elsewhere.
    bar = Progress(
        *columns,
        console=Console(stderr=True),
        redirect_stdout=sys.stdout.isatty(),
        disable=not shows_progress(),
    )
    task = bar.add_task(unit, total=None)
    with ExitStack() as shown:

        def tell(done: int, total: int, work: str = unit) -> None:
            # What is refused before there is anything to count gets no bar.
            if not bar.live.is_started:
                shown.enter_context(bar)
            bar.update(task, completed=done, total=total, description=work)

        yield tell


# Of a log record on stderr, with the time to the millisecond: answers of devices are matched with what was asked.
_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


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
    handler.set_name(_HANDLER)
    handler.setFormatter(logging.Formatter(_FORMAT))
    # A group and its command may each have the option; a record is printed once.
    root.handlers[:] = [other for other in root.handlers if other.name != _HANDLER] + [handler]
    root.setLevel(level)


_HANDLER = "croplab command"

_COMMON_PANEL = "Common options"

_VERSION = Annotated[
    bool,
    typer.Option(
        "--version", callback=_print_version, is_eager=True, rich_help_panel=_COMMON_PANEL,
        help="Print the version and end.",
    ),
]  # fmt: skip
_VERBOSE = Annotated[
    int,
    typer.Option(
        "-v", "--verbose", count=True, callback=_tell_more, show_default=False, metavar="",
        rich_help_panel=_COMMON_PANEL, help="Tell on stderr what is done; -vv each exchange with a device too.",
    ),
]  # fmt: skip
_QUIET = Annotated[
    bool,
    typer.Option(
        "-q", "--quiet", callback=_tell_errors, rich_help_panel=_COMMON_PANEL,
        help="No progress bars and no warnings: errors alone.",
    ),
]  # fmt: skip
_AS_JSON = Annotated[
    bool,
    typer.Option(
        "--json", rich_help_panel=_COMMON_PANEL, help="Print one JSON object, for programs; all else goes to stderr."
    ),
]

# The options of every command and their defaults, by the names of their parameters. Each acts by its callback.
COMMON = {"verbose": (_VERBOSE, 0), "quiet": (_QUIET, False), "version": (_VERSION, False)}

_COMMON_WORD = re.compile(r"-v+|-q|--verbose|--quiet")


def is_common_option(word: str) -> bool:
    """Return whether an argument is a common option that may stand before the name of a command."""
    return _COMMON_WORD.fullmatch(word) is not None


# What stands for a value of an option, by its type; an option whose value is of a kind of its own says it itself.
_METAVARS = {"int": "N", "integer": "N", "float": "X", "str": "TEXT", "text": "TEXT", "path": "PATH"}


def _in_one_style(command: Any) -> None:
    """Give a command's help the style of all: values in capitals, no types of Python, paragraphs without line ends."""
    for parameter in command.params:
        if getattr(parameter, "is_flag", False) or getattr(parameter, "count", False):
            parameter.metavar = ""
        elif parameter.metavar is None and parameter.param_type_name == "argument":
            parameter.metavar = parameter.name.upper()
        elif parameter.metavar is None:
            parameter.metavar = _METAVARS.get(_type_name(parameter))
    for name in ("help", "epilog"):
        text = getattr(command, name)
        if text:
            setattr(command, name, re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(text)))


def _type_name(parameter: Any) -> str:
    """Return the name of an option's type, whichever way this version of typer keeps it; empty of a choice."""
    described = getattr(parameter, "type_descriptor", None)
    if described is None:
        name = str(parameter.type.name)
    else:
        name = "" if described.is_choice else str(parameter.display_type(None)).strip("<>")
    return name.removesuffix(" range")


class _Styled:
    """What gives a command of typer's its help in the style of all."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        _in_one_style(self)

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option ``--help`` without a type."""
        option = super().get_help_option(ctx)  # type: ignore[misc]
        if option is not None:
            option.metavar = ""
        return option


class StyledCommand(_Styled, TyperCommand):
    """A command whose help is in the style of all."""

    def make_context(self, *arguments: Any, **named: Any) -> Any:
        """Return the context of parsed arguments; what is wrong with a value is said without a library's words."""
        try:
            return super().make_context(*arguments, **named)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise


class _StyledGroup(_Styled, TyperGroup):
    """A command with others below it, whose help is in the style of all."""


class _StyledTyper(typer.Typer):
    """An app of commands with help in the style of all, each with the common options."""

    def command(self, name: str | None = None, **more: Any) -> Callable[[Any], Any]:
        """Register a command."""
        named: dict[str, Any] = {"cls": StyledCommand, **more}
        register = super().command(name, **named)

        def decorate(function: Callable[..., None]) -> Callable[..., None]:
            register(_with_common(function))
            return function

        return decorate


def _with_common(function: Callable[..., None]) -> Callable[..., None]:
    hints = get_type_hints(function, include_extras=True)
    own = [
        parameter.replace(annotation=hints[name]) for name, parameter in inspect.signature(function).parameters.items()
    ]
    common = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in COMMON.items()
    ]

    def command(*arguments: Any, **named: Any) -> None:
        function(*arguments, **{name: value for name, value in named.items() if name not in COMMON})

    return _declared(command, function, [*own, *common])


def _nothing() -> None:
    """Do nothing: the common options of a group act by themselves."""


def new_app(help_text: str | None = None, **more: Any) -> typer.Typer:
    """Return an app in the style of all commands.

    `help_text`: what ``--help`` of a group of commands prints; None for an app that is one command.
    """
    app = _StyledTyper(
        cls=_StyledGroup,
        help=help_text,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        **more,
    )
    if help_text is not None:
        app.callback()(_with_common(_nothing))
    return app


class MainCommand(StyledCommand):
    """A command with others beside it: its first word may name one of them in place of its own first argument.

    Its help lists the others. `subcommands` is the app of the others.
    """

    subcommands: ClassVar[typer.Typer]

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        listed = [f"{self.name} {name}: {other.help.partition('.')[0]}." for name, other in self.commands.items()]
        first = next(iter(self.commands))
        beside = f"Commands in place of the first argument, each with its --help; a folder of such a name is ./{first}:"
        self.help = "\n\n".join((self.help or "", beside, *listed))

    @cached_property
    def commands(self) -> Mapping[str, Any]:
        """The others by their names."""
        return get_group(self.subcommands).commands

    # The others are passed on by name.
    def main(  # pyrefly: ignore[bad-override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **more: Any
    ) -> Any:
        """Run the command that the arguments name."""
        words = list(sys.argv[1:] if args is None else args)
        place = next((place for place, word in enumerate(words) if not is_common_option(word)), len(words))
        name = words[place] if place < len(words) else ""
        if name in self.commands:
            named = {**self.context_settings, **more}
            return self.commands[name].main([*words[:place], *words[place + 1 :]], f"{prog_name} {name}", **named)
        if name.removeprefix("--") in self.commands:
            raise InputError(f"{name} is a command, not an option: {prog_name} {name[2:]}; see its --help")
        return super().main(words, prog_name, **more)


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


class JsonOutput:
    """Figures of a command, gathered for the object that is printed at its end."""

    def __init__(self, command: str, asked: bool) -> None:
        self.is_requested = asked
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
            whole = json_value({"command": self._command, **self._values})
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


def option(metavar: str | None, text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """Return typer's option; `names` are its own where that of its parameter, or a --no- beside it, would not do."""
    return typer.Option(*names, metavar=metavar, help=text, rich_help_panel=panel, **more)


def with_option_groups(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command for typer in which options stand in the place of each parameter that is a group of them.

    A group is a frozen dataclass, whose fields are ``Annotated`` with typer's ``Option`` or ``Argument`` and have
    defaults. No two of a command's groups share a field's name.
    """
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    members: dict[str, list[str]] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        group = hints[name]
        if not dataclasses.is_dataclass(group):
            parameters.append(parameter.replace(annotation=group))
            continue
        kinds = get_type_hints(group, include_extras=True)
        members[name] = [field.name for field in dataclasses.fields(group)]
        parameters += [
            parameter.replace(name=field.name, default=field.default, annotation=kinds[field.name])
            for field in dataclasses.fields(group)
        ]

    def command(*arguments: Any, **given: Any) -> None:
        groups = {
            name: hints[name](**{field: given.pop(field) for field in fields if field in given})
            for name, fields in members.items()
        }
        function(*arguments, **given, **groups)

    return _declared(command, function, parameters)


def _declared(
    command: Callable[..., None], function: Callable[..., None], parameters: Sequence[inspect.Parameter]
) -> Callable[..., None]:
    functools.update_wrapper(command, function)
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters} | {"return": None}
    return command


def with_json(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator of a typer command whose one parameter of type `JsonOutput` becomes the option ``--json``."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(function, include_extras=True)
        output_name = next((name for name, kind in hints.items() if kind is JsonOutput), None)
        if output_name is None:
            raise ValueError(f"{command} has no parameter of type JsonOutput to put the option in the place of")
        option = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_AS_JSON)
        subcommands = [
            parameter.replace(annotation=hints[name])
            for name, parameter in inspect.signature(function).parameters.items()
            if name != output_name
        ]

        def with_option(*arguments: Any, as_json: bool = False, **named: Any) -> None:
            with json_output(command, as_json) as output:
                function(*arguments, **named, **{output_name: output})

        return _declared(with_option, function, [*subcommands, option])

    return decorate


def json_value(value: Any) -> Any:
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
        return {field.name: json_value(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [json_value(item) for item in cast("list[Any]", value)]
    listed: Callable[[], Any] | None = getattr(value, "tolist", None)
    return str(value) if listed is None else json_value(listed())
