"""The lamp in simulated time: lit, warm, watched; and what a projector in trouble makes the run say.

On every end the screen goes black and the lamp's fate is decided and said; nothing of it hides why a run ended.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import pytest

from acquisition.run.devices import (
    PAUSE_S,
    POWER_LIMIT_S,
    Devices,
    HealthWatch,
    RetryPolicy,
    RunEnd,
    await_health,
    health_fault,
    lamp_fate,
    leave_lab,
    make_ready,
)
from drivers.links.link import PeerLink
from drivers.pjlink import NoResolution, PjLinkProjector
from drivers.presenter import BLACK, Colour
from drivers.projector import Fault, Power, Projector
from experiment.config import SequenceSettings
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, DeviceFault, LinkClosed, LinkTimeout, StorageError
from sim.projectors.pjlink import PjLinkPeer
from sim.projectors.projector import SimulatedProjector
from tests.acquisition.run.scripted import Beamer, Screen, ScriptedCamera

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
    assert clock.monotonic() == 5


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


SEQUENCE = SequenceSettings(warm_up_s=600)


class Timed(SimulatedClock):
    """A clock by which things happen at their times, while somebody waits."""

    def __init__(self) -> None:
        super().__init__()
        self.due: list[tuple[float, Callable[[], object]]] = []

    def sleep(self, seconds: float) -> None:
        end = self.monotonic() + seconds
        while self.due and min(self.due, key=lambda one: one[0])[0] <= end:
            first = min(self.due, key=lambda one: one[0])
            self.due.remove(first)
            super().sleep(max(first[0] - self.monotonic(), 0))
            first[1]()
        super().sleep(max(end - self.monotonic(), 0))


@dataclass
class Room:
    """A projector behind PJLink, and everything that is said of it."""

    power: Power = Power.ON
    limit_s: float = 600.0
    clock: Timed = field(default_factory=Timed)
    said: list[tuple[float, str, str]] = field(default_factory=list[tuple[float, str, str]])
    beats: list[tuple[float, str]] = field(default_factory=list[tuple[float, str]])

    def __post_init__(self) -> None:
        self.beamer = Beamer(self.clock, self.power)

    @property
    def retry(self) -> RetryPolicy:
        def report(what: str, sentence: str) -> None:
            self.said.append((self.clock.monotonic(), what, sentence))

        def beat(state: str, sentence: str, within_s: float) -> None:
            self.beats.append((self.clock.monotonic(), sentence))

        return RetryPolicy(self.clock, self.limit_s, report, on_wait=beat)

    @property
    def words(self) -> list[str]:
        return [what for _, what, _ in self.said]

    def at(self, seconds: float, action: Callable[[], object]) -> None:
        self.clock.due.append((seconds, action))


def no_time(clock: SimulatedClock) -> RetryPolicy:
    return RetryPolicy(clock, 0)


@pytest.mark.parametrize(("fault", "said"), [("frozen", "frozen"), ("unplugged", "no signal")])
def test_a_picture_that_does_not_follow_is_noticed(fault: str, said: str) -> None:
    clock = SimulatedClock()
    beamer = SimulatedProjector(clock, power=Power.ON)
    peer = PjLinkPeer(beamer)
    projector = PjLinkProjector(lambda: PeerLink(peer), clock=clock)
    assert health_fault(projector) is None
    if fault == "frozen":
        beamer.set_frozen(True)
    else:
        beamer.signal = NoResolution.NO_SIGNAL
    assert said in str(health_fault(projector))


def test_a_cold_lamp_is_lit_and_given_its_minutes() -> None:
    clock = SimulatedClock()
    projector = SimulatedProjector(clock)
    make_ready(projector, SEQUENCE, no_time(clock))
    assert projector.power() is Power.ON
    assert clock.monotonic() >= 600 + projector.traits.warm_up_s


def test_a_warm_lamp_is_not_waited_for_though_the_answer_takes_its_time() -> None:
    class Slow(SimulatedProjector):
        def power(self) -> Power:
            self.clock.sleep(0.1)
            return super().power()

    clock = SimulatedClock()
    make_ready(Slow(clock, power=Power.ON), SEQUENCE, no_time(clock))
    assert clock.monotonic() < 1


def test_a_projector_deaf_while_its_lamp_is_struck_is_waited_for() -> None:
    class Deaf(SimulatedProjector):
        def power(self) -> Power:
            if (power := super().power()) is Power.WARMING:
                raise LinkTimeout("the projector has not answered within 5 s")
            return power

    clock = SimulatedClock()
    projector = Deaf(clock)
    make_ready(projector, SEQUENCE, no_time(clock))
    assert clock.monotonic() >= 600 + projector.traits.warm_up_s


def test_a_lamp_that_never_lights_is_given_up() -> None:
    class Dead(SimulatedProjector):
        def power(self) -> Power:
            return Power.STANDBY

    clock = SimulatedClock()
    with pytest.raises(DeviceFault):
        make_ready(Dead(clock), SequenceSettings(), no_time(clock))
    assert clock.monotonic() <= POWER_LIMIT_S + 2


@pytest.mark.slow
def test_a_lamp_that_goes_out_while_it_warms_up_gets_all_its_minutes_again() -> None:
    room = Room(Power.STANDBY)
    lit_again = 600.0

    def relit() -> None:
        room.beamer.device = SimulatedProjector(room.clock, power=Power.ON)
        room.beamer.pull(False)

    room.at(400, room.beamer.pull)
    room.at(lit_again, relit)
    make_ready(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["warming up", "retry", "paused", "resumed", "warming up"]
    assert room.clock.monotonic() >= lit_again + SEQUENCE.warm_up_s


def test_a_picture_muted_while_the_lamp_warms_up_costs_no_minutes() -> None:
    room = Room(Power.STANDBY)
    room.at(200, lambda: room.beamer.device.set_muted(True))
    room.at(300, lambda: room.beamer.device.set_muted(False))
    make_ready(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["warming up", "retry", "paused", "resumed"]
    assert room.clock.monotonic() <= 600 + room.beamer.device.traits.warm_up_s + 2 * PAUSE_S


def test_a_projector_without_power_is_lit_again_if_asked_to() -> None:
    room = Room()
    switched: list[float] = []

    def power_back() -> None:
        room.beamer.device = SimulatedProjector(room.clock)
        lit = room.beamer.device.switch_on
        room.beamer.device.switch_on = lambda: (switched.append(room.clock.monotonic()), lit())  # pyrefly: ignore[bad-assignment, method-assign]
        room.beamer.pull(False)

    room.at(0, room.beamer.pull)
    room.at(60, power_back)
    room.clock.sleep(0)
    await_health(room.beamer.projector, SEQUENCE.model_copy(update={"relight": True}), room.retry)
    assert len(switched) == 1
    assert room.words == ["retry", "paused", "relit", "still paused", "still paused", "warming up", "resumed"]
    assert room.beamer.device.power() is Power.ON
    assert room.clock.monotonic() >= switched[0] + SEQUENCE.warm_up_s


def test_a_lamp_that_does_not_light_is_not_switched_on_again_and_again() -> None:
    room = Room()
    tries: list[float] = []
    room.beamer.device.switch_off()
    room.beamer.device.switch_on = lambda: tries.append(room.clock.monotonic())  # pyrefly: ignore[method-assign]
    with pytest.raises(DeviceFault):
        await_health(room.beamer.projector, SEQUENCE.model_copy(update={"relight": True}), room.retry)
    assert len(tries) == 1


def test_a_projector_that_came_back_in_standby_is_said_to_be_so() -> None:
    room = Room()

    def power_back() -> None:
        room.beamer.device = SimulatedProjector(room.clock)
        room.beamer.pull(False)

    room.at(0, room.beamer.pull)
    room.at(60, power_back)
    room.at(200, lambda: room.beamer.device.switch_on())
    room.clock.sleep(0)
    await_health(room.beamer.projector, SEQUENCE, room.retry)
    assert room.words == ["retry", "paused", "still paused", "still paused", "warming up", "resumed"]
    assert "nothing listens" in room.said[1][2]
    assert "standby" in room.said[2][2]
    assert "warm-up" in room.said[3][2]
    # What is said at any time is what holds then.
    for at, sentence in room.beats:
        if 70 < at < 195:
            assert "standby" in sentence
            assert "listens" not in sentence
    assert room.clock.monotonic() >= 200 + SEQUENCE.warm_up_s


class Slow:
    """A projector that takes its time, and says what it was asked."""

    def __init__(self, clock: SimulatedClock, answer_s: float) -> None:
        self.clock, self.answer_s = clock, answer_s
        self.asked: list[str] = []
        self.is_muted = False

    def _ask(self, what: str) -> None:
        self.clock.sleep(self.answer_s)
        self.asked.append(what)

    def power(self) -> Power:
        self._ask("power")
        return Power.ON

    def muted(self) -> bool:
        self._ask("muted")
        return self.is_muted

    def faults(self) -> tuple[Fault, ...]:
        self._ask("faults")
        return ()

    def picture_fault(self) -> str | None:
        self._ask("picture")
        return None


ALL = ["faults", "power", "muted", "picture"]


@pytest.mark.parametrize(("answer_s", "asked"), [(0.004, ALL), (0.02, ["faults"])])
def test_a_slow_projector_is_asked_in_turn(answer_s: float, asked: list[str]) -> None:
    clock = SimulatedClock()
    projector = Slow(clock, answer_s)
    watch = HealthWatch(cast("Projector", projector), clock)
    assert watch.fault(thorough=False) is None
    assert projector.asked == ALL, "what it costs is not known before"
    projector.asked.clear()
    clock.sleep(2.3)
    assert watch.fault(thorough=False) is None
    assert projector.asked == asked
    projector.asked.clear()
    assert watch.fault(thorough=True) is None
    assert projector.asked == ALL
