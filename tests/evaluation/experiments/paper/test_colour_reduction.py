"""Colour reduction: the codes after reduction, and estimates on the reduced images."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.experiments.paper.colour_reduction import (
    clear_bits,
    paper_methods,
    reduce_colours,
    remove_bits,
)
from evaluation.experiments.running import evaluate
from generator.files import fit_flash
from tests.evaluation.made_scenes import Made

pytestmark = pytest.mark.slow


def photo(seed: int, side: int = 40) -> npt.NDArray[np.float64]:
    """Return smooth colours under an illuminant, with the brightness range of a photograph."""
    rng = np.random.default_rng(seed)
    grid = np.linspace(0, 3, side)
    waves = [np.sin(np.add.outer(a * grid, b * grid)) for a, b in rng.uniform(-2, 2, (3, 2))]
    return np.exp(np.stack(waves, axis=-1) * rng.uniform(0.5, 2)) * [0.4, 1.0, 0.6]


@given(code=st.integers(0, 255), bits=st.integers(0, 8))
def test_cleared_codes_are_next_lower_step(code: int, bits: int) -> None:
    (cleared,) = clear_bits(np.array([code], np.uint8), bits)
    assert cleared == code // 2**bits * 2**bits


@given(seed=st.integers(0, 2**32), scale=st.floats(1e-3, 1e5))
def test_operator_is_inverted_within_rounding(seed: int, scale: float) -> None:
    image = photo(seed, 12)
    image /= image.max()
    operator = fit_flash(image)
    np.testing.assert_allclose(operator.invert(operator.apply(image)), image, rtol=1e-9)
    # The unit does not matter: images are taken relative to their largest value.
    for ours, scaled in zip(reduce_colours(image, (0, 3)), reduce_colours(image * scale, (0, 3)), strict=True):
        np.testing.assert_allclose(ours, scaled, atol=0.02)
        assert (np.abs(ours - scaled) > 1e-6).mean() < 0.01


@given(seed=st.integers(0, 2**32))
def test_zero_bits_change_only_quantisation(seed: int) -> None:
    image = photo(seed, 12)
    image /= image.max()
    operator = fit_flash(image)
    codes = operator.apply(image)
    (restored,) = reduce_colours(image, 0)
    # Half a code away in every channel at most: between what the codes just below and above stand for.
    unchanged = operator.apply(restored.astype(np.float64))
    assert np.abs(unchanged - codes).max() <= 0.51


def test_masked_pixel_does_not_influence_operator() -> None:
    image, mask = photo(2), np.zeros((40, 40), np.bool_)
    mask[:5] = True
    dark, bright = image.copy(), image.copy()
    dark[mask], bright[mask] = 0, 1e6
    for reduced, masked in zip(reduce_colours(dark, (0, 4), mask), reduce_colours(bright, (0, 4), mask), strict=True):
        np.testing.assert_array_equal(reduced[~mask], masked[~mask])
    (without,) = reduce_colours(dark, 4)
    (with_mask,) = reduce_colours(dark, 4, mask)
    assert np.abs(without[~mask] - with_mask[~mask]).max() > 1e-3


def test_unchanged_images_give_results_of_evaluate() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[:, :8] = True
    light = np.array([0.4, 1.0, 0.6])
    scenes = [Made("photo", light, photo(seed), 3.0, mask if seed % 2 else None) for seed in range(4)]
    assert any((scene.image >= 3.0).any() for scene in scenes)
    methods = paper_methods(sigma=2)
    bits_result = remove_bits(scenes, methods, (0, 3), workers=2)
    for ours, usual in zip(bits_result.raw, evaluate(scenes, methods), strict=True):
        np.testing.assert_array_equal(ours.estimates, usual.estimates)
        for metric in ("recovery", "reproduction"):
            np.testing.assert_array_equal(ours.errors[metric], usual.errors[metric])
    # Rounded to codes the images are nearly the same, with bits at zero they are not.
    for raw, exact, coarse in zip(bits_result.raw, bits_result.reduced[0], bits_result.reduced[3], strict=True):
        near = np.abs(exact.errors["recovery"] - raw.errors["recovery"]).max()
        assert near < 0.15
        assert np.abs(coarse.errors["recovery"] - raw.errors["recovery"]).max() > near
