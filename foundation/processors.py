"""The processors that this process may use: their number, and work that is spread over them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

_In = TypeVar("_In")
_Out = TypeVar("_Out")


def processor_count() -> int:
    """Return the number of processors this process may run on, at least 1.

    A scheduler or a container may bind a process to fewer than the machine has; where the system binds none, all are
    counted. A container's share of processor time is not looked at.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_map(function: Callable[[_In], _Out], things: Iterable[_In], workers: int) -> Iterator[_Out]:
    """Yield the function's values in the order of the things; with one worker in the calling thread.

    Examples
    --------
    >>> list(ordered_map(abs, [-3, 2, -1], workers=2))
    [3, 2, 1]
    """
    from concurrent.futures import Future, ThreadPoolExecutor

    if workers <= 1:
        yield from map(function, things)
        return
    waiting: deque[Future[_Out]] = deque()
    pool = ThreadPoolExecutor(workers)
    try:
        for thing in things:
            waiting.append(pool.submit(function, thing))
            if len(waiting) >= 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
