"""Tuning without ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.green_stability import family, tune
from evaluation.methods.naming import FAMILIES
from evaluation.scene import Image
from foundation.errors import InputError


@dataclass(frozen=True, eq=False)
class Tiles:
    """Coloured tiles under a light that differs in red and blue only; dark tiles are greenish by `cast`."""

    number: int
    cast: float
    name: str = "tiles"
    saturation: float | None = None

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        red = 0.15 + 0.03 * self.number
        return np.array([red, 0.4, 0.6 - red])

    def read(self) -> tuple[Image, None]:
        random = np.random.default_rng(self.number)
        tiles = random.uniform(0.2, 0.5, (12, 12, 3))
        tiles[..., 1] *= random.uniform(1, 1 + self.cast)
        tiles[:2] = 1
        return (tiles.repeat(6, axis=0).repeat(6, axis=1) * self.truth * 5000).astype(np.uint16), None


SCENES = [Tiles(number, 2.0) for number in range(8)]


def test_the_norm_whose_estimates_stay_green_is_chosen() -> None:
    # The brightest tiles are grey: the larger the norm, the less the cast of the others counts.
    tuned = tune(family("shades-of-gray"), SCENES)
    assert tuned.best.name == "Shades-of-Gray (p=15)"
    assert list(tuned.spreads) == sorted(tuned.spreads, reverse=True)
    assert len(tuned.lights) == 8


def test_images_without_a_light_do_not_count() -> None:
    small = [GrayEdge("", 1, 1, sigma) for sigma in (1.0, 40.0)]
    with pytest.raises(InputError, match="only 0 of 8 images give a light"):
        tune(small, SCENES)


def test_too_little_to_tune_with_is_refused() -> None:
    with pytest.raises(InputError, match="1 sets of parameters on 8 images"):
        tune(family("gray-edge-1")[:1], SCENES)
    with pytest.raises(InputError, match="30 sets of parameters on 1 images"):
        tune(family("gray-edge-1"), SCENES[:1])
    with pytest.raises(InputError, match="'gray-edge'"):
        family("gray-edge")


@pytest.mark.parametrize("name", FAMILIES)
def test_members_of_a_family_are_methods_of_the_framework(name: str) -> None:
    members = family(name)
    order, scales = {"gray-edge-1": 1, "gray-edge-2": 2}.get(name, 0), (1, 2, 4, 6, 9)
    grid = [(p, 0) for p in range(1, 16)] if name == "shades-of-gray" else product((1, 2, 4, 6, 9, 13), scales)
    expected = {(order, p, sigma) for p, sigma in grid}
    assert {(one.order, one.p, one.sigma) for one in members if isinstance(one, GrayEdge)} == expected
    assert len({member.name for member in members}) == len(members) == len(expected)
