"""Datasets rendered by colour, and without the print's black: what is in them, what is recorded, who makes them."""

from __future__ import annotations

import csv
import hashlib
import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from foundation.errors import InputError
from generator.cli import main
from generator.dataset.making import generate_dataset, make_dataset, make_share, workplace
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import open_dataset
from generator.dataset.shards import make_shard
from generator.kernels.printing import draw_printed
from generator.kernels.rendering import draw_samples
from generator.lights.lighting import ListedLights, Mixture, plain
from generator.masks.making import FULL
from generator.masks.maps import quantised_chromaticities
from generator.options import LightOptions
from generator.pictures.sources import find_pictures
from generator.rendering.black_points import BlackPoint, veil_of, without_veil
from generator.rendering.colorimetric import ColorimetricRendering
from generator.rendering.matrices import ColourMatrix
from tests.generator.dataset.contents import contents
from tests.generator.rendering.conftest import make_table as make_table_of_a_print

pytestmark = pytest.mark.slow
make_table = make_table_of_a_print

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from tests.generator.conftest import MakeLut

MATRIX = ColourMatrix("mine", np.array([[0.6, 0.3, 0.1], [0.1, 0.7, 0.2], [0.05, 0.25, 0.7]]), "a test")
BY_COLOUR = DatasetOptions(rendering="colorimetric", matrix=MATRIX, black_point=BlackPoint("random"), previews=False)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for name, shape in (("a.png", (40, 70, 3)), ("b.png", (51, 38, 3)), ("c.png", (36, 100, 3))):
        codes = rng.integers(0, 256, shape).astype(np.uint8)
        (folder / name).write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return folder


def made(lut: Lut, pictures: Path, out: Path, options: DatasetOptions, **more: Any) -> dict[str, str]:
    """Make a dataset under lights 1 and 2 and return the hash of every file."""
    generate_dataset(lut, out, find_pictures(pictures), [1, 2], seed=5, options=options, **more)
    return contents(out)


def rows_of(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "images.csv").read_text().splitlines()))


def test_an_image_is_that_of_its_light_without_a_share_of_black(
    make_lut: MakeLut, pictures: Path, tmp_path: Path
) -> None:
    lut = make_lut(bits=3)
    made(lut, pictures, tmp_path / "codes", DatasetOptions(previews=False))
    made(lut, pictures, tmp_path / "colours", BY_COLOUR)
    of_codes, dataset = open_dataset(tmp_path / "codes"), open_dataset(tmp_path / "colours")
    rendering = ColorimetricRendering(lut, MATRIX)
    sources = {source.name: source.read().picture for source in find_pictures(pictures)}
    rows = rows_of(tmp_path / "colours")
    assert dataset.details == {row["image"]: {key: row[key] for key in row if key != "image"} for row in rows}
    for number, (entry, before, row) in enumerate(zip(dataset.entries, of_codes.entries, rows, strict=True)):
        light = plain(int(entry.lights[0]))
        share = BY_COLOUR.black_point.share(5, number)
        assert row["cells"] == rendering.map.sha256[:16]
        printed = rendering.printed(light, share)
        image = draw_printed(lut.samples, sources[entry.source], [printed], rendering.cells, seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), np.minimum(image, lut.provenance.white_level))
        assert float(row["black_taken"]) == pytest.approx(share, abs=1e-8)
        assert 0 <= float(row["outside"]) <= 1
        assert float(row["distance"]) >= 0
        assert row["image"] == entry.image
        # The ground truth is the light's, whatever becomes of the print.
        assert (entry.truth, entry.truths) == (before.truth, before.truths)
    made_of = dataset.description
    assert made_of.rendering is not None
    pixels = [sources[entry.source].size for entry in dataset.entries]
    for name in ("outside", "distance"):
        mean = np.average([float(row[name]) for row in rows], weights=pixels)
        assert getattr(made_of.rendering, name) == pytest.approx(mean, abs=1e-6)


def test_what_was_begun_or_made_by_codes_goes_on_so(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut, out = make_lut(), str(tmp_path / "out")
    wish = (str(lut.folder), out, "--sources", str(pictures), "--light", "1,2", "--seed", "5")
    assert main((*wish, "--rendering", "codes", "--shard", "0/2", "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2")) == 0
    assert open_dataset(out).description.rendering is None
    # It is there, and nothing else was asked for.
    assert main((*wish, "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2", "--rendering", "colorimetric")) == 2


def test_workers_shards_shares_and_other_processes_change_no_byte(
    make_lut: MakeLut, pictures: Path, tmp_path: Path
) -> None:
    lut = make_lut()
    one = made(lut, pictures, tmp_path / "one", BY_COLOUR, workers=1)
    assert made(lut, pictures, tmp_path / "three", BY_COLOUR, workers=3) == one
    plan = Plan(lut, find_pictures(pictures), ListedLights((1, 2)), 5, BY_COLOUR)
    job = pickle.loads(pickle.dumps(plan.job(0)))
    out = tmp_path / "shares"
    with workplace(out, plan.identity(), alone=False) as place, ThreadPoolExecutor(1) as pool:
        make_shard(job, lut, place, pool, 1)
    make_share(plan, out, (0, 1))
    make_dataset(plan, out)
    assert {name: one[name] for name in ("images.csv", "dataset.json", "images/000003.png")} == {
        name: hashlib.sha256((out / name).read_bytes()).hexdigest()
        for name in ("images.csv", "dataset.json", "images/000003.png")
    }


def test_several_lights_share_an_image(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut(bits=3)
    choice = LightOptions(random=1, lights_per_image=2, masks="half-plane").choose(lut, 5)
    sources = find_pictures(pictures)
    plan_options = DatasetOptions(rendering="colorimetric", matrix=MATRIX, black_point=BlackPoint("compensate"))
    dataset = generate_dataset(lut, tmp_path / "out", sources, choice, seed=5, options=plan_options)
    rendering = ColorimetricRendering(lut, MATRIX)
    for number, (entry, source) in enumerate(zip(dataset.entries, sources, strict=True)):
        lighting = choice.lightings_of(number)[0]
        weights = dataset.read_weights(entry)
        lights = [rendering.printed(mixture, 1.0) for mixture in lighting.mixtures]
        wanted = draw_printed(
            lut.samples,
            source.read().picture,
            lights,
            rendering.cells,
            shares=weights,
            most=lut.provenance.white_level,
            seed=5,
            image=number,
        )
        np.testing.assert_array_equal(dataset.read_image(entry), wanted)
        truth = quantised_chromaticities(weights, lighting.whites(lut), FULL) / FULL
        np.testing.assert_allclose(dataset.read_ground_truth_map(entry), truth, atol=2e-5)


def test_a_mixture_of_lights_has_the_black_of_the_mixture(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    mixture = Mixture((0, 3), (0.25, 0.75))
    options = DatasetOptions(rendering="codes", black_point=BlackPoint("compensate"))
    request = LightOptions(light=[mixture.label]).choose(lut, 5)
    dataset = generate_dataset(lut, tmp_path / "out", find_pictures(pictures), request, seed=5, options=options)
    picture = next(iter(find_pictures(pictures))).read().picture
    samples = without_veil(mixture.samples(lut, 5), veil_of(lut, mixture, 1.0), lut.provenance.white_level)
    image = dataset.read_image(dataset.entries[0])
    np.testing.assert_array_equal(image, draw_samples(samples, picture, seed=5, image=0))


def test_faults_are_named() -> None:
    with pytest.raises(InputError, match="colour matrix"):
        DatasetOptions(rendering="codes", matrix=MATRIX)
    with pytest.raises(InputError, match="'inks'"):
        DatasetOptions(rendering="inks")  # pyrefly: ignore[bad-argument-type]
