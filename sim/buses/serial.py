"""Simulated serial port: a pseudo-terminal (Linux and macOS) with a simulated device at its other end.

A thread passes bytes to the device and sends its answers. Closing the pseudo-terminal simulates an unplugged cable. If
the buffer of the system is full, bytes are lost, as on a cable without flow control.
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

_WAKE: Final = b"w"  # Signal to the thread: report when all input is processed.
_END: Final = b"e"  # Signal to the thread: end.

_TIMEOUT_S: Final = 10.0  # Time limit for processing the input, s; milliseconds are usual.


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
        self._wake_read, self._wake_write = os.pipe()
        self._caught_up = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name=f"serving {self.path}", daemon=True)
        self._thread.start()

    def catch_up(self) -> None:
        """Wait until all input is answered. Call this before and after each step of a simulated clock."""
        self._caught_up.clear()
        os.write(self._wake_write, _WAKE)
        self._caught_up.wait(_TIMEOUT_S)

    def close(self) -> None:
        """Disconnect the cable and wait for the thread; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        os.write(self._wake_write, _END)
        self._thread.join()
        for end in (self._master, self._slave, self._wake_read, self._wake_write):
            os.close(end)

    def _serve(self) -> None:
        self._send(self._peer.connect())
        is_awaited = False
        while True:
            ready, _, _ = select.select([self._master, self._wake_read], [], [], POLLING_S)
            signal = os.read(self._wake_read, 1) if self._wake_read in ready else b""
            if signal == _END:
                return
            is_awaited = is_awaited or signal == _WAKE
            received = os.read(self._master, 4096) if self._master in ready else b""
            self._send(self._peer.receive(received))
            if is_awaited and not ready:
                # Bytes need some time to pass the system, so only an interval without bytes shows that all arrived.
                is_awaited = False
                self._caught_up.set()

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(self._master, data) :]
