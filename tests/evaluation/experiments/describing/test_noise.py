"""Noise is found where images are flat, and where they are not, it is said or overstated, never understated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.describing.description import measure_blocks, photon_transfer, relative_noise


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
