"""The projector in a run: made ready before the first frame, its health checked before and after each.

Rules that hold inside:

- A lamp that was lit when it was first asked for is taken as warm; one that was lit meanwhile gets its warm-up, and
  gets it anew where it goes out during that.
- A projector that reports a fault, shows no picture or does not answer is unhealthy: the run pauses, with the cause
  that holds now (`acquisition.run.patience`).
- A projector that was out of reach for as long as a lamp takes to light may have lost its power meanwhile.
- It is lit by the program once, before the first frame: whoever switched it off later may have had a reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

from acquisition.run.patience import PAUSE_S, Patience, Pause
from drivers.projector import Power, Projector, ReportsPictureFault, Severity
from experiment.config import SequenceSettings
from experiment.session.records import duration_text
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceFault, DeviceRefused, LinkError

POWER_LIMIT_S: Final = 300.0
"""How long a lamp may take to light; makers state up to 130 s with repeated ignition."""
RELIGHT_S: Final = 15.0
"""No lamp is lit again, and its projector back on the network, in less."""

ASKING: Final = 0.01
"""Share of a frame's time that questions may always take: five answers of 4 ms in 2.3 s."""

_NAME: Final = "the projector"


def make_ready(projector: Projector, sequence: SequenceSettings, patience: Patience) -> None:
    """Switch the lamp on if need be, wait until it burns steadily, and until its health is good.

    `patience`: waits, with a beat every few seconds; where it has no time, the first fault is raised.
    """
    found_lit = _light(projector, patience)
    patience.attempt(lambda: _unmute(projector), _NAME)
    went_out = _outlast(projector, patience)
    if not found_lit or went_out:
        _warm_up(projector, sequence, patience)


def reported_error(projector: Projector) -> DeviceFault | None:
    """Return the errors that a projector reports of its parts, in one sentence; None where it reports none."""
    parts = ", ".join(fault.part for fault in projector.faults() if fault.severity is Severity.ERROR)
    remedy = "look at its display and have it repaired"
    return DeviceFault(f"the projector reports an error of its {parts}; {remedy}") if parts else None


def require_healthy(projector: Projector) -> None:
    """Require that light leaves the projector and that it reports no error."""
    for require in _REQUIRED:
        require(projector)


def _require_no_error(projector: Projector) -> None:
    if (error := reported_error(projector)) is not None:
        raise error


def _require_on(projector: Projector) -> None:
    power = projector.power()
    if power is not Power.ON:
        remedy = "it is waited for" if power is Power.WARMING else "switch it on"
        raise DeviceFault(f"the projector is in {power.value} during the session; {remedy}")


def _require_unmuted(projector: Projector) -> None:
    if projector.muted():
        raise DeviceFault("the projector's picture is muted; release mute on its remote control")


def _require_picture(projector: Projector) -> None:
    if isinstance(projector, ReportsPictureFault) and (fault := projector.picture_fault()):
        raise DeviceFault(fault)


_REQUIRED: Final = (_require_no_error, _require_on, _require_unmuted, _require_picture)
"""What is asked of a projector, one question or two each; what explains the others comes first."""


def health_fault(
    projector: Projector | None, required: Iterable[Callable[[Projector], None]] = _REQUIRED
) -> DeviceError | None:
    """Return why the projector is not known to be healthy now, as `require_healthy` raises it; None where it is."""
    try:
        if projector is not None:
            for require in required:
                require(projector)
    except DeviceError as fault:
        return fault
    return None


class HealthWatch:
    """Asks for a projector's health between frames, all of it where that costs next to nothing, else in turn.

    A projector on a slow line takes as long to answer as a frame can be shortened by. What the judge sees in a frame, a
    lamp that is out, a picture that is muted or stands still, needs not be asked each time; where it cannot see
    that, in the dark, or where it saw something, all is asked.

    `projector`: which is asked; None: nobody is, and nothing is wrong.
    """

    def __init__(self, projector: Projector | None, clock: Clock) -> None:
        self._projector = projector
        self._clock = clock
        self._begun = clock.monotonic()
        self._cost_s = math.inf
        self._next = 0

    def fault(self, thorough: bool) -> DeviceError | None:
        """Return why the projector is not known to be healthy, of what is asked now; None where it is."""
        begun = self._clock.monotonic()
        frame_s, self._begun = begun - self._begun, begun
        if thorough or math.isinf(self._cost_s) or self._cost_s <= ASKING * frame_s:
            fault = health_fault(self._projector)
            self._cost_s = self._clock.monotonic() - begun
            return fault
        asked = _REQUIRED[self._next]
        self._next = (self._next + 1) % len(_REQUIRED)
        return health_fault(self._projector, (asked,))


def await_health(projector: Projector, sequence: SequenceSettings, patience: Patience) -> None:
    """Pause while the projector is unhealthy; return when it is healthy, and warm, again.

    Parameters are those of `make_ready`.
    """
    pause = patience.pause(_NAME)
    if _outlast(projector, patience, pause):
        _warm_up(projector, sequence, patience)
    pause.over()


def _outlast(projector: Projector, patience: Patience, pause: Pause | None = None) -> bool:
    """Wait until the projector is healthy; return whether its lamp went out meanwhile, or may have.

    A `pause` that is given is not told to be over.
    """
    own = pause or patience.pause(_NAME)
    answered = patience.clock.monotonic()
    went_out = False
    while (fault := health_fault(projector)) is not None:
        if not isinstance(fault, LinkError):
            answered = patience.clock.monotonic()
            went_out = went_out or not _is_lit(projector)
        own.wait(fault)
    went_out = went_out or patience.clock.monotonic() - answered >= RELIGHT_S
    if pause is None:
        own.over()
    return went_out


def _light(projector: Projector, patience: Patience) -> bool:
    """Wait until the lamp is lit, after switching it on if need be; return whether it was lit when first asked for."""
    power: Power | None = patience.attempt(projector.power, _NAME)
    if power is Power.ON:
        return True
    clock = patience.clock
    begun, switched = clock.monotonic(), False
    while power is not Power.ON:
        if power is Power.STANDBY and not switched:
            patience.attempt(projector.switch_on, _NAME)
            begun, switched = clock.monotonic(), True
        if clock.monotonic() - begun > POWER_LIMIT_S:
            state = "does not answer" if power is None else f"is still in {power.value}"
            done = "it was switched on" if switched else "it was first asked"
            raise DeviceFault(
                f"the projector {state} {POWER_LIMIT_S:g} s after {done}; look at its lamp and its display"
            )
        state = "does not answer yet" if power is None else f"is in {power.value}"
        patience.wait(1.0, "waiting", lambda left, state=state: f"the lamp is being lit; the projector {state}")
        power = _power(projector)
    return False


def _power(projector: Projector) -> Power | None:
    """Return the power state; None where it does not answer, as some do not while the lamp is being lit."""
    try:
        return projector.power()
    except (LinkError, DeviceRefused):
        return None


def _unmute(projector: Projector) -> None:
    muted = projector.muted()
    if muted:
        projector.set_muted(False)
    elif muted is None:
        # Some cannot tell before mute was first set, some neither tell nor set it.
        with suppress(DeviceRefused):
            projector.set_muted(False)


def _is_lit(projector: Projector) -> bool:
    try:
        if projector.power() is not Power.ON:
            return False
    except DeviceError:
        return False
    with suppress(DeviceError):
        lamps = projector.lamps()
        return not lamps or any(lamp.lit for lamp in lamps)
    return True


def _warm_up(projector: Projector, sequence: SequenceSettings, patience: Patience) -> None:
    """Wait until the lamp has burned for its time without a break."""
    while sequence.warm_up_s and not _burned(projector, sequence.warm_up_s, patience):
        pass


def _burned(projector: Projector, warm_up_s: float, patience: Patience) -> bool:
    """Wait for a lamp that was just lit, its health being looked at; return False where it went out meanwhile."""
    until = patience.clock.monotonic() + warm_up_s
    patience.report(
        "warming up", f"the lamp was just lit; waiting {duration_text(warm_up_s)} until its colour is steady"
    )

    def countdown(rest: float) -> str:
        return f"the lamp warms up, {duration_text(max(until - patience.clock.monotonic(), 0))} left"

    while (left := until - patience.clock.monotonic()) > 0:
        patience.wait(min(left, PAUSE_S), "waiting", countdown)
        if health_fault(projector) is not None and _outlast(projector, patience):
            return False
    return True
