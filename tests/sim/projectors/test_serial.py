"""The simulated serial projectors with drivers of other authors, and their two ends."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from benqprojector import BenQProjectorSerial
from epson_projector import Projector

from drivers.links.serial import SerialLink
from drivers.projector import Power, ProjectorIdentity
from drivers.serial_projectors.driver import LineProjector
from drivers.serial_projectors.language import built_in_languages, load_language
from foundation.clock import SimulatedClock
from sim.buses.serial import PseudoTerminal
from sim.cli import main
from sim.projectors.projector import ProjectorTraits, SimulatedProjector
from sim.projectors.serial import LinePeer
from tests.drivers.serial_projectors.made_up import TEXT
from tests.sim.conftest import sim_serving

BENQ, EPSON = load_language("benq"), load_language("epson")
AT_ONCE = ProjectorTraits(
    ProjectorIdentity("CroP", "Simulated Projector", "CROP0000001"), warm_up_s=0.0, cool_down_s=0.0
)
"""Other software waits by its own clock; a projector that is on at once keeps it short."""


@pytest.fixture
def device() -> SimulatedProjector:
    return SimulatedProjector(SimulatedClock(), traits=AT_ONCE)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:open_text is deprecated:DeprecationWarning")
def test_benqprojector_drives_the_simulated_benq(device: SimulatedProjector) -> None:
    async def talk(path: str) -> None:
        client = BenQProjectorSerial(path, 115200)
        assert await client.connect()
        assert (client.model, client.power_status) == ("Simulated Projector", client.POWERSTATUS_OFF)
        assert await client.turn_on()
        assert await client.send_command("pow", check_supported=False) == "on"
        assert await client.send_command("blank", "on", check_supported=False) == "on"
        assert await client.send_command("blank", check_supported=False) == "on"
        assert await client.send_command("ltim", check_supported=False) == "120"
        assert await client.send_command("3d", check_supported=False) is None, "refused, and the client knows it"
        await client.disconnect()

    with PseudoTerminal(LinePeer(device, BENQ)) as terminal:
        asyncio.run(talk(terminal.path))
    assert device.power() is Power.ON
    assert device.muted()


def test_epson_projector_drives_the_simulated_epson(device: SimulatedProjector) -> None:
    async def talk(path: str) -> None:
        client = Projector(path, type="serial")
        assert await client.get_power() == "04"
        assert await client.get_serial_number() == "CROP0000001"
        assert await client.send_command("PWR ON") == ""
        client.close()
        # A command locks this client for the time that it takes on a real projector.
        client = Projector(path, type="serial")
        assert await client.get_power() == "01"
        assert await client.get_property("LAMP") == "120"
        assert await client.get_property("ERR") == "00"
        assert await client.send_command("MUTE ON") == ""
        client.close()
        client = Projector(path, type="serial")
        assert await client.get_property("MUTE") == "ON"
        assert await client.get_property("CMODE") is False, "refused, and the client knows it"
        client.close()

    with PseudoTerminal(LinePeer(device, EPSON)) as terminal:
        asyncio.run(talk(terminal.path))
    assert device.power() is Power.ON
    assert device.muted()


@pytest.mark.slow
@pytest.mark.parametrize("language_name", ["optoma", "lantern.toml"])
def test_serves_a_serial_projector_until_interrupted(
    language_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lantern.toml").write_text(TEXT)
    language = load_language(language_name)
    with sim_serving("projector", "--serial", language_name) as (line,):
        assert line.startswith(f"{language.maker} projector at /dev/")
        path = line.split()[-1]
        projector = LineProjector(language, lambda: SerialLink.open(path, language.line.baud))
        assert projector.power() is Power.STANDBY
        projector.switch_on()
        assert projector.power() is Power.WARMING
        projector.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--serial", "klingon"], ", ".join(built_in_languages())),
        (["--serial", "epson", "--pjlink", "0"], "exactly one of --pjlink PORT and --serial LANGUAGE"),
        ([], "exactly one of --pjlink PORT and --serial LANGUAGE"),
        (["--serial", "epson", "--password", "x"], "--serial has no password"),
    ],
)
def test_refuses_wrong_connection_options(capsys: pytest.CaptureFixture[str], arguments: list[str], text: str) -> None:
    assert main(["projector", *arguments]) == 2
    assert text in capsys.readouterr().err
