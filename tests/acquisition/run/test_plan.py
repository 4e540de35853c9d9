"""Plans: printed values, refusals with remedies, and no effect on devices and files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from acquisition.cli import main
from acquisition.run.devices import Devices
from acquisition.run.plan import (
    Answers,
    RunPlan,
    Work,
    ask,
    dry_run,
    make_plan,
    order_of,
    outline,
    settings_doubts,
)
from drivers.camera import CameraIdentity, Supplies
from drivers.presenter import Colour
from drivers.projector import Power
from experiment.chart.layout import design_chart
from experiment.config import LabRig, LabSettings, NotifySettings, ProjectorCable, load_lab, parse_lab
from experiment.lights import Illuminant, save_illuminants
from experiment.session.folder import Session
from experiment.session.records import plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import ConfigurationError, DeviceError, DeviceFault, DeviceRefused, StorageError
from sim.projectors.projector import SimulatedProjector
from tests.json_of import json_of

pytestmark = pytest.mark.slow

GB = 10**9
LIGHTS = tuple(Illuminant(index, "uniform", None, Colour(255, index, 0)) for index in range(100))
EOS = CameraIdentity("Canon Inc.", "Canon EOS 550D", "123")
SPEEDS = (0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)


def settings_with(**tables: dict[str, Any]) -> LabSettings:
    document = {"rig": "lab", "chart": "chart.json", "illuminations": "lights.csv", **tables}
    return LabSettings.model_validate(document)


SETTINGS = settings_with()


def work_of(settings: LabSettings = SETTINGS, done: int = 0, **changes: Any) -> Work:
    steps = plan_steps(LIGHTS, 25, seed=1)
    work = Work(
        Path("night"), not done, steps, frozenset(range(done)), order_of(steps, settings), CHART, LIGHTS, "0" * 64
    )
    return replace(work, **changes)


CHART = design_chart(1)


def planned(
    free: float = 1000 * GB, answers: Answers | None = None, settings: LabSettings = SETTINGS, work: Work | None = None
) -> RunPlan:
    given = answers or Answers(camera=EOS, offered_s=SPEEDS, projector="Epson, in standby", lit=False)
    return make_plan(settings, work or work_of(), given, int(free))


class TestDisk:
    def test_reports_missing_disk_space(self) -> None:
        enough = planned().needed_bytes
        assert planned(enough).faults == ()
        (fault,) = planned(enough - 3.25 * GB).faults
        assert isinstance(fault, StorageError)
        assert "3.3 GB" in str(fault)
        with pytest.raises(StorageError, match=r"3\.3 GB"):
            planned(enough - 3.25 * GB).require()
        (fault,) = planned(enough - 1).faults
        assert "0.1 MB" in str(fault), "a little too small is never nothing"


class TestExposure:
    def test_proposes_nearest_shutter_times(self) -> None:
        settings = settings_with(camera={"shutter_s": 0.45})
        (fault,) = planned(settings=settings).faults
        assert isinstance(fault, DeviceRefused)
        assert str(fault).startswith("camera.shutter_s = 0.45 s is not offered")
        assert "0.4, 0.5, 0.6 s" in str(fault)


@pytest.mark.parametrize(
    ("supplies", "said"),
    [
        (Supplies(battery=0.25), "at 25%, and 110 frames are to be taken; connect a mains adapter"),
        (Supplies(battery=0.25, mains=False), "connect a mains adapter"),
        (Supplies(battery=0.25, mains=True), ""),
        (Supplies(battery=0.5), ""),
        (Supplies(), ""),
        (Supplies(card_free_bytes=GB, saves_to_host=False), "are missing; insert an empty card"),
        (Supplies(card_free_bytes=GB, saves_to_host=True), ""),
        (Supplies(card_free_bytes=100 * GB, saves_to_host=False), ""),
        (Supplies(card_free_bytes=None, saves_to_host=False), ""),
    ],
)
def test_refuses_low_battery_and_small_card(supplies: Supplies, said: str) -> None:
    faults = planned(answers=Answers(camera=EOS, supplies=supplies)).faults
    assert [type(found) for found in faults] == [DeviceFault] * bool(said)
    assert all(said in str(found) for found in faults)


def silent() -> Mock:
    """Return a camera and screen in one, which may be asked and nothing else."""
    device = Mock()
    for verb in (device.configure, device.expose, device.download, device.show):
        verb.side_effect = AssertionError
    device.identity.return_value = EOS
    device.shutter_speeds.return_value = SPEEDS
    device.supplies.return_value = Supplies(0.75)
    device.warnings.return_value = ("night light is on: switch it off",)
    return device


class Unmoved(SimulatedProjector):
    """A projector that may be asked, and nothing else."""

    def switch_on(self) -> None:
        raise AssertionError

    def set_muted(self, muted: bool) -> None:
        raise AssertionError(muted)


class TestAsking:
    def test_asks_devices_without_moving_them(self) -> None:
        clock = SimulatedClock()
        answers = ask(Devices(silent(), silent(), Unmoved(clock), clock))
        assert answers.camera == EOS
        assert answers.supplies == Supplies(0.75)
        assert (answers.lit, answers.faults) == (False, ())
        assert "in standby: it will be switched on" in answers.projector
        assert answers.warnings == ("night light is on: switch it off",)
        assert clock.monotonic() == 0

    def test_asks_missing_camera_once(self) -> None:
        clock, camera = SimulatedClock(), silent()
        camera.identity.side_effect = DeviceError("no camera on USB")
        answers = ask(Devices(camera, silent(), Unmoved(clock, power=Power.ON), clock))
        assert not camera.supplies.called
        assert not camera.shutter_speeds.called
        assert [str(fault) for fault in answers.faults] == ["camera: no camera on USB"]
        assert answers.lit


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    design_chart(1).save(tmp_path / "chart.json")
    save_illuminants(LIGHTS[:4], tmp_path / "lights.csv")
    path = tmp_path / "LAB.toml"
    path.write_text(
        'rig = "simulated"\nchart = "chart.json"\nilluminations = "lights.csv"\n[simulated]\nbody = "Test"\n'
        '[judge]\nresponse = false\n[sequence]\nnotify = "https://ntfy.example/s3cret"\n'
    )
    return path


def contents(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in folder.rglob("*")
    }


@pytest.fixture
def small_disk(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(lab.parent)._replace(free=10**8)
    monkeypatch.setattr(shutil, "disk_usage", Mock(return_value=usage))


@pytest.mark.parametrize(
    ("target", "said", "unsaid"),
    [
        ("{there}/tell --phone", "", "s3cret"),
        ("{there}/gone --phone s3cret", "the command {there}/gone … does not exist", "s3cret"),
        ("{there}/plain --phone", "chmod +x {there}/plain", "--phone"),
        (
            "ntfy.example/s3cret",
            "ntfy.example/… does not exist; if it is an address",
            "s3cret",
        ),
        ("https://ntfy.example/s3cret", "", "s3cret"),
        ("", "", "s3cret"),
    ],
)
def test_doubts_unusable_notice_targets(target: str, said: str, unsaid: str, tmp_path: Path) -> None:
    for name, mode in (("tell", 0o755), ("plain", 0o644)):
        (tmp_path / name).touch(mode)
    target, said = target.format(there=tmp_path), said.format(there=tmp_path)
    of_notify = SETTINGS.model_copy(update={"sequence": SETTINGS.sequence.model_copy(update={"notify": target})})
    of_alive = SETTINGS.model_copy(update={"notify": NotifySettings(alive=target)})
    for key, settings in (("sequence.notify", of_notify), ("notify.alive", of_alive)):
        doubts = settings_doubts(settings)
        assert planned(settings=settings).doubts == doubts
        assert len(doubts) == bool(said)
        assert all(doubt.startswith(f"{key}: ") and said in doubt and unsaid not in doubt for doubt in doubts)


def test_doubts_unlikely_times() -> None:
    sequence, real = SETTINGS.sequence, parse_lab('rig = "lab"\nchart = "c"\nilluminations = "i"\n', "LAB.toml")
    control = real.model_copy(
        update={"lab": LabRig(projector=ProjectorCable(control="pjlink", host="h"))},
    )

    def doubts(settings: LabSettings, **changes: float) -> int:
        return len(settings_doubts(settings.model_copy(update={"sequence": sequence.model_copy(update=changes)})))

    assert doubts(control) == 0
    assert doubts(control, settle_s=500.0) == 1
    assert doubts(control, warm_up_s=20.0) == 1
    assert doubts(real, warm_up_s=20.0) == 0, "the lamp is not controlled"


class TestDryRun:
    def test_prints_new_session_without_creating_it(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        lab.write_text(lab.read_text() + '[notify]\nalive = "https://ping.example/s3cret"\n')
        files = contents(lab.parent)
        assert main(["run", str(lab), str(lab.parent / "night"), "--dry-run"]) == 0
        assert contents(lab.parent) == files
        text = capsys.readouterr().out
        assert "night: new, 8 frames to take (4 light, 2 white, 2 dark); 0 frames of 8 done" in text
        assert "shuffled by seed 1" in text
        assert "in standby: it will be switched on" in text
        assert "notices     to https://ntfy.example/…" in text
        assert "alive       to https://ping.example/…" in text
        assert "s3cret" not in text

    def test_prints_session_without_changing_it(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        night = lab.parent / "night"
        document = json_of(main, ["run", lab, night], capsys)
        assert document == {
            "command": "acquire run",
            "session": str(night),
            "frames": 8,
            "left": 0,
            "refused": [],
            "doubts": [],
        }
        with Session.open_for_run(night) as session:
            times = sorted(frame.taken_at for frame in session.frames())
            frame_s = outline(load_lab(lab), night, session).frame_s
            session.retake("2")
        # Frames overlap: an attempt lasts longer than the interval between frames.
        assert frame_s is not None
        gaps = sorted(later - earlier for earlier, later in pairwise(times))
        assert timedelta(seconds=frame_s) == gaps[len(gaps) // 2]
        files = contents(lab.parent)
        capsys.readouterr()
        assert main(["run", str(lab), str(night), "--dry-run", "--retake", "0-1,2"]) == 0
        assert "3 frames to take (3 light); 5 frames of 8 done" in capsys.readouterr().out
        assert contents(lab.parent) == files
        assert main(["run", str(lab), str(night), "--dry-run", "--retake", "9"]) == 2
        assert "has no illuminant 9" in capsys.readouterr().err
        assert main(["run", str(lab), str(night), "--dry-run"]) == 0
        assert contents(lab.parent) == files
        text = capsys.readouterr().out
        assert "night: resumed, 1 frame to take (1 light); 7 frames of 8 done" in text
        assert "the largest file of the session" in text
        assert "median of the session" in text

    @pytest.mark.parametrize("dry", [["--dry-run"], []])
    def test_refuses_retake_in_new_session(self, lab: Path, capsys: pytest.CaptureFixture[str], dry: list[str]) -> None:
        assert main(["run", str(lab), str(lab.parent / "night"), "--retake", "1", *dry]) == 2
        assert "--retake" in capsys.readouterr().err
        assert not (lab.parent / "night").exists()

    @pytest.mark.usefixtures("small_disk")
    def test_full_disk_sets_exit_code(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["run", str(lab), str(lab.parent / "night"), "--dry-run"]) == 5
        printed = capsys.readouterr()
        assert "the disk of" not in printed.out, "a fault is said once"
        assert "are missing" in printed.err
        document = json_of(main, ["run", lab, lab.parent / "night", "--dry-run"], capsys, code=5)
        assert (document["command"], document["frames"]) == ("acquire run", 8)
        assert document["needed_bytes"] > document["free_bytes"] == 10**8
        (fault,) = document["faults"]
        assert fault.startswith("the disk of")

    def test_refuses_changed_settings(self, lab: Path) -> None:
        night = lab.parent / "night"
        settings = load_lab(lab)
        Session.create(night, settings.to_toml(), CHART, LIGHTS[:4], plan_steps(LIGHTS[:4], 25)).close()
        lab.write_text(lab.read_text() + "[camera]\niso = 400\n")
        with Session.open(night) as session, pytest.raises(ConfigurationError):
            outline(load_lab(lab), night, session)

    def test_closed_rig_is_fault_of_plan(self, lab: Path) -> None:
        lab.write_text(lab.read_text().replace('"Test"', '"Box"'))
        plan = dry_run(load_lab(lab), lab.parent / "night")
        assert plan.work.remaining == 8
        with pytest.raises(ConfigurationError):
            plan.require()


@pytest.mark.usefixtures("small_disk")
def test_run_checks_plan_first(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(lab.parent)
    assert main(["run", str(lab), str(lab.parent / "night")]) == 5
    assert "are missing" in capsys.readouterr().err
    assert contents(lab.parent) == before


def test_refuses_folder_as_illuminants(tmp_path: Path) -> None:
    (tmp_path / "lights").mkdir()
    assert main(["illuminations", str(tmp_path / "lights")]) != 0
    assert [path.name for path in tmp_path.iterdir()] == ["lights"]
