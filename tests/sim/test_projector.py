"""The simulated projector: the contract, its light, and its port in the standard's bytes."""

from __future__ import annotations

import pytest

from drivers.errors import DeviceFault
from drivers.projector import Power, Severity
from sim.clock import SimulatedClock
from sim.projector import PjLinkPeer, SimulatedProjector
from tests.contracts.projector import Bench, ProjectorContract


class TestSimulatedProjector(ProjectorContract):
    @pytest.fixture
    def bench(self) -> Bench:
        clock = SimulatedClock()
        device = SimulatedProjector(clock)
        traits = device.traits
        return Bench(
            device, clock.sleep, device.break_part, device.repair, traits.identity, traits.warm_up_s, traits.cool_down_s
        )


def test_light_follows_the_lamp_and_the_mute() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock)
    assert device.light() == 0.0
    device.switch_on()
    clock.sleep(15)
    assert device.light() == pytest.approx(0.5)
    clock.sleep(15)
    assert device.light() == 1.0
    device.set_muted(True)
    assert device.light() == 0.0
    device.set_muted(False)
    assert device.light() == 1.0
    device.switch_off()
    assert device.light() == 0.0


def test_found_switched_on_it_lights_at_once() -> None:
    assert SimulatedProjector(SimulatedClock(), Power.ON).light() == 1.0


def test_mute_does_not_outlast_standby() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock, Power.ON)
    device.set_muted(True)
    device.switch_off()
    clock.sleep(60)
    device.switch_on()
    clock.sleep(30)
    assert device.light() == 1.0


def test_a_dead_lamp_goes_out_and_is_not_struck_again() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock, Power.ON)
    device.break_part("lamp", Severity.ERROR)
    assert device.light() == 0.0
    assert device.power() is Power.COOLING
    clock.sleep(60)
    with pytest.raises(DeviceFault):
        device.switch_on()
    device.repair()
    device.switch_on()
    assert device.power() is Power.WARMING


def test_a_part_that_cannot_be_reported_is_our_mistake() -> None:
    with pytest.raises(ValueError, match="fan, lamp"):
        SimulatedProjector(SimulatedClock()).break_part("wheel", Severity.ERROR)


def conversation(peer: PjLinkPeer, *commands: bytes) -> list[bytes]:
    return [peer.receive(command) for command in commands]


def test_the_port_speaks_the_standards_bytes() -> None:
    # Written after PJLink 1.04, section 4.
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(clock))
    assert peer.connect() == b"PJLINK 0\r"
    assert conversation(
        peer, b"%1POWR ?\r", b"%1AVMT ?\r", b"%1POWR 1\r", b"%1POWR ?\r", b"%1POWR 0\r", b"%1INPT 31\r"
    ) == [b"%1POWR=0\r", b"%1AVMT=ERR3\r", b"%1POWR=OK\r", b"%1POWR=3\r", b"%1POWR=ERR3\r", b"%1INPT=ERR3\r"]
    clock.sleep(29)
    assert peer.receive(b"%1CLSS ?\r") == b"%1CLSS=1\r"
    clock.sleep(1)
    assert conversation(
        peer,
        b"%1POWR ?\r",
        b"%1AVMT 31\r",
        b"%1AVMT ?\r",
        b"%1AVMT 30\r",
        b"%1AVMT ?\r",
        b"%1INST ?\r",
        b"%1INPT 32\r",
        b"%1INPT ?\r",
        b"%1INPT 59\r",
        b"%1ERST ?\r",
        b"%1LAMP ?\r",
        b"%1POWR 5\r",
        b"%1ABCD ?\r",
        b"%2SNUM ?\r",
        b"%1powr ?\r",
    ) == [
        b"%1POWR=1\r",
        b"%1AVMT=OK\r",
        b"%1AVMT=31\r",
        b"%1AVMT=OK\r",
        b"%1AVMT=30\r",
        b"%1INST=11 31 32\r",
        b"%1INPT=OK\r",
        b"%1INPT=32\r",
        b"%1INPT=ERR2\r",
        b"%1ERST=000000\r",
        b"%1LAMP=120 1\r",
        b"%1POWR=ERR2\r",
        b"%1ABCD=ERR1\r",
        b"%2SNUM=ERR1\r",
        b"%1POWR=1\r",
    ]


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


def test_each_connection_is_greeted_with_its_own_seed() -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()), "secret")
    assert len({peer.connect() for _ in range(8)}) == 8


def test_the_port_hangs_up_after_thirty_idle_seconds() -> None:
    clock = SimulatedClock()
    peer = PjLinkPeer(SimulatedProjector(clock))
    clock.sleep(29)
    assert peer.receive(b"%1POWR ?\r") == b"%1POWR=0\r"
    clock.sleep(29)
    assert not peer.closed
    clock.sleep(1)
    assert peer.closed
    assert peer.receive(b"%1POWR ?\r") == b""


@pytest.mark.parametrize("noise", [b"GET / HTTP/1.0\r\n\r\n", b"\x00" * 500])
def test_the_port_hangs_up_on_what_is_no_pjlink(noise: bytes) -> None:
    peer = PjLinkPeer(SimulatedProjector(SimulatedClock()))
    assert peer.receive(noise) == b""
    assert peer.closed


def test_a_dead_lamp_answers_err4() -> None:
    device = SimulatedProjector(SimulatedClock())
    device.break_part("lamp", Severity.ERROR)
    peer = PjLinkPeer(device)
    assert conversation(peer, b"%1POWR 1\r", b"%1ERST ?\r") == [b"%1POWR=ERR4\r", b"%1ERST=020000\r"]
