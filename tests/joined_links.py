"""Two joined ends of a cable: one end reads what the other writes, in any thread."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from foundation.errors import LinkClosed, LinkTimeout


@dataclass
class _Direction:
    """Bytes under way in one direction."""

    waiting: bytes = b""
    closed: bool = False


class JoinedLink:
    """One end; see `joined_links`."""

    def __init__(self, changed: threading.Condition, outgoing: _Direction, incoming: _Direction) -> None:
        self._changed, self._outgoing, self._incoming = changed, outgoing, incoming

    def write(self, data: bytes, timeout: float) -> None:
        with self._changed:
            if self._outgoing.closed or self._incoming.closed:
                raise LinkClosed("one end of the link is closed")
            self._outgoing.waiting += data
            self._changed.notify_all()

    def read(self, limit: int, timeout: float) -> bytes:
        coming = self._incoming
        with self._changed:
            if not self._changed.wait_for(lambda: coming.waiting or coming.closed or self._outgoing.closed, timeout):
                if not timeout:
                    return b""
                raise LinkTimeout(f"no bytes within {timeout} s")
            taken, coming.waiting = coming.waiting[:limit], coming.waiting[limit:]
        if not taken or self._outgoing.closed:
            raise LinkClosed("one end of the link is closed")
        return taken

    def close(self) -> None:
        with self._changed:
            self._outgoing.closed = True
            self._changed.notify_all()


def joined_links() -> tuple[JoinedLink, JoinedLink]:
    changed, forward, backward = threading.Condition(), _Direction(), _Direction()
    return JoinedLink(changed, forward, backward), JoinedLink(changed, backward, forward)
