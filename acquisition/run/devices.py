"""What a session is taken with, by contract only: made ready, asked at each frame, waited for where it fails or hangs.

The disk is waited for as camera, presenter and projector are. Rules that hold inside:

- The first failure is tried again after a second (`retry`), so that what passes at once pauses nothing. What lasts
  pauses the run (`paused`) with the cause that holds *now*; another cause is told as soon as it is there (`still
  paused`); with other digits it is no other. `resumed` ends it.
- Every few seconds of a pause come `on_wait`, with cause and countdown, and `idle`, for devices that are not at fault.
- When the time is over, the error is of the first cause's class and names it first; what held at last is added.
- What fails again before `RECURS_WITHIN` frames were accepted was not mended: its pauses count together, and share one
  patience and one back-off. A cause that comes and goes ends a run as one does that stays.
- Nothing that is told may end the run: a full disk, which cannot take the note of a pause, gets it when there is space.
- What is no `CropError` passes through at once: Ctrl-C ends a pause; `on_wait` and `idle` may raise
  `KeyboardInterrupt`.
- A lamp that was lit when it was first asked for is taken as warm; one that was lit meanwhile gets its warm-up, and
  gets it anew where it goes out during that.
- A projector that reports a fault, shows no picture or does not answer is unhealthy: the run pauses. One that was out
  of reach for as long as a lamp takes to light may have lost its power meanwhile.
- It is lit by the program once, before the first frame: whoever switched it off later may have had a reason. With
  `sequence.relight` it is lit again where it is in standby, only once a pause, so that tries do not wear out a lamp
  that does not light.
- Whatever ends the run, the screen goes black, and the lamp's fate is decided and said:

====================  =====================================  =========================================
what ended the run    the lamp                               because
====================  =====================================  =========================================
all frames are there  goes out (`sequence.switch_off`)       its hours are counted
it ended by itself    goes out                               nobody may be there till the morning; the
                      (`sequence.lamp_if_unfinished`)        next run warms it up again
somebody ended it     is left as it is                       somebody is there, and may go on at once
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
    ConfigurationError,
    CropError,
    DeviceError,
    DeviceFault,
    DeviceRefused,
    InputError,
    LinkError,
    StorageError,
)

# Where words and sentences of a run go: terminal first, then journal, then whoever is notified.
Report = Callable[[str, str], object]

POWER_LIMIT_S: Final = 300.0  # How long a lamp may take to light; makers state up to 130 s with repeated ignition
RELIGHT_S: Final = 15.0  # No lamp is lit again, and its projector back on the network, in less

QUESTIONS_SHARE: Final = 0.01  # Share of a frame's time that questions may always take: five answers of 4 ms in 2.3 s

_NAME: Final = "the projector"

# How long a projector may take to begin to switch off, after it has said that it will; they answer before they do.
OBEYS_S: Final = 5.0
LOOK_S: Final = 0.5  # Between two questions whether it has begun

TRIES: Final = 3  # Tries at putting the lamp out: an answer that is lost once must not let it burn till the morning
AGAIN_S: Final = 2.0  # Between two of them; a controller that was busy answers then

_BY_HAND: Final = "switch it off by hand"


def make_ready(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    """Switch the lamp on if need be, wait until it burns steadily, and until its health is good.

    Where `retry` has no time, the first fault is raised.
    """
    found_lit = _light(projector, retry)
    retry.attempt(lambda: _unmute(projector), _NAME)
    pause = retry.pause(_NAME)
    went_out = _outlast(projector, retry, pause, sequence.relight)
    pause.over()
    if not found_lit or went_out:
        _warm_up(projector, sequence, retry)


def await_health(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    """Pause while the projector is unhealthy; return when it is healthy, and warm, again."""
    pause = retry.pause(_NAME)
    if _outlast(projector, retry, pause, sequence.relight):
        _warm_up(projector, sequence, retry)
    pause.over()


def reported_error(projector: Projector) -> DeviceFault | None:
    """Return the errors that a projector reports of its parts, in one sentence; None where it reports none."""
    parts = ", ".join(fault.part for fault in projector.faults() if fault.severity is Severity.ERROR)
    remedy = "look at its display and have it repaired"
    return DeviceFault(f"the projector reports an error of its {parts}", remedy=remedy) if parts else None


def _power_fault(projector: Projector) -> DeviceFault | None:
    if (power := projector.power()) is Power.ON:
        return None
    remedy = "it is waited for" if power is Power.WARMING else "switch it on"
    return DeviceFault(f"the projector is in {power.value} during the session", remedy=remedy)


def _mute_fault(projector: Projector) -> DeviceFault | None:
    if not projector.muted():
        return None
    return DeviceFault("the projector's picture is muted", remedy="release mute on its remote control")


def _picture_fault(projector: Projector) -> DeviceFault | None:
    fault = projector.picture_fault() if isinstance(projector, ReportsPictureFault) else None
    return DeviceFault(fault) if fault else None


# What is asked of a projector, one question or two each; what explains the others comes first.
_QUESTIONS: Final = (reported_error, _power_fault, _mute_fault, _picture_fault)


def health_fault(
    projector: Projector, questions: Iterable[Callable[[Projector], DeviceFault | None]] = _QUESTIONS
) -> DeviceError | None:
    """Return why the projector is not known to be healthy now; None where light leaves it and it reports no error."""
    try:
        return next((fault for ask in questions if (fault := ask(projector)) is not None), None)
    except DeviceError as fault:
        return fault


class HealthWatch:
    """Asks for a projector's health between frames, all of it where that costs next to nothing, else in turn.

    A projector on a slow line takes as long to answer as a frame can be shortened by. What the judge sees in a frame, a
    lamp that is out, a picture that is muted or stands still, needs not be asked each time; where it cannot see
    that, in the dark, or where it saw something, all is asked.
    """

    def __init__(self, projector: Projector, clock: Clock) -> None:
        self._projector = projector
        self._clock = clock
        self._begun = clock.monotonic()
        self._cost_s = math.inf
        self._next = 0
        self._suspected = False

    def suspect(self) -> None:
        """Ask for everything the next time: a frame was refused."""
        self._suspected = True

    def fault(self, thorough: bool) -> DeviceError | None:
        """Return why the projector is not known to be healthy, of what is asked now; None where it is."""
        begun = self._clock.monotonic()
        frame_s, self._begun = begun - self._begun, begun
        suspected, self._suspected = self._suspected, False
        if thorough or suspected or math.isinf(self._cost_s) or self._cost_s <= QUESTIONS_SHARE * frame_s:
            fault = health_fault(self._projector)
            self._cost_s = self._clock.monotonic() - begun
            return fault
        question = _QUESTIONS[self._next]
        self._next = (self._next + 1) % len(_QUESTIONS)
        return health_fault(self._projector, (question,))


def _outlast(projector: Projector, retry: RetryPolicy, pause: Pause, relight: bool) -> bool:
    """Wait until the projector is healthy, light it if asked to; return whether its lamp went out, or may have."""
    answered = retry.clock.monotonic()
    went_out = False
    while (fault := health_fault(projector)) is not None:
        if not isinstance(fault, LinkError):
            answered = retry.clock.monotonic()
            went_out = went_out or not _is_lit(projector)
        if relight and _power(projector) is Power.STANDBY:
            relight = False
            with suppress(DeviceError):
                projector.switch_on()
                retry.report("relit", "the projector is in standby, as after a power cut; it is switched on again")
        pause.wait(fault)
    return went_out or retry.clock.monotonic() - answered >= RELIGHT_S


def _light(projector: Projector, retry: RetryPolicy) -> bool:
    """Wait until the lamp is lit, after switching it on if need be; return whether it was lit when first asked for."""
    power: Power | None = retry.attempt(projector.power, _NAME)
    if power is Power.ON:
        return True
    clock = retry.clock
    begun, switched = clock.monotonic(), False
    while power is not Power.ON:
        if power is Power.STANDBY and not switched:
            retry.attempt(projector.switch_on, _NAME)
            begun, switched = clock.monotonic(), True
        if clock.monotonic() - begun > POWER_LIMIT_S:
            state = "does not answer" if power is None else f"is still in {power.value}"
            done = "it was switched on" if switched else "it was first asked"
            raise DeviceFault(
                f"the projector {state} {POWER_LIMIT_S:g} s after {done}", remedy="look at its lamp and its display"
            )
        state = "does not answer yet" if power is None else f"is in {power.value}"
        retry.wait(1.0, "waiting", lambda state=state: f"the lamp is being lit; the projector {state}")
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


def _warm_up(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> None:
    while sequence.warm_up_s and not _burned(projector, sequence, retry):
        pass


def _burned(projector: Projector, sequence: SequenceSettings, retry: RetryPolicy) -> bool:
    """Wait for a lamp that was just lit, its health being looked at; return False where it went out meanwhile."""
    until = retry.clock.monotonic() + sequence.warm_up_s
    wait = duration_text(sequence.warm_up_s)
    retry.report("warming up", f"the lamp was just lit; waiting {wait} until its colour is steady")

    def countdown() -> str:
        return f"the lamp warms up, {duration_text(max(until - retry.clock.monotonic(), 0))} left"

    while (left := until - retry.clock.monotonic()) >= INSTANT_S:
        retry.wait(min(left, PAUSE_S), "waiting", countdown)
        if health_fault(projector) is not None:
            pause = retry.pause(_NAME)
            went_out = _outlast(projector, retry, pause, sequence.relight)
            pause.over()
            if went_out:
                return False
    return True


class RunEnd(Enum):
    """What ended a run."""

    COMPLETE = "complete"
    UNFINISHED = "unfinished"
    INTERRUPTED = "interrupted"


def leave_lab(devices: Devices, end: RunEnd, sequence: SequenceSettings, report: Report) -> None:
    """Make the screen black, and let the lamp go out or burn on; what cannot be done is said, and raises nothing."""
    try:
        devices.presenter.show(BLACK)
    except DeviceError as error:
        _say(report, "screen", f"it could not be made black: {error}")
    _say(report, "lamp", lamp_fate(devices.projector, end, sequence, devices.clock))


def lamp_fate(projector: Projector | None, end: RunEnd, sequence: SequenceSettings, clock: Clock) -> str:
    """Let the lamp go out or burn on, and return in a sentence what it does now."""
    if projector is None:
        return f"the projector is not under control: {_BY_HAND}"
    if end is RunEnd.INTERRUPTED:
        # Somebody waits for the end: a projector that does not answer would hold it up.
        return f"it is left as it is, so that the next run needs no warm-up; else {_BY_HAND}"
    goes_out = sequence.switch_off if end is RunEnd.COMPLETE else sequence.lamp_if_unfinished == "off"
    for _ in range(TRIES - 1):
        with suppress(DeviceError):
            return _decided(projector, goes_out, clock)
        clock.sleep(AGAIN_S)
    try:
        return _decided(projector, goes_out, clock)
    except DeviceError as error:
        undone = "whether it burns is not known" if not goes_out else "it could not be switched off"
        return f"{undone}: {error}; {_BY_HAND}"


def _decided(projector: Projector, goes_out: bool, clock: Clock) -> str:
    power = projector.power()
    if power is not Power.ON and power is not Power.WARMING:
        return f"it is out already: the projector is in {power.value}"
    if not goes_out:
        return f"it burns on, so that the next run needs no warm-up; else {_BY_HAND}"
    projector.switch_off()
    until = clock.monotonic() + OBEYS_S
    while (power := projector.power()) is Power.ON and clock.monotonic() < until:
        clock.sleep(LOOK_S)
    if power is Power.ON:
        return f"it burns on though the projector was told to switch it off; {_BY_HAND}"
    return "it was switched off"


def _say(report: Report, what: str, sentence: str) -> None:
    # The run has its end already, and that counts: a full disk, for one.
    with suppress(CropError):
        report(what, sentence)


@dataclass(frozen=True)
class Devices:
    """The open devices of a rig.

    - `presenter`: fills the projector's picture with one plain colour.
    - `projector`: the control port of the projector; None where its lamp is not under control.
    - `clock`: measures and makes every pause.
    """

    camera: Camera
    presenter: Presenter
    projector: Projector | None
    clock: Clock


@dataclass(frozen=True)
class LightNotShown:
    """Stands for the presenter where nothing is to be shown, in a dry run.

    `found`: what may change the light behind the codes, as far as that is known without showing any.
    """

    found: tuple[str, ...]

    def warnings(self) -> tuple[str, ...]:
        """Return what was found; `drivers.presenter.ReportsWarnings`."""
        return self.found

    def show(self, colour: Colour) -> None:
        """Refuse to."""
        raise DeviceRefused(f"{tuple(colour)} is not shown: the light was not opened")

    def close(self) -> None:
        """Do nothing."""


def ask_all(questions: Mapping[str, Callable[[], object]]) -> None:
    """Ask each question, by the name of its device, and raise what went wrong with all of them together."""
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
        raise fault_of(name, fault)
    of_input = all(isinstance(fault, InputError) for fault in faults.values())
    kind = ConfigurationError if of_input else DeviceError
    listed = "".join(f"\n  {name}: {fault}" for name, fault in faults.items())
    raise kind(f"{len(faults)} of {len(questions)} devices cannot be used:{listed}") from next(iter(faults.values()))


def fault_of(name: str, fault: CropError) -> CropError:
    """Return a fault that begins with the device that it is of: an address alone does not tell which one it is."""
    if str(fault).startswith((name, f"the {name}")):
        return fault
    if fault.about is not None:
        fault.problem = f"{fault.about}: {fault.problem}"
    fault.about = name
    return fault


# How far a shutter time may lie from whole turns of the colour wheel, as a share: shutters are no more exact.
MAX_TURN_ERROR = 0.005

# Shutter times in thirds of a stop as cameras show them, seconds: what is named before a camera can be asked.
ENGRAVED_S = (
    *(1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13, 1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4),
    *(0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 15.0, 20.0, 25.0, 30.0),
)


def _light_period_s(projector: ProjectorCable) -> float:
    """Return the seconds after which the projector's light repeats: a turn of its wheel, else a picture."""
    return 1 / (projector.colour_wheel_hz or projector.refresh_hz)


def wheel_of(settings: LabSettings) -> float:
    """Return the turns a second of the colour wheel before the camera; 0 where there is none, or it is not known."""
    if settings.rig == "simulated":
        return float(settings.simulated.room.get("wheel_hz", 0))
    return settings.lab.projector.colour_wheel_hz or 0.0 if settings.rig == "lab" else 0.0


def period_s(settings: LabSettings) -> float:
    """Return the seconds after which the light before the camera repeats: a turn of its wheel, or a picture."""
    wheel_hz = wheel_of(settings)
    return 1 / wheel_hz if wheel_hz else _light_period_s(settings.lab.projector)


def holds_whole_turns(shutter_s: float, period_s: float) -> bool:
    """Return whether a shutter time is a whole number of periods, at least one, to `MAX_TURN_ERROR`."""
    turns = shutter_s / period_s
    # A time of one period and a little less may have been written with few digits.
    return round(turns) >= 1 and abs(turns - round(turns)) <= MAX_TURN_ERROR * max(turns, 1)


def require_whole_turns(camera: CameraSettings, projector: ProjectorCable) -> None:
    """Require that an exposure holds whole turns of the colour wheel, or whole pictures where there is no wheel."""
    period = _light_period_s(projector)
    shutter = camera.shutter_s
    if holds_whole_turns(shutter, period):
        return
    fitting = [time for time in ENGRAVED_S if holds_whole_turns(time, period)]
    below = max((time for time in fitting if time < shutter), default=None)
    above = min((time for time in fitting if time > shutter), default=None)
    near = " or ".join(f"{time:.4g}" for time in (below, above) if time is not None)
    unit, of, key = "turns", "the colour wheel", "colour_wheel_hz"
    if not projector.colour_wheel_hz:
        unit, of, key = "pictures", "the projector", "refresh_hz"
    raise ConfigurationError(
        f"camera.shutter_s = {shutter:g} is {shutter / period:.2f} {unit} of {of} ({1 / period:g} a second), and a "
        f"frame must hold whole {unit}",
        remedy=f"set it to {near or f'a multiple of {period:.4g}'} s, better 0.5 s or more, or correct "
        f"lab.projector.{key}",
        value=shutter,
        expected=(below, above),
    )


# Before the second try: a notification in front of the picture, or a cable put back, needs no more.
RETRY_S: Final = 1.0
PAUSE_S: Final = 5.0  # Between two tries in a pause; an operator who mends something does not notice so short a wait
# A try that failed after so long has been tried often enough by its driver: the pause is told at once.
SLOW_S: Final = 10.0
# How long a try may go without a sign of life: a camera's driver waits 90 s for a frame of 30 s, then looks for it
# for 70 s more over a new connection, and a question may go without an answer for 20 s.
TRY_S: Final = 300.0
# Frames that must be accepted after a pause for the next one to count anew: what works for half a minute between two
# faults lets a session get on, and what works for a frame or two does not.
RECURS_WITHIN: Final = 10
# Between the second and the third try of what costs a refused file each; the second comes at once, each later pause
# is twice the one before.
BACK_OFF_S: Final = 5.0
LONGEST_BACK_OFF_S: Final = 300.0  # Between two such tries at most: an operator can wait for five minutes
FRAMES: Final = "the frames"  # What is waited for where nothing fails but every frame is refused
TOLD_LATER: Final = " (this was at "  # What stands behind a sentence that the disk could not take when it was said
INSTANT_S: Final = 1e-6  # Resolution of simulated time: nothing shorter can be waited for

_Result = TypeVar("_Result")


def is_curable(fault: CropError) -> bool:
    """Return whether waiting may help: any fault of a device or of the disk, but nothing that the user gave."""
    return isinstance(fault, DeviceError | StorageError) and not isinstance(fault, BusyJournalError | LostJournalError)


class RetryPolicy:
    """How long, and how, a run waits for what fails.

    `report`: told a word, such as ``retry`` or ``paused``, and a sentence. `idle`: keeps the other devices awake every
    few seconds; its `DeviceError` is left to the device's own next use. `on_wait`: told every few seconds the state
    (``paused`` or ``waiting``), what is waited for and how long, and in how many seconds the next sign is due.
    `breakable`: a block in which somebody's request ends the run at once, put around every wait.
    """

    def __init__(
        self,
        clock: Clock,
        limit_s: float,
        report: Report = lambda what, sentence: None,
        idle: Callable[[], None] = lambda: None,
        on_wait: Callable[[str, str, float], object] = lambda state, sentence, within_s: None,
        breakable: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.clock = clock
        self.limit_s = limit_s
        self.breakable = breakable
        self._tell, self._idle, self._on_wait = report, idle, on_wait
        self._untold: list[tuple[str, str, datetime]] = []
        self._histories: dict[str, _History] = {}

    def accepted(self) -> None:
        """Note an accepted frame: what was waited for before so many of them counts as mended."""
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
        """Return what `action` returns, tried until it succeeds or the time is over."""
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
        """Return what waits for `name`, and counts from its first failure; parameters as those of `attempt`."""
        return Pause(self, name, idle, self._histories.setdefault(name, _History()))

    def report(self, what: str, sentence: str) -> None:
        """Tell what happens; where the disk cannot take it, it is told again as soon as something else can be."""
        self._untold.append((what, sentence, self.clock.now()))
        with suppress(StorageError):
            while self._untold:
                what, sentence, at = self._untold[0]
                late = (self.clock.now() - at).total_seconds() > RETRY_S
                self._tell(what, f"{sentence}{TOLD_LATER}{at.astimezone():%H:%M:%S})" if late else sentence)
                self._untold.pop(0)

    def wait(self, seconds: float, state: str, sentence: Callable[[], str], *, idle: bool = True) -> None:
        """Let `seconds` pass; what `sentence` returns is told every few of them."""
        until = self.clock.monotonic() + seconds
        while (left := until - self.clock.monotonic()) >= INSTANT_S:
            self.sign_of_life(state, sentence(), 2 * PAUSE_S + TRY_S * idle)
            self.clock.sleep(min(left, PAUSE_S))
            if idle:
                with suppress(DeviceError):
                    self._idle()

    def sign_of_life(self, state: str, sentence: str, within_s: float) -> None:
        """Tell what is waited for; a disk that cannot take it does not matter."""
        with suppress(StorageError):
            self._on_wait(state, sentence, within_s)


@dataclass
class _History:
    """What was waited for a thing so far: `pauses` of `spent_s` together, and accepted `frames` since the last."""

    pauses: int = 0
    spent_s: float = 0.0
    back_off_s: float = 0.0
    frames: int = 0


class Pause:
    """The wait for one thing that fails; given by `RetryPolicy.pause`."""

    def __init__(self, policy: RetryPolicy, name: str, idle: bool, history: _History) -> None:
        self._policy = policy
        self._history = history
        self._name = name
        self._idle = idle
        self._begun_trying = policy.clock.monotonic()
        self._first: CropError | None = None
        self._failed_at = self._begun_trying
        self._told = ""

    def wait(self, fault: CropError) -> None:
        """Say what holds now, and return when it is time for the next try."""
        with self._policy.breakable():
            self._wait(fault)

    def back_off(self, fault: CropError) -> None:
        """Wait as `wait` does, longer each time, for a try that costs something."""
        clock, history = self._policy.clock, self._history
        until = clock.monotonic() + history.back_off_s
        self.wait(fault)
        while clock.monotonic() < until:
            self.wait(fault)
        history.back_off_s = min(max(2 * history.back_off_s, BACK_OFF_S), LONGEST_BACK_OFF_S)

    def _wait(self, fault: CropError) -> None:
        policy = self._policy
        now = policy.clock.monotonic()
        first = self._first or fault
        again = self._first is not None
        if not again:
            self._first, self._failed_at = fault, now
        left = self._left_s()
        if left < INSTANT_S:
            raise self._ended(first, fault) from fault
        if not again and now - self._begun_trying < SLOW_S:
            policy.report("retry", _named(self._name, fault.while_waiting()))
            policy.clock.sleep(min(RETRY_S, left))
            return
        kind = _kind(fault)
        if kind != self._told:
            how_long = "for as long as it takes" if math.isinf(policy.limit_s) else f"up to {duration_text(left)}"
            policy.report(
                "still paused" if self._told else "paused",
                f"{_named(self._name, fault.while_waiting())} (the run waits {how_long}, and goes on by itself)",
            )
            self._told = kind
        policy.wait(min(PAUSE_S, left), "paused", lambda: self._countdown(fault), idle=self._idle)
        policy.sign_of_life("paused", self._countdown(fault), TRY_S)

    def over(self) -> None:
        """Say that the run goes on, where it had said that it paused."""
        if self._told:
            are = "are" if self._name.endswith("s") else "is"
            lasted = duration_text(self._lasted_s())
            self._policy.report("resumed", f"{self._name} {are} ready again after a pause of {lasted}")
            self._history.pauses += 1
            self._history.frames = 0
            self._history.spent_s += max(self._lasted_s(), PAUSE_S)
            self._told = ""

    def _left_s(self) -> float:
        return self._policy.limit_s - self._history.spent_s - self._lasted_s()

    def _lasted_s(self) -> float:
        return self._policy.clock.monotonic() - self._failed_at

    def _countdown(self, fault: CropError) -> str:
        left = self._left_s()
        end = "waits for as long as it takes" if math.isinf(left) else f"ends in {duration_text(max(left, 0))}"
        held = _named(self._name, fault.while_waiting())
        return f"{held} (paused for {duration_text(self._lasted_s())}; goes on by itself, {end})"

    def _ended(self, first: CropError, fault: CropError) -> CropError:
        if not self._policy.limit_s:
            return first
        # What came first is told without its remedy: that of what holds now helps. A fault may name it already.
        cause, held = first.without_remedy(), fault.while_waiting()
        at_last = held if _kind(cause) in _kind(held) else f"{cause}; at last: {held}"
        waited = duration_text(self._policy.limit_s)
        if self._history.pauses:
            waited += f", in {self._history.pauses + 1} pauses with few frames between them,"
        return _family(first)(
            _named(self._name, at_last),
            remedy=f"the run waited {waited} for that and ended: when it is mended run the same command again",
        )


def pause_cause(sentence: str) -> str:
    """Return what a pause is for, of the sentence that tells it: the same at each of its times, and for all frames."""
    name, *_ = sentence.partition(": ")
    return name if name == FRAMES else _kind(sentence.partition(TOLD_LATER)[0].rpartition(" (")[0])


def _named(name: str, sentence: str) -> str:
    """Return what is said of a fault with the name of what has it, which many name themselves."""
    return sentence if sentence.startswith(name) else f"{name}: {sentence}"


def _kind(fault: CropError | str) -> str:
    """Return a fault's words without its numbers, which may change from one try to the next."""
    return re.sub(r"\d+(?:[.,]\d+)*", "#", str(fault))


def _family(fault: CropError) -> type[CropError]:
    """Return the nearest class of the tree of errors; classes of drivers want more than a sentence."""
    return next(kind for kind in type(fault).__mro__ if kind.__module__ == errors.__name__)


TICK_S: Final = 1.0  # Between two looks at the time

GAP_S: Final = 10.0  # A look that comes so late was held up: a busy machine lets a thread wait for a second or two

# A step is late when it takes so many times as long as it is expected to: a download that is tried again takes two.
LATE_TIMES: Final = 3.0

LATE_S: Final = 10.0  # And so many seconds more: a disk, or a machine with other work, may stall for some


@dataclass
class _Step:
    """What `device` does since `begun`, seconds as they elapse; `expected_s` is what it takes."""

    device: str
    doing: str
    expected_s: float
    begun: float
    is_told: bool = False


class RunWatch:
    """Looks at the time in a thread of its own; use it in a `with` block.

    `on_late`: called by that thread, once for a step that is late, with the sentence that says so and when it began.
    `elapsed`: returns seconds that pass while the machine sleeps, too; None: the machine's.
    """

    def __init__(
        self,
        on_late: Callable[[str, datetime], object] = lambda sentence, begun: None,
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
        """Return for how long the program stood still since this was asked last, seconds; 0 where it did not."""
        self.look()
        with self._lock:
            gap_s, self._gap_s = self._gap_s, 0.0
        return gap_s

    @contextmanager
    def step(self, device: str, doing: str, expected_s: float, kind: str) -> Generator[None]:
        """Note what a device does in the block: at least `expected_s`, or as long as the last of its `kind` took."""
        step = _Step(device, doing, max(expected_s, self._took.get(kind, 0.0)), self._elapsed())
        with self._lock:
            self._step = step
        try:
            yield
        finally:
            with self._lock:
                self._step = None
                if not step.is_told:
                    self._took[kind] = self._elapsed() - step.begun

    def look(self) -> None:
        """Look at the time."""
        late: _Step | None = None
        with self._lock:
            now = self._elapsed()
            passed, self._last = now - self._last, now
            step = self._step
            if passed > GAP_S:
                self._gap_s += passed
                if step is not None:
                    step.begun += passed
            if step is not None and not step.is_told and now - step.begun > LATE_TIMES * step.expected_s + LATE_S:
                late, step.is_told = step, True
        if late is not None:
            begun = datetime.now(UTC) - timedelta(seconds=now - late.begun)
            expected = duration_text(late.expected_s) if late.expected_s >= 1 else f"{late.expected_s:.1g} s"
            since = f"{begun.astimezone():%Y-%m-%d %H:%M:%S}"
            self._on_late(
                f"late since {since}: {late.device} {late.doing}, for which {expected} is expected; look at "
                f"{late.device} and what it is connected by",
                begun,
            )

    def _watch(self) -> None:
        while not self._over.wait(TICK_S):
            self.look()
