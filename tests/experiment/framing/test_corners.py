"""Corners given by hand: read as raw pixels, and refused where no field can be."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from experiment.framing.field import corners_text, parse_corners
from foundation.errors import InputError

GOOD = ("101,51", "3000.5,60", "2990,1900", "95,1890")


def test_raw_pixels_become_half_size_ones() -> None:
    # Raw pixels 0 and 1 make the half-size pixel 0: its middle lies at raw 0.5.
    assert parse_corners(GOOD)[:2] == ((50.25, 25.25), (1500.0, 29.75))
    assert corners_text(parse_corners(GOOD)) == "101,51 3000,60 2990,1900 95,1890"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (GOOD[:3], "3 corners are given"),
        ((*GOOD, "1,1"), "5 corners are given"),
        ((*GOOD[:3], "session"), "'session' is no corner"),
        ((*GOOD[:3], "95"), "'95' is no corner"),
        ((*GOOD[:3], "95,nan"), "'95,nan' is no corner"),
        ((*GOOD[:3], "1,2,3"), "'1,2,3' is no corner"),
        ((GOOD[0], GOOD[2], GOOD[1], GOOD[3]), "no convex quadrilateral"),
        (("0,0", "1000,0", "500,100", "500,1000"), "no convex quadrilateral"),
        ((GOOD[0],) * 4, "no convex quadrilateral"),
        (GOOD[::-1], "counter-clockwise"),
        (("0,0", "1000,0", "1000,100", "0,100"), "at least 192 expected"),
    ],
)
def test_what_cannot_be_corners_is_refused(given: Sequence[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_corners(given)
