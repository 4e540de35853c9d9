"""Factors of exposure, drawn and automatic; gradients of light."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from foundation.errors import InputError
from generator import philox
from generator.masks.making import parse_masks, parse_shape
from generator.variation.variation import AutomaticExposure, DrawnExposure, parse_exposure, parse_gradient


def stops(text: str, count: int = 4000) -> list[float]:
    exposure = parse_exposure(text)
    return [float(np.log2(exposure.factor(5, number, 0.5))) for number in range(count)]


@pytest.mark.slow
def test_drawn_evenly_in_stops() -> None:
    drawn = np.sort(stops("stops:low=-2,high=1"))
    # Kolmogorov and Smirnov: the largest distance of 4000 even numbers exceeds .031 once in a thousand.
    assert np.abs((drawn + 2) / 3 - np.arange(4000) / 4000).max() < 0.031


@pytest.mark.slow
def test_drawn_normally_in_stops() -> None:
    drawn = stops("normal:mean=-1,sd=.5")
    assert np.mean(drawn) == pytest.approx(-1, abs=0.03)
    assert np.std(drawn) == pytest.approx(0.5, abs=0.02)
    assert -2.5 <= min(drawn) < -2
    assert 0 < max(drawn) <= 0.5


@pytest.mark.slow
def test_quantiles_of_another_data_set() -> None:
    drawn = [np.log2(DrawnExposure((-3.0, -1.0, 0.0)).factor(1, number, 0.0)) for number in range(2000)]
    assert np.mean(np.array(drawn) < -1) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.array(drawn) > -0.5) == pytest.approx(0.25, abs=0.05)


def test_a_factor_and_automatic_exposure() -> None:
    assert parse_exposure(".5").factor(0, 0, 0.1) == pytest.approx(0.5)
    assert parse_exposure("clip:share=.01").factor(0, 3, 0.25) == 4
    assert parse_exposure("clip:share=.01,most=3").factor(0, 3, 0.25) == 3
    assert parse_exposure("clip:share=.01").factor(0, 3, 0.0) == 8
    levels = [parse_exposure("level:share=.01,low=.2,high=.8").factor(2, number, 0.1) / 10 for number in range(500)]
    assert 0.2 <= min(levels) < 0.21
    assert 0.78 < max(levels) <= 0.8
    assert np.median(levels) == pytest.approx(0.4, rel=0.1)
    assert len({round(level, 9) for level in levels}) == 500


def test_levels_that_fall_are_refused() -> None:
    with pytest.raises(InputError):
        parse_exposure("level:share=.1,low=.9,high=.5")
    with pytest.raises(InputError):
        AutomaticExposure(0.1, (0.5, 0.2))


def test_light_falls_off_within_the_stops_asked_for() -> None:
    gradient = parse_gradient("soft-edge:width=.8,stops=2,least=1,colour=.1")
    ends = np.array([gradient.of_image(7, number).end for number in range(400)])
    assert ends.max() <= 0.5
    # The brightest channel of the end is between 1 and 2 stops below the light.
    level = np.log2(ends.max(axis=1))
    assert -2 <= level.min() < -1.97
    assert -1.03 < level.max() <= -1
    tint = np.log(ends[:, [0, 2]] / ends[:, 1:2])
    assert 0.095 < np.abs(tint).max() <= 0.1
    assert abs(np.corrcoef(tint.T)[0, 1]) < 0.2
    plain = parse_gradient("smooth").of_image(7, 1).end
    assert plain[0] == plain[1] == plain[2]


def test_the_far_end_is_what_the_words_of_the_image_say() -> None:
    """To the last digits: images made again are to be the same."""
    gradient = parse_gradient("smooth:stops=3,least=.5,colour=.2")
    for number in (0, 7):
        level, red, blue = ((int(word) + 0.5) / 2**32 for word in philox.words(9, 0, 64, number, philox.GRADIENTS)[:3])
        tint = np.exp(0.2 * (2 * np.array([red, 0.5, blue]) - 1))
        wanted = 2 ** -(0.5 + 2.5 * level) * tint / tint.max()
        assert gradient.of_image(9, number).end == pytest.approx(wanted, rel=1e-13)


def test_the_shape_is_not_that_of_masks_of_the_same_seed() -> None:
    gradient = parse_gradient("smooth").of_image(7, 1)
    weights = gradient.weights(40, 60)
    masks = parse_masks("smooth", 2, 7).maker(1).weights(40, 60, 2)
    assert np.abs(np.corrcoef(weights[..., 1].ravel(), masks[..., 1].ravel())[0, 1]) < 0.9
    assert np.ptp(weights[..., 1]) > 0.2
    np.testing.assert_allclose(weights.sum(axis=2), 1, atol=1e-6)


def test_a_folder_of_masks_is_no_gradient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "masks").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"'masks'.*half-plane"):
        parse_gradient("masks:stops=1")


@pytest.mark.parametrize(
    ("parse", "kind", "others", "bounds"),
    [
        (parse_gradient, "smooth", "", {"stops": (0, 6), "colour": (0, 1)}),
        (parse_gradient, "smooth", "stops=6,", {"least": (0, 6)}),
        (parse_exposure, "stops", "high=6,", {"low": (-12, 6)}),
        (parse_exposure, "stops", "low=-12,", {"high": (-12, 6)}),
        (parse_exposure, "normal", "sd=1,", {"mean": (-12, 6)}),
        (parse_exposure, "normal", "mean=0,", {"sd": (0, 6)}),
        (parse_exposure, "clip", "most=8,", {"share": (0, 0.9)}),
        (parse_exposure, "clip", "share=.1,", {"most": (0.01, 64)}),
        (parse_exposure, "level", "share=.1,", {"low": (0.001, 1)}),
        (parse_exposure, "level", "low=.5,", {"share": (0, 0.9)}),
        (parse_exposure, "level", "share=.1,low=.001,", {"high": (0.001, 1)}),
        (parse_shape, "half-plane", "", {"angle": (-360, 360), "width": (0, 1)}),
        (parse_shape, "soft-edge", "", {"angle": (-360, 360), "width": (0, 1)}),
        (parse_shape, "spots", "", {"count": (1, 20), "radius": (0.01, 1), "softness": (0, 2)}),
        (parse_shape, "smooth", "", {"scale": (0.02, 2), "contrast": (0, 100)}),
        (parse_shape, "window", "", {"columns": (1, 20), "rows": (1, 20), "softness": (0, 1)}),
    ],
)
def test_numbers_are_taken_from_bound_to_bound(
    parse: Callable[[str], object], kind: str, others: str, bounds: dict[str, tuple[float, float]]
) -> None:
    for name, ends in bounds.items():
        for end, outwards in zip(ends, (-0.005, 0.005), strict=True):
            parse(f"{kind}:{others}{name}={end}")
            with pytest.raises(InputError, match=rf"from {ends[0]:g} to {ends[1]:g}"):
                parse(f"{kind}:{others}{name}={end + outwards}")
