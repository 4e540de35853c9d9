"""A serial cable to a simulated device: a pseudo-terminal (Linux and macOS).

One thread serves a pseudo-terminal's device. To close it is to pull the cable out; what nobody reads is lost when the
system's buffer is full, as on a cable without flow control.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from typing import Final

from drivers.links.link import ClosedAtEnd, Peer
from drivers.links.network import POLLING_S
from foundation.errors import LinkClosed

_WAKE: Final = b"w"
_END: Final = b"e"  # What rings the serving thread: to say when it has caught up, and to end

# Longest wait for the thread to catch up; it takes milliseconds unless the machine is overloaded.
_TIMEOUT_S: Final = 10.0


class PseudoTerminal(ClosedAtEnd):
    """A serial port at `path` whose far end is `peer`, until closed; use it in a `with` block."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkClosed(f"the system gives no pseudo-terminal: {error}; close programs that use them") from error
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        """The port's name, as any serial software takes it."""
        self._bell, self._ringer = os.pipe()
        self._caught_up = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name=f"serving {self.path}", daemon=True)
        self._thread.start()

    def catch_up(self) -> None:
        """Return when all that was sent has been answered and nothing more comes: before and after a clock leaps."""
        self._caught_up.clear()
        os.write(self._ringer, _WAKE)
        self._caught_up.wait(_TIMEOUT_S)

    def close(self) -> None:
        """Pull the cable out and wait for the thread; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        os.write(self._ringer, _END)
        self._thread.join()
        for end in (self._master, self._slave, self._bell, self._ringer):
            os.close(end)

    def _serve(self) -> None:
        self._say(self._peer.connect())
        awaited = False
        while True:
            ready, _, _ = select.select([self._master, self._bell], [], [], POLLING_S)
            rung = os.read(self._bell, 1) if self._bell in ready else b""
            if rung == _END:
                return
            awaited = awaited or rung == _WAKE
            heard = os.read(self._master, 4096) if self._master in ready else b""
            self._say(self._peer.receive(heard))
            if awaited and not ready:
                # The system takes a moment to carry bytes across: only silence shows that none are on their way.
                awaited = False
                self._caught_up.set()

    def _say(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(self._master, data) :]
