"""The simulated laboratory is built from LAB.toml; unknown settings are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from acquisition.run.plan import ask
from acquisition.run.rig import lab as attached
from acquisition.run.rig.lab import attached_devices
from acquisition.run.rig.opening import open_rig
from acquisition.run.rig.simulated import simulated_body, simulated_frame_bytes, simulated_room
from acquisition.run.run import run_session
from drivers.pjlink import FoundProjector
from drivers.presenter import WHITE
from drivers.raw.rawfile import read_raw
from experiment.chart.layout import design_chart
from experiment.config import CameraSettings, LabSettings, SimulatedSettings, load_lab, parse_lab
from experiment.lights import plan_illuminants, save_illuminants
from experiment.session.folder import Session
from foundation.clock import Clock
from foundation.errors import ConfigurationError, DeviceRefused
from sim.projectors.projector import Screen, SimulatedPresenter
from sim.world.sensors import SENSITIVITY_BODIES

HEAD = 'rig = "simulated"\nchart = "c.json"\nilluminations = "l.csv"\n'


def simulated_display(display: str | int | None, clock: Clock) -> SimulatedPresenter:
    """Stand in for `FullScreen`: whatever display this machine has stays dark."""
    return SimulatedPresenter(Screen(), clock)


def settings(text: str) -> LabSettings:
    return parse_lab(HEAD + text, "LAB.toml")


def test_room_has_parameters_of_file() -> None:
    room = simulated_room(settings("[simulated]\nseed = 5\n[simulated.room]\nwaviness_mm = 6\ntransfer = 2.2\n"))
    assert (room.seed, room.waviness_mm, room.transfer) == (5, 6.0, 2.2)
    assert simulated_room(settings("[simulated.room]\ntransfer = 'srgb'\n")).transfer == "srgb"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wavines_mm = 3", "did you mean 'waviness_mm'?"),
        ("blur_px = -1", "blur_px"),
        ("vignetting = 1.5", "vignetting"),
        ("waviness_mm = 'much'", "simulated.room.waviness_mm"),
        ("transfer = 'log'", "simulated.room.transfer"),
        ("seed = 3", "unknown key 'simulated.room.seed'"),
    ],
)
def test_refuses_wrong_parameter(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "e.toml"
    path.write_text(f"{HEAD}[simulated.room]\n{text}\n")
    with pytest.raises(ConfigurationError) as caught:
        simulated_room(load_lab(path))
    assert expected in str(caught.value)
    assert str(caught.value).startswith(str(path))


def test_refuses_unknown_body() -> None:
    with pytest.raises(ConfigurationError, match=r"did you mean .*sim table --camera list"):
        simulated_body(settings('[simulated]\nbody = "EOS 7D"\n'))


def test_accepts_sensitivities_as_body() -> None:
    text = '[simulated]\nbody = "Canon_EOS_5DS"\n[simulated.camera]\npixels = [800, 556]\nelectrons_per_dn = 2.0\n'
    body = simulated_body(settings(text))
    assert (body.camera, body.sensitivities, body.half_size) == ("Canon EOS 5DS", "Canon_EOS_5DS", (278, 400))
    assert body.electrons_per_dn == 2.0
    with pytest.raises(ConfigurationError, match=r"^LAB.toml: unknown key 'simulated\.camera\.gain'"):
        simulated_body(settings("[simulated.camera]\ngain = 2.0\n"))


@pytest.mark.slow
def test_records_such_body_in_session(tmp_path: Path) -> None:
    design_chart(1, (148, 105)).save(tmp_path / "chart.json")
    save_illuminants(plan_illuminants(0, (3000, 6000)), tmp_path / "lights.csv")
    lab = LabSettings(
        rig="simulated",
        chart=tmp_path / "chart.json",
        illuminations=tmp_path / "lights.csv",
        camera=CameraSettings(aperture="none"),
        simulated=SimulatedSettings(body="Canon_EOS-1Ds_Mark_III", camera={"pixels": [800, 556]}),
    )
    run_session(lab, tmp_path / "session", lambda done, total: None)
    with Session.open(tmp_path / "session") as session:
        frames = [frame for frame in session.frames() if frame.kind == "light"]
        assert len(frames) == 2
        assert 'aperture = "none"' in session.settings_text()
        mosaic = read_raw(session.folder / frames[0].file)
        # A plan needs the size before there are frames.
        assert simulated_frame_bytes(lab) == pytest.approx((session.folder / frames[0].file).stat().st_size, rel=0.02)
    assert mosaic.camera == "Canon EOS-1Ds Mark III"
    assert mosaic.counts.shape == (556, 800)
    assert mosaic.aperture is None
    black = mosaic.masked_black()
    assert black is not None
    assert black == pytest.approx(SENSITIVITY_BODIES["Canon_EOS-1Ds_Mark_III"].black, abs=1)


def test_refuses_imported_session() -> None:
    imported = LabSettings(rig="imported", chart=Path("c"), illuminations=Path("l"))
    with pytest.raises(ConfigurationError, match="other means"), open_rig(imported, design_chart(bits=1)):
        pass


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[lab.camera]\nconnection = "ptpip"\n', "lab.camera.host is missing"),
        ('[lab.projector]\ncontrol = "pjlink"\n', "lab.projector.host is missing"),
        ('[lab.projector]\ncontrol = "serial"\nlanguage = "epson"\n', "lab.projector.device is missing"),
        ('[lab.projector]\ncontrol = "serial"\ndevice = "/dev/ttyS0"\n', "lab.projector.language is missing"),
        ('[lab.projector]\ncontrol = "serial"\nlanguage = "klingon"\n', "projector language 'klingon' does not exist"),
        ('[lab.projector]\ncontrol = "pjlink"\ndevice = "/dev/ttyS0"\n', "PJLink needs the network"),
        ('[lab.projector]\ncontrol = "serial"\nlanguage = "epson"\nhost = "h"\ndevice = "/dev/ttyS0"\n', "both given"),
        ('[lab.camera]\nhost = "1.2.3.4"\n', "connection is"),
        ("[camera]\nshutter_s = 0.51\n", "whole turns"),
    ],
)
def test_refuses_incomplete_connection(text: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquisition.run.rig.lab.FullScreen", simulated_display)
    monkeypatch.setattr("acquisition.run.rig.lab.display_warnings", Mock(return_value=()))
    # The camera must answer, because its fault would be reported together with that of the settings.
    monkeypatch.setattr("acquisition.run.rig.lab.CanonEos", Mock())
    real = parse_lab(HEAD.replace("simulated", "lab") + text, "LAB.toml")
    with pytest.raises(ConfigurationError, match=expected), open_rig(real, design_chart(bits=1)):
        pass


def test_dry_run_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquisition.run.rig.lab.FullScreen", Mock(side_effect=AssertionError("the light was opened")))
    monkeypatch.setattr("acquisition.run.rig.lab.display_warnings", Mock(return_value=("a bent ramp",)))
    monkeypatch.setattr("acquisition.run.rig.lab.CanonEos", Mock())
    real = parse_lab(HEAD.replace("simulated", "lab"), "LAB.toml")
    with open_rig(real, design_chart(bits=1), opens_display=False) as devices:
        assert "a bent ramp" in ask(devices).warnings
        with pytest.raises(DeviceRefused):
            devices.presenter.show(WHITE)


@pytest.mark.skipif(sys.platform != "linux", reason="names of sockets without files are Linux's")
def test_refuses_lab_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = tmp_path / "LAB.toml"
    lab.write_text(HEAD.replace("simulated", "lab"))
    place = lab.stat()
    program = f"from foundation.holds import hold\nwith hold('', 'lab {place.st_dev} {place.st_ino}'): print(), input()"
    opened = Mock(side_effect=AssertionError("a device was opened"))
    for name in ("FullScreen", "CanonEos", "display_warnings"):
        monkeypatch.setattr(f"acquisition.run.rig.lab.{name}", opened)
    with subprocess.Popen([sys.executable, "-uc", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        for opens_display in (True, False):
            with (
                pytest.raises(DeviceRefused, match=f"process {other.pid}"),
                open_rig(parse_lab(lab.read_text(), str(lab)), design_chart(bits=1), opens_display=opens_display),
            ):
                pass
        other.communicate(b"\n")


@pytest.mark.slow
def test_reports_unlistable_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(attached, "search", lambda: (FoundProjector("192.0.2.7", "00:00:5e:00:53:01"),))
    kinds = {found.kind: found for found in attached_devices()}
    assert list(kinds) == ["cameras on USB", "serial ports", "displays", "projectors by PJLink"]
    assert kinds["projectors by PJLink"].found == ("192.0.2.7, MAC 00:00:5e:00:53:01",)
    assert kinds["displays"].found == ()
    assert kinds["displays"].trouble
