"""Training crops: each item depends only on its number, not on batches or threads."""

from __future__ import annotations

import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from foundation.errors import FormatError, InputError
from generator.lights.lighting import Mixture
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Picture
from generator.rendering import Rendering
from generator.rendering.black_points import BlackPoint, black_subtraction
from generator.rendering.colorimetric import ColorimetricRendering
from generator.rendering.matrices import ColourMatrix
from generator.training.crops import KEPT_BLOCKS, Crops, RecycledMemory
from generator.training.gallery import Gallery, gallery_of, open_gallery, save_gallery
from generator.variation.iso_speed import parse_iso
from generator.variation.sensor_noise import SensorNoise
from tests.generator.conftest import MakeLut
from tests.generator.dataset.known import table_in
from tests.generator.rendering.prints import MATRIX as PRINT_MATRIX
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


SHAPE = (4, 3, 32, 32)


def address_of(array: npt.NDArray[np.float32]) -> int:
    return int(array.__array_interface__["data"][0])


def test_reuses_released_memory() -> None:
    recycled = RecycledMemory()
    first = recycled.array(SHAPE)
    assert first.shape == SHAPE
    assert first.dtype == np.float32
    assert first.flags.c_contiguous
    assert first.flags.writeable
    address = address_of(first)
    del first
    assert address_of(recycled.array(SHAPE)) == address


def test_keeps_memory_with_views() -> None:
    recycled = RecycledMemory()
    whole = recycled.array(SHAPE)
    whole[...] = 7
    views = [whole[1:, 0], whole.reshape(-1)[::5], whole[2].T]
    buffer = memoryview(whole[3])
    address = address_of(whole)
    del whole
    for _ in range(2 * KEPT_BLOCKS):
        array = recycled.array(SHAPE)
        assert address_of(array) != address
        array[...] = 1
    assert all((view == 7).all() for view in views)
    assert np.asarray(buffer).min() == 7


def test_reuses_memory_of_equal_size_only() -> None:
    recycled = RecycledMemory()
    for shape in ((1, 3, 8, 8), (7, 3, 32, 32), SHAPE):
        array = recycled.array(shape)
        array[...] = 3
        assert array.shape == shape


def test_threads_do_not_share_memory() -> None:
    recycled = RecycledMemory()
    failed_threads: list[int] = []

    def work(number: int) -> None:
        for _ in range(200):
            array = recycled.array(SHAPE)
            array[...] = number
            if not (array == number).all():
                failed_threads.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed_threads


BITS = 2

MATRIX = ColourMatrix("mine", np.array([[0.6, 0.3, 0.1], [0.1, 0.7, 0.2], [0.05, 0.25, 0.7]]), "a test")


def ramp(height: int, width: int) -> Picture:
    """Return a picture with every colour of a LUT of 2 bits per channel, many times."""
    rows, columns = np.mgrid[:height, :width]
    return (np.stack([columns, rows, rows + columns], axis=-1) % 4 * 64).astype(np.uint8)


@pytest.fixture
def gallery() -> Gallery:
    return gallery_of([ramp(40, 50), np.full((9, 8, 3), 200, np.uint8)], ["ramp", "plain"])


def test_values_are_samples_of_their_colour_and_light(make_lut: MakeLut, gallery: Gallery) -> None:
    lut = make_lut(bits=BITS)
    batch = Crops(lut, gallery, (7, 8), flip=False, length=300, rendering="codes").batch(np.arange(300))
    assert batch.images.shape == (300, 3, 7, 8)
    assert batch.images.dtype == np.float32
    assert set(batch.lights.tolist()) == set(range(4))
    assert set(batch.pictures.tolist()) == {0, 1}
    for image, light, picture in zip(batch.images, batch.lights, batch.pictures, strict=True):
        if picture == 1:
            code = 200 >> 6
            colour = code << 4 | code << 2 | code
            expected = lut.samples[light, colour].astype(np.float32) * np.float32(1 / lut.provenance.white_level)
            assert (image.reshape(3, -1).T[:, None] == expected[None]).all(axis=2).any(axis=1).all()
    np.testing.assert_allclose(batch.illuminants, lut.ground_truth[batch.lights], rtol=1e-6)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.permutations(list(range(24))), cut=st.integers(1, 23))
def test_items_are_independent_of_batches(
    sample: tuple[Crops, np.ndarray[tuple[int, ...], np.dtype[np.float32]]], order: list[int], cut: int
) -> None:
    crops, images = sample
    for items in (order[:cut], order[cut:]):
        np.testing.assert_array_equal(crops.batch(items).images, images[items])


@pytest.fixture
def sample(make_lut: MakeLut, gallery: Gallery) -> tuple[Crops, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    crops = Crops(make_lut(bits=BITS), gallery, (5, 6), length=24, exposure=(0.5, 2.0), seed=11)
    return crops, crops.batch(np.arange(24)).images


def test_pickled_copy_is_equal_and_small(make_lut: MakeLut, gallery: Gallery) -> None:
    crops = Crops(make_lut(bits=3), gallery, (5, 6), lights=[1, Mixture((0, 2), (0.5, 0.5))], length=50, seed=3)
    stored = pickle.dumps(crops)
    assert len(stored) < gallery.codes.size + 4000
    again = pickle.loads(stored)
    np.testing.assert_array_equal(again.batch(np.arange(50)).images, crops.batch(np.arange(50)).images)


def test_seeds_and_epochs_differ(make_lut: MakeLut, gallery: Gallery) -> None:
    lut = make_lut(bits=BITS)
    first = Crops(lut, gallery, (6, 6), length=40).batch(np.arange(40))
    same = Crops(lut, gallery, (6, 6), length=40, threads=3).batch(np.arange(40))
    np.testing.assert_array_equal(first.images, same.images)
    for other in (Crops(lut, gallery, (6, 6), length=40, seed=1), Crops(lut, gallery, (6, 6), length=40, epoch=1)):
        assert (other.batch(np.arange(40)).images != first.images).any(axis=(1, 2, 3)).sum() >= 39
    moved = Crops(lut, gallery, (6, 6), length=40)
    moved.set_epoch(1)
    np.testing.assert_array_equal(
        moved.batch([3]).images, Crops(lut, gallery, (6, 6), length=40, epoch=1).batch([3]).images
    )


@pytest.mark.parametrize("rendering", get_args(Rendering))
def test_fills_given_memory(make_lut: MakeLut, gallery: Gallery, rendering: Rendering) -> None:
    crops = Crops(make_lut(bits=BITS), gallery, (5, 6), length=40, threads=2, rendering=rendering)
    memory = np.full((12, 3, 5, 6), np.nan, np.float32)
    batch = crops.batch(np.arange(9, 20), out=memory[1:])
    assert np.shares_memory(batch.images, memory)
    np.testing.assert_array_equal(memory[1:], crops.batch(np.arange(9, 20)).images)
    assert np.isnan(memory[0]).all()
    with pytest.raises(InputError):
        crops.batch(np.arange(9, 20), out=memory)


def test_choices_are_uniform(make_lut: MakeLut) -> None:
    gallery = gallery_of([ramp(12, 13)] * 5)
    count = 3000
    crops = Crops(make_lut(bits=BITS), gallery, (4, 4), length=count, exposure=(0.25, 1.0), seed=7)
    batch = crops.batch(np.arange(count))
    for drawn, kinds in ((batch.lights, 4), (batch.pictures, 5)):
        expected = count / kinds
        # Chi-square with 4 degrees of freedom at most: above 28 by chance once in 80 000.
        assert ((np.bincount(drawn, minlength=kinds) - expected) ** 2 / expected).sum() < 28
    # The gain is uniform over two stops, mean 1 stop: its error is 2 / sqrt(12 · 3000) = 0.0105 stops.
    means = np.log2(batch.images.mean(axis=(1, 2, 3)))
    bright = np.log2(Crops(make_lut(bits=BITS, name="again"), gallery, (4, 4), length=count, seed=7)
                     .batch(np.arange(count)).images.mean(axis=(1, 2, 3)))  # fmt: skip
    assert abs((means - bright).mean() + 1.0) < 6 * 0.0105
    assert np.ptp(means - bright) == pytest.approx(2.0, abs=0.02)


def test_mirrors_half_of_the_items(make_lut: MakeLut) -> None:
    lut = make_lut(bits=BITS)
    gallery = gallery_of([ramp(6, 6)])
    plain = Crops(lut, gallery, (6, 6), length=200, flip=False).batch(np.arange(200)).images
    mixed = Crops(lut, gallery, (6, 6), length=200).batch(np.arange(200)).images
    mirrored = (mixed == plain[..., ::-1]).all(axis=(1, 2, 3))
    same = (mixed == plain).all(axis=(1, 2, 3))
    assert (mirrored ^ same).all()
    # Of 200 fair coins fewer than 50 or more than 150 heads: below 1e-12.
    assert 50 < mirrored.sum() < 150


def test_refuses_unknown_items(make_lut: MakeLut, gallery: Gallery) -> None:
    crops = Crops(make_lut(bits=BITS), gallery, (4, 4), length=3)
    assert crops[2][0].shape == (3, 4, 4)
    with pytest.raises(IndexError):
        crops[3]


def test_saved_gallery_holds_the_pictures(tmp_path: Path) -> None:
    sources = random_scenes(3, 9, 7)
    gallery = save_gallery(sources, tmp_path / "gallery")
    assert gallery.names == ("random-000000", "random-000001", "random-000002")
    for number, source in enumerate(sources):
        np.testing.assert_array_equal(gallery.picture(number), source.read().picture)
    again = pickle.loads(pickle.dumps(gallery))
    np.testing.assert_array_equal(again.codes, gallery.codes)
    with pytest.raises(InputError):
        save_gallery(sources, tmp_path / "gallery")
    np.testing.assert_array_equal(open_gallery(str(tmp_path / "gallery")).codes, gallery.codes)
    with pytest.raises(InputError, match=r"1 pictures .*2 names"):
        gallery_of([sources[0].read().picture], ["one", "two"])
    (tmp_path / "gallery" / "codes.u8").write_bytes(b"short")
    with pytest.raises(FormatError):
        open_gallery(tmp_path / "gallery")
    with pytest.raises(FormatError):
        open_gallery(tmp_path)


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None
import generator.dataset.making, generator.kernels.rendering
from generator.training import Crops
try:
    from generator.training.torch_crops import CropDataset
except ImportError as error:
    print(error)
"""


def test_reports_missing_pytorch() -> None:
    process = subprocess.run([sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, check=False)
    assert (process.stdout, process.stderr) == (
        "PyTorch is not installed, training batches need it; run pip install torch\n",
        "",
    )


def test_colorimetric_crops_subtract_black_like_images(make_lut: MakeLut, gallery: Gallery) -> None:
    lut = make_lut(bits=BITS)
    black_point = BlackPoint("random")
    options: dict[str, Any] = {"lights": [1, 3], "length": 30, "seed": 8, "matrix": MATRIX}
    crops = Crops(lut, gallery, (7, 8), rendering="colorimetric", black_point=black_point, **options)
    batch = crops.batch(np.arange(30))
    kept = Crops(lut, gallery, (7, 8), rendering="colorimetric", **options).batch(np.arange(30))
    by_codes = Crops(lut, gallery, (7, 8), lights=[1, 3], length=30, seed=8, rendering="codes").batch(np.arange(30))
    np.testing.assert_array_equal(batch.illuminants, by_codes.illuminants)
    np.testing.assert_array_equal(batch.lights, by_codes.lights)
    assert (kept.images != by_codes.images).mean() > 0.5
    assert not kept.black_taken.any()
    assert 0 < batch.black_taken.min() < batch.black_taken.max() < 0.97
    level = lut.provenance.white_level
    for image, plain, light, share in zip(batch.images, kept.images, batch.lights, batch.black_taken, strict=True):
        mixture = crops.lights[int(light)]
        grey = ColorimetricRendering(lut, MATRIX).black(mixture)
        black = black_subtraction(lut, mixture, float(share), grey)
        expected = (plain.astype(float) * level - black.counts[:, None, None]) * black.stretch[:, None, None] / level
        np.testing.assert_allclose(image, expected, atol=2e-6)
    again = pickle.loads(pickle.dumps(crops)).batch(np.arange(30))
    np.testing.assert_array_equal(again.images, batch.images)
    for items in ([29, 3], [3]):
        np.testing.assert_array_equal(crops.batch(items).images, batch.images[items])


def test_refuses_invalid_renderings(make_lut: MakeLut, gallery: Gallery) -> None:
    lut = make_lut(bits=BITS)
    with pytest.raises(InputError, match="'inks'"):
        Crops(lut, gallery, (5, 6), rendering="inks")  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(InputError):
        Crops(lut, gallery, (5, 6), rendering="codes", matrix=MATRIX)


def test_workers_import_no_heavy_libraries() -> None:
    """A spawned worker imports everything again, so OpenCV and SciPy must not be loaded."""
    program = "import sys, generator.training.crops, generator.rendering.colorimetric; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "generator.training.crops" in loaded
    assert not {"cv2", "numba", "scipy", "experiment.framing.pictures"}.intersection(loaded)


CAMERA = ColourMatrix("mine", PRINT_MATRIX, "a test")

NOISE = SensorNoise(read=(6.0, 4.0, 3.5), shot=(0.5, 0.25, 0.75))

MIXED = (Mixture((0, 3), (0.3, 0.7)), 2, "E", "4000K")

CASES: dict[str, dict[str, Any]] = {
    "codes": {"rendering": "codes", "exposure": (0.25, 2.0)},
    "codes of mixtures, black taken out": {"rendering": "codes", "lights": MIXED, "black_point": "random:.9"},
    "codes with noise": {"rendering": "codes", "exposure": (0.1, 8.0), "noise": NOISE, "flip": False, "threads": 3},
    "colours": {"matrix": CAMERA, "lights": [4, 1]},
    "colours without black": {"matrix": CAMERA, "black_point": "compensate", "lights": MIXED, "threads": 2},
    "colours with speed": {"matrix": CAMERA, "noise": NOISE, "iso": parse_iso("1600/100"), "black_point": "random"},
}


def pictures() -> list[npt.NDArray[np.uint8]]:
    """Return pictures of different sizes, the last as large as a crop."""
    return [scene.read().picture for scene in random_scenes(3, 41, 23, 5)] + [
        random_scenes(1, 9, 7, 6)[0].read().picture
    ]


@pytest.mark.parametrize("name", CASES)
def test_items(name: str, tmp_path: Path, pinned: Pinned) -> None:
    gallery = gallery_of(pictures(), ["a", "b", "c", "d"])
    pins: list[Any] = []
    for size, seed, epoch in (((7, 9), 2**63 + 1, 0), ((1, 1), 3, 2**32 - 1), ((5, 8), 4, 7)):
        crops = Crops(
            table_in(tmp_path / f"lut{seed}"), gallery, size, length=1000, seed=seed, epoch=epoch, **CASES[name]
        )
        batch = crops.batch([0, 999, 500, 3, 3, 77])
        pins += [vars(batch), batch.images[0, :, 0, 0], len(crops)]
        crops.set_epoch(1)
        image, light = crops[12]
        pins.append([image, light])
    pinned(f"training items, {name}", pins)
