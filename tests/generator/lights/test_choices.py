"""Which lights fall on which picture."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from foundation.errors import InputError
from generator.lights.choices import SimultaneousLights, nearest_lights, parse_light
from generator.lights.lighting import LightChoice, Lighting, RandomLights, plain
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
