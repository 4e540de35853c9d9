"""When a process that was asked to end may do so: at once, or after what it has begun.

A request comes as a signal, in the midst of anything. A block of work that must not be cut says so with `finishing`; a
request that comes meanwhile is noted, answered with a sentence, and seen by the block where it can end. A second
request ends it at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress


def _say(sentence: str) -> None:
    # A signal may come while a line is being printed; Python's own streams cannot be used then.
    with suppress(OSError):
        os.write(2, f"\n{sentence}\n".encode())


class Ending:
    """Whether the process was asked to end, and whether it may end at once.

    Parameters
    ----------
    say
        Prints a sentence; called in the midst of anything.
    """

    def __init__(self, say: Callable[[str], object] = _say) -> None:
        self._say = say
        self._promise = ""
        self._asked = False

    @property
    def asked(self) -> bool:
        """Whether somebody asked for the end."""
        return self._asked

    def ask(self) -> None:
        """Ask for the end, as a signal does.

        Raises
        ------
        KeyboardInterrupt
            Nothing is being finished, or it was asked before: the process ends at once.
        """
        first, self._asked = not self._asked, True
        if not (first and self._promise):
            raise KeyboardInterrupt
        self._say(self._promise)

    @contextmanager
    def finishing(self, promise: str) -> Generator[None]:
        """Let the first request wait for the end of the block; the block ends early where `asked` says so.

        Parameters
        ----------
        promise
            What whoever asks is told: when it will end.
        """
        before, self._promise = self._promise, promise
        try:
            yield
        finally:
            self._promise = before

    @contextmanager
    def at_once(self) -> Generator[None]:
        """Let the first request end the block at once: nothing has begun in it that could be finished.

        Raises
        ------
        KeyboardInterrupt
            The end was asked for before.
        """
        before, self._promise = self._promise, ""
        try:
            if self._asked:
                raise KeyboardInterrupt
            yield
        finally:
            self._promise = before
