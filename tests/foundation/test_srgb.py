"""The transfer function of sRGB: landmarks of the standard, and that one direction undoes the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.colorimetry import decode_srgb, encode_srgb, srgb_codes


def test_the_landmarks_of_the_standard() -> None:
    assert encode_srgb([0.0, 1.0]).tolist() == [0.0, pytest.approx(1.0)]
    assert encode_srgb(0.0031308) == pytest.approx(12.92 * 0.0031308)
    assert encode_srgb(0.18) == pytest.approx(0.4613561, abs=1e-7)
    assert decode_srgb(0.5) == pytest.approx(0.2140411, abs=1e-7)
    assert decode_srgb(0.04045) == pytest.approx(0.04045 / 12.92)


@given(st.floats(0, 1))
def test_decoding_undoes_encoding(linear: float) -> None:
    # The two pieces of the standard's curve meet within 2·10⁻⁷ of each other.
    assert float(decode_srgb(encode_srgb(linear))) == pytest.approx(linear, abs=3e-8)


def test_every_code_comes_back() -> None:
    codes = np.arange(256, dtype=np.uint8)
    back = srgb_codes(decode_srgb(codes / 255))
    assert back.dtype == np.uint8
    np.testing.assert_array_equal(back, codes)


def test_codes_are_clipped_and_keep_the_shape() -> None:
    assert srgb_codes([[-0.5, 0.0], [1.0, 7.0]]).tolist() == [[0, 0], [255, 255]]


def test_both_rise() -> None:
    ramp = np.linspace(0, 1, 10_001)
    assert np.all(np.diff(encode_srgb(ramp)) > 0)
    assert np.all(np.diff(decode_srgb(ramp)) > 0)
