"""Exchanged illuminants in rooms with known light, and healthy rooms of all kinds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.checks.light_codes import CodeAgreement, code_agreement
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.verdict import judge
from experiment.lights import plan_illuminants
from experiment.session.records import SessionStep
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import FormatError
from sim.spectral import projector_primaries, sensitivities
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, take

pytestmark = pytest.mark.slow

_Array = npt.NDArray[np.float64]
Codes = Sequence[tuple[int, int, int]]

PLAN = plan_illuminants(13, (3000, 6500))
LIMIT = next(limit for limit in FIGURES if limit.name == "off_codes_deg")
ROOMS = {
    "default": Room(),
    "bright room": Room(ambient=0.1, black_leak=0.01),
    "led, steep": Room(lamp_spectrum="led", transfer=2.6),
    "flat": Room(transfer=1.8, projector_falloff=0.3, primary_difference=0.4),
}
SESSIONS: dict[str, Codes] = {
    "two": [(255, 255, 255), (255, 120, 60)],
    "red and white": [(255, 0, 0), (255, 255, 255)],
    "primaries": [(255, 0, 0), (0, 255, 0), (0, 0, 255)],
    "two black bodies": [light.colour for light in plan_illuminants(0, (3000, 8000))],
    "five black bodies": [light.colour for light in plan_illuminants(0, (2500, 3500, 4500, 6500, 9500))],
    "eight": [
        (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 200, 120), (150, 190, 255), (255, 255, 0),
        (128, 128, 128),
    ],
    "thirteen": [light.colour for light in plan_illuminants(3, (2500, 4500, 6500))],
    "41 black bodies": [light.colour for light in plan_illuminants(0, tuple(range(2000, 10001, 200)))],
}  # fmt: skip
_SCATTER = ([0, 0.003, 0.01, 0.03], [0.0003, 0.001, 0.002], [0.0002, 0.0005, 0.002])
CAMERAS = ("Canon_EOS-1Ds_Mark_III", "Canon_EOS_200D", "Canon_EOS_5DS", "Canon_EOS_5D_Mark_II", "Canon_EOS_600D")


def random_session(codes: Codes, seed: int) -> tuple[_Array, _Array]:
    """Return whites (L, 3) of a random healthy room and their uncertainty.

    Tone curves: sRGB, powers of 1.7 to 2.7, or S-shaped; common or individual. Five cameras; mercury lamps and LEDs;
    balanced and mixed primaries; wheels with white and coloured segments; flicker up to 3 %, noise up to 0.2 %.
    """
    random = np.random.default_rng([seed, len(codes)])
    share = np.array(codes) / 255
    curve = random.choice(["srgb", "power", "s", "own"])
    if curve == "srgb":
        light = decode_srgb(share)
    elif curve == "power":
        light = share ** random.uniform(1.7, 2.7)
    else:
        steep, middle, mixed = random.uniform(2, 7), random.uniform(0.45, 0.6), random.uniform(0.2, 0.8)
        low, high = (1 / (1 + np.exp(-steep * (x - middle))) for x in (0, 1))
        s = (1 / (1 + np.exp(-steep * (share - middle))) - low) / (high - low) * np.sqrt(share)
        light = (1 - mixed) * share ** random.uniform(1.8, 2.4) + mixed * s
    if curve == "own":
        light = light ** (1 + 0.08 * random.standard_normal(3))
    lamp = "led" if random.random() < 0.5 else "uhp"
    camera = CAMERAS[int(random.integers(len(CAMERAS)))]
    primaries = np.einsum("pl,lc->pc", projector_primaries(lamp), sensitivities(camera))
    primaries = primaries * np.exp(0.15 * random.standard_normal((3, 1)))
    if random.random() < 0.3:
        mixing = np.abs(random.normal(0, 0.03, (3, 3)))
        np.fill_diagonal(mixing, 1)
        primaries = mixing @ primaries
    primaries = primaries / primaries.sum(axis=0).max() * random.uniform(2000, 12000)
    white: _Array = np.asarray(light @ primaries, dtype=np.float64)
    if random.random() < 0.4:
        for subset in ((0, 1), (0, 2), (1, 2), (0, 1, 2)):
            added = random.uniform(0, 0.5) * light[:, subset].min(axis=1)
            white = white + added[:, None] * primaries[list(subset)].sum(axis=0)
    flicker, colour, noise = (float(random.choice(values)) for values in _SCATTER)
    white = white * (1 + flicker * random.standard_normal((len(codes), 1)))
    white = np.asarray(white * (1 + colour * random.standard_normal(white.shape)), dtype=np.float64)
    error = np.sqrt((noise * white) ** 2 + random.uniform(0.05, 0.3) ** 2)
    return white + error * random.standard_normal(white.shape), error


def agreement(codes: Codes, white: _Array, error: _Array) -> CodeAgreement:
    return code_agreement(np.array(codes), white, error, dark_known=True, drift_known=True)


def agreement_of_plan(white: _Array, error: float = 0.0005) -> CodeAgreement:
    return agreement([light.colour for light in PLAN], white, error * white + 0.1)


def exchange(values: _Array, first: int, second: int) -> _Array:
    values = values.copy()
    values[[first, second]] = values[[second, first]]
    return values


def room_whites(room: Room, noise: float = 0.001) -> _Array:
    """Return whites (L, 3) with noise, without black light."""
    world = hang(room=room).world
    codes = [light.colour for light in PLAN]
    white = np.array([world.white(colour, SETTINGS) for colour in codes])
    black = world.white(type(codes[0])(0, 0, 0), SETTINGS)
    return (white - black) * (1 + noise * np.random.default_rng(4).standard_normal(white.shape))


@pytest.mark.parametrize("codes", SESSIONS.values(), ids=SESSIONS)
def test_accepts_random_healthy_rooms(codes: Codes) -> None:
    for seed in range(4):
        result = agreement(codes, *random_session(codes, seed))
        assert result.off_deg.max() < 1, seed
        assert result.off_brightness.max() < 0.05, seed
        assert result.exchanges == (), seed


@pytest.mark.parametrize("codes", [codes for codes in SESSIONS.values() if len(codes) < 9], ids=list(SESSIONS)[:6])
def test_detects_any_exchange_in_small_sessions(codes: Codes) -> None:
    light = decode_srgb(np.array(codes) / 255)
    # a sample of all pairs, which are all searched
    pairs = [*enumerate(combinations(range(len(codes)), 2))][:: max(1, 2 * len(codes) - 5)][::2]
    for seed, (first, second) in pairs:
        if angles_deg(light[first], light[second]) < 6:
            continue
        white, error = random_session(codes, seed)
        result = agreement(codes, exchange(white, first, second), exchange(error, first, second))
        assert [(pair.one, pair.other) for pair in result.exchanges] == [(first, second)], (seed, first, second)


def test_reports_one_wrong_illuminant_of_eight() -> None:
    codes = SESSIONS["eight"]
    white, error = random_session(codes, 1)
    white[4] = white[5]
    result = agreement(codes, white, error)
    assert int(np.argmax(result.off_deg)) == 4
    assert result.seen_as[4] == 5
    assert result.exchanges == ()


def test_single_illuminant_is_not_verified() -> None:
    result = agreement([(255, 120, 60)], *random_session([(255, 120, 60)], 1))
    assert not result.off_deg.any()
    assert not result.is_verified.any()


@pytest.mark.parametrize("room", ROOMS.values(), ids=ROOMS)
def test_predicts_whites_of_healthy_rooms(room: Room) -> None:
    result = agreement_of_plan(room_whites(room))
    assert result.off_deg.max() < LIMIT.accept / 8
    assert result.is_verified.all()
    assert result.exchange_deg < 2


def test_ignores_unknown_drift() -> None:
    fading = 1 - 0.1 * np.arange(len(PLAN)) / len(PLAN)
    assert agreement_of_plan(room_whites(Room()) * fading[:, None]).off_deg.max() < LIMIT.accept / 3


def shift(count: int) -> npt.NDArray[np.int64]:
    return np.minimum(np.arange(count) + 1, count - 1)


def shift_except_primaries(count: int) -> npt.NDArray[np.int64]:
    alone = [np.count_nonzero(light.colour) == 1 for light in PLAN]
    return np.where(alone, np.arange(count), shift(count))


@pytest.mark.parametrize("shift_list", [shift, shift_except_primaries])
@pytest.mark.parametrize("room", ROOMS.values(), ids=ROOMS)
def test_refuses_shifted_list(room: Room, shift_list: Callable[[int], npt.NDArray[np.int64]]) -> None:
    result = agreement_of_plan(room_whites(room)[shift_list(len(PLAN))])
    assert judge({LIMIT.name: float(result.off_deg.max())}).outcome == "refuse"
    assert (result.off_deg > LIMIT.accept).sum() >= 6


@pytest.mark.parametrize(("first", "second"), [(35, 53), (40, 41), (0, 50), (0, 104)])
def test_reports_exchange_among_many(first: int, second: int) -> None:
    result = agreement_of_plan(exchange(room_whites(Room()), first, second))
    assert [(pair.one, pair.other) for pair in result.exchanges] == [(first, second)]


def test_detects_exchanges_above_reported_angle() -> None:
    codes = SESSIONS["41 black bodies"]
    white, error = random_session(codes, 3)
    limit_deg = agreement(codes, white, error).exchange_deg
    assert limit_deg < 0.6
    angles = angles_deg(white[:-1], white[1:])
    detectable = np.flatnonzero(angles > limit_deg)[[0, 5, 9]].tolist()
    for first in detectable:
        result = agreement(codes, exchange(white, first, first + 1), exchange(error, first, first + 1))
        assert [(pair.one, pair.other) for pair in result.exchanges] == [(first, first + 1)]


def test_does_not_judge_uncertain_whites() -> None:
    white = room_whites(Room(), noise=0.05)
    assert agreement_of_plan(white, error=0.05).off_deg.max() < LIMIT.accept
    # Such illuminants are not verified either.
    assert agreement_of_plan(white, error=0.3).is_verified.mean() < 0.5


def test_detects_half_brightness() -> None:
    codes = [*SESSIONS["eight"], (255, 255, 255)]
    white, error = random_session(codes, 1)
    white[0] /= 2
    result = agreement(codes, white, error)
    assert result.off_brightness[0] > 0.1
    assert result.off_deg.max() < 2


def test_refuses_two_illuminants_from_one_file(lab: Lab, tmp_path: Path) -> None:
    dng = lab.dng()

    def frame(step: SessionStep) -> bytes:
        return dng if step.illumination in (1, 2) else lab.dng(step.colour, step.number)

    with (
        take(lab, tmp_path / "session", LIGHTS[:3], frame=frame) as session,
        pytest.raises(FormatError, match="illuminants 1 and 2"),
    ):
        build(session, tmp_path / "lut")
