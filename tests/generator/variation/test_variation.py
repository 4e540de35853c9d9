"""Exposures, gradients and noise: parsing, distributions, and reproducible images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foundation.errors import InputError
from generator import philox
from generator.masks.making import parse_masks, parse_shape
from generator.variation.exposing import add_noise, brightness_reached, expose
from generator.variation.iso_speed import parse_iso
from generator.variation.sensor_noise import SensorNoise, normal_deviates
from generator.variation.variation import (
    AutomaticExposure,
    DrawnExposure,
    ExposureChoice,
    Variation,
    parse_exposure,
    parse_gradient,
)
from tests.generator.said import said
from tests.pinned import Pinned


def drawn_stops(text: str, count: int = 4000) -> list[float]:
    exposure = parse_exposure(text)
    return [float(np.log2(exposure.factor(5, number, 0.5))) for number in range(count)]


@pytest.mark.slow
def test_draws_uniformly_in_stops() -> None:
    drawn = np.sort(drawn_stops("stops:low=-2,high=1"))
    # Kolmogorov-Smirnov: the largest distance of 4000 uniform numbers exceeds 0.031 once in a thousand.
    assert np.abs((drawn + 2) / 3 - np.arange(4000) / 4000).max() < 0.031


@pytest.mark.slow
def test_draws_normally_in_stops() -> None:
    drawn = drawn_stops("normal:mean=-1,sd=.5")
    assert np.mean(drawn) == pytest.approx(-1, abs=0.03)
    assert np.std(drawn) == pytest.approx(0.5, abs=0.02)
    assert -2.5 <= min(drawn) < -2
    assert 0 < max(drawn) <= 0.5


@pytest.mark.slow
def test_draws_from_quantiles() -> None:
    drawn = [np.log2(DrawnExposure((-3.0, -1.0, 0.0)).factor(1, number, 0.0)) for number in range(2000)]
    assert np.mean(np.array(drawn) < -1) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.array(drawn) > -0.5) == pytest.approx(0.25, abs=0.05)


def test_fixed_and_automatic_exposure() -> None:
    assert parse_exposure(".5").factor(0, 0, 0.1) == pytest.approx(0.5)
    assert parse_exposure("clip:share=.01").factor(0, 3, 0.25) == 4
    assert parse_exposure("clip:share=.01,most=3").factor(0, 3, 0.25) == 3
    assert parse_exposure("clip:share=.01").factor(0, 3, 0.0) == 8
    levels = [parse_exposure("level:share=.01,low=.2,high=.8").factor(2, number, 0.1) / 10 for number in range(500)]
    assert 0.2 <= min(levels) < 0.21
    assert 0.78 < max(levels) <= 0.8
    assert np.median(levels) == pytest.approx(0.4, rel=0.1)
    assert len({round(level, 9) for level in levels}) == 500


def test_refuses_falling_levels() -> None:
    with pytest.raises(InputError):
        parse_exposure("level:share=.1,low=.9,high=.5")
    with pytest.raises(InputError):
        AutomaticExposure(0.1, (0.5, 0.2))


def test_far_end_is_within_requested_stops() -> None:
    gradient = parse_gradient("soft-edge:width=.8,stops=2,least=1,colour=.1")
    ends = np.array([gradient.of_image(7, number).end for number in range(400)])
    assert ends.max() <= 0.5
    # The brightest channel of the far end is 1 to 2 stops darker.
    level = np.log2(ends.max(axis=1))
    assert -2 <= level.min() < -1.97
    assert -1.03 < level.max() <= -1
    tint = np.log(ends[:, [0, 2]] / ends[:, 1:2])
    assert 0.095 < np.abs(tint).max() <= 0.1
    assert abs(np.corrcoef(tint.T)[0, 1]) < 0.2
    plain = parse_gradient("smooth").of_image(7, 1).end
    assert plain[0] == plain[1] == plain[2]


def test_far_end_follows_random_words() -> None:
    gradient = parse_gradient("smooth:stops=3,least=.5,colour=.2")
    for number in (0, 7):
        level, red, blue = ((int(word) + 0.5) / 2**32 for word in philox.words(9, 0, 64, number, philox.GRADIENTS)[:3])
        tint = np.exp(0.2 * (2 * np.array([red, 0.5, blue]) - 1))
        expected = 2 ** -(0.5 + 2.5 * level) * tint / tint.max()
        assert gradient.of_image(9, number).end == pytest.approx(expected, rel=1e-13)


def test_gradients_differ_from_masks_of_the_same_seed() -> None:
    gradient = parse_gradient("smooth").of_image(7, 1)
    weights = gradient.weights(40, 60)
    masks = parse_masks("smooth", 2, 7).maker(1).weights(40, 60, 2)
    assert np.abs(np.corrcoef(weights[..., 1].ravel(), masks[..., 1].ravel())[0, 1]) < 0.9
    assert np.ptp(weights[..., 1]) > 0.2
    np.testing.assert_allclose(weights.sum(axis=2), 1, atol=1e-6)


def test_refuses_folder_of_masks_as_gradient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_accepts_numbers_within_bounds(
    parse: Callable[[str], object], kind: str, others: str, bounds: dict[str, tuple[float, float]]
) -> None:
    for name, ends in bounds.items():
        for end, outwards in zip(ends, (-0.005, 0.005), strict=True):
            parse(f"{kind}:{others}{name}={end}")
            with pytest.raises(InputError, match=rf"from {ends[0]:g} to {ends[1]:g}"):
                parse(f"{kind}:{others}{name}={end + outwards}")


NOISE = SensorNoise(read=(6.0, 0.0, 3.5), shot=(0.5, 0.25, 0.75))

EXPOSURES = (
    "2",
    ".25",
    "64",
    "0.000244140625",
    "65",
    ".0002",
    "nan",
    "stops:low=-2,high=1",
    "stops:low=1,high=1",
    "stops:low=1,high=0",
    "stops:low=-2",
    "normal:mean=-1,sd=.5",
    "normal:mean=0,sd=0",
    "normal:mean=1",
    "clip:share=.01",
    "clip:share=0",
    "clip:share=.9,most=64",
    "clip",
    "level:share=.01,low=.3,high=.9",
    "level:share=.01,low=.5",
    "level:share=0,low=1,high=1,most=2",
    "level:share=.1,high=1",
    "bright",
)

GRADIENTS = (
    "smooth",
    "soft-edge:width=.8,stops=2",
    "half-plane:angle=30,least=2",
    "spots:stops=1.5,least=.5,colour=.3",
    "window:columns=2,softness=.1,colour=0",
    "smooth:stops=1,least=2",
    "none",
    "smooth:stops=0,colour=.2",
)

SPEEDS = (
    "1600/100",
    "1600",
    "100/100",
    "99/100",
    "1600/100:read=2.8",
    "800.5 / 200",
    "x",
    "1600/0",
    "400:read=0",
    "400/200",
)


@pytest.mark.slow
def test_texts_of_variations(pinned: Pinned) -> None:
    pins: dict[str, Any] = {}
    choices: list[ExposureChoice] = [
        DrawnExposure((-2.0, -1.0, 1.5, 1.5)),
        AutomaticExposure(0.5, (0.1, 0.2, 0.9), 3.0),
    ]
    for text in EXPOSURES:
        choice = said(parse_exposure, text)
        if isinstance(choice, dict):
            pins[text] = choice
        else:
            choices.append(choice)
    for number, choice in enumerate(choices):
        factors = [choice.factor(2**33, image, light) for image in (0, 1, 2, 70000) for light in (0.0, 0.2, 1.3)]
        pins[f"exposure {number}"] = [choice.metered_share, choice.describe(), factors]
    for text in GRADIENTS:
        gradient = said(parse_gradient, text)
        pins[text] = gradient if isinstance(gradient, dict) else [
            gradient.describe(),
            [[falloff.end, falloff.weights(5, 8)] for falloff in (gradient.of_image(3, number) for number in range(3))],
        ]  # fmt: skip
    for text in SPEEDS:
        for base in (None, 200.0):
            speed = said(parse_iso, text, base)
            pins[f"{text} of {base}"] = speed if isinstance(speed, dict) else [
                speed.describe(), speed.ratio, NOISE.at(speed.ratio, speed.sensor_electrons)
            ]  # fmt: skip
    pins["deviates"] = [normal_deviates(), normal_deviates()[[0, 1, 8191, 8192, -1]]]
    pinned("texts of variations", pins)


@pytest.mark.slow
def test_images_exposed_anew(pinned: Pinned) -> None:
    rng = np.random.default_rng(12)
    image = rng.poisson(rng.exponential(600, (9, 13, 3))).astype(np.uint16)
    image[0, 0], image[0, 1] = (0, 0, 0), (4600, 4599, 1)
    weights = np.stack([np.zeros((9, 13)), np.linspace(0, 1, 117).reshape(9, 13)], axis=-1).astype(np.float32)
    end = (0.25, 1.0, 0.5)
    pins: dict[str, Any] = {}
    for factor in (0.1, 1.0, 3.0):
        for ratio in (1.0, 2.0):
            for falloff in (None, weights):
                out = np.empty_like(image)
                share = expose(
                    image, factor, NOISE, target_noise=NOISE.at(ratio), iso_ratio=ratio, weights=falloff,
                    far_end=(1.0, 1.0, 1.0) if falloff is None else end, white_level=4600, seed=5, number=3,
                    first_row=2, out=out,
                )  # fmt: skip
                pins[f"{factor} {ratio} {falloff is not None}"] = [share, out.max(), out.tobytes()]
    shares = (0.0, 0.004, 0.0043, 0.01, 0.5, 1.0)
    pins["reached"] = [[brightness_reached(image, share, map_, end) for share in shares] for map_ in (None, weights)]
    for target, ratio, below in ((None, 1.0, False), (NOISE.at(4.0), 4.0, True), (NOISE.at(2.0), 2.0, False)):
        items = rng.uniform(0, 1, (4, 3, 3, 5)).astype(np.float32) ** 4
        items[:, :, 0] = 0
        gains, seeds = np.array([0.25, 1.0, 2.0, 3.0]), np.array([1, 2, 2**63, 2**64 - 1], np.uint64)
        add_noise(items, gains, NOISE, seeds, white_level=900, target_noise=target, iso_ratio=ratio, below_black=below)
        pins[f"items {ratio}"] = list(items)
    for exposure in (
        None,
        parse_exposure(".5"),
        parse_exposure("clip:share=.05"),
        parse_exposure("level:share=.1,low=.5"),
    ):
        for gradient in (None, parse_gradient("smooth:colour=.3")):
            for iso in (None, parse_iso("800/200")):
                if exposure or gradient or iso:
                    varied_image = image.copy()
                    varied = Variation(exposure, gradient, iso, noise=NOISE).apply(varied_image, 4600, 7, 2)
                    name = f"varied {len(pins)}"
                    pins[name] = [varied.details, varied.end, varied.intensity(), varied_image.tobytes()]
    pinned("images exposed anew", pins)
