"""Masks of every kind, number of lights and shape of image, and maps of them, as they were before.

Who changes what a seed decides changes datasets: who makes one again, with a later version, is to get the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foundation.errors import CropError
from generator import philox
from generator.masks.making import RandomStreams, find_masks, parse_masks, quantise_shares
from generator.masks.maps import (
    decode_ground_truth,
    decode_weights,
    encode_maps,
    mean_weights,
    quantised_chromaticities,
    quantised_weights,
)
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

TEXTS = (
    "half-plane",
    "half-plane:angle=90",
    "half-plane:angle=-30,width=.3",
    "soft-edge",
    "soft-edge:angle=200,width=0",
    "spots",
    "spots:count=1,radius=1,softness=2",
    "spots:count=20,radius=.05,softness=0",
    "smooth",
    "smooth:scale=2",
    "smooth:scale=.02,contrast=100",
    "smooth:contrast=0",
    "window",
    "window:columns=1,rows=1,softness=0",
    "window:columns=5,rows=2,softness=.3",
)
REFUSED = ("window:columns=1.5", "spots:count=0", "spots:count=21", "smooth:scale=.01", "half", "smooth:radius=1", "")


def test_masks_of_every_kind(pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    for text in TEXTS:
        for lights in (2, 3, 5):
            plan = parse_masks(text, lights, 2**35 + 4)
            made = [
                plan.maker(number).weights(height, width, lights)
                for number, (height, width) in enumerate(((11, 14), (16, 5), (1, 1), (1, 9)))
            ]
            found[f"{text} {lights}"] = [made[0][5, ::5], b"".join(weights.tobytes() for weights in made)]
    for text in REFUSED:
        with pytest.raises(CropError):
            parse_masks(text, 2, 0)
    # More rows than are computed at a time.
    found["tall"] = parse_masks("smooth", 2, 1).maker(0).weights(1200, 60, 2)
    pinned("masks of every kind", found)


def test_masks_of_files(pinned: Pinned, tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    found: dict[str, Any] = {}
    given = {
        "one": {"a_1.png": rng.integers(0, 256, (6, 8), np.uint8)},
        "both": {
            "a_1.png": rng.integers(0, 256, (6, 8), np.uint8),
            "a_2.png": rng.integers(0, 65536, (6, 8), np.uint16),
        },
        "sets": {f"{name}.png": rng.integers(0, 3, (5, 5), np.uint8) * 127 for name in ("c", "b_10", "b_2", "a")},
        "colour": {"a.png": rng.integers(0, 256, (6, 8, 3), np.uint8)},
        "grey": {"a.png": np.repeat(rng.integers(0, 256, (6, 8, 1), np.uint8), 3, axis=2)},
        "numbered": {f"{number:06d}_1.png": rng.integers(0, 256, (3, 3), np.uint8) for number in (7, 2, 100)},
        "float": {"a_1.tiff": rng.uniform(-0.5, 1.5, (6, 8)).astype(np.float32)},
        "none": {},
    }
    for name, files in given.items():
        folder = tmp_path / name
        folder.mkdir()
        for file, values in files.items():
            (folder / file).write_bytes(cv2.imencode(Path(file).suffix, values)[1].tobytes())
        for lights in (2, 3):
            try:
                plan = find_masks(folder, lights)
                described = {key: value for key, value in plan.describe().items() if key != "sha256"}
                sizes = ((6, 8), (3, 4), (12, 17), (3, 16))
                masks = [plan.maker(number).weights(*size, lights) for number, size in enumerate(sizes)]
                found[f"{name} {lights}"] = [described, [maker.files for maker in plan.sets], plan.places, masks]
            except CropError:
                found[f"{name} {lights}"] = {"refused": 1}
    # Sizes are fitted by a library, to whole 65535ths after that.
    pinned("masks of files", found, nothing=2e-5)


def test_maps_of_weights(pinned: Pinned) -> None:
    rng = np.random.default_rng(14)
    found: dict[str, Any] = {}
    for lights in (1, 2, 3, 6):
        shares = (rng.random((lights, 5, 7)) ** 3).astype(np.float32)
        shares[0, 0, :3] = shares[-1, 0, :3] = 0.25
        weights = np.empty((5, 7, lights), np.float32)
        quantise_shares(shares, weights)
        whites = rng.uniform(0.1, 5000, (lights, 3))
        maps = encode_maps(weights, whites)
        masks = [data for kind, _, data in maps if "mask" in kind]
        found[str(lights)] = [
            weights, quantised_weights(weights, 65535), quantised_weights(weights, 255), mean_weights(weights),
            quantised_chromaticities(weights, whites, 65535), [[kind, name] for kind, name, _ in maps],
            decode_weights(masks, "masks") if masks else None,
            decode_ground_truth(maps[-1][2], "map") if maps else None,
        ]  # fmt: skip
    pinned("maps of weights", found)


def test_streams_are_of_the_words() -> None:
    words = philox.words(2**40 + 9, np.arange(5), 2, 7, philox.MASKS)[0]
    np.testing.assert_allclose(RandomStreams(2**40 + 9, 7).uniform(2, 5), (words + 0.5) / 2**32, rtol=1e-15)
