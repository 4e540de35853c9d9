"""PJLink's lines against the standard's own examples, and any split of them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ProtocolError
from drivers.pjlink import wire
from drivers.pjlink.wire import ErrorCode, Greeting, LineCutter, Refused, Reply, Request
from drivers.projector import Fault, Lamp, Power, Severity

PRINTABLE = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=100)


def test_digest_is_the_standards_example() -> None:
    # PJLink 1.04, 5.1: seed 498e4a67, password JBMIAProjectorLink.
    assert wire.authentication_digest("498e4a67", "JBMIAProjectorLink") == "5d8409bc1c3fa39749434aa3a5c38682"


@pytest.mark.parametrize(
    ("line", "greeting"),
    [
        (b"PJLINK 0", Greeting()),
        (b"PJLINK 1 498e4a67", Greeting("498e4a67")),
        (b"pjlink 1 498E4a67", Greeting("498E4a67")),
        (b"PJLINK ERRA", Refused.WRONG_PASSWORD),
    ],
)
def test_greetings(line: bytes, greeting: Greeting | Refused) -> None:
    assert wire.parse_greeting(line) == greeting


@pytest.mark.parametrize(
    "line", [b"", b"PJLINK", b"PJLINK 1", b"PJLINK 1 short", b"PJLINK 0 x", b"SSH-2.0-x", b"\xff\xfe"]
)
def test_what_is_no_greeting_is_quoted(line: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"check that PJLink is enabled"):
        wire.parse_greeting(line)


def test_commands_are_the_standards_bytes() -> None:
    # PJLink 1.04, 4.1 and 5.1.
    assert wire.encode_request(Request("POWR", "1")) == b"%1POWR 1\r"
    assert wire.encode_request(Request("INPT")) == b"%1INPT ?\r"
    assert wire.encode_request(Request("AVMT", "31")) == b"%1AVMT 31\r"
    assert (
        wire.encode_request(Request("POWR", digest="5d8409bc1c3fa39749434aa3a5c38682"))
        == b"5d8409bc1c3fa39749434aa3a5c38682%1POWR ?\r"
    )
    assert wire.encode_request(Request("SNUM", level=2)) == b"%2SNUM ?\r"


@pytest.mark.parametrize(
    "request_", [Request("powr"), Request("POW"), Request("POWR", "1\r"), Request("POWR", "x" * 129)]
)
def test_our_own_mistakes_never_reach_the_cable(request_: Request) -> None:
    with pytest.raises(ValueError, match="is no PJLink"):
        wire.encode_request(request_)


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        (b"%1POWR=0", Reply("POWR", "0")),
        (b"%1POWR=OK", Reply("POWR", "OK")),
        (b"%1powr=ERR3", Reply("POWR", "ERR3")),
        (b"%1LAMP=120 1 3000 0", Reply("LAMP", "120 1 3000 0")),
        (b"%1NAME=", Reply("NAME", "")),
        ("%1NAME=Höllenmaschine".encode(), Reply("NAME", "Höllenmaschine")),
        (b"%2SNUM=42", Reply("SNUM", "42", level=2)),
        (b"PJLINK ERRA", Refused.WRONG_PASSWORD),
        (b"pjlink erra", Refused.WRONG_PASSWORD),
    ],
)
def test_replies(line: bytes, reply: Reply | Refused) -> None:
    assert wire.parse_reply(line) == reply


@pytest.mark.parametrize("line", [b"%1POWR 0", b"POWR=0", b"%1POW=0", b"%xPOWR=0", b"", b"%1NAME=" + b"x" * 129])
def test_what_is_no_reply_is_quoted(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="expected %1 or %2"):
        wire.parse_reply(line)


def test_errors_are_values_of_their_own() -> None:
    assert Reply("POWR", "ERR1").error is ErrorCode.UNDEFINED
    assert Reply("POWR", "err2").error is ErrorCode.OUT_OF_PARAMETER
    assert Reply("POWR", "ERR3").error is ErrorCode.UNAVAILABLE
    assert Reply("POWR", "ERR4").error is ErrorCode.FAILURE
    assert Reply("NAME", "ERR5").error is None


def test_values_of_the_standard() -> None:
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


@pytest.mark.parametrize(
    ("parse", "value"),
    [
        (wire.parse_power, "4"),
        (wire.parse_power, ""),
        (wire.parse_mute, "12"),
        (wire.parse_mute, "on"),
        (wire.parse_faults, "00000"),
        (wire.parse_faults, "300000"),
        (wire.parse_lamps, "120"),
        (wire.parse_lamps, "120 2"),
        (wire.parse_lamps, "-1 0"),
        (wire.parse_lamps, "١ 1"),
    ],
)
def test_values_outside_the_standard_are_protocol_errors(parse: object, value: str) -> None:
    assert callable(parse)
    with pytest.raises(ProtocolError, match="expected"):
        parse(value)


@given(st.sampled_from(Power))
def test_power_comes_back(power: Power) -> None:
    assert wire.parse_power(wire.format_power(power)) is power


@given(st.dictionaries(st.sampled_from(wire.FAULT_PARTS), st.sampled_from(Severity)))
def test_faults_come_back(faults: dict[str, Severity]) -> None:
    assert {fault.part: fault.severity for fault in wire.parse_faults(wire.format_faults(faults))} == faults


@given(st.lists(st.builds(Lamp, st.integers(0, 99999), st.booleans()), min_size=1, max_size=8))
def test_lamps_come_back(lamps: list[Lamp]) -> None:
    assert wire.parse_lamps(wire.format_lamps(lamps)) == tuple(lamps)


@given(
    st.builds(
        Request,
        st.from_regex("[A-Z0-9]{4}", fullmatch=True),
        PRINTABLE.filter(bool),
        st.sampled_from((1, 2)),
        st.sampled_from(("", "5d8409bc1c3fa39749434aa3a5c38682")),
    )
)
def test_requests_come_back(request_: Request) -> None:
    assert wire.parse_request(wire.encode_request(request_)[:-1]) == request_


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_a_protocol_error(line: bytes) -> None:
    for parse in (wire.parse_greeting, wire.parse_request, wire.parse_reply):
        try:
            parse(line)
        except ProtocolError as error:
            assert len(str(error)) < 600  # noqa: PT017 – both outcomes are right; only the message is judged


@given(st.data())
def test_any_split_gives_the_same_lines(data: st.DataObject) -> None:
    end = st.sampled_from((b"\r", b"\r\n", b"\n", b"\r\r\n"))
    lines = data.draw(st.lists(PRINTABLE.map(str.encode).filter(bool), max_size=6))
    stream = b"".join(line + data.draw(end) for line in lines)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    cutter = LineCutter()
    found: list[bytes] = []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += cutter.feed(stream[start:stop])
    assert found == lines


def test_the_longest_line_passes_and_one_byte_more_does_not() -> None:
    longest = b"%1NAME=" + b"x" * 128
    assert len(longest) + 1 == wire.MAX_LINE
    assert LineCutter().feed(longest + b"\r") == [longest]
    with pytest.raises(ProtocolError, match="136 bytes"):
        LineCutter().feed(longest + b"y\r")
    cutter = LineCutter()
    cutter.feed(longest)
    with pytest.raises(ProtocolError, match="136 bytes"):
        cutter.feed(b"y")
