"""Light in single frames: detection from whites, and cases that must not be reported."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.checks.stray_light import stray_light

_Array = npt.NDArray[np.float64]

CODES = np.array(
    [
        *([255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [255, 255, 0]),
        *([90, 0, 0], [200, 80, 0], [255, 160, 70], [0, 140, 255], [160, 0, 60]),
    ],
    dtype=np.int64,
)
RED, WHITE, YELLOW, DIM, WARM = 0, 3, 4, 5, 7
PRIMARIES = (0, 1, 2)


def measured(
    seed: int = 1, *, stray: dict[int, float] | None = None, boost: float = 0, flicker: float = 0, noise: float = 3e-4
) -> Any:
    """Return the result for a random projector with noise, including white frames."""
    random = np.random.default_rng(seed)
    paper = np.array([[2000, 500, 100], [1100, 5700, 870], [110, 1130, 4600]]) * random.uniform(0.8, 1.25, (3, 3))
    response = random.uniform(1.6, 2.6, 3)

    def projected(codes: _Array) -> _Array:
        amounts = (codes / 255) ** response
        # A yellow segment of the wheel adds light beyond the sum of the primaries.
        overlap = boost * np.minimum(amounts[..., 0], amounts[..., 1])[..., None] * np.array([2300, 6000, 300])
        return amounts @ paper + overlap

    lights = projected(CODES.astype(np.float64))
    for light, share in (stray or {}).items():
        lights[light] += share * paper.sum(axis=0)
    full = np.repeat(projected(np.full((1, 3), 255.0)), 3, axis=0)
    lamp = random.normal(1, flicker, (len(CODES) + 3, 1)) if flicker else np.ones((len(CODES) + 3, 1))
    sigma = noise * lights + 0.3
    whites = (lights + random.normal(0, 1, lights.shape) * sigma) * lamp[3:]
    return stray_light(CODES, whites, sigma, full * (1 + random.normal(0, noise, (3, 3))) * lamp[:3], PRIMARIES)


@pytest.mark.parametrize("seed", range(40))
def test_healthy_projector_has_no_stray_light(seed: int) -> None:
    assert measured(seed).share < 0.001
    assert measured(seed, boost=0.3).share < 0.001
    assert measured(seed, noise=5e-3).share < 0.004
    assert measured(seed, flicker=0.01).share < 0.004


@pytest.mark.parametrize("light", [YELLOW, DIM])
def test_locates_light_in_one_frame(light: int) -> None:
    stray = measured(stray={light: 0.01})
    assert stray.share == pytest.approx(0.01, abs=0.002)
    assert stray.lights_beyond(0.004) == [light]


def test_locates_light_in_frame_of_primary() -> None:
    stray = measured(stray={RED: 0.01})
    assert stray.share == pytest.approx(0.01, abs=0.002)
    assert stray.at_zero[YELLOW] == pytest.approx(-0.01, abs=0.002)
    assert RED in stray.lights_beyond(0.004)
    assert YELLOW not in stray.lights_beyond(0.004)


def test_detects_light_in_primaries_against_white() -> None:
    stray = measured(stray={0: 0.01, 2: 0.01})
    assert stray.of_primaries == pytest.approx(0.018, abs=0.003)
    assert set(stray.lights_beyond(0.004)) >= {0, 2}


def with_reduced_white(share: float, leak: float = 0.0) -> Any:
    """Return the result if full white is reduced by a share, and the red frame has other light."""
    levels = (0, 60, 150, 255)
    mixed = [(r, g, b) for r in levels for g in levels for b in levels if (r, g, b).count(0) < 2]
    codes = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), *mixed], dtype=np.int64)
    paper = np.array([[2000, 500, 100], [1100, 5700, 870], [110, 1130, 4600]], dtype=np.float64)
    whites = (codes / 255) ** 2.2 @ paper
    whites[(codes == 255).all(axis=1)] *= 1 - share
    whites[0] += leak * paper.sum(axis=0)
    full = np.repeat(paper.sum(axis=0)[None], 3, axis=0) * (1 - share)
    return stray_light(codes, whites, 1e-4 * whites + 0.1, full, PRIMARIES)


def test_mixtures_identify_reduced_white() -> None:
    assert with_reduced_white(0.03).share == 0
    # Mixtures of red lack the other light in its frame.
    assert with_reduced_white(0.03, leak=0.01).share > 0.008


def test_ignores_exchanged_frames() -> None:
    """A frame of white with the name of a dim red."""
    assert measured(stray={DIM: 1.0}).share < 0.001


def test_skips_illuminants_without_zero_code() -> None:
    stray = measured(stray={WARM: 0.01})
    assert stray.share < 0.001
    assert not stray.checked[[0, 1, 2, WHITE, WARM]].any()
    assert stray.checked.sum() == 5
    assert stray.to_json()["at_zero_codes"][WARM] is None


def test_checks_zero_codes_despite_white_boost() -> None:
    stray = measured(boost=0.3, stray={DIM: 0.01})
    assert stray.lights_beyond(0.004) == [DIM]
    assert stray.checked.sum() == 5


def test_apparent_boost_does_not_disable_check() -> None:
    """More light in the frame of a primary always gives a larger result."""
    shares = [measured(stray={0: amount}).share for amount in (0.005, 0.01, 0.02, 0.04)]
    assert np.all(np.diff(shares) > 0)
    assert shares[-1] > 0.01


def test_returns_none_without_measurement() -> None:
    whites = np.full((len(CODES), 3), 100.0)
    assert stray_light(CODES, whites, whites * 1e-3, whites[:2], None) is None
    assert stray_light(CODES, whites, whites * 1e-3, whites[:2], PRIMARIES) is None
    assert stray_light(CODES, whites * np.nan, whites * 1e-3, whites[:2], PRIMARIES) is None
