"""The simulated projector: the contract, its light, and its port in the standard's bytes."""

from __future__ import annotations

import pytest

from drivers.pjlink import NoResolution
from drivers.projector import Power, Severity
from foundation.clock import SimulatedClock
from foundation.errors import DeviceFault
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import ProjectorTraits, SimulatedProjector
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


def test_neither_mute_nor_freeze_outlasts_standby() -> None:
    clock = SimulatedClock()
    device = SimulatedProjector(clock, Power.ON)
    device.set_muted(True)
    device.set_frozen(True)
    device.switch_off()
    clock.sleep(60)
    device.switch_on()
    clock.sleep(30)
    assert device.light() == 1.0
    assert not device.frozen()


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
