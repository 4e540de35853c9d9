"""The simulated serial projectors, judged by software that others wrote for the real ones, and their own ends."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator

import pytest
from benqprojector import BenQProjectorSerial
from epson_projector import Projector

from drivers.links.network import TcpLink, serve_peer
from drivers.links.serial import SerialLink
from drivers.projector import Power
from drivers.serial_projectors import LANGUAGES
from drivers.serial_projectors.benq import BenqProjector
from drivers.serial_projectors.epson import EpsonOnNetwork, EpsonProjector
from foundation.clock import SimulatedClock
from sim.buses.serial import PseudoTerminal
from sim.cli import main
from sim.projectors.projector import ProjectorTraits, SimulatedProjector
from sim.projectors.serial import SERIAL_NUMBER, BenqPeer, EpsonPeer
from tests.sim.conftest import sim_serving

AT_ONCE = ProjectorTraits(warm_up_s=0.0, cool_down_s=0.0)
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

    with PseudoTerminal(BenqPeer(device)) as terminal:
        asyncio.run(talk(terminal.path))
    assert device.power() is Power.ON
    assert device.muted()


def test_epson_projector_drives_the_simulated_epson(device: SimulatedProjector) -> None:
    async def talk(path: str) -> None:
        client = Projector(path, type="serial")
        assert await client.get_power() == "04"
        assert await client.get_serial_number() == SERIAL_NUMBER
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

    with PseudoTerminal(EpsonPeer(device)) as terminal:
        asyncio.run(talk(terminal.path))
    assert device.power() is Power.ON
    assert device.muted()


def test_epson_accepts_nothing_until_it_has_switched_on() -> None:
    clock = SimulatedClock()
    peer = EpsonPeer(SimulatedProjector(clock))
    assert peer.receive(b"PWR ON\r") == b""
    assert peer.receive(b"PWR?\r") == b""
    clock.sleep(29)
    assert peer.receive(b"") == b""
    clock.sleep(1)
    assert peer.receive(b"") == b":"
    assert peer.receive(b"PWR?\r\r") == b"PWR=01\r::"


def test_epson_warming_up_by_remote_control_tells_its_power_only() -> None:
    device = SimulatedProjector(SimulatedClock())
    peer = EpsonPeer(device)
    device.switch_on()
    assert peer.receive(b"PWR?\rLAMP?\r") == b"PWR=02\r:ERR\r:"


@pytest.fixture(params=["benq", "epson"])
def served(request: pytest.FixtureRequest, device: SimulatedProjector) -> Iterator[BenqProjector | EpsonProjector]:
    def peer() -> BenqPeer | EpsonPeer:
        return (BenqPeer if request.param == "benq" else EpsonPeer)(device, network=True)

    with serve_peer(peer) as server:

        def connect() -> TcpLink:
            return TcpLink.connect(*server.address, 10.0)

        yield BenqProjector(connect) if request.param == "benq" else EpsonOnNetwork(connect)


def test_serves_the_network_as_well(served: BenqProjector | EpsonProjector) -> None:
    served.switch_on()
    assert served.power() is Power.ON
    served.set_muted(True)
    assert served.muted()
    served.close()
    assert served.muted()
    served.close()


def test_a_pseudo_terminal_leaves_no_thread_and_no_port(device: SimulatedProjector) -> None:
    before = threading.active_count()
    with PseudoTerminal(EpsonPeer(device)) as terminal:
        assert threading.active_count() == before + 1
    terminal.close()
    assert threading.active_count() == before


@pytest.mark.slow
def test_a_pseudo_terminal_that_nobody_reads_can_be_closed(device: SimulatedProjector) -> None:
    with PseudoTerminal(BenqPeer(device)) as terminal:
        link = SerialLink.open(terminal.path, 115200)
        for _ in range(5):
            link.write(b"*modelname=?#\r" * 100, 10.0)
            terminal.catch_up()
        link.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["epson", "optoma"])
def test_serves_a_serial_projector_until_interrupted(name: str) -> None:
    spoken = LANGUAGES[name]
    with sim_serving("projector", "--serial", name) as (line,):
        assert line.startswith(f"{spoken.maker} projector at /dev/")
        path = line.split()[-1]
        projector = spoken.projector(lambda: SerialLink.open(path, spoken.baud))
        assert projector.power() is Power.STANDBY
        projector.switch_on()
        assert projector.power() is Power.WARMING
        projector.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--serial", "klingon"], ", ".join(LANGUAGES)),
        (["--serial", "epson", "--pjlink", "0"], "either --pjlink PORT or --serial LANGUAGE"),
        ([], "either --pjlink PORT or --serial LANGUAGE"),
        (["--serial", "epson", "--password", "x"], "a serial cable has none"),
    ],
)
def test_not_exactly_one_cable_or_no_language_ends_with_2(
    capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["projector", *arguments]) == 2
    assert said in capsys.readouterr().err
