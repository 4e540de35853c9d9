"""A real laboratory in which only the world is simulated, with the wires and cables of real devices.

The camera uses PTP/IP on loopback or the simulated USB bus; the projector PJLink on loopback or a pseudo-terminal. The
light is a window on a virtual X display, which the world observes. The frames equal those of `rig = "simulated"` with
the same seed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from acquisition.cli import main
from acquisition.run.rig.opening import open_rig
from acquisition.run.rig.simulated import sheet, simulated_body, simulated_room
from acquisition.run.run import run_session
from drivers.links.network import serve_peer
from drivers.links.usb import open_usb
from drivers.presenter import Colour
from drivers.projector import Power
from drivers.raw.rawfile import read_raw
from drivers.serial_projectors.language import load_language
from experiment.chart.model import load_chart
from experiment.config import load_lab
from experiment.session.folder import Session
from foundation.clock import SIM_START, Clock, SystemClock
from sim.buses.ptp import serve_ptpip
from sim.buses.serial import PseudoTerminal
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from sim.camera.bodies import EOS_BODIES
from sim.camera.eos import SimulatedEos
from sim.camera.film import WorldFilm
from sim.projectors.pjlink import serve_pjlink
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector
from sim.projectors.serial import LinePeer
from sim.world.world import World
from tests.drivers.display.x_servers import virtual_screen
from tests.drivers.serial_projectors.made_up import MADE_UP, TEXT
from tests.end_to_end.conftest import make_lab
from tests.found_texts import files_with

pytestmark = pytest.mark.slow

FRAMES = 10
PASSWORD = "pj-5ecret-word"
ROOM = """
[camera]
shutter_s = 0.1
[simulated.room]
lamp_drift_per_hour = 0.0
white_level_share = 3.5
"""


def simulated_display(display: str | int | None, clock: Clock) -> SimulatedPresenter:
    """Replace `FullScreen`, so that displays of this machine stay dark."""
    return SimulatedPresenter(Screen(), clock)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the session that the simulated laboratory takes in that room."""
    lab = make_lab(tmp_path_factory.mktemp("simulated"))
    lab.write_text(lab.read_text() + ROOM)
    assert run_session(load_lab(lab), lab.parent / "session", lambda count, total: None).complete
    return lab.parent / "session"


@pytest.mark.parametrize("cables", ["network", "usb and serial"])
def test_real_lab_takes_frames_of_simulated_lab(
    lab: Path, simulated: Path, cables: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = lab.parent
    lab.write_text(lab.read_text() + ROOM)
    settings = load_lab(lab)
    with ExitStack() as stack:
        screen = stack.enter_context(virtual_screen(folder, "320x240"))
        monkeypatch.setenv("DISPLAY", screen.display)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

        def look() -> Colour:
            colours = np.unique(screen.picture())
            assert len(colours) == 1, "the screen is not one plain colour"
            code = int(colours[0])
            return Colour(code >> 16 & 255, code >> 8 & 255, code & 255)

        clock = SystemClock()
        beamer = SimulatedProjector(clock, power=Power.ON)
        world = World(sheet(load_chart(settings.chart)), simulated_body(settings), simulated_room(settings))
        film = WorldFilm(world, look, beamer.light, "0000000001", {})
        executor = stack.enter_context(ThreadPoolExecutor(1))
        world.expose(Colour(0, 0, 0), settings.camera.exposure, key=(0,))  # renders before time counts
        eos = SimulatedEos(EOS_BODIES["Test"], film, clock, auto_power_off_s=0, executor=executor)
        bus = SimulatedBus()
        text = lab.read_text().replace('rig = "simulated"', 'rig = "lab"')
        text = text.replace("[sequence]\n", "[sequence]\nsettle_s = 0.0\n")
        if cables == "network":
            _, port = stack.enter_context(serve_ptpip(eos, 0)).address
            _, control = stack.enter_context(serve_pjlink(beamer, 0, PASSWORD)).address
            monkeypatch.setenv("LAB_PROJECTOR", PASSWORD)
            text += f'[lab.camera]\nconnection = "ptpip"\nhost = "127.0.0.1"\nport = {port}\n'
            text += f'[lab.projector]\ncontrol = "pjlink"\nhost = "127.0.0.1"\nport = {control}\n'
            text += 'password = { env = "LAB_PROJECTOR" }\n'
        else:
            bus.plug(PtpUsbDevice(eos))
            terminal = stack.enter_context(PseudoTerminal(LinePeer(beamer, load_language("benq"))))
            text += '[lab.camera]\nconnection = "usb"\n'
            text += f'[lab.projector]\ncontrol = "serial"\nlanguage = "benq"\ndevice = "{terminal.path}"\n'
        lab.write_text(text)
        monkeypatch.setattr("acquisition.run.rig.lab.open_usb", partial(open_usb, backend=bus))
        assert run_session(load_lab(lab), folder / "real", lambda count, total: None).complete
        assert beamer.power() is not Power.ON, "a complete session switches the lamp off"
        assert look() == Colour(0, 0, 0), "the screen is black at the end"
    assert files_with(folder / "real", PASSWORD) == []
    with Session.open(simulated) as simulated_session, Session.open(folder / "real") as real_session:
        pairs = list(zip(simulated_session.frames(), real_session.frames(), strict=True))
        assert len(pairs) == FRAMES
        for simulated_frame, real_frame in pairs:
            assert (simulated_frame.kind, simulated_frame.illumination) == (real_frame.kind, real_frame.illumination)
            simulated_raw = read_raw(simulated_session.folder / simulated_frame.file)
            real_raw = read_raw(real_session.folder / real_frame.file)
            np.testing.assert_array_equal(simulated_raw.sensor, real_raw.sensor)
            assert real_frame.taken_at > SIM_START


def test_check_reports_changes_of_light(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class WarningPresenter(SimulatedPresenter):
        def warnings(self) -> tuple[str, ...]:
            return ("the gamma ramp is not straight: switch off night light",)

    monkeypatch.setattr("acquisition.run.rig.simulated.SimulatedPresenter", WarningPresenter)
    lab.write_text(lab.read_text().replace("warm_up_s = 0", "warm_up_s = 1200"))
    assert main(["check", str(lab)]) == 0
    printed = capsys.readouterr()
    assert "gamma ramp is not straight" in printed.out
    assert "tags" in printed.out
    assert "warming up: the lamp was just switched on; the run waits 20 min 00 s" in printed.err


@pytest.mark.parametrize("language_name", ["epson", "languages/lantern.toml"])
def test_maker_language_over_network(lab: Path, language_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquisition.run.rig.lab.FullScreen", simulated_display)
    monkeypatch.setattr("acquisition.run.rig.lab.CanonEos", Mock())
    (lab.parent / "languages").mkdir(exist_ok=True)
    (lab.parent / "languages" / "lantern.toml").write_text(TEXT)
    beamer = SimulatedProjector(SystemClock(), power=Power.ON)
    language = MADE_UP if language_name.endswith(".toml") else load_language(language_name)
    with serve_peer(lambda: LinePeer(beamer, language, network=True)) as server:
        host, port = server.address
        text = lab.read_text().replace('rig = "simulated"', 'rig = "lab"')
        text += '[lab.camera]\nconnection = "ptpip"\nhost = "127.0.0.1"\n'
        text += f'[lab.projector]\ncontrol = "serial"\nlanguage = "{language_name}"\n'
        lab.write_text(text + f'host = "{host}"\nport = {port}\n')
        settings = load_lab(lab)
        with open_rig(settings, load_chart(settings.chart)) as devices:
            assert devices.projector is not None
            assert devices.projector.power() is Power.ON
