"""Projectors with a line protocol: the contract in every language, the manuals' bytes, and cable faults.

The conversations follow the manuals named in the language files. Lines marked "not confirmed" follow other drivers.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.link import MAX_MESSAGE, Link, PeerLink
from drivers.links.serial import SerialLink
from drivers.projector import Fault, Lamp, Power, Projector, ProjectorIdentity, Severity
from drivers.serial_projectors.driver import LineProjector
from drivers.serial_projectors.language import Language, built_in_languages, encode_command, load_language
from foundation.clock import SimulatedClock
from foundation.errors import (
    DeviceError,
    DeviceFault,
    DeviceRefused,
    LinkClosed,
    LinkTimeout,
    ProtocolError,
)
from sim.buses.serial import PseudoTerminal
from sim.projectors.projector import IDENTITY, SimulatedProjector
from sim.projectors.serial import LinePeer
from tests.contracts.projector import Bench, ProjectorContract
from tests.drivers.links.troubled_links import Deaf, Dribbling, DroppedAfter, Garbling
from tests.drivers.serial_projectors.conversation import Script, scripted
from tests.drivers.serial_projectors.made_up import MADE_UP

LANGUAGES: dict[str, Language] = {
    **{name: load_language(name) for name in built_in_languages()},
    "made up": MADE_UP,
}
NAMES = sorted(LANGUAGES)
EPSON = LANGUAGES["epson"]

OPTOMA_STATE = bytes.fromhex("7E 30 30 31 32 34 20 31 0D")


class SerialPeerLink(PeerLink):
    """A cable to a peer in the same thread, which is polled before each read."""

    def read(self, limit: int, timeout: float) -> bytes:
        """Return up to `limit` bytes of the peer's replies."""
        if self._open:
            self._incoming += self._peer.receive(b"")
        return super().read(limit, timeout)


def identity_in(language: Language) -> ProjectorIdentity:
    """Return the names of the simulated projector that a language can report."""
    model = "" if language.model is None else language.model.shown.replace("{}", IDENTITY.model)
    return ProjectorIdentity(language.maker, model, "" if language.name is None else IDENTITY.name)


def faults_in(language: Language, faults: frozenset[Fault]) -> frozenset[Fault]:
    """Return the faults that a language can report: errors, if any."""
    announces = any(message.fault is not None for message in language.unasked)
    if language.faults is None and not announces:
        return frozenset()
    return frozenset(fault for fault in faults if fault.severity is Severity.ERROR)


def bench_of(
    language: Language, device: SimulatedProjector, projector: Projector, catch_up: Callable[[], None]
) -> Bench:
    """Return the bench of a simulated projector; `catch_up` delivers unasked messages."""

    def wait(seconds: float) -> None:
        assert isinstance(device.clock, SimulatedClock)
        catch_up()
        device.clock.sleep(seconds)
        catch_up()

    def break_part(part: str, severity: Severity) -> None:
        device.break_part(part, severity)
        catch_up()

    def repair() -> None:
        device.repair()
        if language.faults is None and language.reports_unasked:
            # It does not announce the repair, only that its lamp is struck again.
            device.switch_on()
        catch_up()

    own = {"wait": wait, "break_part": break_part, "repair": repair, "identity": identity_in(language)}
    bench = replace(Bench.of(projector, device), **own, reported=lambda faults: faults_in(language, faults))
    return replace(bench, counts_hours=language.lamp_hours is not None)


class TestOverMemory(ProjectorContract):
    @pytest.fixture(params=[(name, is_whole) for name in NAMES for is_whole in (True, False)], ids=str)
    def bench(self, request: pytest.FixtureRequest) -> Bench:
        name, is_whole = request.param
        language, device = LANGUAGES[name], SimulatedProjector(SimulatedClock())
        peer = LinePeer(device, language)
        cable = (lambda: SerialPeerLink(peer)) if is_whole else (lambda: Dribbling(SerialPeerLink(peer)))
        return bench_of(language, device, LineProjector(language, cable, clock=device.clock), lambda: None)


class TestOverTheNetwork(ProjectorContract):
    """With handshake, without echo and prompt."""

    @pytest.fixture(params=[name for name in NAMES if LANGUAGES[name].network is not None])
    def bench(self, request: pytest.FixtureRequest) -> Bench:
        language, device = LANGUAGES[request.param], SimulatedProjector(SimulatedClock())
        peer = LinePeer(device, language, network=True)
        projector = LineProjector(language, lambda: SerialPeerLink(peer), network=True, clock=device.clock)
        return bench_of(language, device, projector, lambda: None)


@pytest.mark.slow
class TestOverAPseudoTerminal(ProjectorContract):
    @pytest.fixture(params=NAMES)
    def bench(self, request: pytest.FixtureRequest) -> Iterator[Bench]:
        language, device = LANGUAGES[request.param], SimulatedProjector(SimulatedClock())
        with PseudoTerminal(LinePeer(device, language)) as terminal:
            projector = LineProjector(
                language, lambda: SerialLink.open(terminal.path, language.line.baud), clock=device.clock
            )
            yield bench_of(language, device, projector, terminal.catch_up)
            projector.close()


@pytest.mark.parametrize(
    ("code", "power"),
    [
        (b"00", Power.STANDBY),
        (b"01", Power.ON),
        (b"02", Power.WARMING),
        (b"03", Power.COOLING),
        (b"04", Power.STANDBY),
    ],
)
def test_epson_power_codes(code: bytes, power: Power) -> None:
    projector, script = scripted("epson", (b"PWR?\r", b"PWR=" + code + b"\r:"))
    assert projector.power() is power
    assert script.ended()


def test_epson_abnormal_state_is_a_fault() -> None:
    projector, _ = scripted("epson", (b"PWR?\r", b"PWR=05\r:"))
    with pytest.raises(DeviceFault, match="indicators"):
        projector.power()


def test_epson_gets_no_query_until_it_has_switched_on() -> None:
    clock = SimulatedClock()
    projector, script = scripted(
        "epson", (b"PWR?\r", b"PWR=04\r:"), (b"PWR ON\r", ()), (b"PWR?\r", b"PWR=01\r:"), clock=clock
    )
    projector.switch_on()
    assert projector.power() is Power.WARMING
    with pytest.raises(DeviceRefused):
        projector.lamps()
    clock.sleep(40)
    script.more(b":")
    assert projector.power() is Power.ON
    assert script.ended()


def test_epson_reports_power_but_no_faults_while_switching() -> None:
    projector, script = scripted("epson", (b"ERR?\r", b"ERR\r:"), (b"PWR?\r", b"PWR=03\r:"))
    assert projector.faults() == ()
    assert script.ended()
    projector, script = scripted(
        "epson", (b"PWR?\r", b"PWR=04\r:"), (b"PWR ON\r", ()), (b"ERR?\r", b"ERR\r:"), (b"PWR?\r", b"PWR=01\r:")
    )
    projector.switch_on()
    assert projector.faults() == ()
    script.more(b":")
    assert projector.faults() == (), "if the projector is on, ERR means an unsupported query"
    assert script.ended()


def test_epson_unsupported_queries_return_no_value() -> None:
    on, off = (b"PWR?\r", b"PWR=01\r:"), (b"PWR?\r", b"PWR=04\r:")
    projector, script = scripted(
        "epson", (b"MUTE?\r", b"ERR\r:"), on, (b"LAMP?\r", b"ERR\r:"), on,
        (b"MUTE?\r", b"ERR\r:"), off,
        (b"LAMP?\r", b"ERR\r:"), off, (b"ERR?\r", b"ERR\r:"), off,
    )  # fmt: skip
    assert projector.muted() is None
    assert projector.lamps() == ()
    for ask in (projector.muted, projector.lamps, projector.faults):
        with pytest.raises(DeviceRefused):
            ask()
    assert script.ended()


def test_epson_busy_from_an_earlier_program_reports_the_wait() -> None:
    clock = SimulatedClock()
    peer = LinePeer(SimulatedProjector(clock), EPSON)
    LineProjector(EPSON, lambda: SerialPeerLink(peer), clock=clock).switch_on()
    later = LineProjector(EPSON, lambda: SerialPeerLink(peer), clock=clock)
    with pytest.raises(LinkTimeout, match="wait 130 s"):
        later.power()
    clock.sleep(30)
    assert later.power() is Power.ON


def test_epson_switching_times_out() -> None:
    clock = SimulatedClock()
    projector, _ = scripted("epson", (b"PWR?\r", b"PWR=04\r:"), (b"PWR ON\r", ()), clock=clock)
    projector.switch_on()
    clock.sleep(129)
    assert projector.power() is Power.WARMING
    clock.sleep(1)
    with pytest.raises(LinkTimeout, match="130 s"):
        projector.power()


def test_epson_reports_a_late_refusal() -> None:
    projector, script = scripted("epson", (b"PWR?\r", b"PWR=04\r:"), (b"PWR ON\r", ()), (b"PWR?\r", b"PWR=04\r:"))
    projector.switch_on()
    script.more(b"ERR\r:")
    with pytest.raises(DeviceRefused):
        projector.power()
    assert projector.power() is Power.STANDBY


def test_epson_mute_lamp_and_error_codes() -> None:
    projector, script = scripted(
        "epson",
        (b"MUTE ON\r", b":"),
        (b"MUTE?\r", b"MUTE=ON\r:"),
        (b"MUTE OFF\r", b"ERR\r:"),
        (b"ERR?\r", b"ERR=00\r:"),
        (b"ERR?\r", b"ERR=04\r:"),  # the codes of ERR? are not confirmed
        (b"LAMP?\r", b"LAMP=1234\r:"),
        (b"PWR?\r", b"PWR=01\r:"),
        (b"SNO?\r", b"SNO=X4HE7300123\r:"),
    )
    projector.set_muted(True)
    assert projector.muted()
    with pytest.raises(DeviceRefused):
        projector.set_muted(False)
    assert projector.faults() == ()
    assert projector.faults() == (Fault("temperature", Severity.ERROR),)
    assert projector.lamps() == (Lamp(1234, lit=True),)
    assert projector.identity() == ProjectorIdentity("Epson", "", "X4HE7300123")
    assert script.ended()


def test_epson_ignores_events() -> None:
    # Not confirmed: unasked messages of newer projectors.
    event = b"IMEVENT=0001 02 00000002 00000000 T1 F1\r:"
    projector, script = scripted("epson", (b"PWR?\r", (event, b"PWR=02\r:")))
    assert projector.power() is Power.WARMING
    assert script.ended()


def test_epson_event_does_not_answer_the_wake_up() -> None:
    script = Script((b"\r", b"IMEVENT=0001 02 00000002 00000000 T1 F1\r:"))
    with pytest.raises(LinkTimeout):
        LineProjector(EPSON, lambda: script, clock=SimulatedClock()).power()


@pytest.mark.parametrize("codes", [b"ZZ", b"4", b"004", b"00 X1"])
def test_epson_refuses_an_invalid_fault_code(codes: bytes) -> None:
    projector, _ = scripted("epson", (b"ERR?\r", b"ERR=" + codes + b"\r:"))
    with pytest.raises(ProtocolError):
        projector.faults()


def test_epson_unknown_fault_code_is_another_component() -> None:
    projector, _ = scripted("epson", (b"ERR?\r", b"ERR=1f 04\r:"))
    assert projector.faults() == (Fault("other", Severity.ERROR), Fault("temperature", Severity.ERROR))


HELLO = b"ESC/VP.net\x10\x03\x00\x00\x00\x00"
WELCOME = b"ESC/VP.net\x10\x03\x00\x00\x20\x00"


def test_epson_network_handshake() -> None:
    projector, script = scripted("epson", (HELLO, (WELCOME[:7], WELCOME[7:])), (b"PWR?\r", b"PWR=01\r:"), network=True)
    assert projector.power() is Power.ON
    assert script.ended()


@pytest.mark.parametrize(
    ("answer", "error_type", "reason"),
    [
        (WELCOME[:14] + b"\x41\x00", DeviceRefused, "0x41: a password is required"),
        (WELCOME[:14] + b"\x7f\x00", DeviceRefused, "0x7F: unknown reason; check the network settings"),
        (b"PJLINK 0\r", ProtocolError, "check the port"),
    ],
)
def test_epson_network_refusals_have_reasons(answer: bytes, error_type: type[DeviceError], reason: str) -> None:
    projector, _ = scripted("epson", (HELLO, answer), network=True)
    with pytest.raises(error_type, match=reason):
        projector.power()


def test_stops_if_the_network_always_disconnects() -> None:
    opened: list[Link] = []

    def connect() -> Link:
        opened.append(DroppedAfter(Script(), 0))
        return opened[-1]

    with pytest.raises(LinkClosed):
        LineProjector(EPSON, connect, network=True).power()
    assert len(opened) == 1


ON, OFF = Power.ON, Power.STANDBY


@pytest.mark.parametrize(
    ("reply", "power"),
    [
        (b"\r\n>*pow=?#\r\n*POW=ON#\r\n>", ON),
        (b">*pow=?#\r\r\n*POW=OFF#\r\n\r\n>", OFF),
        (b"*POW=ON#", ON),
        (b"*pow=off#\r\n", OFF),
        (b"\0\0>*pow=?#\r\nPOW=ON\r\n", ON),
        (b">*POW=?#\r\n*POW=ON#\r\n>", ON),  # echo in capitals, rrooggiieerr/homeassistant-benqprojector 8
        (b">*pow=?#\r\r\n*POW = off #\r\n", OFF),
    ],
)
def test_benq_power_with_and_without_echo_and_prompt(reply: bytes, power: Power) -> None:
    projector, _ = scripted("benq", (b"\r*pow=?#\r", reply))
    assert projector.power() is power


@pytest.mark.parametrize(
    ("state", "answer"),
    [
        (b">*pow=?#\r\n*POW=OFF#\r\n>", b">*pow=on#\r\n>"),
        (b"*pow=?#\r\n*POW=OFF#\r\n", b"*pow=on#\r\n*pow=on#\r\n"),
    ],
    ids=["with a prompt", "without"],
)
def test_benq_answer_equal_to_its_echo(state: bytes, answer: bytes) -> None:
    projector, script = scripted("benq", (b"\r*pow=?#\r", state), (b"\r*pow=on#\r", answer))
    projector.switch_on()
    assert script.ended()


def test_benq_transition_follows_from_the_last_state() -> None:
    blocked = b">*pow=?#\r\n*Block item#\r\n>"
    projector, script = scripted(
        "benq",
        (b"\r*pow=?#\r", blocked),
        (b"\r*pow=?#\r", b">*pow=?#\r\n*POW=OFF#\r\n>"),
        (b"\r*pow=?#\r", blocked),
        (b"\r*pow=?#\r", b">*pow=?#\r\n*POW=ON#\r\n>"),
        (b"\r*pow=?#\r", blocked),
    )
    with pytest.raises(DeviceRefused):
        projector.power()
    assert projector.power() is Power.STANDBY
    assert projector.power() is Power.WARMING
    assert projector.power() is Power.ON
    assert projector.power() is Power.COOLING
    assert script.ended()


def test_benq_names_lamps_and_refusals() -> None:
    projector, _ = scripted(
        "benq",
        (b"\r*modelname=?#\r", b">*modelname=?#\r\n*MODELNAME=W1070#\r\n>"),
        (b"\r*modelname=?#\r", b">*modelname=?#\r\nW700\r\n>"),
        (b"\r*modelname=?#\r", b">*modelname=?#\r\n*Illegal format#\r\n>"),
        (b"\r*ltim=?#\r", b">*ltim=?#\r\n*LTIM=432#\r\n>"),
        (b"\r*pow=?#\r", b">*pow=?#\r\n*POW=ON#\r\n>"),
        (b"\r*ltim=?#\r", b">*ltim=?#\r\n*Unsupported item#\r\n>"),
        (b"\r*blank=?#\r", b">*blank=?#\r\n*BLANK=OFF#\r\n>"),
        (b"\r*blank=on#\r", b">*blank=on#\r\n*BLANK=ON#\r\n>"),
        (b"\r*blank=?#\r", b">*blank=?#\r\nBlock item\r\n>"),
    )
    assert projector.identity() == ProjectorIdentity("BenQ", "W1070", "")
    assert projector.identity() == ProjectorIdentity("BenQ", "W700", "")
    assert projector.identity() == ProjectorIdentity("BenQ", "", "")
    assert projector.lamps() == (Lamp(432, lit=True),)
    assert projector.lamps() == ()
    projector.set_muted(True)
    with pytest.raises(DeviceRefused):
        projector.muted()


def test_benq_refusal_in_place_of_the_value() -> None:
    # A TK700STi that is cooling down, arendst/Tasmota 15841.
    off = bytes.fromhex("3E2A706F773D3F230D0D0A2A504F573D4F4646230D0A")
    cooling = bytes.fromhex("3E2A706F773D3F230D0D0A2A504F573D426C6F636B206974656D230D0A")
    projector, script = scripted("benq", (b"\r*pow=?#\r", off), (b"\r*pow=?#\r", cooling))
    assert projector.power() is Power.STANDBY
    assert projector.power() is Power.WARMING
    assert script.ended()


def test_benq_lamp_hours_with_a_blank() -> None:
    # A W1100, rrooggiieerr/benqprojector.py 5.
    projector, _ = scripted(
        "benq",
        (b"\r*ltim=?#\r", b"*ltim=?#\r\n*ltim= 1383\r\n"),
        (b"\r*pow=?#\r", b"*POW=ON#\r\n"),
        (b"\r*ltim=?#\r", b"*LTIM=unknown#\r\n"),
    )
    assert projector.lamps() == (Lamp(1383, lit=True),)
    assert projector.lamps() == ()


def test_optoma_confirms_a_query_before_its_answer() -> None:
    # grapefrukt/esphome-optoma 3.
    projector, script = scripted("optoma", (OPTOMA_STATE, b"P\rOk1\r"), (OPTOMA_STATE, b"OK01\r"))
    assert projector.power() is Power.ON
    assert projector.power() is Power.ON
    assert script.ended()


@pytest.mark.parametrize("answer", [b"Illegal format", b"Unsupported item"])
def test_benq_unsupported_mute_query_returns_none(answer: bytes) -> None:
    projector, _ = scripted("benq", (b"\r*blank=?#\r", b">*blank=?#\r\n*" + answer + b"#\r\n>"))
    assert projector.muted() is None


def test_benq_unknown_mute_state_is_set_again() -> None:
    # A remote control may have shown the image in between.
    ask = (b"\r*blank=?#\r", b"*Unsupported item#\r\n")
    hide = (b"\r*blank=on#\r", b"*BLANK=ON#\r\n")
    projector, script = scripted("benq", ask, hide, ask, hide, ask)
    projector.set_muted(True)
    projector.set_muted(True)
    assert projector.muted(), "the last command counts if the state is not reported"
    assert script.ended()


def test_without_fault_query_only_busy_counts_as_healthy() -> None:
    ask = b"\r*pow=?#\r"
    projector, _ = scripted("benq", (ask, b"*Block item#\r\n"), (ask, b"*Unsupported item#\r\n"))
    assert projector.faults() == ()
    with pytest.raises(DeviceRefused, match="remote control"):
        projector.faults()
    projector, _ = scripted("optoma", (OPTOMA_STATE, b"F\r"))
    with pytest.raises(DeviceRefused):
        projector.faults()


# "Power ON ~XX00 1: 7E 30 30 30 30 20 31 0D", HD50 manual.
OPTOMA_ON = bytes.fromhex("7E 30 30 30 30 20 31 0D")
OPTOMA_MUTE = bytes.fromhex("7E 30 30 30 32 20 31 0D")


# "Power State ~XX124 1: 7E 30 30 31 32 34 20 31 0D", W351 manual.
def test_optoma_announces_its_power_state() -> None:
    projector, script = scripted(
        "optoma",
        (OPTOMA_STATE, b"OK0\r"),
        (OPTOMA_ON, b"P\r"),
        (OPTOMA_STATE, (b"INFO1\r", b"OK0\r")),
        (OPTOMA_STATE, b"OK1\r"),
        (OPTOMA_STATE, b"Ok1\r"),
        (OPTOMA_STATE, b"OK0\r"),
    )
    projector.switch_on()
    assert projector.power() is Power.WARMING
    assert projector.power() is Power.ON
    script.more(b"INFO2\r")
    assert projector.power() is Power.COOLING
    script.more(b"INFO0\r")
    assert projector.power() is Power.STANDBY
    assert script.ended()


def test_optoma_mute_lamp_model_and_refusal() -> None:
    projector, script = scripted(
        "optoma",
        (OPTOMA_MUTE, b"P"),
        (b"~00355 1\r", b"F\r"),  # not confirmed; missing in older models
        (b"~00108 1\r", b"OK0123\r"),
        (OPTOMA_STATE, b"OK1\r"),
        (b"~00151 1\r", b"OK2\r"),
        (b"~0002 0\r", b"F\r"),
    )
    projector.set_muted(True)
    assert projector.muted(), "the last command counts if the state is not reported"
    assert projector.lamps() == (Lamp(123, lit=True),)
    assert projector.identity() == ProjectorIdentity("Optoma", "model 2", "")
    with pytest.raises(DeviceRefused):
        projector.set_muted(False)
    assert script.ended()


@pytest.mark.parametrize("pieces", [(b"PINFO1\r",), (b"P", b"INFO1\r"), (b"PIN", b"FO1\r"), (b"INFO1\rP",)], ids=str)
def test_optoma_unended_answer_before_an_unasked_message(pieces: tuple[bytes, ...]) -> None:
    projector, script = scripted("optoma", (OPTOMA_STATE, b"OK0\r"), (OPTOMA_ON, pieces), (OPTOMA_STATE, b"OK0\r"))
    projector.switch_on()
    assert projector.power() is Power.WARMING
    assert script.ended()


def test_optoma_unended_refusal_before_an_unasked_message() -> None:
    projector, _ = scripted("optoma", (OPTOMA_MUTE, b"FINFO6\r"), (OPTOMA_STATE, b"OK1\r"))
    with pytest.raises(DeviceRefused):
        projector.set_muted(True)
    assert projector.faults() == (Fault("fan", Severity.ERROR),)


def test_optoma_unsupported_mute_query_returns_none() -> None:
    projector, script = scripted("optoma", (b"~00355 1\r", b"F\r"), (OPTOMA_MUTE, b"P\r"), (b"~00355 1\r", b"F\r"))
    assert projector.muted() is None
    projector.set_muted(True)
    assert projector.muted()
    assert script.ended()


@pytest.mark.parametrize(("number", "part"), [(4, "lamp"), (6, "fan"), (7, "temperature")])
def test_optoma_announced_faults_are_reported(number: int, part: str) -> None:
    projector, _ = scripted("optoma", (OPTOMA_STATE, b"INFO%d\rOK0\r" % number))  # INFO4 is not confirmed
    assert projector.faults() == (Fault(part, Severity.ERROR),)


def test_extra_reply_does_not_answer_the_next_query() -> None:
    projector, script = scripted("epson", (b"PWR?\r", b"PWR=01\r:PWR=04\r:"), (b"PWR?\r", b"PWR=03\r:"))
    assert projector.power() is Power.ON
    assert projector.power() is Power.COOLING
    assert script.ended()


def answers_on(name: str) -> bytes:
    """Return the reply of the simulated projector to the power query when it is on."""
    language = LANGUAGES[name]
    peer = LinePeer(SimulatedProjector(SimulatedClock(), Power.ON), language)
    return peer.receive(encode_command(language.line, language.power.ask))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_answer_does_not_depend_on_splitting(name: str, data: st.DataObject) -> None:
    language, answer = LANGUAGES[name], answers_on(name)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(answer) - 1))))
    pieces = tuple(answer[start:end] for start, end in zip([0, *cuts], [*cuts, len(answer)], strict=True))
    projector, _ = scripted(language, (encode_command(language.line, language.power.ask), pieces))
    assert projector.power() is Power.ON


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_half_an_answer_times_out(name: str, data: st.DataObject) -> None:
    language, answer = LANGUAGES[name], answers_on(name)
    end = answer.rindex(language.line.ends[0].encode("ascii"))
    half = answer[: data.draw(st.integers(0, end))]
    projector, _ = scripted(language, (encode_command(language.line, language.power.ask), (half,) if half else ()))
    with pytest.raises(LinkTimeout):
        projector.power()


def troubled(name: str, trouble: Callable[[Link], Link]) -> Projector:
    language = LANGUAGES[name]
    peer = LinePeer(SimulatedProjector(SimulatedClock(), Power.ON), language)
    return LineProjector(language, lambda: trouble(SerialPeerLink(peer)))


@pytest.mark.parametrize("name", NAMES)
@given(data=st.binary(max_size=80))
def test_any_bytes_are_understood_or_refused(name: str, data: bytes) -> None:
    class Answering(Dribbling):
        def read(self, limit: int, timeout: float) -> bytes:
            nonlocal data
            if not timeout:
                return b""
            if not data:
                raise LinkTimeout("nothing more comes")
            taken, data = data[:limit], data[limit:]
            return taken

    with contextlib.suppress(DeviceError):
        assert troubled(name, Answering).power() in Power


@pytest.mark.parametrize("name", NAMES)
@given(key=st.binary(min_size=4, max_size=4).filter(any))
def test_wrong_speed_is_a_device_error(name: str, key: bytes) -> None:
    # At the wrong speed some bits are wrong, and the highest bit is mostly set.
    def garble(data: bytes) -> bytes:
        return bytes(byte ^ key[place % 4] | 0x80 for place, byte in enumerate(data))

    with pytest.raises(DeviceError, match="speed"):
        troubled(name, lambda good: Garbling(good, garble)).power()


@pytest.mark.parametrize("name", NAMES)
def test_timeout_names_the_remedies(name: str) -> None:
    limit = f"{LANGUAGES[name].line.timeout_s:g} s"
    with pytest.raises(LinkTimeout, match=rf"within {re.escape(limit)}.*cable.*speed.*standby"):
        troubled(name, lambda good: Deaf(good, 0)).power()


@pytest.mark.parametrize("name", NAMES)
def test_refuses_endless_noise(name: str) -> None:
    class Chattering(Dribbling):
        def read(self, limit: int, timeout: float) -> bytes:
            return b"O" * MAX_MESSAGE

    with pytest.raises(ProtocolError):
        troubled(name, Chattering).power()


@pytest.mark.parametrize("name", NAMES)
def test_reopens_a_dropped_connection(name: str) -> None:
    language = LANGUAGES[name]
    peer = LinePeer(SimulatedProjector(SimulatedClock(), Power.ON), language)
    opened: list[Link] = []

    def connect() -> Link:
        good = SerialPeerLink(peer)
        opened.append(DroppedAfter(good, 2) if not opened else good)
        return opened[-1]

    projector = LineProjector(language, connect)
    for _ in range(4):
        assert projector.power() is Power.ON
    assert len(opened) == 2


@pytest.mark.parametrize("name", NAMES)
def test_late_answer_does_not_answer_the_next_query(name: str) -> None:
    language = LANGUAGES[name]
    peer = LinePeer(SimulatedProjector(SimulatedClock(), Power.ON), language)
    waiting: list[bytes] = []
    late: list[bool] = [False]

    class Late(Dribbling):
        def read(self, limit: int, timeout: float) -> bytes:
            if late[0] and timeout:
                waiting.append(self.good.read(limit, timeout))
                raise LinkTimeout("later")
            return waiting.pop() if waiting else self.good.read(limit, timeout)

    projector = LineProjector(language, lambda: Late(SerialPeerLink(peer)))
    assert projector.power() is Power.ON
    late[0] = True
    with pytest.raises(LinkTimeout):
        # Every language has this command.
        projector.set_muted(True)
    late[0] = False
    assert projector.power() is Power.ON


@pytest.mark.parametrize("name", NAMES)
def test_reports_an_unplugged_cable(name: str) -> None:
    language = LANGUAGES[name]
    with PseudoTerminal(LinePeer(SimulatedProjector(SimulatedClock(), Power.ON), language)) as terminal:
        projector = LineProjector(language, lambda: SerialLink.open(terminal.path, language.line.baud))
        assert projector.power() is Power.ON
    with pytest.raises(LinkClosed, match=terminal.path):
        projector.power()
    projector.close()
