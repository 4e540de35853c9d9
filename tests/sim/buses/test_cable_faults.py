"""Trouble on purpose: each wrapper does what it says, when it says, and otherwise nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.links.usb import open_usb
from drivers.ptp.codes import ResponseCode
from drivers.ptp.session import PtpEvent, PtpRequest, Responder, Transport
from drivers.ptp.usb import UsbTransport
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb import MemoryTransport, PtpUsbDevice, SimulatedBus
from sim.clock import SimulatedClock
from tests.cable_faults import (
    Declining,
    DelayingEvents,
    Falsifying,
    Hanging,
    Interrupting,
    LosingEvents,
    LosingResponses,
    Occasion,
    PulledOut,
    RepeatingEvents,
    UnknownEvents,
)
from tests.contracts.transport import ECHO, GIVE, PATIENCE_S, RAISE, TAKE, Echo, payload


def ask(transport: Transport, code: int, *parameters: int) -> int:
    return transport.transact(PtpRequest(code, 1, parameters), timeout=PATIENCE_S).response.code


def test_an_occasion_counts_its_own_operations() -> None:
    occasion = Occasion({GIVE}, after=1, times=2)
    asked = [GIVE, ECHO, GIVE, GIVE, ECHO, GIVE]
    assert [occasion.has_come(code) for code in asked] == [False, False, True, True, False, False]
    for_ever = Occasion(times=None, after=2)
    assert [for_ever.has_come(ECHO) for _ in range(5)] == [False, False, True, True, True]


def test_declining_carries_nothing_out() -> None:
    echo = Echo()
    transport = MemoryTransport(Declining(echo, ResponseCode.DEVICE_BUSY, Occasion({RAISE}, times=2)))
    answers = [ask(transport, code, 1) for code in (RAISE, ECHO, RAISE, RAISE)]
    assert answers == [ResponseCode.DEVICE_BUSY, ResponseCode.OK, ResponseCode.DEVICE_BUSY, ResponseCode.OK]
    assert len(transport.events()) == 1


def test_a_declined_data_phase_is_still_taken() -> None:
    transport = MemoryTransport(Declining(Echo(), ResponseCode.STORE_FULL, Occasion()))
    done = transport.transact(PtpRequest(TAKE, 1), send=bytes(5000), timeout=PATIENCE_S)
    assert done.response.code == ResponseCode.STORE_FULL
    assert ask(transport, ECHO) == ResponseCode.OK


@pytest.mark.parametrize("obeys", [False, True])
def test_hanging_is_silence(obeys: bool) -> None:
    transport = MemoryTransport(Hanging(Echo(), Occasion({RAISE}), obeys=obeys))
    with pytest.raises(LinkTimeout):
        ask(transport, RAISE, 1)
    transport.reset()
    assert ask(transport, ECHO) == ResponseCode.OK
    assert len(transport.events()) == int(obeys)


@pytest.mark.parametrize("number", range(4))
def test_a_restart_at_any_operation_closes_the_cable_and_comes_back(number: int) -> None:
    bus = SimulatedBus()
    echo = Echo()
    device: list[PtpUsbDevice] = []
    trouble = Interrupting(echo, lambda: bus.replug(device[0]), Occasion(after=number))
    device.append(PtpUsbDevice(trouble))
    bus.plug(device[0])
    transport = UsbTransport(open_usb(backend=bus), SimulatedClock())
    for _ in range(number):
        assert ask(transport, GIVE, 1000) == ResponseCode.OK
    with pytest.raises(LinkClosed):
        ask(transport, GIVE, 1000)
    assert echo.unplugs == 1
    transport.close()
    again = UsbTransport(open_usb(serial=device[0].identity.serial, backend=bus), SimulatedClock())
    done = again.transact(PtpRequest(GIVE, 1, (1000,)), timeout=PATIENCE_S)
    assert done.data == payload(1000)


def _shorter(data: bytes) -> bytes:
    return data[:-1]


def _longer(data: bytes) -> bytes:
    return data + b"more"


def _empty(data: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("change", [_shorter, _longer, _empty])
def test_objects_of_another_size_come_through_as_they_are(change: Callable[[bytes], bytes]) -> None:
    transport = MemoryTransport(Falsifying(Echo(), change, Occasion({GIVE})))
    done = transport.transact(PtpRequest(GIVE, 1, (1000,)), timeout=PATIENCE_S)
    assert done.data == change(payload(1000))
    assert transport.transact(PtpRequest(GIVE, 1, (1000,)), timeout=PATIENCE_S).data == payload(1000)


def told(responder: Responder, calls: int = 1) -> list[tuple[PtpEvent, ...]]:
    transport = MemoryTransport(responder)
    ask(transport, RAISE, 2)
    return [transport.events() for _ in range(calls)]


A, B = PtpEvent(0xC101, parameters=(0,)), PtpEvent(0xC101, parameters=(1,))
UNKNOWN = PtpEvent(0xC1FF)


def test_events_in_trouble() -> None:
    assert told(Echo()) == [(A, B)]
    assert told(LosingEvents(Echo())) == [()]
    assert told(RepeatingEvents(Echo())) == [(A, A, B, B)]
    assert told(UnknownEvents(Echo(), UNKNOWN)) == [(UNKNOWN, A, UNKNOWN, B)]
    # The bus asks until there is nothing: a call of ours is two of the device's.
    assert [bool(events) for events in told(DelayingEvents(Echo(), 2), 4)] == [False, False, True, False]


def test_a_lost_response_was_carried_out() -> None:
    transport = LosingResponses(MemoryTransport(Echo()), Occasion({RAISE}))
    with pytest.raises(LinkTimeout, match="on purpose"):
        ask(transport, RAISE, 1)
    assert len(transport.events()) == 1
    assert ask(transport, ECHO) == ResponseCode.OK


def test_pulled_out_stays_out() -> None:
    transport = PulledOut(MemoryTransport(Echo()), Occasion(after=1))
    assert ask(transport, ECHO) == ResponseCode.OK
    for _ in range(2):
        with pytest.raises(LinkClosed):
            ask(transport, ECHO)


def test_wrappers_can_be_wrapped() -> None:
    trouble = RepeatingEvents(Declining(Echo(), ResponseCode.DEVICE_BUSY, Occasion({ECHO})), 3)
    transport = MemoryTransport(trouble)
    assert ask(transport, ECHO) == ResponseCode.DEVICE_BUSY
    assert ask(transport, RAISE, 1) == ResponseCode.OK
    assert len(transport.events()) == 3
    with pytest.raises(ProtocolError):
        transport.transact(PtpRequest(GIVE, 1, (5_000_000,)), timeout=PATIENCE_S)
