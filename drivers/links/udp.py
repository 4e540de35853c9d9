"""Datagrams of the network: one UDP socket, for finding devices and for receiving their notices.

Rules that hold inside:

- The system's errors become `LinkTimeout` and `LinkClosed` here and nowhere else; every message names host and port.
- A datagram comes whole or not at all, and from anybody: whoever reads it judges sender and content.
"""

from __future__ import annotations

import socket
import time
from types import TracebackType

from foundation.errors import LinkClosed, LinkTimeout

ANY_HOST = "0.0.0.0"
BROADCAST = "255.255.255.255"
MAX_DATAGRAM = 65535
"""The length field of UDP has 16 bits (RFC 768), so that no datagram is cut off."""

Address = tuple[str, int]


class UdpSocket:
    """Sends and receives datagrams at one port, until closed; use it in a `with` block."""

    def __init__(self, port: int = 0, host: str = ANY_HOST) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise LinkClosed(
                f"cannot receive datagrams at {host}:{port}: {error}; end the other program that listens there"
            ) from error
        self.address: Address = self._socket.getsockname()[:2]
        """Host and port at which it listens."""

    def __enter__(self) -> UdpSocket:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def send(self, data: bytes, address: Address) -> None:
        """Send one datagram to host and port; whether it arrives is unknown."""
        host, port = address
        try:
            self._socket.sendto(data, address)
        except (OSError, OverflowError) as error:
            raise LinkClosed(
                f"cannot send a datagram to {host}:{port}: {error}; check the address and the network"
            ) from error

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        """Return the next datagram and who sent it, waiting at most `timeout` seconds."""
        host, port = self.address
        deadline = time.monotonic() + timeout
        while True:
            try:
                self._socket.settimeout(max(deadline - time.monotonic(), 0.0))
                data, (sender, sender_port, *_) = self._socket.recvfrom(MAX_DATAGRAM)
            except ConnectionResetError:
                # Windows reports here that an earlier datagram found nobody; for us that is no news.
                continue
            except (TimeoutError, BlockingIOError) as error:
                raise LinkTimeout(f"no datagram came to {host}:{port} for {timeout:g} s") from error
            except OSError as error:
                raise LinkClosed(f"no more datagrams can be received at {host}:{port}: {error}") from error
            return data, (sender, sender_port)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()
