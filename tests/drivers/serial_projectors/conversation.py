"""Conversations with a projector by heart, to write a manual's bytes into tests."""

from __future__ import annotations

from drivers.serial_projectors.driver import LineProjector
from drivers.serial_projectors.language import Language, load_language
from foundation.clock import SimulatedClock
from foundation.errors import LinkTimeout

Turn = tuple[bytes, tuple[bytes, ...] | bytes]
"""What the projector must hear, and the pieces that it answers."""


class Script:
    """A cable that knows one conversation; a word too many or too few is an error. `more` is what it says unasked."""

    def __init__(self, *turns: Turn) -> None:
        self._turns = list(turns)
        self._said: list[bytes] = []

    def write(self, data: bytes, timeout: float) -> None:
        assert self._turns, f"nothing more was to be said, but {data!r} was"
        heard, said = self._turns.pop(0)
        assert data == heard
        self._said += (said,) if isinstance(said, bytes) else said

    def read(self, limit: int, timeout: float) -> bytes:
        if not self._said:
            if not timeout:
                return b""
            raise LinkTimeout("the script has nothing more to say")
        return self._said.pop(0)

    def close(self) -> None:
        pass

    def more(self, data: bytes) -> None:
        self._said.append(data)

    def ended(self) -> bool:
        return not self._turns and not self._said


def scripted(
    language: str | Language, *turns: Turn, network: bool = False, clock: SimulatedClock | None = None
) -> tuple[LineProjector, Script]:
    """Return a driver of a language, and the conversation that it must have; `wake` is answered first."""
    spoken = load_language(language) if isinstance(language, str) else language
    wake = spoken.line.wake.encode("ascii")
    begun = ((wake, spoken.line.ends[:1].encode("ascii")),) if wake and not network else ()
    script = Script(*begun, *turns)
    return LineProjector(spoken, lambda: script, network, clock=clock or SimulatedClock()), script
