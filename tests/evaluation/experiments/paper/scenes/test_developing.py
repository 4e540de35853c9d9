"""Pictures developed from raw images with their ground truths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.paper.material import DevelopedSource, develop, developed
from evaluation.scene import SceneSet
from foundation.errors import InputError
from foundation.srgb import decode_srgb, srgb_codes
from generator.rendering.matrices import camera_matrix


@dataclass(frozen=True, eq=False)
class Photo:
    """A raw image in memory."""

    image: npt.NDArray[np.float64]
    mask: npt.NDArray[np.bool_] | None
    truth: npt.NDArray[np.float64]
    name: str = "photo"
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_] | None]:
        return self.image, self.mask


@pytest.mark.parametrize("camera", ["Canon EOS 550D", "Canon EOS-1Ds Mark III", "Canon EOS 600D"])
def test_a_picture_photographed_and_developed_is_itself(camera: str) -> None:
    matrix = camera_matrix(camera)
    assert matrix is not None
    rng = np.random.default_rng(7)
    codes = rng.integers(20, 256, (30, 40, 3), dtype=np.uint8)
    codes[:4] = 255  # more than one in a hundred pixels are white, so white is where it was
    light = np.array([0.5, 1.0, 0.7]) * 3000
    raw = decode_srgb(codes / 255) @ matrix.rows.T * light
    assert np.abs(develop(raw, light * 17, matrix=matrix).astype(int) - codes).max() <= 1
    assert np.abs(develop(raw, light, matrix=None).astype(int) - codes).max() > 10
    # The wrong light leaves a cast.
    assert np.abs(develop(raw, light[::-1].copy(), matrix=matrix).astype(int) - codes).max() > 10


def test_one_in_a_hundred_is_clipped() -> None:
    wedge = np.linspace(0, 1, 10000).reshape(100, 100, 1) * np.array([0.3, 1.0, 0.4])
    picture = develop(wedge, np.array([0.3, 1.0, 0.4]))
    assert 0.01 <= (picture == 255).all(axis=2).mean() < 0.015
    # A masked highlight does not darken the picture.
    bright = wedge.copy()
    bright[:50] *= 40
    mask = np.zeros((100, 100), np.bool_)
    mask[:50] = True
    alone = develop(bright[50:], np.array([0.3, 1.0, 0.4]))
    np.testing.assert_array_equal(develop(bright, np.array([0.3, 1.0, 0.4]), mask)[50:], alone)
    assert develop(bright, np.array([0.3, 1.0, 0.4]))[50:].max() < 128


def test_a_clipped_sky_is_white() -> None:
    light = np.array([0.5, 1.0, 0.7])
    image = np.full((20, 20, 3), 200.0) * light
    image[:10] = 1000.0  # all channels at saturation: under this light as red and blue as no sky is
    pink, white = (develop(image, light, saturation=level)[0, 0].tolist() for level in (None, 1000.0))
    assert pink == srgb_codes([1, 0.5, 0.5 / 0.7]).tolist()
    assert white == [255, 255, 255]
    np.testing.assert_array_equal(develop(image, light, saturation=5000.0), develop(image, light))


def test_a_source_has_no_chart() -> None:
    mask = np.zeros((8, 8), np.bool_)
    mask[:3, :3] = True
    scene = Photo(np.full((8, 8, 3), 500.0), mask, np.array([1.0, 1.0, 1.0]))
    (source,) = developed(SceneSet("made up", "none", "here", (scene,)), camera_matrix("EOS 550D"))
    picture = source.read().picture
    assert not picture[mask].any()
    assert (picture[~mask] == 255).all()
    assert source.name == "photo"
    assert source.to_json() == {"developed": "photo", "matrix": "Canon EOS 550D"}


def test_black_stays_black() -> None:
    assert not develop(np.zeros((4, 4, 3)), np.ones(3)).any()
    assert not DevelopedSource(Photo(np.ones((2, 2, 3)), np.ones((2, 2), np.bool_), np.ones(3))).read().picture.any()


@pytest.mark.parametrize("light", [[0.0, 1, 1], [np.nan, 1, 1]])
def test_a_light_has_three_channels(light: list[float]) -> None:
    with pytest.raises(InputError, match="cannot be balanced"):
        develop(np.ones((2, 2, 3)), np.array(light))
