"""A managed print looks as the file says wherever inks reach, and its greys are grey; an unmanaged one has a tint."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import colour
import numpy as np
import pytest
from numpy.typing import NDArray

from sim import spectral
from sim.spectral import (
    PaperName,
    ProfileName,
    print_reflectance,
    printed_reflectance,
)
from tests.sim.world.lab import intended_lab, relative_lab

pytestmark = pytest.mark.slow

PAPERS: tuple[PaperName, ...] = ("poster", "matt", "glossy")
MANAGED: tuple[PaperName, ...] = ("poster", "glossy")
"""Papers whose profiles are worked out here, each in a second: the one with the least black, and the one with most."""
GREYS = np.repeat(np.arange(256)[:, None], 3, axis=1)
CODES = np.array(list(product(range(0, 256, 17), repeat=3)))


@cache
def seen(profile: ProfileName, on: PaperName) -> NDArray[np.float64]:
    """Return CIELAB of all greys under D50, relative to paper."""
    return relative_lab(printed_reflectance(GREYS, profile, on), on)


def difference(wanted: NDArray[np.float64], lab: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(colour.delta_E(wanted, lab, method="CIE 2000"), dtype=np.float64)


@pytest.mark.parametrize("on", PAPERS)
def test_unmanaged_greys_have_the_tint_that_measured_prints_have(on: PaperName) -> None:
    # Papers printed without colour management (head of `sim.world.world`): the largest chroma is 5 to 14, but for one
    # printer, an Epson P800, whose driver balances its greys (1.3).
    lab = seen("unmanaged", on)
    assert 5 < np.hypot(lab[:, 1], lab[:, 2]).max() < 14
    assert np.diff(lab[:, 0]).min() > 0


@pytest.mark.parametrize("on", MANAGED)
def test_a_managed_print_has_the_colours_of_the_file_where_inks_reach(on: PaperName) -> None:
    rng = np.random.default_rng(3)
    pale = 128 + rng.integers(-40, 41, (400, 3))
    off = difference(intended_lab(pale, on), relative_lab(printed_reflectance(pale, "managed", on), on))
    assert np.median(off) < 0.3
    assert off.max() < 2.5


def test_no_ink_code_comes_nearer_than_the_profile_s() -> None:
    axis = np.linspace(0, 255, 33)
    inks = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    every = relative_lab(print_reflectance(inks, "glossy"), "glossy")
    # Nodes of the profile's table, so that nothing is interpolated.
    codes = np.random.default_rng(8).integers(0, 33, (60, 3)) * 255 / 32
    wanted = intended_lab(codes, "glossy")
    lab = relative_lab(printed_reflectance(codes, "managed", "glossy"), "glossy")
    for target, found in zip(wanted, lab, strict=True):
        along = target[1:] / np.hypot(*target[1:])

        def away(
            seen: NDArray[np.float64], target: NDArray[np.float64] = target, along: NDArray[np.float64] = along
        ) -> NDArray[np.float64]:
            off = seen - target
            hue = off[..., 2] * along[0] - off[..., 1] * along[1]
            return np.sqrt((off**2).sum(axis=-1) + 3 * hue**2)

        assert float(away(found)) < float(away(every).min()) + 0.01


def test_srgb_under_d50_is_the_adapted_matrix_of_its_primaries() -> None:
    space = colour.RGB_COLOURSPACES["sRGB"]
    whites: Any = [colour.xy_to_XYZ(xy) for xy in (space.whitepoint, (0.3457, 0.3585))]
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, transform="Bradford")
    found = spectral._SRGB_TO_D50
    np.testing.assert_allclose(found, adapt @ space.matrix_RGB_to_XYZ, atol=2e-4)
