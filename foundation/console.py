"""Common parts of all commands: error messages, exit codes, signals, progress, log options, JSON output.

A command parses its arguments, calls a function, and prints the result. Only `run` converts errors to text.

`new_app` adds the options -h, --version, -v and -q to each command; they are not in the signature of the command. Log
records go to stderr, by default warnings and errors. ``-v`` adds the steps (``INFO``), and ``-vv`` adds all
communication with devices (``DEBUG``). ``-q`` removes warnings and progress bars.

`with_json` adds the option ``--json``. A command with this option prints one JSON object to stdout, and text to stderr.
`docs/reference/json.md` lists the keys; later versions may only add keys. Unknown and infinite numbers are null.
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

from foundation.errors import EXIT_INTERRUPTED, RUN_AGAIN, CropError, InputError, StorageError
from foundation.files import disk_remedy, path_remedy
from foundation.secret_texts import masked, printable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

EXIT_CODES = (
    "Exit codes: 0 done; 2 input cannot be used; 3 a device failed; 4 the data are not good enough; "
    "5 the disk is full or read-only; 130 interrupted."
)

# Message if the current folder was deleted. It replaces other errors, because relative paths need this folder.
_NO_FOLDER_MESSAGE = f"the current folder does not exist any more; change to an existing one (cd), {RUN_AGAIN}"
_WRITE_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def print_error(message: str) -> None:
    """Print one error line to stderr, with secrets masked and control characters escaped."""
    # If stderr is closed, only the exit code reports the error.
    with suppress(OSError):
        print(f"error: {printable(masked(message))}", file=sys.stderr)


def run(command: Callable[[], object], *, is_resumable: bool = True, pause_gc: bool = False) -> int:
    """Call `command` and return its exit code; a foreseeable error is printed as one line to stderr.

    `is_resumable`: whether the same command can resume after an interruption, for the message. `pause_gc`: whether
    garbage collection pauses until `resume_gc` is called, which makes imports faster.
    """
    _make_printable()
    was_enabled = gc.isenabled()
    if pause_gc:
        gc.disable()
    try:
        with preserved_logging():
            code = _exit_code(command, is_resumable)
    finally:
        if was_enabled:
            gc.enable()
    try:
        # Without this call, an error of the last output would occur when the interpreter ends.
        sys.stdout.flush()
    except OSError as error:
        print_error(f"cannot print: {error.strerror}; redirect the output to another file and run again")
        _discard_output(sys.stdout.fileno())
        return code or StorageError.exit_code
    return code


def _make_printable() -> None:
    """Replace closed streams by /dev/null, and characters that the encoding does not have by a question mark."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # The descriptor was closed when the interpreter started. The new descriptor stays open until the process
            # ends.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
        elif isinstance(stream, TextIOWrapper):
            if stream.errors == "strict":
                stream.reconfigure(errors="replace")
            # With python -u there is no buffer, and `stream.buffer` is the file itself.
            buffer: Any = cast("Any", stream).buffer
            if type(getattr(buffer, "raw", buffer)) is FileIO:
                setattr(sys, name, _make_tolerant(stream))


# Names of the descriptors in error messages.
_OUTPUTS = {1: "standard output", 2: "standard error"}


class _Output(FileIO):
    """Output stream that discards all text after its reader, such as `head` or a pager, has ended.

    Other write errors are raised with the name of the stream.
    """

    def write(self, data: ReadableBuffer) -> int:
        """Write bytes; return their number."""
        try:
            return super().write(data)
        except BrokenPipeError:
            # The job must be completed, although nobody reads its output.
            _discard_output(self.fileno())
            return super().write(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, _OUTPUTS.get(self.fileno())) from error


def _make_tolerant(stream: Any) -> TextIOWrapper:
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
    """Enable garbage collection after the imports of a command; the collection skips the imported objects."""
    if not gc.isenabled():
        _freeze_once()
    gc.enable()


@functools.cache
def _freeze_once() -> None:
    # gc.freeze exempts all existing objects from garbage collection. A second call would also exempt garbage.
    gc.freeze()


def _exit_code(command: Callable[[], object], is_resumable: bool) -> int:
    try:
        command()
    except CropError as error:
        print_error(_NO_FOLDER_MESSAGE if error.exit_code == InputError.exit_code and _is_cwd_missing() else str(error))
        return error.exit_code
    except KeyboardInterrupt:
        return _report_interruption(is_resumable)
    except OSError as error:
        has_name = isinstance(error.filename, str | bytes)
        remedy = disk_remedy(error)
        # A missing file and an unconnected socket have other causes than the disk.
        if remedy is not None and error.errno not in (errno.ENOENT, errno.ENOTCONN):
            about = os.fsdecode(error.filename) if has_name else "the disk"
            if about in _OUTPUTS.values():
                _discard_output(next(number for number, name in _OUTPUTS.items() if name == about))
            action = "write" if error.errno in _WRITE_FAULTS else "use"
            print_error(f"cannot {action} {about}: {error.strerror}; {remedy}")
            return StorageError.exit_code
        if _is_cwd_missing():
            print_error(_NO_FOLDER_MESSAGE)
            return InputError.exit_code
        remedy = path_remedy(error)
        if remedy is None or not has_name:
            raise
        print_error(f"cannot use {os.fsdecode(error.filename)}: {error.strerror}; {remedy}")
        return InputError.exit_code
    except MemoryError as error:
        print_error(f"not enough memory ({str(error) or 'all is used'}); use fewer --workers, or smaller pictures")
        return InputError.exit_code
    except SystemExit as error:
        if error.code == EXIT_INTERRUPTED:
            return _report_interruption(is_resumable)
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except Exception as error:
        # If a class is being made when an import is interrupted, Python 3.11 raises a RuntimeError instead.
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        return _report_interruption(is_resumable)
    return 0


def _is_cwd_missing() -> bool:
    try:
        os.getcwd()  # noqa: PTH109  as Path.cwd(), without an object
    except OSError:
        return True
    return False


def _discard_output(descriptor: int) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def _report_interruption(is_resumable: bool) -> int:
    print_error(f"interrupted; {'run the same command again' if is_resumable else 'no results were kept'}")
    return EXIT_INTERRUPTED


def _print_in_handler(message: str) -> None:
    # A signal may arrive while Python prints a line, and its streams must not be used then.
    with suppress(OSError):
        os.write(2, f"\n{message}\n".encode())


def _interrupt() -> None:
    raise KeyboardInterrupt


class EndRequest:
    """Request to end the process, usually sent by a signal.

    By default, a request raises KeyboardInterrupt. In a `postponed` block, the first request only sets `is_requested`
    and prints a message, and the block ends when it can. A second request raises KeyboardInterrupt.
    """

    def __init__(
        self, report: Callable[[str], object] = _print_in_handler, interrupt: Callable[[], object] = _interrupt
    ) -> None:
        self._report, self._interrupt = report, interrupt
        self._message = ""
        self.is_requested = False

    def request(self) -> None:
        """Request the end, as a signal does."""
        is_first, self.is_requested = not self.is_requested, True
        if is_first and self._message:
            self._report(self._message)
        else:
            self._interrupt()

    @contextmanager
    def postponed(self, message: str) -> Generator[None]:
        """Postpone the first request in a block, and print `message` when it comes.

        The block must check `is_requested` and end early.
        """
        outer, self._message = self._message, message
        try:
            yield
        finally:
            self._message = outer

    @contextmanager
    def at_once(self) -> Generator[None]:
        """Raise KeyboardInterrupt at the first request, in a part of a `postponed` block that can end at any time."""
        outer, self._message = self._message, ""
        try:
            if self.is_requested:
                raise KeyboardInterrupt
            yield
        finally:
            self._message = outer


@contextmanager
def orderly_end() -> Generator[EndRequest]:
    """Treat `kill` and a closed terminal like Ctrl-C, so that devices are closed; ignored signals stay ignored."""
    outer = signal.getsignal(signal.SIGINT)
    # The outer handler counts the signals, so it decides whether this request is a repetition.
    ending = EndRequest(interrupt=(lambda: outer(signal.SIGINT, None)) if callable(outer) else _interrupt)
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return

    is_external = False

    def end(number: int, frame: object) -> None:
        nonlocal is_external
        is_external = is_external or number != signal.SIGINT
        ending.request()

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    replaced = {number: handler for number, handler in handlers.items() if handler != signal.SIG_IGN}
    for number in replaced:
        signal.signal(number, end)
    try:
        yield ending
    except OSError as error:
        if not is_external:
            raise
        # A progress bar cannot write its last state to a closed terminal.
        raise KeyboardInterrupt from error
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)


class ReportProgress(Protocol):
    """Function that takes the number of completed items, the total number and, optionally, the current work."""

    def __call__(self, completed: int, total: int, work: str = ..., /) -> None:
        """Show the progress."""


@contextmanager
def progress(unit: str) -> Generator[ReportProgress]:
    """Show a progress bar on stderr, from the first report to the end of the block.

    `unit`: name of the counted items, shown if a report has no `work`.
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
    # Printed text appears above the bar, unless stdout is redirected.
    bar = Progress(
        *columns,
        console=Console(stderr=True),
        redirect_stdout=sys.stdout.isatty(),
        disable=not shows_progress(),
    )
    task = bar.add_task(unit, total=None)
    with ExitStack() as stack:

        def report(completed: int, total: int, work: str = unit) -> None:
            # The bar starts here, so a command that ends before the first report shows no bar.
            if not bar.live.is_started:
                stack.enter_context(bar)
            bar.update(task, completed=completed, total=total, description=work)

        yield report


# Format of log records. Their time has milliseconds, to match answers of devices with requests.
_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


def _print_version(is_requested: bool) -> None:
    if is_requested:
        from importlib.metadata import version

        print(f"croplab {version('croplab')}")
        raise typer.Exit


def _log_more(count: int) -> None:
    if count:
        _set_log_level(logging.INFO if count == 1 else logging.DEBUG)


def _log_errors_only(is_requested: bool) -> None:
    if is_requested:
        _set_log_level(logging.ERROR)


def _set_log_level(level: int) -> None:
    root, handler = logging.getLogger(), logging.StreamHandler(sys.stderr)
    handler.set_name(_HANDLER)
    handler.setFormatter(logging.Formatter(_FORMAT))
    # A group and its command may both have the option. Replace the handler, so that each record is printed once.
    root.handlers[:] = [present for present in root.handlers if present.name != _HANDLER] + [handler]
    root.setLevel(level)


_HANDLER = "croplab command"

_COMMON_PANEL = "Common options"

_VERSION = Annotated[
    bool,
    typer.Option(
        "--version", callback=_print_version, is_eager=True, rich_help_panel=_COMMON_PANEL,
        help="Print the version and exit.",
    ),
]  # fmt: skip
_VERBOSE = Annotated[
    int,
    typer.Option(
        "-v", "--verbose", count=True, callback=_log_more, show_default=False, metavar="",
        rich_help_panel=_COMMON_PANEL, help="Print each step to stderr; -vv also the communication with devices.",
    ),
]  # fmt: skip
_QUIET = Annotated[
    bool,
    typer.Option(
        "-q", "--quiet", callback=_log_errors_only, rich_help_panel=_COMMON_PANEL,
        help="Print errors only, no progress bars or warnings.",
    ),
]  # fmt: skip
_AS_JSON = Annotated[
    bool,
    typer.Option(
        "--json", rich_help_panel=_COMMON_PANEL, help="Print one JSON object to stdout and all other text to stderr."
    ),
]

# Options of all commands and their defaults, by parameter name. Callbacks handle these options.
COMMON = {"verbose": (_VERBOSE, 0), "quiet": (_QUIET, False), "version": (_VERSION, False)}

_COMMON_WORD = re.compile(r"-v+|-q|--verbose|--quiet")


def is_common_option(word: str) -> bool:
    """Return whether an argument is a common option, which may precede the name of a command."""
    return _COMMON_WORD.fullmatch(word) is not None


# Placeholders for option values in the help, by type. Some options define a placeholder of their own.
_METAVARS = {"int": "N", "integer": "N", "float": "X", "str": "TEXT", "text": "TEXT", "path": "PATH"}


def _apply_style(command: Any) -> None:
    """Change the help of a command: capital placeholders, no Python types, no line ends inside paragraphs."""
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
    # The attributes depend on the version of typer. An option with a choice of words has no type name.
    descriptor = getattr(parameter, "type_descriptor", None)
    if descriptor is None:
        name = str(parameter.type.name)
    else:
        name = "" if descriptor.is_choice else str(parameter.display_type(None)).strip("<>")
    return name.removesuffix(" range")


class _Styled:
    """Base class of commands with our style of help."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        _apply_style(self)

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option ``--help`` without a type."""
        option = super().get_help_option(ctx)  # type: ignore[misc]
        if option is not None:
            option.metavar = ""
        return option


# Our names of options and arguments, with the names that other programs use.
_OTHER_NAMES = {
    "workers": "j jobs n-jobs threads n-threads num-threads num-workers processes cores cpus parallel nproc",
    "out": "o output output-dir outdir output-folder dest destination save",
    "sources": "i input inputs images pictures source src",
    "seed": "s random-seed random-state",
    "crop": "size patch-size crop-size image-size resolution",
    "crops": "n count num number images-per-picture repeat",
    "folds": "k kfold k-fold n-splits n-folds splits",
    "read": "layout camera subset partial black saturation",
    "light": "lights illuminant illuminants illumination illuminations",
    "dry-run": "n dryrun simulate no-act",
    "verbose": "debug log-level d",
    "quiet": "silent s",
    "page": "paper paper-size size format",
    "method": "m methods model algorithm",
    "error": "metric",
    "host": "bind address ip",
    "pjlink": "port p tcp",
    "port": "p",
    "model": "camera body",
    "camera": "model body",
    "settings": "c config config-file conf",
    "format": "f type extension file-format",
    "matrix": "ccm colour-matrix color-matrix",
    "lab": "c config settings",
    "data": "dataset data-set d",
}


class StyledCommand(_Styled, TyperCommand):
    """Command with our style of help."""

    def make_context(self, *arguments: Any, **keywords: Any) -> Any:
        """Return the context of parsed arguments."""
        try:
            return super().make_context(*arguments, **keywords)
        except typer.BadParameter as error:
            # Remove the prefix that pydantic adds to messages.
            error.message = error.message.removeprefix("Value error, ")
            raise
        except Exception as error:
            # The class of this error depends on the version of typer.
            if hasattr(error, "possibilities"):
                self._suggest(cast("Any", error))
            raise

    def _suggest(self, error: Any) -> None:
        """If an unknown option is one of `_OTHER_NAMES`, add our name to its error."""
        word = error.option_name.lstrip("-").lower().replace("_", "-")
        ours = [name for name, others in _OTHER_NAMES.items() if word in (name, *others.split())]
        options = [f"--{name}" for name in ours if any(f"--{name}" in each.opts for each in self.params)]
        parameters = [each for each in self.params if each.param_type_name == "argument"]
        named = [str(each.metavar) for each in parameters if each.name in (word, *ours)]
        if options:
            error.possibilities = options
        elif named:
            error.message += f"; {named[0]} is an argument, give it without the name of an option"
            error.possibilities = []


class _StyledGroup(_Styled, TyperGroup):
    """Group of commands with our help."""


class _StyledTyper(typer.Typer):
    """App of commands with our style of help and the common options."""

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        """Register a command."""
        keywords: dict[str, Any] = {"cls": StyledCommand, **options}
        register = super().command(name, **keywords)

        def decorate(function: Callable[..., None]) -> Callable[..., None]:
            register(_with_common_options(function))
            return function

        return decorate


def _with_common_options(function: Callable[..., None]) -> Callable[..., None]:
    hints = get_type_hints(function, include_extras=True)
    own = [
        parameter.replace(annotation=hints[name]) for name, parameter in inspect.signature(function).parameters.items()
    ]
    common = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in COMMON.items()
    ]

    def command(*arguments: Any, **keywords: Any) -> None:
        function(*arguments, **{name: value for name, value in keywords.items() if name not in COMMON})

    return _with_signature(command, function, [*own, *common])


def _no_action() -> None:
    """Do nothing, because callbacks handle the common options of a group."""


def new_app(help_text: str | None = None, **options: Any) -> typer.Typer:
    """Return an app with our style of help and the common options.

    `help_text`: help of a group of commands; None for an app with one command.
    """
    app = _StyledTyper(
        cls=_StyledGroup,
        help=help_text,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        **options,
    )
    if help_text is not None:
        app.callback()(_with_common_options(_no_action))
    return app


class MainCommand(StyledCommand):
    """Command that can have the name of a subcommand as first argument; its help lists the subcommands."""

    subcommands: ClassVar[typer.Typer]

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        lines = [f"{self.name} {name}: {command.help.partition('.')[0]}." for name, command in self.commands.items()]
        first = next(iter(self.commands))
        heading = f"Subcommands, each with --help; for a folder with the name of a subcommand, write ./{first}:"
        self.help = "\n\n".join((self.help or "", heading, *lines))

    @cached_property
    def commands(self) -> Mapping[str, Any]:
        """Subcommands by name."""
        return get_group(self.subcommands).commands

    def main(  # pyrefly: ignore[bad-override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **options: Any
    ) -> Any:
        """Run the command or the subcommand that the arguments name."""
        words = list(sys.argv[1:] if args is None else args)
        index = next((index for index, word in enumerate(words) if not is_common_option(word)), len(words))
        name = words[index] if index < len(words) else ""
        if name in self.commands:
            keywords = {**self.context_settings, **options}
            return self.commands[name].main([*words[:index], *words[index + 1 :]], f"{prog_name} {name}", **keywords)
        if name.removeprefix("--") in self.commands:
            raise InputError(f"{name} is a command, not an option: {prog_name} {name[2:]}; see its --help")
        return super().main(words, prog_name, **options)


@contextmanager
def preserved_logging() -> Generator[None]:
    """Restore the log settings after the block, because a program may call commands with different options."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    try:
        yield
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers


def shows_progress() -> bool:
    """Return whether progress is shown; ``-q`` switches it off."""
    return logging.getLogger().isEnabledFor(logging.WARNING)


class JsonOutput:
    """Values of the JSON object that a command prints when it ends."""

    def __init__(self, command: str, is_requested: bool) -> None:
        self.is_requested = is_requested
        self._command = command
        self._values: dict[str, Any] = {}

    def add(self, **values: Any) -> None:
        """Add values of types that `json_value` accepts."""
        self._values.update(values)

    def append(self, key: str, value: Any) -> None:
        """Append a value to the list `key`, which is added if missing."""
        self._values.setdefault(key, []).append(value)

    def write(self, stream: TextIO) -> None:
        """Print the object unless it is empty."""
        if self._values:
            document = json_value({"command": self._command, **self._values})
            print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False), file=stream)


@contextmanager
def json_output(command: str, is_requested: bool) -> Generator[JsonOutput]:
    """Collect values in the block and, if requested, print them when it ends, also after an error.

    If values are requested, all other output of the block goes to stderr.
    """
    output = JsonOutput(command, is_requested)
    if not is_requested:
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


def option(metavar: str | None, text: str, *names: str, panel: str | None = None, **options: Any) -> Any:
    """Return an option of typer; `names`, if given, replace the names that typer makes from the parameter."""
    return typer.Option(*names, metavar=metavar, help=text, rich_help_panel=panel, **options)


def with_option_groups(function: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of a command that is a group of options by the options of this group.

    A group is a frozen dataclass. Its fields are ``Annotated`` with ``Option`` or ``Argument`` of typer, and have
    defaults. A field name must occur only once in a command.
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

    def command(*arguments: Any, **values: Any) -> None:
        groups = {
            name: hints[name](**{field: values.pop(field) for field in fields if field in values})
            for name, fields in members.items()
        }
        function(*arguments, **values, **groups)

    return _with_signature(command, function, parameters)


def _with_signature(
    command: Callable[..., None], function: Callable[..., None], parameters: Sequence[inspect.Parameter]
) -> Callable[..., None]:
    functools.update_wrapper(command, function)
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters} | {"return": None}
    return command


def with_json(command: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that replaces a command's parameter of type `JsonOutput` by the option ``--json``."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(function, include_extras=True)
        output_name = next((name for name, kind in hints.items() if kind is JsonOutput), None)
        if output_name is None:
            raise ValueError(f"{command} has no parameter of type JsonOutput, expected one; add it")
        json_option = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_AS_JSON)
        parameters = [
            parameter.replace(annotation=hints[name])
            for name, parameter in inspect.signature(function).parameters.items()
            if name != output_name
        ]

        def with_option(*arguments: Any, as_json: bool = False, **keywords: Any) -> None:
            with json_output(command, as_json) as output:
                function(*arguments, **keywords, **{output_name: output})

        return _with_signature(with_option, function, [*parameters, json_option])

    return decorate


def json_value(value: Any) -> Any:
    """Convert a value for JSON: numpy numbers to numbers, NaN and infinity to None, other objects to text.

    Examples
    --------
    >>> from pathlib import Path
    >>> json_value({"place": Path("lut"), "angles": (0.5, float("nan"))})
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
    to_list: Callable[[], Any] | None = getattr(value, "tolist", None)
    return str(value) if to_list is None else json_value(to_list())
