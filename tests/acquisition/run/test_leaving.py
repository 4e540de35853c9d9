"""On every end the screen goes black and the lamp's fate is decided and said; nothing of it hides why a run ended."""

from __future__ import annotations

import pytest

from acquisition.run.devices import Devices
from acquisition.run.lamp import OBEYS_S, RunEnd, lamp_fate, leave_lab
from drivers.presenter import BLACK, Colour
from drivers.projector import Power
from experiment.config import SequenceSettings
from foundation.errors import DeviceError, LinkClosed, StorageError
from sim.clock import SimulatedClock
from sim.projectors.projector import SimulatedProjector
from tests.acquisition.run.scripted import Screen, ScriptedCamera

ON, OFF = Power.ON, Power.COOLING


@pytest.mark.parametrize(
    ("end", "settings", "power"),
    [
        (RunEnd.COMPLETE, SequenceSettings(), OFF),
        (RunEnd.COMPLETE, SequenceSettings(switch_off=False), ON),
        (RunEnd.COMPLETE, SequenceSettings(lamp_if_unfinished="on"), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(switch_off=False), OFF),
        (RunEnd.UNFINISHED, SequenceSettings(lamp_if_unfinished="on"), ON),
        (RunEnd.INTERRUPTED, SequenceSettings(), ON),
        (RunEnd.INTERRUPTED, SequenceSettings(switch_off=False, lamp_if_unfinished="on"), ON),
    ],
)
def test_the_lamp_s_fate_is_decided_and_said(end: RunEnd, settings: SequenceSettings, power: Power) -> None:
    clock = SimulatedClock()
    projector, screen = SimulatedProjector(clock, power=ON), Screen()
    said: list[tuple[str, str]] = []
    devices = Devices(ScriptedCamera(screen, clock, {}), screen, projector, clock)
    leave_lab(devices, end, settings, lambda what, sentence: said.append((what, sentence)))
    assert projector.power() is power
    assert screen.shown == [BLACK]
    ((what, sentence),) = said
    assert what == "lamp"
    assert ("was switched off" in sentence) == (power is OFF)
    assert ("burns on" in sentence) == (power is ON and end is not RunEnd.INTERRUPTED)
    assert ("left as it is" in sentence) == (end is RunEnd.INTERRUPTED)


@pytest.mark.parametrize(("lost", "said"), [(2, "it was switched off"), (3, "it could not be switched off: no answer")])
def test_an_answer_that_is_lost_does_not_let_the_lamp_burn(lost: int, said: str) -> None:
    class Deaf(SimulatedProjector):
        asked = 0

        def power(self) -> Power:
            type(self).asked += 1
            if type(self).asked <= lost:
                raise DeviceError("no answer")
            return super().power()

    clock = SimulatedClock()
    sentence = lamp_fate(Deaf(clock, power=ON), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert sentence.startswith(said)


def test_a_lamp_that_is_out_is_left_alone() -> None:
    class Untouched(SimulatedProjector):
        def switch_off(self) -> None:
            raise AssertionError

    clock = SimulatedClock()
    said = lamp_fate(Untouched(clock), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert said == "it is out already: the projector is in standby"


def test_a_lamp_that_does_not_obey_is_said_to_burn() -> None:
    class Deaf(SimulatedProjector):
        def switch_off(self) -> None: ...

    clock = SimulatedClock()
    said = lamp_fate(Deaf(clock, power=ON), RunEnd.COMPLETE, SequenceSettings(), clock)
    assert "burns on though the projector was told" in said
    assert "by hand" in said
    assert clock.monotonic() <= OBEYS_S + 1


@pytest.mark.parametrize("end", RunEnd)
def test_a_projector_out_of_reach_hides_nothing(end: RunEnd) -> None:
    class Gone(SimulatedProjector):
        def power(self) -> Power:
            raise LinkClosed("nothing listens at 192.168.1.30:4352")

    clock = SimulatedClock()
    said = lamp_fate(Gone(clock, power=ON), end, SequenceSettings(), clock)
    assert ("nothing listens" in said) == (end is not RunEnd.INTERRUPTED)
    assert "by hand" in said
    assert lamp_fate(None, end, SequenceSettings(), clock).endswith("by hand")


def test_a_screen_that_fails_and_a_full_disk_raise_nothing() -> None:
    class Broken(Screen):
        def show(self, colour: Colour) -> None:
            raise DeviceError("the display is gone")

    clock, screen = SimulatedClock(), Broken()
    projector = SimulatedProjector(clock, power=ON)
    said: list[str] = []

    def report(what: str, sentence: str) -> None:
        said.append(f"{what}: {sentence}")
        raise StorageError("the disk is full")

    leave_lab(
        Devices(ScriptedCamera(screen, clock, {}), screen, projector, clock),
        RunEnd.COMPLETE,
        SequenceSettings(),
        report,
    )
    assert said == ["screen: it could not be made black: the display is gone", "lamp: it was switched off"]
    assert projector.power() is OFF
