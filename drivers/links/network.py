"""TCP connections, TCP servers for simulated devices, and UDP datagrams.

Every error message names host and port. A datagram arrives complete or not at all. It may come from any sender, so the
caller must check its sender and content.
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

    def __init__(self, connection: socket.socket, address: str) -> None:
        self._socket = connection
        self._address = address
        self._timeout: float | None = None
        # Commands are short, and each one waits for its reply. Nagle's algorithm would only delay them.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @classmethod
    def connect(cls, host: str, port: int, timeout: float) -> TcpLink:
        """Open a connection within `timeout` seconds."""
        address = f"{host}:{port}"
        try:
            return cls(socket.create_connection((host, port), timeout), address)
        except TimeoutError as error:
            raise LinkTimeout(
                f"{address} has not answered within {timeout:g} s; check address and cable, and that the device is on"
            ) from error
        except socket.gaierror as error:
            raise LinkClosed(
                f"the name {host} cannot be resolved ({error.strerror}); correct the name, or use the address"
            ) from error
        except ConnectionRefusedError as error:
            raise LinkClosed(
                f"nothing listens at {address}; check the port, and that network control is enabled on the device"
            ) from error
        except (OSError, OverflowError) as error:
            raise LinkClosed(f"cannot connect to {address}: {error}; check the address and the network") from error

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""
        try:
            self._set_timeout(timeout)
            self._socket.sendall(data)
        except OSError as error:
            raise self._link_error(error, f"{self._address} accepted no data for {timeout:g} s") from error

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 to `limit` bytes; see `Link.read`."""
        try:
            self._set_timeout(timeout)
            data = self._socket.recv(limit)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._link_error(error, f"{self._address} sent nothing for {timeout:g} s") from error
        if not data:
            raise LinkClosed(f"{self._address} closed the connection; open a new one")
        return data

    def hang_up(self) -> None:
        """End the connection without closing its socket; a thread that is reading from it stops."""
        # Only the reading thread may close the socket. Otherwise the system could give its number to a new connection,
        # from which the thread would then read. The shutdown fails if the other side has already disconnected.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect and close the socket; a thread that is reading from it stops."""
        self.hang_up()
        self._socket.close()

    def _set_timeout(self, timeout: float) -> None:
        # Setting the timeout is a system call, which is not needed if the timeout is unchanged.
        if timeout != self._timeout:
            self._socket.settimeout(timeout)
            self._timeout = timeout

    def _link_error(self, error: OSError, timeout_message: str) -> LinkError:
        if isinstance(error, (TimeoutError, BlockingIOError)):
            return LinkTimeout(f"{timeout_message}; check that the device is on and not busy with another controller")
        reason = error.strerror or str(error)
        return LinkClosed(f"the connection to {self._address} is lost ({reason}); open a new connection")


class TcpServer(ClosedAtEnd):
    """A server on the loopback address that calls `handle` in a new thread for each connection.

    The end of its `with` block stops the server, closes all connections and waits for all threads.
    """

    def __init__(self, handle: Callable[[TcpLink], None], port: int = 0) -> None:
        self._handle = handle
        try:
            self._listener = socket.create_server((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            raise LinkClosed(
                f"cannot listen at {LOOPBACK}:{port}: {error}; choose another port, or 0 for any free port"
            ) from error
        self._lock = threading.Lock()
        self._links: set[TcpLink] = set()
        self._threads: list[threading.Thread] = []
        self._closing = False
        # Host and port where the server listens.
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._accepting = threading.Thread(target=self._accept, name=f"listening at {self.address[1]}", daemon=True)
        self._accepting.start()

    def hang_up(self) -> None:
        """Close all connections, like a device that restarts; new connections are still accepted."""
        with self._lock:
            links = list(self._links)
        for link in links:
            link.hang_up()

    def close(self) -> None:
        """Stop listening, close all connections and join the threads; a second call does nothing."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
        # On all systems, a new connection ends accept() in the other thread.
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
            with self._lock:
                if self._closing:
                    connection.close()
                    return
                link = TcpLink(connection, f"{host}:{port}")
                self._links.add(link)
                thread = threading.Thread(target=self._serve, args=(link,), name=f"serving {host}:{port}", daemon=True)
                self._threads = [running for running in self._threads if running.is_alive()]
                self._threads.append(thread)
                thread.start()

    def _serve(self, link: TcpLink) -> None:
        try:
            with contextlib.suppress(LinkError):
                self._handle(link)
        finally:
            link.close()
            with self._lock:
                self._links.discard(link)


POLLING_S = 0.02  # Interval at which a simulated device is polled for delayed replies, seconds
_TIMEOUT_S = 30.0  # Longest wait until the driver accepts a reply, seconds


def serve_peer(new_peer: Callable[[], Peer], port: int = 0) -> TcpServer:
    """Start a server that makes a new simulated device for each connection; the caller closes the server."""

    def handle(link: TcpLink) -> None:
        peer = new_peer()
        link.write(peer.connect(), _TIMEOUT_S)
        while not peer.closed:
            try:
                reply = peer.receive(link.read(4096, POLLING_S))
            except LinkTimeout:
                reply = peer.receive(b"")
            if reply:
                link.write(reply, _TIMEOUT_S)

    return TcpServer(handle, port)


ANY_HOST = "0.0.0.0"
BROADCAST = "255.255.255.255"
MAX_DATAGRAM = 65535  # Longest datagram, bytes; the length field of UDP has 16 bits (RFC 768)

Address = tuple[str, int]


class UdpSocket(ClosedAtEnd):
    """A UDP socket at one port; use it in a `with` block."""

    def __init__(self, port: int = 0, host: str = ANY_HOST) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise LinkClosed(
                f"cannot receive datagrams at {host}:{port}: {error}; close the other program that uses this port"
            ) from error
        # Host and port where datagrams arrive.
        self.address: Address = self._socket.getsockname()[:2]

    def send(self, data: bytes, address: Address) -> None:
        """Send one datagram to host and port; its arrival is not confirmed."""
        host, port = address
        try:
            self._socket.sendto(data, address)
        except (OSError, OverflowError) as error:
            raise LinkClosed(
                f"cannot send a datagram to {host}:{port}: {error}; check the address and the network"
            ) from error

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        """Return the next datagram and its sender; wait at most `timeout` seconds."""
        host, port = self.address
        try:
            self._socket.settimeout(max(timeout, 0.0))
            data, (sender, sender_port, *_) = self._socket.recvfrom(MAX_DATAGRAM)
        except (TimeoutError, BlockingIOError) as error:
            raise LinkTimeout(
                f"no datagram arrived at {host}:{port} within {timeout:g} s; check the network"
            ) from error
        except OSError as error:
            raise LinkClosed(f"cannot receive datagrams at {host}:{port}: {error}; open the port again") from error
        return data, (sender, sender_port)

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()
