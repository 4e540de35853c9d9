"""Training items of known galleries, as they were before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from generator.lights.lighting import Mixture
from generator.pictures.random_scenes import random_scenes
from generator.rendering.matrices import ColourMatrix
from generator.training.crops import Crops
from generator.training.gallery import gallery_of, open_gallery, save_gallery
from generator.variation.iso_speed import parse_iso
from generator.variation.sensor_noise import SensorNoise
from tests.generator.dataset.known import table_in
from tests.generator.rendering.prints import MATRIX
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

MINE = ColourMatrix("mine", MATRIX, "a test")
NOISE = SensorNoise(read=(6.0, 4.0, 3.5), shot=(0.5, 0.25, 0.75))
MIXED = (Mixture((0, 3), (0.3, 0.7)), 2, "E", "4000K")

CASES: dict[str, dict[str, Any]] = {
    "codes": {"rendering": "codes", "exposure": (0.25, 2.0)},
    "codes of mixtures, black taken out": {"rendering": "codes", "lights": MIXED, "black_point": "random:.9"},
    "codes with noise": {"rendering": "codes", "exposure": (0.1, 8.0), "noise": NOISE, "flip": False, "threads": 3},
    "colours": {"matrix": MINE, "lights": [4, 1]},
    "colours without black": {"matrix": MINE, "black_point": "compensate", "lights": MIXED, "threads": 2},
    "colours with speed": {"matrix": MINE, "noise": NOISE, "iso": parse_iso("1600/100"), "black_point": "random"},
}


def pictures() -> list[npt.NDArray[np.uint8]]:
    """Return pictures of unlike sizes, the last as large as a crop."""
    return [scene.read().picture for scene in random_scenes(3, 41, 23, 5)] + [
        random_scenes(1, 9, 7, 6)[0].read().picture
    ]


@pytest.mark.parametrize("name", CASES)
def test_items(name: str, tmp_path: Path, pinned: Pinned) -> None:
    gallery = gallery_of(pictures(), ["a", "b", "c", "d"])
    found: list[Any] = []
    for size, seed, epoch in (((7, 9), 2**63 + 1, 0), ((1, 1), 3, 2**32 - 1), ((5, 8), 4, 7)):
        crops = Crops(
            table_in(tmp_path / f"lut{seed}"), gallery, size, length=1000, seed=seed, epoch=epoch, **CASES[name]
        )
        batch = crops.batch([0, 999, 500, 3, 3, 77])
        found += [vars(batch), batch.images[0, :, 0, 0], len(crops)]
        crops.set_epoch(1)
        image, light = crops[12]
        found.append([image, light])
    pinned(f"training items, {name}", found)


def test_galleries_and_what_is_refused(tmp_path: Path, pinned: Pinned) -> None:
    saved = save_gallery(random_scenes(3, 8, 5, 1), tmp_path / "gallery")
    again = open_gallery(tmp_path / "gallery")
    lut = table_in(tmp_path / "lut")
    wrong: list[dict[str, Any]] = [{"size": (0, 4)}, {"size": (6, 4)}, {"size": (5, 9)}, {"size": 3}, {"length": 0}]
    wrong += [{"length": 2**32 + 1}, {"exposure": (0.0, 1.0)}, {"exposure": (2.0, 1.0)}, {"iso": parse_iso("200/100")}]
    wrong += [{"seed": -1}, {"seed": 2**64}, {"lights": []}, {"lights": [9]}, {"lights": "all"}, {"epoch": -1}]
    wrong += [{"epoch": 2**32}, {"black_point": "like"}, {"black_point": "grey"}, {"black_point": 3}]
    found: list[Any] = [saved.names, saved.sizes, saved.offsets, saved.codes, again.names, again.picture(2), len(again)]

    for given in wrong:
        named: dict[str, Any] = {"size": (5, 8), "rendering": "codes", **given}
        found.append(said(Crops, lut, again, **named))
    crops = Crops(lut, again, (5, 8), length=4, rendering="codes")
    items: list[Any] = [[], [4], [-1], [[0]]]
    found += [said(crops.batch, one) for one in items]
    found += [
        said(gallery_of, []),
        said(gallery_of, pictures(), ["a"]),
        said(gallery_of, [np.zeros((0, 3, 3), np.uint8)]),
    ]
    found.append(said(save_gallery, [], tmp_path / "new"))
    pinned("galleries", found)
