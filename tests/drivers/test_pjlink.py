"""PJLink: the standard's lines and datagrams, conversations, the projector contract, cable faults, and the search.

Examples and conversations are from JBMIA, PJLink Specifications 1.04 and 2.00 (sections 3 to 5).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.run.devices import health_fault
from drivers import pjlink as wire
from drivers.links.link import Link, PeerLink
from drivers.links.network import Address, TcpLink, UdpSocket
from drivers.pjlink import (
    FoundProjector,
    NoResolution,
    PjLinkProjector,
    PjLinkReply,
    PjLinkRequest,
    Refused,
    Resolution,
    search,
)
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import SimulatedClock
from foundation.errors import DeviceFault, DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.projectors.pjlink import PjLinkPeer, serve_pjlink
from sim.projectors.projector import SimulatedProjector
from tests.contracts.projector import Bench, ProjectorContract
from tests.drivers.links.troubled_links import Deaf, Dribbling, DroppedAfter, Garbling, Slow
from tests.drivers.script import Script

PASSWORD = "JBMIAProjectorLink"
DIGEST = b"5d8409bc1c3fa39749434aa3a5c38682"


def driver(*scripts: Script, password: str | None = None) -> PjLinkProjector:
    """Return a driver on scripted connections; an additional connection is an error."""
    waiting = list(scripts)
    return PjLinkProjector(lambda: waiting.pop(0), password)


def test_queries_power_without_password() -> None:
    script = Script(
        b"PJLINK 0\r", b"%1POWR ?\r", b"%1POWR=0\r", b"%1POWR 1\r", b"%1POWR=OK\r", b"%1POWR ?\r", b"%1POWR=3\r"
    )
    projector = driver(script)
    assert projector.power() is Power.STANDBY
    projector.switch_on()
    assert projector.power() is Power.WARMING
    assert script.ended()
    projector.close()
    assert script.closed


def test_only_the_first_command_has_a_digest() -> None:
    script = Script(
        b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r", b"%1AVMT 31\r", b"%1AVMT=OK\r"
    )  # fmt: skip
    projector = driver(script, password=PASSWORD)
    assert projector.power() is Power.ON
    projector.set_muted(True)
    assert script.ended()


def test_unrequested_password_is_not_sent() -> None:
    script = Script(b"PJLINK 0\r", b"%1POWR ?\r", b"%1POWR=1\r")
    assert driver(script, password=PASSWORD).power() is Power.ON


def test_wrong_password_is_refused() -> None:
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"PJLINK ERRA\r")
    with pytest.raises(DeviceRefused):
        driver(script, password=PASSWORD).power()
    assert script.ended()
    assert script.closed


class Refusing(BaseHTTPRequestHandler):
    """A web server without pages."""

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@pytest.mark.slow
def test_reports_a_web_server_at_the_port() -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        projector = PjLinkProjector(lambda: TcpLink.connect("127.0.0.1", server.server_port, 10.0), timeout=0.05)
        with pytest.raises(DeviceRefused, match=r"^the projector: an HTTP server answers at its .* port 4352"):
            projector.power()
        server.shutdown()


def test_missing_password_is_reported_before_sending() -> None:
    script = Script(b"PJLINK 1 498e4a67\r")
    with pytest.raises(DeviceRefused):
        driver(script).power()
    assert script.ended()
    assert script.closed


def test_reconnects_if_each_command_needs_a_digest() -> None:
    first = Script(
        b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r", b"%1ERST ?\r", b"PJLINK ERRA\r"
    )  # fmt: skip
    second = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1ERST ?\r", b"%1ERST=000000\r")
    projector = driver(first, second, password=PASSWORD)
    assert projector.power() is Power.ON
    assert projector.faults() == ()
    assert first.closed
    assert second.ended()


def test_reads_faults_lamps_and_identity() -> None:
    script = Script(
        b"PJLINK 0\r",
        b"%1ERST ?\r", b"%1ERST=010020\r",
        b"%1LAMP ?\r", b"%1LAMP=120 1 3000 0\r",
        b"%1INF1 ?\r", b"%1INF1=Seiko\r",
        b"%1INF2 ?\r", b"%1INF2=ERR1\r",
        b"%1NAME ?\r", b"%1NAME=room 3\r",
    )  # fmt: skip
    projector = driver(script)
    assert projector.faults() == (Fault("lamp", Severity.WARNING), Fault("filter", Severity.ERROR))
    assert projector.lamps() == (Lamp(120, True), Lamp(3000, False))
    assert projector.identity() == ProjectorIdentity("Seiko", "", "room 3")
    assert script.ended()


@pytest.mark.parametrize(
    ("code", "error", "reason"),
    [
        (b"ERR1", DeviceRefused, "does not support this command"),
        (b"ERR2", DeviceRefused, "does not offer this value"),
        (b"ERR3", DeviceRefused, "warming up, cooling down or in standby"),
        (b"ERR4", DeviceFault, "internal failure"),
    ],
)
def test_error_codes_have_messages(code: bytes, error: type[Exception], reason: str) -> None:
    script = Script(b"PJLINK 0\r", b"%1AVMT 31\r", b"%1AVMT=" + code + b"\r", b"%1POWR ?\r", b"%1POWR=3\r")
    projector = driver(script)
    with pytest.raises(error, match=rf"{code.decode()} to AVMT 31: .*{reason}"):
        projector.set_muted(True)
    # A refusal is not a fault of the cable, so the connection stays open.
    assert projector.power() is Power.WARMING


def test_dropped_new_connection_is_not_repeated() -> None:
    for script in (Script(None), Script(b"PJLINK 0\r", b"%1POWR ?\r", None)):
        with pytest.raises(LinkClosed):
            driver(script).power()
        assert script.closed


def test_late_answer_does_not_answer_the_next_query() -> None:
    late = Script(b"PJLINK 0\r", b"%1POWR ?\r")
    fresh = Script(b"PJLINK 0\r", b"%1ERST ?\r", b"%1ERST=000000\r")
    projector = driver(late, fresh)
    with pytest.raises(LinkTimeout):
        projector.power()
    assert late.closed
    assert projector.faults() == ()


@pytest.mark.parametrize(
    "answer", [b"%1LAMP=1 1\r", b"what?\r", b"%1POWR=7\r", b"%1POWR=\r", b"x" * 500, b"\xff\r", b"%1POWR=OK\r"]
)
def test_unexpected_answer_is_a_protocol_error(answer: bytes) -> None:
    with pytest.raises(ProtocolError):
        driver(Script(b"PJLINK 0\r", b"%1POWR ?\r", answer)).power()


def test_set_command_requires_ok() -> None:
    with pytest.raises(ProtocolError):
        driver(Script(b"PJLINK 0\r", b"%1POWR 1\r", b"%1POWR=1\r")).switch_on()


def test_class_2_queries() -> None:
    script = Script(
        b"PJLINK 0\r",
        b"%1CLSS ?\r", b"%1CLSS=2\r",
        b"%2IRES ?\r", b"%2IRES=1920x1080\r",
        b"%2IRES ?\r", b"%2IRES=-\r",
        b"%2IRES ?\r", b"%2IRES=*\r",
        b"%2FREZ ?\r", b"%2FREZ=1\r",
    )  # fmt: skip
    projector = driver(script)
    assert projector.input_resolution() == Resolution(1920, 1080)
    assert projector.input_resolution() is NoResolution.NO_SIGNAL
    assert projector.input_resolution() is NoResolution.UNKNOWN_SIGNAL
    assert projector.frozen()
    assert script.ended()


@pytest.mark.parametrize(("level", "code", "meant"), [(b"1", b"31", "31"), (b"2", b"3a", "3A")])
def test_input_query_uses_the_projectors_class(level: bytes, code: bytes, meant: str) -> None:
    script = Script(
        b"PJLINK 0\r",
        b"%1CLSS ?\r", b"%1CLSS=" + level + b"\r",
        b"%" + level + b"INPT ?\r", b"%" + level + b"INPT=" + code + b"\r",
    )  # fmt: skip
    assert driver(script).input() == meant
    assert script.ended()


def class_2(*conversation: bytes) -> PjLinkProjector:
    return driver(Script(b"PJLINK 0\r", b"%1CLSS ?\r", b"%1CLSS=2\r", *conversation))


@pytest.mark.parametrize("code", [b"ERR1", b"err1", b"ERR2"])
def test_unsupported_class_2_queries_return_no_value(code: bytes) -> None:
    script = Script(
        b"PJLINK 0\r",
        b"%1CLSS ?\r", b"%1CLSS=2\r",
        b"%2FREZ ?\r", b"%2FREZ=" + code + b"\r",
        b"%2IRES ?\r", b"%2IRES=" + code + b"\r",
        b"%1AVMT ?\r", b"%1AVMT=" + code + b"\r",
        b"%1LAMP ?\r", b"%1LAMP=" + code + b"\r",
        b"%1ERST ?\r", b"%1ERST=" + code + b"\r",
        b"%1POWR ?\r", b"%1POWR=1\r",
    )  # fmt: skip
    projector = driver(script)
    # Unsupported queries are sent once.
    for _ in range(2):
        assert projector.picture_fault() is None
    assert projector.frozen() is None
    assert projector.input_resolution() is None
    assert projector.muted() is None
    assert projector.lamps() == ()
    assert projector.faults() == ()
    # The second call queries the power, so that a missing reply does not look healthy.
    assert projector.faults() == ()
    assert script.ended()


def test_queries_signal_if_freeze_is_unsupported() -> None:
    projector = class_2(b"%2FREZ ?\r", b"%2FREZ=ERR1\r", b"%2IRES ?\r", b"%2IRES=-\r")
    assert "no signal" in (projector.picture_fault() or "")
    projector = class_2(b"%2FREZ ?\r", b"%2FREZ=0\r", b"%2IRES ?\r", b"%2IRES=ERR1\r", b"%2FREZ ?\r", b"%2FREZ=1\r")
    assert projector.picture_fault() is None
    assert "frozen" in (projector.picture_fault() or "")


def test_unavailable_values_are_queried_again() -> None:
    script = Script(
        b"PJLINK 0\r",
        b"%1CLSS ?\r", b"%1CLSS=ERR3\r",
        b"%1CLSS ?\r", b"%1CLSS=2\r",
        b"%2FREZ ?\r", b"%2FREZ=ERR3\r",
        b"%2IRES ?\r", b"%2IRES=ERR3\r",
        b"%2FREZ ?\r", b"%2FREZ=1\r",
        b"%1ERST ?\r", b"%1ERST=ERR3\r",
        b"%1ERST ?\r", b"%1ERST=010000\r",
        b"%1AVMT ?\r", b"%1AVMT=ERR3\r",
        b"%1AVMT ?\r", b"%1AVMT=31\r",
    )  # fmt: skip
    projector = driver(script)
    assert projector.picture_fault() is None
    assert projector.picture_fault() is None
    assert "frozen" in (projector.picture_fault() or "")
    assert projector.faults() == ()
    assert projector.faults() == (Fault("lamp", Severity.WARNING),)
    with pytest.raises(DeviceRefused):
        projector.muted()
    assert projector.muted()
    assert script.ended()


def test_reported_failure_is_a_device_fault() -> None:
    with pytest.raises(DeviceFault):
        class_2(b"%2FREZ ?\r", b"%2FREZ=ERR4\r").picture_fault()
    with pytest.raises(DeviceFault):
        driver(Script(b"PJLINK 0\r", b"%1ERST ?\r", b"%1ERST=ERR4\r")).faults()


def test_wrong_password_is_not_an_unsupported_query() -> None:
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1CLSS ?\r", b"PJLINK ERRA\r")
    with pytest.raises(DeviceRefused):
        driver(script, password=PASSWORD).picture_fault()


@pytest.mark.parametrize("answer", [b"%1CLSS=1\r", b"%1CLSS=ERR1\r"])
def test_class_1_gets_no_class_2_queries(answer: bytes) -> None:
    script = Script(b"PJLINK 0\r", b"%1CLSS ?\r", answer)
    projector = driver(script)
    for ask in (
        projector.input_resolution,
        projector.frozen,
    ):
        with pytest.raises(DeviceRefused):
            ask()
    assert projector.pjlink_class() == 1
    assert script.ended()


def test_startup_notice_does_not_answer_a_query() -> None:
    # Some class 2 projectors send it over TCP, and pad their packets with NUL (reports of other controllers' users).
    script = Script(
        b"PJLINK 0\r" + bytes(200),
        b"%1POWR ?\r", b"%2LKUP=D0:D9:4F:00:00:01\r\0\0\0", b"\0\0%1POWR=1\r" + bytes(120),
        b"%1POWR ?\r", b"%2LKUP=D0:D9:4F:00:00:01\r%1POWR=2\r",
    )  # fmt: skip
    projector = driver(script)
    assert projector.power() is Power.ON
    assert projector.power() is Power.COOLING
    assert script.ended()


def test_endless_answer_is_a_timeout() -> None:
    clock = SimulatedClock()

    class Endless(Script):
        def read(self, limit: int, timeout: float) -> bytes:
            clock.sleep(1.0)
            return b"P"

        def write(self, data: bytes, timeout: float) -> None:
            """Ignore the data."""

    with pytest.raises(LinkTimeout):
        PjLinkProjector(lambda: Endless(b""), timeout=5.0, clock=clock).power()


def noisy(link: Link) -> Link:
    """Let a projector answer in lower case, with LF and padding, and with start-up notices."""

    def garble(data: bytes) -> bytes:
        data = data.replace(b"%1POWR=", b"%1powr=").replace(b"=OK", b"=Ok").replace(b"=ERR", b"=err")
        return b"\n%2LKUP=00:11:22:33:44:55\r\0" + data.replace(b"\r", b"\r\n\0\0")

    return Garbling(link, garble)


WAYS: dict[str, tuple[Callable[[Link], Link], str | None]] = {
    "open": (lambda link: link, None),
    "password": (lambda link: link, PASSWORD),
    "byte by byte": (Dribbling, None),
    "dropped at every second command": (lambda link: DroppedAfter(link, 1), None),
    "dropped, password": (lambda link: DroppedAfter(link, 1), PASSWORD),
    "noisy line ends": (noisy, None),
}


class TestOverMemory(ProjectorContract):
    @pytest.fixture(params=WAYS)
    def bench(self, request: pytest.FixtureRequest) -> Bench:
        trouble, password = WAYS[request.param]
        device = SimulatedProjector(SimulatedClock())
        return Bench.of(PjLinkProjector(lambda: trouble(PeerLink(PjLinkPeer(device, password))), password), device)


class TestOverLoopback(ProjectorContract):
    @pytest.fixture(params=[None, PASSWORD], ids=["open", "password"])
    def bench(self, request: pytest.FixtureRequest) -> Iterator[Bench]:
        device = SimulatedProjector(SimulatedClock())
        with serve_pjlink(device, password=request.param) as server:
            projector = PjLinkProjector(lambda: TcpLink.connect(*server.address, 10.0), request.param, 10.0)
            yield Bench.of(projector, device)
            projector.close()


class TestSlowReplies(ProjectorContract):
    """Replies take four of the permitted five seconds, by the cable's own clock."""

    @pytest.fixture
    def bench(self) -> Bench:
        cable_clock, device = SimulatedClock(), SimulatedProjector(SimulatedClock())
        slow = lambda: Slow(PeerLink(PjLinkPeer(device)), cable_clock, 4.0)  # noqa: E731
        return Bench.of(PjLinkProjector(slow, clock=cable_clock), device)


def test_late_answer_is_a_timeout() -> None:
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()))
    projector = PjLinkProjector(lambda: Slow(PeerLink(peer), clock, 6.0), clock=clock)
    with pytest.raises(LinkTimeout):
        projector.power()


def test_recovers_from_a_garbled_answer() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock(), Power.ON))
    garbles: list[Callable[[bytes], bytes]] = [lambda data: data.replace(b"POWR=", b"PO\xffR="), lambda data: data]
    projector = PjLinkProjector(lambda: Garbling(PeerLink(peer), garbles.pop(0)))
    with pytest.raises(ProtocolError):
        projector.power()
    assert projector.power() is Power.ON


def test_recovers_from_a_lost_answer() -> None:
    device = SimulatedProjector(SimulatedClock())
    links: list[Link] = []

    def connect() -> Link:
        good = PeerLink(PjLinkPeer(device))
        links.append(Deaf(good, after=1) if not links else good)
        return links[-1]

    projector = PjLinkProjector(connect)
    with pytest.raises(LinkTimeout):
        projector.switch_on()
    # The command was executed, but the driver cannot detect that and reports the timeout.
    assert projector.power() is Power.WARMING


def test_log_has_no_password_or_digest(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r")
    assert driver(script, password=PASSWORD).power() is Power.ON
    assert "%1POWR ?" in caplog.text
    assert PASSWORD not in caplog.text
    assert DIGEST.decode("ascii") not in caplog.text


PRINTABLE = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=100)


def test_digest_matches_the_standards_example() -> None:
    # PJLink 1.04, 5.1: seed 498e4a67, password JBMIAProjectorLink.
    assert wire.authentication_digest("498e4a67", "JBMIAProjectorLink") == "5d8409bc1c3fa39749434aa3a5c38682"


@pytest.mark.parametrize(
    ("line", "greeting"),
    [
        (b"PJLINK 0", None),
        (b"PJLINK 1 498e4a67", "498e4a67"),
        (b"pjlink 1 498E4a67", "498E4a67"),
        (b"PJLINK  1  42 ", "42"),
        (b"PJLINK ERRA", Refused.WRONG_PASSWORD),
        (b"Pjlink err a", Refused.WRONG_PASSWORD),
    ],
)
def test_parses_greetings(line: bytes, greeting: str | Refused | None) -> None:
    assert wire.parse_greeting(line) == greeting


@pytest.mark.parametrize(
    "line", [b"", b"PJLINK", b"PJLINK 1", b"PJLINK 1 a b", b"PJLINK 0 x", b"SSH-2.0-x", b"\xff\xfe"]
)
def test_refuses_invalid_greetings(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="PJLink is enabled"):
        wire.parse_greeting(line)


def test_reports_an_http_server_that_sends_first() -> None:
    # RFC 9110, 15.5.9: reply of a server that has waited too long for a request.
    with pytest.raises(ProtocolError, match=r"HTTP server.*'HTTP/1\.1 408"):
        wire.parse_greeting(b"HTTP/1.1 408 Request Timeout")


def test_commands_match_the_standards_bytes() -> None:
    # PJLink 1.04, 4.1 and 5.1.
    assert wire.encode_request(PjLinkRequest("POWR", "1")) == b"%1POWR 1\r"
    assert wire.encode_request(PjLinkRequest("INPT")) == b"%1INPT ?\r"
    assert wire.encode_request(PjLinkRequest("AVMT", "31")) == b"%1AVMT 31\r"
    assert (
        wire.encode_request(PjLinkRequest("POWR", digest="5d8409bc1c3fa39749434aa3a5c38682"))
        == b"5d8409bc1c3fa39749434aa3a5c38682%1POWR ?\r"
    )
    assert wire.encode_request(PjLinkRequest("SNUM", level=2)) == b"%2SNUM ?\r"


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        (b"%1POWR=0", PjLinkReply("POWR", "0")),
        (b"%1POWR=OK", PjLinkReply("POWR", "OK")),
        (b"%1powr=ERR3", PjLinkReply("POWR", "ERR3")),
        (b"%1LAMP=120 1 3000 0", PjLinkReply("LAMP", "120 1 3000 0")),
        (b"%1NAME=", PjLinkReply("NAME", "")),
        ("%1NAME=Höllenmaschine".encode(), PjLinkReply("NAME", "Höllenmaschine")),
        (b"%2SNUM=42", PjLinkReply("SNUM", "42", level=2)),
        (b"%2INNM=HDMI 1", PjLinkReply("INNM", "HDMI 1", level=2)),
        (b"%2IRES=-", PjLinkReply("IRES", "-", level=2)),
        (b"%2IRES=*", PjLinkReply("IRES", "*", level=2)),
        (b"PJLINK ERRA", Refused.WRONG_PASSWORD),
        (b"pjlink erra", Refused.WRONG_PASSWORD),
        (b"PJLINK ERR A ", Refused.WRONG_PASSWORD),
        (b"%1POWR=ERRA", Refused.WRONG_PASSWORD),
        (b" %1POWR = 1 ", PjLinkReply("POWR", "1")),
    ],
)
def test_parses_replies(line: bytes, reply: PjLinkReply | Refused) -> None:
    assert wire.parse_reply(line) == reply


@pytest.mark.parametrize("line", [b"%1POWR 0", b"POWR=0", b"%1POW=0", b"%xPOWR=0", b"", b"%1NAME=" + b"x" * 129])
def test_refuses_invalid_replies(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        wire.parse_reply(line)


def test_parses_values_of_class_1() -> None:
    assert [wire.parse_power(digit) for digit in "0123"] == [Power.STANDBY, Power.ON, Power.COOLING, Power.WARMING]
    assert [wire.parse_mute(code) for code in ("11", "31", "21", "30")] == [True, True, False, False]
    assert wire.parse_faults("000000") == ()
    # fan, lamp, temperature, cover, filter, other
    assert wire.parse_faults("120012") == (
        Fault("fan", Severity.WARNING),
        Fault("lamp", Severity.ERROR),
        Fault("filter", Severity.WARNING),
        Fault("other", Severity.ERROR),
    )
    assert wire.parse_lamps("22358 1") == (Lamp(22358, True),)
    assert wire.parse_lamps("120 1 3000 0") == (Lamp(120, True), Lamp(3000, False))


def test_parses_values_of_class_2() -> None:
    # PJLink 2.00, 4.4, 4.9, 4.14 and 4.18 to 4.26.
    assert [wire.parse_input(code) for code in ("11", "59", "3A", "6z")] == ["11", "59", "3A", "6Z"]
    assert [wire.is_class_1_input(code) for code in ("11", "59", "3A", "61", "10")] == [True, True, False, False, False]
    assert wire.parse_input_resolution("1920x1080") == Resolution(1920, 1080)
    assert wire.parse_input_resolution("1024X768") == Resolution(1024, 768)
    assert wire.parse_input_resolution("-") is NoResolution.NO_SIGNAL
    assert wire.parse_input_resolution("*") is NoResolution.UNKNOWN_SIGNAL
    assert [wire.parse_freeze(digit) for digit in "01"] == [False, True]
    assert [wire.parse_class(digit) for digit in "12"] == [1, 2]


@pytest.mark.parametrize(
    ("parse", "value"),
    [
        (wire.parse_power, "4"),
        (wire.parse_power, ""),
        (wire.parse_power, "on"),
        (wire.parse_faults, "300000"),
        (wire.parse_faults, "ok"),
    ],
)
def test_refuses_values_outside_the_standard(parse: object, value: str) -> None:
    assert callable(parse)
    with pytest.raises(ProtocolError):
        parse(value)


@pytest.mark.parametrize(
    ("parse", "value", "meaning"),
    [
        (wire.parse_class, "Class 1", 1),  # Optoma X351, gaetano-guerriero/pypjlink 1
        (wire.parse_class, "Version1", 1),  # BenQ, OpenLP bug 1550891
        (wire.parse_class, "CLASS2", 2),
        (wire.parse_class, "", 1),
        (wire.parse_class, "²", 1),
        # Extron drivers of several makers read LAMP without a state, others with a state for each of two lamps.
        (wire.parse_lamps, "120", (Lamp(120, None),)),
        (wire.parse_lamps, "120 3000", (Lamp(120, None), Lamp(3000, None))),
        (wire.parse_lamps, "120 1 3000", (Lamp(120, True), Lamp(3000, None))),
        (wire.parse_lamps, "0 1 10 0", (Lamp(0, True), Lamp(10, False))),
        (wire.parse_lamps, "-1 0", ()),
        (wire.parse_lamps, "١ 1", ()),
        (wire.parse_lamps, "unknown", ()),
        (wire.parse_faults, "000", ()),
        (wire.parse_faults, "", ()),
        (wire.parse_faults, "00 00 01", (Fault("other", Severity.WARNING),)),
        (wire.parse_faults, "020", (Fault("lamp", Severity.ERROR),)),
        (wire.parse_faults, "00000022", (Fault("other", Severity.ERROR),)),
        (wire.parse_power, "01", Power.ON),
        (wire.parse_power, "00", Power.STANDBY),
        (wire.parse_mute, "12", None),
        (wire.parse_freeze, "2", None),
        # Three characters, home-assistant/core 55507: a client that expected two stopped there.
        (wire.parse_input, "31a", "31A"),
        (wire.parse_input_resolution, "1920 x 1080", Resolution(1920, 1080)),
        (wire.parse_input_resolution, "1920x1080p", Resolution(1920, 1080)),
        (wire.parse_input_resolution, "1080i", NoResolution.UNKNOWN_SIGNAL),
        (wire.parse_input_resolution, "", NoResolution.UNKNOWN_SIGNAL),
        (wire.parse_input_resolution, "--", NoResolution.NO_SIGNAL),
    ],
)
def test_reads_values_that_real_projectors_send(parse: Callable[[str], object], value: str, meaning: object) -> None:
    assert parse(value) == meaning


def test_optoma_with_class_in_words_passes_all_queries_of_a_run() -> None:
    # gaetano-guerriero/pypjlink 1; lower case: openhab/openhab-addons 6725.
    script = Script(
        b"PJLINK 0\r\n",
        b"%1ERST ?\r", b"%1erst=000 \r\n",
        b"%1POWR ?\r", b"%1powr=1\0",
        b"%1AVMT ?\r", b"%1AVMT = err 1\n",
        b"%1CLSS ?\r", b"%1CLSS=Class 1\r",
    )  # fmt: skip
    assert health_fault(driver(script)) is None
    assert script.ended()


@pytest.mark.slow
@given(
    st.builds(
        PjLinkRequest,
        st.from_regex("[A-Z0-9]{4}", fullmatch=True),
        PRINTABLE.filter(bool),
        st.sampled_from((1, 2)),
        st.sampled_from(("", "5d8409bc1c3fa39749434aa3a5c38682")),
    )
)
def test_requests_survive_encoding_and_parsing(request_: PjLinkRequest) -> None:
    assert wire.parse_request(wire.encode_request(request_)[:-1]) == request_


@given(st.binary(max_size=200))
def test_any_bytes_give_a_value_or_a_protocol_error(line: bytes) -> None:
    for parse in (wire.parse_greeting, wire.parse_request, wire.parse_reply):
        try:
            parse(line)
        except ProtocolError as error:
            assert len(str(error)) < 600  # noqa: PT017 – both outcomes are right; only the message is judged


@pytest.mark.slow
@given(st.data())
def test_lines_do_not_depend_on_splitting(data: st.DataObject) -> None:
    end = st.sampled_from((b"\r", b"\r\n", b"\n", b"\r\r\n", b"\r\0\0\0"))
    value = st.one_of(
        PRINTABLE,
        st.sampled_from(("HDMI 1", "1920x1080", "-", "*", "3A", "11 31 3A 61", "45", "ERR3", "Höllenmaschine")),
    )
    command = st.sampled_from(("INNM", "IRES", "RRES", "SNUM", "SVER", "FILT", "RLMP", "RFIL", "FREZ", "INPT", "INST"))
    reply = st.tuples(command, value).map(lambda both: f"%2{both[0]}={both[1]}")
    lines = [line.encode() for line in data.draw(st.lists(st.one_of(PRINTABLE.filter(bool), reply), max_size=6))]
    stream = b"".join(line + data.draw(end) for line in lines)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    lines_read, rest = list[bytes](), b""
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        rest += stream[start:stop]
        while (parsed := wire.split_line(rest)) is not None:
            lines_read.append(parsed[0])
            rest = rest[parsed[1] :]
    assert lines_read == lines


def test_refuses_lines_above_the_longest() -> None:
    longest = b"%1NAME=" + b"x" * 128
    assert len(longest) + 1 == wire.MAX_LINE
    assert wire.split_line(longest + b"\r") == (longest, 136)
    assert wire.split_line(longest) is None
    for longer in (longest + b"y\r", longest + b"y"):
        with pytest.raises(ProtocolError):
            wire.split_line(longer)


MAC = "00:11:22:aa:bb:cc"


@pytest.mark.parametrize(
    ("datagram", "command", "value"),
    [
        (b"%2ACKN=00:11:22:aa:bb:cc\r", "ACKN", MAC),
        (b"%2LKUP=00:11:22:aa:bb:cc\r", "LKUP", MAC),
        (b"%2ERST=010020\r", "ERST", "010020"),
        (b"%2POWR=1\r", "POWR", "1"),
        (b"%2INPT=3A\r", "INPT", "3A"),
    ],
)
def test_parses_the_standards_datagrams(datagram: bytes, command: str, value: str) -> None:
    reply = PjLinkReply(command, value, 2)
    assert wire.encode_reply(reply) == datagram
    for received in (datagram, datagram.lower() + b"\n", datagram[:-1], b"\r" + datagram + b"\0\0\0\0"):
        (parsed,) = wire.parse_datagram(received)
        assert (parsed.command, parsed.value.upper(), parsed.level) == (command, value.upper(), 2)


@pytest.mark.parametrize(
    "datagram",
    [
        b"", b"%2SRCH\r", b"%1POWR=1\r", b"PJLINK ERRA\r", b"\xff\xfe\x00", b"M-SEARCH * HTTP/1.1\r\n\r\n", b"x" * 2000,
    ],
)  # fmt: skip
def test_ignores_other_datagrams(datagram: bytes) -> None:
    assert wire.parse_datagram(datagram) == ()


def test_replies_in_a_datagram_keep_their_order() -> None:
    replies = wire.parse_datagram(b"%2POWR=3\r%2what\r%2INPT=31\r")
    assert replies == (PjLinkReply("POWR", "3", 2), PjLinkReply("INPT", "31", 2))


@given(st.binary(max_size=300))
def test_any_datagram_is_parsed_without_error(datagram: bytes) -> None:
    assert len(wire.parse_datagram(datagram)) <= len(datagram)


class ScriptedNetwork(UdpSocket):
    """Datagrams that arrive at given times; records sent datagrams with their times."""

    def __init__(self, clock: SimulatedClock, *arrivals: tuple[float, bytes, str]) -> None:
        self._clock = clock
        self._arrivals = list(arrivals)
        self.sent: list[tuple[float, bytes, Address]] = []
        self.closed = False

    def send(self, data: bytes, address: Address) -> None:
        self.sent.append((self._clock.monotonic(), data, address))

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        now = self._clock.monotonic()
        if self._arrivals and self._arrivals[0][0] <= now + timeout:
            at, datagram, host = self._arrivals.pop(0)
            self._clock.sleep(max(at - now, 0.0))
            return datagram, (host, 4352)
        self._clock.sleep(timeout)
        raise LinkTimeout("nothing")

    def close(self) -> None:
        self.closed = True


def run_search(network: ScriptedNetwork, clock: SimulatedClock) -> tuple[FoundProjector, ...]:
    ports: list[int] = []

    def opened(port: int) -> ScriptedNetwork:
        ports.append(port)
        return network

    projectors = search(open_socket=opened, clock=clock)
    assert ports == [4352]
    assert network.closed
    return projectors


def test_search_collects_for_thirty_seconds_without_duplicates() -> None:
    clock = SimulatedClock()
    network = ScriptedNetwork(
        clock,
        (0.0, b"%2SRCH\r", "192.168.1.2"),  # our own search, received by ourselves
        (0.5, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"),
        (1.7, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"),
        (2.0, b"%2POWR=1\r", "192.168.1.22"),
        (9.9, b"%2ackn=00:11:22:AA:BB:02\r\n", "192.168.1.21"),
        (10.0, b"%2ACKN=001122aabbcc\r", "192.168.1.24"),
        (10.0, b"%2ACKN=00:11:22:aa:bb\r", "192.168.1.24"),
        (10.0, b"%2ACKN=0g:11:22:aa:bb:cc\r", "192.168.1.24"),
        (31.0, b"%2ACKN=00:11:22:aa:bb:03\r", "192.168.1.23"),
    )
    assert run_search(network, clock) == (
        FoundProjector("192.168.1.20", "00:11:22:aa:bb:01"),
        FoundProjector("192.168.1.21", "00:11:22:aa:bb:02"),
    )
    assert clock.monotonic() == pytest.approx(30.0)
    assert [(data, address) for _, data, address in network.sent] == [(b"%2SRCH\r", ("255.255.255.255", 4352))] * 3
    assert [at for at, _, _ in network.sent] == pytest.approx([0.0, 1.0, 2.0])


def test_search_time_starts_at_the_call() -> None:
    clock = SimulatedClock()
    clock.sleep(1000)
    network = ScriptedNetwork(clock, (1000.5, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"))
    assert [projector.host for projector in run_search(network, clock)] == ["192.168.1.20"]
    assert clock.monotonic() == pytest.approx(1030.0)


def test_endless_junk_does_not_extend_the_search() -> None:
    clock = SimulatedClock()
    network = ScriptedNetwork(clock, *[(0.01 * i, b"\xff" * 40, "192.168.1.9") for i in range(4000)])
    assert run_search(network, clock) == ()
    assert clock.monotonic() == pytest.approx(30.0, abs=0.1)


def test_search_refuses_a_port_in_use() -> None:
    with UdpSocket(host="127.0.0.1") as socket, pytest.raises(LinkClosed, match="close the other program"):
        search(listen_port=socket.address[1])


def test_refuses_calls_on_a_closed_socket() -> None:
    udp = UdpSocket(host="127.0.0.1")
    udp.close()
    udp.close()
    with pytest.raises(LinkClosed):
        udp.receive(0.0)
    with pytest.raises(LinkClosed, match=r"127\.0\.0\.1:9"):
        udp.send(b"x", ("127.0.0.1", 9))


def test_refuses_a_too_long_datagram() -> None:
    with UdpSocket(host="127.0.0.1") as udp, pytest.raises(LinkClosed):
        udp.send(b"x" * 70000, udp.address)
