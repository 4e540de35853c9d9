"""How near a session comes to the time that exposure, settling and download need in any case, and what saving costs.

`python -m benchmarks.sequencer` prints one JSON object a line for each figure:

- in simulated time, 767 frames (707 lights and their references) of the layout of an EOS 550D's CR2, with the latencies
  of a camera, a screen and a projector; each file is written, flushed, hashed and decoded;
- in real time on the machine at hand, frames of 25 MB at 30 MB/s, exposure 0.5 s, settling 0.2 s, decoded and judged;
- a frame saved, hashed and judged against the same bytes written, flushed and hashed by a few lines.

``python -m benchmarks.sequencer quick`` takes a tenth of the frames in simulated time, and some minutes. Frames are
judged as in a session (`acquisition.judge.judge.LiveJudge`); with ``exposure`` among the words by their exposure alone,
as it was before.

The unavoidable time of a frame is release, exposure and readout, and then the longer of settling and download: a body
does not expose while it sends, and the light may change when it has announced the frame. What is flattered: files are
prepared (two, a dark and a lit one, with the slices of a 550D and without its previews), cable and body do their work
without a processor of this machine, the latencies are constants, and no frame is refused: the judge measures and
compares each as in a session without frames of the primaries, before a bare wall, and what it says of a light that does
not change is passed over. In simulated time work of this machine takes none; the figures in real time have it.
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
from benchmarks import words_given
from calibration.figures.light import OFF_CODES_DEG
from calibration.figures.single_frames import REPEATED
from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.projector import Fault, Lamp, Power, ProjectorIdentity
from experiment.chart.layout import design_chart
from experiment.config import LabSettings, SequenceSettings
from experiment.lights import Illumination, plan_illuminations
from experiment.session.folder import Session
from experiment.session.journal import Journal
from experiment.session.records import Judgement, SessionStep, plan_steps
from foundation.clock import SIM_START, Clock, SimulatedClock, SystemClock
from sim.world.sensors import BODIES
from tests.drivers.raw.raw_files import write_cr2

BODY = BODIES["EOS 550D"]
EXPOSURE = ExposureSettings(100, 8.0, 0.5)
LIGHTS = plan_illuminations(35, list(range(2000, 10001, 200)))
# Lights of the session in real time: some tens of frames, a minute.
REAL_LIGHTS = 36
# Of an EOS 550D's lossless JPEG: two of the first width, one of the last; together its 5344 columns.
SLICES = (2, 1728, 1888)
# Files of the comparison with plain saving.
SAVED = 12


@dataclass(frozen=True)
class Latencies:
    """What devices take, seconds.

    - `release_s`: from the command to the open shutter: mirror and two messages (60D: 2 … 40 ms a message; mirror
      chosen).
    - `readout_s`: from the closed shutter to the announcement: an EOS 550D's in `sim.camera.bodies`.
    - `bytes_per_s`: of the cable: USB 2.0 carries 25 to 40 million.
    - `show_s`: from the call to a colour that is known to be on the screen: a picture or two at 60 Hz.
    - `verify_s`: reading the screen back.
    - `question_s`: A projector's answer over the network; it is asked five things a frame.
    """

    release_s: float = 0.08
    readout_s: float = 0.783
    bytes_per_s: float = 27.5e6
    show_s: float = 1.5 / 60
    verify_s: float = 0.008
    question_s: float = 0.004


class PacedScreen:
    """Remembers the colour, and takes its time."""

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
    """A healthy projector that takes its time to say so."""

    def __init__(self, clock: Clock, latencies: Latencies) -> None:
        self.clock, self.latencies = clock, latencies
        self.state = Power.ON

    def _ask(self) -> None:
        self.clock.sleep(self.latencies.question_s)

    def identity(self) -> ProjectorIdentity:
        """Return a name."""
        return ProjectorIdentity("CroP", "paced", "")

    def power(self) -> Power:
        """Say that the lamp burns, or cools when it was switched off."""
        self._ask()
        return self.state

    def switch_on(self) -> None:
        """Do nothing."""

    def switch_off(self) -> None:
        """Do so: one that went on burning would be looked at for five seconds more, a tenth of a short session."""
        self.state = Power.COOLING

    def muted(self) -> bool:
        """Say that it is not."""
        self._ask()
        return False

    def set_muted(self, muted: bool) -> None:
        """Do nothing."""

    def faults(self) -> tuple[Fault, ...]:
        """Say that there are none."""
        self._ask()
        return ()

    def picture_fault(self) -> str | None:
        """Say that the picture follows: signal and freeze are two questions."""
        self._ask()
        self._ask()
        return None

    def lamps(self) -> tuple[Lamp, ...]:
        """Return none."""
        return ()

    def close(self) -> None:
        """Do nothing."""


class PacedCamera:
    """Hands out prepared files in the time that a camera takes."""

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
        """Offer none: nobody asks."""
        return ()

    def expose(self) -> datetime:
        """Release, expose, read out."""
        self._frame = self.files["dark" if self.screen.colour == BLACK else "lit"]
        self.frames += 1
        self._released = self.clock.now()
        exposing_s = self.latencies.release_s + EXPOSURE.shutter_s + self.latencies.readout_s
        self.exposing_s += exposing_s
        self.clock.sleep(exposing_s)
        return self._released

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Send the file in pieces of a mebibyte, as fast as the cable."""
        begun = self.clock.monotonic()
        self.downloading_s.append(len(self._frame) / self.latencies.bytes_per_s)
        for at in range(0, len(self._frame), 1 << 20):
            into.write(self._frame[at : at + (1 << 20)])
            due = begun + min(at + (1 << 20), len(self._frame)) / self.latencies.bytes_per_s
            self.clock.sleep(max(due - self.clock.monotonic(), 0))
        return CapturedFrame(f"IMG_{self.frames:04d}.CR2", len(self._frame), self._released)

    def close(self) -> None:
        """Do nothing."""


def prepared_files() -> dict[str, bytes]:
    """Return a dark and a lit file, with the noise of the body; a fixed code table makes up for missing previews."""
    rng = np.random.default_rng(20190601)
    rows, columns = np.mgrid[0 : BODY.sensor[0], 0 : BODY.sensor[1]]
    scene = 0.6 + 0.4 * np.sin(columns / 90) * np.cos(rows / 70)
    return {"dark": _file(0 * scene, rng), "lit": _file(7000 * scene, rng)}


def _file(signal: np.ndarray[tuple[int, int], np.dtype[np.float64]], rng: np.random.Generator) -> bytes:
    noise = rng.standard_normal(BODY.sensor, dtype=np.float32)
    counts = BODY.black + signal + noise * np.sqrt(signal / BODY.electrons_per_dn + BODY.read_noise_dn**2)
    for area in BODY.masked:
        part = (slice(area.top, area.top + area.height), slice(area.left, area.left + area.width))
        counts[part] = BODY.black + BODY.read_noise_dn * noise[part]
    whole = counts.round().clip(0, BODY.saturation).astype(np.uint16)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "frame.cr2"
        write_cr2(file, whole, BODY.model, EXPOSURE.iso, SLICES)
        return file.read_bytes()


class PassingJudge:
    """The judge of a session, whose refusals of a frame that was seen before are passed over.

    What is refused for anything else is not: the judge did not look at it whole.
    """

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
        """Return the judgement with all its numbers, accepted."""
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
        """Take in a frame of an earlier run."""
        self._judge.recall(step, measurement, accepted)


def _settings(settle_s: float) -> LabSettings:
    return LabSettings(
        rig="simulated",
        chart=Path("chart.json"),
        illuminations=Path("lights.csv"),
        sequence=SequenceSettings(settle_s=settle_s),
    )


@dataclass(frozen=True)
class Measured:
    """A session: frames, its time by its clock and by this machine's, the unavoidable time, and where time went."""

    frames: int
    taken_s: float
    machine_s: float
    unavoidable_s: float
    timings: dict[str, float]

    @property
    def efficiency(self) -> float:
        """Unavoidable time over the time taken."""
        return self.unavoidable_s / self.taken_s


def measure(
    clock: Clock, latencies: Latencies, settle_s: float, lights: int, files: dict[str, bytes], live: bool = True
) -> Measured:
    """Take a session of `lights` lights; files are emptied when they are judged, so that the disk need not hold all.

    They keep their size: a run takes frames again whose files are gone or cut.
    """
    screen = PacedScreen(clock, latencies)
    camera = PacedCamera(screen, clock, latencies, files)
    chosen = [Illumination(n, "uniform", None, LIGHTS[n].colour) for n in range(lights)]
    settings = _settings(settle_s)
    steps = plan_steps(chosen, settings.sequence.reference_every)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "session"
        with Session.create(folder, settings.to_toml(), design_chart(bits=1), chosen, steps) as session:

            def tidy(taken: Taken) -> None:
                assert taken.judgement.accepted, taken.judgement.reason
                for path in session.frames_folder.glob(f"{taken.step.stem}.*"):
                    size = path.stat().st_size
                    os.truncate(path, 0)
                    os.truncate(path, size)

            begun, machine = clock.monotonic(), time.perf_counter()
            devices = Devices(camera, screen, PacedProjector(clock, latencies), clock)
            judge = PassingJudge() if live else ExposureJudge(settings)
            assert take_session(session, devices, settings, judge, tidy).complete
            assert camera.frames == len(steps)
            taken_s, machine_s = clock.monotonic() - begun, time.perf_counter() - machine
            parts = [details.timings for details in session.journal.details().values()]
    medians = {name: statistics.median(part[name] for part in parts) for name in parts[0]}
    # The first light settles with nothing to hide it; behind the last frame there is no light to settle.
    *downloads, last = camera.downloading_s
    waits = [settle_s, *(max(settle_s, downloading_s) for downloading_s in downloads), last]
    return Measured(len(steps), taken_s, machine_s, camera.exposing_s + sum(waits), medians)


def report(name: str, value: float, unit: str, against: str = "") -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.4g}"), "unit": unit, "against": against}), flush=True)


def report_session(name: str, measured: Measured) -> None:
    """Print what a session took, and where its time went."""
    frames = measured.frames
    report(f"{name}: frames", frames, "frames")
    report(f"{name}: seconds a frame", measured.taken_s / frames, "s")
    report(
        f"{name}: unavoidable", measured.unavoidable_s / frames, "s", "exposure and the longer of settling, download"
    )
    report(f"{name}: efficiency", measured.efficiency, "ratio", "unavoidable time over time taken")
    for part, seconds in measured.timings.items():
        report(f"{name}: median of {part}", seconds, "s")


@contextmanager
def counted_writes() -> Generator[list[float]]:
    """Collect the seconds of each write to the journal."""
    spent: list[float] = []
    real = {name: getattr(Journal, name) for name in ("begin", "commit", "beat", "note")}

    def timed(name: str):
        def call(*given: object, **named: object) -> object:
            begun = time.perf_counter()
            try:
                return real[name](*given, **named)
            finally:
                spent.append(time.perf_counter() - begun)

        return call

    for name in real:
        setattr(Journal, name, timed(name))
    try:
        yield spent
    finally:
        for name, method in real.items():
            setattr(Journal, name, method)


def compare_saving(files: dict[str, bytes], live: bool) -> None:
    """Compare what becomes of a frame on this machine with plain saving of the same bytes."""
    instant = Latencies(0, 0, 1e15, 0, 0, 0)
    measured = measure(SimulatedClock(), instant, 0.0, SAVED - 4, files, live)
    with tempfile.TemporaryDirectory() as scratch:
        begun = time.perf_counter()
        for number in range(measured.frames):
            _save(Path(scratch) / f"{number}.cr2", files["lit"])
        saved_s = time.perf_counter() - begun
    name = "sequencer: a frame of 18 Mpx saved, hashed, decoded, judged"
    report(name, measured.machine_s / measured.frames, "s")
    report(f"{name}, over saving alone", measured.machine_s / saved_s, "ratio", "write, fsync, SHA-256")
    judged_s = measured.timings["judge"] * measured.frames
    report(f"{name}, over saving and judging", measured.machine_s / (saved_s + judged_s), "ratio", "and judging")


def _save(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    hashlib.sha256(content).hexdigest()


def main() -> int:
    """Measure sessions of prepared frames."""
    words = words_given(__doc__, ("quick", "exposure"))
    files = prepared_files()
    report("size of a frame", len(files["lit"]) / 1e6, "MB")
    report("load of the machine when begun", os.getloadavg()[0], "processes", f"{os.cpu_count()} processors")
    live = "exposure" not in words
    report("judged", float(live), "", "1: by the live judge, 0: by exposure alone")
    compare_saving(files, live)
    real = Latencies(0, 0, 30e6, 0, 0, 0)
    with counted_writes() as spent:
        measured = measure(SystemClock(), real, 0.2, REAL_LIGHTS, files, live)
    report_session("real time", measured)
    report("real time: journal's writes a frame", sum(spent) / measured.frames, "s")
    lights = len(LIGHTS) // 10 if "quick" in words else len(LIGHTS)
    report_session("simulated time", measure(SimulatedClock(), Latencies(), 0.5, lights, files, live))
    slow = measure(SimulatedClock(), Latencies(question_s=0.02), 0.5, len(LIGHTS) // 10, files, live)
    report_session("simulated time, a projector that takes 20 ms an answer", slow)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
