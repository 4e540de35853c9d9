"""The simulated projector's PJLink port: the standard's bytes, and another program's client.

What aiopjlink understands, which knows both classes, we cannot have misread alone. The projector's time is handed in,
so nobody waits for a lamp.
"""

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


def test_the_port_speaks_the_standards_bytes() -> None:
    # Written after PJLink 1.04, section 4.
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(clock, traits=ProjectorTraits(pjlink_class=1)))
    assert peer.connect() == b"PJLINK 0\r"
    assert conversation(
        peer, b"%1POWR ?\r", b"%1AVMT ?\r", b"%1POWR 1\r", b"%1POWR ?\r", b"%1POWR 0\r", b"%1INPT 31\r"
    ) == [b"%1POWR=0\r", b"%1AVMT=ERR3\r", b"%1POWR=OK\r", b"%1POWR=3\r", b"%1POWR=ERR3\r", b"%1INPT=ERR3\r"]
    clock.sleep(29)
    assert peer.receive(b"%1CLSS ?\r") == b"%1CLSS=1\r"
    clock.sleep(1)
    asked = [
        (b"%1POWR ?", b"%1POWR=1"),
        (b"%1AVMT 31", b"%1AVMT=OK"),
        (b"%1AVMT ?", b"%1AVMT=31"),
        (b"%1AVMT 30", b"%1AVMT=OK"),
        (b"%1AVMT ?", b"%1AVMT=30"),
        (b"%1INST ?", b"%1INST=11 31 32"),
        (b"%1INPT 32", b"%1INPT=OK"),
        (b"%1INPT ?", b"%1INPT=32"),
        (b"%1INPT 59", b"%1INPT=ERR2"),
        (b"%1INPT 3A", b"%1INPT=ERR2"),
        (b"%1ERST ?", b"%1ERST=000000"),
        (b"%1LAMP ?", b"%1LAMP=120 1"),
        (b"%1POWR 5", b"%1POWR=ERR2"),
        (b"%1ABCD ?", b"%1ABCD=ERR1"),
        (b"%2SNUM ?", b"%2SNUM=ERR1"),
        (b"%1powr ?", b"%1POWR=1"),
    ]
    assert conversation(peer, *(question + b"\r" for question, _ in asked)) == [answer + b"\r" for _, answer in asked]


def test_class_2_speaks_the_standards_bytes() -> None:
    # Written after PJLink 2.00, 4.3, 4.4, 4.9, 4.18 and 4.26.
    device = SimulatedProjector(SimulatedClock(), Power.ON)
    peer = PjLinkPeer(device)
    asked = [
        (b"%1CLSS ?", b"%1CLSS=2"),
        (b"%1INST ?", b"%1INST=11 31 32"),
        (b"%2INST ?", b"%2INST=11 31 32 3A 61"),
        (b"%2INPT 3A", b"%2INPT=OK"),
        (b"%2INPT ?", b"%2INPT=3A"),
        (b"%2INPT 6Z", b"%2INPT=ERR2"),
        (b"%1INPT 61", b"%1INPT=ERR2"),
        (b"%2IRES ?", b"%2IRES=1920x1080"),
        (b"%2SNUM ?", b"%2SNUM=ERR1"),
        (b"%2FREZ ?", b"%2FREZ=0"),
        (b"%2FREZ 1", b"%2FREZ=OK"),
        (b"%2FREZ ?", b"%2FREZ=1"),
        (b"%2FREZ 0", b"%2FREZ=OK"),
        (b"%2FREZ ?", b"%2FREZ=0"),
        (b"%2FREZ 2", b"%2FREZ=ERR2"),
        (b"%2POWR ?", b"%2POWR=ERR1"),
        (b"%3POWR ?", b"%3POWR=ERR1"),
    ]
    assert conversation(peer, *(question + b"\r" for question, _ in asked)) == [answer + b"\r" for _, answer in asked]
    device.signal = NoResolution.NO_SIGNAL
    assert peer.receive(b"%2IRES ?\r") == b"%2IRES=-\r"
    device.signal = NoResolution.UNKNOWN_SIGNAL
    assert peer.receive(b"%2IRES ?\r") == b"%2IRES=*\r"


def test_class_2_in_standby() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()))
    asked = [
        (b"%2IRES ?", b"%2IRES=ERR3"),
        (b"%2FREZ 1", b"%2FREZ=ERR3"),
        (b"%2INPT ?", b"%2INPT=ERR3"),
        (b"%2SNUM ?", b"%2SNUM=ERR1"),
    ]
    assert conversation(peer, *(question + b"\r" for question, _ in asked)) == [answer + b"\r" for _, answer in asked]


def test_the_port_asks_for_the_password_once_a_connection() -> None:
    # PJLink 1.04, 5.1.
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()), "JBMIAProjectorLink", seed="498e4a67")
    for _ in range(2):
        assert peer.connect() == b"PJLINK 1 498e4a67\r"
        assert conversation(peer, b"5d8409bc1c3fa39749434aa3a5c38682%1POWR ?\r", b"%1POWR ?\r") == [b"%1POWR=0\r"] * 2
    peer.connect()
    assert peer.receive(b"%1POWR 1\r") == b"PJLINK ERRA\r"
    assert peer.closed
    peer.connect()
    assert peer.receive(b"%1ERST ?\r%1POWR 1\r") == b"PJLINK ERRA\r"


def test_a_port_takes_the_question_for_sha256_for_a_wrong_digest() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()), "secret")
    assert peer.receive(b"PJLINK 2\r") == b""
    assert peer.closed


def test_each_connection_is_greeted_with_its_own_seed() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()), "secret")
    assert len({peer.connect() for _ in range(8)}) == 8


def test_the_port_hangs_up_after_thirty_idle_seconds() -> None:
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(clock))
    clock.sleep(29)
    assert peer.receive(b"%1POWR ?\r") == b"%1POWR=0\r"
    clock.sleep(29)
    assert peer.receive(b"") == b"", "to ask what it has to say is no command"
    assert not peer.closed
    clock.sleep(1)
    assert peer.closed
    assert peer.receive(b"%1POWR ?\r") == b""


@pytest.mark.parametrize("noise", [b"GET / HTTP/1.0\r\n\r\n", b"\x01" * 500])
def test_the_port_hangs_up_on_what_is_no_pjlink(noise: bytes) -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()))
    assert peer.receive(noise) == b""
    assert peer.closed


def test_a_dead_lamp_answers_err4() -> None:
    device = SimulatedProjector(SimulatedClock())
    device.break_part("lamp", Severity.ERROR)
    peer = PjLinkPeer(device)
    assert conversation(peer, b"%1POWR 1\r", b"%1ERST ?\r") == [b"%1POWR=ERR4\r", b"%1ERST=020000\r"]


PATIENCE_S = 30.0
"""How long a client may wait for an answer on a computer that has much else to do."""


@dataclass
class Served:
    """A simulated projector behind a TCP server, and the password it asks for."""

    device: SimulatedProjector
    clock: SimulatedClock
    server: TcpServer
    password: str | None

    def talk(self, conversation: Callable[[aiopjlink.PJLink], Awaitable[None]], password: str | None = None) -> None:
        """Let aiopjlink connect and have a conversation."""

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


def test_aiopjlink_goes_round_the_four_states(served: Served) -> None:
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


def test_aiopjlink_is_told_by_class_1_that_it_knows_no_class_2() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock, Power.ON, ProjectorTraits(pjlink_class=1))

    async def conversation(link: aiopjlink.PJLink) -> None:
        assert await link.info.pjlink_class() is PJClass.ONE
        with pytest.raises(aiopjlink.PJLinkERR1):
            await link.info.serial_number()

    with serve_pjlink(device) as server:
        Served(device, clock, server, None).talk(conversation)


def test_aiopjlink_is_hung_up_on_after_thirty_idle_seconds(served: Served) -> None:
    async def conversation(link: aiopjlink.PJLink) -> None:
        await link.power.get()
        served.clock.sleep(30)
        with pytest.raises(aiopjlink.PJLinkConnectionClosed):
            await link.power.get()

    served.talk(conversation)
