"""Cables of the network: TCP connections, the loopback servers of simulated devices, and datagrams over UDP.

The system's errors become `LinkTimeout` and `LinkClosed` here and nowhere else; every message names host and port. A
datagram comes whole or not at all, and from anybody: whoever reads it judges sender and content.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

from drivers.links.link import ClosedAtEnd, Peer
from foundation.errors import LinkClosed, LinkError, LinkTimeout

LOOPBACK = "127.0.0.1"


class TcpLink:
    """A `drivers.links.link.Link` over one TCP connection."""

    def __init__(self, connection: socket.socket, far_end: str) -> None:
        self._socket = connection
        self._far_end = far_end
        self._timeout: float | None = None
        # Commands are short and each waits for its answer: to gather them into bigger packets only delays them.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @classmethod
    def connect(cls, host: str, port: int, timeout: float) -> TcpLink:
        """Open a connection within `timeout` seconds."""
        far_end = f"{host}:{port}"
        try:
            return cls(socket.create_connection((host, port), timeout), far_end)
        except TimeoutError as error:
            raise LinkTimeout(
                f"{far_end} does not answer within {timeout:g} s; check address and cable, and that the device is on"
            ) from error
        except socket.gaierror as error:
            raise LinkClosed(
                f"the name {host} is not known here ({error.strerror}); check it, or use the address"
            ) from error
        except ConnectionRefusedError as error:
            raise LinkClosed(
                f"nothing listens at {far_end}; check the port, and that network control is enabled on the device"
            ) from error
        except (OSError, OverflowError) as error:
            raise LinkClosed(f"cannot connect to {far_end}: {error}; check the address and the network") from error

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""
        try:
            self._limit(timeout)
            self._socket.sendall(data)
        except OSError as error:
            raise self._translated(error, f"{self._far_end} takes no data for {timeout:g} s") from error

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 … `limit` bytes, waiting at most `timeout` seconds for the first; see `Link.read`."""
        try:
            self._limit(timeout)
            data = self._socket.recv(limit)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._translated(error, f"{self._far_end} sent nothing for {timeout:g} s") from error
        if not data:
            raise LinkClosed(f"{self._far_end} hung up; open a new connection")
        return data

    def hang_up(self) -> None:
        """End the connection and wake a reader in another thread, which is to close it.

        Closed under a reader that is about to wait, its number may at once be that of another connection, and the
        reader waits for that one.
        """
        # A socket that the other side has left cannot be shut down any more, and need not be.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Hang up, and give the connection back; a reader in another thread is woken."""
        self.hang_up()
        self._socket.close()

    def _limit(self, timeout: float) -> None:
        # To set it is a system call, and most calls want what the last one wanted.
        if timeout != self._timeout:
            self._socket.settimeout(timeout)
            self._timeout = timeout

    def _translated(self, error: OSError, late: str) -> LinkError:
        if isinstance(error, (TimeoutError, BlockingIOError)):
            return LinkTimeout(f"{late}; check that the device is on and not busy with another controller")
        reason = error.strerror or str(error)
        return LinkClosed(f"the connection to {self._far_end} is lost ({reason}); open a new one")


class TcpServer(ClosedAtEnd):
    """Takes connections and gives each to `handle` in a thread of its own, until closed.

    Use it in a `with` block; leaving it hangs up every connection and joins every thread.
    """

    def __init__(self, handle: Callable[[TcpLink], None], port: int = 0) -> None:
        self._handle = handle
        try:
            self._listener = socket.create_server((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise LinkClosed(
                f"cannot listen at {LOOPBACK}:{port}: {error}; choose another port, 0 picks a free one"
            ) from error
        self._guard = threading.Lock()
        self._links: set[TcpLink] = set()
        self._threads: list[threading.Thread] = []
        self._closing = False
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        """Host and port on which it listens."""
        self._accepting = threading.Thread(target=self._accept, name=f"listening at {self.address[1]}", daemon=True)
        self._accepting.start()

    def hang_up(self) -> None:
        """End every connection there is, as a device does that restarts; new ones are still taken."""
        with self._guard:
            links = list(self._links)
        for link in links:
            link.hang_up()

    def close(self) -> None:
        """Stop listening, hang up and wait for the threads; a second call does nothing."""
        with self._guard:
            if self._closing:
                return
            self._closing = True
        # A connection of our own is the one portable way to wake a thread that waits in accept().
        with contextlib.suppress(OSError):
            socket.create_connection(self.address, 1).close()
        self._accepting.join()
        self._listener.close()
        self.hang_up()
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while True:
            try:
                connection, (host, port, *_) = self._listener.accept()
            except OSError:
                return
            with self._guard:
                if self._closing:
                    connection.close()
                    return
                link = TcpLink(connection, f"{host}:{port}")
                self._links.add(link)
                thread = threading.Thread(target=self._serve, args=(link,), name=f"serving {host}:{port}", daemon=True)
                self._threads = [other for other in self._threads if other.is_alive()]
                self._threads.append(thread)
                thread.start()

    def _serve(self, link: TcpLink) -> None:
        try:
            with contextlib.suppress(LinkError):
                self._handle(link)
        finally:
            link.close()
            with self._guard:
                self._links.discard(link)


POLLING_S = 0.02  # How often a peer is asked what it has to say by now: drivers wait seconds for an answer

_TIMEOUT_S = 30.0  # Longest wait for a client to take an answer


def serve_peer(peer: Callable[[], Peer], port: int = 0) -> TcpServer:
    """Return a running server that gives each connection a peer; close it."""

    def handle(link: TcpLink) -> None:
        there = peer()
        link.write(there.connect(), _TIMEOUT_S)
        while not there.closed:
            try:
                said = there.receive(link.read(4096, POLLING_S))
            except LinkTimeout:
                said = there.receive(b"")
            if said:
                link.write(said, _TIMEOUT_S)

    return TcpServer(handle, port)


ANY_HOST = "0.0.0.0"
BROADCAST = "255.255.255.255"
MAX_DATAGRAM = 65535  # The length field of UDP has 16 bits (RFC 768), so that no datagram is cut off

Address = tuple[str, int]


class UdpSocket(ClosedAtEnd):
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
        try:
            self._socket.settimeout(max(timeout, 0.0))
            data, (sender, sender_port, *_) = self._socket.recvfrom(MAX_DATAGRAM)
        except (TimeoutError, BlockingIOError) as error:
            raise LinkTimeout(f"no datagram came to {host}:{port} for {timeout:g} s") from error
        except OSError as error:
            raise LinkClosed(f"no more datagrams can be received at {host}:{port}: {error}") from error
        return data, (sender, sender_port)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()
