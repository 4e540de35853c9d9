"""Efficiency of a session: unavoidable time for exposure, settling and download, divided by the time taken.

`python -m benchmarks.sequencer` prints one JSON object per result and line:

- the efficiency in simulated time, for 767 frames (707 illuminants with references) in the layout of EOS 550D CR2
  files, with latencies of a camera, a screen and a projector. Each file is written, flushed, hashed and decoded;
- the efficiency in real time on this machine, for frames of 25 MB at 30 MB/s, an exposure of 0.5 s and settling of 0.2
  s. Each file is decoded and judged;
- the time to save, hash and judge a frame, compared with a few lines of code that write, flush and hash the same bytes.

``quick`` takes a tenth of the frames in simulated time, in some minutes. Frames are judged as in a session
(`acquisition.judge.judge.LiveJudge`); with the word ``exposure`` only their exposure is judged.

The unavoidable time of a frame is the time for release, exposure and readout, plus the longer of settling and download.
A camera does not expose while it sends a file. The illuminant may change when the camera has announced the frame.

Simplifications: All frames are copies of two prepared files, a dark and a lit one, with the slices of a 550D and
without previews. Cable and camera use no processor time, latencies are constant, and no frame is refused. The judge
measures and compares each frame as in a session without primaries; its message that the illuminant does not change is
ignored. In simulated time, work of this machine takes no time. The results in real time include this work.
"""

from __future__ import annotations

import hashlib
import json
import os
import statistics
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

import numpy as np

from acquisition.judge.judge import LiveJudge
from acquisition.judge.measure import ExposureJudge
from acquisition.run.devices import Devices
from acquisition.run.pipeline import Taken
from acquisition.run.run import take_session
from benchmarks import parse_words
from calibration.figures.light import OFF_CODES_DEG
from calibration.figures.single_frames import REPEATED
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity
from experiment.chart.layout import design_chart
from experiment.config import LabSettings, SequenceSettings
from experiment.lights import Illuminant, plan_illuminants
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.clock import SIM_START, Clock, SimulatedClock, SystemClock
from sim.world.sensors import BODIES
from tests.drivers.raw.raw_files import write_cr2

BODY = BODIES["EOS 550D"]
EXPOSURE = ExposureSettings(100, 8.0, 0.5)
LIGHTS = plan_illuminants(35, list(range(2000, 10001, 200)))
# Illuminants of the session in real time: some tens of frames, one minute.
REAL_LIGHTS = 36
# Slices of the lossless JPEG of an EOS 550D: two of the first width, one of the last, together 5344 columns.
SLICES = (2, 1728, 1888)
# Number of files in the comparison with plain saving.
SAVED = 12


@dataclass(frozen=True)
class Latencies:
    """Latencies of the devices."""

    release_s: float = 0.08  # command to open shutter: mirror and two messages (60D: 2 to 40 ms each)
    readout_s: float = 0.783  # closed shutter to announcement, EOS 550D (`sim.camera.bodies`)
    bytes_per_s: float = 27.5e6  # of the cable; USB 2.0 transfers 25 to 40 MB/s
    show_s: float = 1.5 / 60  # call to confirmed colour: one or two images at 60 Hz
    verify_s: float = 0.008  # reading the screen back
    question_s: float = 0.004  # one answer of a network projector; a frame needs five


class PacedScreen:
    """A screen that stores the colour, with realistic delays."""

    def __init__(self, clock: Clock, latencies: Latencies) -> None:
        self.clock, self.latencies = clock, latencies
        self.colour = BLACK

    def show(self, colour: Colour) -> None:
        """Show a colour."""
        self.clock.sleep(self.latencies.show_s)
        self.colour = colour

    def verify(self, colour: Colour) -> None:
        """Read the screen back."""
        self.clock.sleep(self.latencies.verify_s)
        assert colour == self.colour

    def close(self) -> None:
        """Do nothing."""


class PacedProjector:
    """A projector without faults that answers with realistic delays."""

    def __init__(self, clock: Clock, latencies: Latencies) -> None:
        self.clock, self.latencies = clock, latencies
        self.state = Power.ON

    def _ask(self) -> None:
        self.clock.sleep(self.latencies.question_s)

    def identity(self) -> ProjectorIdentity:
        """Return a name."""
        return ProjectorIdentity("CroP", "paced", "")

    def power(self) -> Power:
        """Report a lit lamp, or a cooling one after `switch_off`."""
        self._ask()
        return self.state

    def switch_on(self) -> None:
        """Do nothing."""

    def switch_off(self) -> None:
        """Start cooling. If the projector stayed on, the run would wait five seconds, a tenth of a short session."""
        self.state = Power.COOLING

    def muted(self) -> bool:
        """Report that the image is visible."""
        self._ask()
        return False

    def set_muted(self, muted: bool) -> None:
        """Do nothing."""

    def faults(self) -> tuple[Fault, ...]:
        """Report no faults."""
        self._ask()
        return ()

    def picture_fault(self) -> str | None:
        """Report no fault; signal and freeze are two requests."""
        self._ask()
        self._ask()
        return None

    def lamps(self) -> tuple[Lamp, ...]:
        """Return none."""
        return ()

    def close(self) -> None:
        """Do nothing."""


class PacedCamera:
    """A camera that delivers prepared files with realistic delays."""

    def __init__(self, screen: PacedScreen, clock: Clock, latencies: Latencies, files: dict[str, bytes]) -> None:
        self.screen, self.clock, self.latencies, self.files = screen, clock, latencies, files
        self.exposing_s = 0.0
        self.downloading_s: list[float] = []
        self.frames = 0
        self._frame = b""
        self._released = SIM_START

    def identity(self) -> CameraIdentity:
        """Return a name."""
        return CameraIdentity(BODY.maker, BODY.model, "1")

    def configure(self, settings: ExposureSettings) -> None:
        """Do nothing."""

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return none; they are not requested here."""
        return ()

    def expose(self) -> datetime:
        """Release, expose and read out."""
        self._frame = self.files["dark" if self.screen.colour == BLACK else "lit"]
        self.frames += 1
        self._released = self.clock.now()
        exposing_s = self.latencies.release_s + EXPOSURE.shutter_s + self.latencies.readout_s
        self.exposing_s += exposing_s
        self.clock.sleep(exposing_s)
        return self._released

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Send the file in pieces of 1 MiB at the speed of the cable."""
        start = self.clock.monotonic()
        self.downloading_s.append(len(self._frame) / self.latencies.bytes_per_s)
        for offset in range(0, len(self._frame), 1 << 20):
            into.write(self._frame[offset : offset + (1 << 20)])
            due_s = start + min(offset + (1 << 20), len(self._frame)) / self.latencies.bytes_per_s
            self.clock.sleep(max(due_s - self.clock.monotonic(), 0))
        return CapturedFrame(f"IMG_{self.frames:04d}.CR2", len(self._frame), self._released)

    def close(self) -> None:
        """Do nothing."""


def prepared_files() -> dict[str, bytes]:
    """Return a dark and a lit file with the noise of the body; a fixed code table replaces the previews in size."""
    rng = np.random.default_rng(20190601)
    rows, columns = np.mgrid[0 : BODY.sensor[0], 0 : BODY.sensor[1]]
    scene = 0.6 + 0.4 * np.sin(columns / 90) * np.cos(rows / 70)
    return {"dark": _file(0 * scene, rng), "lit": _file(7000 * scene, rng)}


def _file(signal: np.ndarray[tuple[int, int], np.dtype[np.float64]], rng: np.random.Generator) -> bytes:
    noise = rng.standard_normal(BODY.sensor, dtype=np.float32)
    counts = BODY.black + signal + noise * np.sqrt(signal / BODY.electrons_per_dn + BODY.read_noise_dn**2)
    for area in BODY.masked:
        area_slices = (slice(area.top, area.top + area.height), slice(area.left, area.left + area.width))
        counts[area_slices] = BODY.black + BODY.read_noise_dn * noise[area_slices]
    sensor_counts = counts.round().clip(0, BODY.saturation).astype(np.uint16)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "frame.cr2"
        write_cr2(file, sensor_counts, BODY.model, EXPOSURE.iso, SLICES)
        return file.read_bytes()


class PassingJudge:
    """The judge of a session, without rejections for repeated frames; other rejections stay."""

    def __init__(self) -> None:
        settings = LabSettings.model_validate(
            {
                "rig": "simulated",
                "chart": "chart.json",
                "illuminations": "lights.csv",
                "judge": {"chart": False},
            }
        )
        self._judge = LiveJudge(settings, design_chart(bits=1), LIGHTS)

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return the judgement with all figures, accepted."""
        judgement = self._judge.judge(file, step)
        passed = all(check.passed or check.name in (OFF_CODES_DEG.name, REPEATED.name) for check in judgement.checks)
        if not passed:
            return judgement
        return replace(
            judgement,
            checks=tuple(replace(check, reason="") for check in judgement.checks),
            voids=False,
            lasting=False,
        )

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        self._judge.recall(step, measurement, accepted)


def _settings(settle_s: float) -> LabSettings:
    return LabSettings(
        rig="simulated",
        chart=Path("chart.json"),
        illuminations=Path("lights.csv"),
        sequence=SequenceSettings(settle_s=settle_s),
    )


@dataclass(frozen=True)
class SessionTimes:
    """A measured session: frames, its time by its own clock and by this machine's, unavoidable time, phases."""

    frames: int
    taken_s: float
    machine_s: float
    unavoidable_s: float
    timings: dict[str, float]

    @property
    def efficiency(self) -> float:
        """Unavoidable time / time taken."""
        return self.unavoidable_s / self.taken_s


def measure(
    clock: Clock, latencies: Latencies, settle_s: float, lights: int, files: dict[str, bytes], live: bool = True
) -> SessionTimes:
    """Take a session of `lights` illuminants.

    Judged files are emptied to save disk space. They keep their size, because a run repeats frames with missing or cut
    files.
    """
    screen = PacedScreen(clock, latencies)
    camera = PacedCamera(screen, clock, latencies, files)
    plan = [Illuminant(n, "uniform", None, LIGHTS[n].colour) for n in range(lights)]
    settings = _settings(settle_s)
    steps = plan_steps(plan, settings.sequence.reference_every)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "session"
        with Session.create(folder, settings.to_toml(), design_chart(bits=1), plan, steps) as session:

            def tidy(frame: Taken) -> None:
                assert frame.judgement.accepted, frame.judgement.reason
                for path in session.frames_folder.glob(f"{frame.step.stem}.*"):
                    size = path.stat().st_size
                    os.truncate(path, 0)
                    os.truncate(path, size)

            start, machine_start = clock.monotonic(), time.perf_counter()
            devices = Devices(camera, screen, PacedProjector(clock, latencies), clock)
            judge = PassingJudge() if live else ExposureJudge(settings)
            assert take_session(session, devices, settings, judge, tidy).complete
            assert camera.frames == len(steps)
            taken_s, machine_s = clock.monotonic() - start, time.perf_counter() - machine_start
            step_timings = [details.timings for details in session.journal.details().values()]
    medians = {name: statistics.median(timings[name] for timings in step_timings) for name in step_timings[0]}
    # Settling of the first illuminant overlaps with nothing; after the last frame nothing settles.
    *downloads, last = camera.downloading_s
    waits = [settle_s, *(max(settle_s, downloading_s) for downloading_s in downloads), last]
    return SessionTimes(len(steps), taken_s, machine_s, camera.exposing_s + sum(waits), medians)


def report(name: str, value: float, unit: str, against: str = "") -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.4g}"), "unit": unit, "against": against}), flush=True)


def report_session(name: str, measured: SessionTimes) -> None:
    """Print the time of a session and its phases."""
    frames = measured.frames
    report(f"{name}: frames", frames, "frames")
    report(f"{name}: seconds per frame", measured.taken_s / frames, "s")
    report(
        f"{name}: unavoidable",
        measured.unavoidable_s / frames,
        "s",
        "shortest possible time: exposure + longer of settling and download",
    )
    report(f"{name}: efficiency", measured.efficiency, "ratio", "unavoidable time / time taken")
    for phase, seconds in measured.timings.items():
        report(f"{name}: median of {phase}", seconds, "s")


@contextmanager
def counted_writes() -> Generator[list[float]]:
    """Collect the seconds of each write to the journal."""
    write_s: list[float] = []
    original = {name: getattr(Journal, name) for name in ("begin", "commit", "beat", "note")}

    def timed(name: str):
        def call(*arguments: object, **options: object) -> object:
            start = time.perf_counter()
            try:
                return original[name](*arguments, **options)
            finally:
                write_s.append(time.perf_counter() - start)

        return call

    for name in original:
        setattr(Journal, name, timed(name))
    try:
        yield write_s
    finally:
        for name, method in original.items():
            setattr(Journal, name, method)


def compare_saving(files: dict[str, bytes], live: bool) -> None:
    """Compare the processing of a frame with plain saving of the same bytes."""
    instant = Latencies(0, 0, 1e15, 0, 0, 0)
    measured = measure(SimulatedClock(), instant, 0.0, SAVED - 4, files, live)
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        for number in range(measured.frames):
            _save(Path(scratch) / f"{number}.cr2", files["lit"])
        saved_s = time.perf_counter() - start
    name = "sequencer: a frame of 18 Mpx saved, hashed, decoded, judged"
    report(name, measured.machine_s / measured.frames, "s")
    report(f"{name}/ saving alone", measured.machine_s / saved_s, "ratio", "write, fsync, SHA-256")
    judged_s = measured.timings["judge"] * measured.frames
    report(
        f"{name}/ saving and judging",
        measured.machine_s / (saved_s + judged_s),
        "ratio",
        "write, fsync, SHA-256, judging",
    )


def _save(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    hashlib.sha256(content).hexdigest()


def main() -> int:
    words = parse_words(__doc__, ("quick", "exposure"))
    files = prepared_files()
    report("size of a frame", len(files["lit"]) / 1e6, "MB")
    report("load of the machine at the start", os.getloadavg()[0], "processes", f"{os.cpu_count()} processors")
    live = "exposure" not in words
    report("judged", float(live), "", "1: by the live judge, 0: by exposure alone")
    compare_saving(files, live)
    latencies = Latencies(0, 0, 30e6, 0, 0, 0)
    with counted_writes() as write_s:
        real_session = measure(SystemClock(), latencies, 0.2, REAL_LIGHTS, files, live)
    report_session("real time", real_session)
    report("real time: journal writes per frame", sum(write_s) / real_session.frames, "s")
    lights = len(LIGHTS) // 10 if "quick" in words else len(LIGHTS)
    report_session("simulated time", measure(SimulatedClock(), Latencies(), 0.5, lights, files, live))
    slow_session = measure(SimulatedClock(), Latencies(question_s=0.02), 0.5, len(LIGHTS) // 10, files, live)
    report_session("simulated time, a projector with 20 ms per answer", slow_session)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
