"""Colorimetry against colour-science, which the suite itself does without."""

from __future__ import annotations

import colour
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiment.lights import CCTS_K, blackbody_light, shown_colour
from foundation.colorimetry.observer import XYZ_TO_SRGB, linear_srgb, observer_cie_1931, planck, xyz_of

WAVELENGTHS = np.arange(360.0, 781.0)


def test_the_observer_is_the_cie_s_of_1931() -> None:
    wavelengths, functions = observer_cie_1931()
    theirs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    assert np.array_equal(wavelengths, theirs.wavelengths)
    assert np.array_equal(functions, theirs.values)
    # CIE 15:2018, table 1: the greatest value of ȳ, and the wavelength at which it stands.
    assert (wavelengths[functions[:, 1].argmax()], functions[:, 1].max()) == (555, 1.0)


def test_the_matrix_is_that_of_the_standard() -> None:
    assert np.array_equal(XYZ_TO_SRGB, colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB)


@given(st.floats(1000, 25_000))
def test_black_bodies_are_those_of_colour_science(cct_k: float) -> None:
    theirs = colour.sd_blackbody(cct_k, colour.SpectralShape(360, 780, 1))
    assert planck(WAVELENGTHS, cct_k) == pytest.approx(theirs.values, rel=1e-12)


@pytest.mark.parametrize("cct_k", CCTS_K)
def test_the_plan_s_codes_are_those_that_colour_science_gives(cct_k: float) -> None:
    spectrum = colour.sd_blackbody(cct_k, colour.SpectralShape(360, 780, 1))
    xyz = np.asarray(colour.sd_to_XYZ(spectrum, k=1.0))
    linear = np.asarray(colour.XYZ_to_sRGB(xyz / xyz[1], apply_cctf_encoding=False))
    assert linear_srgb(xyz_of(WAVELENGTHS, planck(WAVELENGTHS, cct_k))) == pytest.approx(linear, abs=1e-5)
    assert shown_colour(blackbody_light(cct_k)) == shown_colour(np.maximum(linear, 0))


def test_a_light_that_is_scaled_has_the_same_xyz() -> None:
    power = planck(WAVELENGTHS, 5000)
    assert xyz_of(WAVELENGTHS, 7 * power) == pytest.approx(xyz_of(WAVELENGTHS, power))
