"""The plan before action: what is printed holds, what would end a run is refused with its remedy, and nothing moves."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from acquisition.cli import main
from acquisition.run.devices import Devices
from acquisition.run.plan import (
    Answers,
    RunPlan,
    Work,
    ask,
    dry_run,
    free_bytes_at,
    make_plan,
    order_of,
    outline,
    settings_doubts,
)
from drivers.camera import CameraIdentity, ExposureSettings, Supplies
from drivers.presenter import Colour
from drivers.projector import Power
from experiment.chart.layout import design_chart
from experiment.config import LabRig, LabSettings, NotifySettings, ProjectorCable, load_lab, parse_lab
from experiment.lights import Illumination, save_illuminations
from experiment.session.folder import Session
from experiment.session.records import plan_steps
from foundation.clock import SimulatedClock
from foundation.errors import ConfigurationError, CropError, DeviceError, DeviceFault, DeviceRefused, StorageError
from sim.projectors.projector import SimulatedProjector
from tests.json_of import json_of

pytestmark = pytest.mark.slow

GB = 10**9
LIGHTS = tuple(Illumination(index, "uniform", None, Colour(255, index, 0)) for index in range(100))
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
    given = answers or Answers(camera=EOS, offered_s=SPEEDS, projector="Epson, in standby: it will be lit", lit=False)
    return make_plan(settings, work or work_of(), given, int(free))


class TestDisk:
    def test_a_disk_that_is_too_small_names_what_is_missing(self) -> None:
        enough = planned().needed_bytes
        assert planned(enough).faults == ()
        (fault,) = planned(enough - 3.25 * GB).faults
        assert isinstance(fault, StorageError)
        assert "3.3 GB" in str(fault)
        with pytest.raises(StorageError, match=r"3\.3 GB"):
            planned(enough - 3.25 * GB).require()
        (fault,) = planned(enough - 1).faults
        assert "0.1 MB" in str(fault), "a little too small is never nothing"

    def test_free_space_is_that_of_the_nearest_folder_that_is_there(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: list[Path] = []
        usage = shutil.disk_usage(tmp_path)

        def disk_usage(path: Path) -> object:
            asked.append(Path(path))
            return usage._replace(free=1)

        monkeypatch.setattr(shutil, "disk_usage", disk_usage)
        assert free_bytes_at(tmp_path / "in" / "night") == 1
        assert asked == [tmp_path]

    def test_a_disk_that_fails(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def dead(path: object) -> object:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

        monkeypatch.setattr(os, "statvfs", dead)
        with pytest.raises(StorageError):
            free_bytes_at(tmp_path)


class TestExposure:
    def test_a_time_that_is_not_offered_names_the_nearest(self) -> None:
        settings = settings_with(camera={"shutter_s": 0.45})
        (fault,) = planned(settings=settings).faults
        assert isinstance(fault, DeviceRefused)
        assert str(fault).startswith("camera.shutter_s = 0.45: the body does not offer it; ")
        assert "0.4, 0.5, 0.6 s" in str(fault)


class TestSupplies:
    @pytest.mark.parametrize(
        ("supplies", "fault"),
        [
            (Supplies(battery=0.25), True),
            (Supplies(battery=0.25, mains=False), True),
            (Supplies(battery=0.25, mains=True), False),
            (Supplies(battery=0.5), False),
            (Supplies(), False),
        ],
    )
    def test_a_low_battery_ends_a_night(self, supplies: Supplies, fault: bool) -> None:
        faults = planned(answers=Answers(camera=EOS, supplies=supplies)).faults
        assert [type(found) for found in faults] == [DeviceFault] * fault
        assert all("at 25%, and 110 frames are to be taken; connect a mains adapter" in str(found) for found in faults)

    @pytest.mark.parametrize(
        ("supplies", "fault"),
        [
            (Supplies(card_free_bytes=GB, saves_to_host=False), True),
            (Supplies(card_free_bytes=GB, saves_to_host=True), False),
            (Supplies(card_free_bytes=100 * GB, saves_to_host=False), False),
            (Supplies(card_free_bytes=None, saves_to_host=False), False),
        ],
    )
    def test_a_card_that_is_too_small_matters_where_frames_stay_on_it(self, supplies: Supplies, fault: bool) -> None:
        faults = planned(answers=Answers(camera=EOS, supplies=supplies)).faults
        assert [type(found) for found in faults] == [DeviceFault] * fault
        assert all("are missing; put in an empty card of" in str(found) for found in faults)


class TestOrder:
    def test_a_session_keeps_the_order_that_it_was_begun_with(self) -> None:
        assert (
            order_of(plan_steps(LIGHTS, 25), SETTINGS) == "as listed, as the session was begun; LAB.toml says shuffled"
        )
        shuffled = plan_steps(LIGHTS, 25, seed=1)
        assert (
            order_of(shuffled, settings_with(sequence={"seed": 2}))
            == "shuffled by another seed, as the session was begun"
        )
        wanted = settings_with(sequence={"order": "listed"})
        assert order_of(shuffled, wanted) == "shuffled by seed 1, as the session was begun; LAB.toml says listed"


@dataclass
class Silent:
    """Devices that note what is asked of them, and must do nothing else."""

    log: list[str] = field(default_factory=list[str])
    fault: DeviceError | None = None

    def _noted(self, what: str, answer: Any) -> Any:
        self.log.append(what)
        if self.fault is not None:
            raise self.fault
        return answer

    def identity(self) -> CameraIdentity:
        return self._noted("identity", EOS)

    def shutter_speeds(self) -> tuple[float, ...]:
        return self._noted("shutter_speeds", SPEEDS)

    def supplies(self) -> Supplies:
        return self._noted("supplies", Supplies(0.75))

    def configure(self, settings: ExposureSettings) -> None:
        raise AssertionError(settings)

    def expose(self) -> datetime:
        raise AssertionError

    def download(self, into: object) -> Any:
        raise AssertionError(into)

    def show(self, colour: Colour) -> None:
        raise AssertionError(colour)

    def warnings(self) -> tuple[str, ...]:
        return ("night light is on: switch it off",)

    def close(self) -> None: ...


class Unmoved(SimulatedProjector):
    """A projector that may be asked, and nothing else."""

    def switch_on(self) -> None:
        raise AssertionError

    def set_muted(self, muted: bool) -> None:
        raise AssertionError(muted)


class TestAsking:
    def test_devices_are_asked_and_nothing_moves(self) -> None:
        clock = SimulatedClock()
        answers = ask(Devices(Silent(), Silent(), Unmoved(clock), clock))
        assert answers.camera == EOS
        assert answers.supplies == Supplies(0.75)
        assert (answers.lit, answers.faults) == (False, ())
        assert "in standby: it will be lit" in answers.projector
        assert answers.warnings == ("night light is on: switch it off",)
        assert clock.monotonic() == 0

    def test_a_camera_that_is_gone_is_asked_once_and_the_rest_all_the_same(self) -> None:
        clock, camera = SimulatedClock(), Silent(fault=DeviceError("no camera on USB"))
        answers = ask(Devices(camera, Silent(), Unmoved(clock, power=Power.ON), clock))
        assert camera.log == ["identity"]
        assert [str(fault) for fault in answers.faults] == ["camera: no camera on USB"]
        assert answers.lit

    def test_what_cannot_be_asked_is_named(self) -> None:
        class Mute:
            def __init__(self) -> None:
                self.identity = Silent().identity
                self.shutter_speeds = tuple
                self.configure, self.expose, self.download = Silent().configure, Silent().expose, Silent().download
                self.close = Silent().close

        answers = ask(Devices(Mute(), Silent(), None, SimulatedClock()))  # pyrefly: ignore[bad-argument-type]
        assert [sentence.split(":")[0] for sentence in answers.unasked] == [
            "shutter times", "battery", "ISO speed and aperture", "lamp",
        ]  # fmt: skip


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    design_chart(1).save(tmp_path / "chart.json")
    save_illuminations(LIGHTS[:4], tmp_path / "lights.csv")
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

    def small(path: Path) -> object:
        return usage

    monkeypatch.setattr(shutil, "disk_usage", small)


@pytest.mark.parametrize(
    ("target", "said", "unsaid"),
    [
        ("{there}/tell --phone", "", "s3cret"),
        ("{there}/gone --phone s3cret", "{there}/gone … is no command that is there", "s3cret"),
        ("{there}/plain --phone", "chmod +x {there}/plain", "--phone"),
        (
            "ntfy.example/s3cret",
            "ntfy.example/… is no command that is there; an address begins",
            "s3cret",
        ),
        ("https://ntfy.example/s3cret", "", "s3cret"),
        ("", "", "s3cret"),
    ],
)
def test_who_would_not_hear_what_he_is_told_is_doubted(target: str, said: str, unsaid: str, tmp_path: Path) -> None:
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


def test_times_that_were_meant_otherwise_are_doubted() -> None:
    sequence, real = SETTINGS.sequence, parse_lab('rig = "lab"\nchart = "c"\nilluminations = "i"\n', "LAB.toml")
    control = real.model_copy(
        update={"lab": LabRig(projector=ProjectorCable(control="pjlink", host="h"))},
    )

    def doubts(settings: LabSettings, **changes: float) -> int:
        return len(settings_doubts(settings.model_copy(update={"sequence": sequence.model_copy(update=changes)})))

    assert doubts(control) == 0
    assert doubts(control, settle_s=500.0) == 1
    assert doubts(control, warm_up_s=20.0) == 1
    assert doubts(real, warm_up_s=20.0) == 0, "the lamp is not under control"


class TestDryRun:
    def test_a_new_session_is_printed_and_not_made(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        lab.write_text(lab.read_text() + '[notify]\nalive = "https://ping.example/s3cret"\n')
        before = contents(lab.parent)
        assert main(["run", str(lab), str(lab.parent / "night"), "--dry-run"]) == 0
        assert contents(lab.parent) == before
        text = capsys.readouterr().out
        assert "night: new, 8 frames to take (4 light, 2 white, 2 dark); 0 frames of 8 done" in text
        assert "shuffled by seed 1" in text
        assert "in standby: it will be lit" in text
        assert "notices     to https://ntfy.example/…" in text
        assert "alive       to https://ping.example/…" in text
        assert "s3cret" not in text

    def test_a_session_is_looked_at_and_not_changed(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        night = lab.parent / "night"
        found = json_of(main, ["run", lab, night], capsys)
        assert found == {
            "command": "acquire run",
            "session": str(night),
            "frames": 8,
            "left": 0,
            "refused": [],
            "doubts": [],
        }
        with Session.open_for_run(night) as session:
            taken = sorted(frame.taken_at for frame in session.frames())
            frame_s = outline(load_lab(lab), night, session).frame_s
            session.retake("2")
        # Frames overlap: the time of an attempt is not that from one frame to the next.
        assert frame_s is not None
        gaps = sorted(after - before for before, after in pairwise(taken))
        assert timedelta(seconds=frame_s) == gaps[len(gaps) // 2]
        before = contents(lab.parent)
        capsys.readouterr()
        assert main(["run", str(lab), str(night), "--dry-run", "--retake", "0-1,2"]) == 0
        assert "3 frames to take (3 light); 5 frames of 8 done" in capsys.readouterr().out
        assert contents(lab.parent) == before
        assert main(["run", str(lab), str(night), "--dry-run", "--retake", "9"]) == 2
        assert "has no light 9" in capsys.readouterr().err
        assert main(["run", str(lab), str(night), "--dry-run"]) == 0
        assert contents(lab.parent) == before
        text = capsys.readouterr().out
        assert "night: taken up again, 1 frame to take (1 light); 7 frames of 8 done" in text
        assert "the largest of the session so far" in text
        assert "median of the session so far" in text

    @pytest.mark.parametrize("dry", [["--dry-run"], []])
    def test_nothing_is_taken_again_of_a_session_that_was_not_begun(
        self, lab: Path, capsys: pytest.CaptureFixture[str], dry: list[str]
    ) -> None:
        assert main(["run", str(lab), str(lab.parent / "night"), "--retake", "1", *dry]) == 2
        assert "--retake" in capsys.readouterr().err
        assert not (lab.parent / "night").exists()

    @pytest.mark.usefixtures("small_disk")
    def test_a_full_disk_is_printed_and_is_the_exit_code(self, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["run", str(lab), str(lab.parent / "night"), "--dry-run"]) == 5
        said = capsys.readouterr()
        assert "the disk of" not in said.out, "a fault is said once"
        assert "are missing" in said.err
        found = json_of(main, ["run", lab, lab.parent / "night", "--dry-run"], capsys, code=5)
        assert (found["command"], found["frames"]) == ("acquire run", 8)
        assert found["needed_bytes"] > found["free_bytes"] == 10**8
        (fault,) = found["faults"]
        assert fault.startswith("the disk of")

    def test_a_session_that_was_begun_otherwise_is_refused(self, lab: Path) -> None:
        night = lab.parent / "night"
        settings = load_lab(lab)
        Session.create(night, settings.to_toml(), CHART, LIGHTS[:4], plan_steps(LIGHTS[:4], 25)).close()
        lab.write_text(lab.read_text() + "[camera]\niso = 400\n")
        with Session.open(night) as session, pytest.raises(ConfigurationError):
            outline(load_lab(lab), night, session)

    def test_a_rig_that_cannot_be_opened_is_a_fault_of_the_plan(self, lab: Path) -> None:
        lab.write_text(lab.read_text().replace('"Test"', '"Box"'))
        plan = dry_run(load_lab(lab), lab.parent / "night")
        assert plan.work.left == 8
        with pytest.raises(ConfigurationError):
            plan.require()


def test_the_first_fault_is_raised_and_the_others_named() -> None:
    faults: tuple[CropError, ...] = (DeviceFault("the lamp is broken"), StorageError("the disk is full"))
    plan = replace(planned(), faults=faults)
    with pytest.raises(DeviceFault):
        plan.require()
    replace(planned(), faults=()).require()


@pytest.mark.usefixtures("small_disk")
def test_a_run_checks_its_plan_before_anything_moves(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(lab.parent)
    assert main(["run", str(lab), str(lab.parent / "night")]) == 5
    assert "are missing" in capsys.readouterr().err
    assert contents(lab.parent) == before


def test_a_folder_in_place_of_the_lights_leaves_nothing_beside_it(tmp_path: Path) -> None:
    (tmp_path / "lights").mkdir()
    assert main(["illuminations", str(tmp_path / "lights")]) != 0
    assert [path.name for path in tmp_path.iterdir()] == ["lights"]
