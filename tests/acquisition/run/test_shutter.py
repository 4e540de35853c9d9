"""Shutter times under a colour wheel: which are refused, and which are recommended."""

from __future__ import annotations

import re

import pytest

from acquisition.config import CameraSettings, ProjectorCable
from acquisition.run.shutter import (
    ENGRAVED_S,
    GOOD_LEVELS,
    better_shutter,
    exposure_advice,
    holds_whole_turns,
    light_period_s,
    require_whole_turns,
)
from drivers.camera import ExposureSettings
from drivers.canon.apex import SHUTTER
from drivers.canon.camera import CanonEos
from foundation.errors import ConfigurationError
from sim.buses.ptp_memory import MemoryTransport
from sim.camera.eos import SimulatedEos
from sim.camera.eos_bodies import EOS_BODIES
from sim.clock import SimulatedClock
from tests.contracts.camera import SeededFilm

WHEEL = ProjectorCable()
PERIOD_S = 1 / 60


@pytest.mark.parametrize("shutter_s", [1 / 60, 0.01667, 0.25, 0.5, 0.6, 1.0, 2.0, 4.98])
def test_whole_turns_of_the_wheel_are_accepted(shutter_s: float) -> None:
    require_whole_turns(CameraSettings(shutter_s=shutter_s), WHEEL)


@pytest.mark.parametrize(
    ("shutter_s", "near"),
    [
        (1 / 125, "set it to 0.01667 s, better"),
        (1 / 8, "set it to 0.1 or 0.1667 s"),
        (0.51, "set it to 0.5 or 0.6 s"),
    ],
)
def test_a_part_of_a_turn_is_refused_with_the_nearest_times_that_cameras_have(shutter_s: float, near: str) -> None:
    with pytest.raises(ConfigurationError, match=r"turns of the colour wheel \(60 a second\)") as caught:
        require_whole_turns(CameraSettings(shutter_s=shutter_s), WHEEL)
    assert near in str(caught.value)
    assert "lab.projector.colour_wheel_hz" in str(caught.value)


def test_a_projector_without_a_wheel_needs_whole_pictures() -> None:
    steady = ProjectorCable(colour_wheel_hz=0, refresh_hz=50)
    require_whole_turns(CameraSettings(shutter_s=0.02), steady)
    with pytest.raises(ConfigurationError, match=r"pictures of the projector \(50 a second\).*\.refresh_hz"):
        require_whole_turns(CameraSettings(shutter_s=1 / 60), steady)


def test_the_times_that_are_named_before_a_camera_is_asked_are_engraved() -> None:
    engraved = {step.value for step in SHUTTER.steps}
    assert set(ENGRAVED_S) <= engraved


@pytest.mark.parametrize("body", ["EOS 550D", "EOS 6D Mark II", "Test"])
@pytest.mark.parametrize("wheel_hz", [60.0, 59.94, 120.0])
@pytest.mark.parametrize("level", [0.03, 0.1, 0.25, 0.85, 0.99, 1.0])
@pytest.mark.parametrize("shutter_s", [0.1, 0.5, 2.0])
def test_what_is_recommended_the_body_takes_and_the_wheel_allows(
    body: str, wheel_hz: float, level: float, shutter_s: float
) -> None:
    clock = SimulatedClock()
    eos = SimulatedEos(EOS_BODIES[body], SeededFilm(), clock, serial="1", auto_power_off_s=0)
    camera = CanonEos(lambda: MemoryTransport(eos), clock)
    camera.configure(ExposureSettings(iso=100, aperture=8, shutter_s=shutter_s))
    wheel = ProjectorCable(colour_wheel_hz=wheel_hz)
    advice = exposure_advice(level, shutter_s, camera.shutter_speeds(), light_period_s(wheel))
    said = re.fullmatch(r"30% to 80% wanted, try camera\.shutter_s = (\S+)", advice)
    assert said is not None, advice
    tried = float(said[1])
    require_whole_turns(CameraSettings(shutter_s=tried), wheel)
    camera.configure(ExposureSettings(iso=100, aperture=8, shutter_s=tried))
    assert GOOD_LEVELS[0] * 0.99 <= level * tried / shutter_s <= GOOD_LEVELS[1] * 1.01


def test_of_two_times_the_one_nearer_to_the_wanted_exposure_is_recommended() -> None:
    assert better_shutter(0.2, 0.5, (0.5, 1.0, 1.6, 2.0), PERIOD_S) == 2.0
    assert better_shutter(0.2, 0.5, (0.5, 1.0, 1.6), PERIOD_S) == 1.6
    assert better_shutter(0.2, 0.5, (0.5, 1.0), PERIOD_S) == 1.0


@pytest.mark.parametrize(
    ("level", "offered", "remedy"),
    [
        (1.0, (1 / 125, 1 / 100, 1 / 8, 0.5), "set a higher f-number or a lower ISO speed"),
        (0.01, (0.25, 0.5), "set a lower f-number or a higher ISO speed"),
        (0.01, (), "set a lower f-number or a higher ISO speed"),
    ],
)
def test_where_no_time_will_do_the_remedy_is_another(level: float, offered: tuple[float, ...], remedy: str) -> None:
    advice = exposure_advice(level, 0.5, offered, PERIOD_S)
    assert "no shutter time that the camera offers" in advice
    assert "a whole multiple of 0.01667 s, after which the projector's light repeats" in advice
    assert advice.endswith(remedy)


def test_a_time_that_cuts_a_turn_is_not_recommended_though_it_would_expose_best() -> None:
    assert better_shutter(0.2, 0.1, (0.1, 0.2, 0.3, 0.375), PERIOD_S) == 0.3


def test_a_good_exposure_is_left_alone() -> None:
    assert exposure_advice(0.5, 0.5, (0.25, 0.5), PERIOD_S) == ""


@pytest.mark.parametrize(("shutter_s", "whole"), [(1 / 60, True), (1 / 125, False), (0.0, False), (0.508, False)])
def test_whole_turns(shutter_s: float, whole: bool) -> None:
    assert holds_whole_turns(shutter_s, PERIOD_S) is whole
