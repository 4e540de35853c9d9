"""Mixtures of illuminants, and the illuminants of an image."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.errors import InputError
from generator.lights.lighting import Lighting, Mixture, mixture_of, parse_mixture, single_mixture
from generator.masks.making import FULL, GivenMasks
from generator.masks.maps import quantised_chromaticities
from tests.generator.conftest import MakeLut

_shares = st.dictionaries(
    st.integers(0, 999_999), st.floats(1e-6, 1e6, allow_nan=False, allow_infinity=False), min_size=1, max_size=5
)


class Halves(GivenMasks):
    """The first illuminant on the left, the second on the right."""

    def weights(self, height: int, width: int, lights: int) -> npt.NDArray[np.float32]:
        left = (np.arange(width) < width // 2).astype(np.float32)
        assert lights == 2
        return np.broadcast_to(np.stack([left, 1 - left], axis=-1), (height, width, 2)).copy()


@given(_shares)
def test_label_round_trip(shares: dict[int, float]) -> None:
    mixture = mixture_of(shares)
    assert parse_mixture(mixture.label) == mixture
    assert sum(round(weight * 10**9) for weight in mixture.weights) == 10**9
    total = sum(shares.values())
    for light, share in shares.items():
        weight = dict(zip(mixture.lights, mixture.weights, strict=True)).get(light, 0)
        assert weight == pytest.approx(share / total, abs=5e-9)


def test_documented_labels() -> None:
    assert single_mixture(12).label == "12"
    assert Mixture((12, 40), (0.25, 0.75)).label == "12:0.25+40:0.75"
    assert parse_mixture(" 40:.75+12:0.25 ".strip()) == Mixture((12, 40), (0.25, 0.75))


@pytest.mark.parametrize("text", ["", "a", "-1", "3:", "3:1+", "3:0.5+3:0.5", "3:0+4:1", "3:-1+4:2", "3:nan", "1;2"])
def test_refuses_invalid_label(text: str) -> None:
    with pytest.raises(InputError):
        parse_mixture(text)


def test_refuses_weights_without_sum_1() -> None:
    with pytest.raises(InputError):
        parse_mixture("3:0.5+4:0.6")


@pytest.mark.parametrize(
    ("lights", "weights"), [((), ()), ((1, 0), (0.5, 0.5)), ((1, 1), (0.5, 0.5)), ((1,), (0.5, 0.5)), ((-1,), (1.0,))]
)
def test_refuses_lights_not_ascending(lights: tuple[int, ...], weights: tuple[float, ...]) -> None:
    with pytest.raises(InputError):
        Mixture(lights, weights)


def test_ground_truth_of_mixture(make_lut: MakeLut) -> None:
    lut = make_lut()
    np.testing.assert_allclose(Mixture((0, 3), (0.25, 0.75)).white(lut), 0.25 * lut.white[0] + 0.75 * lut.white[3])
    np.testing.assert_array_equal(single_mixture(2).white(lut), lut.white[2])
    np.testing.assert_array_equal(single_mixture(2).samples(lut), lut.samples[2])


def test_refuses_light_missing_in_lut(make_lut: MakeLut) -> None:
    lut = make_lut(lights=4)
    for method in (Mixture((0, 4), (0.5, 0.5)).white, Mixture((0, 4), (0.5, 0.5)).samples):
        with pytest.raises(InputError):
            method(lut)


def test_ground_truth_map(make_lut: MakeLut) -> None:
    lut = make_lut()
    lighting = Lighting((single_mixture(0), Mixture((1, 2), (0.5, 0.5))), Halves(()))
    weights = lighting.weights_of(2, 4)
    truth = quantised_chromaticities(weights, lighting.whites(lut), FULL) / FULL
    second_white = lut.white[1] / 2 + lut.white[2] / 2
    np.testing.assert_allclose(truth[:, :2], np.broadcast_to(lut.ground_truth[0], (2, 2, 3)), atol=1 / FULL)
    np.testing.assert_allclose(
        truth[:, 2:], np.broadcast_to(second_white / second_white.sum(), (2, 2, 3)), atol=1 / FULL
    )
    halves = np.full((1, 1, 2), 0.5, np.float32)
    even = quantised_chromaticities(halves, lighting.whites(lut), FULL)[0, 0] / FULL
    sum_of_whites = lut.white[0] + second_white
    np.testing.assert_allclose(even, sum_of_whites / sum_of_whites.sum(), atol=1 / FULL)


def test_masks_require_several_lights() -> None:
    with pytest.raises(InputError):
        Lighting((single_mixture(0), single_mixture(1)))
    with pytest.raises(InputError):
        Lighting((single_mixture(0),), Halves(()))
    np.testing.assert_array_equal(Lighting((single_mixture(3),)).weights_of(2, 3), np.ones((2, 3, 1), np.float32))
