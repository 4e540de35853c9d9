"""Set-up faults of a real laboratory: `acquire check` and `acquire run` report each in one sentence with its remedy.

The devices are simulated at the ends of real cables; a simulated presenter replaces the display.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from acquisition.cli import main
from drivers.display.fullscreen import Display, choose_display
from drivers.links.network import TcpLink, TcpServer
from drivers.links.usb import open_usb
from drivers.pjlink import PjLinkProjector
from drivers.projector import Power
from drivers.serial_projectors.language import load_language
from foundation.clock import Clock, SystemClock
from sim.buses.ptp import serve_ptpip
from sim.buses.serial import PseudoTerminal
from sim.buses.usb import PtpUsbDevice, SimulatedBus, UsbIdentity
from sim.camera.bodies import EOS_BODIES
from sim.camera.eos import SimulatedEos
from sim.projectors.pjlink import serve_pjlink
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector
from sim.projectors.serial import LinePeer
from tests.contracts.camera import SeededFilm

pytestmark = pytest.mark.slow

DESK = Display(1, "DP-1", 0, 0, 2560, 1440, 60)


@dataclass
class Bench:
    """A LAB.toml under construction, and its devices."""

    lab: Path
    monkeypatch: pytest.MonkeyPatch
    capsys: pytest.CaptureFixture[str]
    bus: SimulatedBus = field(default_factory=SimulatedBus)

    def plug(self, serial: str = "1") -> PtpUsbDevice:
        """Connect a camera to the bus."""
        eos = SimulatedEos(EOS_BODIES["EOS 550D"], SeededFilm(1000), SystemClock(), serial=serial)
        device = PtpUsbDevice(eos, UsbIdentity(*eos.body.usb, serial=serial))
        self.bus.plug(device)
        return device

    def messages_of(self, text: str) -> tuple[int, str]:
        """Return the exit code and the message, which must be equal for both commands."""
        self.lab.write_text(self.lab.read_text().replace('rig = "simulated"', 'rig = "lab"') + text)
        outcomes = [self._outcome("check", str(self.lab)), self._outcome("run", str(self.lab), str(self.session))]
        assert outcomes[0] == outcomes[1]
        return outcomes[0]

    @property
    def session(self) -> Path:
        return self.lab.parent / "session"

    def _outcome(self, *arguments: str) -> tuple[int, str]:
        code = main(arguments)
        message = self.capsys.readouterr().err
        assert message.count("error: ") == 1
        # Remaining times differ from run to run.
        return code, re.sub(r"\b0\.0\d+ s", "0.05 s", message.partition("error: ")[2].rstrip())


@pytest.fixture
def bench(lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Bench:
    bench = Bench(lab, monkeypatch, capsys)

    def presenter(display: str | int | None, clock: Clock) -> SimulatedPresenter:
        choose_display((DESK,), display)
        return SimulatedPresenter(Screen(), clock)

    def warnings(display: str | int | None) -> tuple[str, ...]:
        choose_display((DESK,), display)
        return ()

    monkeypatch.setattr("acquisition.run.rig.lab.FullScreen", presenter)
    monkeypatch.setattr("acquisition.run.rig.lab.display_warnings", warnings)
    monkeypatch.setattr("acquisition.run.rig.lab.open_usb", partial(open_usb, backend=bench.bus))
    return bench


@pytest.fixture
def camera() -> Iterator[str]:
    """Return the settings of a camera that answers on loopback."""
    eos = SimulatedEos(EOS_BODIES["Test"], SeededFilm(1000), SystemClock(), auto_power_off_s=0)
    with serve_ptpip(eos, 0) as server:
        yield f'[lab.camera]\nconnection = "ptpip"\nhost = "127.0.0.1"\nport = {server.address[1]}\n'


def pjlink(port: int) -> str:
    return f'[lab.projector]\ncontrol = "pjlink"\nhost = "127.0.0.1"\nport = {port}\n'


def free_port() -> int:
    with TcpServer(lambda link: None) as server:
        return server.address[1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            'control = "serial"\nlanguage = "optoma"\nhost = "127.0.0.1"',
            "Optoma projectors have only a serial port",
        ),
        ('control = "serial"\nlanguage = "epson"\nbaud = 12345678901\ndevice = "{port}"', "set another speed"),
    ],
)
def test_refuses_impossible_cable(bench: Bench, camera: str, text: str, words: str) -> None:
    with PseudoTerminal(LinePeer(SimulatedProjector(SystemClock()), load_language("epson"))) as terminal:
        code, message = bench.messages_of(f"{camera}[lab.projector]\n{text.format(port=terminal.path)}\n")
    assert code == 2
    assert words in message


def test_reports_missing_serial_port(bench: Bench, camera: str) -> None:
    code, message = bench.messages_of(
        f'{camera}[lab.projector]\ncontrol = "serial"\nlanguage = "benq"\ndevice = "/dev/ttyCROP9"\n'
    )
    assert code == 3
    assert message.startswith("projector: serial port /dev/ttyCROP9 does not exist (present: ")


def test_reports_wrong_language(bench: Bench, camera: str) -> None:
    with PseudoTerminal(LinePeer(SimulatedProjector(SystemClock()), load_language("epson"))) as terminal:
        code, message = bench.messages_of(
            f'{camera}[lab.projector]\ncontrol = "serial"\nlanguage = "optoma"\ndevice = "{terminal.path}"\n'
        )
    assert code == 3
    assert "answers 'ERR" in message
    assert "compare speed and parity with the projector's menu, and check the name of the language" in message


def test_reports_closed_port(bench: Bench, camera: str) -> None:
    code, message = bench.messages_of(camera + pjlink(port := free_port()))
    assert code == 3
    assert message == (
        f"projector: nothing listens at 127.0.0.1:{port}; check the port, and that network control is enabled on the "
        "device"
    )


def test_reports_silent_projector(bench: Bench, camera: str) -> None:
    bench.monkeypatch.setattr("acquisition.run.rig.lab.PjLinkProjector", partial(PjLinkProjector, timeout=0.05))

    def stay_silent(link: TcpLink) -> None:
        link.read(1, 60.0)

    with TcpServer(stay_silent) as server:
        code, message = bench.messages_of(camera + pjlink(server.address[1]))
    assert code == 3
    assert "has not answered within 0.05 s" in message
    assert "check that it is on the network" in message


def test_reports_missing_display_and_camera(bench: Bench) -> None:
    code, message = bench.messages_of('[lab.light]\ndisplay = "HDMI-1"\n')
    # The camera is still tested; the fault of a device determines the exit code.
    assert code == 3
    assert "display 'HDMI-1' is not connected" in message
    assert str(DESK) in message
    assert "no camera with vendor 04a9 on USB (present: none)" in message


def test_refuses_ambiguous_cameras(bench: Bench) -> None:
    bench.plug("1")
    bench.plug("2")
    code, message = bench.messages_of("")
    assert code == 2
    assert "2 cameras on USB match, expected 1: " in message
    assert "set a serial number or port" in message


def test_reports_wrong_device_at_camera_port(bench: Bench) -> None:
    with serve_pjlink(SimulatedProjector(SystemClock(), power=Power.ON), 0) as server:
        port = server.address[1]
        code, message = bench.messages_of(f'[lab.camera]\nconnection = "ptpip"\nhost = "127.0.0.1"\nport = {port}\n')
    assert code == 3
    assert f"the camera at 127.0.0.1:{port} sent no valid PTP/IP reply" in message
