"""The simulated projector itself, a lamp that takes its time, and the screen: one plain colour that a camera sees.

It has states and no bytes, and moves with the time that is handed in, only when somebody looks.
"""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.pjlink import NoResolution, Resolution
from drivers.presenter import BLACK, Colour
from drivers.projector import FAULT_PARTS, Fault, Lamp, Power, ProjectorIdentity, Severity
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceFault, DeviceRefused

REFRESH_S = 1 / 60  # 60 Hz, the usual picture rate


@dataclass
class Screen:
    """The colour shown now; shared by the presenter, who writes, and the camera, who looks."""

    colour: Colour = BLACK


class SimulatedPresenter:
    """A `drivers.presenter.Presenter` on a `Screen`."""

    def __init__(self, screen: Screen, clock: Clock) -> None:
        self._screen = screen
        self._clock = clock
        self._open = True

    def show(self, colour: Colour) -> None:
        """Put `colour` on the screen, one refresh from now."""
        if not self._open:
            raise DeviceError("the simulated screen is closed; open the rig again")
        self._clock.sleep(REFRESH_S)
        self._screen.colour = colour

    def close(self) -> None:
        """Leave the screen black."""
        self._screen.colour = BLACK
        self._open = False


WARM_UP_S = 30.0  # A little less than the 40 s typical of PWR ON (Epson, ESC/VP21 Command User's Guide)
COOL_DOWN_S = 60.0  # A little more than the 10 to 50 s of PWR OFF (same source): drivers must wait for it
IDENTITY = ProjectorIdentity("CroP", "Simulated Projector", "dark room")
INPUTS = ("11", "31", "32", "3A", "61")  # Codes of the inputs (PJLink INPT); class 1 has the first three
PANEL = Resolution(1920, 1080)


@dataclass(frozen=True)
class ProjectorTraits:
    """What does not change about a simulated projector.

    `lamp_hours` is what its lamp has burnt at the start.
    """

    identity: ProjectorIdentity = IDENTITY
    warm_up_s: float = WARM_UP_S
    cool_down_s: float = COOL_DOWN_S
    lamp_hours: float = 120.0
    pjlink_class: int = 2


class SimulatedProjector:
    """A lamp projector.

    It keeps the contract of `drivers.projector.Projector`, and may be used from several threads.
    """

    def __init__(self, clock: Clock, power: Power = Power.STANDBY, traits: ProjectorTraits | None = None) -> None:
        self.clock = clock
        self.traits = traits or ProjectorTraits()
        self._guard = threading.RLock()
        self._power = power
        self._since = clock.monotonic()
        self._lit_s = self.traits.lamp_hours * 3600.0
        self._muted = False
        self._faults: dict[str, Severity] = {}
        self._input = "31"
        self._frozen = False
        self.signal: Resolution | NoResolution = PANEL
        """What arrives at its input; change it at will."""

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name."""
        return self.traits.identity

    def power(self) -> Power:
        """Return the power state now."""
        with self._guard:
            self._move()
            return self._power

    def switch_on(self) -> None:
        """Strike the lamp; refused while it cools."""
        with self._guard:
            self._begin(Power.WARMING, Power.ON, "cooling down")

    def switch_off(self) -> None:
        """Put the lamp out; refused while it warms up."""
        with self._guard:
            self._begin(Power.COOLING, Power.STANDBY, "warming up")

    def muted(self) -> bool:
        """Return whether the picture is blanked; refused unless it is on."""
        with self._while_on():
            return self._muted

    def set_muted(self, muted: bool) -> None:
        """Blank the picture, or show it; refused unless it is on."""
        with self._while_on():
            self._muted = muted

    def input(self) -> str:
        """Return the code of the input that is shown (PJLink INPT); refused unless it is on."""
        with self._while_on():
            return self._input

    def set_input(self, code: str) -> None:
        """Show another of `INPUTS`; refused unless it is on."""
        with self._while_on():
            if code not in INPUTS:
                raise ValueError(code)
            self._input = code

    def input_resolution(self) -> Resolution | NoResolution:
        """Return the resolution of the signal at its input, or why there is none; refused unless it is on."""
        with self._while_on():
            return self.signal

    def frozen(self) -> bool:
        """Return whether the picture is frozen; refused unless it is on."""
        with self._while_on():
            return self._frozen

    def set_frozen(self, frozen: bool) -> None:
        """Freeze the picture, or let it move; refused unless it is on."""
        with self._while_on():
            self._frozen = frozen

    def faults(self) -> tuple[Fault, ...]:
        """Return every fault that has been injected and not repaired."""
        with self._guard:
            return tuple(Fault(part, self._faults[part]) for part in FAULT_PARTS if part in self._faults)

    def lamps(self) -> tuple[Lamp, ...]:
        """Return its one lamp."""
        with self._guard:
            self._move()
            burning = self.clock.monotonic() - self._since if self._lit() else 0.0
            return (Lamp(int((self._lit_s + burning) / 3600.0), self._lit()),)

    def close(self) -> None:
        """Do nothing: it is the thing itself, not a connection to it."""

    def light(self) -> float:
        """Return the fraction of the full light that reaches the screen now, 0 … 1.

        0 when off, muted or with a dead lamp; rises in proportion to time during warm-up.
        """
        with self._guard:
            self._move()
            if self._muted or not self._lit():
                return 0.0
            if self._power is Power.WARMING:
                return (self.clock.monotonic() - self._since) / self.traits.warm_up_s
            return 1.0

    def break_part(self, part: str, severity: Severity) -> None:
        """Inject a fault in one of `drivers.projector.FAULT_PARTS`; an error of the lamp puts it out."""
        if part not in FAULT_PARTS:
            raise ValueError(f"{part} is no part that can be reported; choose of {', '.join(FAULT_PARTS)}")
        with self._guard:
            self._move()
            self._faults[part] = severity
            if part == "lamp" and severity is Severity.ERROR and self._power in (Power.ON, Power.WARMING):
                self._enter(Power.COOLING, self.clock.monotonic())

    def repair(self) -> None:
        """Take away every fault."""
        with self._guard:
            self._faults.clear()

    def _begin(self, change: Power, settled: Power, busy: str) -> None:
        self._move()
        if self._power is settled:
            return
        if self._power in (Power.WARMING, Power.COOLING):
            if self._power is change:
                busy = self._power.value
            raise DeviceRefused(f"the simulated projector is {busy}; wait until it is done")
        if change is Power.WARMING and self._faults.get("lamp") is Severity.ERROR:
            raise DeviceFault("the lamp of the simulated projector is dead; repair it")
        self._enter(change, self.clock.monotonic())

    @contextmanager
    def _while_on(self) -> Generator[None]:
        """Hold the state for the block; refuse it unless the projector is on."""
        with self._guard:
            self._move()
            if self._power is not Power.ON:
                raise DeviceRefused(f"the simulated projector is in {self._power.value}; wait until it is on")
            yield

    def _lit(self) -> bool:
        return self._power in (Power.ON, Power.WARMING)

    def _move(self) -> None:
        passed = self.clock.monotonic() - self._since
        if self._power is Power.WARMING and passed >= self.traits.warm_up_s:
            self._enter(Power.ON, self._since + self.traits.warm_up_s)
        elif self._power is Power.COOLING and passed >= self.traits.cool_down_s:
            self._enter(Power.STANDBY, self._since + self.traits.cool_down_s)

    def _enter(self, power: Power, at: float) -> None:
        if self._lit():
            self._lit_s += at - self._since
        self._power = power
        self._since = at
        if power is Power.STANDBY:
            self._muted = False
            self._frozen = False
