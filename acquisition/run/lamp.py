"""The projector in a run: made ready before the first frame, its health checked before and after each.

Rules that hold inside:

- A lamp that was lit when it was first asked for is taken as warm; one that was lit meanwhile gets its warm-up.
- A projector that reports a fault, shows no picture or does not answer is unhealthy: the run pauses.
- A projector that was out of reach for as long as a lamp takes to light may have lost its power meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable

from acquisition.config import SequenceSettings
from drivers.projector import Power, Projector, ReportsPictureFault, Severity
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceFault, DeviceRefused, LinkError

POWER_LIMIT_S = 300.0
"""How long a lamp may take to light; makers state up to 130 s with repeated ignition."""
IDLE_S = 8.0
"""Between two messages to a camera in a long wait; libgphoto2 keeps bodies awake every 10 s."""
PAUSE_S = 5.0
"""Between two questions to an unhealthy projector; an operator who mends it does not notice so short a wait."""
RELIGHT_S = 15.0
"""No lamp is lit again, and its projector back on the network, in less."""


def make_ready(
    projector: Projector,
    clock: Clock,
    sequence: SequenceSettings,
    idle: Callable[[], None] = lambda: None,
    report: Callable[[str, str], None] = lambda what, sentence: None,
) -> None:
    """Switch the lamp on if need be, wait until it burns steadily, and require good health.

    Parameters
    ----------
    idle
        Called every few seconds of the wait, for the other devices.
    report
        Called with a word and a sentence when a long wait begins.

    Raises
    ------
    DeviceFault
        It reports an error, or the lamp does not light within `POWER_LIMIT_S`.
    DeviceRefused, LinkError, ProtocolError
        It does not carry out a command, or cannot be reached.
    """
    begun = clock.monotonic()
    found_lit, switched = True, False
    while (power := _power(projector, patiently=switched)) is not Power.ON:
        found_lit = False
        if power is Power.STANDBY and not switched:
            projector.switch_on()
            switched = True
        if clock.monotonic() - begun > POWER_LIMIT_S:
            state = "does not answer" if power is None else f"is still in {power.value}"
            raise DeviceFault(
                f"the projector {state} {POWER_LIMIT_S:g} s after it was switched on; look at its lamp and its display"
            )
        clock.sleep(1.0)
    try:
        muted = projector.muted()
    except DeviceRefused:
        # Some do not know it before mute was first set.
        muted = True
    if muted:
        projector.set_muted(False)
    require_healthy(projector)
    if not found_lit:
        _warm_up(clock, sequence, idle, report)


def require_healthy(projector: Projector) -> None:
    """Require that light leaves the projector and that it reports no error.

    Raises
    ------
    DeviceFault
        It is off, muted, frozen, without a signal, or reports an error.
    """
    errors = [fault.part for fault in projector.faults() if fault.severity is Severity.ERROR]
    if errors:
        raise DeviceFault(
            f"the projector reports an error of its {', '.join(errors)}; look at its display and have it repaired"
        )
    power = projector.power()
    if power is not Power.ON:
        raise DeviceFault(f"the projector is in {power.value} during the session; switch it on")
    if projector.muted():
        raise DeviceFault("the projector's picture is muted; release mute on its remote control")
    if isinstance(projector, ReportsPictureFault) and (fault := projector.picture_fault()):
        raise DeviceFault(fault)


def health_fault(projector: Projector | None) -> DeviceError | None:
    """Return why the projector is not known to be healthy now, as `require_healthy` raises it; None where it is."""
    try:
        if projector is not None:
            require_healthy(projector)
    except DeviceError as fault:
        return fault
    return None


def await_health(
    projector: Projector,
    clock: Clock,
    sequence: SequenceSettings,
    idle: Callable[[], None],
    report: Callable[[str, str], None],
) -> None:
    """Pause while the projector is unhealthy; return when it is healthy, and warm, again.

    Parameters
    ----------
    idle
        Called every few seconds of the wait, for the other devices.
    report
        Called with a word and a sentence when the pause begins, when the lamp warms up again, and when it is over.

    Raises
    ------
    DeviceError
        The fault that lasts after `sequence.patience_s`.
    """
    fault = health_fault(projector)
    if fault is None:
        return
    report("paused", f"{fault} (the run waits for up to {sequence.patience_s:g} s, and goes on by itself)")
    begun = answered = clock.monotonic()
    went_out = False
    while fault is not None:
        if not isinstance(fault, LinkError):
            answered = clock.monotonic()
            went_out = went_out or not _is_lit(projector)
        if clock.monotonic() - begun >= sequence.patience_s:
            raise type(fault)(
                f"{fault}; the run waited {sequence.patience_s:g} s for that and ended: then run the same command again"
            ) from fault
        clock.sleep(min(PAUSE_S, sequence.patience_s))
        idle()
        fault = health_fault(projector)
        went_out = went_out or clock.monotonic() - answered >= RELIGHT_S
    paused_s = clock.monotonic() - begun
    if went_out:
        _warm_up(clock, sequence, idle, report)
    report("resumed", f"the projector is ready again after a pause of {paused_s:.0f} s")


def _power(projector: Projector, patiently: bool) -> Power | None:
    """Return the power state; None where a projector that is `patiently` asked does not answer now."""
    try:
        return projector.power()
    except (LinkError, DeviceRefused):
        # Some do not answer while the lamp is being lit.
        if not patiently:
            raise
    return None


def _is_lit(projector: Projector) -> bool:
    try:
        return projector.power() is Power.ON
    except DeviceError:
        return False


def _warm_up(
    clock: Clock, sequence: SequenceSettings, idle: Callable[[], None], report: Callable[[str, str], None]
) -> None:
    if not sequence.warm_up_s:
        return
    report("warming up", f"the lamp was just lit; waiting {sequence.warm_up_s:g} s until its colour is steady")
    until = clock.monotonic() + sequence.warm_up_s
    while (left := until - clock.monotonic()) > 0:
        clock.sleep(min(left, IDLE_S))
        idle()
