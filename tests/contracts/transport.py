"""Contract tests of every PTP cable; a suite supplies its cable with the fixture `bench`."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.ptp.codes import ResponseCode
from drivers.ptp.protocol import MAX_COLLECTED, Answer, NoAnswer, PtpEvent, PtpRequest, PtpResponse, Transport
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError

# Time limit for expected data; reached only by a failing test.
PATIENCE_S = 10.0
# Time limit for data that never arrive.
GIVE_UP_S = 0.05

# Answers with the parameters of the request.
ECHO = 0x9F01
# Sends as many bytes of data as its parameter gives.
GIVE = 0x9F02
# Takes data, and answers with their length and CRC-32.
TAKE = 0x9F03
# Answers busy instead of sending data.
REFUSE = 0x9F04
# Sends data, then reports an incomplete transfer.
BREAK_OFF = 0x9F05
# Raises as many events as its parameter gives.
RAISE = 0x9F06
# Never answers.
HANG = 0x9F07
# Answers with the number of another transaction.
MIX_UP = 0x9F08

# Payload sizes at which packets, pieces or reads are just full; 500 bytes and a header of 12 make a packet of 512.
EDGES = (
    0,
    1,
    499,
    500,
    501,
    512,
    1012,
    1024,
    65524,
    65535,
    65536,
    65537,
    131072,
    262132,
    262144,
    524276,
    524288,
    786432,
)


def payload(size: int) -> bytes:
    """Return `size` bytes without short repetitions."""
    return (bytes(range(251)) * (size // 251 + 1))[:size]


@dataclass
class Echo:
    """A `drivers.ptp.protocol.Responder` that carries out the operations above."""

    raised: list[PtpEvent] = field(default_factory=list[PtpEvent])
    cancellations: list[int] = field(default_factory=list[int])
    unplugs: int = 0

    def takes_data(self, request: PtpRequest) -> bool:
        return request.code == TAKE

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        transaction = request.transaction
        ok = PtpResponse(ResponseCode.OK, transaction)
        match request.code:
            case 0x9F01:
                return Answer(PtpResponse(ResponseCode.OK, transaction, request.parameters))
            case 0x9F02:
                return Answer(ok, payload(request.parameters[0]))
            case 0x9F03:
                received = data or b""
                return Answer(PtpResponse(ResponseCode.OK, transaction, (len(received), zlib.crc32(received))))
            case 0x9F05:
                return Answer(PtpResponse(ResponseCode.INCOMPLETE_TRANSFER, transaction), payload(1000))
            case 0x9F06:
                self.raised += [PtpEvent(0xC101, parameters=(number,)) for number in range(request.parameters[0])]
                return Answer(ok)
            case 0x9F07:
                raise NoAnswer
            case 0x9F08:
                return Answer(PtpResponse(ResponseCode.OK, transaction + 1))
            case _:
                return Answer(PtpResponse(ResponseCode.DEVICE_BUSY, transaction))

    def events(self) -> tuple[PtpEvent, ...]:
        events = tuple(self.raised)
        self.raised.clear()
        return events

    def cancelled(self, transaction: int) -> None:
        self.cancellations.append(transaction)

    def unplugged(self) -> None:
        self.unplugs += 1


@dataclass
class Bench:
    """A cable under test, the device at its far end, and a function that disconnects it."""

    transport: Transport
    device: Echo
    pull: Callable[[], None]


class TransportContract:
    """Subclass it as ``TestX`` and supply the fixture `bench`."""

    def test_transfers_a_transaction_without_data(self, bench: Bench) -> None:
        for count in range(6):
            parameters = tuple(0xFFFFFFFF - number for number in range(count))
            request = PtpRequest(ECHO, 7 + count, parameters)
            transaction = bench.transport.transact(request, timeout=PATIENCE_S)
            assert transaction.response == PtpResponse(ResponseCode.OK, 7 + count, parameters)
            assert transaction.data == b""

    @pytest.mark.slow
    def test_transfers_full_packets_in_both_directions(self, bench: Bench) -> None:
        for size in EDGES:
            _give(bench, size)
            _take(bench, size)
            _give(bench, 3)

    # The contract is shared by many cables, and a cable may be used for many transactions.
    @settings(
        max_examples=40,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.differing_executors],
    )
    @pytest.mark.slow
    @given(size=st.integers(0, 5000) | st.integers(1, 200).map(lambda packets: 512 * packets - 12))
    def test_transfers_any_size_in_both_directions(self, bench: Bench, size: int) -> None:
        _give(bench, size)
        _take(bench, size)

    @pytest.mark.slow
    def test_pieces_form_the_data(self, bench: Bench) -> None:
        pieces: list[bytes] = []
        request = PtpRequest(GIVE, 1, (5_000_000,))
        transaction = bench.transport.transact(request, receive=pieces.append, timeout=PATIENCE_S)
        assert transaction.response.ok
        assert transaction.data == b""
        assert b"".join(pieces) == payload(5_000_000)
        assert len(pieces) > 4, "an object must not be held in memory as a whole"

    @pytest.mark.slow
    def test_refuses_too_much_data(self, bench: Bench) -> None:
        _give(bench, MAX_COLLECTED)
        with pytest.raises(ProtocolError):
            bench.transport.transact(PtpRequest(GIVE, 1, (MAX_COLLECTED + 1,)), timeout=PATIENCE_S)

    def test_returns_error_instead_of_data(self, bench: Bench) -> None:
        transaction = bench.transport.transact(PtpRequest(REFUSE, 3), timeout=PATIENCE_S)
        assert transaction.response == PtpResponse(ResponseCode.DEVICE_BUSY, 3)
        _give(bench, 100)

    def test_returns_error_after_data(self, bench: Bench) -> None:
        transaction = bench.transport.transact(PtpRequest(BREAK_OFF, 3), timeout=PATIENCE_S)
        assert transaction.response.code == ResponseCode.INCOMPLETE_TRANSFER
        _give(bench, 100)

    def test_reports_events_once_and_in_order(self, bench: Bench) -> None:
        assert bench.transport.events() == ()
        bench.transport.transact(PtpRequest(RAISE, 1, (20,)), timeout=PATIENCE_S)
        assert [event.parameters for event in _next_events(bench, 20)] == [(number,) for number in range(20)]
        assert bench.transport.events() == ()

    def test_resets_silent_device(self, bench: Bench) -> None:
        with pytest.raises(LinkTimeout):
            bench.transport.transact(PtpRequest(HANG, 1), timeout=GIVE_UP_S)
        with pytest.raises(ProtocolError):
            bench.transport.transact(PtpRequest(ECHO, 2), timeout=PATIENCE_S)
        bench.transport.reset()
        assert bench.device.unplugs == 1
        _give(bench, 100)

    def test_refuses_response_of_other_transaction(self, bench: Bench) -> None:
        with pytest.raises(ProtocolError, match="transaction 6"):
            bench.transport.transact(PtpRequest(MIX_UP, 5), timeout=PATIENCE_S)
        bench.transport.reset()
        _give(bench, 100)

    def test_continues_after_failed_receiver(self, bench: Bench) -> None:
        with pytest.raises(_DiskFullError):
            bench.transport.transact(PtpRequest(GIVE, 4, (3_000_000,)), receive=_full, timeout=PATIENCE_S)
        _give(bench, 100)
        assert bench.device.unplugs == 0

    def test_unplugged_cable_is_closed(self, bench: Bench) -> None:
        _give(bench, 100)
        bench.pull()
        for _ in range(2):
            with pytest.raises(LinkClosed):
                bench.transport.transact(PtpRequest(GIVE, 2, (100,)), timeout=PATIENCE_S)

    def test_closed_cable_refuses_requests(self, bench: Bench) -> None:
        bench.transport.close()
        bench.transport.close()
        with pytest.raises(LinkClosed):
            bench.transport.transact(PtpRequest(ECHO, 1), timeout=PATIENCE_S)

    def test_times_out_with_label(self, bench: Bench) -> None:
        assert bench.transport.label
        with pytest.raises(LinkTimeout):
            bench.transport.transact(PtpRequest(HANG, 1), timeout=GIVE_UP_S)


class _DiskFullError(Exception):
    pass


def _full(piece: bytes) -> None:
    raise _DiskFullError


def _next_events(bench: Bench, count: int) -> list[PtpEvent]:
    """Return the next `count` events: on a network they may arrive after the response."""
    events: list[PtpEvent] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(events) < count and time.monotonic() < deadline:
        events.extend(bench.transport.events())
    return events


def _give(bench: Bench, size: int) -> None:
    transaction = bench.transport.transact(PtpRequest(GIVE, 1, (size,)), timeout=PATIENCE_S)
    assert transaction.response == PtpResponse(ResponseCode.OK, 1)
    assert transaction.data == payload(size)


def _take(bench: Bench, size: int) -> None:
    data = payload(size)
    transaction = bench.transport.transact(PtpRequest(TAKE, 2), send=data, timeout=PATIENCE_S)
    assert transaction.response.parameters == (size, zlib.crc32(data))
