"""USB/IP: an independent client uses the lent device, the kernel's bytes, and the PTP contract through it all."""

from __future__ import annotations

import contextlib
import itertools
import socket
import struct
import threading
from collections.abc import Iterator

import pytest
import usbip
import usbip.host
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.network import TcpServer
from drivers.links.usb import Pipe, PipeStalled
from drivers.ptp.protocol import PtpRequest, PtpResponse
from drivers.ptp.usb import ContainerReader, DataPiece, DataStart, UsbTransport, encode
from foundation.clock import SimulatedClock
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb import BULK_IN, BULK_OUT, INTERRUPT_IN, PtpUsbDevice, UsbIdentity
from sim.buses.usbip import ImportRequest, RequestReader, Submit, Unlink, UsbIpService, serve_usbip
from tests.contracts.transport import GIVE, HANG, PATIENCE_S, RAISE, Bench, Echo, TransportContract, payload
from tests.joined_links import JoinedLink, joined_links

ADDRESSES = {Pipe.BULK_OUT: BULK_OUT, Pipe.BULK_IN: BULK_IN, Pipe.INTERRUPT_IN: INTERRUPT_IN}
URB = struct.Struct(">IIIIIIiiii8s")


class UsbIpPipes:
    """The pipes of an imported device, as the kernel's vhci-hcd would work them; only what the tests need."""

    label = "the imported camera"
    packet_size = 512
    polling_s = 0.1

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), PATIENCE_S)
        self._socket.sendall(struct.pack(">HHI32s", 0x0111, 0x8003, 0, b"1-1"))
        assert self._exactly(8) == struct.pack(">HHI", 0x0111, 0x0003, 0)
        assert self._exactly(312)[256:259] == b"1-1"
        self._number = 0

    def bulk_write(self, data: bytes, timeout: float) -> None:
        self._submit(0, 2, len(data), b"", data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        return self._submit(1, 1, limit, b"", b"", timeout)

    def interrupt_read(self, timeout: float) -> bytes:
        try:
            return self._submit(1, 3, 8, b"", b"", timeout)
        except LinkTimeout:
            return b""

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        self._submit(0, 0, len(data), struct.pack("<BBHHH", 0x21, request, 0, 0, len(data)), data, timeout)

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        return self._submit(1, 0, limit, struct.pack("<BBHHH", 0xA1, request, 0, 0, limit), b"", timeout)

    def clear_halt(self, pipe: Pipe) -> None:
        self._submit(0, 0, 0, struct.pack("<BBHHH", 0x02, 1, 0, ADDRESSES[pipe], 0), b"", PATIENCE_S)

    def reset_port(self) -> None:
        raise AssertionError("no test comes here")

    def close(self) -> None:
        self._socket.close()

    def _submit(self, inward: int, endpoint: int, length: int, setup: bytes, data: bytes, timeout: float) -> bytes:
        self._number += 1
        number = self._number
        self._send(URB.pack(1, number, 0x10002, inward, endpoint, 0, length, 0, 0, 0, setup) + data)
        try:
            return self._returned(number, inward, timeout)
        except TimeoutError:
            self._number += 1
            self._send(URB.pack(2, self._number, 0x10002, 0, 0, number, 0, 0, 0, 0, b""))
            self._returned(self._number, 0, PATIENCE_S)
            raise LinkTimeout(f"{self.label}: nothing on endpoint {endpoint}") from None

    def _returned(self, number: int, inward: int, timeout: float) -> bytes:
        self._socket.settimeout(timeout)
        command, came, _, _, _, status, actual, *_ = URB.unpack(self._exactly(48))
        assert came == number
        signed = status - (1 << 32) if status >> 31 else status
        data = self._exactly(actual) if inward and command == 3 else b""
        if signed == -32:
            raise PipeStalled("stalled")
        assert signed in (0, -104)
        return data

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise LinkClosed("the imported camera is gone") from error

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            try:
                piece = self._socket.recv(count - len(data))
            except TimeoutError:
                raise
            except OSError as error:
                raise LinkClosed("the imported camera is gone") from error
            if not piece:
                raise LinkClosed("the imported camera is gone")
            data += piece
        return data


class TestLent(TransportContract):
    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        responder = Echo()
        with serve_usbip([PtpUsbDevice(responder)], 0) as server:
            transport = UsbTransport(UsbIpPipes(*server.address), SimulatedClock())
            yield Bench(transport, responder, server.close)
            transport.close()


@pytest.fixture
def lender() -> Iterator[TcpServer]:
    devices = [
        PtpUsbDevice(Echo()),
        PtpUsbDevice(Echo(), UsbIdentity(product=0x32CA, serial="77", name="EOS 6D Mark II")),
    ]
    before = set(threading.enumerate())
    with serve_usbip(devices, 0) as server:
        yield server
    assert set(threading.enumerate()) <= before


def test_a_client_by_others_finds_the_cameras(lender: TcpServer) -> None:
    found = usbip.host.list_devices(usbip.USBIP(*lender.address))
    assert [(entry["busid"], entry["idVendor"], entry["idProduct"]) for entry in found] == [
        ("1-1", 0x04A9, 0x31EA),
        ("1-2", 0x04A9, 0x32CA),
    ]
    assert all(entry["interfaces"] == [(6, 1, 1)] and entry["speed"] == 3 for entry in found)


def test_a_client_by_others_imports_a_camera_and_talks_to_it(lender: TcpServer) -> None:
    camera = usbip.open(0x04A9, 0x32CA, transport=usbip.USBIP(*lender.address))
    assert camera.device_descriptor.idProduct == 0x32CA
    assert camera.control(0x80, 6, 0x0302, 0x0409, 255)[2:].decode("utf-16-le") == "EOS 6D Mark II"
    camera.bulk_out(BULK_OUT, encode(PtpRequest(GIVE, 1, (1000,))))
    messages = ContainerReader().feed(camera.bulk_in(BULK_IN, 4096) + camera.bulk_in(BULK_IN, 512))
    assert messages == [DataStart(GIVE, 1, 1000), DataPiece(payload(1000), last=True), PtpResponse(0x2001, 1)]
    camera.bulk_out(BULK_OUT, encode(PtpRequest(RAISE, 2, (1,))))
    assert camera.interrupt_in(INTERRUPT_IN, 8) == bytes.fromhex("10000000040001c1")
    assert camera.interrupt_in(INTERRUPT_IN, 8) == bytes.fromhex("ffffffff00000000")
    camera.close()


def test_a_stall_is_told_and_cleared(lender: TcpServer) -> None:
    camera = usbip.open(0x04A9, 0x31EA, transport=usbip.USBIP(*lender.address))
    with pytest.raises(usbip.Stall):
        camera.bulk_out(BULK_OUT, b"this is no container")
    with pytest.raises(usbip.Stall):
        camera.bulk_in(BULK_IN, 512)
    with pytest.raises(usbip.Stall):
        camera.control(0x80, 6, 0x0600, 0, 10)
    camera.control(0x02, 1, 0, BULK_OUT, b"")
    camera.control(0x02, 1, 0, BULK_IN, b"")
    camera.control(0x21, 0x66, 0, 0, b"")
    camera.bulk_out(BULK_OUT, encode(PtpRequest(GIVE, 1, (0,))))
    assert len(camera.bulk_in(BULK_IN, 512)) == 12
    camera.close()


def test_what_is_lent_or_missing_is_refused(lender: TcpServer) -> None:
    first = usbip.open(busid="1-1", transport=usbip.USBIP(*lender.address))
    for bus_id in (b"1-1", b"1-9"):
        with socket.create_connection(lender.address, PATIENCE_S) as second:
            second.sendall(struct.pack(">HHI32s", 0x0111, 0x8003, 0, bus_id))
            assert second.recv(100) == bytes.fromhex("0111 0003 00000001")
    first.close()


class Conversation:
    """A connection in this thread: the service runs until it has read all that was written."""

    def __init__(self, responder: Echo) -> None:
        self._near, far = joined_links()
        self._far = _Once(far)
        self._service = UsbIpService([PtpUsbDevice(responder)])

    def say(self, *requests: bytes) -> bytes:
        self._near.write(b"".join(requests), PATIENCE_S)
        with pytest.raises(LinkClosed):
            self._service.handle(self._far)
        return self._near.read(1 << 20, 0)


class _Once:
    """A link that is closed once nothing more waits to be read."""

    def __init__(self, good: JoinedLink) -> None:
        self._good = good

    def read(self, limit: int, timeout: float) -> bytes:
        if data := self._good.read(limit, 0.0):
            return data
        raise LinkClosed("the end of the conversation")

    def write(self, data: bytes, timeout: float) -> None:
        self._good.write(data, timeout)

    def close(self) -> None:
        self._good.close()


IMPORT = bytes.fromhex("0111 8003 00000000") + b"1-1".ljust(32, b"\0")


def submit(number: int, inward: int, endpoint: int, length: int, data: bytes = b"", flags: int = 0) -> bytes:
    return URB.pack(1, number, 0x10002, inward, endpoint, flags, length, 0, 0, 0, b"") + data


def results(heard: bytes) -> list[tuple[int, int, int, bytes]]:
    """Return command, number, status and data of what came after the import."""
    heard = heard[8 + 312 :]
    found: list[tuple[int, int, int, bytes]] = []
    while heard:
        command, number, device, direction, endpoint, status, actual, *rest = URB.unpack_from(heard)
        assert (device, direction, endpoint) == (0, 0, 0)
        assert rest == [0, 0, 0, bytes(8)], "no isochronous transfer"
        assert command == 3 or actual == 0
        body = actual if command == 3 and number < 100 else 0
        found.append((command, number, status - (1 << 32) if status >> 31 else status, heard[48 : 48 + body]))
        heard = heard[48 + body :]
    return found


def test_transfers_in_end_in_their_order_once_there_is_something() -> None:
    command = encode(PtpRequest(GIVE, 1, (4,)))
    heard = Conversation(Echo()).say(
        IMPORT, submit(1, 1, 1, 512), submit(2, 1, 1, 512), submit(100, 0, 2, len(command), command)
    )
    assert [(command, number, status, len(data)) for command, number, status, data in results(heard)] == [
        (3, 100, 0, 0),
        (3, 1, 0, 16),
        (3, 2, 0, 12),
    ]


def test_the_rest_of_a_read_that_came_up_short_is_held() -> None:
    command = encode(PtpRequest(GIVE, 1, (4,)))
    conversation = (
        IMPORT,
        submit(1, 1, 1, 1024, flags=1),
        submit(2, 1, 1, 512),
        submit(100, 0, 2, len(command), command),
    )
    assert [entry[1:3] for entry in results(Conversation(Echo()).say(*conversation))] == [(100, 0), (1, -121)]


def test_a_full_packet_is_closed_where_the_flag_asks() -> None:
    request = encode(PtpRequest(0x9F03, 1))
    data = (512).to_bytes(4, "little") + bytes.fromhex("0200 039f 01000000") + bytes(500)
    for flags, answered in ((0, False), (0x40, True)):
        heard = Conversation(Echo()).say(
            IMPORT,
            submit(1, 1, 1, 512),
            submit(100, 0, 2, len(request), request),
            submit(101, 0, 2, len(data), data, flags),
        )
        assert (1 in [number for _, number, _, _ in results(heard)]) == answered


def test_a_silent_device_keeps_nobody_from_leaving() -> None:
    command = encode(PtpRequest(HANG, 1))
    responder = Echo()
    Conversation(responder).say(IMPORT, submit(1, 1, 1, 512), submit(100, 0, 2, len(command), command))
    assert responder.unplugs == 1


@given(cuts=st.lists(st.integers(0, 200), max_size=6))
def test_any_split_of_the_stream_gives_the_same_requests(cuts: list[int]) -> None:
    stream = IMPORT + submit(1, 0, 2, 5, b"hello") + URB.pack(2, 2, 1, 0, 0, 1, 0, 0, 0, 0, b"") + submit(3, 1, 3, 8)
    reader = RequestReader()
    places = sorted({0, len(stream), *(min(cut, len(stream)) for cut in cuts)})
    found = [request for start, end in itertools.pairwise(places) for request in reader.feed(stream[start:end])]
    assert found == [
        ImportRequest("1-1"),
        Submit(1, False, 2, 0, 5, bytes(8), b"hello"),
        Unlink(2, 1),
        Submit(3, True, 3, 0, 8, bytes(8)),
    ]


@given(st.binary(min_size=0, max_size=200), st.booleans())
def test_garbage_is_a_protocol_error_or_incomplete(garbage: bytes, imported: bool) -> None:
    reader = RequestReader()
    if imported:
        reader.feed(IMPORT)
    with contextlib.suppress(ProtocolError):
        reader.feed(garbage)
