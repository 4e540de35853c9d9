"""Gamut of a LUT: mixtures for a target, and their agreement with photographed illuminants."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import f as f_distribution

from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from drivers.presenter import Colour
from experiment.lights import Illuminant
from foundation.colorimetry import angles_deg
from foundation.errors import InputError
from generator.lights.gamut import (
    TOLERANCE_DEG,
    Gamut,
    black_body,
    rb_of,
    rgb_of,
)
from generator.lights.lighting import Mixture, single_mixture
from sim.world.world import Room
from tests.calibration.lab import SETTINGS, Lab, hang, take
from tests.generator.conftest import MakeLut

PRIMARIES = np.array([[5000.0, 900.0, 300.0], [900.0, 6000.0, 1000.0], [150.0, 1100.0, 4800.0]])


def grid(steps: int = 8) -> npt.NDArray[np.float64]:
    """Return the ground truths of a triangular grid of illuminants, with the brightest primary at full drive."""
    drives = np.array([[i, steps - i - j, j] for i in range(steps + 1) for j in range(steps + 1 - i)], dtype=np.float64)
    return drives / drives.max(axis=1, keepdims=True) @ PRIMARIES


def mixed_rgb(gamut: Gamut, mixture: Mixture) -> npt.NDArray[np.float64]:
    return np.asarray(mixture.weights) @ gamut.white[list(mixture.lights)]


GRID = Gamut(grid())

_drives = st.tuples(*[st.floats(0.001, 1.0)] * 3)


@given(_drives)
def test_matches_any_light_with_at_most_three_neighbours(drives: tuple[float, float, float]) -> None:
    target = np.array(drives) @ PRIMARIES
    match = GRID.match(target)
    assert len(match.mixture.lights) <= 3
    angle = float(angles_deg(mixed_rgb(GRID, match.mixture), target))
    assert angle == pytest.approx(match.angle, abs=1e-9)
    # Three illuminants match exactly, except for the rounding of weights.
    assert angle < (1e-6 if len(match.mixture.lights) == 3 else TOLERANCE_DEG)
    assert sum(match.mixture.weights) == pytest.approx(1, abs=1e-12)
    # Illuminants of the mixture are neighbours: their distance is at most the longest side of a triangle.
    lights = GRID.white[list(match.mixture.lights)]
    longest = angles_deg(GRID.directions[GRID.edges[:, 0]], GRID.directions[GRID.edges[:, 1]]).max()
    assert angles_deg(lights[:, None], lights[None]).max() <= longest + 1e-9


def test_uses_fewest_lights() -> None:
    single = GRID.match(3 * GRID.white[17])
    assert (single.mixture.lights, single.mixture.weights) == ((17,), (1.0,))
    assert single.angle < 1e-6
    first, second = (int(light) for light in GRID.edges[20])
    two = GRID.match(GRID.white[first] + 2 * GRID.white[second]).mixture
    assert two.lights == (first, second)
    np.testing.assert_allclose(two.weights, [1 / 3, 2 / 3], atol=2e-9)
    third = GRID.triangles[11]
    three = GRID.match(GRID.white[third].sum(axis=0)).mixture
    assert three.lights == tuple(third)
    np.testing.assert_allclose(three.weights, 1 / 3, atol=2e-9)


def test_tolerance_of_one_light() -> None:
    axis = np.cross(GRID.directions[17], [0.3, -0.5, 0.4])
    axis /= np.linalg.norm(axis)
    for share, lights in ((0.9, 1), (1.2, 2)):
        rotated = GRID.directions[17] + np.radians(share * TOLERANCE_DEG) * axis
        assert len(GRID.match(rotated).mixture.lights) >= lights
        assert (len(GRID.match(rotated).mixture.lights) == 1) == (lights == 1)


@pytest.mark.slow
def test_refuses_light_outside_gamut_with_nearest() -> None:
    target = rgb_of([0.9, 0.02])
    with pytest.raises(InputError, match=r"r=0\.9000, b=0\.0200.*° outside.*r=") as info:
        GRID.match(target)
    nearest = GRID.match(target, outside="nearest")
    # Brute force over all mixtures of two illuminants.
    share = np.linspace(0, 1, 401)[:, None, None, None]
    pairs = share * GRID.directions[:, None] + (1 - share) * GRID.directions[None]
    smallest = angles_deg(pairs.reshape(-1, 3), target).min()
    assert nearest.angle == pytest.approx(smallest, rel=1e-4)
    assert f"{nearest.angle:.2f}°" in str(info.value)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_contains_agrees_with_match(r: float, b: float) -> None:
    if r + b > 1:
        r, b = 1 - r, 1 - b
    target = rgb_of([r, b])
    if GRID.contains(target[None])[0]:
        assert GRID.match(target).angle <= TOLERANCE_DEG
    else:
        # The gamut is the set of nonnegative drives of the primaries, except for rounding and the tolerance.
        drives = np.linalg.solve(PRIMARIES.T, target)
        assert drives.min() < 1e-9


@pytest.mark.parametrize("target", [[0.0, 0, 0], [1, -1, 1], [1, 2], [np.nan, 1, 1], [[1, 2, 3]]])
def test_refuses_invalid_light(target: list[float]) -> None:
    with pytest.raises(InputError):
        GRID.match(target)


def test_chromaticity_round_trip() -> None:
    rgb = np.array([[2.0, 5.0, 1.0], [0.1, 0.2, 0.7]])
    np.testing.assert_allclose(rb_of(rgb), [[0.25, 0.125], [0.1, 0.7]])
    np.testing.assert_allclose(rgb_of(rb_of(rgb)), rgb / rgb.sum(axis=1, keepdims=True))
    np.testing.assert_array_equal(GRID.contains(rb_of(GRID.white * 1.0)[40:41]), [True])


def test_lights_on_a_line_mix_neighbours() -> None:
    line = Gamut(np.array([[1.0, 4.0, 3.0], [3.0, 4.0, 1.0], [2.0, 4.0, 2.0], [2.0, 4.0, 2.0]]))
    assert len(line.triangles) == 0
    match = line.match([1.25, 4, 2.75])
    assert match.mixture.lights == (0, 2)
    np.testing.assert_allclose(match.mixture.weights, [0.75, 0.25], atol=1e-9)
    with pytest.raises(InputError, match="outside"):
        line.match([1, 3, 3])
    assert not line.contains(np.array([[1.25, 4, 2.75]]))[0]


@pytest.mark.parametrize("lights", [1, 2])
def test_gamut_of_one_or_two_lights(lights: int) -> None:
    small_gamut = Gamut(PRIMARIES[:lights])
    assert small_gamut.match(PRIMARIES[0]).mixture.lights == (0,)
    assert small_gamut.match(PRIMARIES[:lights].sum(axis=0)).mixture.lights == tuple(range(lights))
    assert small_gamut.match([1.0, 0.0, 0.0], "nearest").mixture.lights == (0,)


def test_interpolates_black_bodies_in_mired(make_lut: MakeLut) -> None:
    # The black bodies of the LUT are the illuminants 1 and 3, at 3001 and 3003 K.
    lut = make_lut(lights=5)
    assert black_body(lut, 3001).lights == (1,)
    assert black_body(lut, 3003).lights == (3,)
    middle = 2 / (1 / 3001 + 1 / 3003)
    mixture = black_body(lut, middle)
    assert mixture.lights == (1, 3)
    white = mixture.white(lut)
    np.testing.assert_allclose(white / white.sum(), lut.ground_truth[[1, 3]].mean(axis=0), rtol=1e-8)
    nearly = black_body(lut, 3001.2).white(lut)
    assert angles_deg(nearly, lut.white[1]) < angles_deg(nearly, lut.white[3])


def test_refuses_temperature_outside_range(make_lut: MakeLut) -> None:
    lut = make_lut(lights=5)
    for cct_k in (3000.9, 3003.1):
        with pytest.raises(InputError):
            black_body(lut, cct_k)
    with pytest.raises(InputError):
        black_body(make_lut(lights=1, name="none"), 3001)


# Three illuminants, the even mixture of the first two, and the even mixture of all three.
CODES = (
    Colour(255, 100, 40),
    Colour(255, 200, 240),
    Colour(255, 60, 200),
    Colour(255, 150, 140),
    Colour(255, 120, 160),
)

CASES = (
    pytest.param(Mixture((0, 1), (0.5, 0.5)), 3, id="two"),
    pytest.param(Mixture((0, 1, 2), (1 / 3, 1 / 3, 1 / 3)), 4, id="three"),
)


@pytest.fixture(scope="module")
def lab() -> Lab:
    return hang(room=Room(waviness_mm=0.5, transfer=1.0))


@pytest.fixture(scope="module")
def table(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Lut:
    folder = tmp_path_factory.mktemp("realism")
    lights = tuple(Illuminant(index, "uniform", None, colour) for index, colour in enumerate(CODES))
    with take(lab, folder / "session", lights, every=3) as session:
        result = build(session, folder / "lut")
    assert result.lut is not None
    return open_lut(result.lut)


def variances(samples: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    return np.asarray(samples.astype(np.float64).var(axis=1, ddof=1))


@pytest.mark.slow
@pytest.mark.parametrize(("mixture", "photographed"), CASES)
def test_mixture_matches_photographed_light(mixture: Mixture, photographed: int, table: Lut, lab: Lab) -> None:
    truth = lab.world.white(CODES[photographed], SETTINGS)
    white = mixture.white(table)
    assert angles_deg(white, table.white[photographed]) < 0.05
    # The LUT of this small chart is itself within 0.2° of the true illuminant.
    assert angles_deg(white, truth) < 0.2
    np.testing.assert_allclose(white / table.white[photographed], 1, atol=0.005)
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    true = lab.world.reflected(codes, CODES[photographed], SETTINGS) / truth * white
    mean = mixture.samples(table).astype(np.float64).mean(axis=1)
    lit = true > 300
    error = (mean / true - 1)[lit]
    assert lit.sum() > 600
    assert abs(error.mean()) < 0.003
    assert np.sqrt((error**2).mean()) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("mixture", "photographed"), CASES)
def test_mixture_has_noise_of_one_exposure(mixture: Mixture, photographed: int, table: Lut) -> None:
    # Pooled variances of 512 patches; their ratio follows the F distribution with 512 · 24 degrees of freedom, because
    # the noise of patches is independent. Six tests at 10⁻⁶ each. Averaged noise would be half as large.
    real = variances(table.samples[photographed])
    mixed = variances(mixture.samples(table))
    freedom = 24 * len(real)
    low, high = (float(f_distribution.ppf(share, freedom, freedom)) for share in (5e-7, 1 - 5e-7))
    expected = (real + mixed) / 2
    for channel in range(3):
        ratio = mixed[:, channel].sum() / real[:, channel].sum()
        # Patches with unequal variances have fewer degrees of freedom (Satterthwaite).
        cells = expected[:, channel].sum() ** 2 / (expected[:, channel] ** 2).sum()
        spread = np.sqrt(len(real) / cells)
        assert 1 + (low - 1) * spread < ratio < 1 + (high - 1) * spread


@pytest.mark.slow
def test_match_of_photographed_light_reproduces_its_colours(table: Lut, lab: Lab) -> None:
    # The target was photographed but is not in the gamut's list; its colours must be reproduced as well.
    gamut = Gamut(table.white[:3])
    match = gamut.match(table.white[4])
    assert match.mixture.lights == (0, 1, 2)
    np.testing.assert_allclose(match.mixture.weights, 1 / 3, atol=0.02)
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    true = lab.world.reflected(codes, CODES[4], SETTINGS) / lab.world.white(CODES[4], SETTINGS)
    mean = match.mixture.samples(table).astype(np.float64).mean(axis=1) / match.mixture.white(table)
    lit = true * table.white[4] > 300
    assert np.sqrt(((mean / true - 1)[lit] ** 2).mean()) < 0.01
    assert single_mixture(4).samples(table).shape == match.mixture.samples(table).shape
