"""What a seed decides stays what it is: who makes a data set again, with a later version, gets the same.

The numbers were written down once. Whoever changes one changes data sets.
"""

from __future__ import annotations

import numpy as np
import pytest

from generator import philox
from generator.dataset.plan import exact_parts
from generator.dataset.shards import split_of
from generator.lights.choices import DrawnLights
from generator.lights.distributions import Gaussian, Uniform
from generator.lights.gamut import Gamut, rb_of, rgb_of
from generator.lights.lighting import RandomLights
from generator.masks.making import RandomStreams, parse_masks
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import random_places
from generator.rendering.black_points import parse_black_point
from generator.training.crops import Crops
from generator.training.gallery import gallery_of
from generator.variation.variation import parse_exposure
from tests.generator.conftest import MakeLut

SEED = 2**40 + 9

DRAWN = (
    (Uniform(), [[0.352596, 0.331543], [0.389473, 0.277498], [0.325066, 0.217919], [0.448931, 0.244946]]),
    (
        Gaussian(0.3, 0.3, 0.03, 0.02, 0.5),
        [[0.298815, 0.277338], [0.319319, 0.277551], [0.299347, 0.300883], [0.258052, 0.291236]],
    ),
)
"""r and b of two lights of each of two pictures."""

FACTORS = {
    "stops:low=-2,high=1": [1.133351, 0.5468784],
    "normal:mean=-1,sd=.5": [0.6158962, 0.4484456],
    "level:share=.01,low=.2,high=.8": [1.826102, 1.123421],
}

MASKS = {
    "half-plane": "0 0 0 0  0 0 0 1  0 0 1 1",
    "soft-edge": ".0 .0 .0 .1574  .0 .0012 .2401 .6725  .022 .3329 .7648 .9992",
    "spots": ".0651 0 .471 .4713  1 0 .5124 .7262  .0818 1 0 0",
    "spots:count=2,softness=.1": "0 0 .5 .5932  1 0 .5 1  0 0 0 0",
    "smooth": ".7678 .0075 .0006 .0022  .9904 .5746 .0198 .1646  .7911 .7152 .4571 .299",
    "smooth:scale=.2,contrast=5": ".5311 .3099 .9136 .5343  .1079 .0011 .9093 .0068  .3254 .8201 .2215 .3655",
    "window": ".5 .7441 1 0  0 0 1 0  0 .7475 0 0",
    "window:columns=3,rows=1": ".5 .7441 1 0  0 0 1 0  0 .5943 0 0",
}
"""Shares of the third light, row by row."""


def test_lights() -> None:
    random = RandomLights(3, 10, SEED)
    assert [[lighting.mixtures[0].label for lighting in random.lightings_of(at)] for at in (0, 1, 70000)] == [
        ["9", "6", "7"],
        ["7", "9", "6"],
        ["4", "0", "8"],
    ]
    corners = rgb_of([[0.2, 0.2], [0.5, 0.2], [0.2, 0.5]])
    for distribution, wanted in DRAWN:
        choice = DrawnLights(Gamut(corners), distribution, 2, SEED)
        mixtures = [lighting.mixtures[0] for at in (0, 70000) for lighting in choice.lightings_of(at)]
        found = [rb_of(np.asarray(one.weights) @ corners[list(one.lights)]) for one in mixtures]
        np.testing.assert_allclose(found, wanted, atol=2e-6)


def test_parts_and_places() -> None:
    scenes = random_scenes(9, 4, 4, SEED)
    assert "".join(part[1] for part in exact_parts(scenes, (0.4, 0.3, 0.3), SEED)) == "raeeraaer"
    parts = [split_of((0.4, 0.3, 0.3), SEED, None, scene.name) for scene in scenes]
    assert "".join(str(part)[1] for part in parts) == "aeaearree"
    assert random_places((500, 300), (64, 48), 3, SEED, "a.png") == [(169, 7), (29, 70), (26, 142)]
    assert scenes[1].read().picture[:2, 0].ravel().tolist() == [207, 151, 146, 244, 66, 91]


def test_exposure_and_black() -> None:
    for text, wanted in FACTORS.items():
        found = [parse_exposure(text).factor(SEED, number, 0.3) for number in (0, 70000)]
        assert found == pytest.approx(wanted, rel=1e-5)
    found = [parse_black_point("random").share(SEED, number) for number in (0, 70000)]
    assert found == pytest.approx([0.055123, 0.288613], abs=1e-5)


@pytest.mark.parametrize("text", MASKS)
def test_masks(text: str) -> None:
    """Of the third light in the second image, at twelve places of a picture of 48 x 36 px."""
    found = parse_masks(text, 3, SEED).maker(1).weights(36, 48, 3)[6::12, 6::12, 2]
    np.testing.assert_allclose(found, np.array(MASKS[text].split(), float).reshape(3, 4), atol=2e-4)


def test_streams_are_of_the_words() -> None:
    words = philox.words(SEED, np.arange(5), 2, 7, philox.MASKS)[0]
    np.testing.assert_allclose(RandomStreams(SEED, 7).uniform(2, 5), (words + 0.5) / 2**32, rtol=1e-15)


def test_training_items(make_lut: MakeLut) -> None:
    gallery = gallery_of([np.zeros((9, 9, 3), np.uint8)] * 5)
    crops = Crops(make_lut(), gallery, (8, 8), length=6, seed=SEED, epoch=1, black_point="random", rendering="codes")
    batch = crops.batch(np.arange(6))
    assert (batch.lights.tolist(), batch.pictures.tolist()) == ([3, 3, 1, 3, 1, 3], [3, 0, 2, 3, 3, 0])
    wanted = [0.908903, 0.760228, 0.113894, 0.315437, 0.61138, 0.244231]
    np.testing.assert_allclose(batch.black_taken, wanted, atol=1e-5)
