"""The plan of a run: what it takes, needs and finds, and what would end it before its end.

Made before anything moves, printed by a dry run, required by a run, in this order: the frames that are left, from files
alone (`Work`); how large and how long they are (`Estimate`); what the devices say, of which nothing is set, lit,
released or shown for it (`Answers`); all of it together (`RunPlan`), and as text (`plan_lines`). A session that is
there is read and not changed; one that is not is not made. A fault would end the run, and has its remedy; a doubt may.
What is estimated says what it rests on.
"""

from __future__ import annotations

import errno
import math
import os
import shlex
import shutil
import statistics
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar

from acquisition.run.devices import (
    Devices,
    fault_of,
    holds_whole_turns,
    period_s,
    reported_error,
    wheel_of,
)
from acquisition.run.rig.opening import known_frame_bytes, open_rig
from drivers.camera import CameraIdentity, ReportsSupplies, Supplies
from drivers.presenter import BLACK, ReportsWarnings
from drivers.projector import Power, Projector
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings, parse_lab
from experiment.lights import Illumination, load_illuminations
from experiment.session.folder import Session, session_exists
from experiment.session.records import KINDS, RESPONSE, SessionStep, duration_text, plan_steps
from experiment.session.repair import require_frames_folder
from foundation.errors import (
    ConfigurationError,
    CropError,
    DeviceError,
    DeviceFault,
    DeviceRefused,
    InputError,
    StorageError,
    counted,
)
from foundation.files import file_sha256, storage_error
from foundation.secret_texts import is_address, is_webhook, target_label

# Settings that must stay for a whole session: they decide what its frames show.
FIXED: Final = (
    "rig", "camera", "simulated.body", "simulated.camera", "simulated.seed", "simulated.room",
    "sequence.reference_every",
)  # fmt: skip

KNOWN_AFTER: Final = 5  # Frames after which their own times and sizes tell more than what is assumed


@dataclass(frozen=True)
class Work:
    """What a run has to do, known from files alone.

    - `new`: whether the session is yet to be made.
    - `done`: numbers of the steps that have their frame.
    - `order`: of the lights, in words.
    - `lights_sha256`: of the file of the lights, hexadecimal.
    - `frame_bytes`, `frame_s`: largest raw file of the session, and median seconds from one frame to the next; None
      where too few were taken.
    """

    folder: Path
    new: bool
    steps: tuple[SessionStep, ...]
    done: frozenset[int]
    order: str
    chart: Chart
    lights: tuple[Illumination, ...]
    lights_sha256: str
    frame_bytes: int | None = None
    frame_s: float | None = None

    @property
    def left(self) -> int:
        """Frames to take."""
        return sum(step.number not in self.done for step in self.steps)


def planned_steps(settings: LabSettings, lights: Sequence[Illumination]) -> tuple[SessionStep, ...]:
    """Return the frames of a new session, in the order that the settings ask for."""
    sequence = settings.sequence
    seed = sequence.seed if sequence.order == "shuffled" else None
    return plan_steps(lights, sequence.reference_every, seed=seed, response=RESPONSE if settings.judge.response else ())


def outline(settings: LabSettings, folder: Path, session: Session | None, retake: str | None = None) -> Work:
    """Return what a run has to do, new in `folder`, or with a session that it takes up.

    Frames that were taken tell their times and sizes. `retake`: what would be taken again (`Session.retake`).
    """
    if session is None:
        if retake is not None:
            raise nothing_to_retake(folder)
        chart, lights = load_chart(settings.chart), load_illuminations(settings.illuminations)
        steps, sha256 = planned_steps(settings, lights), file_sha256(settings.illuminations)
        return Work(folder, True, steps, frozenset(), order_of(steps, settings), chart, lights, sha256)
    require_same(session, settings)
    taken = [frame.taken_at for frame in sorted(session.frames(), key=lambda frame: frame.attempt)]
    gaps = [(after - before).total_seconds() for before, after in pairwise(taken) if after >= before]
    sizes = [frame.size for frame in session.journal.accepted_files()]
    again = {frame.step for frame in session.plan_retake(retake).frames} if retake is not None else set[int]()
    return Work(
        folder,
        False,
        session.steps,
        frozenset(session.done_steps() & {step.number for step in session.steps} - again),
        order_of(session.steps, settings),
        session.chart,
        session.illuminations,
        file_sha256(settings.illuminations),
        max(sizes) if len(sizes) >= KNOWN_AFTER else None,
        statistics.median(gaps) if len(gaps) >= KNOWN_AFTER else None,
    )


def nothing_to_retake(folder: Path) -> InputError:
    """Return the error that says that a session is not there yet."""
    return InputError("nothing was taken yet that could be taken again", about=folder, remedy="leave --retake out")


def require_same(session: Session, settings: LabSettings) -> None:
    """Require that a session is taken up as it was begun: what decides what its frames show is the same."""
    try:
        before = parse_lab(session.settings_text(), str(session.folder / "session.toml"))
    except ConfigurationError as error:
        raise ConfigurationError(f"{error}; restore it from a copy") from error
    for key in FIXED:
        old, new = _value(before, key), _value(settings, key)
        if old != new:
            raise ConfigurationError(
                f"{session.folder} was begun with {key} = {old!r}, {settings.file} says {new!r}",
                remedy="put the old value back, or name a new session folder",
                value=new,
                expected=old,
            )
    if load_chart(settings.chart).sha256 != session.chart.sha256:
        raise ConfigurationError(
            f"{session.folder} was begun with another chart than {settings.chart}",
            remedy="name that, or a new session folder",
        )
    if load_illuminations(settings.illuminations) != session.illuminations:
        raise ConfigurationError(
            f"{session.folder} was begun with other lights than {settings.illuminations}",
            remedy="name those, or a new session folder",
        )


def _value(settings: LabSettings, key: str) -> Any:
    value: Any = settings.model_dump()
    for part in key.split("."):
        value = value[part]
    return value


def order_of(steps: Sequence[SessionStep], settings: LabSettings) -> str:
    """Return in words in which order a plan shows its lights; a session that was begun keeps its own."""
    shown = [step.illumination for step in steps if step.illumination is not None]
    sequence = settings.sequence
    # Which light is at which place of the list decides, not its codes.
    places = [Illumination(index, "uniform", None, BLACK) for index in sorted(shown)]
    wanted = [step.illumination for step in plan_steps(places, 1, seed=sequence.seed) if step.kind == "light"]
    if shown == wanted and sequence.order == "shuffled":
        return f"shuffled by seed {sequence.seed}"
    if shown == sorted(shown):
        return "as listed" + (
            f", as the session was begun; {settings.file} says shuffled" * (sequence.order != "listed")
        )
    if shown == wanted:
        return f"shuffled by seed {sequence.seed}, as the session was begun; {settings.file} says listed"
    return "shuffled by another seed, as the session was begun"


# Frames taken again for which there must be space, as a share of the plan: chosen; disturbances of an hour's run.
RETAKEN_SHARE: Final = 0.1
BESIDE_BYTES: Final = 150_000  # Of each frame: a preview of 640 px, and its rows in the journal
# What is left free beside: the disk's other users, and file systems that slow down when they are full.
SPARE_BYTES: Final = 500_000_000
# Of lossless raw files of 14 bits: 1.34 at ISO 100 (EOS 550D, 25 MB; EOS 6D Mark II, 36 MB), more with noise.
BYTES_PER_PIXEL: Final = 1.5
# Of bodies that may write every photosite in 16 bits (Sony), and of those of the simulated lab, which do.
LOOSE_BYTES_PER_PIXEL: Final = 2.0
UNKNOWN_BYTES: Final = 60_000_000  # Assumed of a body that is not known: 40 million photosites
# Photosites in millions, and the bodies that have no more: the makers' numbers, about a twentieth added for masked
# borders. From general knowledge but for the EOS 550D, 6D Mark II, 5D Mark II, 5DS and 1Ds Mark III.
_MODELS: Final = (
    (0.52, "CroP Test"),
    (18.7, "EOS 550D, EOS REBEL T2i, EOS Kiss X4, EOS 650D, EOS 700D, EOS REBEL T4i, EOS REBEL T5i, "
           "EOS 100D"),
    (19.0, "EOS 600D, EOS REBEL T3i, EOS Kiss X5, EOS 60D, EOS 7D, EOS 1300D, EOS REBEL T6"),
    (22.1, "EOS 5D Mark II, EOS-1Ds Mark III, EOS R6, EOS-1D X Mark III"),
    (23.4, "EOS 5D Mark III"),
    (25.0, "EOS 70D, EOS 6D, EOS 7D Mark II, EOS-1D X, EOS-1D X Mark II, EOS R3, EOS 750D, EOS 760D, "
           "EOS 77D, EOS 80D, EOS 800D, EOS 2000D, EOS REBEL T7, EOS 200D, EOS 250D, EOS R100, EOS R50, "
           "EOS R10, D750, D610, D600, D780, D5600, D7200, Z 5, Z 6, Z 6II, ILCE-7M3, ILCE-6400"),
    (26.9, "EOS 6D Mark II, EOS RP, EOS R8"),
    (31.9, "EOS 5D Mark IV, EOS R"),
    (34.5, "EOS 90D, EOS M6 Mark II, EOS R7, ILCE-7M4"),
    (43.0, "D800, D800E, D810, ILCE-7RM2"),
    (47.4, "EOS R5, D850, Z 7, Z 7II, Z 8, Z 9"),
    (53.5, "EOS 5DS, EOS 5DS R"),
    (62.0, "ILCE-7RM3, ILCE-7RM4, ILCE-7RM5"),
)  # fmt: skip

# Photosites of the bodies that are known, in millions.
MEGAPIXELS: Final = {model: size for size, models in _MODELS for model in models.split(", ")}


@dataclass(frozen=True)
class Estimate:
    """A number, what it rests on, and whether that is more than a guess."""

    value: float
    basis: str
    sure: bool


def frame_bytes(largest: int | None, model: str, given: int | None = None) -> Estimate:
    """Return the size of a raw file, bytes.

    `largest`: of the session so far; None if nothing was taken. `model`: as the body names itself; empty if it could
    not be asked.
    """
    if largest is not None:
        return Estimate(largest, "the largest of the session so far", True)
    if given is not None:
        return Estimate(given, "as the simulated camera writes them", True)
    known = MEGAPIXELS.get(model.removeprefix("Canon ").removeprefix("NIKON "))
    if known is None:
        whom = f"how large a frame of {model} is, is not known" if model else "the camera could not be asked"
        return Estimate(UNKNOWN_BYTES, f"assumed: {whom}; acquire check measures it", False)
    each = LOOSE_BYTES_PER_PIXEL if model.startswith(("ILCE", "CroP ")) else BYTES_PER_PIXEL
    return Estimate(known * 1e6 * each, f"{known:.1f} million photosites, {each:g} bytes each", True)


def needed_bytes(frames: int, frame_bytes: float) -> int:
    """Return the space for `frames` raw files of `frame_bytes`, retakes and a reserve included; 0 for none."""
    if not frames:
        return 0
    return math.ceil(frames * (1 + RETAKEN_SHARE) * (frame_bytes + BESIDE_BYTES)) + SPARE_BYTES


def free_bytes_at(folder: Path) -> int:
    """Return the free space where `folder` is or would be made, bytes."""
    place = folder.absolute()
    try:
        while not place.is_dir() and place != place.parent:
            place = place.parent
        if os.statvfs(place).f_flag & os.ST_RDONLY:
            raise storage_error(folder, OSError(errno.EROFS, os.strerror(errno.EROFS)))
        if not os.access(place, os.W_OK | os.X_OK):
            raise storage_error(folder, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
        return shutil.disk_usage(place).free
    except OSError as error:
        raise storage_error(folder, error, "look at") from error


def bytes_text(number: float, up: bool = False) -> str:
    """Return bytes as GB or MB with a digit; rounded `up` where they are missing.

    Examples
    --------
    >>> bytes_text(25_340_000), bytes_text(1.01e9), bytes_text(1.01e9, up=True)
    ('25.3 MB', '1.0 GB', '1.1 GB')
    """
    unit, name = (1e9, "GB") if number >= 1e9 else (1e6, "MB")
    tenths = number / unit * 10
    return f"{(math.ceil(tenths) if up else round(tenths)) / 10:.1f} {name}"


_T = TypeVar("_T")


@dataclass(frozen=True)
class Answers:
    """What the devices said; None, or empty, where they could not be asked, or do not tell.

    - `offered_s`: shutter times that the camera offers, seconds.
    - `projector`: its name and state, in words.
    - `lit`: whether its lamp burns.
    - `warnings`: what changes the light behind the codes, each with its remedy.
    - `unasked`: what could not be asked, and why.
    - `faults`: what would end the run.
    """

    camera: CameraIdentity | None = None
    offered_s: tuple[float, ...] = ()
    supplies: Supplies | None = None
    projector: str = ""
    lit: bool | None = None
    warnings: tuple[str, ...] = ()
    unasked: tuple[str, ...] = ()
    faults: tuple[CropError, ...] = ()


def ask(devices: Devices) -> Answers:
    """Ask open devices for what a plan needs; a device that does not answer is a fault, the others are asked."""
    faults: list[CropError] = []
    unasked: list[str] = []

    def answer(device: str, question: Callable[[], _T], otherwise: _T) -> _T:
        try:
            return question()
        except DeviceError as fault:
            faults.append(fault_of(device, fault))
            return otherwise

    camera, projector, presenter = devices.camera, devices.projector, devices.presenter
    identity = answer("camera", camera.identity, None)
    offered: tuple[float, ...] = ()
    supplies: Supplies | None = None
    # A camera that cannot be reached is asked once: each question would wait for it.
    if identity is not None:
        offered = answer("camera", camera.shutter_speeds, ())
        if not offered:
            unasked.append("shutter times: the camera lists none")
        if isinstance(camera, ReportsSupplies):
            supplies = answer("camera", camera.supplies, None)
        if supplies is None or (supplies.battery is None and not supplies.mains):
            unasked.append("battery: the camera does not tell; see that it runs on mains power")
        unasked.append("ISO speed and aperture: they are set and verified before the lamp is lit")
    state, lit = "", None
    if projector is not None:
        state, lit = answer("projector", lambda: projector_state(projector), ("", None))
        if lit is not None:
            error = answer("projector", lambda: reported_error(projector), None)
            faults += [] if error is None else [error]
    else:
        unasked.append("lamp: the projector is not under control; switch it on half an hour before")
    warnings: tuple[str, ...] = ()
    if isinstance(presenter, ReportsWarnings):
        warnings = answer("display", presenter.warnings, ())
    return Answers(identity, offered, supplies, state, lit, warnings, tuple(unasked), tuple(faults))


def projector_state(projector: Projector) -> tuple[str, bool | None]:
    """Return who a projector is and how its lamp is, in words; and whether it burns."""
    identity = projector.identity()
    name = " ".join(word for word in (identity.maker, identity.model, identity.name) if word) or "projector"
    hours = ", ".join(f"{lamp.hours} h" for lamp in projector.lamps())
    power = projector.power()
    lit = power is Power.ON
    state = "its lamp burns and is taken as warm" if lit else f"in {power.value}: it will be lit"
    return f"{name}{f', lamp {hours}' if hours else ''}, {state}", lit


# What a cable is assumed to carry before a frame was taken: USB 2.0 carries 30 to 40 million bytes a second.
DOWNLOAD_BYTES_PER_S: Final = 25e6
# What a frame is assumed to need beside light and cable: release, mirror, read-back of the screen, journal.
STEP_S: Final = 0.4
LIGHTING_S: Final = 60.0  # Assumed time from switching on to a lit lamp; makers state 30 to 40 s, and up to 130 s
# At this charge a series of many frames is not begun without mains power: bodies report in steps of a quarter, and
# refuse to release a little later.
LOW_BATTERY: Final = 0.25
FEW_FRAMES: Final = 50  # So many frames are taken on a low battery all the same
# How far a shutter time may lie from one that the body offers, as a share; drivers take no more.
OFFERED_WITHIN: Final = 0.01


@dataclass(frozen=True)
class RunPlan:
    """What a run will take, need and find.

    - `frame_bytes`, `frame_s`: a raw file, bytes, and a frame's time, seconds.
    - `warm_up_s`: of the lamp before the first frame, seconds; of one that is known to burn, none.
    - `free_bytes`: on the disk of the session.
    - `faults`, `doubts`: what would end the run, each with its remedy; what may, a sentence each.
    """

    settings: LabSettings
    work: Work
    answers: Answers
    frame_bytes: Estimate
    frame_s: Estimate
    warm_up_s: float
    free_bytes: int
    faults: tuple[CropError, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def needed_bytes(self) -> int:
        """Space that the run needs, those that are taken again and a reserve included."""
        return needed_bytes(self.work.left, self.frame_bytes.value)

    @property
    def time_s(self) -> float:
        """How long the run will take if nothing goes wrong."""
        return self.work.left * self.frame_s.value + (self.warm_up_s if self.work.left else 0)

    def require(self) -> None:
        """Refuse a run that could not be brought to its end."""
        if self.faults:
            first, *others = self.faults
            raise type(first)("; moreover, ".join([str(first), *map(str, others)]))


def make_plan(
    settings: LabSettings, work: Work, answers: Answers, free_bytes: int, given_bytes: int | None = None
) -> RunPlan:
    """Return the plan of a run, with all that would end it."""
    size = frame_bytes(work.frame_bytes, answers.camera.model if answers.camera is not None else "", given_bytes)
    # A lamp that could not be asked about is taken as cold.
    cold = answers.lit is False or (answers.lit is None and has_lamp_control(settings))
    warm_up_s = LIGHTING_S + settings.sequence.warm_up_s if cold and settings.sequence.warm_up_s > 0 else 0.0
    found = (
        *answers.faults,
        *answers.warnings,
        *settings_doubts(settings),
        _exposure_fault(settings, work, answers),
        _battery_fault(work, answers),
        _card_fault(work, answers, size.value),
        _disk_fault(work, size, free_bytes),
        _black_fault(settings, work),
    )
    return RunPlan(
        settings,
        work,
        answers,
        size,
        _frame_s(settings, work, size.value),
        warm_up_s,
        free_bytes,
        tuple(one for one in found if isinstance(one, CropError)),
        tuple(one for one in found if isinstance(one, str)),
    )


# Settling above which seconds may have been taken for milliseconds: chosen, many times what projectors need.
LONG_SETTLE_S: Final = 10.0
# Warm-up below which a lamp is not yet steady: chosen; makers ask for ten minutes to half an hour.
SHORT_WARM_UP_S: Final = 300.0


def settings_doubts(settings: LabSettings) -> tuple[str, ...]:
    """Return what of the settings may be a mistake that is otherwise found in the night, a sentence each."""
    doubts = [doubt for key, target in _targets(settings) if (doubt := _target_doubt(key, target))]
    settle_s, warm_up_s = settings.sequence.settle_s, settings.sequence.warm_up_s
    if settle_s > LONG_SETTLE_S:
        doubts.append(
            f"sequence.settle_s = {settle_s:g}: each frame waits so many seconds; a projector shows a colour within one"
        )
    if settings.rig == "lab" and has_lamp_control(settings) and warm_up_s < SHORT_WARM_UP_S:
        doubts.append(
            f"sequence.warm_up_s = {warm_up_s:g}: a lamp changes its light for longer, at least "
            f"{SHORT_WARM_UP_S:g} s are expected of one; of a laser or LEDs it may be enough"
        )
    return tuple(doubts)


def _targets(settings: LabSettings) -> tuple[tuple[str, str], ...]:
    return ("sequence.notify", settings.sequence.notify), ("notify.alive", settings.notify.alive)


def _target_doubt(key: str, target: str) -> str:
    """Return why nobody may hear what a target is told; empty where it is a URL, a command that is there, or none."""
    command = shlex.split(target)[:1]
    if is_webhook(target) or not command or shutil.which(command[0]):
        return ""
    label = target_label(target)
    if is_address(target):
        return f"{key}: {label} is no command that is there; an address begins with https://"
    if Path(command[0]).is_file():
        return f"{key}: {command[0]} may not be executed; chmod +x {shlex.quote(command[0])}"
    return f"{key}: {label} is no command that is there; name one by its whole path, or a URL with https://"


def has_lamp_control(settings: LabSettings) -> bool:
    """Return whether a run switches the projector's lamp, and waits until it is warm."""
    return settings.rig != "lab" or settings.lab.projector.control != "none"


def is_offered(shutter_s: float, offered_s: Sequence[float]) -> bool | None:
    """Return whether a body offers a shutter time; None where it lists none. All in seconds."""
    if not offered_s:
        return None
    return any(abs(shutter_s / time - 1) <= OFFERED_WITHIN for time in offered_s)


def _frame_s(settings: LabSettings, work: Work, size: float) -> Estimate:
    if work.frame_s is not None:
        return Estimate(work.frame_s, "median of the session so far", True)
    exposure, settle = settings.camera.shutter_s, settings.sequence.settle_s
    return Estimate(
        exposure + max(settle, size / DOWNLOAD_BYTES_PER_S) + STEP_S,
        f"assumed: exposure {exposure:g} s, settling {settle:g} s while {bytes_text(size)} come at "
        f"{DOWNLOAD_BYTES_PER_S / 1e6:g} MB/s, {STEP_S:g} s beside",
        False,
    )


def _disk_fault(work: Work, size: Estimate, free_bytes: int) -> StorageError | str | None:
    needed = needed_bytes(work.left, size.value)
    missing = needed - free_bytes
    if missing <= 0:
        return None
    sentence = (
        f"the disk of {work.folder} has {bytes_text(free_bytes)} free, the run needs {bytes_text(needed)}: "
        f"{bytes_text(missing, up=True)} are missing; free as much, or name a session folder on another disk"
    )
    return StorageError(sentence) if size.sure else f"{sentence} (the size of a frame is {size.basis})"


def _black_fault(settings: LabSettings, work: Work) -> CropError | None:
    """Return why a new session with a light that is none could never be complete; one that is begun goes on."""
    black = [step.illumination for step in work.steps if step.kind == "light" and not any(step.colour)]
    if work.done or not black:
        return None
    return InputError(
        f"{settings.illuminations}: light {black[0]} has the codes 0, 0, 0: no frame under it can be used; take it out"
    )


def _exposure_fault(settings: LabSettings, work: Work, answers: Answers) -> CropError | None:
    shutter = settings.camera.shutter_s
    if not work.left or is_offered(shutter, answers.offered_s) is not False:
        return None
    near = sorted(answers.offered_s, key=lambda time: abs(math.log(time / shutter)))[:3]
    listed = ", ".join(f"{time:.4g}" for time in sorted(near))
    return DeviceRefused(
        f"camera.shutter_s = {shutter:g}: the body does not offer it; the nearest times that it offers are {listed} s"
    )


def _battery_fault(work: Work, answers: Answers) -> CropError | str | None:
    supplies = answers.supplies
    if supplies is None or supplies.battery is None or supplies.mains or work.left <= FEW_FRAMES:
        return None
    state = f"the camera's battery is at {supplies.battery:.0%}"
    frames = counted(work.left, "frame is", "frames are")
    if supplies.battery <= LOW_BATTERY:
        return DeviceFault(f"{state}, and {frames} to be taken; connect a mains adapter, or charge it")
    return f"{state}, and {frames} to be taken: a charge lasts for some hundred; better connect a mains adapter"


def _card_fault(work: Work, answers: Answers, size: float) -> CropError | None:
    supplies = answers.supplies
    if supplies is None or supplies.saves_to_host or supplies.card_free_bytes is None:
        return None
    needed = math.ceil(work.left * (1 + RETAKEN_SHARE) * size)
    missing = needed - supplies.card_free_bytes
    if missing <= 0:
        return None
    return DeviceFault(
        f"the camera's card has {bytes_text(supplies.card_free_bytes)} free, and frames stay on it: "
        f"{bytes_text(missing, up=True)} are missing; put in an empty card of {bytes_text(needed, up=True)}"
    )


def plan_lines(plan: RunPlan) -> tuple[str, ...]:
    """Return the plan as text: in each line what is meant, and what is known of it; `RunPlan.require` tells faults."""
    work, settings, answers = plan.work, plan.settings, plan.answers
    count = counted(work.left, "frame")
    lines = [
        ("session", f"{work.folder}: {'new' if work.new else 'taken up again'}, {_kinds(work)}"),
        ("order", work.order),
        ("chart", f"{settings.chart}: {work.chart.colour_count} colours, SHA-256 {work.chart.sha256[:16]}"),
        ("lights", f"{settings.illuminations}: {len(work.lights)}, SHA-256 {work.lights_sha256[:16]}"),
        ("exposure", _exposure(plan)),
        ("time", _time(plan, count)),
        ("disk", _disk(plan, count)),
        ("camera", _camera(answers)),
        (
            "projector",
            answers.projector or ("could not be asked" if has_lamp_control(settings) else "not under control"),
        ),
    ]
    for name, (_, target) in zip(("notices", "alive"), _targets(settings), strict=True):
        if target:
            lines.append((name, f"to {target_label(target)}"))
    lines += [("not asked", sentence) for sentence in answers.unasked]
    lines += [("doubt", sentence) for sentence in plan.doubts]
    return tuple(f"{name:<11} {text}" for name, text in lines)


def _exposure(plan: RunPlan) -> str:
    exposure = plan.settings.camera
    said = {
        True: "the body offers this time",
        False: "the body does not offer this time",
        None: "whether the body offers this time is not known",
    }
    offered = said[is_offered(exposure.shutter_s, plan.answers.offered_s)]
    return f"{exposure.exposure}{_turns(plan.settings)}; {offered}"


def _time(plan: RunPlan, count: str) -> str:
    if not plan.work.left:
        return "nothing is left to take"
    known = "" if plan.answers.lit is not None else ", if it does not burn yet"
    warm_up = f", after {duration_text(plan.warm_up_s)} until the lamp is warm{known}" if plan.warm_up_s else ""
    each = f"{plan.frame_s.value:.2f} s each ({plan.frame_s.basis})"
    return f"{duration_text(plan.time_s)}: {count}, {each}{warm_up}"


def _disk(plan: RunPlan, count: str) -> str:
    free = f"{bytes_text(plan.free_bytes)} free"
    if not plan.work.left:
        return f"nothing needed, {free}"
    return (
        f"{bytes_text(plan.needed_bytes)} needed for {count} of {bytes_text(plan.frame_bytes.value)} "
        f"({plan.frame_bytes.basis}), {RETAKEN_SHARE:.0%} taken again and a reserve; {free}"
    )


def _camera(answers: Answers) -> str:
    if answers.camera is None:
        return "could not be asked"
    text = answers.camera.name
    if answers.camera.serial:
        text += f", serial number {answers.camera.serial}"
    supplies = answers.supplies
    if supplies is None:
        return text
    if supplies.mains:
        text += ", on mains power"
    elif supplies.battery is not None:
        text += f", battery {supplies.battery:.0%}"
    text += ", frames go to this computer" if supplies.saves_to_host else ", frames stay on its card"
    if supplies.card_free_bytes is not None:
        text += f", card {bytes_text(supplies.card_free_bytes)} free"
    return text


def _kinds(work: Work) -> str:
    todo = Counter(step.kind for step in work.steps if step.number not in work.done)
    parts = ", ".join(f"{todo[kind]} {kind}" for kind in KINDS if todo[kind])
    done = f"{counted(len(work.done), 'frame')} of {len(work.steps)} done"
    return f"{counted(work.left, 'frame')} to take ({parts}); {done}" if work.left else f"complete; {done}"


def _turns(settings: LabSettings) -> str:
    """Return how many turns of the colour wheel, or pictures, an exposure holds; empty where the light is steady."""
    wheel = wheel_of(settings)
    if settings.rig != "lab" and not wheel:
        return ""
    period, unit = period_s(settings), "turn of the colour wheel" if wheel else "picture"
    turns = settings.camera.shutter_s / period
    plural = unit.replace("turn ", "turns ").replace("picture", "pictures")
    if holds_whole_turns(settings.camera.shutter_s, period):
        return f" = {counted(round(turns), unit, plural)}"
    return f" = {turns:.2f} {plural}, which are not whole"


def dry_run(settings: LabSettings, folder: Path, retake: str | None = None) -> RunPlan:
    """Return the plan of the run that `settings` and `folder` would begin; devices that cannot be opened are faults."""
    with ExitStack() as opened:
        session = opened.enter_context(Session.open(folder)) if session_exists(folder) else None
        if session is not None:
            require_frames_folder(folder)
        work = outline(settings, folder, session, retake)
        try:
            devices = opened.enter_context(open_rig(settings, work.chart, session, shows=False))
        except CropError as fault:
            return make_plan(settings, work, Answers(faults=(fault,)), free_bytes_at(folder))
        return make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings))


def require_plan(settings: LabSettings, folder: Path, session: Session | None, devices: Devices) -> None:
    """Refuse a run, whose devices are open and have not moved, that could not be brought to its end.

    `session`: what is taken up; None where a new one is to be made in `folder`.
    """
    work = outline(settings, folder, session)
    make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings)).require()
