"""Codes of a plain frame."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.presenter import BLACK, WHITE, Colour

CODES = st.integers(0, 255)


@given(CODES, CODES, CODES)
def test_every_code_of_a_byte_is_a_colour(red: int, green: int, blue: int) -> None:
    colour = Colour(red, green, blue)
    assert colour.codes == (red, green, blue)
    assert colour == Colour(red, green, blue)


@given(st.integers().filter(lambda code: not 0 <= code <= 255), st.sampled_from(("red", "green", "blue")))
def test_what_no_projector_can_show_is_refused_by_name(code: int, channel: str) -> None:
    codes = {"red": 0, "green": 0, "blue": 0, channel: code}
    with pytest.raises(ValueError, match=f"{channel} is {code}; a code is 0 … 255"):
        Colour(**codes)


def test_black_and_white_are_the_ends() -> None:
    assert Colour(0, 0, 0) == BLACK
    assert Colour(255, 255, 255) == WHITE
