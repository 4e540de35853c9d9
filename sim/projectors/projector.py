"""Simulated projector with a lamp, and simulated screen with one uniform colour."""

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

REFRESH_S = 1 / 60  # Usual frame period of a screen, s.


@dataclass
class Screen:
    """Displayed colour: the presenter sets it, and the camera photographs it."""

    colour: Colour = BLACK


class SimulatedPresenter:
    """A `drivers.presenter.Presenter` on a `Screen`."""

    def __init__(self, screen: Screen, clock: Clock) -> None:
        self._screen = screen
        self._clock = clock
        self._open = True

    def show(self, colour: Colour) -> None:
        """Display `colour` after one frame period."""
        if not self._open:
            raise DeviceError("the simulated screen is closed; open the rig again")
        self._clock.sleep(REFRESH_S)
        self._screen.colour = colour

    def close(self) -> None:
        """Display black and close."""
        self._screen.colour = BLACK
        self._open = False


WARM_UP_S = 30.0  # Epson projectors typically need 40 s (ESC/VP21 Command User's Guide, PWR ON).
COOL_DOWN_S = 60.0  # Epson projectors need 10 to 50 s (same source, PWR OFF).
IDENTITY = ProjectorIdentity("CroP", "Simulated Projector", "dark room")
INPUTS = ("11", "31", "32", "3A", "61")  # Codes of the inputs (PJLink INPT); class 1 has the first three.
PANEL = Resolution(1920, 1080)


@dataclass(frozen=True)
class ProjectorTraits:
    """Constant properties of a simulated projector; `lamp_hours` is the initial state of its lamp counter."""

    identity: ProjectorIdentity = IDENTITY
    warm_up_s: float = WARM_UP_S
    cool_down_s: float = COOL_DOWN_S
    lamp_hours: float = 120.0
    pjlink_class: int = 2


class SimulatedProjector:
    """Simulated lamp projector (`drivers.projector.Projector`); methods may be called by several threads."""

    def __init__(self, clock: Clock, power: Power = Power.STANDBY, traits: ProjectorTraits | None = None) -> None:
        self.clock = clock
        self.traits = traits or ProjectorTraits()
        self._lock = threading.RLock()
        self._power = power
        self._state_since_s = clock.monotonic()
        self._burnt_s = self.traits.lamp_hours * 3600.0
        self._muted = False
        self._faults: dict[str, Severity] = {}
        self._input = "31"
        self._frozen = False
        self.signal: Resolution | NoResolution = PANEL

    def identity(self) -> ProjectorIdentity:
        """Return maker, model and name."""
        return self.traits.identity

    def power(self) -> Power:
        """Return the current power state."""
        with self._lock:
            self._update()
            return self._power

    def switch_on(self) -> None:
        """Switch the lamp on; refused during warm-up and cooling."""
        with self._lock:
            self._start(Power.WARMING, Power.ON)

    def switch_off(self) -> None:
        """Switch the lamp off; refused during warm-up and cooling."""
        with self._lock:
            self._start(Power.COOLING, Power.STANDBY)

    def muted(self) -> bool:
        """Return whether the picture is black (muted); refused unless the projector is on."""
        with self._require_on():
            return self._muted

    def set_muted(self, muted: bool) -> None:
        """Blank or show the picture; refused unless the projector is on."""
        with self._require_on():
            self._muted = muted

    def input(self) -> str:
        """Return the code of the selected input (PJLink INPT); refused unless the projector is on."""
        with self._require_on():
            return self._input

    def set_input(self, code: str) -> None:
        """Select one of `INPUTS`; refused unless the projector is on."""
        with self._require_on():
            if code not in INPUTS:
                raise ValueError(f"the input is {code!r}, expected one of {', '.join(INPUTS)}")
            self._input = code

    def input_resolution(self) -> Resolution | NoResolution:
        """Return the resolution of the input signal, or the reason for its absence; refused unless on."""
        with self._require_on():
            return self.signal

    def frozen(self) -> bool:
        """Return whether the picture is frozen; refused unless the projector is on."""
        with self._require_on():
            return self._frozen

    def set_frozen(self, frozen: bool) -> None:
        """Freeze or unfreeze the picture; refused unless the projector is on."""
        with self._require_on():
            self._frozen = frozen

    def faults(self) -> tuple[Fault, ...]:
        """Return all injected faults that are not repaired."""
        with self._lock:
            return tuple(Fault(name, self._faults[name]) for name in FAULT_PARTS if name in self._faults)

    def lamps(self) -> tuple[Lamp, ...]:
        """Return the state of the only lamp."""
        with self._lock:
            self._update()
            burning_s = self.clock.monotonic() - self._state_since_s if self._lit() else 0.0
            return (Lamp(int((self._burnt_s + burning_s) / 3600.0), self._lit()),)

    def close(self) -> None:
        """Do nothing, because there is no connection."""

    def light(self) -> float:
        """Return the relative light output now, 0 to 1.

        The output is 0 if the projector is off or muted, or if its lamp is broken. It increases linearly during
        warm-up.
        """
        with self._lock:
            self._update()
            if self._muted or not self._lit():
                return 0.0
            if self._power is Power.WARMING:
                return (self.clock.monotonic() - self._state_since_s) / self.traits.warm_up_s
            return 1.0

    def break_part(self, part: str, severity: Severity) -> None:
        """Inject a fault of one of `drivers.projector.FAULT_PARTS`; a lamp with an error goes off."""
        if part not in FAULT_PARTS:
            raise ValueError(f"the part is {part!r}, expected one of {', '.join(FAULT_PARTS)}")
        with self._lock:
            self._update()
            self._faults[part] = severity
            if part == "lamp" and severity is Severity.ERROR and self._power in (Power.ON, Power.WARMING):
                self._enter(Power.COOLING, self.clock.monotonic())

    def repair(self) -> None:
        """Remove all faults."""
        with self._lock:
            self._faults.clear()

    def _start(self, transition: Power, target: Power) -> None:
        self._update()
        if self._power is target:
            return
        if self._power in (Power.WARMING, Power.COOLING):
            raise DeviceRefused(f"the simulated projector is in {self._power.value}; wait until it has finished")
        if transition is Power.WARMING and self._faults.get("lamp") is Severity.ERROR:
            raise DeviceFault("the lamp of the simulated projector is broken; repair it")
        self._enter(transition, self.clock.monotonic())

    @contextmanager
    def _require_on(self) -> Generator[None]:
        """Lock the state during the block; raise an error unless the projector is on."""
        with self._lock:
            self._update()
            if self._power is not Power.ON:
                raise DeviceRefused(f"the simulated projector is in {self._power.value}; switch it on and wait")
            yield

    def _lit(self) -> bool:
        return self._power in (Power.ON, Power.WARMING)

    def _update(self) -> None:
        elapsed_s = self.clock.monotonic() - self._state_since_s
        if self._power is Power.WARMING and elapsed_s >= self.traits.warm_up_s:
            self._enter(Power.ON, self._state_since_s + self.traits.warm_up_s)
        elif self._power is Power.COOLING and elapsed_s >= self.traits.cool_down_s:
            self._enter(Power.STANDBY, self._state_since_s + self.traits.cool_down_s)

    def _enter(self, power: Power, at: float) -> None:
        if self._lit():
            self._burnt_s += at - self._state_since_s
        self._power = power
        self._state_since_s = at
        if power is Power.STANDBY:
            self._muted = False
            self._frozen = False
