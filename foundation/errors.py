"""Every error that a user of CroP can meet, in one tree.

The tree says whose move it is::

    CropError                 1   anything foreseeable; never raised itself
    ├── InputError            2   what the user gave cannot be used: arguments, files, folders
    │   ├── ConfigurationError    LAB.toml: a key, a value
    │   └── FormatError           a file is not what it should be: raw, chart, session, table, picture
    ├── DeviceError           3   a device or its cable
    │   ├── LinkError             the cable: nothing comes through
    │   │   ├── LinkTimeout       nothing came in time; the device may still be there
    │   │   └── LinkClosed        the other side hung up; a new connection is needed
    │   ├── ProtocolError         the device said something that its standard does not allow
    │   ├── DeviceRefused         the device understood and said no
    │   └── DeviceFault           the device reports a defect: lamp, temperature, fan, cover
    ├── QualityError          4   the data are not good enough to go on
    │   └── RegistrationError     the chart cannot be found, or is not the one expected
    └── StorageError          5   the disk: full, read-only, gone

The number is the exit code of a command that ends with it (0 success, 130 interrupted). A sentence holds the value,
what was expected, the file or device it is about, and the remedy: ``about: problem; remedy``. What a program asks of an
error stands in attributes of its own, so that sentences can be worded anew. Errors of libraries are raised again as one
of these at the place where the library is called, with ``from error``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Final

from foundation.secret_texts import masked

EXIT_INTERRUPTED = 130  # Exit code of a command that Ctrl-C ended; 128 + SIGINT, as shells have it


# What ends a remedy that a command did not wait for; one that waits goes on by itself (`CropError.while_waiting`).
RUN_AGAIN: Final = "then run the same command again"

# Longest sentence of an error: names and values that stand in it may be a stranger's, and as long as he likes.
_LONGEST = 8000


class CropError(Exception):
    """Root of the tree: a foreseeable fault, described in one sentence that holds no secret of an address.

    Parameters
    ----------
    problem
        What is wrong, with the value and what was expected.
    about
        File, folder or device that it is about: the sentence begins with it. None where the problem names it.
    remedy
        What to do, an imperative: the sentence ends with it. Where it is not given apart, it is what stands behind the
        first semicolon of the problem; "" where nothing does.
    value, expected
        What was found and what should have been, for programs; the problem says both in words.

    Examples
    --------
    >>> str(FormatError("its version is 7, 1 is read", about="lut.json", remedy="build the table again", value=7))
    'lut.json: its version is 7, 1 is read; build the table again'
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
        """Return the sentence, users, passwords and tokens of addresses in it masked; cut where it has no end."""
        return self._sentence(self.remedy)

    def without_remedy(self) -> str:
        """Return the sentence up to its remedy: what is wrong."""
        return self._sentence("")

    def while_waiting(self) -> str:
        """Return the sentence for where the command waits and goes on by itself: without the order to run it again."""
        return self._sentence(self.remedy.removesuffix(RUN_AGAIN).rstrip(" ,;"))

    def _sentence(self, remedy: str) -> str:
        begin = "" if self.about is None else f"{self.about}: "
        text = masked(f"{begin}{self.problem}{f'; {remedy}' if remedy else ''}")
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} … {text[-_LONGEST // 4 :]}"


class InputError(CropError):
    """What the user gave cannot be used; nothing has been changed."""

    exit_code = 2


class ConfigurationError(InputError):
    """A settings file holds an unknown key or an unusable value."""


class FormatError(InputError):
    """A file or folder is not in the format expected of it, or is damaged."""


class DeviceError(CropError):
    """A device cannot do its part; data already taken are safe."""

    exit_code = 3


class LinkError(DeviceError):
    """The cable to a device fails; see the two kinds for what helps."""


class LinkTimeout(LinkError):
    """Nothing came through within the time limit."""


class LinkClosed(LinkError):
    """The other side closed the connection, or it could not be opened."""


class ProtocolError(DeviceError):
    """A device sent bytes that its standard does not allow."""


class DeviceRefused(DeviceError):
    """A device understood the command and declined it."""


class DeviceFault(DeviceError):
    """A device reports a defect of its own."""


class QualityError(CropError):
    """The data were taken and read, but are not good enough."""

    exit_code = 4


class RegistrationError(QualityError):
    """The chart was not found in a frame, or is not the chart expected."""


class StorageError(CropError):
    """The disk is full, read-only or gone; what was complete before is untouched."""

    exit_code = 5


def counted(number: int, what: str, plural: str | None = None) -> str:
    """Return a number with what is counted, in the plural but for one.

    Examples
    --------
    >>> counted(1, "image"), counted(0, "image"), counted(2, "is left", "are left")
    ('1 image', '0 images', '2 are left')
    """
    return f"{number} {what if number == 1 else plural or what + 's'}"


def nearest_names(wanted: str, known: Iterable[str], most: int = 1) -> str:
    """Return the question whether one of the known names was meant, ending with a mark; empty where none is near.

    Capitals, spaces, hyphens and underscores make no difference.

    Examples
    --------
    >>> nearest_names("Grey_World", ["gray-world", "white-patch"])
    "did you mean 'gray-world'?"
    """
    plain = {re.sub(r"[\s_-]+", "", name).lower(): name for name in known}
    near = difflib.get_close_matches(re.sub(r"[\s_-]+", "", wanted).lower(), plain, n=most, cutoff=0.5)
    return f"did you mean {' or '.join(repr(plain[name]) for name in near)}?" if near else ""


def first_few(things: Sequence[object], most: int = 10) -> str:
    """Return things between commas as a message names them: the first ones, and an ellipsis where there are more."""
    return ", ".join(map(str, things[:most])) + (" …" if len(things) > most else "")


def value_text(value: object) -> str:
    """Return what a value is, for a message about a wrong argument: type and shape of an array, the text of a text.

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
