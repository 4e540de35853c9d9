"""Wrappers that add faults to a good cable."""

from __future__ import annotations

from collections.abc import Callable

from drivers.links.link import Link
from foundation.clock import Clock
from foundation.errors import LinkClosed, LinkTimeout


class Dribbling:
    """Reads byte by byte."""

    def __init__(self, good: Link) -> None:
        self.good = good

    def write(self, data: bytes, timeout: float) -> None:
        self.good.write(data, timeout)

    def read(self, limit: int, timeout: float) -> bytes:
        return self.good.read(1, timeout)

    def close(self) -> None:
        self.good.close()


class Garbling(Dribbling):
    """Changes its input by `garble`."""

    def __init__(self, good: Link, garble: Callable[[bytes], bytes]) -> None:
        super().__init__(good)
        self._garble = garble

    def read(self, limit: int, timeout: float) -> bytes:
        return self._garble(self.good.read(limit, timeout))


class DroppedAfter(Dribbling):
    """Disconnects before write number `writes`, counted from 0."""

    def __init__(self, good: Link, writes: int) -> None:
        super().__init__(good)
        self._remaining_writes = writes

    def write(self, data: bytes, timeout: float) -> None:
        if self._remaining_writes == 0:
            self.good.close()
            raise LinkClosed("dropped on purpose")
        self._remaining_writes -= 1
        self.good.write(data, timeout)

    def read(self, limit: int, timeout: float) -> bytes:
        return self.good.read(limit, timeout)


class Deaf(Dribbling):
    """Loses the replies from read number `after` on, counted from 0."""

    def __init__(self, good: Link, after: int) -> None:
        super().__init__(good)
        self._remaining_reads = after

    def read(self, limit: int, timeout: float) -> bytes:
        data = self.good.read(limit, timeout)
        if self._remaining_reads == 0 and data:
            raise LinkTimeout(f"swallowed {data!r} on purpose")
        self._remaining_reads -= bool(data)
        return data


class Slow(Dribbling):
    """Each read takes `seconds` of `clock`, or times out."""

    def __init__(self, good: Link, clock: Clock, seconds: float) -> None:
        super().__init__(good)
        self._clock = clock
        self._seconds = seconds

    def read(self, limit: int, timeout: float) -> bytes:
        self._clock.sleep(min(self._seconds, timeout))
        if not timeout:
            return b""
        if timeout < self._seconds:
            raise LinkTimeout(f"an answer takes {self._seconds:g} s on purpose")
        return self.good.read(limit, timeout)
