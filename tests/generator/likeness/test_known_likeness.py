"""Numbers of known images, weights of pictures, and what is said of them, as they were before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from generator.dataset.plan import DatasetOptions, exact_parts, parse_split, sizes_of
from generator.dataset.shards import split_of
from generator.likeness.real_data import (
    BY_QUANTILES,
    BY_SPREAD,
    BlackShares,
    MeasuredPictures,
    Reached,
    balance,
    cautions,
    draw_pictures,
    exposure_sentence,
    like_exposure,
    like_size,
    measure_pictures,
    remedies,
)
from generator.named_numbers import parse_numbers
from generator.philox import distinct, standard_normal, words
from generator.pictures.random_scenes import RandomScene, random_scenes
from generator.rendering.black_points import BlackPoint
from generator.statistics import RealStatistics, cell_borders, cell_means, numbers_of_cells, percentile, read_statistics
from tests.generator.said import said
from tests.generator.stats_files import write_stats
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

WHITE = np.array([900.0, 1200.0, 700.0])


def target(
    values: dict[str, Any], layout: str = "generated", sizes: Any = ((60, 40, 9), (40, 60, 2))
) -> RealStatistics:
    count = max(map(len, values.values()), default=0)
    return RealStatistics("real", layout, 64, sizes, count, np.array([[0.3, 0.4, 0.3]]), values, "s.json", "0")


def test_numbers_of_images(pinned: Pinned) -> None:
    rng = np.random.default_rng(22)
    found: list[Any] = [cell_borders(size, side) for size, side in ((10, 4), (3, 8), (64, 64), (65, 0), (7, 7))]
    for shape in ((1, 1, 3), (5, 9, 3), (70, 65, 3)):
        image = rng.exponential(300, shape).astype(np.uint16)
        cells = cell_means(image, WHITE, 8)
        hidden = cells.copy()
        hidden[0, 0] = np.nan
        found += [
            cells,
            *(numbers_of_cells(one) for one in (cells, hidden, cells * [1, 0, 1], cells * 0, cells * [1, 1, 5])),
        ]
    found += [percentile(np.arange(7.0), percent) for percent in (0, 1, 50, 95, 99)] + [percentile(np.empty(0), 5)]
    pinned("numbers of images", found)


def test_pictures_that_are_drawn(pinned: Pinned) -> None:
    """Weights are found by a descent that ends within a thousandth."""
    rng = np.random.default_rng(23)
    names = (*BY_QUANTILES, *BY_SPREAD)
    pictures = {name: rng.uniform(0.05, 0.8, 60) for name in names}
    real = {name: rng.uniform(0.15, 0.6, 45) for name in names}
    for name in names:
        # Just at percentiles of the real ones.
        pictures[name][:3] = np.sort(real[name])[[4, 22, 40]]
    found: list[Any] = []
    for shares, least in (((), 0.2), ((), 0.9), ((0.0, 0.5, 1.0), 0.2)):
        measured = MeasuredPictures(pictures, np.arange(60) // 3 == 4, shares)
        drawn = draw_pictures(measured, target(real), None, 5, least)
        found += [drawn.describe(), drawn.sentences(), drawn.places, drawn.weights, drawn.blacks]
        options = (DatasetOptions(), DatasetOptions(rendering="codes"), DatasetOptions(black_point=BlackPoint("like")))
        found += [remedies(drawn, one) for one in options]
    moments = rng.normal(size=(50, 2))
    found += [balance(moments, np.array([0.4, 0.0]), 100.0, least) for least in (0.1, 0.8, 0.99)]
    few = MeasuredPictures({name: values[:2] for name, values in pictures.items()}, np.zeros(2, bool))
    found += [said(draw_pictures, few, target({name: values[:2] for name, values in real.items()}), None, 1)]
    found += [said(draw_pictures, few, target(real), 0, 1)]
    found += [said(draw_pictures, MeasuredPictures({}, np.ones(2, bool)), target(real), 0, 1)]
    pinned("pictures that are drawn", found, same=2e-3, nothing=1e-4)


def test_what_is_said_of_real_data(tmp_path: Path, pinned: Pinned) -> None:
    found: list[Any] = []
    for name in ("chroma_spread", "grey_offset_red", "grey_spread_blue"):
        made = [Reached(name, 1.0, 0.5, after, 2.0) for after in (0.5, 0.79, 0.8, 1.25, 1.26, 1.5, 1.51)]
        found.append([[one.is_alike, one.sentence()] for one in made])
    bright = {"luminance_50": np.full(31, 0.36), "exposure": np.linspace(0, 1.2, 31)}
    for one in (
        target(bright),
        target({"luminance_50": np.full(30, 0.35)}),
        target({"luminance_50": np.full(29, 0.1)}),
    ):
        found += [cautions(one), like_exposure(one), exposure_sentence(one), one.may_be_encoded]
    scenes = [RandomScene(number, 30 + 3 * number, 50 - number, 0) for number in range(12)]
    for layout, sizes in (("generated", ((60, 40, 9),)), ("thumbnails", ((60, 40, 9),)), ("generated", ())):
        size = like_size(target({}, layout, sizes), scenes)
        found.append(None if size is None else [size.describe(), size.sentence()])
    found.append(said(like_size, target({}, sizes=((200, 20, 1),)), scenes))
    found.append(said(like_size, target({}, sizes=((20, 20, 1),)), scenes))

    def photograph(picture: Any, number: int) -> Any:
        return (picture.astype(np.uint16) * np.array([3, 4, 2], np.uint16) + number).astype(np.uint16)

    for black in (None, BlackShares((30.0, 40.0, 20.0), (0.0, 0.6, 1.0))):
        measured = measure_pictures(random_scenes(3, 30, 20, 2), photograph, WHITE, 5, 1, None, black)
        found += [measured.values, measured.unreadable, measured.variants]
    path = write_stats(tmp_path / "s.json", [[0.3, 0.4, 0.3]], {"exposure": [0.5, 0.25]})
    found.append(read_statistics(path))
    pinned("what is said of real data", found)


def test_parts_and_words(pinned: Pinned) -> None:
    texts = (
        "80,10,10",
        "3,1",
        ".5,.5",
        "0.7,0.2,0.1",
        "33.3,33.3,33.4",
        "99.99995,0,0",
        "99.9999,0,0.00005",
        "1,0,0",
        "0,1",
    )
    texts += (
        "0.5,0.4",
        "0.6,0.4000005",
        "0.6,0.400002",
        "1.5,.5",
        "50.5,49.5",
        "50.5,49.6",
        "50.5,49.50015",
        "0,0,0",
        "-1,2",
        "1",
        "a,b",
        "inf,1",
    )
    shares = ((0.8, 0.1, 0.1), (0.34, 0.33, 0.33), (0.0, 0.5, 0.5), (1.0, 0.0, 0.0))
    scenes = random_scenes(13, 2, 2, 4)
    number = {"r": (0.0, 1.0), "b": (-1.0, 2.0)}
    given = ("r=1,b=-1", "R = .5", "", "r=1.1", "b=2.01", "r=0,r=0", "x=1", "r", "r=nan", "r=1e-3,b=2")
    wrong: list[dict[str, Any]] = [{"bits": 0}, {"bits": 9}, {"crops": 0}, {"shard_images": 0}, {"split_exact": True}]
    wrong += [{"form": "gif"}, {"scale": "full", "form": "exr"}, {"layout": "zip"}, {"scale": "half"}]
    wrong += [{"split": split} for split in ((0.5, 0.5, 0.1), (0.5, 0.5, 1e-7), (1.1, -0.1, 0.0))]
    found: dict[str, Any] = {
        "splits": {text: said(parse_split, text) for text in texts},
        "sizes": [[sizes_of(count, share) for count in (1, 2, 3, 10, 11, 12, 101)] for share in shares],
        "parts": [[part[0] for part in exact_parts(scenes, share, 9)] for share in shares],
        "each": [split_of(share, 9, None, scene.name) for share in shares for scene in scenes],
        "files": [split_of(share, 9, f"{number:x}" * 64, "a") for share in shares for number in range(16)],
        "options": [str(said(DatasetOptions, **one))[:300] for one in wrong],
        "bits": [DatasetOptions(bits=bits).bits for bits in (1, 8)],
        "numbers": {text: said(parse_numbers, text, number, "a thing") for text in given},
        "words": words(2**40 + 3, np.arange(4), [[1], [2**32 - 1]], 7, 12),
        "distinct": [distinct(5, count, total, 9, 1) for count, total in ((1, 1), (5, 5), (3, 1000), (4, 2**32))],
        "normal": standard_normal(words(5, np.arange(6), 0, 0, 3)),
    }  # fmt: skip
    pinned("parts and words", found)
