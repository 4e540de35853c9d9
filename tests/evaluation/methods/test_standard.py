"""Every method of the command against images whose answer is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods import standard_methods
from evaluation.methods.pixels import GREY
from evaluation.metrics import recovery_error

if TYPE_CHECKING:
    pass


LIGHT = np.array([0.5, 1.0, 0.7])


def grey_scene(seed: int = 0) -> npt.NDArray[np.float64]:
    """Return a grey noise image (64, 80, 3) under LIGHT: every method must find it."""
    grey = np.random.default_rng(seed).uniform(100, 3000, (64, 80, 1))
    return grey * LIGHT


@pytest.mark.parametrize("name", standard_methods())
def test_every_method_finds_the_light_on_grey_things(name: str) -> None:
    estimate = standard_methods()[name].estimate(grey_scene())
    assert recovery_error(estimate, LIGHT) < 1e-3
    assert np.linalg.norm(estimate) == pytest.approx(1)


@pytest.mark.parametrize("name", standard_methods())
def test_masked_and_saturated_pixels_do_not_matter(name: str) -> None:
    image = grey_scene()
    image[20:30, 30:50] = (9000, 100, 100)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[20:30, 30:50] = True
    method = standard_methods()[name]
    assert np.isfinite(method.estimate(image)).all()
    if name in ("white-patch", "gray-world", "shades-of-gray", "pca"):
        # The others look at neighbours of what is left out too, as their authors' program does.
        assert recovery_error(method.estimate(image, mask=mask), LIGHT) < 1e-3
        assert recovery_error(method.estimate(image, saturation=8000), LIGHT) < 1e-3
        assert recovery_error(method.estimate(image), LIGHT) > 1


@pytest.mark.parametrize("name", standard_methods())
def test_an_image_without_a_usable_pixel_is_grey(name: str) -> None:
    method = standard_methods()[name]
    assert method.estimate(np.full((40, 40, 3), 500, np.uint16), saturation=500) is GREY
    assert method.estimate(np.zeros((40, 40, 3), np.uint16)) is GREY
    assert method.estimate(np.ones((1, 1, 3)), mask=np.ones((1, 1), bool)) is GREY
    np.testing.assert_allclose(GREY, 3**-0.5)
