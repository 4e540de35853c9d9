"""The dials against what is engraved on them."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from drivers.canon.apex import APERTURE, ISO, SHUTTER, TOLERANCE, Scale
from foundation.errors import InputError, ProtocolError

SCALES = pytest.mark.parametrize("scale", [SHUTTER, APERTURE, ISO], ids=lambda scale: scale.name)
# The list of apertures that the recorded 60D offered: third stops, f/3.5 to f/22.
APERTURES_60D = (0x25, 0x28, 0x2B, 0x2D, 0x30, 0x33, 0x35, 0x38, 0x3B, 0x3D, 0x40, 0x43, 0x45, 0x48, 0x4B, 0x4D, 0x50)


@pytest.mark.parametrize(
    ("scale", "code", "label", "value"),
    [
        (SHUTTER, 0x10, "30", 30),
        (SHUTTER, 0x38, "1", 1),
        (SHUTTER, 0x45, "0.3", 0.3),
        (SHUTTER, 0x68, "1/60", 1 / 60),
        (SHUTTER, 0xA0, "1/8000", 1 / 8000),
        (APERTURE, 0x10, "1.4", 1.4),
        (APERTURE, 0x25, "3.5", 3.5),
        (APERTURE, 0x38, "8", 8),
        (APERTURE, 0x50, "22", 22),
        (ISO, 0x48, "100", 100),
        (ISO, 0x4D, "160", 160),
        (ISO, 0x78, "6400", 6400),
        (ISO, 0x98, "102400", 102400),
    ],
)
def test_codes_are_canons(scale: Scale, code: int, label: str, value: float) -> None:
    assert scale.label(code) == label
    assert scale.value(code) == pytest.approx(value)
    assert scale.code(label) == scale.code(value) == code


@SCALES
def test_every_label_finds_its_code_back(scale: Scale) -> None:
    for step in scale.steps:
        assert scale.code(step.label, [step.code]) == scale.code(step.value, [step.code]) == step.code


@SCALES
def test_labels_are_rounded_stops(scale: Scale) -> None:
    # A nominal value lies within a quarter of a stop of the exact one (0.3 s and f/1.8 as half stops are the
    # coarsest), so that no code can be off by a third.
    for step in scale.steps:
        stops = abs(math.log2(step.value / scale.exact(step.code))) * (2 if scale is APERTURE else 1)
        assert stops < 0.25, (step, stops)


@SCALES
def test_neighbours_are_wider_apart_than_the_tolerance(scale: Scale) -> None:
    values = sorted({step.value for step in scale.steps})
    assert min(high / low for low, high in pairwise(values)) > 1.05 > 1 + 2 * TOLERANCE


@SCALES
def test_codes_ascend_as_values_do(scale: Scale) -> None:
    values = [step.value for step in scale.steps]
    assert values == sorted(values, reverse=scale is SHUTTER)
    assert len({step.code for step in scale.steps}) == len(scale.steps)


def test_the_list_of_the_body_decides_between_half_and_third_stops() -> None:
    assert SHUTTER.code("1/10") == SHUTTER.code(0.1, [0x50, 0x53, 0x55]) == 0x53
    assert SHUTTER.code("1/10", [0x50, 0x54, 0x58]) == 0x54
    assert APERTURE.code(3.5, APERTURES_60D) == 0x25


@pytest.mark.parametrize("wanted", [0.0167, 1 / 60, "1/60", " 1/60 s", "0.01667"])
def test_rounded_values_are_the_nominal_ones(wanted: float | str) -> None:
    assert SHUTTER.code(wanted) == 0x68


def test_apertures_as_people_write_them() -> None:
    assert APERTURE.code("f/8", APERTURES_60D) == APERTURE.code("F/8.0") == APERTURE.code(8) == 0x38


def test_what_is_between_is_not_guessed() -> None:
    with pytest.raises(InputError, match=r"^aperture 7\.5 is not offered; near it: 6\.3, 7\.1, 8, 9$"):
        APERTURE.code(7.5, APERTURES_60D)
    with pytest.raises(InputError, match=r"aperture 2\.8 is not offered; near it: 3\.5, 4, 4\.5, 5"):
        APERTURE.code(2.8, APERTURES_60D)
    with pytest.raises(InputError, match="the list is empty"):
        SHUTTER.code("1/60", [])


@pytest.mark.parametrize("wanted", ["", "fast", "1/0", "-1", 0, -1.0, math.nan, math.inf, "nan", "inf", "1/2/3"])
def test_what_is_no_value(wanted: float | str) -> None:
    with pytest.raises(InputError, match="is not offered"):
        SHUTTER.code(wanted)


def test_bulb_and_auto_are_no_values() -> None:
    assert SHUTTER.code("bulb", [0x0C, 0x10]) == 0x0C
    assert ISO.code("Auto") == 0
    assert SHUTTER.label(0x0C) == "bulb"
    with pytest.raises(ProtocolError, match="the camera reports shutter time bulb"):
        SHUTTER.value(0x0C)
    with pytest.raises(ProtocolError, match="turn its mode dial to M"):
        APERTURE.value(0)
    with pytest.raises(InputError, match="is not offered"):
        SHUTTER.code("bulb", [0x10])


def test_a_code_in_no_table_has_a_label_and_its_law() -> None:
    assert SHUTTER.label(0xA9) == "code 0xa9"
    with pytest.raises(ProtocolError, match="code 0xa9"):
        SHUTTER.value(0xA9)
    assert SHUTTER.exact(0x60) == 2.0**-5
    assert APERTURE.exact(0x28) == 4
    assert ISO.exact(0x58) == 400
    for code in (-1, 0x100, 0xFFFFFFFF, 0):
        with pytest.raises(ProtocolError, match="has no value"):
            APERTURE.exact(code)


def test_lists_read_well() -> None:
    assert APERTURE.labels((0x25, 0x28, 0xF1)) == "3.5, 4, code 0xf1"
    assert APERTURE.labels(()) == "nothing"
