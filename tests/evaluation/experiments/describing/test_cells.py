"""Cells are means over usable pixels with the light divided out, whatever the size, and however it is cut."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.describing.description import LEVELS, Cells, reduce_scene
from foundation.errors import FormatError
from tests.evaluation.experiments.describing.scenes import Made, MadeMixture

LIGHT = np.array([0.5, 1.0, 0.75])


def reduced(scene: Made, side: int = 64) -> Cells:
    return reduce_scene(scene, scene.image, scene.mask, side)


def by_loop(image: npt.NDArray[np.float64], usable: npt.NDArray[np.bool_], side: int) -> npt.NDArray[np.float64]:
    """Return cells the slow way."""
    height, width = usable.shape
    result = np.full((side, side, 3), np.nan)
    for row in range(side):
        for column in range(side):
            place = (
                slice(row * height // side, (row + 1) * height // side),
                slice(column * width // side, (column + 1) * width // side),
            )
            if usable[place].mean() >= 0.5:
                result[row, column] = image[place][usable[place]].mean(axis=0)
    return result


@pytest.mark.parametrize("band", [1, 700, 1 << 18])
def test_means_of_usable_pixels(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.experiments.describing.description._BAND_PIXELS", band)
    random = np.random.default_rng(1)
    image = random.uniform(0, 1000, (45, 71, 3)) * LIGHT
    mask = random.random((45, 71)) < 0.3
    mask[:9, :12] = True
    found = reduced(Made("a", 3 * LIGHT, image, 900.0, mask), 8)
    clipped = (image >= 900).any(axis=2) & ~mask
    expected = by_loop(image / LIGHT * LIGHT.mean(), ~mask & ~clipped, 8)
    assert np.isnan(expected[0, 0]).all()
    np.testing.assert_allclose(found.colours, expected, rtol=1e-12)
    assert (found.pixels, found.masked, found.clipped) == (45 * 71, mask.sum(), clipped.sum())
    counted = np.clip(image.max(axis=2)[~mask] / 900 * LEVELS, 0, LEVELS - 1).astype(int)
    np.testing.assert_array_equal(found.levels, np.bincount(counted, minlength=LEVELS))


def test_what_is_not_finite_is_not_used() -> None:
    image = np.ones((4, 4, 3)) * LIGHT
    image[0, 0, 1] = np.nan
    found = reduced(Made("a", LIGHT, image))
    assert np.isnan(found.colours[0, 0]).all()
    assert np.isfinite(found.colours).sum() == 45
    assert found.masked == 1
    assert not found.levels.size


def test_small_images_keep_their_pixels_and_side_zero_keeps_all() -> None:
    image = np.random.default_rng(2).uniform(1, 2, (100, 5, 3))
    assert reduced(Made("a", LIGHT, image)).colours.shape == (64, 5, 3)
    whole = reduced(Made("a", LIGHT, image), 0).colours
    np.testing.assert_allclose(whole, image / LIGHT * LIGHT.mean())


@pytest.mark.parametrize("band", [1, 1 << 18])
def test_each_pixel_of_a_mixture_is_divided_by_its_own_light(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.experiments.describing.description._BAND_PIXELS", band)
    lights = np.array([[0.6, 1.0, 0.3], [0.3, 1.0, 0.8]])
    image = np.repeat(lights, 40, axis=0) * np.full((50, 1, 1), 100.0)
    scene = MadeMixture("m", lights.mean(axis=0), image, lights=lights)
    colours = reduced(scene, 10).colours
    np.testing.assert_allclose(colours / colours[..., 1:2], 1, rtol=1e-6)
    # By the mean light, the halves would be orange and blue.
    wrong = reduced(Made("m", scene.truth, image), 10).colours
    assert np.ptp(wrong[..., 0] / wrong[..., 1]) > 0.5


@pytest.mark.parametrize("truth", [[0, 1, 1], [1, np.nan, 1], [-1, 1, 1]])
def test_a_light_that_cannot_be_divided_by_is_named(truth: list[float]) -> None:
    with pytest.raises(FormatError, match=r"the ground truth of dark\.png is"):
        reduced(Made("dark.png", np.array(truth, dtype=float), np.ones((4, 4, 3))))
