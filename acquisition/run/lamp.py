"""The projector's part in a run: light before the first frame, and a pause while there is none or it is in doubt.

Rules that hold inside:

- A lamp that burnt when it was first asked is taken as warm; one that was lit meanwhile gets its minutes.
- Whatever a projector says, or does not say, instead of being well is a complaint: a sentence, and a pause.
- A projector that was out of reach for as long as a lamp takes to light may have lost its power meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable

from acquisition.config import SequenceSettings
from drivers.projector import PictureWitness, Power, Projector, Severity
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceFault, DeviceRefused, LinkError

POWER_LIMIT_S = 300.0
"""How long a lamp may take to light; makers state up to 130 s with repeated ignition."""
IDLE_S = 8.0
"""Between two words to a camera in a long wait; libgphoto2 keeps bodies awake every 10 s."""
PAUSE_S = 5.0
"""Between two looks at a projector that complains."""
RELIGHT_S = 15.0
"""No lamp is struck again, and its projector back on the network, in less."""


def make_ready(
    projector: Projector,
    clock: Clock,
    sequence: SequenceSettings,
    idle: Callable[[], None] = lambda: None,
    tell: Callable[[str, str], None] = lambda what, sentence: None,
) -> None:
    """Switch the lamp on if need be, wait until it burns steadily, and require good health.

    Parameters
    ----------
    idle
        Called every few seconds of the wait, for the other devices.
    tell
        Called with a word and a sentence when a long wait begins.

    Raises
    ------
    DeviceFault
        It reports an error, or the lamp does not light within `POWER_LIMIT_S`.
    DeviceRefused, LinkError, ProtocolError
        It does not do what it is told, or cannot be reached.
    """
    begun = clock.monotonic()
    found_lit, switched = True, False
    while (power := _power(projector, patiently=switched)) is not Power.ON:
        found_lit = False
        if power is Power.STANDBY and not switched:
            projector.switch_on()
            switched = True
        if clock.monotonic() - begun > POWER_LIMIT_S:
            state = "out of reach" if power is None else f"in {power.value}"
            raise DeviceFault(
                f"the projector is still {state} after {POWER_LIMIT_S:g} s; look at its lamp and its display"
            )
        clock.sleep(1.0)
    try:
        muted = projector.muted()
    except DeviceRefused:
        # Some cannot tell before they were told.
        muted = True
    if muted:
        projector.set_muted(False)
    require_healthy(projector)
    if not found_lit:
        _warm_up(clock, sequence, idle, tell)


def require_healthy(projector: Projector) -> None:
    """Require that light leaves the projector and that it reports no error.

    Raises
    ------
    DeviceFault
        It is off, muted, frozen, without a signal, or reports an error.
    """
    errors = [fault.part for fault in projector.faults() if fault.severity is Severity.ERROR]
    if errors:
        raise DeviceFault(f"the projector reports an error of its {', '.join(errors)}; look at its display and mend it")
    power = projector.power()
    if power is not Power.ON:
        raise DeviceFault(f"the projector went to {power.value} during the session; switch it on")
    if projector.muted():
        raise DeviceFault("the projector's picture is muted; release mute on its remote control")
    if isinstance(projector, PictureWitness) and (fault := projector.picture_fault()):
        raise DeviceFault(fault)


def complaint_of(projector: Projector | None) -> DeviceError | None:
    """Return what keeps the projector from being known to be well now, or None."""
    try:
        if projector is not None:
            require_healthy(projector)
    except DeviceError as complaint:
        return complaint
    return None


def await_health(
    projector: Projector,
    clock: Clock,
    sequence: SequenceSettings,
    idle: Callable[[], None],
    tell: Callable[[str, str], None],
) -> None:
    """Pause while the projector complains; go on when it is well, and warm, again.

    Parameters
    ----------
    idle
        Called every few seconds of the wait, for the other devices.
    tell
        Called with a word and a sentence when the pause begins, when the lamp warms up again, and when it is over.

    Raises
    ------
    DeviceError
        What it still complains of after `sequence.patience_s`.
    """
    complaint = complaint_of(projector)
    if complaint is None:
        return
    tell("paused", f"{complaint} (the run goes on by itself; it waits for {sequence.patience_s:g} s)")
    begun = heard = clock.monotonic()
    went_out = False
    while complaint is not None:
        if not isinstance(complaint, LinkError):
            heard = clock.monotonic()
            went_out = went_out or not _is_lit(projector)
        if clock.monotonic() - begun >= sequence.patience_s:
            raise type(complaint)(
                f"{complaint}; the run waited {sequence.patience_s:g} s for that: then run again"
            ) from complaint
        clock.sleep(min(PAUSE_S, sequence.patience_s))
        idle()
        complaint = complaint_of(projector)
        went_out = went_out or clock.monotonic() - heard >= RELIGHT_S
    paused_s = clock.monotonic() - begun
    if went_out:
        _warm_up(clock, sequence, idle, tell)
    tell("resumed", f"the projector is well again after {paused_s:.0f} s")


def _power(projector: Projector, patiently: bool) -> Power | None:
    """Return the power state; None where a projector that is `patiently` asked does not tell now."""
    try:
        return projector.power()
    except (LinkError, DeviceRefused):
        # Some hear nothing while the lamp is struck.
        if not patiently:
            raise
    return None


def _is_lit(projector: Projector) -> bool:
    try:
        return projector.power() is Power.ON
    except DeviceError:
        return False


def _warm_up(
    clock: Clock, sequence: SequenceSettings, idle: Callable[[], None], tell: Callable[[str, str], None]
) -> None:
    if not sequence.warm_up_s:
        return
    tell("warming up", f"the lamp was just lit and gets {sequence.warm_up_s:g} s until its colour is steady")
    until = clock.monotonic() + sequence.warm_up_s
    while (left := until - clock.monotonic()) > 0:
        clock.sleep(min(left, IDLE_S))
        idle()
