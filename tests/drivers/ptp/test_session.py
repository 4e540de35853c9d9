"""A session's opening, numbering and patience, against a scripted cable."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.ptp.codes import Operation, ResponseCode
from drivers.ptp.session import (
    LAST_TRANSACTION,
    OPEN_TRIES,
    PASSING_LIMIT_S,
    OperationDeclined,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    PtpSession,
    Transaction,
)
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.clock import SimulatedClock


class Scripted:
    """A cable that answers from a script of response codes and errors, OK when it is over."""

    label = "the scripted camera"

    def __init__(self, *script: int | Exception) -> None:
        self.script = list(script)
        self.asked: list[PtpRequest] = []
        self.resets = 0

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        self.asked.append(request)
        step = self.script.pop(0) if self.script else ResponseCode.OK
        if isinstance(step, Exception):
            raise step
        return Transaction(PtpResponse(step, request.transaction, (7,)), b"data")

    def events(self) -> tuple[PtpEvent, ...]:
        return (PtpEvent(0xC101),)

    def reset(self) -> None:
        self.resets += 1

    def close(self) -> None: ...


def opened(*script: int | Exception) -> tuple[PtpSession, Scripted, SimulatedClock]:
    cable, clock = Scripted(*script), SimulatedClock()
    session = PtpSession(cable, clock)
    session.open()
    return session, cable, clock


@pytest.mark.parametrize("answer", [ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN])
def test_opens_with_number_0_and_counts_from_1(answer: int) -> None:
    session, cable, _ = opened(answer)
    assert session.call(Operation.GET_DEVICE_INFO) == ((7,), b"data")
    session.close()
    assert cable.asked == [PtpRequest(0x1002, 0, (1,)), PtpRequest(0x1001, 1), PtpRequest(0x1003, 2)]


def test_takes_the_next_session_number_where_one_is_not_taken() -> None:
    _, cable, _ = opened(ResponseCode.INVALID_TRANSACTION_ID, ResponseCode.INVALID_TRANSACTION_ID)
    assert [request.parameters for request in cable.asked] == [(1,), (2,), (3,)]


def test_resets_a_silent_body_and_tries_again() -> None:
    _, cable, _ = opened(LinkTimeout("silent"), ProtocolError("garbage"))
    assert (len(cable.asked), cable.resets) == (OPEN_TRIES, OPEN_TRIES - 1)


@pytest.mark.parametrize("fault", [LinkTimeout("silent"), ProtocolError("garbage")])
def test_gives_up_on_a_body_that_stays_silent(fault: Exception) -> None:
    with pytest.raises(type(fault)):
        opened(*[fault] * OPEN_TRIES)


def test_a_body_that_is_gone_is_not_asked_again() -> None:
    cable = Scripted(LinkClosed("gone"))
    with pytest.raises(LinkClosed):
        PtpSession(cable, SimulatedClock()).open()
    assert len(cable.asked) == 1


def test_an_opening_that_is_refused_is_refused() -> None:
    with pytest.raises(DeviceRefused, match=r"answers ACCESS_DENIED \(0x200f\) to OPEN_SESSION \(0x1002\)\(0x1\)"):
        opened(ResponseCode.ACCESS_DENIED)


@pytest.mark.parametrize("code", [0x2019, 0xA102, 0xA106])
def test_what_is_declined_for_the_moment_is_asked_again_under_a_new_number(code: int) -> None:
    session, cable, clock = opened(ResponseCode.OK, code, code, code)
    session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert [request.transaction for request in cable.asked[1:]] == [1, 2, 3, 4]
    assert clock.monotonic() == pytest.approx(0.05 + 0.1 + 0.2)


def test_patience_ends_by_the_clock() -> None:
    session, _, clock = opened(ResponseCode.OK, *[0x2019] * 1000)
    with pytest.raises(OperationDeclined, match="wait until it is idle") as caught:
        session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert caught.value.code == 0x2019
    assert clock.monotonic() == pytest.approx(PASSING_LIMIT_S)


def test_no_patience_asks_once() -> None:
    session, cable, clock = opened(ResponseCode.OK, 0x2019)
    with pytest.raises(OperationDeclined):
        session.call(Operation.EOS_REMOTE_RELEASE_ON, 3, 1, retry_s=0.0)
    assert (len(cable.asked), clock.monotonic()) == (2, 0.0)


def test_every_other_answer_is_told_by_its_name_at_once() -> None:
    session, cable, _ = opened(ResponseCode.OK, 0x200F)
    with pytest.raises(DeviceRefused, match=r"the scripted camera answers ACCESS_DENIED \(0x200f\)"):
        session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert len(cable.asked) == 2


def test_numbers_begin_anew_after_the_last() -> None:
    session, cable, _ = opened()
    session._transaction = LAST_TRANSACTION - 1  # pyright: ignore[reportPrivateUsage] - four thousand million calls later
    for _ in range(3):
        session.call(Operation.EOS_KEEP_DEVICE_ON)
    assert [request.transaction for request in cable.asked[1:]] == [0xFFFFFFFE, 1, 2]


def test_closing_a_session_on_a_dead_cable_does_nothing() -> None:
    session, _, _ = opened(ResponseCode.OK, LinkClosed("gone"))
    session.close()
