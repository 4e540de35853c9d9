"""Raw samples at the right positions, detection of nonuniform patches, and window sizes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import integrate, stats

from calibration.radiometry.table_noise import noise_curve
from calibration.report.plots import half_size
from calibration.sampling import (
    WINDOWS,
    bleed,
    gather,
    gather_means,
    gather_values,
    has_dead_photosite,
    largest_window,
    mean_bleed,
    median_of_variance,
    noise_levels,
    patch_means,
    photon_transfer,
    sample_noise,
    sites_at,
    table_values,
    unevenness,
)
from drivers.raw.rawfile import frame_black
from foundation.errors import InputError
from tests.calibration.lab import Lab


@pytest.mark.slow
def test_samples_are_half_size_pixels(lab: Lab, tmp_path: Path) -> None:
    mosaic = lab.mosaic(tmp_path)
    black = frame_black(mosaic)
    picture = half_size(mosaic)
    height, width = picture.shape[:2]
    places = np.random.default_rng(1).random((200, 2)) * (width - 1, height - 1)
    sites = sites_at(places, (height, width))
    samples, highest = gather(mosaic, black, sites)
    for patch, (x, y) in enumerate(places):
        column, row = round(float(x)), round(float(y))
        if not (2 <= column < width - 2 and 2 <= row < height - 2):
            assert not sites.inside[patch]
            assert not samples[patch].any()
            continue
        window = picture[row - 2 : row + 3, column - 2 : column + 3].reshape(25, 3)
        assert samples[patch] == pytest.approx(window, abs=2e-3)
        raw = mosaic.counts[2 * (row - 2) : 2 * (row + 3), 2 * (column - 2) : 2 * (column + 3)]
        assert highest[patch] == raw.max()


@given(st.floats(-10, 60), st.floats(-10, 60))
@example(2, 2)
@example(47, 37)
@example(1, 20)
@example(20, 1)
@example(48, 20)
@example(20, 38)
def test_patch_is_inside_with_all_pixels(x: float, y: float) -> None:
    sites = sites_at(np.array([[x, y]]), (40, 50))
    column, row = int(np.rint(x)), int(np.rint(y))
    assert bool(sites.inside[0]) == (column - 2 >= 0 and row - 2 >= 0 and column + 2 <= 49 and row + 2 <= 39)


def test_table_values_round_and_clip() -> None:
    samples = np.array([[[-3.0, 0.4, 0.6]] * 25, [[100.0, 200.0, 300.0]] * 25], dtype=np.float32)
    values = table_values(samples, np.array([[1.0, 1.0, 1.0], [0.8, 1.0, 1.25]]))
    assert values.dtype == np.uint16
    assert values[0, 0].tolist() == [0, 0, 1]
    assert values[1, 0].tolist() == [125, 200, 240]


@pytest.mark.slow
@pytest.mark.parametrize("window", [3, 5, 7])
def test_one_pass_matches_two(lab: Lab, tmp_path: Path, window: int) -> None:
    mosaic = lab.mosaic(tmp_path)
    black = np.array([[2046.25, 2047.5], [2049.0, 2044.0]])
    random = np.random.default_rng(3)
    height, width = half_size(mosaic).shape[:2]
    sites = sites_at(random.random((300, 2)) * (width - 1, height - 1), (height, width), window)
    field, dark = random.uniform(0.7, 1.3, (300, 3)), random.uniform(0, 40, (300, 3)).astype(np.float32)
    samples, highest = gather(mosaic, black, sites)
    assert samples.shape == (300, window**2, 3)
    values, highest_too = gather_values(mosaic, black, sites, field, dark)
    inside = sites.inside
    assert np.array_equal(values[inside], table_values(samples, field, dark)[inside])
    assert not values[~inside].any()
    assert np.array_equal(highest, highest_too)
    # By NumPy alone, in double precision: equal but where a value lies on the edge between two counts.
    plain = np.rint((samples[inside].astype(np.float64) - dark[inside, None]) / field[inside, None])
    assert np.abs(values[inside] - np.clip(plain, 0, None)).max() <= 1


def patches(level: float, sigma: float, count: int = 3000) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.random.default_rng(2).normal(level, sigma, (count, 25, 3))


def rim(window: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return the samples of a window on its rim."""
    return np.pad(np.zeros((window - 2, window - 2), dtype=np.bool_), 1, constant_values=True).ravel()


def test_detects_rim_of_another_colour() -> None:
    samples = patches(8000, 60)
    samples[7, rim(5), 1] += 400
    result = unevenness(samples, np.full((len(samples), 3), 60.0))
    assert np.flatnonzero(result).tolist() == [7]
    assert result[7] == pytest.approx(400 / (8000 + 400 * 16 / 25), rel=0.15)


def test_ignores_rim_below_one_percent() -> None:
    samples = patches(8000, 1)
    samples[:, rim(5)] += 70
    assert not unevenness(samples, np.full((len(samples), 3), 1.0)).any()


@pytest.mark.parametrize("window", [3, 7, 9])
def test_detects_rim_in_other_windows(window: int) -> None:
    """With 0.4 % noise, a rim 8 % brighter exceeds 5 σ even for the single inner pixel of 3×3."""
    samples = np.random.default_rng(6).normal(8000, 30, (3000, window**2, 3))
    samples[7, rim(window), 1] += 640
    assert np.flatnonzero(unevenness(samples, sample_noise(samples))).tolist() == [7]


def test_noise_is_function_of_level() -> None:
    random = np.random.default_rng(5)
    level = random.uniform(50, 8000, 4000)
    sigma = np.sqrt(36 + level / 1.8)
    samples = level[:, None, None] + sigma[:, None, None] * random.standard_normal((4000, 25, 3))
    ratio = sample_noise(samples) / sigma[:, None]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert np.abs(ratio[level > 500] - 1).max() < 0.15


def test_patch_means_match_numpy() -> None:
    values = np.random.default_rng(4).integers(0, 65536, (50, 25, 3)).astype(np.uint16)
    np.testing.assert_allclose(patch_means(values), values.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(patch_means(values[::3]), values[::3].mean(axis=1), rtol=1e-14)


def test_bleed_matches_arrangement_table() -> None:
    """Rendered pixel by pixel: 8.6 px cells with 0.7 px blur give 1.3 %, with 0.5 px 0.1 %; 10.2 px cells 0.07 %."""
    assert bleed(8.6, 0.7) == pytest.approx(0.013, rel=0.1)
    assert bleed(8.6, 0.5) == pytest.approx(0.001, rel=0.1)
    assert bleed(10.2, 0.7) < 0.0008


def test_largest_windows_match_arrangement_table() -> None:
    """From rendering: 5×5 for the EOS 550D and 7×7 for the 6D Mark II below 0.2 % at a blur of 0.7 px."""
    assert largest_window(10.2, 0.7) == 5
    assert largest_window(12.4, 0.7) == 7
    assert largest_window(4.0, 0.7) == 0
    # 0.3 % of a sample of 5×5 would come from beyond a cell of 9.35 px, 0.17 % beyond one of 9.6 px.
    assert [bleed(cell_px, 0.7) for cell_px in (9.35, 9.6)] == pytest.approx([0.003, 0.0017], abs=1e-4)
    assert [largest_window(cell_px, 0.7) for cell_px in (9.35, 9.6)] == [3, 5]
    assert [bleed(10.2, 0.7, window) for window in WINDOWS] == sorted(bleed(10.2, 0.7, window) for window in WINDOWS)


@pytest.mark.parametrize("window", WINDOWS)
def test_bleed_is_tail_of_gaussian(window: int) -> None:
    cell_px, blur_px = 11.0, 1.4
    # A quarter of a pixel of registration and half of one of rounding towards the nearer edge.
    nearest = cell_px / 2 - (window // 2 + 0.75)
    tail, _ = integrate.quad(stats.norm(0, blur_px).pdf, nearest, 40)
    assert bleed(cell_px, blur_px, window) == pytest.approx(tail, rel=1e-6)
    # Pixel by pixel and along both axes: what is inside along both is the cell's own.
    x = np.arange(window) - window // 2
    inside = stats.norm(x, blur_px).cdf(cell_px / 2) - stats.norm(x, blur_px).cdf(-cell_px / 2)
    expected = 1 - float(np.outer(inside, inside).mean())
    assert mean_bleed(cell_px, np.array([1e-9, blur_px]), window) == pytest.approx([0, expected], abs=1e-12)


def test_detects_dead_photosite() -> None:
    samples = np.full((7, 25, 3), 400.0)
    for patch, (channel, level) in enumerate([(0, 199), (0, 201), (1, 299), (1, 301), (2, 199), (2, 201)]):
        samples[patch, 12, channel] = level
    assert has_dead_photosite(samples).tolist() == [True, False, True, False, True, False, False]
    # Half of 300 counts or less is not told from noise.
    assert not has_dead_photosite(samples * 0.75).any()
    assert has_dead_photosite(samples * 0.76)[0]


def test_level_noise_is_scaled_median() -> None:
    random = np.random.default_rng(7)
    level = random.permutation(np.arange(96.0))
    for degrees in (8, 24, 80):
        assert median_of_variance(degrees) == pytest.approx(stats.chi2(degrees).median() / degrees, rel=2e-3)
    at, seen = noise_levels(level, 2 * level + 1, 25)
    # Sixteen cells a level.
    groups = np.arange(96.0).reshape(6, 16)
    assert at == pytest.approx(np.median(groups, axis=1))
    assert seen == pytest.approx((2 * at + 1) / median_of_variance(24))
    assert [len(noise_levels(level[:n], level[:n], 25)[0]) for n in (96, 79, 48)] == [6, 4, 4]
    many = np.arange(16.0 * 60)
    assert [len(noise_levels(many, many, 25, 1, most)[0]) for most in (48, 32)] == [48, 32]


def test_count_means_match_samples(lab: Lab, tmp_path: Path) -> None:
    mosaic = lab.mosaic(tmp_path)
    # Of each channel another, green's mean too.
    black = np.array([[2046.25, 2047.5], [2049.0, 2044.0]])
    height, width = half_size(mosaic).shape[:2]
    sites = sites_at(np.random.default_rng(8).random((80, 2)) * (width - 1, height - 1), (height, width), 7)
    samples, _ = gather(mosaic, black, sites)
    assert not sites.inside.all()
    np.testing.assert_allclose(gather_means(mosaic, black, sites), samples.mean(axis=1, dtype=np.float64), atol=1e-3)
    # Neighbours on the sensor one after another, in stripes as high as a window.
    stripe = sites.rows[sites.order] // 7
    assert (np.diff(stripe) >= 0).all()
    assert (np.diff(sites.columns[sites.order])[np.diff(stripe) == 0] >= 0).all()


# The photon-transfer curve, from cells whose noise is made to order.


@pytest.mark.slow
def test_recovers_gain_and_read_noise() -> None:
    random = np.random.default_rng(4)
    level = random.uniform(20, 9000, (6000, 3))
    variance = np.array([36.0, 18, 36]) + level / [1.8, 3.6, 1.8] + (0.003 * level) ** 2
    samples = level[:, None] + np.sqrt(variance)[:, None] * random.standard_normal((6000, 25, 3))
    result = photon_transfer(samples.mean(axis=1), samples.var(axis=1, ddof=1))
    assert result.gain_e == pytest.approx([1.8, 3.6, 1.8], rel=0.06)
    assert result.read_noise == pytest.approx(np.sqrt([36, 18, 36]), rel=0.4)
    assert result.response == pytest.approx(0.003, rel=0.35)
    assert (result.misfit < 0.1).all()
    assert not result.noisy.any()


def test_lists_nonuniform_cells() -> None:
    random = np.random.default_rng(5)
    level = random.uniform(500, 9000, (3000, 3))
    samples = level[:, None] + np.sqrt(level / 1.8)[:, None] * random.standard_normal((3000, 25, 3))
    samples[7, :13] *= 1.15
    result = photon_transfer(samples.mean(axis=1), samples.var(axis=1, ddof=1))
    assert np.flatnonzero(result.noisy).tolist() == [7]


def stored(samples: np.ndarray[Any, Any], unfit: tuple[int, ...] = ()) -> Any:
    """Return the parts of a table (L, C, S, 3) from which noise is read."""
    return SimpleNamespace(
        folder="a table",
        samples=samples,
        white=np.ones((len(samples), 3)),
        light_samples=samples.__getitem__,
        provenance=SimpleNamespace(unfit=[SimpleNamespace(colour=colour) for colour in unfit]),
    )


def test_table_noise_matches_samples() -> None:
    level = np.linspace(100, 9000, 64)[None, :, None, None]
    noise = np.random.default_rng(3).normal(0, 0.5, (2, 64, 25, 3))
    quiet = np.rint(level + noise).astype(np.uint16)
    assert quiet.var(axis=2, ddof=1).max() < 1
    result = noise_curve(stored(quiet))
    assert result is not None
    # Rounding adds a twelfth.
    assert result.read_noise == pytest.approx(np.sqrt(0.25 + 1 / 12), rel=0.1)
    assert noise_curve(stored(np.rint(level + 0 * noise).astype(np.uint16))) is None


def test_few_cells_give_no_noise() -> None:
    noisy = np.random.default_rng(3).normal(1000, 30, (1, 33, 25, 3)).astype(np.uint16)
    assert noise_curve(stored(noisy, unfit=(7,))) is not None
    # Samples that are 0 are cut, and their cell is no longer as noisy as its level.
    noisy[0, 5, 3, 1] = 0
    assert noise_curve(stored(noisy)) is not None
    with pytest.raises(InputError):
        noise_curve(stored(noisy, unfit=(7,)))
    with pytest.raises(InputError):
        noise_curve(stored(noisy[:, :, :1]))


def test_samples_without_curve_give_no_noise() -> None:
    level = np.repeat([500.0, 1000, 2000, 4000], 16)[None, :, None, None]
    spread = np.repeat([60.0, 5, 60, 5], 16)[None, :, None, None]
    wild = level + spread * np.random.default_rng(3).normal(0, 1, (1, 64, 25, 3))
    with pytest.raises(InputError):
        noise_curve(stored(wild.astype(np.uint16)))
