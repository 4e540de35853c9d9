"""A session with a projector that is muted, unplugged, cold: what fails is waited for, said, and costs no frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acquisition.run.devices import PAUSE_S, Devices
from acquisition.run.pipeline import Taken
from acquisition.run.run import take_session
from drivers.projector import Power
from sim.projectors.projector import SimulatedProjector
from tests.acquisition.run.scripted import EXPOSE_S, SETTINGS, Hurried, Lab, ScriptedCamera

pytestmark = pytest.mark.slow

ONE_AGAIN = ["accepted", "accepted", "refused", "accepted", "accepted", "accepted", "accepted"]
"""The light that is on the screen when something happens is taken again: its frame cannot be trusted."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


def test_a_muted_picture_pauses_the_run_until_it_is_released(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    clock.calls[PAUSE_S] = lambda: lab.projector.set_muted(False)

    def mute(taken: Taken) -> None:
        if lab.camera.captures == 2:
            lab.projector.set_muted(True)

    said: list[str] = []
    assert take_session(lab.session, lab.devices, SETTINGS, observe=mute, announce=said.append).complete
    assert [sentence.split(":")[0] for sentence in said] == ["refused", "retry", "paused", "resumed", "lamp"]
    events = [event.what for event in lab.session.journal.events()]
    assert events == ["start", "refused", "retry", "paused", "resumed", "lamp", "complete"]
    assert "mute" in lab.session.journal.events()[1].detail
    assert lab.verdicts() == ONE_AGAIN


def test_a_frame_during_which_the_picture_was_muted_is_taken_again(folder: Path) -> None:
    lab = Lab(folder)
    lab.clock = clock = Hurried()
    lab.camera.clock = clock
    lab.projector = SimulatedProjector(clock, power=Power.ON)
    # The scripted camera sleeps for its first frame: that is when somebody presses mute.
    clock.calls = {EXPOSE_S: lambda: lab.projector.set_muted(True), PAUSE_S: lambda: lab.projector.set_muted(False)}
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["refused"] + ["accepted"] * 6
    assert "muted" in lab.session.frames()[0].verdict


def test_the_camera_is_spoken_to_while_the_lamp_warms_up(folder: Path) -> None:
    lab = Lab(folder)
    lab.projector = SimulatedProjector(lab.clock)
    spoken: list[float] = []

    class PatientCamera(ScriptedCamera):
        def idle(self) -> None:
            spoken.append(self.clock.monotonic())

    lab.camera = PatientCamera(lab.screen, lab.clock, {})
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert spoken[-1] >= SETTINGS.sequence.warm_up_s
    assert max(np.diff(spoken)) <= 10


def test_a_lab_without_lamp_control_works(folder: Path) -> None:
    lab = Lab(folder)
    devices = Devices(lab.camera, lab.screen, None, lab.clock)
    assert take_session(lab.session, devices, SETTINGS).complete
