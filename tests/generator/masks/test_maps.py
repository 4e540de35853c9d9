"""Masks and ground truth maps of images."""

from __future__ import annotations

from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import PIL.Image
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from foundation.colorimetry import angles_deg
from foundation.errors import FormatError
from generator.files import encode_map
from generator.lights.lighting import Lighting, single_mixture
from generator.masks.making import FULL, find_masks, parse_masks
from generator.masks.maps import decode_ground_truth, decode_weights, encode_maps
from tests.generator.conftest import MakeLut


@pytest.mark.parametrize("lights", [2, 3])
def test_map_round_trip(tmp_path: Path, make_lut: MakeLut, lights: int) -> None:
    lut = make_lut()
    light_numbers = [0, 2, 3][:lights]
    lighting = Lighting(
        tuple(single_mixture(light) for light in light_numbers), parse_masks("smooth", lights, 1).maker(0)
    )
    weights = lighting.weights_of(40, 60)
    names: list[str] = []
    for folder, suffix, data in encode_maps(weights, lighting.whites(lut)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / f"000004{suffix}").write_bytes(data)
        names.append(f"{folder}/000004{suffix}")
    assert names == [*(f"masks/000004_{light}.png" for light in range(lights)), "ground_truth/000004.png"]
    *masks, truths = [(tmp_path / name).read_bytes() for name in names]
    np.testing.assert_array_equal(decode_weights(masks, "it"), weights)
    truth = decode_ground_truth(truths, "it")
    exact = weights.astype(np.float64) @ lut.white[light_numbers]
    assert angles_deg(truth.astype(np.float64), exact).max() < 0.002
    np.testing.assert_allclose(truth.sum(axis=2), 1, atol=1e-6)
    # An independent reader gives the same, and the files are valid input masks.
    with PIL.Image.open(tmp_path / "masks/000004_1.png") as mask:
        assert mask.mode == "I;16"
        np.testing.assert_array_equal(np.asarray(mask), np.rint(weights[..., 1] * FULL))
    reread = find_masks(tmp_path / "masks", lights).maker(0)
    np.testing.assert_array_equal(reread.weights(40, 60, lights), weights)


@given(
    st.sampled_from([(), (3,)]).flatmap(
        lambda channels: hnp.arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9), *map(st.just, channels)))
    )
)
def test_other_readers_read_any_map(values: npt.NDArray[np.uint16]) -> None:
    data = encode_map(values)
    np.testing.assert_array_equal(imagecodecs.png_decode(data), values)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    np.testing.assert_array_equal(decoded if values.ndim == 2 else decoded[..., ::-1], values)


def test_refuses_damaged_maps() -> None:
    masks = [encode_map(np.ones(shape, np.uint16)) for shape in ((2, 2), (2, 3))]
    with pytest.raises(FormatError):
        decode_weights(masks, "it")
    with pytest.raises(FormatError):
        decode_weights([masks[0], masks[1][:50]], "it")
    with pytest.raises(FormatError):
        decode_ground_truth(masks[0], "it")
