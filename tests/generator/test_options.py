"""Pinned choices of illuminants by distributions, lists and options.

A later version must make the same data set from the same seed, so these results must not change.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.table.lut import Lut
from generator import philox
from generator.lights.choices import light_numbers, parse_light
from generator.lights.distributions import parse_distribution
from generator.lights.gamut import black_body, rgb_of
from generator.lights.lighting import LightChoice, mixture_of, parse_mixture
from generator.options import LightOptions
from tests.generator.dataset.known import table_in
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

SEED = 2**40 + 9


def choice_record(choice: LightChoice, scenes: tuple[int, ...] = (0, 1, 2, 70000)) -> list[Any]:
    """Return the description of a choice, and the illuminants of some scenes."""
    lights = [
        [mixture.label for lighting in choice.lightings_of(scene) for mixture in lighting.mixtures] for scene in scenes
    ]
    return [choice.describe(), choice.lights_each, lights]


@pytest.fixture(scope="module", autouse=True)
def lut(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lut]:
    """Change to a folder with a LUT and files of ground truths."""
    folder = tmp_path_factory.mktemp("lights")
    rng = np.random.default_rng(6)
    with chdir(folder):
        truths = rgb_of(rng.normal([0.35, 0.25], 0.02, (12, 2)))
        Path("gt.csv").write_text(
            "name,R,G,B\n" + "".join(f"{n}.png,{r},{g},{b}\n" for n, (r, g, b) in enumerate(truths))
        )
        Path("gt.txt").write_text("\n".join(f" {r:.6f} {g:.6f};{b:.6f}" for r, g, b in truths[:4]) + "\n\n")
        Path("many.csv").write_text(
            "b,image,r,g\n.2,one.cr2,.4,.4\n.25,two.png,.35,.4\n.3,one.cr2,.3,.4\n.2,two.png,.45,.35\n"
        )
        yield table_in(Path("lut"))


def test_pinned_draws(pinned: Pinned) -> None:
    words = philox.words(3, np.arange(100), 1, 2, philox.CHROMATICITIES)
    texts = ("uniform", "gaussian:r=.3,b=.25,sd=.02", "gaussian:r=.3,b=.25,sd_r=.03,sd_b=.02,corr=-.8")
    texts += ("gt.csv", "gt.txt", "gaussian:r=.3,sd=.1", "gaussian:r=.3,b=.2,sd_r=.1", "none")
    results: dict[str, Any] = {}
    for text in texts:
        distribution = said(parse_distribution, text)
        results[text] = distribution if isinstance(distribution, dict) else [
            distribution.describe(),
            distribution.draw(words),
        ]  # fmt: skip
    pinned("draws of distributions", results)


def test_pinned_lights_of_texts(lut: Lut, pinned: Pinned) -> None:
    texts = ("0", "4", "5", "999", "1000", "5500", "C", " C ", "c", "tungsten", "2500K", "9000k", "2499K", "4000 K")
    texts += (
        "cct=7000",
        "cct=.5",
        "r=.3,b=.25",
        "r=.3",
        "r=.6,b=.5",
        "r=.5,b=.5",
        "r=.33333,b=.9",
        "0:1+4:3",
        "0:0+4:3",
    )
    texts += ("4:.3+0:.7", "0:.3+0:.7", "", "r=.3,b=.25,cct=5000", "1:.2+9:.8")
    results = {text: said(parse_light, text, lut) for text in texts}
    results |= {f"{text} nearest": said(parse_light, text, lut, None, "nearest") for text in texts}
    lists = ("all", " ALL ", "0,2-4", "4-4,1,4", "3-1", "0-5", "1,,2", "0 - 2 , 4", "-1")
    results |= {f"list {text}": said(light_numbers, text, 5) for text in lists}
    share_sets = ({4: 3, 1: 1, 2: 0.0}, {0: 1, 1: 4e-10}, {0: 1, 1: 6e-10}, {0: 1, 1: 1, 2: 1})
    results |= {f"parts {number}": mixture_of(shares) for number, shares in enumerate(share_sets)}
    results["parsed"] = [parse_mixture(text) for text in ("7", "3:.2+1:.8", "1:.3333333+2:.3333333+5:.3333334")]
    results["bodies"] = [black_body(lut, kelvin) for kelvin in (2500, 2501, 3000, 3800, 5000, 5500, 8000, 9000)]
    pinned("lights that texts name", results)


REQUESTS: dict[str, dict[str, Any]] = {
    "random": {},
    "three random": {"random": 3},
    "drawn": {"distribution": "gaussian:r=.32,b=.28,sd=.03", "random": 2},
    "drawn evenly together": {"distribution": "uniform", "random": 2, "lights_per_image": 2},
    "nearest": {"nearest": Path("gt.csv")},
    "nearest together": {"nearest": Path("gt.txt"), "lights_per_image": 2},
    "matched": {"match": Path("gt.csv"), "masks": "window"},
    "listed together": {"light": ["0-3"], "lights_per_image": 2, "masks": "half-plane"},
    "listed unevenly": {"light": ["0-2"], "lights_per_image": 2},
    "texts": {"light": ("A", "r=.33,b=.27", "4000K"), "lights_per_image": 3},
    "one of several": {"masks": "smooth", "lights_per_image": 1},
    "none": {"lights_per_image": 0},
    "both": {"light": ["0"], "random": 2},
    "too many": {"random": 6},
    "far": {"distribution": "gaussian:r=.9,b=.02,sd=.001"},
}


def test_pinned_choices(lut: Lut, pinned: Pinned) -> None:
    results: dict[str, Any] = {}
    for name, keywords in REQUESTS.items():
        choice = said(LightOptions(**keywords).choose, lut, SEED)
        results[name] = choice if isinstance(choice, dict) else said(choice_record, choice, (0, 1, 70000))
    pinned("requests of lights", results)
