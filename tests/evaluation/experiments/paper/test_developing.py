"""Pictures developed from raw images with their ground truths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.paper.developing import DevelopedSource, camera_from_srgb, develop, developed
from evaluation.scene import SceneSet
from foundation.errors import InputError
from foundation.srgb import decode_srgb


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


def test_the_matrix_of_the_550d() -> None:
    # From Adobe's numbers by another program; to three decimals.
    known = [[0.578, 0.344, 0.079], [0.088, 0.674, 0.238], [0.035, 0.217, 0.748]]
    np.testing.assert_allclose(camera_from_srgb("Canon EOS 550D"), known, atol=1.5e-3)


@pytest.mark.parametrize("camera", ["Canon EOS 550D", "Canon EOS-1Ds Mark III", "Canon EOS 600D"])
def test_a_picture_photographed_and_developed_is_itself(camera: str) -> None:
    rng = np.random.default_rng(7)
    codes = rng.integers(20, 256, (30, 40, 3), dtype=np.uint8)
    codes[:4] = 255  # more than one in a hundred pixels are white, so white is where it was
    light = np.array([0.5, 1.0, 0.7]) * 3000
    raw = decode_srgb(codes / 255) @ camera_from_srgb(camera).T * light
    assert np.abs(develop(raw, light * 17, camera=camera).astype(int) - codes).max() <= 1
    assert np.abs(develop(raw, light, camera=None).astype(int) - codes).max() > 10
    # The wrong light leaves a cast.
    assert np.abs(develop(raw, light[::-1].copy(), camera=camera).astype(int) - codes).max() > 10


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


def test_a_source_has_no_chart() -> None:
    mask = np.zeros((8, 8), np.bool_)
    mask[:3, :3] = True
    scene = Photo(np.full((8, 8, 3), 500.0), mask, np.array([1.0, 1.0, 1.0]))
    (source,) = developed(SceneSet("made up", "none", "here", (scene,)), "Canon EOS 550D")
    picture = source.read().picture
    assert not picture[mask].any()
    assert (picture[~mask] == 255).all()
    assert source.name == "photo"
    assert source.to_json() == {"developed": "photo", "camera": "Canon EOS 550D"}


def test_black_stays_black() -> None:
    assert not develop(np.zeros((4, 4, 3)), np.ones(3)).any()
    assert not DevelopedSource(Photo(np.ones((2, 2, 3)), np.ones((2, 2), np.bool_), np.ones(3))).read().picture.any()


@pytest.mark.parametrize("light", [[0.0, 1, 1], [np.nan, 1, 1]])
def test_a_light_has_three_channels(light: list[float]) -> None:
    with pytest.raises(InputError, match="cannot be balanced"):
        develop(np.ones((2, 2, 3)), np.array(light))


def test_an_unknown_camera_is_refused_at_once() -> None:
    with pytest.raises(InputError, match="the cameras are Canon EOS-1Ds Mark III"):
        developed(SceneSet("made up", "none", "here", ()), "Kodak Brownie")
