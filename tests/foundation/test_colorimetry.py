"""Colorimetry compared with colour-science, values of the sRGB standard, and properties of angles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiment.lights import CCTS_K, blackbody_light, shown_colour
from foundation.colorimetry import (
    XYZ_TO_SRGB,
    angles_deg,
    decode_srgb,
    encode_srgb,
    linear_srgb,
    observer_cie_1931,
    planck,
    srgb_codes,
    xyz_of,
)

WAVELENGTHS = np.arange(360.0, 781.0)


@pytest.fixture(scope="module")
def science() -> Any:
    import colour

    return colour


@pytest.mark.slow
def test_observer_equals_cie_1931(science: Any) -> None:
    wavelengths, functions = observer_cie_1931()
    theirs = science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    assert np.array_equal(wavelengths, theirs.wavelengths)
    assert np.array_equal(functions, theirs.values)
    # CIE 15:2018, table 1: the maximum of ȳ, and its wavelength.
    assert (wavelengths[functions[:, 1].argmax()], functions[:, 1].max()) == (555, 1.0)


@pytest.mark.slow
def test_matrix_equals_the_standard(science: Any) -> None:
    assert np.array_equal(XYZ_TO_SRGB, science.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB)


@pytest.mark.slow
@given(st.floats(1000, 25_000))
def test_black_bodies_equal_colour_science(science: Any, cct_k: float) -> None:
    theirs = science.sd_blackbody(cct_k, science.SpectralShape(360, 780, 1))
    assert planck(WAVELENGTHS, cct_k) == pytest.approx(theirs.values, rel=1e-12)
    assert planck(WAVELENGTHS.astype(np.float32), cct_k) == pytest.approx(theirs.values, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("cct_k", CCTS_K)
def test_planned_codes_equal_colour_science(science: Any, cct_k: float) -> None:
    spectrum = science.sd_blackbody(cct_k, science.SpectralShape(360, 780, 1))
    xyz = np.asarray(science.sd_to_XYZ(spectrum, k=1.0))
    linear = np.asarray(science.XYZ_to_sRGB(xyz / xyz[1], apply_cctf_encoding=False))
    assert linear_srgb(xyz_of(WAVELENGTHS, planck(WAVELENGTHS, cct_k))) == pytest.approx(linear, abs=1e-5)
    assert shown_colour(blackbody_light(cct_k)) == shown_colour(np.maximum(linear, 0))


def test_xyz_does_not_depend_on_the_scale_of_power() -> None:
    power = planck(WAVELENGTHS, 5000)
    assert xyz_of(WAVELENGTHS, 7 * power) == pytest.approx(xyz_of(WAVELENGTHS, power))


def test_transfer_function_has_the_values_of_the_standard() -> None:
    assert encode_srgb([0.0, 1.0]).tolist() == [0.0, pytest.approx(1.0)]
    assert encode_srgb(0.0031308) == pytest.approx(12.92 * 0.0031308)
    assert encode_srgb(0.18) == pytest.approx(0.4613561, abs=1e-7)
    assert decode_srgb(0.5) == pytest.approx(0.2140411, abs=1e-7)
    assert decode_srgb(0.04045) == pytest.approx(0.04045 / 12.92)


@given(st.floats(0, 1))
def test_decoding_undoes_encoding(linear: float) -> None:
    # The two pieces of the standard's curve meet within 2·10⁻⁷ of each other.
    assert float(decode_srgb(encode_srgb(linear))) == pytest.approx(linear, abs=3e-8)


def test_encoding_restores_every_code() -> None:
    codes = np.arange(256, dtype=np.uint8)
    back = srgb_codes(decode_srgb(codes / 255))
    assert back.dtype == np.uint8
    np.testing.assert_array_equal(back, codes)


def test_known_angles() -> None:
    assert angles_deg([1, 0, 0], [0, 1, 0]) == pytest.approx(90)
    assert angles_deg([1, 0, 0], [1, 1, 0]) == pytest.approx(45)
    assert angles_deg([1, 1, 1], [-1, -1, -1]) == pytest.approx(180)
