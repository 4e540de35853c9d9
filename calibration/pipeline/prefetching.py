"""Frames worked on by threads, some before their turn, with the results in the frames' order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from experiment.session.records import FrameRecord
from foundation.processors import processor_count

MOST_THREADS = 8
"""Each thread holds a raw file and its counts, 110 MB for a 6D Mark II: more would not stay below 2 GB."""

_Result = TypeVar("_Result")


def thread_count() -> int:
    """Return how many frames are read and measured at a time: one a processor, as far as memory allows."""
    return min(processor_count(), MOST_THREADS)


def prefetched(
    work: Callable[[FrameRecord], _Result],
    records: Sequence[FrameRecord],
    others_wait_for: Callable[[FrameRecord], bool],
) -> Generator[tuple[FrameRecord, _Result]]:
    """Yield each frame with what `work` returned for it, in order, while threads work on those that follow."""
    count = thread_count()
    with ThreadPoolExecutor(count) as pool:
        begun: deque[tuple[FrameRecord, Future[_Result]]] = deque()
        todo = deque(records)
        try:
            while todo or begun:
                while todo and len(begun) <= count and not any(others_wait_for(record) for record, _ in begun):
                    record = todo.popleft()
                    begun.append((record, pool.submit(work, record)))
                record, future = begun[0]
                result = future.result()
                yield record, result
                begun.popleft()
        finally:
            for _, future in begun:
                future.cancel()
