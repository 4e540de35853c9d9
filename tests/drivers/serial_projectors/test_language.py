"""Language files: what they say is taken as it stands, and what they cannot say is refused with file and key."""

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


def test_languages_are_found_in_any_case_and_unknown_ones_name_the_known() -> None:
    assert {"benq", "epson", "optoma"} <= set(built_in_languages())
    assert load_language("Epson") == EPSON
    with pytest.raises(ConfigurationError, match=f"'klingon'; expected {', '.join(built_in_languages())}, or "):
        load_language("klingon")


def test_speeds_and_ports_are_those_of_the_manuals() -> None:
    assert (EPSON.line.baud, BENQ.line.baud, OPTOMA.line.baud) == (9600, 115200, 9600)
    assert EPSON.network is not None
    assert BENQ.network is not None
    assert (EPSON.network.port, BENQ.network.port, OPTOMA.network) == (3629, 8000, None)


def test_codes_are_those_of_the_manual() -> None:
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


def test_a_file_of_ones_own_is_read(tmp_path: Path) -> None:
    path = tmp_path / "lantern.TOML"
    path.write_text(TEXT)
    assert load_language(str(path)) == MADE_UP
    with pytest.raises(InputError, match=r"other\.toml"):
        load_language(str(tmp_path / "other.toml"))


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("busy =", "bussy =", "unknown key 'refusals.bussy'; did you mean 'busy'?"),
        ("[mute]", "[mutes]", "unknown key 'mutes'; did you mean 'mute'?"),
        ("baud = 19200", "", "line.baud is missing; add it"),
        ("baud = 19200", "baud = 20", "line.baud = 20: "),
        ('HEATING = "warm-up"', 'HEATING = "warm"', "power.states.HEATING = 'warm': "),
        ('OFF = "standby"', 'OFF = "cooling"', 'power: a value for "standby" was expected'),
        ('command = "@{}', 'command = "@', "line.command = "),
        ('F = "fan"', 'F = "fans"', f"faults.parts.F = 'fans': expected one of {', '.join(FAULT_PARTS)}"),
        ('on = "POWER ON"', 'on = "MARCHÉ"', "power.on = 'MARCHÉ': ASCII characters were expected"),
        ('busy = ["BUSY"]\nunknown = ["WHAT"]', "", "refusals: at least one answer that refuses was expected"),
        ("baud = 19200", "baud = x", "is not TOML"),
    ],
)
def test_a_mistake_names_file_key_and_expectation(before: str, after: str, said: str) -> None:
    assert before in TEXT
    with pytest.raises(ConfigurationError) as told:
        parse_language(TEXT.replace(before, after), "lantern.toml")
    assert str(told.value).startswith("lantern.toml")
    assert said in str(told.value)
    assert "languages for examples" in str(told.value)


def test_a_state_behind_the_end_of_the_answer_is_refused() -> None:
    handshake = (
        '[network.handshake]\nsend = "hi"\nanswer_begins = "h"\nanswer_length = 2\nstate_at = 2\naccepted = "00"\n'
    )
    with pytest.raises(ConfigurationError, match="state_at = 2 was expected below answer_length = 2"):
        parse_language(TEXT.replace("[refusals]", f"{handshake}[refusals]"), "lantern.toml")


def test_an_answer_survives_both_ends() -> None:
    for language in (EPSON, BENQ, OPTOMA, MADE_UP):
        data = encode_answer(language.line, "Answer 1")
        taken = answer_parser(language.line)(data + b"more")
        assert taken is not None
        assert taken[0] == "Answer 1"
    assert encode_answer(EPSON.line, "") == b":"


@given(data=st.binary(max_size=80))
def test_whatever_comes_is_taken_waited_for_or_refused(data: bytes) -> None:
    assert EPSON.network is not None
    assert EPSON.network.handshake is not None
    parsers = [answer_parser(language.line, "pow=?") for language in (EPSON, BENQ, OPTOMA, MADE_UP)]
    for take in (*parsers, handshake_parser(EPSON.network.handshake)):
        try:
            taken = take(data)
        except ProtocolError:
            continue
        assert taken is None or 1 <= taken[1] <= len(data)
