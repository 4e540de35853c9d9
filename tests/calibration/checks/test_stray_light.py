"""Light that single frames have and dark ones have not: what whites show of it, and what must not be taken for it."""

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


def found(
    seed: int = 1, *, stray: dict[int, float] | None = None, boost: float = 0, flicker: float = 0, noise: float = 3e-4
) -> Any:
    """Return what is found of lights of a random projector whose whites have noise, and white frames of it."""
    random = np.random.default_rng(seed)
    paper = np.array([[2000, 500, 100], [1100, 5700, 870], [110, 1130, 4600]]) * random.uniform(0.8, 1.25, (3, 3))
    response = random.uniform(1.6, 2.6, 3)

    def seen(codes: _Array) -> _Array:
        amounts = (codes / 255) ** response
        # A segment of the wheel that is yellow adds light that is no sum of the primaries'.
        overlap = boost * np.minimum(amounts[..., 0], amounts[..., 1])[..., None] * np.array([2300, 6000, 300])
        return amounts @ paper + overlap

    lights = seen(CODES.astype(np.float64))
    for light, share in (stray or {}).items():
        lights[light] += share * paper.sum(axis=0)
    full = np.repeat(seen(np.full((1, 3), 255.0)), 3, axis=0)
    lamp = random.normal(1, flicker, (len(CODES) + 3, 1)) if flicker else np.ones((len(CODES) + 3, 1))
    sigma = noise * lights + 0.3
    whites = (lights + random.normal(0, 1, lights.shape) * sigma) * lamp[3:]
    return stray_light(CODES, whites, sigma, full * (1 + random.normal(0, noise, (3, 3))) * lamp[:3], PRIMARIES)


@pytest.mark.parametrize("seed", range(40))
def test_a_healthy_projector_has_none(seed: int) -> None:
    assert found(seed).share < 0.001
    assert found(seed, boost=0.3).share < 0.001
    assert found(seed, noise=5e-3).share < 0.004
    assert found(seed, flicker=0.01).share < 0.004


@pytest.mark.parametrize("light", [YELLOW, DIM])
def test_light_in_one_frame_is_found_there(light: int) -> None:
    stray = found(stray={light: 0.01})
    assert stray.share == pytest.approx(0.01, abs=0.002)
    assert stray.lights_beyond(0.004) == [light]


def test_light_in_the_frame_of_a_primary_is_missed_in_lights_that_are_made_of_it() -> None:
    stray = found(stray={RED: 0.01})
    assert stray.share == pytest.approx(0.01, abs=0.002)
    assert stray.at_zero[YELLOW] == pytest.approx(-0.01, abs=0.002)
    assert RED in stray.lights_beyond(0.004)
    assert YELLOW not in stray.lights_beyond(0.004)


def test_light_in_all_primaries_shows_against_white() -> None:
    stray = found(stray={0: 0.01, 2: 0.01})
    assert stray.of_primaries == pytest.approx(0.018, abs=0.003)
    assert set(stray.lights_beyond(0.004)) >= {0, 2}


def held_back(share: float, leak: float = 0.0) -> Any:
    """Return what is found where full white is held back by a share, and red's frame has other light, if any."""
    levels = (0, 60, 150, 255)
    mixed = [(r, g, b) for r in levels for g in levels for b in levels if (r, g, b).count(0) < 2]
    codes = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), *mixed], dtype=np.int64)
    paper = np.array([[2000, 500, 100], [1100, 5700, 870], [110, 1130, 4600]], dtype=np.float64)
    whites = (codes / 255) ** 2.2 @ paper
    whites[(codes == 255).all(axis=1)] *= 1 - share
    whites[0] += leak * paper.sum(axis=0)
    full = np.repeat(paper.sum(axis=0)[None], 3, axis=0) * (1 - share)
    return stray_light(codes, whites, 1e-4 * whites + 0.1, full, PRIMARIES)


def test_a_projector_that_holds_full_white_back_is_known_by_its_other_lights() -> None:
    assert held_back(0.03).share == 0
    # Other light in a primary's frame is missed by lights of it.
    assert held_back(0.03, leak=0.01).share > 0.008


def test_a_light_of_another_name_is_none_of_a_room() -> None:
    """A frame of white under the name of a dim red one."""
    assert found(stray={DIM: 1.0}).share < 0.001


def test_lights_without_a_code_of_zero_are_not_checked() -> None:
    stray = found(stray={WARM: 0.01})
    assert stray.share < 0.001
    assert not stray.checked[[0, 1, 2, WHITE, WARM]].any()
    assert stray.checked.sum() == 5
    assert stray.to_json()["at_zero_codes"][WARM] is None


def test_where_white_is_brightened_lights_with_a_code_of_zero_are_checked_still() -> None:
    stray = found(boost=0.3, stray={DIM: 0.01})
    assert stray.lights_beyond(0.004) == [DIM]
    assert stray.checked.sum() == 5


def test_what_looks_like_a_boost_does_not_switch_the_check_off() -> None:
    """Light in a primary's frame, the more of it the worse: never less is said of it."""
    shares = [found(stray={0: amount}).share for amount in (0.005, 0.01, 0.02, 0.04)]
    assert np.all(np.diff(shares) > 0)
    assert shares[-1] > 0.01


def test_what_cannot_be_known_is_not_said() -> None:
    whites = np.full((len(CODES), 3), 100.0)
    assert stray_light(CODES, whites, whites * 1e-3, whites[:2], None) is None
    assert stray_light(CODES, whites, whites * 1e-3, whites[:2], PRIMARIES) is None
    assert stray_light(CODES, whites * np.nan, whites * 1e-3, whites[:2], PRIMARIES) is None
