"""The PJLink driver: conversations in the standard's bytes, the projector contract, and troubled cables.

The conversations are written after PJLink 1.04, 2.00 (sections 4 and 5), not after the codec under test.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from drivers.links.link import Link, PeerLink
from drivers.links.network import TcpLink
from drivers.pjlink import NoResolution, PjLinkProjector, Resolution
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import SimulatedClock
from foundation.errors import DeviceFault, DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import EOS_550D
from sim.camera.eos import SimulatedEos
from sim.projectors.pjlink import PjLinkPeer, serve_pjlink
from sim.projectors.projector import SimulatedProjector
from tests.contracts.camera import SeededFilm
from tests.contracts.projector import Bench, ProjectorContract
from tests.drivers.links.troubled_links import Deaf, Dribbling, DroppedAfter, Garbling, Slow
from tests.drivers.script import Script

PASSWORD = "JBMIAProjectorLink"
DIGEST = b"5d8409bc1c3fa39749434aa3a5c38682"


def driver(*scripts: Script, password: str | None = None) -> PjLinkProjector:
    """Return the driver on one script after another; a connection too many is an error."""
    waiting = list(scripts)
    return PjLinkProjector(lambda: waiting.pop(0), password)


def test_power_without_password() -> None:
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


def test_only_the_first_command_proves_the_password() -> None:
    script = Script(
        b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r", b"%1AVMT 31\r", b"%1AVMT=OK\r"
    )  # fmt: skip
    projector = driver(script, password=PASSWORD)
    assert projector.power() is Power.ON
    projector.set_muted(True)
    assert script.ended()


def test_a_password_that_nobody_asks_for_is_not_sent() -> None:
    script = Script(b"PJLINK 0\r", b"%1POWR ?\r", b"%1POWR=1\r")
    assert driver(script, password=PASSWORD).power() is Power.ON


def test_a_wrong_password_is_refused_in_words() -> None:
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"PJLINK ERRA\r")
    with pytest.raises(DeviceRefused):
        driver(script, password=PASSWORD).power()
    assert script.ended()
    assert script.closed


class Refusing(BaseHTTPRequestHandler):
    """A web page that is none."""

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextmanager
def http_server() -> Generator[tuple[str, int]]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield "127.0.0.1", server.server_port
        server.shutdown()


@contextmanager
def camera() -> Generator[tuple[str, int]]:
    with serve_ptpip(SimulatedEos(EOS_550D, SeededFilm(600), SimulatedClock()), 0) as server:
        yield server.address


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stranger", "name"), [(http_server, "an HTTP server"), (camera, r"a camera \(PTP/IP\)")], ids=["http", "camera"]
)
def test_what_answers_at_a_projectors_port_and_is_none_is_named(
    stranger: Callable[[], AbstractContextManager[tuple[str, int]]], name: str
) -> None:
    with stranger() as address:
        projector = PjLinkProjector(lambda: TcpLink.connect(*address, 10.0), timeout=0.05)
        with pytest.raises(DeviceRefused, match=rf"^the projector: {name} answers at its .* as port 4352"):
            projector.power()


def test_a_projector_that_falls_silent_is_asked_for_nothing_else() -> None:
    first = Script(b"PJLINK 0\r", b"%1POWR ?\r", b"%1POWR=1\r")
    projector = driver(first, Script())
    assert projector.power() is Power.ON
    projector.close()
    with pytest.raises(LinkTimeout):
        projector.power()


def test_a_missing_password_is_asked_for_before_anything_is_sent() -> None:
    script = Script(b"PJLINK 1 498e4a67\r")
    with pytest.raises(DeviceRefused):
        driver(script).power()
    assert script.ended()
    assert script.closed


def test_a_server_that_wants_the_digest_each_time_gets_a_new_connection() -> None:
    first = Script(
        b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r", b"%1ERST ?\r", b"PJLINK ERRA\r"
    )  # fmt: skip
    second = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1ERST ?\r", b"%1ERST=000000\r")
    projector = driver(first, second, password=PASSWORD)
    assert projector.power() is Power.ON
    assert projector.faults() == ()
    assert first.closed
    assert second.ended()


def test_health_and_name() -> None:
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


def test_a_lampless_projector_has_no_lamps() -> None:
    assert driver(Script(b"PJLINK 0\r", b"%1LAMP ?\r", b"%1LAMP=ERR1\r")).lamps() == ()


@pytest.mark.parametrize(
    ("code", "error", "words"),
    [
        (b"ERR1", DeviceRefused, "does not know this command"),
        (b"ERR2", DeviceRefused, "does not offer this value"),
        (b"ERR3", DeviceRefused, "warming up, cooling down or in standby"),
        (b"ERR4", DeviceFault, "failure of its own"),
    ],
)
def test_each_error_has_its_sentence(code: bytes, error: type[Exception], words: str) -> None:
    script = Script(b"PJLINK 0\r", b"%1AVMT 31\r", b"%1AVMT=" + code + b"\r", b"%1POWR ?\r", b"%1POWR=3\r")
    projector = driver(script)
    with pytest.raises(error, match=rf"{code.decode()} to AVMT 31: .*{words}"):
        projector.set_muted(True)
    # A refusal is no fault of the cable: the same connection goes on.
    assert projector.power() is Power.WARMING


def test_tolerates_case_line_feeds_and_pieces() -> None:
    script = Script(b"pjlink ", b"0\r\n", b"%1POWR ?\r", b"%1po", b"wr=", b"1\r\n", b"%1POWR 0\r", b"%1POWR=ok\r\n")
    projector = driver(script)
    assert projector.power() is Power.ON
    projector.switch_off()
    assert script.ended()


def test_an_idle_connection_that_was_dropped_is_replaced_silently() -> None:
    first = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r", None)
    second = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r")
    projector = driver(first, second, password=PASSWORD)
    assert projector.power() is Power.ON
    assert projector.power() is Power.ON
    assert first.closed
    assert second.ended()


def test_a_new_connection_that_is_dropped_is_not_tried_again() -> None:
    for script in (Script(None), Script(b"PJLINK 0\r", b"%1POWR ?\r", None)):
        with pytest.raises(LinkClosed):
            driver(script).power()
        assert script.closed


def test_a_second_drop_in_a_row_is_told() -> None:
    first = Script(b"PJLINK 0\r", b"%1POWR ?\r", b"%1POWR=1\r", None)
    second = Script(b"PJLINK 0\r", b"%1POWR ?\r", None)
    projector = driver(first, second)
    projector.power()
    with pytest.raises(LinkClosed):
        projector.power()


def test_a_late_answer_never_meets_a_later_question() -> None:
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
def test_an_answer_that_does_not_fit_is_a_protocol_error(answer: bytes) -> None:
    with pytest.raises(ProtocolError):
        driver(Script(b"PJLINK 0\r", b"%1POWR ?\r", answer)).power()


def test_a_set_command_must_be_answered_by_ok() -> None:
    with pytest.raises(ProtocolError):
        driver(Script(b"PJLINK 0\r", b"%1POWR 1\r", b"%1POWR=1\r")).switch_on()


def test_what_class_2_tells() -> None:
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
def test_the_input_is_asked_for_in_the_projectors_class(level: bytes, code: bytes, meant: str) -> None:
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
def test_a_class_2_projector_that_does_not_know_a_question_cannot_tell(code: bytes) -> None:
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
    # What it does not know it is asked once.
    for _ in range(2):
        assert projector.picture_fault() is None
    assert projector.frozen() is None
    assert projector.input_resolution() is None
    assert projector.muted() is None
    assert projector.lamps() == ()
    assert projector.faults() == ()
    # Health is not taken from silence: the second time it is asked for its power instead.
    assert projector.faults() == ()
    assert script.ended()


def test_a_projector_that_cannot_tell_whether_it_is_frozen_is_asked_for_its_signal() -> None:
    projector = class_2(b"%2FREZ ?\r", b"%2FREZ=ERR1\r", b"%2IRES ?\r", b"%2IRES=-\r")
    assert "no signal" in (projector.picture_fault() or "")
    projector = class_2(b"%2FREZ ?\r", b"%2FREZ=0\r", b"%2IRES ?\r", b"%2IRES=ERR1\r", b"%2FREZ ?\r", b"%2FREZ=1\r")
    assert projector.picture_fault() is None
    assert "frozen" in (projector.picture_fault() or "")


def test_what_a_projector_does_not_tell_now_it_is_asked_again() -> None:
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


def test_a_failure_that_the_projector_reports_is_no_ignorance() -> None:
    with pytest.raises(DeviceFault):
        class_2(b"%2FREZ ?\r", b"%2FREZ=ERR4\r").picture_fault()
    with pytest.raises(DeviceFault):
        driver(Script(b"PJLINK 0\r", b"%1ERST ?\r", b"%1ERST=ERR4\r")).faults()


def test_a_wrong_password_is_no_ignorance() -> None:
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1CLSS ?\r", b"PJLINK ERRA\r")
    with pytest.raises(DeviceRefused):
        driver(script, password=PASSWORD).picture_fault()


@pytest.mark.parametrize("answer", [b"%1CLSS=1\r", b"%1CLSS=ERR1\r"])
def test_class_1_is_never_asked_what_class_2_knows(answer: bytes) -> None:
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


def test_a_notice_of_start_inside_the_connection_answers_nothing() -> None:
    # Some class 2 projectors send it there, and fill their packets up with NUL (seen by users of other controllers).
    script = Script(
        b"PJLINK 0\r" + bytes(200),
        b"%1POWR ?\r", b"%2LKUP=D0:D9:4F:00:00:01\r\0\0\0", b"\0\0%1POWR=1\r" + bytes(120),
        b"%1POWR ?\r", b"%2LKUP=D0:D9:4F:00:00:01\r%1POWR=2\r",
    )  # fmt: skip
    projector = driver(script)
    assert projector.power() is Power.ON
    assert projector.power() is Power.COOLING
    assert script.ended()


def test_another_service_at_that_port_is_named() -> None:
    with pytest.raises(ProtocolError, match=r"SSH-2\.0"):
        driver(Script(b"SSH-2.0-OpenSSH_9.2\r\n")).power()


def test_an_answer_that_never_ends_is_a_timeout() -> None:
    clock = SimulatedClock()

    class Endless(Script):
        def read(self, limit: int, timeout: float) -> bytes:
            clock.sleep(1.0)
            return b"P"

        def write(self, data: bytes, timeout: float) -> None:
            """Hear what it is, without a word on that."""

    with pytest.raises(LinkTimeout):
        PjLinkProjector(lambda: Endless(b""), timeout=5.0, clock=clock).power()


def noisy(link: Link) -> Link:
    """Have a projector answer in small letters, with LF and filling, and announce its start in between."""

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


class TestAnswersThatTakeTheirTime(ProjectorContract):
    """Four of the five seconds that an answer may take, by a clock of the cable's own."""

    @pytest.fixture
    def bench(self) -> Bench:
        cable_clock, device = SimulatedClock(), SimulatedProjector(SimulatedClock())
        slow = lambda: Slow(PeerLink(PjLinkPeer(device)), cable_clock, 4.0)  # noqa: E731
        return Bench.of(PjLinkProjector(slow, clock=cable_clock), device)


def test_an_answer_that_comes_too_late_is_a_timeout() -> None:
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()))
    projector = PjLinkProjector(lambda: Slow(PeerLink(peer), clock, 6.0), clock=clock)
    with pytest.raises(LinkTimeout):
        projector.power()


def test_a_garbled_answer_is_told_and_the_next_connection_is_clean() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock(), Power.ON))
    garbles: list[Callable[[bytes], bytes]] = [lambda data: data.replace(b"POWR=", b"PO\xffR="), lambda data: data]
    projector = PjLinkProjector(lambda: Garbling(PeerLink(peer), garbles.pop(0)))
    with pytest.raises(ProtocolError):
        projector.power()
    assert projector.power() is Power.ON


def test_a_swallowed_answer_is_told_and_the_next_connection_is_clean() -> None:
    device = SimulatedProjector(SimulatedClock())
    made: list[Link] = []

    def connect() -> Link:
        good = PeerLink(PjLinkPeer(device))
        made.append(Deaf(good, after=1) if not made else good)
        return made[-1]

    projector = PjLinkProjector(connect)
    with pytest.raises(LinkTimeout):
        projector.switch_on()
    # The command itself went through; the driver does not hide that it cannot know.
    assert projector.power() is Power.WARMING


def test_a_restarted_server_goes_unnoticed() -> None:
    device = SimulatedProjector(SimulatedClock())
    with serve_pjlink(device, password=PASSWORD) as server:
        projector = PjLinkProjector(lambda: TcpLink.connect(*server.address, 10.0), PASSWORD, 10.0)
        assert projector.power() is Power.STANDBY
        server.hang_up()
        assert projector.power() is Power.STANDBY
        projector.close()


def test_what_is_logged_has_neither_password_nor_digest(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    script = Script(b"PJLINK 1 498e4a67\r", DIGEST + b"%1POWR ?\r", b"%1POWR=1\r")
    assert driver(script, password=PASSWORD).power() is Power.ON
    assert "%1POWR ?" in caplog.text
    assert PASSWORD not in caplog.text
    assert DIGEST.decode("ascii") not in caplog.text
