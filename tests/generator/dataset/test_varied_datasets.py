"""Datasets whose images differ beside scene and light: what is recorded, what is true, and that it is made again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calibration.table.lut import Lut
from evaluation.datasets.generated import open_generated
from evaluation.scene import MixedScene
from foundation.errors import InputError
from generator.dataset.making import Workers, generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset, file_faults, open_dataset
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import RandomLights
from generator.masks.making import parse_masks
from generator.pictures.sources import Preparation, find_pictures, read_picture
from generator.rendering.render import render
from generator.variation.iso_speed import parse_iso
from generator.variation.variation import Variation, parse_exposure, parse_gradient, varied_by
from tests.generator.conftest import MakeLut
from tests.generator.dataset.contents import contents

pytestmark = pytest.mark.slow

Make = Callable[..., Dataset]


@pytest.fixture
def lut(make_lut: MakeLut) -> Lut:
    """Return a table of 512 colours, enough to tell its noise."""
    return make_lut(bits=3)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Return a folder of four pictures with colours that change slowly."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for name in "abcd":
        coarse = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
        codes = cv2.resize(coarse, (96, 72), interpolation=cv2.INTER_CUBIC)
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return folder


@pytest.fixture
def make(lut: Lut, pictures: Path, tmp_path: Path) -> Make:
    """Return a maker of datasets of the pictures under two lights each."""

    def made(
        name: str, variation: Variation | None = None, crops: int = 1, lights: Any = None, workers: int = 1, **more: Any
    ) -> Dataset:
        preparation = Preparation(crop=(32, 24), crops=crops, seed=5) if crops > 1 else Preparation()
        options = DatasetOptions(form="tiff", previews=False, variation=variation, crops=crops, shard_images=3, **more)
        choice = lights or RandomLights(2, len(lut.white), 5)
        sources = find_pictures(pictures, preparation)
        return generate_dataset(
            lut, tmp_path / name, sources, choice, seed=5, options=options, workers=Workers(count=workers)
        )

    return made


def everything(lut: Lut) -> Variation:
    return varied_by(
        lut, parse_exposure("stops:low=-2,high=2"), parse_gradient("smooth:stops=1"), parse_iso("400/100:read=1")
    )


def test_truths_and_choices_do_not_change_with_exposure_and_noise(lut: Lut, make: Make) -> None:
    plain, varied = make("plain"), make("varied", everything(lut))
    assert [(e.image, e.source, e.lights, e.truths, e.truth) for e in plain.entries] == [
        (e.image, e.source, e.lights, e.truths, e.truth) for e in varied.entries
    ]
    assert list(varied.details) == [entry.image for entry in varied.entries]
    names = ["end_r", "end_g", "end_b", "exposure", "iso", "clipped"]
    for entry in varied.entries:
        assert [*varied.details[entry.image]] == ["cells", "outside", "distance", *names]
        row = {name: float(varied.details[entry.image][name]) for name in names}
        assert 0.25 <= row["exposure"] <= 4
        assert row["iso"] == pytest.approx(400)
        # Where light falls off, all channels do by as much: an image's mean is the plain one's times some number.
        one, other = (set_.read_image(entry).astype(np.float64).mean(axis=(0, 1)) for set_ in (plain, varied))
        if row["clipped"] < 0.001:
            ratio = other / one / row["exposure"]
            assert row["end_g"] - 0.05 < ratio.min()
            assert ratio.max() < 1.05
    assert list(file_faults(varied.store.place)) == []


def test_workers_layouts_and_kills_do_not_change_an_image(lut: Lut, make: Make, tmp_path: Path) -> None:
    options = {"variation": everything(lut), "crops": 2}
    make("one", **options)
    make("three", workers=3, **options)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")
    one = open_dataset(tmp_path / "one")
    for layout in ("webdataset", "parquet"):
        other = make(layout, layout=layout, **options)
        assert other.details == one.details
        for entry, its in zip(one.entries, other.entries, strict=True):
            np.testing.assert_array_equal(one.read_image(entry), other.read_image(its))


def test_the_share_that_is_clipped_is_the_one_asked_for(lut: Lut, make: Make) -> None:
    dataset = make("clipped", varied_by(lut, parse_exposure("clip:share=.05,most=50")))
    white = dataset.description.table.white_level
    for entry in dataset.entries:
        image = dataset.read_image(entry)
        assert image.max() == white
        clipped = (image.max(axis=2) == white).mean()
        assert float(dataset.details[entry.image]["clipped"]) == pytest.approx(clipped, rel=1e-6)
        # Of 6912 pixels; more only where several have the count at which the share ends.
        assert 0.05 <= clipped + 1 / 6912 < 0.06
    # Noise lifts the brightest pixels: a factor that is chosen without it clips more.
    noisy = make("noisy", varied_by(lut, parse_exposure("clip:share=.05,most=50"), iso=parse_iso("6400/100")))
    shares = [float(row["clipped"]) for row in noisy.details.values()]
    assert np.abs(np.array(shares) / 0.05 - 1).max() < 0.06
    unclipped = make("unclipped", varied_by(lut, parse_exposure("clip:share=0,most=50")))
    assert all(float(row["clipped"]) == 0 for row in unclipped.details.values())
    assert all(unclipped.read_image(entry).max() >= white - 8 for entry in unclipped.entries)


def test_crops_are_numbered_recorded_and_stay_together(make: Make, pictures: Path, lut: Lut) -> None:
    dataset = make("crops", crops=3, split=(0.5, 0.2, 0.3))
    assert len(dataset.entries) == 4 * 3 * 2
    assert len(dataset.sources) == 4
    for number, entry in enumerate(dataset.entries):
        row = dataset.details[entry.image]
        assert entry.image == f"{number:06d}.tiff"
        assert (entry.source, int(row["crop"])) == ("abcd"[number // 6] + ".png", number // 2 % 3)
        left, top = int(row["left"]), int(row["top"])
        cut = read_picture(pictures / entry.source)[top : top + 24, left : left + 32]
        expected = render(lut, np.ascontiguousarray(cut), int(entry.illumination), seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), expected)
    # All crops of a picture are in one part, and in one group of folds.
    parts = {
        entry.source: {other.split for other in dataset.entries if other.source == entry.source}
        for entry in dataset.entries
    }
    assert all(len(its) == 1 for its in parts.values())
    assert {getattr(scene, "group", "") for scene in open_generated(dataset.store.place).scenes} == set(parts)
    # Each crop has lights of its own.
    assert len({tuple(entry.illumination for entry in dataset.entries[at : at + 2]) for at in range(0, 24, 2)}) > 4
    assert dataset.description.pixels == 4 * 3 * 32 * 24


def test_crops_that_the_sources_do_not_have(lut: Lut, pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 1 crops, expected 2"):
        generate_dataset(lut, tmp_path / "out", find_pictures(pictures), [0], options=DatasetOptions(crops=2))


def test_a_tint_has_maps_that_are_true(lut: Lut, make: Make) -> None:
    gradient = parse_gradient("soft-edge:width=.9,stops=1,least=1,colour=.5")
    dataset = make("tint", varied_by(lut, gradient=gradient))
    plain = make("plain")
    scenes = open_generated(dataset.store.place).scenes
    for entry, flat, scene in zip(dataset.entries, plain.entries, scenes, strict=True):
        row = dataset.details[entry.image]
        end = np.array([float(row[f"end_{channel}"]) for channel in "rgb"])
        light = int(entry.illumination)
        assert entry.lights == (str(light), str(light))
        np.testing.assert_allclose(entry.truths[0], lut.ground_truth[light], atol=1e-9)
        weights = dataset.read_weights(entry).astype(np.float64)
        here = weights @ np.array([lut.white[light], lut.white[light] * end])
        np.testing.assert_allclose(
            dataset.read_ground_truth_map(entry), here / here.sum(axis=2, keepdims=True), atol=2e-5
        )
        mean = here.mean(axis=(0, 1))
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-7)
        # The image is the plain one in the light that the map tells of.
        ratio = dataset.read_image(entry) / np.maximum(plain.read_image(flat), 1.0) / (here / lut.white[light])
        assert np.abs(np.median(ratio, axis=(0, 1)) - 1).max() < 0.01
        assert isinstance(scene, MixedScene)


def test_several_lights_that_fall_off_are_weighed_by_their_light(lut: Lut, make: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("half-plane:angle=0", 2, 5))
    gradient = varied_by(lut, gradient=parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3"))
    dataset = make("several", gradient, lights=choice)
    plain = make("plain", lights=choice)
    moved = 0.0
    for entry, flat in zip(dataset.entries, plain.entries, strict=True):
        weights = dataset.read_weights(entry).astype(np.float64)
        np.testing.assert_array_equal(weights, plain.read_weights(flat))
        falloff = parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3").of_image(5, int(entry.image[:6]))
        level = 1 - falloff.weights(*weights.shape[:2])[..., 1] * (1 - falloff.end[0])
        mean = (weights * level[..., None]).mean(axis=(0, 1)) @ lut.white[[int(light) for light in entry.lights]]
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-6)
        moved = max(moved, np.abs(np.subtract(entry.truth, flat.truth)).max())
    # In the world where the falling off is forgotten, the truth would be the plain one.
    assert moved > 0.001


def test_tints_and_several_lights_are_refused(lut: Lut, make: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("smooth", 2, 5))
    with pytest.raises(InputError, match="colour"):
        make("both", varied_by(lut, gradient=parse_gradient("smooth:colour=.1")), lights=choice)


def test_raw_files_hold_the_same_counts(lut: Lut, make: Make, pictures: Path, tmp_path: Path) -> None:
    variation = everything(lut)
    options = DatasetOptions(form="dng", previews=False, variation=variation)
    raw = generate_dataset(
        lut, tmp_path / "raw", find_pictures(pictures), RandomLights(2, 4, 5), seed=5, options=options
    )
    plain = make("tiff", variation)
    assert raw.details == {name.replace("tiff", "dng"): row for name, row in plain.details.items()}
    for one, other in zip(raw.entries, plain.entries, strict=True):
        halved, image = raw.read_image(one), plain.read_image(other)
        np.testing.assert_array_equal(halved[..., 0], image[0::2, 0::2, 0])
        np.testing.assert_array_equal(halved[..., 2], image[1::2, 1::2, 2])
