"""What falls on a picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.errors import InputError
from generator.lights.lighting import Lighting, Mixture, mixture_of, parse_mixture, plain
from generator.masks.making import FULL, GivenMasks
from generator.masks.maps import quantised_chromaticities
from tests.generator.conftest import MakeLut

_parts = st.dictionaries(
    st.integers(0, 999_999), st.floats(1e-6, 1e6, allow_nan=False, allow_infinity=False), min_size=1, max_size=5
)


class Halves(GivenMasks):
    """The first light on the left, the second on the right."""

    def weights(self, height: int, width: int, lights: int) -> npt.NDArray[np.float32]:
        left = (np.arange(width) < width // 2).astype(np.float32)
        assert lights == 2
        return np.broadcast_to(np.stack([left, 1 - left], axis=-1), (height, width, 2)).copy()


@given(_parts)
def test_a_label_gives_back_the_mixture(parts: dict[int, float]) -> None:
    mixture = mixture_of(parts)
    assert parse_mixture(mixture.label) == mixture
    assert sum(round(weight * 10**9) for weight in mixture.weights) == 10**9
    total = sum(parts.values())
    for light, share in parts.items():
        here = dict(zip(mixture.lights, mixture.weights, strict=True)).get(light, 0)
        assert here == pytest.approx(share / total, abs=5e-9)


def test_labels_as_documented() -> None:
    assert plain(12).label == "12"
    assert Mixture((12, 40), (0.25, 0.75)).label == "12:0.25+40:0.75"
    assert parse_mixture(" 40:.75+12:0.25 ".strip()) == Mixture((12, 40), (0.25, 0.75))


@pytest.mark.parametrize("text", ["", "a", "-1", "3:", "3:1+", "3:0.5+3:0.5", "3:0+4:1", "3:-1+4:2", "3:nan", "1;2"])
def test_what_is_no_label_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_mixture(text)


def test_weights_that_do_not_sum_to_1_are_refused() -> None:
    with pytest.raises(InputError):
        parse_mixture("3:0.5+4:0.6")


@pytest.mark.parametrize(
    ("lights", "weights"), [((), ()), ((1, 0), (0.5, 0.5)), ((1, 1), (0.5, 0.5)), ((1,), (0.5, 0.5)), ((-1,), (1.0,))]
)
def test_lights_that_do_not_ascend_are_refused(lights: tuple[int, ...], weights: tuple[float, ...]) -> None:
    with pytest.raises(InputError):
        Mixture(lights, weights)


def test_the_ground_truth_is_the_mixture_of_ground_truths(make_lut: MakeLut) -> None:
    lut = make_lut()
    np.testing.assert_allclose(Mixture((0, 3), (0.25, 0.75)).white(lut), 0.25 * lut.white[0] + 0.75 * lut.white[3])
    np.testing.assert_array_equal(plain(2).white(lut), lut.white[2])
    np.testing.assert_array_equal(plain(2).samples(lut), lut.samples[2])


def test_a_light_that_the_table_lacks_is_named(make_lut: MakeLut) -> None:
    lut = make_lut(lights=4)
    for of in (Mixture((0, 4), (0.5, 0.5)).white, Mixture((0, 4), (0.5, 0.5)).samples):
        with pytest.raises(InputError):
            of(lut)


def test_ground_truth_of_every_pixel(make_lut: MakeLut) -> None:
    lut = make_lut()
    lighting = Lighting((plain(0), Mixture((1, 2), (0.5, 0.5))), Halves(()))
    weights = lighting.weights_of(2, 4)
    truth = quantised_chromaticities(weights, lighting.whites(lut), FULL) / FULL
    other = lut.white[1] / 2 + lut.white[2] / 2
    np.testing.assert_allclose(truth[:, :2], np.broadcast_to(lut.ground_truth[0], (2, 2, 3)), atol=1 / FULL)
    np.testing.assert_allclose(truth[:, 2:], np.broadcast_to(other / other.sum(), (2, 2, 3)), atol=1 / FULL)
    halves = np.full((1, 1, 2), 0.5, np.float32)
    even = quantised_chromaticities(halves, lighting.whites(lut), FULL)[0, 0] / FULL
    both = lut.white[0] + other
    np.testing.assert_allclose(even, both / both.sum(), atol=1 / FULL)


def test_masks_stand_for_several_lights_only() -> None:
    with pytest.raises(InputError):
        Lighting((plain(0), plain(1)))
    with pytest.raises(InputError):
        Lighting((plain(0),), Halves(()))
    np.testing.assert_array_equal(Lighting((plain(3),)).weights_of(2, 3), np.ones((2, 3, 1), np.float32))
