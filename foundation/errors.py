"""All errors that CroP reports to its user, and phrases for their messages.

The classes form one tree::

    CropError                 1   any foreseeable error; only its subclasses are raised
    ├── InputError            2   input of the user cannot be used: arguments, files, folders
    │   ├── ConfigurationError    a settings file has a wrong key or value
    │   └── FormatError           a raw file, chart, session, LUT or picture is damaged or has the wrong format
    ├── DeviceError           3   a device or its connection failed
    │   ├── LinkError             the connection failed
    │   │   ├── LinkTimeout       no answer in time; the device may still be connected
    │   │   └── LinkClosed        the connection is closed; connect again
    │   ├── ProtocolError         the device sent bytes that its standard does not allow
    │   ├── DeviceRefused         the device refused a command
    │   └── DeviceFault           the device reports a defect: lamp, temperature, fan, cover
    ├── QualityError          4   the data are not good enough to continue
    │   └── RegistrationError     the chart was not detected, or it is another chart
    └── StorageError          5   the disk is full, read-only or disconnected

The number is the exit code of a command that ends with the error (0 success, 130 interrupted). A message has the form
``about: problem; remedy``. Programs use the attributes of an error, never its text. Code that calls a library converts
the library's errors to these classes, with ``raise … from error``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Final

from foundation.secret_texts import masked

# Exit code of a command that was ended by Ctrl-C: 128 + SIGINT, as in shells.
EXIT_INTERRUPTED = 130

# Last part of a remedy. A waiting command resumes by itself, so `CropError.while_waiting` leaves this part out.
RUN_AGAIN: Final = "then run the same command again"

# Longest message, in characters. Names and values in files from other people can have any length.
_MAX_LENGTH = 8000


class CropError(Exception):
    """Base class of all foreseeable errors. The message is one sentence.

    Parameters
    ----------
    problem
        Description of the fault, with the value found and the value expected.
    about
        File, folder or device with the fault, the first part of the message. None if `problem` names it.
    remedy
        What the user should do, the last part of the message. If empty, the remedy is the part of `problem` after the
        first semicolon.
    value, expected
        Value found and value expected, for programs.

    Examples
    --------
    >>> str(FormatError("version 7, expected 1", about="lut.json", remedy="build the LUT again", value=7))
    'lut.json: version 7, expected 1; build the LUT again'
    """

    exit_code = 1

    def __init__(
        self,
        problem: str = "",
        *,
        about: object = None,
        remedy: str = "",
        value: object = None,
        expected: object = None,
    ) -> None:
        super().__init__(problem)
        self.problem, self.remedy = problem, remedy
        if not remedy:
            self.problem, _, self.remedy = problem.partition("; ")
        self.about, self.value, self.expected = about, value, expected

    def __str__(self) -> str:
        """Return the message. User names, passwords and tokens in addresses are masked; a long message is shortened."""
        return self._message(self.remedy)

    def without_remedy(self) -> str:
        """Return the message without its remedy."""
        return self._message("")

    def while_waiting(self) -> str:
        """Return the message without the instruction to run the command again, for a command that waits."""
        return self._message(self.remedy.removesuffix(RUN_AGAIN).rstrip(" ,;"))

    def _message(self, remedy: str) -> str:
        prefix = "" if self.about is None else f"{self.about}: "
        text = masked(f"{prefix}{self.problem}{f'; {remedy}' if remedy else ''}")
        return text if len(text) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH // 2]} … {text[-_MAX_LENGTH // 4 :]}"


class InputError(CropError):
    """Input of the user cannot be used; nothing has been changed."""

    exit_code = 2


class ConfigurationError(InputError):
    """A settings file has a wrong key or value."""


class FormatError(InputError):
    """A file or folder is damaged or has the wrong format."""


class DeviceError(CropError):
    """A device cannot be used; data recorded earlier are safe."""

    exit_code = 3


class LinkError(DeviceError):
    """The connection to a device failed."""


class LinkTimeout(LinkError):
    """No data within the time limit."""


class LinkClosed(LinkError):
    """The device closed the connection, or the connection could not be opened."""


class ProtocolError(DeviceError):
    """A device sent bytes that its standard does not allow."""


class DeviceRefused(DeviceError):
    """A device refused a command."""


class DeviceFault(DeviceError):
    """A device reports a defect."""


class QualityError(CropError):
    """The data can be read, but are not good enough."""

    exit_code = 4


class RegistrationError(QualityError):
    """The chart was not detected in a frame, or it is another chart."""


class StorageError(CropError):
    """The disk is full, read-only or disconnected; files that were complete before are unchanged."""

    exit_code = 5


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number and its noun, in the plural for all numbers except 1; the default plural ends in -s.

    Examples
    --------
    >>> counted(1, "image"), counted(0, "image"), counted(2, "is left", "are left")
    ('1 image', '0 images', '2 are left')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def nearest_names(name: str, candidates: Iterable[str], limit: int = 1) -> str:
    """Return a question with the most similar candidates, at most `limit`; an empty text if none is similar.

    Capitals, spaces, hyphens and underscores are ignored.

    Examples
    --------
    >>> nearest_names("Grey_World", ["gray-world", "white-patch"])
    "did you mean 'gray-world'?"
    """
    candidate_of = {re.sub(r"[\s_-]+", "", candidate).lower(): candidate for candidate in candidates}
    similar = difflib.get_close_matches(re.sub(r"[\s_-]+", "", name).lower(), candidate_of, n=limit, cutoff=0.5)
    return f"did you mean {' or '.join(repr(candidate_of[key]) for key in similar)}?" if similar else ""


def first_few(items: Sequence[object], limit: int = 10) -> str:
    """Return the first `limit` items, separated by commas, and an ellipsis if there are more."""
    return ", ".join(map(str, items[:limit])) + (" …" if len(items) > limit else "")


def value_text(value: object) -> str:
    """Describe a wrong argument for a message: its type, and its text, its number or the shape of an array.

    Examples
    --------
    >>> value_text("cat.png"), value_text(3.5), value_text([1, 2])
    ("the text 'cat.png'", 'float 3.5', 'a list')
    """
    if isinstance(value, str | PurePath):
        return f"the text {str(value)!r}"
    if isinstance(value, int | float | None):
        return "None" if value is None else f"{type(value).__name__} {value}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    return f"a {type(value).__name__}" if dtype is None else f"an array {dtype} {shape}"
