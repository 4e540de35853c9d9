"""Exposures, gradients, noise and speeds of known images, as they were before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

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

pytestmark = pytest.mark.slow

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


def test_texts_of_variations(pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    choices: list[ExposureChoice] = [
        DrawnExposure((-2.0, -1.0, 1.5, 1.5)),
        AutomaticExposure(0.5, (0.1, 0.2, 0.9), 3.0),
    ]
    for text in EXPOSURES:
        choice = said(parse_exposure, text)
        if isinstance(choice, dict):
            found[text] = choice
        else:
            choices.append(choice)
    for number, choice in enumerate(choices):
        factors = [choice.factor(2**33, image, light) for image in (0, 1, 2, 70000) for light in (0.0, 0.2, 1.3)]
        found[f"exposure {number}"] = [choice.seen, choice.describe(), factors]
    for text in GRADIENTS:
        gradient = said(parse_gradient, text)
        found[text] = gradient if isinstance(gradient, dict) else [
            gradient.describe(),
            [[made.end, made.weights(5, 8)] for made in (gradient.of_image(3, number) for number in range(3))],
        ]  # fmt: skip
    for text in SPEEDS:
        for base in (None, 200.0):
            speed = said(parse_iso, text, base)
            found[f"{text} of {base}"] = speed if isinstance(speed, dict) else [
                speed.describe(), speed.ratio, NOISE.at(speed.ratio, speed.sensor_electrons)
            ]  # fmt: skip
    found["deviates"] = [normal_deviates(), normal_deviates()[[0, 1, 8191, 8192, -1]]]
    pinned("texts of variations", found)


def test_images_exposed_anew(pinned: Pinned) -> None:
    rng = np.random.default_rng(12)
    image = rng.poisson(rng.exponential(600, (9, 13, 3))).astype(np.uint16)
    image[0, 0], image[0, 1] = (0, 0, 0), (4600, 4599, 1)
    weights = np.stack([np.zeros((9, 13)), np.linspace(0, 1, 117).reshape(9, 13)], axis=-1).astype(np.float32)
    end = (0.25, 1.0, 0.5)
    found: dict[str, Any] = {}
    for factor in (0.1, 1.0, 3.0):
        for ratio in (1.0, 2.0):
            for far in (None, weights):
                out = np.empty_like(image)
                share = expose(
                    image, factor, NOISE, wanted=NOISE.at(ratio), ratio=ratio, weights=far, end=end if far is not None
                    else (1.0, 1.0, 1.0), white_level=4600, seed=5, number=3, first_row=2, out=out,
                )  # fmt: skip
                found[f"{factor} {ratio} {far is not None}"] = [share, out.max(), out.tobytes()]
    shares = (0.0, 0.004, 0.0043, 0.01, 0.5, 1.0)
    found["reached"] = [[brightness_reached(image, share, far, end) for share in shares] for far in (None, weights)]
    for wanted, ratio, below in ((None, 1.0, False), (NOISE.at(4.0), 4.0, True), (NOISE.at(2.0), 2.0, False)):
        items = rng.uniform(0, 1, (4, 3, 3, 5)).astype(np.float32) ** 4
        items[:, :, 0] = 0
        gains, seeds = np.array([0.25, 1.0, 2.0, 3.0]), np.array([1, 2, 2**63, 2**64 - 1], np.uint64)
        add_noise(items, gains, NOISE, seeds, white_level=900, wanted=wanted, ratio=ratio, below_black=below)
        found[f"items {ratio}"] = list(items)
    for exposure in (
        None,
        parse_exposure(".5"),
        parse_exposure("clip:share=.05"),
        parse_exposure("level:share=.1,low=.5"),
    ):
        for gradient in (None, parse_gradient("smooth:colour=.3")):
            for iso in (None, parse_iso("800/200")):
                if exposure or gradient or iso:
                    made = image.copy()
                    varied = Variation(exposure, gradient, iso, noise=NOISE).apply(made, 4600, 7, 2)
                    name = f"varied {len(found)}"
                    found[name] = [varied.details, varied.end, varied.intensity(), made.tobytes()]
    pinned("images exposed anew", found)
