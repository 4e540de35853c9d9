"""Scripted conversations with a projector, to write a manual's bytes into tests."""

from __future__ import annotations

from drivers.serial_projectors.driver import LineProjector
from drivers.serial_projectors.language import Language, load_language
from foundation.clock import SimulatedClock
from foundation.errors import LinkTimeout

# Expected command, and the pieces of its reply.
Turn = tuple[bytes, tuple[bytes, ...] | bytes]


class Script:
    """A cable with one conversation; missing and additional commands are errors. `more` adds unasked messages."""

    def __init__(self, *turns: Turn) -> None:
        self._turns = list(turns)
        self._replies: list[bytes] = []

    def write(self, data: bytes, timeout: float) -> None:
        assert self._turns, f"the script has ended, but {data!r} was sent"
        expected, reply = self._turns.pop(0)
        assert data == expected
        self._replies += (reply,) if isinstance(reply, bytes) else reply

    def read(self, limit: int, timeout: float) -> bytes:
        if not self._replies:
            if not timeout:
                return b""
            raise LinkTimeout("the script has no reply")
        return self._replies.pop(0)

    def close(self) -> None:
        pass

    def more(self, data: bytes) -> None:
        self._replies.append(data)

    def ended(self) -> bool:
        return not self._turns and not self._replies


def scripted(
    language: str | Language, *turns: Turn, network: bool = False, clock: SimulatedClock | None = None
) -> tuple[LineProjector, Script]:
    """Return a driver of a language and its scripted conversation; `wake` is answered first."""
    loaded = load_language(language) if isinstance(language, str) else language
    wake = loaded.line.wake.encode("ascii")
    opening = ((wake, loaded.line.ends[:1].encode("ascii")),) if wake and not network else ()
    script = Script(*opening, *turns)
    return LineProjector(loaded, lambda: script, network, clock=clock or SimulatedClock()), script
