"""Lights that bear another's codes, against rooms whose light is known."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.lights.illuminations import Illumination, plan_illuminations
from acquisition.session.folder import Session
from acquisition.session.plan import SessionStep
from calibration.checks.light_codes import DEGREE, LIGHTS_A_TERM, angles_off_codes_deg
from calibration.pipeline.build import build
from calibration.report.report import write_report
from calibration.verdict.thresholds import THRESHOLDS
from calibration.verdict.verdict import judge
from foundation.errors import FormatError, QualityError
from foundation.srgb import decode_srgb
from sim.world.room import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, hang, take

PLAN = plan_illuminations(13, (3000, 6500))
LIMIT = next(limit for limit in THRESHOLDS if limit.name == "off_codes_deg")
ROOMS = {
    "default": Room(),
    "bright room": Room(ambient=0.1, black_leak=0.01),
    "led, steep": Room(lamp_spectrum="led", transfer=2.6),
    "flat": Room(transfer=1.8, projector_falloff=0.3, primary_difference=0.4),
}

_Array = npt.NDArray[np.float64]


def whites(room: Room, noise: float = 0.001) -> _Array:
    """Return the lights' whites (L, 3), read with an error."""
    world = hang(room=room).world
    white = np.array([world.white(light.colour, SETTINGS) for light in PLAN])
    return white * (1 + noise * np.random.default_rng(4).standard_normal(white.shape))


def off(white: _Array, error_deg: float = 0.02) -> _Array:
    angles = angles_off_codes_deg(PLAN, white, np.full(len(PLAN), error_deg))
    assert angles is not None
    return angles


def outcome(angles: _Array) -> str:
    return judge({LIMIT.name: float(angles.max())}).outcome


@pytest.mark.parametrize("room", ROOMS.values(), ids=ROOMS)
def test_the_codes_of_a_healthy_room_give_its_whites(room: Room) -> None:
    assert off(whites(room)).max() < LIMIT.accept / 8


def test_a_lamp_whose_drift_is_not_known_is_no_wrong_name() -> None:
    fading = 1 - 0.1 * np.arange(len(PLAN)) / len(PLAN)
    assert off(whites(Room()) * fading[:, None]).max() < LIMIT.accept / 3


def test_a_flickering_lamp_is_no_wrong_name() -> None:
    white, random = whites(Room()), np.random.default_rng(8)
    for _ in range(5):
        flicker = 1 + 0.04 * random.standard_normal(len(PLAN))
        assert off(white * flicker[:, None]).max() < LIMIT.accept / 4


def test_light_added_where_primaries_overlap_is_no_wrong_name() -> None:
    """A wheel of six segments, or a white boost: yellow is brighter than red and green."""
    white = whites(Room())
    linear = decode_srgb(np.array([c.codes for c in PLAN]) / 255)
    full = white.max(axis=0)
    for one, other in ((0, 1), (1, 2), (0, 2)):
        segment = np.minimum(linear[:, one], linear[:, other])[:, None]
        white = white + 0.4 * segment * full * np.isin(np.arange(3), (one, other))
    white = white + 0.5 * linear.min(axis=1)[:, None] * full
    assert off(white).max() < LIMIT.accept / 8


def shifted(count: int) -> npt.NDArray[np.int64]:
    return np.minimum(np.arange(count) + 1, count - 1)


def shifted_but_for_primaries(count: int) -> npt.NDArray[np.int64]:
    alone = [np.count_nonzero(light.codes) == 1 for light in PLAN]
    return np.where(alone, np.arange(count), shifted(count))


@pytest.mark.parametrize("shift", [shifted, shifted_but_for_primaries])
@pytest.mark.parametrize("room", ROOMS.values(), ids=ROOMS)
def test_a_shifted_list_is_refused(room: Room, shift: Callable[[int], npt.NDArray[np.int64]]) -> None:
    angles = off(whites(room)[shift(len(PLAN))])
    assert outcome(angles) == "refuse"
    assert (angles > LIMIT.accept).sum() >= 6


@pytest.mark.parametrize(("one", "other"), [(35, 53), (40, 41), (0, 50)])
def test_two_exchanged_lights_are_named(one: int, other: int) -> None:
    white = whites(Room())
    white[[one, other]] = white[[other, one]]
    angles = off(white)
    assert set(np.flatnonzero(angles > LIMIT.accept)) == {one, other}
    assert outcome(angles) != "accept"


def test_exchanged_primaries_are_refused() -> None:
    """With corners of the plan amiss it is not sure which of them is."""
    white = whites(Room())
    white[[0, 104]] = white[[104, 0]]
    angles = off(white)
    assert {0, 104} & set(np.flatnonzero(angles > LIMIT.accept))
    assert outcome(angles) == "refuse"


def test_a_white_that_is_not_known_is_not_judged() -> None:
    white = whites(Room(), noise=0.05)
    assert off(white, error_deg=0.02).max() > LIMIT.accept
    assert off(white, error_deg=2.0).max() < LIMIT.accept


def test_few_lights_tell_nothing() -> None:
    least = LIGHTS_A_TERM * (1 + 7 * DEGREE)
    white, errors = whites(Room()), np.zeros(len(PLAN))
    assert angles_off_codes_deg(PLAN[: least - 1], white[: least - 1], errors[: least - 1]) is None
    assert angles_off_codes_deg(PLAN[:least], white[:least], errors[:least]) is not None


def test_lights_off_their_codes_make_no_table_and_are_named(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[_Array] = []

    def angles_off(lights: Sequence[Illumination], white: _Array, errors_deg: _Array) -> _Array:
        given.extend([white, errors_deg])
        return np.where(np.isin(np.arange(len(lights)), (3, 7)), 5.0 + np.arange(len(lights)), 0.1)

    monkeypatch.setattr("calibration.pipeline.collecting.angles_off_codes_deg", angles_off)
    with pytest.raises(QualityError, match=r"codes predict: 12°.*, 2 lights: 7, 3; correct the list of frames"):
        build(session, tmp_path / "lut", report=write_report)
    report = json.loads((tmp_path / "lut.refused" / "report.json").read_text())
    assert report["off_codes_deg"][2:4] == [0.1, 8.0]
    assert "12.00° at most, light 7" in (tmp_path / "lut.refused" / "report.html").read_text()
    assert (given[0] > 0).all()
    assert (given[1] < 0.5).all()


def test_lights_exposed_otherwise_are_not_held_against_their_codes(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def angles_off(*_: object) -> _Array:
        return np.zeros(3)

    def longer(step: SessionStep) -> bytes:
        exposed = replace(SETTINGS, shutter_s=0.6) if step.illumination == 1 else SETTINGS
        return lab.dng(step.colour, step.number, exposed)

    monkeypatch.setattr("calibration.pipeline.collecting.angles_off_codes_deg", angles_off)
    with take(lab, tmp_path / "alike", LIGHTS[:3]) as session:
        result = build(session, tmp_path / "lut")
        assert result.figures.lights.off_codes_deg is not None
        assert result.figures.frames[0].exposure == pytest.approx(0.5 * 100 / 8**2)
    with take(lab, tmp_path / "longer", LIGHTS[:3], frame=longer) as session:
        assert build(session, tmp_path / "other").figures.lights.off_codes_deg is None


def test_two_lights_of_one_file_make_no_table(lab: Lab, tmp_path: Path) -> None:
    one = lab.dng()

    def frame(step: SessionStep) -> bytes:
        return one if step.illumination in (1, 2) else lab.dng(step.colour, step.number)

    with (
        take(lab, tmp_path / "session", LIGHTS[:3], frame=frame) as session,
        pytest.raises(FormatError, match="lights 1 and 2 have the same raw file"),
    ):
        build(session, tmp_path / "lut")
