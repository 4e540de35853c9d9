"""The description of a data set: of its images each, in any number of threads, and of real ones as they are known.

Noise is found where images are flat, and where they are not, it is said or overstated, never understated.

Lights in their plane, and how far two sets of them are apart.

The numbers of an image are what can be reckoned by hand, and do not depend on light, unit or size.

Cells are means over usable pixels with the light divided out, whatever the size, and however it is cut.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import open_scenes
from evaluation.experiments.describing.description import (
    LEVELS,
    Cells,
    describe,
    energy_distance,
    figures,
    light_distribution,
    measure_blocks,
    measure_scene,
    photon_transfer,
    read_statistics,
    reduce_scene,
    relative_noise,
    statistics_to_json,
)
from evaluation.scene import SceneSet
from foundation.errors import FormatError, InputError
from generator.statistics import log_chroma
from tests.data_files import available
from tests.evaluation.experiments.describing.scenes import Made, MadeMixture, made_set, random_set


def blocks_of(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return measure_blocks(image, limit=10_000)


def test_white_noise_on_a_plane() -> None:
    random = np.random.default_rng(0)
    y, x = (np.broadcast_to(side, (400, 400)) for side in (np.arange(400.0)[:, None], np.arange(400.0)))
    plane: npt.NDArray[np.float64] = (1000 + 0.5 * x + 0.25 * y)[..., None] * [0.5, 1, 0.8]
    blocks = blocks_of(plane + random.normal(0, 10, plane.shape))
    assert blocks.shape == (2500, 2, 3)
    np.testing.assert_allclose(np.sqrt((blocks[:, 1] ** 2).mean(axis=0)), 10, rtol=0.02)
    assert np.median(blocks[:, 0, 1]) == pytest.approx(1150, rel=0.01)
    level = plane * 0 + 1000 + random.normal(0, 10, plane.shape)
    assert relative_noise(blocks_of(level), 100) == pytest.approx(0.01, rel=0.03)


def test_objects_on_most_of_an_image_do_not_count() -> None:
    random = np.random.default_rng(1)
    image = np.full((400, 400, 3), 1000.0)
    image[:200] = np.kron(random.uniform(500, 1500, (40, 80, 1)), np.ones((5, 5, 3)))
    image += random.normal(0, 10, image.shape)
    assert relative_noise(blocks_of(image), 100) == pytest.approx(0.01, rel=0.15)


def test_texture_all_over_overstates_and_averaging_understates() -> None:
    random = np.random.default_rng(2)
    noise = random.normal(0, 10, (400, 400, 3))
    texture = 1000 + noise + 100 * random.random((400, 400, 1))
    assert relative_noise(blocks_of(texture), 100) > 0.02
    averaged = 1000 + (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + np.roll(noise, (1, 1), (0, 1))) / 4
    # Four pixels averaged have a noise of .5 %; the Laplacian sees less than half of what neighbours share.
    assert relative_noise(blocks_of(averaged), 100) < 0.0025


def test_blocks_hold_usable_pixels_only_and_lie_all_over() -> None:
    image = np.ones((64, 96, 3)) * np.arange(96)[None, :, None]
    mask = np.zeros((64, 96), bool)
    mask[20, 30] = True
    blocks = measure_blocks(image, None, mask)
    assert len(blocks) == 8 * 12 - 1
    # The block with that pixel is in columns 24 to 31, whose mean is 27.5: one of eight is missing.
    assert [(blocks[:, 0, 0] == 8 * column + 3.5).sum() for column in range(12)] == [8, 8, 8, 7, *[8] * 8]
    assert len(measure_blocks(image, 88.0)) == 8 * 11
    few = measure_blocks(np.ones((800, 800, 3)), limit=256)
    assert 150 < len(few) <= 256
    assert measure_blocks(image, None, np.ones_like(mask)).shape == (0, 2, 3)
    assert measure_blocks(image[:7]).shape == (0, 2, 3)
    assert np.isnan(relative_noise(few[:9], 0))
    assert np.isnan(relative_noise(few, 2))


def sensor(read: float, gain: float, seed: int, images: int = 24) -> list[npt.NDArray[np.float64]]:
    """Return the blocks of images of flat patches, as a sensor of that noise would take them."""
    random = np.random.default_rng(seed)
    taken: list[npt.NDArray[np.float64]] = []
    for _ in range(images):
        patches = np.kron(np.exp(random.uniform(np.log(0.005), 0, (8, 8, 1))), np.ones((16, 16, 3)))
        noise = np.sqrt(read**2 + gain * patches) * random.normal(size=patches.shape)
        taken.append(blocks_of(patches + noise))
    return taken


@pytest.mark.parametrize(("read", "gain"), [(0.002, 2e-4), (0.0, 1e-3), (0.004, 0.0)])
def test_photon_transfer(read: float, gain: float) -> None:
    for curve in photon_transfer(sensor(read, gain, 3)):
        assert curve.read is not None
        assert curve.gain is not None
        signal = np.array([0.01, 0.1, 0.8])
        fitted = curve.read**2 + curve.gain * signal
        np.testing.assert_allclose(np.sqrt(fitted), np.sqrt(read**2 + gain * signal), rtol=0.06)
        assert curve.misfit is not None
        assert curve.misfit < 0.06


def test_levels_are_of_the_flattest_tenth_of_the_blocks_of_each() -> None:
    random = np.random.default_rng(5)
    signal, sigma = np.exp(random.uniform(-4, 0, 400)), random.uniform(1, 2, 400)
    blocks = np.repeat(np.stack([signal, sigma], axis=1)[..., None], 3, axis=2)
    least, most = (float(np.percentile(signal, share)) for share in (0.5, 99.5))
    edges = np.geomspace(least, most, 13)
    edges[[0, -1]] = 0, np.inf
    expected: list[tuple[float, float, int]] = []
    for low, high in pairwise(edges):
        inside = (signal >= low) & (signal < high)
        limit = np.percentile(sigma[inside], 10)
        if (count := int(inside.sum())) >= 30:
            # The flattest tenth of blocks of white noise shows .7325 of its deviation.
            expected.append((float(signal[inside & (sigma <= limit)].mean()), float(limit / 0.7325), count))
    assert 4 < len(expected) < 12
    found = photon_transfer([blocks])[0].levels
    np.testing.assert_allclose([(level.signal, level.sigma, level.blocks) for level in found], expected)


def test_no_curve_is_fitted_where_there_is_none() -> None:
    random = np.random.default_rng(4)
    # Noise that falls with the signal, as texture in the shadows or a tone curve leaves it.
    odd: list[npt.NDArray[np.float64]] = []
    for _ in range(24):
        patches = np.kron(np.exp(random.uniform(np.log(0.005), 0, (8, 8, 1))), np.ones((16, 16, 3)))
        odd.append(blocks_of(patches + 2e-4 / patches * random.normal(size=patches.shape)))
    curve = photon_transfer(odd)[1]
    assert curve.read is curve.gain is None
    assert curve.misfit is not None
    assert curve.misfit > 0.25
    flat = [blocks_of(0.5 + 0.01 * random.normal(size=(64, 64, 3))) for _ in range(20)]
    alone = photon_transfer(flat)[1]
    assert alone.gain is alone.misfit is None
    assert [curve.levels for curve in photon_transfer([])] == [(), (), ()]


def levels(signals: list[float], sigmas: list[float], blocks: int = 40) -> list[npt.NDArray[np.float64]]:
    """Return the blocks of levels of signal that show a noise each, the same in all of them."""
    given = np.repeat(np.stack([signals, np.multiply(sigmas, 0.7325)], axis=1), blocks, axis=0)
    return [np.repeat(given[..., None], 3, axis=2)]


def test_a_curve_is_of_four_levels_of_thirty_blocks_that_span_a_factor_of_four() -> None:
    signals = [1.0, 1.6, 2.5, 4.0]
    for given, blocks, is_fitted in (
        (signals, 40, True),
        (signals, 30, True),
        (signals, 29, False),
        ([1.0, 2.5, 6.0], 40, False),
        ([1.0, 1.6, 2.5, 3.99], 40, False),
    ):
        curve = photon_transfer(levels(given, list(np.sqrt(0.04 + 0.01 * np.array(given))), blocks))[0]
        assert (curve.gain is not None) == is_fitted, (given, blocks)
        if is_fitted:
            assert (curve.read, curve.gain, curve.misfit) == pytest.approx((0.2, 0.01, 0), abs=1e-9)
            assert [level.blocks for level in curve.levels] == [blocks] * 4


def test_a_curve_holds_where_it_is_off_by_a_quarter_at_most() -> None:
    off = np.array([1, -1, -1, 1, 1, -1, -1, 1])
    misfits: dict[bool, list[float]] = {True: [], False: []}
    for part in np.linspace(0.15, 0.35, 41):
        curve = photon_transfer(levels(list(np.geomspace(1, 10, 8)), list(0.1 * np.exp(part * off))))[1]
        assert curve.misfit is not None
        misfits[curve.gain is not None].append(curve.misfit)
    assert 0.24 < max(misfits[True]) <= 0.25 < min(misfits[False]) < 0.26


def test_the_noise_of_an_image_is_of_ten_blocks_brighter_than_the_least() -> None:
    (blocks,) = levels([1.0, 2.0], [0.03, 0.02], 10)
    assert relative_noise(blocks, 1.0) == pytest.approx(0.01)
    assert np.isnan(relative_noise(blocks[:-1], 1.0))
    # In an image it is told by what is brighter than a tenth of its 99th percentile.
    random = np.random.default_rng(6)
    image = np.repeat(np.repeat([[0.099, 1.0]], 80, axis=0), 40, axis=1)[..., None] * np.ones(3)
    image[:, 40:] += 0.02 * random.normal(size=(80, 40, 3))
    assert measure_scene(Made("a", np.ones(3), image, 10.0)).values["noise"] == pytest.approx(0.02, rel=0.15)
    image[:, :40] = 0.15
    assert measure_scene(Made("a", np.ones(3), image, 10.0)).values["noise"] < 1e-9


def lights_at(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return lights whose ln(R/G) and ln(B/G) are given."""
    return np.exp(np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)) * 5


def test_a_rectangle() -> None:
    corners = np.array([[0, 0], [3, 0], [3, 1], [0, 1.0]]) @ np.array([[0.6, -0.8], [0.8, 0.6]])
    found = light_distribution(lights_at(corners))
    np.testing.assert_allclose(log_chroma(lights_at(corners)), corners, atol=1e-12)
    assert found.hull_area == pytest.approx(3)
    assert (found.along, found.across) == pytest.approx((1.5, 0.5))
    assert found.axis_deg == pytest.approx(np.degrees(np.arctan2(-0.8, 0.6)))
    assert found.mean == pytest.approx(tuple(corners.mean(axis=0)))
    np.testing.assert_allclose(found.covariance, np.cov(corners.T, bias=True)[[0, 0, 1], [0, 1, 1]])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_lights_on_a_line_have_no_area(count: int) -> None:
    found = light_distribution(lights_at(np.outer(np.arange(float(count)), np.array([0.1, -0.1]))))
    assert found.hull_area == 0
    assert found.across == pytest.approx(0, abs=1e-7)


def test_energy_distance_of_normals() -> None:
    random = np.random.default_rng(0)
    # For points a and b on a line, 2|a - b| against nothing within: the whole of it.
    assert energy_distance([[0.0]] * 4, [[2.0]] * 3)[0] == pytest.approx(1)
    # N(0, 1) and N(m, 1): E|X - Y| of normals with deviation √2; E|X - X'| = 2/√π.
    one, other = random.normal(0, 1, (900, 1)), random.normal(1, 1, (900, 1))
    apart = 2 / np.sqrt(np.pi) * np.exp(-1 / 4) + 0.5204999  # m erf(m / 2), m = 1
    share, p = energy_distance(one, other)
    assert share == pytest.approx(1 - 2 / np.sqrt(np.pi) / apart, rel=0.15)
    assert p == pytest.approx(1 / 200)


def test_false_alarms_of_the_permutation_test() -> None:
    random = np.random.default_rng(1)
    found = [energy_distance(*random.normal(0, 1, (2, 25, 2)))[1] for _ in range(150)]
    assert np.mean(np.array(found) <= 0.1) == pytest.approx(0.1, abs=0.075)
    assert 0.3 < np.mean(found) < 0.7


def test_many_lights_are_thinned() -> None:
    random = np.random.default_rng(2)
    share, p = energy_distance(random.normal(0, 1, (3000, 2)), random.normal(0, 1, (1500, 2)))
    assert share < 0.01
    assert p > 0.01


LIGHT = np.array([0.5, 1.0, 0.75])


def numbers(reflectances: npt.NDArray[np.float64], light: npt.NDArray[np.float64] = LIGHT) -> dict[str, float]:
    return dict(measure_scene(Made("a", light, reflectances * light)).values)


def test_two_colours_by_hand() -> None:
    image = np.empty((32, 32, 3))
    image[:, :16] = 0.5
    image[:, 16:] = [0.6, 0.3, 0.1]
    found = numbers(image)
    # Chromaticities 1/3 each, and .6 .3 .1: half of each difference is the standard deviation.
    half = np.array([0.6 - 1 / 3, 1 / 3 - 0.3, 1 / 3 - 0.1]) / 2
    assert found["chroma_spread"] == pytest.approx(np.sqrt((half**2).mean()))
    assert found["log_red_spread"] == pytest.approx(np.log(2) / 2)
    assert found["log_blue_spread"] == pytest.approx(np.log(3) / 2)
    assert found["grey_red"] == pytest.approx(np.log(0.55 / 0.4))
    assert found["grey_blue"] == pytest.approx(np.log(0.3 / 0.4))
    assert found["near_grey"] == 0.5
    # Luminance is .5 and 1/3; one step in 31 side by side, none in 31 above one another.
    assert found["luminance_25"] == pytest.approx(2 / 3)
    assert found["luminance_75"] == pytest.approx(1)
    assert found["edges"] == pytest.approx(np.log(1.5) / 62)
    assert found["edges_95"] == 0
    assert np.isnan([found["exposure"], found["clipped"]]).all()


def test_luminance_percentiles_of_a_ramp() -> None:
    ramp = np.repeat(np.linspace(0, 1, 4096).astype(np.float64), 3).reshape(64, 64, 3)
    found = numbers(ramp)
    for percent in (1, 5, 25, 50, 75, 95):
        assert found[f"luminance_{percent}"] == pytest.approx(percent / 99, abs=0.001)


def test_light_unit_and_size_do_not_matter() -> None:
    image = np.exp(np.random.default_rng(1).normal(-2, 0.7, (64, 64, 3)))
    first = numbers(image)
    repeated = np.repeat(np.repeat(image, 5, axis=0), 3, axis=1)
    larger = numbers(repeated * 1000, np.array([3.0, 1, 7]))
    for name in first.keys() - {"noise", "exposure", "clipped"}:
        assert larger[name] == pytest.approx(first[name]), name


def test_exposure_and_clipping_leave_masked_pixels_out() -> None:
    image = np.full((50, 40, 3), 200, np.uint16)
    image[:10] = [100, 4000, 100]
    image[10:20, :20] = [100, 900, 100]
    mask = np.zeros((50, 40), bool)
    mask[:5] = True
    found = measure_scene(Made("a", LIGHT, image, 1000.0, mask))
    assert found.values["clipped"] == pytest.approx(200 / 1800)
    assert found.values["exposure"] > 0.99
    assert found.masked == pytest.approx(0.1)
    assert found.size == (40, 50)
    mask[:10] = True
    found = measure_scene(Made("a", LIGHT, image, 1000.0, mask))
    assert found.values["clipped"] == 0
    assert found.values["exposure"] == pytest.approx(0.9, abs=0.001)


@pytest.mark.parametrize("image", [np.zeros((20, 20, 3)), np.full((20, 20, 3), 50.0)])
def test_nothing_to_measure_is_not_a_number(image: npt.NDArray[np.float64]) -> None:
    found = measure_scene(Made("a", LIGHT, image, 40.0))
    assert np.isnan([found.values[name] for name in ("chroma_spread", "luminance_50", "edges", "noise")]).all()
    assert found.chroma.sum() == 0
    np.testing.assert_allclose(found.lights, [LIGHT / LIGHT.sum()])


def test_all_lights_of_a_mixture_are_kept() -> None:
    lights = np.array([[0.6, 1.0, 0.3], [0.3, 1.0, 0.8]])
    found = measure_scene(MadeMixture("m", lights.mean(axis=0), np.ones((20, 20, 3)), lights=lights))
    np.testing.assert_allclose(found.lights, lights / lights.sum(axis=1, keepdims=True))


def reduced(scene: Made, side: int = 64) -> Cells:
    return reduce_scene(scene, scene.image, scene.mask, side)


def by_loop(image: npt.NDArray[np.float64], usable: npt.NDArray[np.bool_], side: int) -> npt.NDArray[np.float64]:
    """Return cells the slow way."""
    height, width = usable.shape
    result = np.full((side, side, 3), np.nan)
    for row in range(side):
        for column in range(side):
            place = (
                slice(row * height // side, (row + 1) * height // side),
                slice(column * width // side, (column + 1) * width // side),
            )
            if usable[place].mean() >= 0.5:
                result[row, column] = image[place][usable[place]].mean(axis=0)
    return result


@pytest.mark.parametrize("band", [1, 700, 1 << 18])
def test_means_of_usable_pixels(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.experiments.describing.description._BAND_PIXELS", band)
    random = np.random.default_rng(1)
    image = random.uniform(0, 1000, (45, 71, 3)) * LIGHT
    mask = random.random((45, 71)) < 0.3
    mask[:9, :12] = True
    found = reduced(Made("a", 3 * LIGHT, image, 900.0, mask), 8)
    clipped = (image >= 900).any(axis=2) & ~mask
    expected = by_loop(image / LIGHT * LIGHT.mean(), ~mask & ~clipped, 8)
    assert np.isnan(expected[0, 0]).all()
    np.testing.assert_allclose(found.colours, expected, rtol=1e-12)
    assert (found.pixels, found.masked, found.clipped) == (45 * 71, mask.sum(), clipped.sum())
    counted = np.clip(image.max(axis=2)[~mask] / 900 * LEVELS, 0, LEVELS - 1).astype(int)
    np.testing.assert_array_equal(found.levels, np.bincount(counted, minlength=LEVELS))


def test_what_is_not_finite_is_not_used() -> None:
    image = np.ones((4, 4, 3)) * LIGHT
    image[0, 0, 1] = np.nan
    found = reduced(Made("a", LIGHT, image))
    assert np.isnan(found.colours[0, 0]).all()
    assert np.isfinite(found.colours).sum() == 45
    assert found.masked == 1
    assert not found.levels.size


def test_small_images_keep_their_pixels_and_side_zero_keeps_all() -> None:
    image = np.random.default_rng(2).uniform(1, 2, (100, 5, 3))
    assert reduced(Made("a", LIGHT, image)).colours.shape == (64, 5, 3)
    whole = reduced(Made("a", LIGHT, image), 0).colours
    np.testing.assert_allclose(whole, image / LIGHT * LIGHT.mean())


@pytest.mark.parametrize("band", [1, 1 << 18])
def test_each_pixel_of_a_mixture_is_divided_by_its_own_light(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.experiments.describing.description._BAND_PIXELS", band)
    lights = np.array([[0.6, 1.0, 0.3], [0.3, 1.0, 0.8]])
    image = np.repeat(lights, 40, axis=0) * np.full((50, 1, 1), 100.0)
    scene = MadeMixture("m", lights.mean(axis=0), image, lights=lights)
    colours = reduced(scene, 10).colours
    np.testing.assert_allclose(colours / colours[..., 1:2], 1, rtol=1e-6)
    # By the mean light, the halves would be orange and blue.
    wrong = reduced(Made("m", scene.truth, image), 10).colours
    assert np.ptp(wrong[..., 0] / wrong[..., 1]) > 0.5


@pytest.mark.parametrize("truth", [[0, 1, 1], [1, np.nan, 1], [-1, 1, 1]])
def test_a_light_that_cannot_be_divided_by_is_named(truth: list[float]) -> None:
    with pytest.raises(FormatError, match=r"ground truth of dark\.png"):
        reduced(Made("dark.png", np.array(truth, dtype=float), np.ones((4, 4, 3))))


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


def test_a_data_set_without_an_image_is_refused() -> None:
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


def test_a_light_below_0_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    path.write_text(statistics_to_json(describe(random_set("a", 3))).replace('"lights": [[0.', '"lights": [[-0.'))
    with pytest.raises(FormatError, match="all above 0"):
        read_statistics(path)


REAL = available("benchmark/nus_canon_600d_64x64.npz")
CHROMA_SPREAD = 0.0623
"""That of those thumbnails."""


@pytest.fixture(params=["made", *REAL], ids=lambda path: Path(path).stem)
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
    if thumbnails in REAL:
        assert value["chroma_spread"] == pytest.approx(CHROMA_SPREAD, abs=0.0001)
        # Averaged, and rounded to 8 bits: there is no photon-transfer curve to be found.
        assert all(curve.gain is None for curve in made.noise)
