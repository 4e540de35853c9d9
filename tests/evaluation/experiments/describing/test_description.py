"""The description of a data set: of its images each, in any number of threads, and of real ones as they are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import open_scenes
from evaluation.experiments.describing import describe, figures
from evaluation.experiments.describing.description import read_statistics, statistics_to_json
from evaluation.scene import SceneSet
from foundation.errors import FormatError, InputError
from tests.data_files import available
from tests.evaluation.experiments.describing.scenes import Made, MadeMixture, made_set, random_set

pytestmark = pytest.mark.slow


def test_threads_change_nothing_and_every_image_is_counted() -> None:
    seen: list[None] = []
    one = describe(random_set("a", 9), on_scene=lambda: seen.append(None))
    assert statistics_to_json(describe(random_set("a", 9), workers=3)) == statistics_to_json(one)
    assert len(seen) == 9
    assert one.images == tuple(f"a {number}" for number in range(9))
    assert one.sizes == ((16, 16, 9),)
    assert one.lights.shape == (9, 3)


def test_figures_of_lights_are_of_every_light_of_a_mixture() -> None:
    lights = np.array([[0.6, 1.0, 0.3], [0.3, 1.0, 0.8]])
    image = np.ones((20, 20, 3))
    mixed = MadeMixture("m", lights.mean(axis=0), image, lights=lights)
    made = describe(made_set("x", [mixed, Made("a", np.array([1.0, 1, 1]), image)]))
    assert made.mixed == 1
    reds = np.log([0.6, 0.3, 1])
    assert figures(made)["light_red"] == pytest.approx(reds.mean())
    assert figures(made)["light_spread_red"] == pytest.approx(reds.std())


def test_sizes_noise_unit_and_no_image() -> None:
    shapes = [(20, 30), (20, 30), (8, 8)]
    scenes = [Made(f"{number}", np.ones(3), np.ones((*shape, 3)), 2.0) for number, shape in enumerate(shapes)]
    made = describe(made_set("x", scenes))
    assert made.sizes == ((30, 20, 2), (8, 8, 1))
    assert made.noise_unit == "saturation"
    with pytest.raises(InputError, match="/none holds no image"):
        describe(SceneSet("none", "made", "/none", ()))


def test_a_file_holds_all_of_it(tmp_path: Path) -> None:
    made = describe(random_set("a", 12))
    text = statistics_to_json(made)
    path = tmp_path / "s.json"
    path.write_text(text)
    back = read_statistics(path)
    assert back.images == made.images
    assert back.treatment == made.treatment
    for name, value in figures(made).items():
        assert figures(back)[name] == pytest.approx(value, rel=1e-4, nan_ok=True), name
    np.testing.assert_allclose(back.lights, made.lights, rtol=1e-5)
    np.testing.assert_allclose(back.chroma, made.chroma, rtol=1e-5)
    np.testing.assert_allclose(back.luminance, made.luminance, rtol=1e-5)
    assert back.noise_unit == made.noise_unit
    assert [len(curve.levels) for curve in back.noise] == [len(curve.levels) for curve in made.noise]
    assert "NaN" not in text


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            '"version": 1',
            '"version": 2',
            r"crop\.statistics, version 2; expected crop\.statistics, version 1",
        ),
        ('"lights": [[', '"lamps": [[', "is not as its format has it: KeyError"),
        ('"lights": [[0.', '"lights": [[-0.', "all above 0"),
        ('"images": ["a 0", ', '"images": [', "values of 2 images expected"),
        ('"grey_red": [', '"gray_red": [', "grey_red"),
        ("{\n", "[\n", "cannot be read as statistics"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    text = statistics_to_json(describe(random_set("a", 3)))
    assert old in text
    path = tmp_path / "s.json"
    path.write_text(text.replace(old, new))
    with pytest.raises(FormatError, match=says):
        read_statistics(path)


REAL = ("benchmark/nus_canon_1ds_mk3_64x64.npz", "benchmark/nus_canon_600d_64x64.npz")
CHROMA_SPREADS = {"nus_canon_1ds_mk3_64x64": 0.0607, "nus_canon_600d_64x64": 0.0623}


@pytest.fixture(params=["made", *available(*REAL)], ids=lambda path: Path(path).stem)
def thumbnails(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return an archive of thumbnails, made up or real."""
    if request.param != "made":
        return request.param
    random = np.random.default_rng(7)
    lights = np.array([0.6, 1, 0.5]) * np.exp(random.normal(0, 0.1, (30, 3)))
    images = np.exp(random.normal(-2, 0.6, (30, 64, 64, 3))) * lights[:, None, None]
    images[:, :20, 30:50] = 0
    path = tmp_path / "made.npz"
    np.savez(path, images=images.astype(np.float32), gt=lights, names=np.arange(30).astype(str))
    return path


def test_figures_are_those_of_a_few_lines_of_numpy(thumbnails: Path) -> None:
    made = describe(open_scenes(thumbnails), workers=2)
    with np.load(thumbnails) as content:
        images: npt.NDArray[np.float64] = content["images"].astype(np.float64)
        lights: npt.NDArray[np.float64] = content["gt"].astype(np.float64)
    spreads: list[float] = []
    offsets: list[npt.NDArray[np.float64]] = []
    middles: list[float] = []
    for image, light in zip(images, lights, strict=True):
        pixels = image.reshape(-1, 3) / light
        pixels = pixels[pixels.any(axis=1)]
        lit = pixels[(pixels > 0).all(axis=1)]
        chroma: npt.NDArray[np.float64] = lit / lit.sum(axis=1)[:, None]
        variances: list[float] = [float(chroma[:, channel].var()) for channel in range(3)]
        spreads.append((sum(variances) / 3) ** 0.5)
        means: npt.NDArray[np.float64] = pixels.mean(axis=0)
        offsets.append(np.log(np.array([means[0], means[2]]) / means[1]))
        grey = (pixels * light.mean()).mean(axis=1)
        middles.append(float(np.median(grey) / np.percentile(grey, 99, method="hazen")))
    value = figures(made)
    assert value["chroma_spread"] == pytest.approx(np.median(spreads))
    assert value["luminance_50"] == pytest.approx(np.median(middles))
    spread, offset = np.std(offsets, axis=0), np.mean(offsets, axis=0)
    assert (value["grey_spread_red"], value["grey_spread_blue"]) == pytest.approx(tuple(spread))
    assert (value["grey_offset_red"], value["grey_offset_blue"]) == pytest.approx(tuple(offset))
    if thumbnails.stem in CHROMA_SPREADS:
        assert value["chroma_spread"] == pytest.approx(CHROMA_SPREADS[thumbnails.stem], abs=0.0001)
        # Averaged, and rounded to 8 bits: there is no photon-transfer curve to be found.
        assert all(curve.gain is None for curve in made.noise)
