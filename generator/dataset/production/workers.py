"""Who makes the shards of a dataset, and what is called meanwhile."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from foundation.errors import InputError


@dataclass(frozen=True)
class Workers:
    """Who makes the shards; no byte of the dataset depends on it.

    Attributes
    ----------
    engine
        ``local``, ``dask`` or ``dask://HOST:PORT``; see `parse_engine`.
    count
        Threads, or processes of a cluster on this machine, 1 or more; each has at most about three pictures in memory.
        A cluster that is named has its own.

    Raises
    ------
    InputError
        There is no such engine, or no worker.

    Examples
    --------
    >>> Workers(count=4)
    Workers(engine='local', count=4)
    >>> Workers("dask://10.0.0.7:8786").address
    'tcp://10.0.0.7:8786'
    """

    engine: str = "local"
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"{self.count} workers were asked for, expected 1 or more")
        parse_engine(self.engine)

    @property
    def address(self) -> str | None:
        """The scheduler's address, as `parse_engine` returns it."""
        return parse_engine(self.engine)


def _ignore(*arguments: object) -> None:
    del arguments


@dataclass(frozen=True)
class Callbacks:
    """What is called while images are made, always from the calling thread.

    Attributes
    ----------
    on_done
        Takes how many of the planned images were made by an earlier call; called once, before the first is made.
    on_image
        Called after each image.
    on_skip
        Takes the name of a source that cannot be read, the reason, and the number of images that are left out.
    on_wait
        Takes a sentence for the user where the work waits for somebody to do something.

    Examples
    --------
    >>> left_out = []
    >>> callbacks = Callbacks(on_skip=lambda name, reason, images: left_out.append(name))
    >>> callbacks.on_skip("bad.png", "bad.png is no picture", 2)
    >>> left_out
    ['bad.png']
    """

    on_done: Callable[[int], None] = _ignore
    on_image: Callable[[], None] = _ignore
    on_skip: Callable[[str, str, int], None] = _ignore
    on_wait: Callable[[str], None] = _ignore


SILENT: Final = Callbacks()
"""Callbacks that do nothing."""


def parse_engine(text: str) -> str | None:
    """Return the address of the Dask scheduler that an engine's name asks for.

    Returns `tcp://HOST:PORT`; empty for a cluster on this machine; None for threads of this program.
    """
    if text == "local":
        return None
    if text == "dask":
        return ""
    match = re.fullmatch(r"dask://([^/\s]+:\d+)/?", text)
    if not match:
        raise InputError(f"{text!r} is no engine; use local, dask, or dask://HOST:PORT of a Dask scheduler")
    return f"tcp://{match[1]}"


def parse_share(text: str) -> tuple[int, int]:
    """Return (i, n) of a text such as `3/16`: share i of n, i from 0.

    Examples
    --------
    >>> parse_share("3/16")
    (3, 16)
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), re.ASCII)
    if not match or not int(match[1]) < int(match[2]):
        raise InputError(f"{text!r} is no share; write I/N with I from 0 to N - 1, such as 0/16")
    return int(match[1]), int(match[2])
