"""Language files: valid files are loaded, mistakes are refused with file and key."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.projector import FAULT_PARTS
from drivers.serial_projectors.language import (
    answer_parser,
    built_in_languages,
    encode_answer,
    handshake_parser,
    load_language,
    parse_language,
)
from foundation.errors import ConfigurationError, InputError, ProtocolError
from tests.drivers.serial_projectors.made_up import MADE_UP, TEXT

EPSON, BENQ, OPTOMA = (load_language(name) for name in ("epson", "benq", "optoma"))


def test_loads_languages_in_any_case_and_lists_known_ones() -> None:
    assert {"benq", "epson", "optoma"} <= set(built_in_languages())
    assert load_language("Epson") == EPSON
    with pytest.raises(
        ConfigurationError, match=f"'klingon' does not.* expected {', '.join(built_in_languages())}, or "
    ):
        load_language("klingon")
    with pytest.raises(ConfigurationError, match="did you mean 'epson'"):
        load_language("epsn")


def test_speeds_and_ports_match_the_manuals() -> None:
    assert (EPSON.line.baud, BENQ.line.baud, OPTOMA.line.baud) == (9600, 115200, 9600)
    assert EPSON.network is not None
    assert BENQ.network is not None
    assert (EPSON.network.port, BENQ.network.port, OPTOMA.network) == (3629, 8000, None)


def test_codes_match_the_manual() -> None:
    # Epson, ESC/VP21 guide, PWR.
    expected = {"00": "standby", "01": "on", "02": "warm-up", "03": "cooling", "04": "standby", "09": "standby"}
    assert {code: power.value for code, power in EPSON.power.states.items()} == expected
    assert list(EPSON.power.stopped) == ["05"]
    assert EPSON.faults is not None
    parts = {
        "01": "fan",
        "03": "lamp",
        "04": "temperature",
        "06": "lamp",
        "07": "cover",
        "08": "filter",
        "0D": "filter",
    }
    assert EPSON.faults.parts == parts | {"0B": "other"}


def test_loads_a_user_file(tmp_path: Path) -> None:
    path = tmp_path / "lantern.TOML"
    path.write_text(TEXT)
    assert load_language(str(path)) == MADE_UP
    with pytest.raises(InputError, match=r"other\.toml"):
        load_language(str(tmp_path / "other.toml"))


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("busy =", "bussy =", "unknown key 'refusals.bussy'; did you mean 'busy'?"),
        ("[mute]", "[mutes]", "unknown key 'mutes'; did you mean 'mute'?"),
        ("baud = 19200", "", "line.baud is missing; add it"),
        ("baud = 19200", 'baud = "9600"', "line.baud = '9600': expected a whole number"),
        ("baud = 19200", "baud = 19200\necho = 'yes'", "line.echo = 'yes': expected true or false"),
        ('busy = ["BUSY"]', "busy = 5", "refusals.busy = 5: expected a list"),
        ('answer = "POWER {}"', 'answer = "POWER"', "power.answer = 'POWER': expected a text with {}"),
        ('on = "POWER ON"', 'on = "POWER {}"', "power.on = 'POWER {}': expected a text without {}"),
        ('off = "POWER OFF"', 'off = "Power On"', "power: on and off are both 'POWER ON'"),
        ('done = "POWER {}"', 'done = "BUSY"', "power.done = 'BUSY' is also one of the refusals"),
        ("stopped = { HOT", "stopped = { Off", "power: OFF: expected each value in only one"),
        ("{ NO = true, YES = false }", "{ NO = true, no = false }", "mute.states: expected values that differ"),
        ("states = { NO = true, YES = false }", "", "mute: ask is given: expected states with a value"),
        ("states = { NO = true, YES = false }", "states = { NO = true }", "mute: ask is given: expected states"),
        ('ask = "SHOW?"', "", "mute: answer is given without ask"),
        ('healthy = "NONE"', 'healthy = "NO FAULT"', "faults: 'NO FAULT': expected one word"),
        ('healthy = "NONE"', 'healthy = "f"', "faults: healthy = 'f': expected a value that is not in parts"),
        ('healthy = "NONE"', 'healthy = "NONE"\ndigits = 1', "faults: 'NONE': expected 1 hexadecimal digits"),
        ('{ F = "fan", L = "lamp", T = "temperature" }', "{}", "faults.parts: expected at least 1 value"),
        ('command = "@{}\\r\\n"', 'command = "@{}"', "line: command = '@{}': expected the characters"),
        ('ends = "\\r"', 'ends = "#"', "expected one of the characters of ends = '#'"),
        ('answer = "@{}\\r\\n"', 'answer = "@{}#\\r\\n"', "expected one of the characters of ends = '\\r'"),
        ('ends = "\\r"', 'ends = "S\\r"', "mute.answer has 'SHOW {}': expected a text without the characters"),
        ("[name]", '[[unasked]]\ntext = "{}"\n[name]', "power.answer = 'POWER {}' is also one of the unasked messages"),
        ("[name]", '[unasked]\ntext = "BYE"\n[name]', "unasked: expected a list of tables: write [[unasked]]"),
        ("baud = 19200", "baud = 20", "line.baud = 20: "),
        ('HEATING = "warm-up"', 'HEATING = "warm"', "power.states.HEATING = 'warm': "),
        ('OFF = "standby"', 'OFF = "cooling"', 'power: expected a value for "standby"'),
        ('command = "@{}', 'command = "@', "line.command = "),
        ('F = "fan"', 'F = "fans"', f"faults.parts.F = 'fans': expected one of {', '.join(FAULT_PARTS)}"),
        ('on = "POWER ON"', 'on = "MARCHÉ"', "power.on = 'MARCHÉ': expected only ASCII characters"),
        ('busy = ["BUSY"]\nunknown = ["WHAT"]', "", "refusals: expected at least one refusing reply"),
    ],
)
def test_mistakes_report_file_key_and_expectation(before: str, after: str, reason: str) -> None:
    assert before in TEXT
    with pytest.raises(ConfigurationError) as caught:
        parse_language(TEXT.replace(before, after), "lantern.toml")
    assert str(caught.value).startswith("lantern.toml")
    assert reason in str(caught.value)
    assert "languages for examples" in str(caught.value)
    assert "mistakes" not in str(caught.value), "one mistake is reported once"


def test_reports_missing_tables_and_missing_quotation_marks() -> None:
    begin, _, end = TEXT.partition("[mute]")
    without_mute = begin + end[end.index("[faults]") :]
    with pytest.raises(ConfigurationError, match=r"the table \[mute\] is missing; add it, with on, off, done"):
        parse_language(without_mute, "lantern.toml")
    with pytest.raises(ConfigurationError, match=r"is not TOML.*quotation marks"):
        parse_language(TEXT.replace("baud = 19200", "baud = x"), "lantern.toml")


def test_accepts_one_refusal_without_a_list() -> None:
    assert parse_language(TEXT.replace('["BUSY"]', '"BUSY"'), "lantern.toml") == MADE_UP


@pytest.mark.parametrize("state", ['accepted = "2"', 'accepted = "20"\nrefusals = { 4g = "a bad request" }'])
def test_refuses_a_state_that_is_not_a_byte(state: str) -> None:
    handshake = f'[network.handshake]\nsend = "hi"\nanswer_begins = "h"\nanswer_length = 2\nstate_at = 1\n{state}\n'
    with pytest.raises(ConfigurationError, match="two hexadecimal digits"):
        parse_language(TEXT.replace("[refusals]", f"{handshake}[refusals]"), "lantern.toml")


def test_refuses_a_state_after_the_end_of_the_answer() -> None:
    handshake = (
        '[network.handshake]\nsend = "hi"\nanswer_begins = "h"\nanswer_length = 2\nstate_at = 2\naccepted = "00"\n'
    )
    with pytest.raises(ConfigurationError, match="state_at = 2: expected a value below answer_length = 2"):
        parse_language(TEXT.replace("[refusals]", f"{handshake}[refusals]"), "lantern.toml")


def test_answers_survive_encoding_and_parsing() -> None:
    for language in (EPSON, BENQ, OPTOMA, MADE_UP):
        data = encode_answer(language.line, "Answer 1")
        parsed = answer_parser(language)(data + b"more")
        assert parsed is not None
        assert parsed[0] == "Answer 1"
    assert encode_answer(EPSON.line, "") == b":"


@given(data=st.binary(max_size=80))
def test_any_bytes_are_parsed_or_refused(data: bytes) -> None:
    assert EPSON.network is not None
    assert EPSON.network.handshake is not None
    parsers = [answer_parser(language, "pow=?") for language in (EPSON, BENQ, OPTOMA, MADE_UP)]
    for parse in (*parsers, handshake_parser(EPSON.network.handshake)):
        try:
            parsed = parse(data)
        except ProtocolError:
            continue
        assert parsed is None or 1 <= parsed[1] <= len(data)
