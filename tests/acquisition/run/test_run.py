"""A session that is taken up again: its files, its devices, and what ties it to what was taken before."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from acquisition.monitor.view import read_session
from acquisition.run import run
from acquisition.run.devices import Devices
from acquisition.run.pipeline import link_runs
from acquisition.run.rig.lab import session_clock
from acquisition.run.run import (
    BEGINS,
    clock_note,
    killed_note,
    require_same_devices,
    run_session,
    take_session,
)
from drivers.camera import CameraIdentity, CapturedFrame
from drivers.presenter import Colour
from drivers.projector import ProjectorIdentity
from experiment.config import LabSettings
from experiment.lights import Illumination
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement, link_steps, plan_steps
from foundation.console import Ending
from foundation.errors import DeviceError, DeviceRefused
from tests.acquisition.run.scripted import LIGHTS, SETTINGS, Lab

RESPONSE = (Colour(250, 0, 0), Colour(0, 250, 0))
TIES = [step.colour for step in link_steps(0)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "session"


def lab_with_response(folder: Path) -> Lab:
    """Return a lab whose session begins with white, dark, red, green."""
    lab = Lab(folder)
    lab.session.close()
    (folder / "journal.sqlite").unlink()
    Journal.create(folder / "journal.sqlite", plan_steps(LIGHTS, 25, response=RESPONSE))
    lab.session = Session.open_for_run(folder)
    return lab


def interrupt_after(lab: Lab, frames: int, first: tuple[int, ...] = ()) -> None:
    """Take some frames and end the run."""
    ending = Ending(lambda sentence: None)
    lab.camera.after[lab.camera.captures + frames] = ending.ask
    with pytest.raises(KeyboardInterrupt):
        take_session(lab.session, lab.devices, SETTINGS, ending=ending, first=first)


def test_nothing_is_tied_to_nothing(folder: Path) -> None:
    lab = lab_with_response(folder)
    assert link_runs(lab.session, lab.clock.now()) == ()
    assert take_session(lab.session, lab.devices, SETTINGS).complete


def test_a_session_that_does_not_know_its_projector_is_not_tied(folder: Path) -> None:
    lab = Lab(folder)
    interrupt_after(lab, 3)
    assert link_runs(lab.session, lab.clock.now()) == ()


@pytest.mark.slow
def test_a_run_that_is_taken_up_shows_the_ties_first(folder: Path) -> None:
    lab = lab_with_response(folder)
    interrupt_after(lab, 5)
    first = link_runs(lab.session, lab.clock.now())
    assert first == (8, 9, 10, 11, 12, 13)
    lab.camera.exposed.clear()
    assert take_session(lab.session, lab.devices, SETTINGS, first=first).complete
    assert lab.camera.exposed[:6] == TIES
    assert len(lab.session.steps) == 14


@pytest.mark.slow
def test_ties_that_were_interrupted_are_taken_anew(folder: Path) -> None:
    lab = lab_with_response(folder)
    interrupt_after(lab, 5)
    interrupt_after(lab, 2, link_runs(lab.session, lab.clock.now()))
    again = link_runs(lab.session, lab.clock.now())
    assert again == (8, 9, 10, 11, 12, 13), "no further steps"
    assert not lab.session.done_steps() & set(again), "no step ever has two frames that count"
    lab.camera.exposed.clear()
    interrupt_after(lab, 7, again)
    assert lab.camera.exposed[:6] == TIES, "those that were taken are taken again: the chart may have moved since"
    assert link_runs(lab.session, lab.clock.now()) == (14, 15, 16, 17, 18, 19), "behind another light they are new"


def test_the_journal_says_that_the_run_before_was_killed(folder: Path) -> None:
    journal = Lab(folder).session.journal
    until = datetime.now(UTC) + timedelta(seconds=60)
    assert killed_note(Session.open(folder)) == ""
    journal.beat("running", "frames are taken", until)
    assert "was killed, or power was lost" in killed_note(Session.open(folder))
    journal.beat("ended", "interrupted", until)
    assert killed_note(Session.open(folder)) == ""


def test_a_run_that_begins_again_says_so_before_its_devices_are_open(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab(folder)
    lab.session.journal.beat("running", "frames are taken", datetime.now(UTC) + timedelta(seconds=60))
    lab.session.close()
    seen: list[str] = []

    def opening(*given: object) -> Devices:
        seen.append(read_session(folder).head(datetime.now(UTC)).sentence)
        raise DeviceError("no camera on USB; plug it in")

    def same(session: Session, settings: LabSettings) -> None:
        """Accept any settings."""

    monkeypatch.setattr(run, "open_rig", opening)
    monkeypatch.setattr(run, "require_same", same)
    with pytest.raises(DeviceError):
        run_session(SETTINGS, folder, lambda done, total: None)
    assert seen == [BEGINS]
    view = read_session(folder)
    assert view.head(datetime.now(UTC)).sentence == "no camera on USB; plug it in"
    assert [event.what for event in view.events].count("killed") == 1


def test_another_camera_or_projector_is_refused(folder: Path) -> None:
    lab = Lab(folder)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    assert lab.session.journal.records()["camera"] == "Canon Test, serial number 1"
    lab.projector.identity = lambda: ProjectorIdentity("Epson", "EB", "hall")  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, SETTINGS)
    lab.projector = None  # type: ignore[assignment]
    lab.camera.identity = lambda: CameraIdentity("Canon", "Test", "2")  # type: ignore[method-assign]
    assert caught.value.value == "Epson EB"
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, SETTINGS)
    assert caught.value.expected == "Canon Test, serial number 1"
    assert caught.value.value == "Canon Test, serial number 2"
    assert "new session" in caught.value.remedy


def test_firmware_and_the_projectors_own_name_may_change(folder: Path) -> None:
    lab = Lab(folder)
    require_same_devices(lab.session, lab.devices, SETTINGS)
    body, beamer = lab.camera.identity(), lab.projector.identity()
    lab.camera.identity = lambda: replace(body, firmware="1.1.0")  # type: ignore[method-assign]
    lab.projector.identity = lambda: replace(beamer, name="another")  # type: ignore[method-assign]
    require_same_devices(lab.session, lab.devices, SETTINGS)


def test_another_screen_of_a_real_lab_is_refused(folder: Path) -> None:
    lab = Lab(folder)
    one = LabSettings(rig="lab", chart=Path("c"), illuminations=Path("i"))
    require_same_devices(lab.session, lab.devices, one)
    light = one.lab.light.model_copy(update={"display": "HDMI-2"})
    other = one.model_copy(update={"lab": one.lab.model_copy(update={"light": light})})
    with pytest.raises(DeviceRefused) as caught:
        require_same_devices(lab.session, lab.devices, other)
    assert (caught.value.expected, caught.value.value) == ("display", "display HDMI-2")


@pytest.mark.slow
def test_lights_taken_again_are_closed_by_a_pair_behind_the_plan(folder: Path) -> None:
    lab = Lab(folder, lights=(*LIGHTS, Illumination(2, "uniform", None, Colour(9, 255, 3))))
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    lab.session.retake("1")
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert [step for step, _ in lab.taken()][-3:] == ["l3", "w7", "d8"]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert len(lab.taken()) == 10, "and only once"


def test_a_machine_whose_clock_was_set_back_between_two_runs_is_told(folder: Path) -> None:
    lab = Lab(folder)
    ahead = datetime.now(UTC) + timedelta(hours=5)
    assert clock_note(lab.session, session_clock(lab.session)) == ""
    attempt = lab.session.journal.begin(lab.session.steps[0], "frames/a", ahead)
    received = lab.session.receive("a", lambda into: CapturedFrame("a.cr2", into.write(b"a"), ahead))
    lab.session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=ahead)
    clock = session_clock(lab.session)
    assert clock.now() >= ahead, "what is taken now lies behind it"
    said = clock_note(lab.session, clock)
    assert f"behind the last frame of {folder}" in said
    assert "set the machine's clock right" in said
    assert session_clock(None).behind_s == 0
