"""Shutter times under a colour wheel: which are refused."""

from __future__ import annotations

from itertools import pairwise

import pytest

from acquisition.run.devices import ENGRAVED_S, require_whole_turns, wheel_of
from drivers.canon import SHUTTER
from experiment.config import CameraSettings, ProjectorCable, parse_lab
from foundation.errors import ConfigurationError


def test_a_projector_without_a_wheel_needs_whole_pictures() -> None:
    steady = ProjectorCable(colour_wheel_hz=0, refresh_hz=50)
    require_whole_turns(CameraSettings(shutter_s=0.02), steady)
    with pytest.raises(ConfigurationError, match=r"\(50 a second\).*\.refresh_hz"):
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
