"""PJLink's lines against the standard's own examples, and any split of them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import pjlink as wire
from drivers.pjlink import NoResolution, PjLinkReply, PjLinkRequest, Refused, Resolution
from drivers.projector import Fault, Lamp, Power, Severity
from foundation.errors import ProtocolError

PRINTABLE = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=100)


def test_digest_is_the_standards_example() -> None:
    # PJLink 1.04, 5.1: seed 498e4a67, password JBMIAProjectorLink.
    assert wire.authentication_digest("498e4a67", "JBMIAProjectorLink") == "5d8409bc1c3fa39749434aa3a5c38682"


@pytest.mark.parametrize(
    ("line", "greeting"),
    [
        (b"PJLINK 0", None),
        (b"PJLINK 1 498e4a67", "498e4a67"),
        (b"pjlink 1 498E4a67", "498E4a67"),
        (b"PJLINK ERRA", Refused.WRONG_PASSWORD),
    ],
)
def test_greetings(line: bytes, greeting: str | Refused | None) -> None:
    assert wire.parse_greeting(line) == greeting


@pytest.mark.parametrize(
    "line", [b"", b"PJLINK", b"PJLINK 1", b"PJLINK 1 short", b"PJLINK 0 x", b"SSH-2.0-x", b"\xff\xfe"]
)
def test_what_is_no_greeting_is_quoted(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="PJLink is enabled"):
        wire.parse_greeting(line)


def test_an_http_server_that_speaks_first_is_said_to_be_one() -> None:
    # RFC 9110, 15.5.9: what a server may send that has waited too long for a request.
    with pytest.raises(ProtocolError, match=r"HTTP server.*'HTTP/1\.1 408"):
        wire.parse_greeting(b"HTTP/1.1 408 Request Timeout")


def test_commands_are_the_standards_bytes() -> None:
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
    "request_",
    [PjLinkRequest("powr"), PjLinkRequest("POW"), PjLinkRequest("POWR", "1\r"), PjLinkRequest("POWR", "x" * 129)],
)
def test_our_own_mistakes_never_reach_the_cable(request_: PjLinkRequest) -> None:
    with pytest.raises(ValueError, match="is no PJLink"):
        wire.encode_request(request_)


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
    ],
)
def test_replies(line: bytes, reply: PjLinkReply | Refused) -> None:
    assert wire.parse_reply(line) == reply


@pytest.mark.parametrize("line", [b"%1POWR 0", b"POWR=0", b"%1POW=0", b"%xPOWR=0", b"", b"%1NAME=" + b"x" * 129])
def test_what_is_no_reply_is_quoted(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        wire.parse_reply(line)


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


def test_values_of_class_2() -> None:
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
        (wire.parse_input, "71"),
        (wire.parse_input, "30"),
        (wire.parse_input, "3"),
        (wire.parse_input_resolution, "1920"),
        (wire.parse_input_resolution, ""),
        (wire.parse_input_resolution, "1920x1080p"),
        (wire.parse_input_resolution, "٣x٣"),
        (wire.parse_freeze, "2"),
        (wire.parse_class, "0"),
        (wire.parse_class, "²"),
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
    with pytest.raises(ProtocolError):
        parse(value)


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
def test_requests_come_back(request_: PjLinkRequest) -> None:
    assert wire.parse_request(wire.encode_request(request_)[:-1]) == request_


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_a_protocol_error(line: bytes) -> None:
    for parse in (wire.parse_greeting, wire.parse_request, wire.parse_reply):
        try:
            parse(line)
        except ProtocolError as error:
            assert len(str(error)) < 600  # noqa: PT017 – both outcomes are right; only the message is judged


@pytest.mark.slow
@given(st.data())
def test_any_split_gives_the_same_lines(data: st.DataObject) -> None:
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
    found, rest = list[bytes](), b""
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        rest += stream[start:stop]
        while (taken := wire.take_line(rest)) is not None:
            found.append(taken[0])
            rest = rest[taken[1] :]
    assert found == lines


def test_the_longest_line_passes_and_one_byte_more_does_not() -> None:
    longest = b"%1NAME=" + b"x" * 128
    assert len(longest) + 1 == wire.MAX_LINE
    assert wire.take_line(longest + b"\r") == (longest, 136)
    assert wire.take_line(longest) is None
    for longer in (longest + b"y\r", longest + b"y"):
        with pytest.raises(ProtocolError):
            wire.take_line(longer)
