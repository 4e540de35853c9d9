"""Speed of PTP over CroP's cables: `python -m benchmarks.ptp` prints one JSON object per line.

Camera and computer are simulated in this process and share its processor. They are connected over loopback and over the
simulated USB bus. Each measurement takes turns with the program that it is compared with. Speeds are the best of all
turns; ratios are the median over the turns.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from statistics import median

from drivers.links.network import LOOPBACK
from drivers.links.usb import open_usb
from drivers.ptp.codes import Operation, ResponseCode
from drivers.ptp.ip import READ, IpTransport
from drivers.ptp.protocol import Answer, PtpEvent, PtpRequest, PtpResponse, Transport
from drivers.ptp.usb import UsbTransport
from foundation.clock import SystemClock
from sim.buses.ptp import serve_ptpip
from sim.buses.usb import PtpUsbDevice, SimulatedBus

# 30 MB, the size of a raw file.
OBJECT = bytes(range(256)) * 117_188
DOWNLOADS = 21
TURNS = 5
OPERATIONS = 2000
TIMEOUT_S = 10.0


class Store:
    """A device that holds one object and answers all other requests with success."""

    def takes_data(self, request: PtpRequest) -> bool:
        return False

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        content = OBJECT if request.code == Operation.GET_OBJECT else None
        return Answer(PtpResponse(ResponseCode.OK, request.transaction), content)

    def events(self) -> tuple[PtpEvent, ...]:
        return ()

    def cancelled(self, transaction: int) -> None: ...

    def unplugged(self) -> None: ...


class Plain:
    """A socket that answers a ``1`` with one byte, and any other byte with the object."""

    def __init__(self) -> None:
        self._listener = socket.create_server((LOOPBACK, 0))
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        self._socket = socket.create_connection(self._listener.getsockname())
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = bytearray(READ)

    def download(self) -> None:
        self._socket.sendall(b"0")
        missing = len(OBJECT)
        while missing:
            missing -= self._socket.recv_into(self._buffer)

    def exchange(self) -> None:
        self._socket.sendall(b"1")
        self._socket.recv(1)

    def close(self) -> None:
        self._socket.close()
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection:
            while word := connection.recv(1):
                connection.sendall(OBJECT if word == b"0" else word)


def time_s(work: Callable[[], object]) -> float:
    """Return the duration of `work`, in seconds."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def turns(runs: int, *works: Callable[[], object]) -> list[list[float]]:
    """Return the times of each work over several turns, in seconds."""
    return [list(times) for times in zip(*([time_s(work) for work in works] for _ in range(runs)), strict=True)]


def ratio(to: list[float], of: list[float]) -> float:
    """Return the median speed ratio of `of` to `to`."""
    return median(to_s / of_s for to_s, of_s in zip(to, of, strict=True))


def download(transport: Transport) -> None:
    received = 0

    def take(piece: bytes) -> None:
        nonlocal received
        received += len(piece)

    transport.transact(PtpRequest(Operation.GET_OBJECT, 1, (1,)), receive=take, timeout=TIMEOUT_S)
    assert received == len(OBJECT)


def operate(transport: Transport) -> None:
    for number in range(OPERATIONS):
        transport.transact(PtpRequest(Operation.EOS_KEEP_DEVICE_ON, number), timeout=TIMEOUT_S)


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def main() -> None:
    bus = SimulatedBus()
    bus.plug(PtpUsbDevice(Store()))
    over_usb = UsbTransport(open_usb(backend=bus), SystemClock())
    plain = Plain()
    with serve_ptpip(Store(), 0) as server:
        over_ip = IpTransport.connect(*server.address, guid=bytes(16), name="CroP", clock=SystemClock())
        by_socket, by_ip, by_usb = turns(
            DOWNLOADS, plain.download, lambda: download(over_ip), lambda: download(over_usb)
        )
        exchanging, operating_ip, operating_usb = turns(
            TURNS,
            lambda: [plain.exchange() for _ in range(OPERATIONS)],
            lambda: operate(over_ip),
            lambda: operate(over_usb),
        )
        over_ip.close()
    over_usb.close()
    plain.close()

    size = len(OBJECT) / 1e6
    report("PTP/IP download of 30 MB", size / min(by_ip), "MB/s", "none")
    report(
        "PTP/IP download / plain socket",
        ratio(by_socket, by_ip),
        "1",
        "a plain socket copy in the same run; at least 0.5",
    )
    report("PTP/IP operations", OPERATIONS / min(operating_ip), "1/s", "none")
    report(
        "PTP/IP operations / plain socket", ratio(exchanging, operating_ip), "1", "one byte in each direction, same run"
    )
    report("USB download of 30 MB, simulated bus", size / min(by_usb), "MB/s", "35 to 40 MB/s of high speed")
    report("USB operations, simulated bus", OPERATIONS / min(operating_usb), "1/s", "none")


if __name__ == "__main__":
    main()
