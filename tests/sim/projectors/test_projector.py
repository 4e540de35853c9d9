"""The simulated projector and screen: contracts and light."""

from __future__ import annotations

import pytest

from drivers.projector import Power, Severity
from foundation.clock import SimulatedClock
from foundation.errors import DeviceFault
from sim.projectors.projector import Screen, SimulatedPresenter, SimulatedProjector
from tests.contracts import presenter
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


def test_broken_lamp_stays_off() -> None:
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


class TestSimulatedPresenter(presenter.PresenterContract):
    @pytest.fixture
    def bench(self) -> presenter.Bench:
        screen = Screen()
        return presenter.Bench(SimulatedPresenter(screen, SimulatedClock()), lambda: screen.colour)
