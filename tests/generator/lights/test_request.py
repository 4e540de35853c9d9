"""From options to a choice of lights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from foundation.errors import InputError
from generator.lights.choices import DrawnLights, ListedLights, RandomLights, SequentialLights, SimultaneousLights
from generator.lights.lighting import Mixture, plain
from generator.lights.request import LightRequest

if TYPE_CHECKING:
    from calibration.table.lut import Lut


@pytest.fixture
def truths(tmp_path: Path, make_lut: Callable[..., Lut]) -> Path:
    """Return a file of the ground truths of lights 2, 0 and 1 of the table."""
    path = tmp_path / "gt.txt"
    path.write_text("".join(f"{r} {g} {b}\n" for r, g, b in make_lut(name="other").white[[2, 0, 1]]))
    return path


def test_one_random_light_unless_said(make_lut: Callable[..., Lut]) -> None:
    assert LightRequest().choose(make_lut(), 3) == RandomLights(1, 4, 3)
    assert LightRequest(random=2).choose(make_lut(name="b"), 3) == RandomLights(2, 4, 3)


def test_listed_lights(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut()
    assert LightRequest(illuminations="0,2-3").choose(lut, 3) == ListedLights((0, 2, 3))
    assert LightRequest(light=("2", "0:0.5+1:0.5")).choose(lut, 3) == ListedLights(
        (plain(2), Mixture((0, 1), (0.5, 0.5)))
    )


def test_ground_truths_of_a_file(make_lut: Callable[..., Lut], truths: Path) -> None:
    lut = make_lut()
    for request in (LightRequest(nearest=truths), LightRequest(match=truths)):
        choice = request.choose(lut, 3)
        assert isinstance(choice, SequentialLights)
        assert [choice.lightings_of(at)[0].mixtures[0] for at in range(4)] == [plain(2), plain(0), plain(1), plain(2)]
    both = LightRequest(match=truths, lights_per_image=2, masks="window").choose(lut, 3)
    assert both.lights_each == 1
    assert [both.lightings_of(at)[0].mixtures for at in range(2)] == [(plain(2), plain(0)), (plain(1), plain(2))]


def test_a_distribution_with_several_lights_an_image(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut()
    # The table's lights lie on a line; one more direction gives them a gamut.
    lut.white[0] = [9000, 1000, 1000]
    request = LightRequest(distribution="uniform", random=3, lights_per_image=2, masks="spots:count=1")
    choice = request.choose(lut, 3)
    assert isinstance(choice, SimultaneousLights)
    assert choice.lights_each == 3
    assert isinstance(choice.choice, DrawnLights)
    lightings = choice.lightings_of(0)
    assert [len(lighting.mixtures) for lighting in lightings] == [2, 2, 2]
    weights = lightings[0].weights_of(20, 30)
    assert weights.shape == (20, 30, 2)
    assert not np.array_equal(weights, lightings[1].weights_of(20, 30))


def test_masks_mean_two_lights_and_two_lights_mean_masks(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut()
    for request in (LightRequest(masks="smooth"), LightRequest(lights_per_image=2)):
        choice = request.choose(lut, 1)
        assert isinstance(choice, SimultaneousLights)
        assert choice.together == 2
        assert choice.describe() == {
            "choice": "together",
            "together": 2,
            "masks": {"masks": "smooth", "scale": 0.5, "contrast": 2.0},
            "lights": {"choice": "random", "count": 2},
        }


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"illuminations": "0", "light": ("1",)}, "--illuminations and --light were both given; give one of them"),
        ({"random": 2, "nearest": Path("gt")}, "--nearest and --random were both given; give one"),
        ({"distribution": "uniform", "match": Path("gt")}, "--match and --distribution were both given"),
        ({"illuminations": "0-2", "lights_per_image": 2}, "3 lights for each picture cannot be shared out 2"),
        ({"lights_per_image": 0}, "0 lights an image were asked for"),
        ({"lights_per_image": 1, "masks": "spots"}, "--masks spots says where several lights fall, but each image has"),
        ({"light": ("r=.9,b=.05",)}, "outside what the table"),
        ({"masks": "stripes"}, "'stripes' is neither a folder of masks nor a kind"),
    ],
)
def test_what_does_not_go_together_is_named(
    make_lut: Callable[..., Lut], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        LightRequest(**options).choose(make_lut(), 0)


def test_the_nearest_that_is_possible(make_lut: Callable[..., Lut]) -> None:
    choice = LightRequest(light=("r=.9,b=.05",), outside="nearest").choose(make_lut(), 0)
    assert choice.lightings_of(0)[0].mixtures == (plain(3),)
