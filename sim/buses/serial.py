"""Simulated serial port: a pseudo-terminal (Linux and macOS) whose other end is a simulated device.

One thread serves the device. Closing the pseudo-terminal is like unplugging the cable. As on a cable without flow
control, bytes are lost if the buffer of the system is full.
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

_WAKE: Final = b"w"  # Signal to the thread: report when all input is processed
_END: Final = b"e"  # Signal to the thread: end

_TIMEOUT_S: Final = 10.0  # Limit for processing the input, s; it takes milliseconds unless the machine is overloaded.


class PseudoTerminal(ClosedAtEnd):
    """Serial port at `path`, connected to `peer` until closed; use it in a `with` block."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkClosed(f"cannot open a pseudo-terminal: {error}; close programs that use them") from error
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._bell, self._ringer = os.pipe()
        self._caught_up = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name=f"serving {self.path}", daemon=True)
        self._thread.start()

    def catch_up(self) -> None:
        """Wait until all input is processed and answered; call it before and after a step of the clock."""
        self._caught_up.clear()
        os.write(self._ringer, _WAKE)
        self._caught_up.wait(_TIMEOUT_S)

    def close(self) -> None:
        """Disconnect the cable and wait for the thread; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        os.write(self._ringer, _END)
        self._thread.join()
        for end in (self._master, self._slave, self._bell, self._ringer):
            os.close(end)

    def _serve(self) -> None:
        self._send(self._peer.connect())
        is_awaited = False
        while True:
            ready, _, _ = select.select([self._master, self._bell], [], [], POLLING_S)
            signal = os.read(self._bell, 1) if self._bell in ready else b""
            if signal == _END:
                return
            is_awaited = is_awaited or signal == _WAKE
            received = os.read(self._master, 4096) if self._master in ready else b""
            self._send(self._peer.receive(received))
            if is_awaited and not ready:
                # Bytes take a moment to cross the system: only a silent interval shows that none are on the way.
                is_awaited = False
                self._caught_up.set()

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(self._master, data) :]
