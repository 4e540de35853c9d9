"""Subtraction of the print's black: white and means stay, values are clipped, crops agree with images."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest

from foundation.colorimetry import angles_deg
from foundation.errors import QualityError
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import photograph
from generator.kernels.mixing import mix_samples
from generator.kernels.planar import draw_batch
from generator.lights.lighting import Lighting, Mixture, single_mixture
from generator.rendering.black_points import (
    BlackPoint,
    BlackSubtraction,
    black_cell_counts,
    black_subtraction,
    parse_black_point,
    subtract_black,
)
from generator.rendering.matrices import ColourMatrix
from tests.generator.conftest import MakeLut
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX

WHITE = np.array([3000.0, 6000.0, 4000.0])
BLACK = np.array([110.0, 220.0, 150.0])
READ = 8.0


def samples_of(means: npt.NDArray[np.float64], count: int = 25, seed: int = 1) -> npt.NDArray[np.uint16]:
    """Return samples (N, count, 3) of patches with those means (N, 3), with photon noise and read noise."""
    rng = np.random.default_rng(seed)
    drawn = rng.poisson(means[:, None].repeat(count, axis=1)) + rng.normal(0, READ, (len(means), count, 3))
    return np.clip(np.rint(drawn), 0, 65535).astype(np.uint16)


def subtraction(share: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    counts = share * BLACK
    return counts, 1 / (1 - counts / WHITE)


def subtracted(samples: npt.NDArray[np.uint16], share: float, white_level: int = 15000) -> npt.NDArray[np.uint16]:
    return subtract_black(samples, BlackSubtraction(*subtraction(share)), white_level)


@pytest.mark.parametrize("share", [0.3, 0.97, 1.0])
def test_mean_of_every_patch_follows_the_formula(share: float) -> None:
    means = BLACK + np.linspace(0, 1, 200)[:, None] ** 3 * (WHITE - BLACK)
    samples = samples_of(means)
    result = subtracted(samples, share).astype(np.float64)
    counts, stretch = subtraction(share)
    exact = (samples - counts) * stretch
    expected = exact.mean(axis=1)
    is_positive = expected >= 0
    # Rounding leaves half a count per patch of 25 samples.
    assert np.abs(result.mean(axis=1) - expected)[is_positive].max() <= 0.02 + 1e-9
    # Patches darker than the subtracted counts are 0.
    assert (result.mean(axis=1)[~is_positive] == 0).all()
    # The wrong way: clipped at 0, the darkest patches are too bright.
    if share == 1:
        clipped = np.maximum(exact, 0).mean(axis=1)
        assert (clipped - expected)[:5].mean() > 1


def test_noise_is_stretched_like_the_signal() -> None:
    samples = samples_of(np.linspace(0.2, 1, 400)[:, None] * WHITE)
    result = subtracted(samples, 1.0).astype(np.float64)
    stretch = subtraction(1.0)[1]
    ratio = result.std(axis=1) / samples.std(axis=1) / stretch
    # Rounding adds a variance of 1/12 or 2/12 to at least 700.
    assert np.abs(ratio.mean(axis=0) - 1).max() < 0.001


def test_keeps_white_and_saturation() -> None:
    level = 6500
    white = np.repeat(WHITE[None, None], 4, axis=1).astype(np.uint16)
    full = np.full((1, 4, 3), level, np.uint16)
    for share in (0.01, 0.5, 0.97, 1.0):
        result = subtracted(np.concatenate([white, full]), share, level)
        np.testing.assert_array_equal(result[0], white[0])
        np.testing.assert_array_equal(result[1], full[0])
    # If saturation is below white, as in an overexposed LUT, clipped highlights stay neutral.
    samples = np.concatenate([np.repeat(BLACK[None, None], 25, axis=1), np.full((7, 25, 3), 3500)]).astype(np.uint16)
    provenance = SimpleNamespace(bits=1, white_level=3500, unfit=())
    lut = SimpleNamespace(samples=samples[None], white=WHITE[None] * 1.5, provenance=provenance, folder="lut")
    result = subtract_black(samples, black_subtraction(lut, single_mixture(0), 0.97), 3500)  # pyrefly: ignore[bad-argument-type]
    assert (result[1:] == 3500).all()
    assert result[0].max() < 9


def test_clips_at_both_ends() -> None:
    rng = np.random.default_rng(5)
    samples = rng.integers(0, 15001, (300, 25, 3)).astype(np.uint16)
    samples[::7] = 0
    samples[3::7] = 15000
    result = subtracted(samples, 1.0)
    assert result.max() == 15000
    assert (result[::7] == 0).all()
    assert (result[3::7] == 15000).all()
    exact = (samples - subtraction(1.0)[0]) * subtraction(1.0)[1]
    inner = (exact.min(axis=1) >= 0) & (exact.max(axis=1) < 15000)
    assert np.abs(result - exact).transpose(0, 2, 1)[inner].max() <= 1.0


def test_black_of_lights_mixtures_and_unfit_patches(make_lut: MakeLut) -> None:
    lut = make_lut()
    means = lut.samples[:, 0].mean(axis=1)
    np.testing.assert_allclose(black_cell_counts(lut, single_mixture(2)), means[2])
    np.testing.assert_allclose(black_cell_counts(lut, Mixture((1, 3), (0.25, 0.75))), 0.25 * means[1] + 0.75 * means[3])
    stained = make_lut(unfit=(0,), name="stained")
    np.testing.assert_allclose(black_cell_counts(stained, single_mixture(2)), stained.samples[2, 1].mean(axis=0))
    mixture = Mixture((1, 3), (0.25, 0.75))
    half = black_subtraction(lut, mixture, 0.5)
    np.testing.assert_allclose((mixture.white(lut) - half.counts) * half.stretch, mixture.white(lut))


def test_subtraction_before_and_after_mixing_agree() -> None:
    # Two illuminants with black relative to white of 0.03 and 0.045, as in real LUTs.
    whites = np.array([[3000.0, 6000, 4000], [5000.0, 4000, 2000]])
    blacks = whites * [[0.03], [0.045]]
    reflectances = np.linspace(0, 1, 64)[:, None] ** 2
    lights = [black + reflectances * (white - black) for black, white in zip(blacks, whites, strict=True)]
    tables = [np.rint(means[:, None].repeat(4, axis=1)).astype(np.uint16) for means in lights]
    subtracted = [
        subtract_black(table, BlackSubtraction(black, 1 / (1 - black / white)), 65535)
        for table, black, white in zip(tables, blacks, whites, strict=True)
    ]
    codes = ((np.arange(64)[:, None] >> [4, 2, 0] & 3) << 6).astype(np.uint8)[None]
    for weight in (0.0, 0.25, 0.5, 1.0):
        weights = np.array([weight, 1 - weight], np.float32)
        mixed = mix_samples(tables, codes, weights)[0].astype(np.float64)
        black, white = weights @ blacks, weights @ whites
        expected = (mixed - black) / (1 - black / white)
        result = mix_samples(subtracted, codes, weights)[0]
        # Rounding of 1.5 counts, and 0.0005 of white.
        assert np.abs(result - expected).max() < 1.5 + 0.0005 * white.max()


def test_crop_equals_unrounded_image_with_noise_below_0() -> None:
    means = np.concatenate([BLACK[None], np.linspace(0.1, 1, 7)[:, None] * WHITE])
    samples = samples_of(means)
    picture = np.random.default_rng(3).integers(0, 2, (40, 60, 3)).astype(np.uint8) * 255
    counts, stretch = subtraction(1.0)
    level = 15000
    window = [(7, 5, 30, 20)]
    arguments: dict[str, Any] = {"white_level": level, "seeds": 4, "images": 9}
    plain_crop = draw_batch(samples[None], [0], [picture], window, **arguments)[0]
    crop = draw_batch(samples[None], [0], [picture], window, black_counts=[counts], stretches=[stretch], **arguments)[0]
    exact = (plain_crop.astype(np.float64) * level - counts[:, None, None]) * stretch[:, None, None] / level
    np.testing.assert_allclose(crop, exact, atol=1e-6)
    assert crop.min() < 0
    whole = draw_batch(
        samples[None], [0], [picture], [(0, 0, 60, 40)], black_counts=[counts], stretches=[stretch], **arguments
    )[0]
    np.testing.assert_array_equal(whole[:, 5:25, 7:37], crop)
    unchanged = draw_batch(samples[None], [0], [picture], window, black_counts=[[0, 0, 0]], **arguments)[0]
    np.testing.assert_array_equal(unchanged, plain_crop)


def test_gain_darkens_clipped_pixels_of_a_crop() -> None:
    samples = np.full((8, 3, 3), 15000, np.uint16)
    picture = np.zeros((4, 9, 3), np.uint8)
    counts, stretch = subtraction(0.9)
    black = {"black_counts": [counts], "stretches": [stretch]}
    crop = draw_batch(samples[None], [0], [picture], [(0, 0, 9, 4)], white_level=15000, gains=0.5, **black)
    assert (crop == 0.5).all()


def test_random_shares_are_uniform_and_reproducible() -> None:
    black_point = parse_black_point("random:.8")
    shares = np.array([black_point.share(3, image) for image in range(400)])
    assert shares.min() >= 0
    assert shares.max() < 0.8
    # Mean of 400 uniform shares: standard error 0.8 / sqrt(12 * 400).
    assert abs(shares.mean() - 0.4) < 5 * 0.8 / 4800**0.5
    assert black_point.share(3, 7) == shares[7] != black_point.share(4, 7)
    assert [parse_black_point(text).share(3, 7) for text in ("keep", "compensate")] == [0, 1]
    assert parse_black_point("random") == BlackPoint("random", 0.97)


def test_rendering_by_colour_subtracts_neutral_grey(make_lut: MakeLut) -> None:
    lut = make_lut()
    light = Mixture((1, 3), (0.25, 0.75))
    white, black = light.white(lut), black_cell_counts(lut, light)
    shares = black / white
    assert shares.max() > 1.1 * shares.min()
    grey, whole = black_subtraction(lut, light, 1.0, 0.04), black_subtraction(lut, light, 1.0)
    np.testing.assert_allclose(grey.counts, white * 0.04)
    with pytest.raises(QualityError, match=r"black of 0\.5 0\.5 0\.5"):
        black_subtraction(lut, light, 1.0, 0.5)
    for brightness in (shares.max(), 0.2, 0.9):
        greys = (white * brightness - grey.counts) * grey.stretch / white
        assert np.ptp(greys) < 1e-12
    # The wrong way: a dark grey gets the complement of the black's tint.
    greys = (white * shares.max() - whole.counts) * whole.stretch / white
    assert np.ptp(greys) > 0.05 * greys.max()


@pytest.mark.slow
def test_compensation_reaches_black_of_colorimetric_images(
    make_table: MakeTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    tint = np.array([1.15, 1.0, 0.85])

    def redden(samples: npt.NDArray[np.uint16]) -> None:
        samples[:] = np.rint(samples * tint)

    lut = make_table(bits=4, change=redden)
    white = lut.white[1]
    black = float((black_cell_counts(lut, single_mixture(1)) / white).min())
    codes = np.zeros((64, 64, 3), np.uint8)
    codes[32:] = 40
    codes[:, 32:] += 215
    options = DatasetOptions(rendering="colorimetric", matrix=ColourMatrix("mine", MATRIX, ""))
    shown: dict[float, npt.NDArray[np.float64]] = {}
    for share in (0.0, 0.5, 1.0):
        monkeypatch.setattr(BlackPoint, "share", Mock(return_value=share))
        share_options = options if share == 0 else replace(options, black_point=BlackPoint("compensate"))
        image = photograph(lut, codes, Lighting((single_mixture(1),)), share_options, 3, 4, 11536).counts
        shown[share] = np.stack([area.mean(axis=(0, 1)) for area in (image[:32, :32], image[32:, :32])]) / white
    dark, grey = shown[0.0]
    # Mixtures make no grey as dark as the black patch, so its counts are too few to subtract.
    assert dark.mean() > 1.2 * black
    assert ((dark - black) / (1 - black)).mean() > 0.008
    for share, (darker, greyer) in shown.items():
        level = share * dark.mean()
        # Patches of the mixture that are darker than the subtracted counts become 0, and raise its mean.
        np.testing.assert_allclose(darker, (dark - level) / (1 - level), atol=0.003)
        np.testing.assert_allclose(greyer, (grey - level) / (1 - level), atol=0.0015)
        assert angles_deg(greyer, np.ones(3)) < 1
