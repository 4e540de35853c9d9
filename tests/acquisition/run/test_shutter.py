"""Shutter times under a colour wheel: which are refused."""

from __future__ import annotations

from itertools import pairwise

import pytest

from acquisition.run.devices import ENGRAVED_S, require_whole_turns, wheel_of
from drivers.canon import SHUTTER
from experiment.config import CameraSettings, ProjectorCable, parse_lab
from foundation.errors import ConfigurationError

WHEEL = ProjectorCable()


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
    assert near in caught.value.remedy
    assert "lab.projector.colour_wheel_hz" in caught.value.remedy


def test_a_projector_without_a_wheel_needs_whole_pictures() -> None:
    steady = ProjectorCable(colour_wheel_hz=0, refresh_hz=50)
    require_whole_turns(CameraSettings(shutter_s=0.02), steady)
    with pytest.raises(ConfigurationError, match=r"pictures of the projector \(50 a second\).*\.refresh_hz"):
        require_whole_turns(CameraSettings(shutter_s=1 / 60), steady)


def test_the_times_that_are_named_before_a_camera_is_asked_are_engraved() -> None:
    engraved = {step.value for step in SHUTTER.steps}
    assert set(ENGRAVED_S) <= engraved
    # Thirds of a stop, as engraved: 1/20 after 1/25, 1/13 after 1/15.
    assert all(1.1 < longer / shorter < 1.4 for shorter, longer in pairwise(ENGRAVED_S))


def test_the_wheel_before_the_camera_is_the_lab_s_or_the_simulated_room_s() -> None:
    head = 'chart = "c"\nilluminations = "l"\n'
    of_lab = "[lab.projector]\ncolour_wheel_hz = 120\n"
    of_room = "[simulated.room]\nwheel_hz = 60\n"
    rigs = [("lab", of_lab), ("simulated", of_room), ("simulated", of_lab), ("imported", of_lab)]
    wheels = [wheel_of(parse_lab(f'rig = "{rig}"\n{head}{table}', "LAB.toml")) for rig, table in rigs]
    assert wheels == [120, 60, 0, 0]
