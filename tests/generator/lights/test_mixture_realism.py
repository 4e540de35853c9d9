"""Mixtures of photographed lights against the same light photographed: brightness, colour and noise.

The room's projector is linear here, so that a code halfway between two lights' codes is their even mixture to the last
digit, stray light included.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import f as f_distribution

from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from drivers.presenter import Colour
from experiment.lights import Illumination
from foundation.colorimetry import angles_deg
from generator.lights.gamut import Gamut
from generator.lights.lighting import Mixture, plain
from sim.world.world import Room
from tests.calibration.lab import SETTINGS, Lab, hang, take

pytestmark = pytest.mark.slow

CODES = (
    Colour(255, 100, 40),
    Colour(255, 200, 240),
    Colour(255, 60, 200),
    Colour(255, 150, 140),
    Colour(255, 120, 160),
)
"""Three lights, the even mixture of the first two, and the even mixture of all three."""
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
    lights = tuple(Illumination(index, "uniform", None, colour) for index, colour in enumerate(CODES))
    with take(lab, folder / "session", lights, every=3) as session:
        result = build(session, folder / "lut")
    assert result.lut is not None
    return open_lut(result.lut)


def variances(samples: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    return np.asarray(samples.astype(np.float64).var(axis=1, ddof=1))


@pytest.mark.parametrize(("mixture", "photographed"), CASES)
def test_white_and_every_colour_are_those_of_the_real_light(
    mixture: Mixture, photographed: int, table: Lut, lab: Lab
) -> None:
    truth = lab.world.white(CODES[photographed], SETTINGS)
    white = mixture.white(table)
    assert angles_deg(white, table.white[photographed]) < 0.05
    # The small chart's table is itself within 0.2° of the room's light.
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


@pytest.mark.parametrize(("mixture", "photographed"), CASES)
def test_noise_is_that_of_one_exposure(mixture: Mixture, photographed: int, table: Lut) -> None:
    """Variances of 512 cells, pooled in each channel; the ratio of two of them follows F.

    The cells of one table share their lens and paper, but their noise is independent, so each channel has 512 · 24
    degrees of freedom. Six tests at 10⁻⁶ each; averaged noise would be half as large and fail by a hundred orders.
    """
    real = variances(table.samples[photographed])
    mixed = variances(mixture.samples(table))
    freedom = 24 * len(real)
    low, high = (float(f_distribution.ppf(share, freedom, freedom)) for share in (5e-7, 1 - 5e-7))
    expected = (real + mixed) / 2
    for channel in range(3):
        ratio = mixed[:, channel].sum() / real[:, channel].sum()
        # The sum over unequal cells has fewer degrees of freedom than their number (Satterthwaite); allow for it.
        cells = expected[:, channel].sum() ** 2 / (expected[:, channel] ** 2).sum()
        spread = np.sqrt(len(real) / cells)
        assert 1 + (low - 1) * spread < ratio < 1 + (high - 1) * spread


def test_the_mixture_found_for_a_real_light_is_that_light(table: Lut, lab: Lab) -> None:
    """Ask for the white of a light that was photographed but left out: its colours come out, too."""
    gamut = Gamut(table.white[:3])
    match = gamut.match(table.white[4])
    assert match.mixture.lights == (0, 1, 2)
    np.testing.assert_allclose(match.mixture.weights, 1 / 3, atol=0.02)
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    true = lab.world.reflected(codes, CODES[4], SETTINGS) / lab.world.white(CODES[4], SETTINGS)
    mean = match.mixture.samples(table).astype(np.float64).mean(axis=1) / match.mixture.white(table)
    lit = true * table.white[4] > 300
    assert np.sqrt(((mean / true - 1)[lit] ** 2).mean()) < 0.01
    assert plain(4).samples(table).shape == match.mixture.samples(table).shape
