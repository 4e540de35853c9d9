"""Choices of illuminants for pictures."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from foundation.errors import InputError
from generator.lights.choices import (
    SimultaneousLights,
    light_notes,
    matched_lights,
    nearest_lights,
    parse_light,
    parse_lights,
)
from generator.lights.gamut import TOLERANCE_DEG, Gamut, rgb_of
from generator.lights.lighting import LightChoice, Lighting, Mixture, RandomLights, single_mixture
from generator.masks.making import parse_masks
from tests.generator.conftest import MakeLut


def light_numbers(lightings: tuple[Lighting, ...]) -> tuple[int, ...]:
    """Return the numbers of lightings with one illuminant each."""
    assert all(len(lighting.mixtures) == 1 and lighting.mixtures[0].weights == (1.0,) for lighting in lightings)
    return tuple(lighting.mixtures[0].lights[0] for lighting in lightings)


def test_nearest_light_has_smallest_angle(make_lut: MakeLut) -> None:
    lut = make_lut(lights=4)
    targets = lut.white[[2, 0, 3]] * np.array([[1e-4], [7.0], [1.0]]) + [[0, 0, 1e-3]] * 3
    choice = nearest_lights(lut, targets, "truths.csv")
    assert max(match.angle for match in choice.matches) < 0.2
    assert [light_numbers(choice.lightings_of(position)) for position in range(5)] == [(2,), (0,), (3,), (2,), (0,)]
    assert choice.describe() == {"choice": "nearest", "file": "truths.csv", "each": 1, "lights": ["2", "0", "3"]}
    pairs = nearest_lights(lut, targets, lights_each=2)
    assert [light_numbers(pairs.lightings_of(position)) for position in range(3)] == [(2, 0), (3, 2), (0, 3)]


def test_parses_light_names(make_lut: MakeLut) -> None:
    lut = make_lut(lights=3)
    illuminations = [
        replace(light, name=name) for light, name in zip(lut.illuminations, ("A", "FL2", "D65"), strict=True)
    ]
    lut = replace(lut, illuminations=tuple(illuminations))
    assert parse_light(" FL2 ", lut) == single_mixture(1)
    assert parse_light("2", lut) == single_mixture(2)
    with pytest.raises(InputError, match=r"'fl2'.*'FL2'\?"):
        parse_light("fl2", lut)
    with pytest.raises(InputError, match="name: A, FL2, D65"):
        parse_light("xyzzy", lut)


def test_simultaneous_lights_share_an_image() -> None:
    masks = parse_masks("spots", 2, seed=9)
    inner = RandomLights(4, 10, seed=1)
    choice = SimultaneousLights(inner, 2, masks)
    assert isinstance(choice, LightChoice)
    assert choice.lights_each == 2
    lightings = choice.lightings_of(6)
    assert [mixture.lights[0] for lighting in lightings for mixture in lighting.mixtures] == list(
        light_numbers(inner.lightings_of(6))
    )
    assert [lighting.masks for lighting in lightings] == [masks.maker(12), masks.maker(13)]
    assert pickle.loads(pickle.dumps(choice)).lightings_of(6) == lightings
    assert choice.describe()["lights"] == inner.describe()


GAMUT = Gamut(rgb_of([[0.5, 0.2], [0.3, 0.15], [0.2, 0.45]]))
INSIDE = rgb_of([0.33, 0.25]).tolist()


def outside_gamut(degrees: float) -> list[float]:
    """Return an illuminant at this angle from the first corner of `GAMUT`, outside the gamut."""
    corner, away = GAMUT.directions[0], np.array([1.0, 0.0, 0.0])
    away = away - (away @ corner) * corner
    angle = np.radians(degrees)
    return (np.cos(angle) * corner + np.sin(angle) * away / np.linalg.norm(away)).tolist()


def test_replaces_ground_truths_outside_gamut_by_nearest() -> None:
    choice = matched_lights(GAMUT, {1: INSIDE, 2: outside_gamut(2.5)}, "gt.csv")
    assert choice.matches[0].angle < TOLERANCE_DEG
    assert choice.matches[1].angle == pytest.approx(2.5)
    (note,) = light_notes(choice)
    assert note.startswith("1 of the 2 ground truths of gt.csv are outside")
    assert "up to 2.50 degrees" in note
    assert choice.describe()["outside"] == {"count": 1, "largest_deg": 2.5}
    together = SimultaneousLights(
        matched_lights(GAMUT, {1: outside_gamut(2.5)}, "gt.csv", 2), 2, parse_masks("spots", 2, 0)
    )
    assert len(light_notes(together)) == 1
    assert light_notes(matched_lights(GAMUT, {1: INSIDE})) == light_notes(RandomLights(1, 3, 0)) == ()


def test_refuses_ground_truths_far_outside_gamut() -> None:
    several = dict.fromkeys(range(2, 12), INSIDE)
    assert matched_lights(GAMUT, {1: outside_gamut(9.9), **several}).outside == 1
    assert matched_lights(GAMUT, {1: outside_gamut(3.1), 2: INSIDE, 3: INSIDE, 4: outside_gamut(2.9)}).outside == 2
    with pytest.raises(InputError, match=r"^1 of the 11 .* of gt\.csv .* 10\.10 degrees \(first in line 9\),"):
        matched_lights(GAMUT, {**several, 9: outside_gamut(10.1), 12: INSIDE}, "gt.csv")
    with pytest.raises(InputError, match=r"^2 of the 4 .* 3\.20 degrees \(first in line 2\), .*order R, G, B.*camera"):
        matched_lights(GAMUT, {1: INSIDE, 2: outside_gamut(3.1), 3: INSIDE, 4: outside_gamut(3.2)})


def test_parses_lists_and_single_lights(make_lut: MakeLut) -> None:
    lut = make_lut()
    assert parse_lights(["0,2-3", "1"], lut).lights == (0, 2, 3, 1)
    assert parse_lights(["all", "0:.5+3:.5"], lut).lights == (0, 1, 2, 3, Mixture((0, 3), (0.5, 0.5)))
    with pytest.raises(InputError, match="5600K"):
        parse_lights(["5600"], lut)
    with pytest.raises(InputError, match="no illuminant 4, expected 0 to 3"):
        parse_lights(["2-4"], lut)
