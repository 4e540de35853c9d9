"""The simulated PJLink projector: bytes of the standard, and aiopjlink as an independent client."""

from __future__ import annotations

import asyncio
import gc
import warnings
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass

import aiopjlink
import pytest
from aiopjlink import PJClass

from drivers.links.network import TcpServer
from drivers.pjlink import NoResolution
from drivers.projector import Power, Severity
from foundation.clock import SimulatedClock
from sim.projectors.pjlink import PjLinkPeer, serve_pjlink
from sim.projectors.projector import ProjectorTraits, SimulatedProjector


def conversation(peer: PjLinkPeer, *commands: bytes) -> list[bytes]:
    return [peer.receive(command) for command in commands]


PATIENCE_S = 30.0
"""How long a client may wait for an answer on a computer that has much else to do."""


@dataclass
class Served:
    """A simulated projector behind a TCP server, with its password."""

    device: SimulatedProjector
    clock: SimulatedClock
    server: TcpServer
    password: str | None

    def talk(self, conversation: Callable[[aiopjlink.PJLink], Awaitable[None]], password: str | None = None) -> None:
        """Connect aiopjlink and run a conversation."""

        async def connected() -> None:
            host, port = self.server.address
            async with aiopjlink.PJLink(host, port, password or self.password, timeout=PATIENCE_S) as link:
                await conversation(link)

        asyncio.run(connected())


@pytest.fixture(params=[None, "JBMIAProjectorLink"], ids=["open", "password"])
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    clock = SimulatedClock()
    device = SimulatedProjector(clock)
    with serve_pjlink(device, password=request.param) as server:
        yield Served(device, clock, server, request.param)


def test_aiopjlink_passes_the_four_states(served: Served) -> None:
    async def conversation(link: aiopjlink.PJLink) -> None:
        states = aiopjlink.Power.State
        assert await link.power.get() is states.OFF
        await link.power.turn_on()
        assert await link.power.get() is states.WARMING
        with pytest.raises(aiopjlink.PJLinkERR3):
            await link.power.turn_off()
        served.clock.sleep(29)
        assert await link.power.get() is states.WARMING
        served.clock.sleep(1)
        assert await link.power.get() is states.ON
        await link.power.turn_off()
        assert await link.power.get() is states.COOLING

    served.talk(conversation)


def test_aiopjlink_selects_inputs_of_both_classes(served: Served) -> None:
    served.device.switch_on()
    served.clock.sleep(30)
    modes = aiopjlink.Sources.Mode

    async def conversation(link: aiopjlink.PJLink) -> None:
        assert await link.info.pjlink_class() is PJClass.TWO
        assert await link.sources.available() == [(modes.RGB, "1"), (modes.DIGITAL, "1"), (modes.DIGITAL, "2")]
        assert await link.sources.get() == (modes.DIGITAL, "1")
        await link.sources.set(modes.DIGITAL, "A", PJClass.TWO)
        assert await link.sources.get(PJClass.TWO) == (modes.DIGITAL, "A")
        with pytest.raises(aiopjlink.PJLinkERR2):
            await link.sources.set(modes.DIGITAL, "A")

    served.talk(conversation)


def test_aiopjlink_reads_resolutions(served: Served) -> None:
    served.device.switch_on()
    served.clock.sleep(30)

    async def conversation(link: aiopjlink.PJLink) -> None:
        assert await link.sources.resolution() == (1920, 1080)
        served.device.signal = NoResolution.NO_SIGNAL
        with pytest.raises(aiopjlink.PJLinkProjectorError, match="no signal"):
            await link.sources.resolution()
        served.device.signal = NoResolution.UNKNOWN_SIGNAL
        with pytest.raises(aiopjlink.PJLinkProjectorError, match="unknown signal"):
            await link.sources.resolution()

    served.talk(conversation)


def test_aiopjlink_mutes_and_freezes(served: Served) -> None:
    served.device.switch_on()
    served.clock.sleep(30)

    async def conversation(link: aiopjlink.PJLink) -> None:
        assert await link.mute.status() == (False, False)
        await link.mute.both(True)
        assert await link.mute.status() == (True, True)
        await link.mute.video(False)
        assert not served.device.muted()
        assert await link.freeze.get() is False
        await link.freeze.set(True)
        assert await link.freeze.get() is True
        assert served.device.frozen()
        await link.freeze.set(False)
        assert not served.device.frozen()

    served.talk(conversation)


def test_aiopjlink_reads_health_and_names(served: Served) -> None:
    async def conversation(link: aiopjlink.PJLink) -> None:
        category, level = aiopjlink.Errors.Category, aiopjlink.Errors.Level
        assert set((await link.errors.query()).values()) == {level.OK}
        served.device.break_part("temperature", Severity.WARNING)
        served.device.break_part("filter", Severity.ERROR)
        errors = await link.errors.query()
        assert errors[category.TEMP] is level.WARN
        assert errors[category.FILTER] is level.ERROR
        assert await link.lamps.status() == [(120, aiopjlink.Lamp.State.OFF)]
        assert await link.info.manufacturer_name() == "CroP"
        assert await link.info.product_name() == "Simulated Projector"
        assert await link.info.projector_name() == "dark room"

    served.talk(conversation)


@pytest.mark.slow
def test_aiopjlink_is_refused_with_a_wrong_password() -> None:
    clock = SimulatedClock()
    with serve_pjlink(SimulatedProjector(clock), password="right") as server:

        async def nothing(link: aiopjlink.PJLink) -> None:
            raise AssertionError("it was let in")

        # A refused aiopjlink leaves its socket to the garbage collector, which is to find it here.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            with pytest.raises(aiopjlink.PJLinkPassword):
                Served(SimulatedProjector(clock), clock, server, None).talk(nothing, "wrong")
            gc.collect()


def test_class_1_refuses_class_2_commands() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock, Power.ON, ProjectorTraits(pjlink_class=1))

    async def conversation(link: aiopjlink.PJLink) -> None:
        assert await link.info.pjlink_class() is PJClass.ONE
        with pytest.raises(aiopjlink.PJLinkERR1):
            await link.info.serial_number()

    with serve_pjlink(device) as server:
        Served(device, clock, server, None).talk(conversation)


def test_closes_the_connection_after_thirty_idle_seconds(served: Served) -> None:
    async def conversation(link: aiopjlink.PJLink) -> None:
        await link.power.get()
        served.clock.sleep(30)
        with pytest.raises(aiopjlink.PJLinkConnectionClosed):
            await link.power.get()

    served.talk(conversation)
