"""The JVC flat field: conversations in the specification's bytes, the presenter contract, and troubled cables."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.display import jvc
from drivers.display.jvc import JvcFlatField
from drivers.links.link import PeerLink
from drivers.links.network import TcpLink, serve_peer
from drivers.presenter import BLACK, WHITE, Colour
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.projectors.jvc import JvcPeer
from sim.projectors.projector import Screen
from tests.contracts.presenter import Bench, PresenterContract
from tests.drivers.script import Script

ACKNOWLEDGED = b"\x06\x89\x01SS\n"


class TestOverMemory(PresenterContract):
    @pytest.fixture
    def bench(self) -> Bench:
        screen = Screen(WHITE)
        peer = JvcPeer(screen)
        return Bench(JvcFlatField(lambda: PeerLink(peer), clock=SimulatedClock()), lambda: screen.colour)


class TestOverTcp(PresenterContract):
    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        screen = Screen(WHITE)
        with serve_peer(lambda: JvcPeer(screen)) as server:
            presenter = JvcFlatField(lambda: TcpLink.connect(*server.address, 5.0))
            yield Bench(presenter, lambda: screen.colour)
            presenter.close()


def colour(red: bytes, green: bytes, blue: bytes) -> list[bytes]:
    commands = (b"SSTP02", b"SSFR" + red, b"SSFG" + green, b"SSFB" + blue)
    return [line for command in commands for line in (b"!\x89\x01" + command + b"\n", ACKNOWLEDGED)]


def test_speaks_as_specified() -> None:
    script = Script(
        b"PJ_OK", b"PJREQ", b"PJACK",
        *colour(b"0000", b"0000", b"0000"), *colour(b"00FF", b"0080", b"000A"), *colour(b"0000", b"0000", b"0000"),
    )  # fmt: skip
    presenter = JvcFlatField(lambda: script, clock=SimulatedClock())
    presenter.show(Colour(255, 128, 10))
    presenter.close()
    assert script.ended()
    assert script.closed


def test_an_answer_may_come_in_pieces() -> None:
    lines = [b"PJ", b"_OK", b"PJREQ", b"PJACK", *colour(b"0000", b"0000", b"0000")]
    lines[5:6] = [b"\x06", b"\x89\x01SS", b"\n"]
    JvcFlatField(lambda: Script(*lines), clock=SimulatedClock())


@pytest.mark.parametrize(
    ("lines", "kind", "reason"),
    [
        ((b"PJ_NG",), DeviceRefused, "another controller"),
        ((b"PJ_OK", b"PJREQ", b"PJNAK"), DeviceRefused, "password"),
        ((b"PJLINK 0\r",), ProtocolError, "answers b'PJLIN' in place of b'PJ_OK'"),
        ((b"PJ_OK", b"PJREQ", b"PJACK", b"!\x89\x01SSTP02\n"), LinkTimeout, "within 5 s"),
        ((b"PJ_OK", b"PJREQ", b"PJACK", b"!\x89\x01SSTP02\n", b"\x06\x89\x01PW\n"), ProtocolError, "in place of"),
    ],
)
def test_what_goes_wrong_is_named(lines: tuple[bytes, ...], kind: type[DeviceError], reason: str) -> None:
    script = Script(*lines)
    with pytest.raises(kind, match=reason):
        JvcFlatField(lambda: script, clock=SimulatedClock())
    assert script.closed


def test_connects_again_when_the_projector_hung_up() -> None:
    screen = Screen()
    peer = JvcPeer(screen)
    presenter = JvcFlatField(lambda: PeerLink(peer), clock=SimulatedClock())
    peer.hang_up()
    presenter.show(Colour(9, 8, 7))
    assert screen.colour == Colour(9, 8, 7)


@pytest.mark.parametrize("told", [1, 2, 3])
def test_what_was_told_before_a_connection_was_lost_is_told_again(told: int) -> None:
    black, grey = colour(b"0000", b"0000", b"0000"), colour(b"0009", b"0009", b"0009")
    first = Script(b"PJ_OK", b"PJREQ", b"PJACK", *black, *grey[: 2 * told], None)
    second = Script(b"PJ_OK", b"PJREQ", b"PJACK", *grey[2 * told :], *grey)
    scripts = [first, second]
    JvcFlatField(lambda: scripts.pop(0), clock=SimulatedClock()).show(Colour(9, 9, 9))
    assert first.closed
    assert second.ended()


def test_a_projector_that_is_gone_is_told_and_may_come_back() -> None:
    screen = Screen()
    peer = JvcPeer(screen)
    there = True

    def connect() -> PeerLink:
        if not there:
            raise LinkClosed("nothing listens")
        return PeerLink(peer)

    presenter = JvcFlatField(connect, clock=SimulatedClock())
    there = False
    peer.hang_up()
    with pytest.raises(LinkClosed):
        presenter.show(WHITE)
    there = True
    presenter.show(WHITE)
    assert screen.colour == WHITE
    there = False
    peer.hang_up()
    presenter.close()


@pytest.mark.parametrize("text", [b"SSTP07", b"SSFR0100", b"SSFR00", b"SSFRxxxx", b"PW0", b""])
def test_the_simulated_projector_ignores_what_it_does_not_know(text: bytes) -> None:
    screen = Screen()
    peer = JvcPeer(screen)
    assert peer.receive(jvc.REQUEST + jvc.encode_operation(jvc.FLAT_FIELD)) == jvc.ACCEPTED + ACKNOWLEDGED
    assert peer.receive(b"!\x89\x01" + text + b"\n") == b""
    assert screen.colour == WHITE


def test_the_simulated_projector_hangs_up_on_strangers() -> None:
    screen = Screen()
    peer = JvcPeer(screen)
    assert peer.receive(b"PJLINK") == b"PJNAK"
    assert peer.closed


@given(st.data())
def test_commands_may_be_cut_anywhere(data: st.DataObject) -> None:
    screen = Screen()
    peer = JvcPeer(screen)
    stream = b"PJREQ" + b"".join(colour(b"0010", b"0020", b"0030")[::2])
    answer = b""
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        answer += peer.receive(stream[:size])
        stream = stream[size:]
    assert answer == b"PJACK" + 4 * ACKNOWLEDGED
    assert screen.colour == Colour(16, 32, 48)
    assert screen.colour != BLACK
