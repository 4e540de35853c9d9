"""Plan a run: its frames, the time and disk space that it needs, and faults that would end it.

The plan is made before a device is used. It is based on files (`Work`), on estimates of size and time (`Estimate`), and
on answers of the devices (`Answers`), which are only queried, not changed. A dry run prints the plan (`plan_lines`). A
run does not start if its plan has a fault, that is a problem that would end it. A doubt is only a warning.
"""

from __future__ import annotations

import math
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
    holds_whole_turns,
    period_s,
    reported_error,
    wheel_of,
    with_device_name,
)
from acquisition.run.rig.opening import known_frame_bytes, open_rig
from drivers.camera import CameraIdentity, ReportsSupplies, Supplies
from drivers.presenter import BLACK, ReportsWarnings
from drivers.projector import Power, Projector
from experiment.chart.model import Chart, load_chart
from experiment.config import LabSettings, parse_lab
from experiment.lights import Illuminant, load_illuminants
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
from foundation.files import file_sha256
from foundation.folders import bytes_text, free_bytes_at
from foundation.secret_texts import is_address, is_webhook, target_label

# Settings that must not change during a session, because they change its frames.
FIXED: Final = (
    "rig", "camera", "simulated.body", "simulated.camera", "simulated.seed", "simulated.room",
    "sequence.reference_every",
)  # fmt: skip

KNOWN_AFTER: Final = 5  # Smallest number of frames from which times and sizes are measured instead of assumed


@dataclass(frozen=True)
class Work:
    """Frames, chart and illuminants of a run, as read from files.

    - `new`: whether the session does not exist yet.
    - `done`: numbers of the steps with an accepted frame.
    - `order`: order of the illuminants, in words.
    - `lights_sha256`: hash of the file of the illuminants, hexadecimal.
    - `frame_bytes`, `frame_s`: largest raw file of the session, and median interval between frames, s; None with too
      few frames.
    """

    folder: Path
    new: bool
    steps: tuple[SessionStep, ...]
    done: frozenset[int]
    order: str
    chart: Chart
    lights: tuple[Illuminant, ...]
    lights_sha256: str
    frame_bytes: int | None = None
    frame_s: float | None = None

    @property
    def remaining(self) -> int:
        """Number of frames to take."""
        return sum(step.number not in self.done for step in self.steps)


def planned_steps(settings: LabSettings, lights: Sequence[Illuminant]) -> tuple[SessionStep, ...]:
    """Return the frames of a new session, in the order of the settings."""
    sequence = settings.sequence
    seed = sequence.seed if sequence.order == "shuffled" else None
    return plan_steps(lights, sequence.reference_every, seed=seed, response=RESPONSE if settings.judge.response else ())


def outline(settings: LabSettings, folder: Path, session: Session | None, retake: str | None = None) -> Work:
    """Return the work of a run: a new session in `folder`, or the rest of a session.

    `retake`: frames to repeat (`Session.retake`).
    """
    if session is None:
        if retake is not None:
            raise nothing_to_retake(folder)
        chart, lights = load_chart(settings.chart), load_illuminants(settings.illuminations)
        steps, sha256 = planned_steps(settings, lights), file_sha256(settings.illuminations)
        return Work(folder, True, steps, frozenset(), order_of(steps, settings), chart, lights, sha256)
    require_same(session, settings)
    times = [frame.taken_at for frame in sorted(session.frames(), key=lambda frame: frame.attempt)]
    gaps = [(following - earlier).total_seconds() for earlier, following in pairwise(times) if following >= earlier]
    sizes = [frame.size for frame in session.journal.accepted_files()]
    retaken_steps = {frame.step for frame in session.plan_retake(retake).frames} if retake is not None else set[int]()
    return Work(
        folder,
        False,
        session.steps,
        frozenset(session.done_steps() & {step.number for step in session.steps} - retaken_steps),
        order_of(session.steps, settings),
        session.chart,
        session.illuminations,
        file_sha256(settings.illuminations),
        max(sizes) if len(sizes) >= KNOWN_AFTER else None,
        statistics.median(gaps) if len(gaps) >= KNOWN_AFTER else None,
    )


def nothing_to_retake(folder: Path) -> InputError:
    """Return the error for a retake in a session that does not exist."""
    return InputError("the session has no frames to repeat yet", about=folder, remedy="omit --retake")


def require_same(session: Session, settings: LabSettings) -> None:
    """Require that chart, illuminants and the settings in `FIXED` are the same as at the start of the session."""
    try:
        earlier = parse_lab(session.settings_text(), str(session.folder / "session.toml"))
    except ConfigurationError as error:
        raise ConfigurationError(f"{error}; restore it from a copy") from error
    for key in FIXED:
        old, new = _value(earlier, key), _value(settings, key)
        if old != new:
            raise ConfigurationError(
                f"{settings.file} has {key} = {new!r}, but {session.folder} was started with {old!r}",
                remedy="restore the old value, or give a new session folder",
                value=new,
                expected=old,
            )
    if load_chart(settings.chart).sha256 != session.chart.sha256:
        raise ConfigurationError(
            f"{session.folder} was started with another chart than {settings.chart}",
            remedy="give the chart of the session (its chart.json), or a new session folder",
        )
    if load_illuminants(settings.illuminations) != session.illuminations:
        raise ConfigurationError(
            f"{session.folder} was started with other illuminants than {settings.illuminations}",
            remedy="give the illuminants of the session (its illuminations.csv), or a new session folder",
        )


def _value(settings: LabSettings, key: str) -> Any:
    value: Any = settings.model_dump()
    for name in key.split("."):
        value = value[name]
    return value


def order_of(steps: Sequence[SessionStep], settings: LabSettings) -> str:
    """Return the order of the illuminants in words; an existing session keeps its order."""
    indices = [step.illumination for step in steps if step.illumination is not None]
    sequence = settings.sequence
    # The order depends on the indices, not on the codes.
    listed = [Illuminant(index, "uniform", None, BLACK) for index in sorted(indices)]
    shuffled = [step.illumination for step in plan_steps(listed, 1, seed=sequence.seed) if step.kind == "light"]
    if indices == shuffled and sequence.order == "shuffled":
        return f"shuffled by seed {sequence.seed}"
    if indices == sorted(indices):
        return "as listed" + (
            f", kept from the start of the session; {settings.file} has 'shuffled'" * (sequence.order != "listed")
        )
    if indices == shuffled:
        return f"shuffled by seed {sequence.seed}, kept from the start of the session; {settings.file} has 'listed'"
    return "shuffled by another seed, kept from the start of the session"


# A run reserves space to repeat this fraction of the frames. Chosen by judgement.
RETAKEN_SHARE: Final = 0.1
EXTRA_BYTES: Final = 150_000  # Space for the preview of a frame and its rows in the journal, bytes
# Space that remains free, bytes, because other programs need it and full disks are slow.
SPARE_BYTES: Final = 500_000_000
# Assumed size of lossless 14-bit raw files, bytes per photosite. At ISO 100, an EOS 550D needs 1.34; noise adds more.
BYTES_PER_PIXEL: Final = 1.5
# Assumed size for cameras that may write 16 bits per photosite (Sony), and for the simulated cameras, bytes.
PADDED_BYTES_PER_PIXEL: Final = 2.0
UNKNOWN_BYTES: Final = 60_000_000  # Assumed size of a raw file of an unknown camera, bytes
# Millions of photosites, and models with at most this number. It is the maker's number plus 5 % for borders.
# Only the numbers of the EOS 550D, 6D Mark II, 5D Mark II, 5DS and 1Ds Mark III were verified.
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

# Millions of photosites of known models.
MEGAPIXELS: Final = {model: size for size, models in _MODELS for model in models.split(", ")}


@dataclass(frozen=True)
class Estimate:
    """A value, its basis in words, and whether it is reliable or only an assumption."""

    value: float
    basis: str
    sure: bool


def frame_bytes(largest: int | None, model: str, simulated: int | None = None) -> Estimate:
    """Return the size of a raw file, bytes.

    `largest`: largest file of the session; None if it has none. `model`: as the camera reports it; "" if the
    camera did not answer. `simulated`: size of simulated files; None for a real camera.
    """
    if largest is not None:
        return Estimate(largest, "the largest file of the session", True)
    if simulated is not None:
        return Estimate(simulated, "size of the simulated files", True)
    megapixels = MEGAPIXELS.get(model.removeprefix("Canon ").removeprefix("NIKON "))
    if megapixels is None:
        cause = f"the size of a frame of {model} is unknown" if model else "the camera did not answer"
        return Estimate(UNKNOWN_BYTES, f"assumed, because {cause}; acquire check measures it", False)
    density = PADDED_BYTES_PER_PIXEL if model.startswith(("ILCE", "CroP ")) else BYTES_PER_PIXEL
    return Estimate(megapixels * 1e6 * density, f"{megapixels:.1f} million photosites, {density:g} bytes each", True)


def needed_bytes(frames: int, frame_bytes: float) -> int:
    """Return the space for `frames` raw files of `frame_bytes`, with retakes and reserve; 0 for no frames."""
    if not frames:
        return 0
    return math.ceil(frames * (1 + RETAKEN_SHARE) * (frame_bytes + EXTRA_BYTES)) + SPARE_BYTES


_T = TypeVar("_T")


@dataclass(frozen=True)
class Answers:
    """Answers of the devices; None or empty if a device did not answer, or does not report the value.

    - `offered_s`: shutter times that the camera offers, s.
    - `projector`: name and state, in words.
    - `lit`: whether the lamp is on.
    - `warnings`: settings that change the colours on the screen, each with its remedy.
    - `unasked`: values that are not reported or not queried, each with the reason.
    - `faults`: faults that would end the run.
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
    """Query the devices for a plan; a device that does not answer is a fault."""
    faults: list[CropError] = []
    unasked: list[str] = []

    def answer(device: str, question: Callable[[], _T], default: _T) -> _T:
        try:
            return question()
        except DeviceError as fault:
            faults.append(with_device_name(device, fault))
            return default

    camera, projector, presenter = devices.camera, devices.projector, devices.presenter
    identity = answer("camera", camera.identity, None)
    offered: tuple[float, ...] = ()
    supplies: Supplies | None = None
    # A camera that does not answer is queried only once, because each query would time out.
    if identity is not None:
        offered = answer("camera", camera.shutter_speeds, ())
        if not offered:
            unasked.append("shutter times: the camera does not list them")
        if isinstance(camera, ReportsSupplies):
            supplies = answer("camera", camera.supplies, None)
        if supplies is None or (supplies.battery is None and not supplies.mains):
            unasked.append("battery: the camera does not report it; make sure that it runs on mains power")
        unasked.append("ISO speed and aperture: the run sets and verifies them before it switches the lamp on")
    state, lit = "", None
    if projector is not None:
        state, lit = answer("projector", lambda: projector_state(projector), ("", None))
        if lit is not None:
            error = answer("projector", lambda: reported_error(projector), None)
            faults += [] if error is None else [error]
    else:
        unasked.append("lamp: the projector is not controlled; switch it on half an hour before the run")
    warnings: tuple[str, ...] = ()
    if isinstance(presenter, ReportsWarnings):
        warnings = answer("display", presenter.warnings, ())
    return Answers(identity, offered, supplies, state, lit, warnings, tuple(unasked), tuple(faults))


def projector_state(projector: Projector) -> tuple[str, bool | None]:
    """Return name and state of a projector in words, and whether its lamp is on."""
    identity = projector.identity()
    name = " ".join(word for word in (identity.maker, identity.model, identity.name) if word) or "projector"
    hours = ", ".join(f"{lamp.hours} h" for lamp in projector.lamps())
    power = projector.power()
    lit = power is Power.ON
    state = "its lamp is on and assumed to be warm" if lit else f"in {power.value}: it will be switched on"
    return f"{name}{f', lamp {hours}' if hours else ''}, {state}", lit


# Assumed transfer rate, as long as none is measured. USB 2.0 transfers 30 to 40 million bytes per second.
DOWNLOAD_BYTES_PER_S: Final = 25e6
# Assumed time of a frame in addition to exposure and transfer, s: mirror, read-back of the screen, journal.
STEP_S: Final = 0.4
LIGHTING_S: Final = 60.0  # Assumed time until the lamp is lit, s; makers state 30 to 130 s
# Battery level at which a long run is refused. Cameras report the level in steps of a quarter, and a camera at this
# step soon stops.
LOW_BATTERY: Final = 0.25
FEW_FRAMES: Final = 50  # Number of frames that are taken even with a low battery
# Largest relative difference between a shutter time and the nearest time that the camera offers. Drivers accept no
# larger difference.
OFFERED_WITHIN: Final = 0.01


@dataclass(frozen=True)
class RunPlan:
    """Time and space that a run needs, and faults that would end it.

    - `frame_bytes`, `frame_s`: size of a raw file, bytes, and time of a frame, s.
    - `warm_up_s`: warm-up of the lamp before the first frame, s; 0 if the lamp is on.
    - `free_bytes`: free space on the disk of the session.
    - `faults`: faults that would end the run, each with its remedy.
    - `doubts`: warnings.
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
        """Space for the run, with retakes and reserve, bytes."""
        return needed_bytes(self.work.remaining, self.frame_bytes.value)

    @property
    def time_s(self) -> float:
        """Duration of the run without disturbances, s."""
        return self.work.remaining * self.frame_s.value + (self.warm_up_s if self.work.remaining else 0)

    def require(self) -> None:
        """Raise all faults as one error."""
        if self.faults:
            first, *more_faults = self.faults
            raise type(first)("; in addition, ".join([str(first), *map(str, more_faults)]))


def make_plan(
    settings: LabSettings, work: Work, answers: Answers, free_bytes: int, given_bytes: int | None = None
) -> RunPlan:
    """Return the plan of a run with all its faults."""
    size = frame_bytes(work.frame_bytes, answers.camera.model if answers.camera is not None else "", given_bytes)
    # If the state of the lamp is unknown, it is assumed to be cold.
    is_cold = answers.lit is False or (answers.lit is None and has_lamp_control(settings))
    warm_up_s = LIGHTING_S + settings.sequence.warm_up_s if is_cold and settings.sequence.warm_up_s > 0 else 0.0
    problems = (
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
        tuple(problem for problem in problems if isinstance(problem, CropError)),
        tuple(problem for problem in problems if isinstance(problem, str)),
    )


# Longest plausible settling time, s. Chosen by judgement: a longer one was probably given in milliseconds.
LONG_SETTLE_S: Final = 10.0
# Shortest warm-up without a warning, s. It is half of the shortest time that makers recommend (10 to 30 minutes).
SHORT_WARM_UP_S: Final = 300.0


def settings_doubts(settings: LabSettings) -> tuple[str, ...]:
    """Return warnings about settings that may be mistakes, one sentence for each."""
    doubts = [doubt for key, target in _targets(settings) if (doubt := _target_doubt(key, target))]
    settle_s, warm_up_s = settings.sequence.settle_s, settings.sequence.warm_up_s
    if settle_s > LONG_SETTLE_S:
        doubts.append(
            f"sequence.settle_s = {settle_s:g} s, but a projector shows a colour within 1 s; check the unit (seconds)"
        )
    if settings.rig == "lab" and has_lamp_control(settings) and warm_up_s < SHORT_WARM_UP_S:
        doubts.append(
            f"sequence.warm_up_s = {warm_up_s:g} s, expected at least {SHORT_WARM_UP_S:g} s for a lamp; ignore this "
            "for a laser or LEDs"
        )
    return tuple(doubts)


def _targets(settings: LabSettings) -> tuple[tuple[str, str], ...]:
    return ("sequence.notify", settings.sequence.notify), ("notify.alive", settings.notify.alive)


def _target_doubt(key: str, target: str) -> str:
    """Return why notices may not reach a target; "" if it is a URL, an executable command, or empty."""
    command = shlex.split(target)[:1]
    if is_webhook(target) or not command or shutil.which(command[0]):
        return ""
    label = target_label(target)
    if is_address(target):
        return f"{key}: the command {label} does not exist; if it is an address, start it with https://"
    if Path(command[0]).is_file():
        return f"{key}: {command[0]} is not executable; run chmod +x {shlex.quote(command[0])}"
    return f"{key}: the command {label} does not exist; give its full path, or a URL with https://"


def has_lamp_control(settings: LabSettings) -> bool:
    """Return whether a run switches the lamp of the projector, and waits for its warm-up."""
    return settings.rig != "lab" or settings.lab.projector.control != "none"


def is_offered(shutter_s: float, offered_s: Sequence[float]) -> bool | None:
    """Return whether a camera offers a shutter time; None if it lists no times. All times are in s."""
    if not offered_s:
        return None
    return any(abs(shutter_s / time - 1) <= OFFERED_WITHIN for time in offered_s)


def _frame_s(settings: LabSettings, work: Work, size: float) -> Estimate:
    if work.frame_s is not None:
        return Estimate(work.frame_s, "median of the session", True)
    exposure, settle = settings.camera.shutter_s, settings.sequence.settle_s
    return Estimate(
        exposure + max(settle, size / DOWNLOAD_BYTES_PER_S) + STEP_S,
        f"assumed: exposure {exposure:g} s, settling {settle:g} s during the transfer of {bytes_text(size)} at "
        f"{DOWNLOAD_BYTES_PER_S / 1e6:g} MB/s, other steps {STEP_S:g} s",
        False,
    )


def _disk_fault(work: Work, size: Estimate, free_bytes: int) -> StorageError | str | None:
    needed = needed_bytes(work.remaining, size.value)
    missing = needed - free_bytes
    if missing <= 0:
        return None
    sentence = (
        f"the disk of {work.folder} has {bytes_text(free_bytes)} free, but the run needs {bytes_text(needed)}: "
        f"{bytes_text(missing, up=True)} are missing; free space, or give a session folder on another disk"
    )
    return StorageError(sentence) if size.sure else f"{sentence} (the size of a frame is {size.basis})"


def _black_fault(settings: LabSettings, work: Work) -> CropError | None:
    black = [step.illumination for step in work.steps if step.kind == "light" and not any(step.colour)]
    if work.done or not black:
        return None
    return InputError(
        f"{settings.illuminations}: illuminant {black[0]} has the codes 0, 0, 0, which give no usable frame; delete it"
    )


def _exposure_fault(settings: LabSettings, work: Work, answers: Answers) -> CropError | None:
    shutter = settings.camera.shutter_s
    if not work.remaining or is_offered(shutter, answers.offered_s) is not False:
        return None
    nearest = sorted(answers.offered_s, key=lambda time: abs(math.log(time / shutter)))[:3]
    times = ", ".join(f"{time:.4g}" for time in sorted(nearest))
    return DeviceRefused(
        f"camera.shutter_s = {shutter:g} s is not offered by the camera; set one of the nearest times, {times} s"
    )


def _battery_fault(work: Work, answers: Answers) -> CropError | str | None:
    supplies = answers.supplies
    if supplies is None or supplies.battery is None or supplies.mains or work.remaining <= FEW_FRAMES:
        return None
    state = f"the camera's battery is at {supplies.battery:.0%}"
    frames = counted(work.remaining, "frame is", "frames are")
    if supplies.battery <= LOW_BATTERY:
        return DeviceFault(f"{state}, and {frames} to be taken; connect a mains adapter, or charge the battery")
    return (
        f"{state}, and {frames} to be taken, but a charge is enough for a few hundred frames; connect a mains adapter"
    )


def _card_fault(work: Work, answers: Answers, size: float) -> CropError | None:
    supplies = answers.supplies
    if supplies is None or supplies.saves_to_host or supplies.card_free_bytes is None:
        return None
    needed = math.ceil(work.remaining * (1 + RETAKEN_SHARE) * size)
    missing = needed - supplies.card_free_bytes
    if missing <= 0:
        return None
    return DeviceFault(
        f"the camera's card, where frames are saved, has {bytes_text(supplies.card_free_bytes)} free, but the run "
        f"needs {bytes_text(needed, up=True)}: {bytes_text(missing, up=True)} are missing; insert an empty card"
    )


def plan_lines(plan: RunPlan) -> tuple[str, ...]:
    """Return the plan as lines of name and content, without its faults."""
    work, settings, answers = plan.work, plan.settings, plan.answers
    count = counted(work.remaining, "frame")
    lines = [
        ("session", f"{work.folder}: {'new' if work.new else 'resumed'}, {_frames_text(work)}"),
        ("order", work.order),
        ("chart", f"{settings.chart}: {work.chart.colour_count} colours, SHA-256 {work.chart.sha256[:16]}"),
        ("illuminants", f"{settings.illuminations}: {len(work.lights)}, SHA-256 {work.lights_sha256[:16]}"),
        ("exposure", _exposure_text(plan)),
        ("time", _time_text(plan, count)),
        ("disk", _disk_text(plan, count)),
        ("camera", _camera_text(answers)),
        (
            "projector",
            answers.projector or ("did not answer" if has_lamp_control(settings) else "not controlled"),
        ),
    ]
    for name, (_, target) in zip(("notices", "alive"), _targets(settings), strict=True):
        if target:
            lines.append((name, f"to {target_label(target)}"))
    lines += [("not checked", sentence) for sentence in answers.unasked]
    lines += [("doubt", sentence) for sentence in plan.doubts]
    return tuple(f"{name:<11} {text}" for name, text in lines)


def _exposure_text(plan: RunPlan) -> str:
    exposure = plan.settings.camera
    texts = {
        True: "the camera offers this time",
        False: "the camera does not offer this time",
        None: "it is unknown whether the camera offers this time",
    }
    offered = texts[is_offered(exposure.shutter_s, plan.answers.offered_s)]
    return f"{exposure.exposure}{_turns_text(plan.settings)}; {offered}"


def _time_text(plan: RunPlan, count: str) -> str:
    if not plan.work.remaining:
        return "all frames are complete"
    condition = "" if plan.answers.lit is not None else ", unless it is already on"
    warm_up = f", after {duration_text(plan.warm_up_s)} to warm up the lamp{condition}" if plan.warm_up_s else ""
    frame_s = f"{plan.frame_s.value:.2f} s each ({plan.frame_s.basis})"
    return f"{duration_text(plan.time_s)}: {count}, {frame_s}{warm_up}"


def _disk_text(plan: RunPlan, count: str) -> str:
    free_text = f"{bytes_text(plan.free_bytes)} free"
    if not plan.work.remaining:
        return f"no space needed, {free_text}"
    return (
        f"{bytes_text(plan.needed_bytes)} needed for {count} of {bytes_text(plan.frame_bytes.value)} "
        f"({plan.frame_bytes.basis}), {RETAKEN_SHARE:.0%} retakes and a reserve; {free_text}"
    )


def _camera_text(answers: Answers) -> str:
    if answers.camera is None:
        return "did not answer"
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
    text += ", saves frames on this computer" if supplies.saves_to_host else ", saves frames on its card"
    if supplies.card_free_bytes is not None:
        text += f", card {bytes_text(supplies.card_free_bytes)} free"
    return text


def _frames_text(work: Work) -> str:
    counts = Counter(step.kind for step in work.steps if step.number not in work.done)
    kinds_text = ", ".join(f"{counts[name]} {name}" for name in KINDS if counts[name])
    open_text = f"{counted(work.remaining, 'frame')} to take ({kinds_text})" if work.remaining else "complete"
    return f"{open_text}; {counted(len(work.done), 'frame')} of {len(work.steps)} done"


def _turns_text(settings: LabSettings) -> str:
    """Return the turns of the colour wheel, or the display refreshes, in an exposure; "" for a steady light."""
    wheel = wheel_of(settings)
    if settings.rig != "lab" and not wheel:
        return ""
    period, unit = period_s(settings), "turn of the colour wheel" if wheel else "refresh of the display"
    turns = settings.camera.shutter_s / period
    plural = unit.replace("turn ", "turns ").replace("refresh ", "refreshes ")
    if holds_whole_turns(settings.camera.shutter_s, period):
        return f" = {counted(round(turns), unit, plural)}"
    return f" = {turns:.2f} {plural}, which is not a whole number"


def dry_run(settings: LabSettings, folder: Path, retake: str | None = None) -> RunPlan:
    """Return the plan of a run without taking frames; a device that cannot be opened is a fault."""
    with ExitStack() as opened:
        session = opened.enter_context(Session.open(folder)) if session_exists(folder) else None
        if session is not None:
            require_frames_folder(folder)
        work = outline(settings, folder, session, retake)
        try:
            devices = opened.enter_context(open_rig(settings, work.chart, session, opens_display=False))
        except CropError as fault:
            return make_plan(settings, work, Answers(faults=(fault,)), free_bytes_at(folder))
        return make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings))


def require_plan(settings: LabSettings, folder: Path, session: Session | None, devices: Devices) -> None:
    """Refuse a run that could not be completed. Its devices must be open, but not used yet.

    `session`: the resumed session; None for a new one in `folder`.
    """
    work = outline(settings, folder, session)
    make_plan(settings, work, ask(devices), free_bytes_at(folder), known_frame_bytes(settings)).require()
