"""A cable with one scripted conversation; missing and additional bytes are errors."""

from __future__ import annotations

from foundation.errors import LinkClosed, LinkTimeout


class Script:
    """Alternating lines of the device and of the host in their order; None disconnects.

    A read with timeout 0 returns nothing, as it only checks for unsolicited messages. Unread replies are errors, see
    `ended`.
    """

    def __init__(self, *lines: bytes | None) -> None:
        self._lines = list(lines)
        self.closed = False

    def write(self, data: bytes, timeout: float) -> None:
        if self._lines and self._lines[0] is None:
            raise LinkClosed("the script disconnects")
        assert self._lines, f"the script has ended, but {data!r} was sent"
        assert data == self._lines.pop(0)

    def read(self, limit: int, timeout: float) -> bytes:
        if not timeout:
            return b""
        if not self._lines:
            raise LinkTimeout("the script has no reply")
        line = self._lines.pop(0)
        if line is None:
            raise LinkClosed("the script disconnects")
        return line

    def close(self) -> None:
        self.closed = True

    def ended(self) -> bool:
        return not self._lines
