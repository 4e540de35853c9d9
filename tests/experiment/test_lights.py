"""The 707 illuminants against published black bodies and the sRGB standard, and their file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.cli import main
from drivers.presenter import Colour
from experiment.lights import (
    Illuminant,
    illuminants_to_csv,
    load_illuminants,
    parse_ccts,
    uniform_lights,
)
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError

HEADER = "index,kind,cct_k,red,green,blue\n"


def codes(lights: tuple[Illuminant, ...]) -> list[tuple[int, int, int]]:
    return [light.colour for light in lights]


def test_plan_has_666_uniform_illuminants_and_41_black_bodies(plan: tuple[Illuminant, ...]) -> None:
    assert len(plan) == 707
    assert [light.index for light in plan] == list(range(707))
    assert [light.kind for light in plan] == ["uniform"] * 666 + ["blackbody"] * 41
    assert [light.cct_k for light in plan[:666]] == [None] * 666
    assert [light.cct_k for light in plan[666:]] == list(range(2000, 10001, 200))
    assert len(set(codes(plan))) == 707
    assert all(max(code) == 255 for code in codes(plan))


def test_uniform_illuminants_are_on_the_grid(plan: tuple[Illuminant, ...]) -> None:
    uniform_codes = set(codes(plan[:666]))
    assert {(255, 0, 0), (0, 255, 0), (0, 0, 255)} <= uniform_codes
    linear = np.array(uniform_lights())
    np.testing.assert_allclose(linear.sum(axis=1), 1)
    assert linear.min() == 0
    np.testing.assert_allclose(35 * linear, np.rint(35 * linear), atol=1e-9)
    # The codes have the chromaticity of the grid point, except for rounding.
    light = decode_srgb(np.array(codes(plan[:666])) / 255)
    np.testing.assert_allclose(light / light.sum(axis=1, keepdims=True), linear, atol=0.002)


def test_parses_temperatures() -> None:
    assert parse_ccts("2000:3000:250") == (2000, 2250, 2500, 2750, 3000)
    assert parse_ccts("2000:2999:500") == (2000, 2500)
    assert parse_ccts("3000:2000:-500") == (3000, 2500, 2000)
    assert parse_ccts("6500:6500:1") == (6500,)
    assert parse_ccts("2856, 6504") == (2856, 6504)
    assert parse_ccts("") == ()
    assert parse_ccts("1000,100000") == (1000, 100000)
    assert len(parse_ccts("1000:10999:1")) == 10_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("10000:2000:200", "10000 to 2000 K .*200 K"),
        ("2000:10000:0", "steps of 0 K"),
        ("2000:10000:1e-6", "at most 10000 temperatures"),
        ("1:1e12:1", "1 K is given, expected 1000"),
        ("warm", "FIRST:LAST:STEP or"),
        ("999", "999 K is given"),
        ("100001", "100001 K is given"),
        ("1000:11000:1", "at most 10000 temperatures"),
    ],
)
def test_refuses_wrong_temperatures(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_ccts(text)


def test_refuses_a_plot_as_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["illuminations", str(tmp_path / "a.png"), "--grid", "1"]) == 2
    assert "a.png" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


ccts_k = st.none() | st.floats(1, 1e6)
colours = st.builds(Colour, st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))


@given(st.lists(st.tuples(ccts_k, colours), min_size=1, max_size=8))
def test_reads_any_illuminants_that_it_writes(
    tmp_path_factory: pytest.TempPathFactory, drawn: list[tuple[float | None, Colour]]
) -> None:
    illuminants = tuple(
        Illuminant(number, "uniform" if cct_k is None else "blackbody", cct_k, colour)
        for number, (cct_k, colour) in enumerate(drawn)
    )
    path = tmp_path_factory.mktemp("lights") / "illuminations.csv"
    path.write_text(illuminants_to_csv(illuminants))
    assert load_illuminants(path) == illuminants


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no illuminants, expected columns"),
        (HEADER, "has no illuminants, expected columns"),
        ("index,kind,red,green,blue\n0,uniform,1,2,3\n", "has no illuminants, expected columns"),
        (HEADER + "0,uniform,,1,2\n", "illuminant 0: blue is missing"),
        (HEADER + "0,uniform,,1.5,2,3\n", "illuminant 0: red is 1.5"),
        (HEADER + "0,uniform,,1,256,3\n", "illuminant 0: green is 256, expected a code from 0 to 255"),
        (HEADER + "0,sun,,1,2,3\n", "illuminant 0: kind is 'sun'"),
        (HEADER + "0,uniform,,1,2,3\n2,uniform,,1,2,3\n", "illuminant 1: index is 2, expected 1"),
        (HEADER + "0,blackbody,,1,2,3\n", "illuminant 0: cct_k is missing"),
        (HEADER + "0,blackbody,-5,1,2,3\n", "illuminant 0: cct_k is -5"),
        (HEADER + "0,blackbody,inf,1,2,3\n", "illuminant 0: cct_k is inf"),
        (HEADER + "0," + "u" * 200_000 + ",,1,2,3\n", "field larger than field limit"),
    ],
)
def test_refuses_bad_file(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "illuminations.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FormatError) as refused:
        load_illuminants(path)
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_refuses_missing_and_binary_files(tmp_path: Path) -> None:
    binary = tmp_path / "picture.csv"
    binary.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    for path in (tmp_path / "none.csv", tmp_path, binary):
        with pytest.raises(FormatError, match="acquire illuminations"):
            load_illuminants(path)
