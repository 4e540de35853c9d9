"""Make the devices of a session ready, query them, and wait if a device or the disk fails.

After a failure, the run tries again after a second (event `retry`). If the second try also fails, the run pauses (event
`paused`). Every message contains the current cause. If the cause changes, this is reported at once (event `still
paused`), except if only numbers in the message change. The event `resumed` ends the pause. If the pause exceeds
`patience_s`, the run ends with an error of the same class as the first cause.

At the end of a run the screen is set to black, and the lamp is left in this state:

====================  =====================================  =========================================
end of the run        lamp                                   reason
====================  =====================================  =========================================
all frames are taken  off (`sequence.switch_off`)            a lamp lasts a limited number of hours
ended by a fault      off (`sequence.lamp_if_unfinished`)    perhaps nobody is present for hours
interrupted           unchanged                              the operator may continue at once
====================  =====================================  =========================================
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Final, Self, TypeVar

from drivers.camera import Camera
from drivers.presenter import BLACK, Colour, Presenter
from drivers.projector import Power, Projector, ReportsPictureFault, Severity
from experiment.config import CameraSettings, LabSettings, ProjectorCable, SequenceSettings
from experiment.session.journal import LostJournalError
from experiment.session.opening import BusyJournalError
from experiment.session.records import duration_text
from foundation import errors
from foundation.clock import Clock, elapsed_s
from foundation.errors import (
    RUN_AGAIN,
    ConfigurationError,
    CropError,
    DeviceError,
    DeviceFault,
    DeviceRefused,
    InputError,
    LinkError,
    StorageError,
)

# Receives the name of an event, and a sentence about it.
Report = Callable[[str, str], object]

POWER_LIMIT_S: Final = 300.0  # Longest time for a lamp to light, s; makers state up to 130 s with repeated ignition
# Shortest time in which a projector that lost its power can light its lamp and answer again, s.
RELIGHT_S: Final = 15.0

QUERIES_SHARE: Final = 0.01  # If all queries take less than this fraction of a frame's time, all are made at each frame

_PROJECTOR: Final = "the projector"

# Longest time between the answer to a switch-off command and its execution, s.
SWITCH_OFF_LIMIT_S: Final = 5.0
POWER_QUERY_S: Final = 0.5  # Interval between two queries of the power state, s

TRIES: Final = 3  # Number of tries to switch the lamp off
AGAIN_S: Final = 2.0  # Interval between these tries, s

_BY_HAND: Final = "switch it off by hand"


def make_ready(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    """Switch the lamp on if necessary, and wait until it is warm and the projector is healthy.

    If the time limit of `retry` is 0, the first fault is raised.
    """
    # A lamp that is lit at the first query is assumed to be warm.
    was_lit = _light(projector, retry)
    retry.attempt(lambda: _unmute(projector), _PROJECTOR)
    pause = retry.pause(_PROJECTOR)
    went_out = _wait_until_healthy(projector, retry, pause, sequence.relight)
    pause.over()
    if not was_lit or went_out:
        _warm_up(projector, sequence, retry)


def await_health(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    """Pause while the projector is unhealthy; return when it is healthy and warm."""
    pause = retry.pause(_PROJECTOR)
    if _wait_until_healthy(projector, retry, pause, sequence.relight):
        _warm_up(projector, sequence, retry)
    pause.over()


def reported_error(projector: Projector) -> DeviceFault | None:
    """Return the errors that a projector reports, as one fault; None if it reports none."""
    part_names = ", ".join(fault.part for fault in projector.faults() if fault.severity is Severity.ERROR)
    remedy = "read its display, and have it repaired"
    return DeviceFault(f"the projector reports an error of its {part_names}", remedy=remedy) if part_names else None


def _power_fault(projector: Projector) -> DeviceFault | None:
    if (power := projector.power()) is Power.ON:
        return None
    remedy = "the run waits for it" if power is Power.WARMING else "switch it on"
    return DeviceFault(f"the projector is in {power.value} during the session, expected on", remedy=remedy)


def _mute_fault(projector: Projector) -> DeviceFault | None:
    if not projector.muted():
        return None
    return DeviceFault("the projected image is muted", remedy="release mute on its remote control")


def _picture_fault(projector: Projector) -> DeviceFault | None:
    fault = projector.picture_fault() if isinstance(projector, ReportsPictureFault) else None
    return DeviceFault(fault) if fault else None


# Queries for the health of a projector. Causes come before their consequences.
_QUERIES: Final = (reported_error, _power_fault, _mute_fault, _picture_fault)


def health_fault(
    projector: Projector, queries: Iterable[Callable[[Projector], DeviceFault | None]] = _QUERIES
) -> DeviceError | None:
    """Return the first fault of the projector, which may be a missing answer; None if it is healthy."""
    try:
        return next((fault for query in queries if (fault := query(projector)) is not None), None)
    except DeviceError as fault:
        return fault


class HealthWatch:
    """Queries the health of a projector between frames: all queries if they are fast, otherwise one per frame.

    On a slow connection, all queries would delay every frame. The judge detects a dark lamp and a muted or frozen
    picture in all frames but dark frames. All queries are therefore made at dark frames, and after a refused frame.
    """

    def __init__(self, projector: Projector, clock: Clock) -> None:
        self._projector = projector
        self._clock = clock
        self._started = clock.monotonic()
        self._cost_s = math.inf
        self._next = 0
        self._suspected = False

    def suspect(self) -> None:
        """Make all queries the next time, because a frame was refused."""
        self._suspected = True

    def fault(self, thorough: bool) -> DeviceError | None:
        """Make the queries that are due, or all if `thorough`; return the first fault, or None."""
        started = self._clock.monotonic()
        frame_s, self._started = started - self._started, started
        suspected, self._suspected = self._suspected, False
        if thorough or suspected or math.isinf(self._cost_s) or self._cost_s <= QUERIES_SHARE * frame_s:
            fault = health_fault(self._projector)
            self._cost_s = self._clock.monotonic() - started
            return fault
        query = _QUERIES[self._next]
        self._next = (self._next + 1) % len(_QUERIES)
        return health_fault(self._projector, (query,))


def _wait_until_healthy(projector: Projector, retry: RetryPolicy, pause: Pause, relight: bool) -> bool:
    """Wait until the projector is healthy; return whether its lamp went out, or may have gone out."""
    # If the projector does not answer for `RELIGHT_S`, it may have lost its power.
    answered = retry.clock.monotonic()
    went_out = False
    while (fault := health_fault(projector)) is not None:
        if not isinstance(fault, LinkError):
            answered = retry.clock.monotonic()
            went_out = went_out or not _is_lit(projector)
        # The lamp is switched on only with `relight`, because somebody may have switched it off on purpose. It is lit
        # once per pause, because repeated ignition wears out a lamp.
        if relight and _power(projector) is Power.STANDBY:
            relight = False
            with suppress(DeviceError):
                projector.switch_on()
                retry.report("relit", "the projector was in standby, as after a power cut; it was switched on again")
        pause.wait(fault)
    return went_out or retry.clock.monotonic() - answered >= RELIGHT_S


def _light(projector: Projector, retry: RetryPolicy) -> bool:
    """Switch the lamp on if necessary, and wait until it is lit; return whether it was lit at the first query."""
    power: Power | None = retry.attempt(projector.power, _PROJECTOR)
    if power is Power.ON:
        return True
    clock = retry.clock
    started_s, switched = clock.monotonic(), False
    while power is not Power.ON:
        if power is Power.STANDBY and not switched:
            retry.attempt(projector.switch_on, _PROJECTOR)
            started_s, switched = clock.monotonic(), True
        if clock.monotonic() - started_s > POWER_LIMIT_S:
            state = "does not answer" if power is None else f"is still in {power.value}"
            start = "it was switched on" if switched else "the first query"
            raise DeviceFault(
                f"the projector {state} {POWER_LIMIT_S:g} s after {start}", remedy="check its lamp and its display"
            )
        state = "does not answer yet" if power is None else f"is in {power.value}"
        retry.wait(1.0, "waiting", lambda state=state: f"waiting for the lamp; the projector {state}")
        power = _power(projector)
    return False


def _power(projector: Projector) -> Power | None:
    # Some projectors do not answer while their lamp ignites.
    try:
        return projector.power()
    except (LinkError, DeviceRefused):
        return None


def _unmute(projector: Projector) -> None:
    muted = projector.muted()
    if muted:
        projector.set_muted(False)
    elif muted is None:
        # Some projectors report mute only after it was set once, and others cannot set it.
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
        return not lamps or any(lamp.lit is not False for lamp in lamps)
    return True


def _warm_up(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    while sequence.warm_up_s and not _wait_for_warm_up(projector, sequence, retry):
        pass


def _wait_for_warm_up(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> bool:
    """Return False if the lamp went out during the wait."""
    until = retry.clock.monotonic() + sequence.warm_up_s
    wait = duration_text(sequence.warm_up_s)
    retry.report("warming up", f"the lamp was just switched on; the run waits {wait} until its colour is steady")

    def countdown() -> str:
        return f"the lamp is warming up, {duration_text(max(until - retry.clock.monotonic(), 0))} left"

    while (left_s := until - retry.clock.monotonic()) >= INSTANT_S:
        retry.wait(min(left_s, PAUSE_S), "waiting", countdown)
        if health_fault(projector) is not None:
            pause = retry.pause(_PROJECTOR)
            went_out = _wait_until_healthy(projector, retry, pause, sequence.relight)
            pause.over()
            if went_out:
                return False
    return True


class RunEnd(Enum):
    """How a run ended."""

    COMPLETE = "complete"
    UNFINISHED = "unfinished"
    INTERRUPTED = "interrupted"


def leave_lab(devices: Devices, end: RunEnd, sequence: SequenceSettings, report: Report) -> None:
    """Set the screen to black, and switch the lamp off or leave it on; faults are reported, not raised."""
    try:
        devices.presenter.show(BLACK)
    except DeviceError as error:
        _report_safely(report, "screen", f"it could not be set to black: {error}")
    _report_safely(report, "lamp", settle_lamp(devices.projector, end, sequence, devices.clock))


def settle_lamp(projector: Projector | None, end: RunEnd, sequence: SequenceSettings, clock: Clock) -> str:
    """Switch the lamp off or leave it on; return its state in a sentence."""
    if projector is None:
        return f"the projector is not controlled: {_BY_HAND}"
    if end is RunEnd.INTERRUPTED:
        # The operator waits for the end. A query could delay it, if the projector does not answer.
        return f"it is left as it is, so that the next run needs no warm-up; if no run follows, {_BY_HAND}"
    goes_out = sequence.switch_off if end is RunEnd.COMPLETE else sequence.lamp_if_unfinished == "off"
    for _ in range(TRIES - 1):
        with suppress(DeviceError):
            return _set_lamp(projector, goes_out, clock)
        clock.sleep(AGAIN_S)
    try:
        return _set_lamp(projector, goes_out, clock)
    except DeviceError as error:
        failure = "its state is unknown" if not goes_out else "it could not be switched off"
        return f"{failure}: {error}; {_BY_HAND}"


def _set_lamp(projector: Projector, goes_out: bool, clock: Clock) -> str:
    power = projector.power()
    if power is not Power.ON and power is not Power.WARMING:
        return f"it is already off: the projector is in {power.value}"
    if not goes_out:
        return f"it stays on, so that the next run needs no warm-up; if no run follows, {_BY_HAND}"
    projector.switch_off()
    until = clock.monotonic() + SWITCH_OFF_LIMIT_S
    while (power := projector.power()) is Power.ON and clock.monotonic() < until:
        clock.sleep(POWER_QUERY_S)
    if power is Power.ON:
        return f"it is still on {SWITCH_OFF_LIMIT_S:g} s after the command to switch it off; {_BY_HAND}"
    return "it was switched off"


def _report_safely(report: Report, event: str, sentence: str) -> None:
    # A fault here, such as a full disk, must not hide the reason why the run ended.
    with suppress(CropError):
        report(event, sentence)


@dataclass(frozen=True)
class Devices:
    """The open devices of a rig.

    - `presenter`: fills the picture of the projector with one colour.
    - `projector`: control port of the projector; None if it is not controlled.
    - `clock`: used for all waiting and for all times of the session.
    """

    camera: Camera
    presenter: Presenter
    projector: Projector | None
    clock: Clock


@dataclass(frozen=True)
class DryRunPresenter:
    """Presenter of a dry run, which shows nothing.

    `display_texts`: warnings about the display, which are known although nothing is shown.
    """

    display_texts: tuple[str, ...]

    def warnings(self) -> tuple[str, ...]:
        """Return these warnings; see `drivers.presenter.ReportsWarnings`."""
        return self.display_texts

    def show(self, colour: Colour) -> None:
        """Refuse to show a colour."""
        raise DeviceRefused(f"{tuple(colour)} cannot be shown: the display is closed in a dry run; omit --dry-run")

    def close(self) -> None:
        """Do nothing."""


def ask_all(questions: Mapping[str, Callable[[], object]]) -> None:
    """Query every device, and raise all faults together."""
    faults: dict[str, CropError] = {}
    for name, question in questions.items():
        try:
            question()
        except (DeviceError, InputError) as fault:
            faults[name] = fault
    if not faults:
        return
    if len(faults) == 1:
        ((name, fault),) = faults.items()
        raise with_device_name(name, fault)
    is_input_error = all(isinstance(fault, InputError) for fault in faults.values())
    cls = ConfigurationError if is_input_error else DeviceError
    lines = "".join(f"\n  {name}: {fault}" for name, fault in faults.items())
    raise cls(f"{len(faults)} of {len(questions)} devices cannot be used:{lines}") from next(iter(faults.values()))


def with_device_name(device: str, fault: CropError) -> CropError:
    """Add the name of the device to a fault, because an address alone does not identify the device."""
    if str(fault).startswith((device, f"the {device}")):
        return fault
    if fault.about is not None:
        fault.problem = f"{fault.about}: {fault.problem}"
    fault.about = device
    return fault


# Largest relative deviation of a shutter time from a whole number of turns of the colour wheel. Shutters are not more
# exact.
MAX_TURN_ERROR = 0.005

# Nominal shutter times of cameras in thirds of a stop, s, which messages propose.
ENGRAVED_S = (
    *(1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13, 1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4),
    *(0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 15.0, 20.0, 25.0, 30.0),
)


def _light_period_s(projector: ProjectorCable) -> float:
    return 1 / (projector.colour_wheel_hz or projector.refresh_hz)


def wheel_of(settings: LabSettings) -> float:
    """Return the turns per second of the colour wheel; 0 without a wheel, or if it is unknown."""
    if settings.rig == "simulated":
        return float(settings.simulated.room.get("wheel_hz", 0))
    return settings.lab.projector.colour_wheel_hz or 0.0 if settings.rig == "lab" else 0.0


def period_s(settings: LabSettings) -> float:
    """Return the period of the light, s: a turn of the colour wheel, or without a wheel a refresh of the display."""
    wheel_hz = wheel_of(settings)
    return 1 / wheel_hz if wheel_hz else _light_period_s(settings.lab.projector)


def holds_whole_turns(shutter_s: float, period_s: float) -> bool:
    """Return whether a shutter time is a whole number of periods, at least one, within `MAX_TURN_ERROR`."""
    turns = shutter_s / period_s
    # A time slightly below one period is accepted, because it may have been rounded.
    return round(turns) >= 1 and abs(turns - round(turns)) <= MAX_TURN_ERROR * max(turns, 1)


def require_whole_turns(camera: CameraSettings, projector: ProjectorCable) -> None:
    """Require that an exposure is a whole number of turns of the colour wheel, or of display refreshes without one."""
    period = _light_period_s(projector)
    shutter = camera.shutter_s
    if holds_whole_turns(shutter, period):
        return
    fitting = [time for time in ENGRAVED_S if holds_whole_turns(time, period)]
    shorter = max((time for time in fitting if time < shutter), default=None)
    longer = min((time for time in fitting if time > shutter), default=None)
    nearest = " or ".join(f"{time:.4g}" for time in (shorter, longer) if time is not None)
    unit, source, key = "turns", "the colour wheel", "colour_wheel_hz"
    if not projector.colour_wheel_hz:
        unit, source, key = "refreshes", "the display", "refresh_hz"
    raise ConfigurationError(
        f"camera.shutter_s = {shutter:g} s is {shutter / period:.2f} {unit} of {source} ({1 / period:g} per second), "
        f"expected whole {unit}",
        remedy=f"set it to {nearest or f'a multiple of {period:.4g}'} s, preferably 0.5 s or more, or correct "
        f"lab.projector.{key}",
        value=shutter,
        expected=(shorter, longer),
    )


# Time before the second try, s. Many disturbances are shorter, for example a notification over the picture.
RETRY_S: Final = 1.0
PAUSE_S: Final = 5.0  # Interval between two tries in a pause, s
# Limit for the first try, s. If the try takes longer, its driver has already repeated it, and the pause starts at once.
SLOW_S: Final = 10.0
# Longest time between two signs of life during a try, s. A camera driver may wait several minutes for a long exposure.
TRY_S: Final = 300.0
# If fewer accepted frames than this lie between two pauses for the same device, the durations of the pauses are added.
# The sum is compared with the time limit, so that an intermittent fault also ends a run.
RECURS_WITHIN: Final = 10
# Time between the second and the third try of a refused frame, s. Each later interval is twice the previous interval.
BACK_OFF_S: Final = 5.0
LONGEST_BACK_OFF_S: Final = 300.0  # Longest interval between two such tries, s
FRAMES: Final = "the frames"  # Name of pauses for refused frames, instead of a device
# Appended with a time to a sentence that was stored late, because the disk was full.
REPORTED_LATE: Final = " (this was at "
INSTANT_S: Final = 1e-6  # Resolution of simulated time, s

_Result = TypeVar("_Result")


def is_curable(fault: CropError) -> bool:
    """Return whether waiting may help: after a fault of a device or the disk, but not after wrong input."""
    return isinstance(fault, DeviceError | StorageError) and not isinstance(fault, BusyJournalError | LostJournalError)


class RetryPolicy:
    """Waits for a device or disk that fails, up to a time limit.

    An exception that is not a `CropError`, such as Ctrl-C, ends a pause at once. If the disk is full, reports are
    stored later, when there is space again.

    - `report`: receives an event, such as ``retry`` or ``paused``, and a sentence.
    - `idle`: called every few seconds to keep the other devices awake; its `DeviceError` is ignored.
    - `on_wait`: called every few seconds with the state (``paused`` or ``waiting``), a sentence with cause and duration
      of the wait, and the seconds until the next sign of life.
    - `breakable`: context of every wait, in which a request of the operator ends the run at once.
    """

    def __init__(
        self,
        clock: Clock,
        limit_s: float,
        report: Report = lambda event, sentence: None,
        idle: Callable[[], None] = lambda: None,
        on_wait: Callable[[str, str, float], object] = lambda state, sentence, within_s: None,
        breakable: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.clock = clock
        self.limit_s = limit_s
        self.breakable = breakable
        self._report, self._idle, self._on_wait = report, idle, on_wait
        self._unreported: list[tuple[str, str, datetime]] = []
        self._histories: dict[str, _History] = {}

    def accepted(self) -> None:
        """Count an accepted frame. A fault counts as removed after `RECURS_WITHIN` accepted frames."""
        for name, history in list(self._histories.items()):
            history.frames += 1
            if history.frames >= RECURS_WITHIN:
                del self._histories[name]

    def attempt(
        self,
        action: Callable[[], _Result],
        name: str,
        *,
        curable: Callable[[CropError], bool] = is_curable,
        idle: bool = True,
    ) -> _Result:
        """Return the result of `action`, repeated until it succeeds or the time limit is reached."""
        pause = self.pause(name, idle=idle)
        while True:
            try:
                result = action()
            except CropError as fault:
                if not curable(fault):
                    raise
                pause.wait(fault)
            else:
                pause.over()
                return result

    def pause(self, name: str, *, idle: bool = True) -> Pause:
        """Return the pause for the device or disk `name`. `idle`: whether waits call the `idle` of this policy."""
        return Pause(self, name, idle, self._histories.setdefault(name, _History()))

    def report(self, event: str, sentence: str) -> None:
        """Report an event; if the disk is full, the report is stored together with the next report."""
        self._unreported.append((event, sentence, self.clock.now()))
        with suppress(StorageError):
            while self._unreported:
                event, sentence, at = self._unreported[0]
                is_late = (self.clock.now() - at).total_seconds() > RETRY_S
                self._report(event, f"{sentence}{REPORTED_LATE}{at.astimezone():%H:%M:%S})" if is_late else sentence)
                self._unreported.pop(0)

    def wait(self, seconds: float, state: str, sentence: Callable[[], str], *, idle: bool = True) -> None:
        """Wait for `seconds`, and report the current text of `sentence` every few seconds."""
        until = self.clock.monotonic() + seconds
        while (left_s := until - self.clock.monotonic()) >= INSTANT_S:
            self.sign_of_life(state, sentence(), 2 * PAUSE_S + TRY_S * idle)
            self.clock.sleep(min(left_s, PAUSE_S))
            if idle:
                with suppress(DeviceError):
                    self._idle()

    def sign_of_life(self, state: str, sentence: str, within_s: float) -> None:
        """Report the reason of the wait; errors of the disk are ignored."""
        with suppress(StorageError):
            self._on_wait(state, sentence, within_s)


@dataclass
class _History:
    """Earlier pauses for one name: number, total duration, next back-off, and frames accepted since the last pause."""

    pauses: int = 0
    spent_s: float = 0.0
    back_off_s: float = 0.0
    frames: int = 0


class Pause:
    """The wait for a device or disk that fails; created by `RetryPolicy.pause`."""

    def __init__(self, policy: RetryPolicy, name: str, idle: bool, history: _History) -> None:
        self._policy = policy
        self._history = history
        self._name = name
        self._idle = idle
        self._started_at = policy.clock.monotonic()
        self._first: CropError | None = None
        self._failed_at = self._started_at
        self._reported = ""

    def wait(self, fault: CropError) -> None:
        """Report the current fault, and return when the next try is due."""
        with self._policy.breakable():
            self._wait(fault)

    def back_off(self, fault: CropError) -> None:
        """Wait like `wait`, but longer each time, because every try takes a frame."""
        clock, history = self._policy.clock, self._history
        until = clock.monotonic() + history.back_off_s
        self.wait(fault)
        while clock.monotonic() < until:
            self.wait(fault)
        history.back_off_s = min(max(2 * history.back_off_s, BACK_OFF_S), LONGEST_BACK_OFF_S)

    def _wait(self, fault: CropError) -> None:
        policy = self._policy
        now_s = policy.clock.monotonic()
        first = self._first or fault
        has_failed_before = self._first is not None
        if not has_failed_before:
            self._first, self._failed_at = fault, now_s
        left_s = self._left_s()
        if left_s < INSTANT_S:
            raise self._ended(first, fault) from fault
        if not has_failed_before and now_s - self._started_at < SLOW_S:
            policy.report("retry", _with_name(self._name, fault.while_waiting()))
            policy.clock.sleep(min(RETRY_S, left_s))
            return
        cause_text = _numberless(fault)
        if cause_text != self._reported:
            how_long = "without limit" if math.isinf(policy.limit_s) else f"up to {duration_text(left_s)}"
            policy.report(
                "still paused" if self._reported else "paused",
                f"{_with_name(self._name, fault.while_waiting())} (the run waits {how_long}, resumes automatically)",
            )
            self._reported = cause_text
        policy.wait(min(PAUSE_S, left_s), "paused", lambda: self._countdown(fault), idle=self._idle)
        policy.sign_of_life("paused", self._countdown(fault), TRY_S)

    def over(self) -> None:
        """End the pause. If its start was reported, report its end, too."""
        if self._reported:
            are = "are" if self._name.endswith("s") else "is"
            lasted = duration_text(self._lasted_s())
            self._policy.report("resumed", f"{self._name} {are} ready again after a pause of {lasted}")
            self._history.pauses += 1
            self._history.frames = 0
            self._history.spent_s += max(self._lasted_s(), PAUSE_S)
            self._reported = ""

    def _left_s(self) -> float:
        return self._policy.limit_s - self._history.spent_s - self._lasted_s()

    def _lasted_s(self) -> float:
        return self._policy.clock.monotonic() - self._failed_at

    def _countdown(self, fault: CropError) -> str:
        left_s = self._left_s()
        end = "waits without limit" if math.isinf(left_s) else f"ends in {duration_text(max(left_s, 0))}"
        sentence = _with_name(self._name, fault.while_waiting())
        return f"{sentence} (paused for {duration_text(self._lasted_s())}; resumes automatically, {end})"

    def _ended(self, first: CropError, fault: CropError) -> CropError:
        if not self._policy.limit_s:
            return first
        # The first fault is reported without its remedy, because only the remedy of the last fault can help.
        cause, current = first.without_remedy(), fault.while_waiting()
        sentence = current if _numberless(cause) in _numberless(current) else f"{cause}; last fault: {current}"
        waited = duration_text(self._policy.limit_s)
        if self._history.pauses:
            waited += f", in {self._history.pauses + 1} pauses with few frames between them,"
        return _general_class(first)(
            _with_name(self._name, sentence),
            remedy=f"the run waited {waited} and ended: remove the cause, {RUN_AGAIN}",
        )


def pause_cause(sentence: str) -> str:
    """Return the cause in the sentence of a pause, without numbers; it is `FRAMES` for all refused frames."""
    name, *_ = sentence.partition(": ")
    return name if name == FRAMES else _numberless(sentence.partition(REPORTED_LATE)[0].rpartition(" (")[0])


def _with_name(name: str, sentence: str) -> str:
    return sentence if sentence.startswith(name) else f"{name}: {sentence}"


def _numberless(fault: CropError | str) -> str:
    # Numbers in a message may change from one try to the next.
    return re.sub(r"\d+(?:[.,]\d+)*", "#", str(fault))


def _general_class(fault: CropError) -> type[CropError]:
    # Return the base class in `foundation.errors`, because error classes of drivers may need more than a message.
    return next(error_class for error_class in type(fault).__mro__ if error_class.__module__ == errors.__name__)


TICK_S: Final = 1.0  # Interval between two checks of the time, s

# Longest delay of a check of the time on a busy computer, s. A longer delay means that the program was suspended.
GAP_S: Final = 10.0

# A step is late if it takes longer than this multiple of its expected duration, plus `LATE_S`.
LATE_TIMES: Final = 3.0

LATE_S: Final = 10.0  # Additional time for a step, s, because a busy disk or computer may stall for some seconds


@dataclass
class _Step:
    """A step in progress: its device, activity, expected duration, and start (elapsed s)."""

    device: str
    doing: str
    expected_s: float
    started: float
    is_reported: bool = False


class RunWatch:
    """Watches the duration of steps in its own thread; use it in a `with` block.

    `on_late`: called by this thread, once for a late step, with a sentence and the start of the step. `elapsed`:
    returns seconds, including the time during which the computer slept; None for `elapsed_s`.
    """

    def __init__(
        self,
        on_late: Callable[[str, datetime], object] = lambda sentence, started: None,
        elapsed: Callable[[], float] | None = None,
    ) -> None:
        self._on_late = on_late
        self._elapsed = elapsed or elapsed_s
        self._lock = threading.Lock()
        self._last = self._elapsed()
        self._gap_s = 0.0
        self._step: _Step | None = None
        self._took: dict[str, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def gap_s(self) -> float:
        """Return for how many seconds the program was stopped since the last call; 0 if it was not."""
        self.check_time()
        with self._lock:
            gap_s, self._gap_s = self._gap_s, 0.0
        return gap_s

    @contextmanager
    def step(self, device: str, doing: str, expected_s: float, step_kind: str) -> Generator[None]:
        """Watch a device during the block.

        The expected duration is `expected_s`, or the duration of the last step of this kind if it was longer.
        """
        step = _Step(device, doing, max(expected_s, self._took.get(step_kind, 0.0)), self._elapsed())
        with self._lock:
            self._step = step
        try:
            yield
        finally:
            with self._lock:
                self._step = None
                if not step.is_reported:
                    self._took[step_kind] = self._elapsed() - step.started

    def check_time(self) -> None:
        """Check whether the program was stopped, and whether the current step is late."""
        late: _Step | None = None
        with self._lock:
            now = self._elapsed()
            passed, self._last = now - self._last, now
            step = self._step
            if passed > GAP_S:
                self._gap_s += passed
                if step is not None:
                    step.started += passed
            if step is not None and not step.is_reported and now - step.started > LATE_TIMES * step.expected_s + LATE_S:
                late, step.is_reported = step, True
        if late is not None:
            started = datetime.now(UTC) - timedelta(seconds=now - late.started)
            expected = duration_text(late.expected_s) if late.expected_s >= 1 else f"{late.expected_s:.1g} s"
            since = f"{started.astimezone():%Y-%m-%d %H:%M:%S}"
            self._on_late(
                f"late since {since}: {late.device} {late.doing}, expected duration {expected}; check "
                f"{late.device} and its connection",
                started,
            )

    def _watch(self) -> None:
        while not self._over.wait(TICK_S):
            self.check_time()
