"""The print's black taken out of samples: white stays, means stay, nothing wraps, crops see what images see."""

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
from generator.rendering.black_points import BlackPoint, Veil, black_of, parse_black_point, veil_of, without_veil
from generator.rendering.matrices import ColourMatrix
from tests.generator.conftest import MakeLut
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX

WHITE = np.array([3000.0, 6000.0, 4000.0])
BLACK = np.array([110.0, 220.0, 150.0])
READ = 8.0


def cells_of(means: npt.NDArray[np.float64], count: int = 25, seed: int = 1) -> npt.NDArray[np.uint16]:
    """Return samples (N, count, 3) of cells with those means (N, 3): photon noise and read noise, as a table has it."""
    rng = np.random.default_rng(seed)
    drawn = rng.poisson(means[:, None].repeat(count, axis=1)) + rng.normal(0, READ, (len(means), count, 3))
    return np.clip(np.rint(drawn), 0, 65535).astype(np.uint16)


def veil(share: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    taken = share * BLACK
    return taken, 1 / (1 - taken / WHITE)


def taken_out(samples: npt.NDArray[np.uint16], share: float, white_level: int = 15000) -> npt.NDArray[np.uint16]:
    return without_veil(samples, Veil(*veil(share)), white_level)


@pytest.mark.parametrize("share", [0.3, 0.97, 1.0])
def test_the_mean_of_every_cell_is_the_formula_s_also_at_black(share: float) -> None:
    means = BLACK + np.linspace(0, 1, 200)[:, None] ** 3 * (WHITE - BLACK)
    samples = cells_of(means)
    got = taken_out(samples, share).astype(np.float64)
    taken, stretch = veil(share)
    exact = (samples - taken) * stretch
    wanted = exact.mean(axis=1)
    shown = wanted >= 0
    # Rounding leaves half a count of a cell's 25.
    assert np.abs(got.mean(axis=1) - wanted)[shown].max() <= 0.02 + 1e-9
    # A cell that is darker than what was taken out is black, and that is all that is lost.
    assert (got.mean(axis=1)[~shown] == 0).all()
    # What would be wrong: cut off at 0, the darkest cells are too bright by counts.
    if share == 1:
        cut = np.maximum(exact, 0).mean(axis=1)
        assert (cut - wanted)[:5].mean() > 1


def test_noise_is_stretched_as_the_signal_is_and_else_stays() -> None:
    samples = cells_of(np.linspace(0.2, 1, 400)[:, None] * WHITE)
    got = taken_out(samples, 1.0).astype(np.float64)
    stretch = veil(1.0)[1]
    ratio = got.std(axis=1) / samples.std(axis=1) / stretch
    # Rounding passed on adds a twelfth of a count's variance or two to some 700 at least.
    assert np.abs(ratio.mean(axis=0) - 1).max() < 0.001


def test_white_stays_to_the_last_bit_and_saturation_stays_saturated() -> None:
    level = 6500
    white = np.repeat(WHITE[None, None], 4, axis=1).astype(np.uint16)
    full = np.full((1, 4, 3), level, np.uint16)
    for share in (0.01, 0.5, 0.97, 1.0):
        got = taken_out(np.concatenate([white, full]), share, level)
        np.testing.assert_array_equal(got[0], white[0])
        np.testing.assert_array_equal(got[1], full[0])
    # With saturation below the white of a light, as in an overexposed table, clipped highlights stay without colour.
    samples = np.concatenate([np.repeat(BLACK[None, None], 25, axis=1), np.full((7, 25, 3), 3500)]).astype(np.uint16)
    provenance = SimpleNamespace(bits=1, white_level=3500, unfit=())
    lut = SimpleNamespace(samples=samples[None], white=WHITE[None] * 1.5, provenance=provenance, folder="lut")
    got = without_veil(samples, veil_of(lut, single_mixture(0), 0.97), 3500)  # pyrefly: ignore[bad-argument-type]
    assert (got[1:] == 3500).all()
    assert got[0].max() < 9


def test_nothing_wraps_at_either_end() -> None:
    rng = np.random.default_rng(5)
    samples = rng.integers(0, 15001, (300, 25, 3)).astype(np.uint16)
    samples[::7] = 0
    samples[3::7] = 15000
    got = taken_out(samples, 1.0)
    assert got.max() == 15000
    assert (got[::7] == 0).all()
    assert (got[3::7] == 15000).all()
    exact = (samples - veil(1.0)[0]) * veil(1.0)[1]
    inner = (exact.min(axis=1) >= 0) & (exact.max(axis=1) < 15000)
    assert np.abs(got - exact).transpose(0, 2, 1)[inner].max() <= 1.0


def test_black_is_that_of_the_light_its_mixture_and_the_nearest_fit_cell(make_lut: MakeLut) -> None:
    lut = make_lut()
    means = lut.samples[:, 0].mean(axis=1)
    np.testing.assert_allclose(black_of(lut, single_mixture(2)), means[2])
    np.testing.assert_allclose(black_of(lut, Mixture((1, 3), (0.25, 0.75))), 0.25 * means[1] + 0.75 * means[3])
    stained = make_lut(unfit=(0,), name="stained")
    np.testing.assert_allclose(black_of(stained, single_mixture(2)), stained.samples[2, 1].mean(axis=0))
    mixture = Mixture((1, 3), (0.25, 0.75))
    half = veil_of(lut, mixture, 0.5)
    np.testing.assert_allclose((mixture.white(lut) - half.taken) * half.stretch, mixture.white(lut))


def test_taken_out_of_each_light_it_is_taken_out_of_their_mixture() -> None:
    # Two lights whose black over white differ as much as those of real tables: .03 and .045.
    whites = np.array([[3000.0, 6000, 4000], [5000.0, 4000, 2000]])
    blacks = whites * [[0.03], [0.045]]
    reflectances = np.linspace(0, 1, 64)[:, None] ** 2
    lights = [black + reflectances * (white - black) for black, white in zip(blacks, whites, strict=True)]
    tables = [np.rint(means[:, None].repeat(4, axis=1)).astype(np.uint16) for means in lights]
    freed = [
        without_veil(table, Veil(black, 1 / (1 - black / white)), 65535)
        for table, black, white in zip(tables, blacks, whites, strict=True)
    ]
    codes = ((np.arange(64)[:, None] >> [4, 2, 0] & 3) << 6).astype(np.uint8)[None]
    for weight in (0.0, 0.25, 0.5, 1.0):
        weights = np.array([weight, 1 - weight], np.float32)
        mixed = mix_samples(tables, codes, weights)[0].astype(np.float64)
        black, white = weights @ blacks, weights @ whites
        wanted = (mixed - black) / (1 - black / white)
        got = mix_samples(freed, codes, weights)[0]
        # A count and a half of rounding, and half a thousandth of white.
        assert np.abs(got - wanted).max() < 1.5 + 0.0005 * white.max()


def test_a_crop_is_the_image_but_for_rounding_and_has_noise_below_0() -> None:
    means = np.concatenate([BLACK[None], np.linspace(0.1, 1, 7)[:, None] * WHITE])
    samples = cells_of(means)
    picture = np.random.default_rng(3).integers(0, 2, (40, 60, 3)).astype(np.uint8) * 255
    taken, stretch = veil(1.0)
    level = 15000
    window = [(7, 5, 30, 20)]
    arguments: dict[str, Any] = {"white_level": level, "seeds": 4, "images": 9}
    plainly = draw_batch(samples[None], [0], [picture], window, **arguments)[0]
    crop = draw_batch(samples[None], [0], [picture], window, taken=[taken], stretches=[stretch], **arguments)[0]
    exact = (plainly.astype(np.float64) * level - taken[:, None, None]) * stretch[:, None, None] / level
    np.testing.assert_allclose(crop, exact, atol=1e-6)
    assert crop.min() < 0
    whole = draw_batch(
        samples[None], [0], [picture], [(0, 0, 60, 40)], taken=[taken], stretches=[stretch], **arguments
    )[0]
    np.testing.assert_array_equal(whole[:, 5:25, 7:37], crop)
    nothing = draw_batch(samples[None], [0], [picture], window, taken=[[0, 0, 0]], **arguments)[0]
    np.testing.assert_array_equal(nothing, plainly)


def test_a_clipped_pixel_of_a_crop_stays_clipped_and_a_gain_darkens_it() -> None:
    samples = np.full((8, 3, 3), 15000, np.uint16)
    picture = np.zeros((4, 9, 3), np.uint8)
    taken, stretch = veil(0.9)
    crop = draw_batch(
        samples[None], [0], [picture], [(0, 0, 9, 4)], white_level=15000, gains=0.5, taken=[taken], stretches=[stretch]
    )
    assert (crop == 0.5).all()


def test_random_shares_are_even_and_a_function_of_seed_and_image() -> None:
    black_point = parse_black_point("random:.8")
    shares = np.array([black_point.share(3, image) for image in range(400)])
    assert shares.min() >= 0
    assert shares.max() < 0.8
    # Mean of 400 even shares: standard error .8 / sqrt(12 * 400).
    assert abs(shares.mean() - 0.4) < 5 * 0.8 / 4800**0.5
    assert black_point.share(3, 7) == shares[7] != black_point.share(4, 7)
    assert [parse_black_point(text).share(3, 7) for text in ("keep", "compensate")] == [0, 1]
    assert parse_black_point("random") == BlackPoint("random", 0.97)


def test_of_greys_a_grey_is_taken_out_and_not_the_tinted_black_cell(make_lut: MakeLut) -> None:
    lut = make_lut()
    light = Mixture((1, 3), (0.25, 0.75))
    white, black = light.white(lut), black_of(lut, light)
    shares = black / white
    assert shares.max() > 1.1 * shares.min()
    grey, whole = veil_of(lut, light, 1.0, 0.04), veil_of(lut, light, 1.0)
    np.testing.assert_allclose(grey.taken, white * 0.04)
    with pytest.raises(QualityError, match=r"black of 0\.5 0\.5 0\.5"):
        veil_of(lut, light, 1.0, 0.5)
    for brightness in (shares.max(), 0.2, 0.9):
        seen = (white * brightness - grey.taken) * grey.stretch / white
        assert np.ptp(seen) < 1e-12
    # What would be wrong: a dark grey takes on the complement of the black's tint.
    seen = (white * shares.max() - whole.taken) * whole.stretch / white
    assert np.ptp(seen) > 0.05 * seen.max()


@pytest.mark.slow
def test_black_of_a_picture_is_black_where_mixtures_are_brighter_than_the_black_cell(
    make_table: MakeTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    tint = np.array([1.15, 1.0, 0.85])

    def redden(samples: npt.NDArray[np.uint16]) -> None:
        samples[:] = np.rint(samples * tint)

    lut = make_table(bits=4, change=redden)
    white = lut.white[1]
    black = float((black_of(lut, single_mixture(1)) / white).min())
    codes = np.zeros((64, 64, 3), np.uint8)
    codes[32:] = 40
    codes[:, 32:] += 215
    options = DatasetOptions(rendering="colorimetric", matrix=ColourMatrix("mine", MATRIX, ""))
    seen: dict[float, npt.NDArray[np.float64]] = {}
    for share in (0.0, 0.5, 1.0):
        monkeypatch.setattr(BlackPoint, "share", Mock(return_value=share))
        taken = options if share == 0 else replace(options, black_point=BlackPoint("compensate"))
        image = photograph(lut, codes, Lighting((single_mixture(1),)), taken, 3, 4, 11536).counts
        seen[share] = np.stack([part.mean(axis=(0, 1)) for part in (image[:32, :32], image[32:, :32])]) / white
    dark, grey = seen[0.0]
    # Mixtures make no grey as dark as the black cell, so what is in that cell is too little to take out.
    assert dark.mean() > 1.2 * black
    assert ((dark - black) / (1 - black)).mean() > 0.008
    for share, (darker, greyer) in seen.items():
        level = share * dark.mean()
        # Cells of the mixture that are darker than what is taken out end at 0, and keep its mean from doing so.
        np.testing.assert_allclose(darker, (dark - level) / (1 - level), atol=0.003)
        np.testing.assert_allclose(greyer, (grey - level) / (1 - level), atol=0.0015)
        assert angles_deg(greyer, np.ones(3)) < 1
