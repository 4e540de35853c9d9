"""Positions in a print compared with an exhaustive search."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from calibration.table.lut import open_lut
from foundation.colorimetry import angles_deg
from generator.rendering import print_inverse
from generator.rendering.colorimetric import BLACK_WITHIN_DEG, MOST_LIFT, black_point, reference_light, source_colours
from generator.rendering.matrices import matrix_for
from generator.rendering.print_inverse import corners, invert
from generator.rendering.print_profiles import PrintProfile, profile_of
from synthesis.lamps import read_lights
from synthesis.settings import parse_settings, table_task
from synthesis.table import compute_table

Array = npt.NDArray[np.float64]

# Brightness has half the weight of chromaticity, along unit vectors.
SCALE = np.array([[0.5**0.5 / 3**0.5] * 3, [0.5**0.5, 0, -(0.5**0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]])


def shown(colours: Array, positions: Array, bits: int) -> Array:
    """Return the colours of a print at positions."""
    side = 1 << bits
    print_at = RegularGridInterpolator([np.arange(side)] * 3, colours.reshape(side, side, side, 3))
    return np.asarray(print_at(positions), np.float64)


def searched(colours: Array, targets: Array, bits: int) -> tuple[Array, Array]:
    """Return colours and residuals of the nearest of all positions on a grid with 8 steps between patches."""
    axis = np.linspace(0, (1 << bits) - 1, 8 * ((1 << bits) - 1) + 1)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    grid_colours = shown(colours, grid, bits)
    residuals, nearest = KDTree(np.log(grid_colours) @ SCALE.T).query(np.log(targets) @ SCALE.T)
    return grid_colours[nearest], np.asarray(residuals, np.float64)


def computed_profile(camera: str, room: dict[str, str], out: Path) -> tuple[PrintProfile, Array]:
    """Return the profile of a computed LUT of 512 colours under daylight, and source colours for its camera."""
    settings = parse_settings({"room": room, "chart": {"bits": 3}}, "settings")
    compute_table(table_task(camera, settings, "settings", read_lights("5600K")), out, threads=2)
    lut = open_lut(out)
    return profile_of(lut, reference_light(lut)), source_colours(matrix_for(lut))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "paper", "profile_name"),
    [
        ("EOS 550D", "glossy", "unmanaged"),
        ("Canon_EOS_5DS", "matt", "unmanaged"),
        ("Canon_EOS_600D", "glossy", "managed"),
    ],
)
def test_no_other_position_is_nearer(camera: str, paper: str, profile_name: str, tmp_path: Path) -> None:
    profile, source = computed_profile(camera, {"paper": paper, "profile": profile_name}, tmp_path / "lut")
    colours, bits = profile.colours, profile.bits
    targets = profile.black + (profile.white - profile.black) * source
    result = shown(colours, invert(colours, targets, bits), bits)
    residuals = np.linalg.norm((np.log(result) - np.log(targets)) @ SCALE.T, axis=1)
    # Exact colours, and colours outside the gamut; 0.0001 is the tolerance of the search.
    levels = profile.black * np.linspace(1, MOST_LIFT, 26)
    greys = levels[:, None] * np.ones(3)
    found_colours, found_residuals = searched(colours, np.concatenate([targets, greys]), bits)
    assert (residuals - found_residuals[: len(targets)]).max() < 1.1e-4
    # Colours that the print shows at a known position.
    positions = np.random.default_rng(3).uniform(0, (1 << bits) - 1, (2000, 3)) ** 2 / ((1 << bits) - 1)
    targets = shown(colours, positions, bits)
    result = shown(colours, invert(colours, targets, bits), bits)
    assert angles_deg(result, targets).max() < 0.02
    assert np.abs(result / targets - 1).max() < 5e-4
    # The black point is a grey of the print, and the search has no darker one. Without a grey, it is the print's black.
    black = black_point(profile, colours, bits)
    is_neutral = angles_deg(found_colours[len(source) :], np.ones(3)) <= BLACK_WITHIN_DEG
    assert black <= min(levels[is_neutral], default=np.inf)
    shown_black = shown(colours, invert(colours, np.full((1, 3), black), bits), bits)
    assert black == profile.black or angles_deg(shown_black, np.ones(3))[0] <= BLACK_WITHIN_DEG


def test_search_leaves_folds_of_dark_colours() -> None:
    # Noise is stronger than the rise from patch to patch, so a descent stops between patches or at an edge.
    bits, rng = 3, np.random.default_rng(5)
    code = np.stack(np.meshgrid(*[np.arange(8) / 7] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    colours = (0.02 + code**3) * rng.uniform(0.7, 1.3, (512, 3))
    positions = rng.uniform(0, 3, (300, 3))
    targets = shown(colours, positions, bits)
    np.testing.assert_allclose(shown(colours, invert(colours, targets, bits), bits), targets, rtol=3e-4)


def test_residual_and_jacobian_match_interpolated_print() -> None:
    rng = np.random.default_rng(8)
    patches, target = rng.uniform(0.1, 1, (8, 3)), np.log([0.3, 0.5, 0.4])
    print_at = RegularGridInterpolator(
        [np.arange(2)] * 3, patches.reshape(2, 2, 2, 3), bounds_error=False, fill_value=None
    )
    np.testing.assert_allclose(print_inverse._SCALE, SCALE)

    def residual(position: Array) -> Array:
        return SCALE @ (np.log(print_at(position)[0]) - target)

    for position in [*rng.uniform(0.1, 0.9, (9, 3)), np.zeros(3), np.ones(3)]:
        found_residual, jacobian = np.empty(3), np.empty((3, 3))
        square = print_inverse._evaluate(patches, position, target, SCALE, found_residual, jacobian)
        np.testing.assert_allclose(found_residual, residual(position))
        assert square == pytest.approx((found_residual**2).sum())
        steps = 1e-5 * np.eye(3)
        expected = [(residual(position + step) - residual(position - step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(jacobian, np.transpose(expected), atol=1e-6)


def test_weights_of_corners_interpolate_patches() -> None:
    rng = np.random.default_rng(9)
    colours, positions = rng.uniform(0.1, 1, (64, 3)), np.concatenate([rng.uniform(0, 3, (50, 3)), np.eye(3) * 3])
    around, weights = corners(positions, 2)
    np.testing.assert_allclose(np.einsum("kc,kcx->kx", weights, colours[around]), shown(colours, positions, 2))
