"""Contract tests of every projector; a suite supplies its projector with the fixture `bench`.

The projector is in standby at first. `Bench.wait` advances its simulated clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from drivers.projector import Fault, Lamp, Power, Projector, ProjectorIdentity, Severity
from foundation.errors import DeviceRefused
from sim.projectors.projector import SimulatedProjector


@dataclass(frozen=True)
class Bench:
    """A projector under test with controls for faults and time.

    `reported` maps true faults to those that the protocol can report. `counts_hours`: the protocol reports lamp hours.
    """

    projector: Projector
    wait: Callable[[float], None]
    break_part: Callable[[str, Severity], None]
    repair: Callable[[], None]
    identity: ProjectorIdentity
    warm_up_s: float
    cool_down_s: float
    reported: Callable[[frozenset[Fault]], frozenset[Fault]] = lambda faults: faults
    counts_hours: bool = True

    @classmethod
    def of(cls, projector: Projector, device: SimulatedProjector) -> Bench:
        """Return the bench of a driver on a simulated projector that reports all faults."""
        traits = device.traits
        controls = device.clock.sleep, device.break_part, device.repair
        return cls(projector, *controls, traits.identity, traits.warm_up_s, traits.cool_down_s)

    def switched_on(self) -> Projector:
        """Return the projector after it has warmed up."""
        self.projector.switch_on()
        self.wait(self.warm_up_s)
        return self.projector


class ProjectorContract:
    """Subclass it as ``TestX`` and supply the fixture `bench`."""

    def test_names_itself(self, bench: Bench) -> None:
        assert bench.projector.identity() == bench.identity

    def test_passes_through_four_states(self, bench: Bench) -> None:
        projector = bench.projector
        assert projector.power() is Power.STANDBY
        projector.switch_on()
        assert projector.power() is Power.WARMING
        bench.wait(bench.warm_up_s - 1)
        assert projector.power() is Power.WARMING
        bench.wait(1)
        assert projector.power() is Power.ON
        projector.switch_off()
        assert projector.power() is Power.COOLING
        bench.wait(bench.cool_down_s - 1)
        assert projector.power() is Power.COOLING
        bench.wait(1)
        assert projector.power() is Power.STANDBY

    def test_switching_to_present_state_changes_nothing(self, bench: Bench) -> None:
        bench.projector.switch_off()
        assert bench.projector.power() is Power.STANDBY
        projector = bench.switched_on()
        projector.switch_on()
        assert projector.power() is Power.ON

    def test_refuses_to_reverse_during_change(self, bench: Bench) -> None:
        projector = bench.projector
        projector.switch_on()
        with pytest.raises(DeviceRefused):
            projector.switch_off()
        bench.wait(bench.warm_up_s)
        projector.switch_off()
        with pytest.raises(DeviceRefused):
            projector.switch_on()
        assert projector.power() is Power.COOLING

    def test_mutes_and_unmutes(self, bench: Bench) -> None:
        projector = bench.switched_on()
        assert not projector.muted()
        projector.set_muted(True)
        assert projector.muted()
        projector.set_muted(False)
        assert not projector.muted()

    def test_refuses_to_mute_without_light(self, bench: Bench) -> None:
        with pytest.raises(DeviceRefused):
            bench.projector.set_muted(True)

    def test_reports_faults_until_repaired(self, bench: Bench) -> None:
        assert bench.projector.faults() == ()
        bench.break_part("temperature", Severity.WARNING)
        bench.break_part("fan", Severity.ERROR)
        true = frozenset({Fault("fan", Severity.ERROR), Fault("temperature", Severity.WARNING)})
        assert set(bench.projector.faults()) == bench.reported(true)
        bench.repair()
        assert bench.projector.faults() == ()

    def test_counts_lamp_hours(self, bench: Bench) -> None:
        if not bench.counts_hours:
            assert bench.projector.lamps() == ()
            return
        (first,) = bench.projector.lamps()
        assert not first.lit
        bench.wait(10 * 3600)
        assert bench.projector.lamps() == (first,)
        bench.switched_on()
        bench.wait(10 * 3600)
        assert bench.projector.lamps() == (Lamp(first.hours + 10, lit=True),)
        bench.projector.switch_off()
        bench.wait(bench.cool_down_s)
        assert bench.projector.lamps() == (Lamp(first.hours + 10, lit=False),)

    def test_works_after_an_idle_time(self, bench: Bench) -> None:
        assert bench.projector.power() is Power.STANDBY
        bench.wait(24 * 3600)
        assert bench.projector.power() is Power.STANDBY
        bench.projector.switch_on()
        assert bench.projector.power() is Power.WARMING

    def test_second_close_keeps_the_power_state(self, bench: Bench) -> None:
        projector = bench.switched_on()
        projector.close()
        projector.close()
        assert projector.power() is Power.ON
