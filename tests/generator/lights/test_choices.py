"""Which lights fall on which picture."""

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
from generator.lights.lighting import LightChoice, Lighting, Mixture, RandomLights, plain
from generator.masks.making import parse_masks
from tests.generator.conftest import MakeLut


def numbers(lightings: tuple[Lighting, ...]) -> tuple[int, ...]:
    """Return the lights of lightings that are one light of the table each."""
    assert all(len(lighting.mixtures) == 1 and lighting.mixtures[0].weights == (1.0,) for lighting in lightings)
    return tuple(lighting.mixtures[0].lights[0] for lighting in lightings)


def test_nearest_is_by_angle(make_lut: MakeLut) -> None:
    lut = make_lut(lights=4)
    wanted = lut.white[[2, 0, 3]] * np.array([[1e-4], [7.0], [1.0]]) + [[0, 0, 1e-3]] * 3
    choice = nearest_lights(lut, wanted, "truths.csv")
    assert max(match.angle for match in choice.matches) < 0.2
    assert [numbers(choice.lightings_of(position)) for position in range(5)] == [(2,), (0,), (3,), (2,), (0,)]
    assert choice.describe() == {"choice": "nearest", "file": "truths.csv", "each": 1, "lights": ["2", "0", "3"]}
    both = nearest_lights(lut, wanted, each=2)
    assert [numbers(both.lightings_of(position)) for position in range(3)] == [(2, 0), (3, 2), (0, 3)]


def test_lights_of_a_table_may_have_names(make_lut: MakeLut) -> None:
    lut = make_lut(lights=3)
    named = [replace(light, name=name) for light, name in zip(lut.illuminations, ("A", "FL2", "D65"), strict=True)]
    lut = replace(lut, illuminations=tuple(named))
    assert parse_light(" FL2 ", lut) == plain(1)
    assert parse_light("2", lut) == plain(2)
    with pytest.raises(InputError, match=r"'fl2'.*'FL2'\?"):
        parse_light("fl2", lut)
    with pytest.raises(InputError, match="name: A, FL2, D65"):
        parse_light("xyzzy", lut)


def test_lights_together_share_an_image() -> None:
    masks = parse_masks("spots", 2, seed=9)
    inner = RandomLights(4, 10, seed=1)
    choice = SimultaneousLights(inner, 2, masks)
    assert isinstance(choice, LightChoice)
    assert choice.lights_each == 2
    lightings = choice.lightings_of(6)
    assert [mixture.lights[0] for lighting in lightings for mixture in lighting.mixtures] == list(
        numbers(inner.lightings_of(6))
    )
    assert [lighting.masks for lighting in lightings] == [masks.maker(12), masks.maker(13)]
    assert pickle.loads(pickle.dumps(choice)).lightings_of(6) == lightings
    assert choice.describe()["lights"] == inner.describe()


def test_lights_that_the_table_cannot_make_are_noted_and_the_nearest_taken() -> None:
    gamut = Gamut(rgb_of([[0.5, 0.1], [0.3, 0.2], [0.2, 0.45]]))
    inside, outside = rgb_of([[0.33, 0.25], [0.1, 0.1]])
    choice = matched_lights(gamut, np.array([inside, outside]), "gt.csv")
    assert choice.matches[0].angle < TOLERANCE_DEG < 5 < choice.matches[1].angle
    (note,) = light_notes(choice)
    assert note.startswith("1 of the 2 lights of gt.csv lie outside")
    assert f"up to {choice.matches[1].angle:.2f} degrees" in note
    together = SimultaneousLights(
        matched_lights(gamut, np.array([outside]), "gt.csv", 2), 2, parse_masks("spots", 2, 0)
    )
    assert len(light_notes(together)) == 1
    assert light_notes(matched_lights(gamut, np.array([inside]))) == light_notes(RandomLights(1, 3, 0)) == ()


def test_lists_and_lights_are_told_apart(make_lut: MakeLut) -> None:
    lut = make_lut()
    assert parse_lights(["0,2-3", "1"], lut).lights == (0, 2, 3, 1)
    assert parse_lights(["all", "0:.5+3:.5"], lut).lights == (0, 1, 2, 3, Mixture((0, 3), (0.5, 0.5)))
    with pytest.raises(InputError, match="5600K"):
        parse_lights(["5600"], lut)
    with pytest.raises(InputError, match="lights 0 to 3"):
        parse_lights(["2-4"], lut)
