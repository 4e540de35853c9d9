"""What a session is taken with, by contract only: camera, presenter and projector, made ready and asked at each frame.

Rules that hold inside:

- A lamp that was lit when it was first asked for is taken as warm; one that was lit meanwhile gets its warm-up, and
  gets it anew where it goes out during that.
- A projector that reports a fault, shows no picture or does not answer is unhealthy: the run pauses, with the cause
  that holds now (`acquisition.run.retry`).
- A projector that was out of reach for as long as a lamp takes to light may have lost its power meanwhile.
- It is lit by the program once, before the first frame: whoever switched it off later may have had a reason. With
  `sequence.relight` it is lit again where it is in standby, once a pause: a lamp that does not light is not worn out.
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
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import Final

from acquisition.run.retry import INSTANT_S, PAUSE_S, Pause, Report, RetryPolicy
from drivers.camera import Camera
from drivers.presenter import BLACK, Colour, Presenter
from drivers.projector import Power, Projector, ReportsPictureFault, Severity
from experiment.config import CameraSettings, LabSettings, ProjectorCable, SequenceSettings
from experiment.session.records import duration_text
from foundation.clock import Clock
from foundation.errors import ConfigurationError, CropError, DeviceError, DeviceFault, DeviceRefused, LinkError

POWER_LIMIT_S: Final = 300.0
"""How long a lamp may take to light; makers state up to 130 s with repeated ignition."""
RELIGHT_S: Final = 15.0
"""No lamp is lit again, and its projector back on the network, in less."""

QUESTIONS_SHARE: Final = 0.01
"""Share of a frame's time that questions may always take: five answers of 4 ms in 2.3 s."""

_NAME: Final = "the projector"

OBEYS_S: Final = 5.0
"""How long a projector may take to begin to switch off, after it has said that it will; they answer before they do."""
LOOK_S: Final = 0.5
"""Between two questions whether it has begun."""

TRIES: Final = 3
"""Tries at putting the lamp out: an answer that is lost once must not let it burn till the morning."""
AGAIN_S: Final = 2.0
"""Between two of them; a controller that was busy answers then."""

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
    power = projector.power()
    if power is Power.ON:
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


_QUESTIONS: Final = (reported_error, _power_fault, _mute_fault, _picture_fault)
"""What is asked of a projector, one question or two each; what explains the others comes first."""


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
    """Wait until the lamp has burned for its time without a break."""
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

    - `camera`: takes the frames.
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

    - `found`: what may change the light behind the codes, as far as that is known without showing any.
    - `unasked`: what could not be asked, and why; empty where all was.
    """

    found: tuple[str, ...]
    unasked: str = ""

    def warnings(self) -> tuple[str, ...]:
        """Return what was found; `drivers.presenter.ReportsWarnings`."""
        return self.found

    def show(self, colour: Colour) -> None:
        """Refuse to."""
        raise DeviceRefused(f"{colour.codes} is not shown: the light was not opened")

    def close(self) -> None:
        """Do nothing."""


Questions = Mapping[str, Callable[[], object]]
"""What is asked, by the name of the device; each raises what its device says against it."""


def ask_all(questions: Questions) -> None:
    """Ask each question, in their order, and raise what went wrong with all of them together."""
    faults: dict[str, CropError] = {}
    for name, question in questions.items():
        try:
            question()
        except (DeviceError, ConfigurationError) as fault:
            faults[name] = fault
    if not faults:
        return
    if len(faults) == 1:
        ((name, fault),) = faults.items()
        raise fault_of(name, fault)
    of_settings = all(isinstance(fault, ConfigurationError) for fault in faults.values())
    kind = ConfigurationError if of_settings else DeviceError
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


MAX_TURN_ERROR = 0.005
"""How far a shutter time may lie from whole turns of the colour wheel, as a share: shutters are no more exact."""

ENGRAVED_S = (
    *(1 / 60, 1 / 50, 1 / 40, 1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 13, 1 / 10, 1 / 8, 1 / 6, 1 / 5, 1 / 4),
    *(0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 15.0, 20.0, 25.0, 30.0),
)
"""Shutter times in thirds of a stop as cameras show them, seconds: what is named before a camera can be asked."""


def light_period_s(projector: ProjectorCable) -> float:
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
    return 1 / wheel_hz if wheel_hz else light_period_s(settings.lab.projector)


def holds_whole_turns(shutter_s: float, period_s: float) -> bool:
    """Return whether a shutter time is a whole number of periods, at least one, to `MAX_TURN_ERROR`."""
    turns = shutter_s / period_s
    # A time of one period and a little less may have been written with few digits.
    return round(turns) >= 1 and abs(turns - round(turns)) <= MAX_TURN_ERROR * max(turns, 1)


def require_whole_turns(camera: CameraSettings, projector: ProjectorCable) -> None:
    """Require that an exposure holds whole turns of the colour wheel, or whole pictures where there is no wheel."""
    period = light_period_s(projector)
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
