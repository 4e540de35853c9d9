"""What a table costs: `python -m benchmarks.build_lut [PART …]` prints one JSON object a line for each figure.

Parts are `memory`, `chart`, `DNG` and `CR2`; all of them, which takes some minutes, if none is named.

A short session of full-size frames of the EOS 550D is built as `build-lut` builds it, once as the uncompressed DNG that
the simulated camera writes and once with the same counts as CR2 (lossless JPEG, as the real body). Each is given beside
a plain pass over the same files in turn with it, so that the machine's speed cancels: rawpy's unpacking alone, in as
many threads as the build decodes with, and dcraw, where it is installed.

What the lens's correction and the comparison of every cell cost is the build's processor time over that of a build
without either, frame by frame. Measuring the lens, once a session, is shared out among the frames of 707 lights, which
flatters: a session of ten lights takes a quarter longer for it. The memory is that of the command, run on frames of the
EOS 6D Mark II, for few lights and for more.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import rawpy

from benchmarks import words_given
from calibration.checks.frame_consistency import ConsistencyCheck
from calibration.pipeline.baseline import baseline_of, with_lens
from calibration.pipeline.build import build, thread_count
from calibration.pipeline.frames import PAPER_OPTIONS, BuildOptions, select_frames
from calibration.pipeline.measuring import decode_frame
from calibration.registration.register import register
from calibration.sampling import gather_values, sites_at
from drivers.camera import CapturedFrame
from drivers.raw.rawfile import frame_black, read_raw
from experiment.chart.layout import design_chart
from experiment.chart.printing import drawing
from experiment.lights import plan_illuminations
from experiment.session.folder import Session
from experiment.session.journal import ReceivedFile
from experiment.session.records import Judgement, plan_steps
from sim.camera.film import write_dng
from sim.optics import MILD_SHOULDERS
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import REFERENCE_EXPOSURE, Room, World
from tests.drivers.raw.raw_files import write_cr2

RUNS = 4
ROUNDS = 3

# Frames of a session of the paper's lights: a white and a dark one with every 25, and at the end.
PAPER_FRAMES = 707 + 2 * 30


def least(work: Callable[[], object], runs: int = RUNS) -> float:
    """Return the least wall time of several runs, seconds."""
    times: list[float] = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def report(name: str, value: float, unit: str, against: str) -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def take(folder: Path, body: str = "EOS 550D", cr2: bool = False, lights: int = 11) -> tuple[Session, World]:
    """Return a session of eleven lights, or another number, as DNG or CR2, and the room it was taken in."""
    chart = design_chart()
    picture = drawing(chart)
    # A lens whose spread is proven, so that its correction is part of what is measured.
    room = replace(Room(), **MILD_SHOULDERS, veil=0.005)
    world = World(Print(picture.page_mm, picture.rectangles_mm, picture.rgb), BODIES[body], room)
    ccts = np.linspace(2500, 10000, max(lights - 3, 1)).round().tolist()
    planned = plan_illuminations(grid=1, ccts_k=ccts)[:lights]
    session = Session.create(folder, "", chart, planned)
    at = datetime(2024, 3, 1, tzinfo=UTC)
    for step in plan_steps(planned, 25):
        stream = BytesIO()
        counts = world.expose(step.colour, REFERENCE_EXPOSURE, key=(step.number,))
        file = f"frames/{step.stem}.{'cr2' if cr2 else 'dng'}"
        if cr2:
            write_cr2(folder / file, counts, world.body.model)
            data = (folder / file).read_bytes()
        else:
            write_dng(stream, counts, world.body, settings=REFERENCE_EXPOSURE, taken_at=at)
            data = stream.getvalue()
        at += timedelta(seconds=4)
        attempt = session.journal.begin(step, file, at)
        (folder / file).write_bytes(data)
        received = ReceivedFile(
            folder / file, len(data), hashlib.sha256(data).hexdigest(), CapturedFrame(Path(file).name, len(data), at)
        )
        session.journal.commit(attempt, received, Judgement(()), exposure_s=REFERENCE_EXPOSURE.shutter_s, ended_at=at)
    return session, world


class Costs(NamedTuple):
    """What one frame costs, seconds of wall time and of processor time."""

    wall: float
    processor: float


def timed(work: Callable[[], object], frames: int) -> Costs:
    """Return what `work` costs for each of its frames."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return Costs((time.perf_counter() - wall) / frames, (time.process_time() - processor) / frames)


def build_timed(session: Session, out: Path, options: BuildOptions = PAPER_OPTIONS) -> Costs:
    """Return what a frame of a build costs once the chart is found; the report and the dark frames are not counted."""
    marks: list[Costs] = []

    def mark(done: int, total: int, what: str) -> None:
        marks.append(Costs(time.perf_counter(), time.process_time()))

    result = build(session, out, mark, options=options)
    if result.figures.lens.corrected != options.lens_correction:
        raise SystemExit("the lens of the benchmark's room is not corrected; it measures something else")
    shutil.rmtree(out)
    # The first mark is set before the chart is sought, the second when the first frame is done, the last after all. As
    # many frames are under way at the first one counted as at the last one: towards the end, threads run out of work.
    first, last, frames = marks[1], marks[-2 - thread_count()], len(marks) - 3 - thread_count()
    return Costs((last.wall - first.wall) / frames, (last.processor - first.processor) / frames)


def compare(session: Session, out: Path, kind: str) -> None:
    """Build a session's table and print what a frame costs, beside unpacking and dcraw of the same files.

    One after another and again, and the median of the rounds' ratios, so that what else the machine does falls on all.
    """
    files = [session.folder / record.file for record in session.frames()]
    dcraw = shutil.which("dcraw")

    def unpack_all() -> None:
        with ThreadPoolExecutor(thread_count()) as pool:
            list(pool.map(unpack, files))

    def develop() -> None:
        for file in files[:4]:
            subprocess.run([str(dcraw), "-D", "-4", "-T", "-c", file], stdout=subprocess.DEVNULL, check=True)

    rounds: list[tuple[Costs, Costs, float]] = []
    frame: list[float] = []
    session_of_707: list[float] = []
    once = lens_measured(session)
    for _ in range(ROUNDS):
        unpacking = timed(unpack_all, len(files))
        with patch.object(ConsistencyCheck, "_disturbed", return_value=((), (), ())):
            without = build_timed(session, out, replace(PAPER_OPTIONS, lens_correction=False))
        building = build_timed(session, out)
        frame.append(building.processor / without.processor)
        session_of_707.append((building.processor + once / PAPER_FRAMES) / without.processor)
        again = timed(unpack_all, len(files))
        unpacking = Costs(*(np.mean([unpacking, again], axis=0).tolist()))
        rounds.append((building, unpacking, timed(develop, 4).wall if dcraw else np.nan))
    wall, processor, against_dcraw = (
        float(np.median(ratios))
        for ratios in zip(
            *((b.wall / u.wall, b.processor / u.processor, b.wall / d) for b, u, d in rounds), strict=True
        )
    )
    count = f"{thread_count()} threads"
    report(f"one frame of a build, {kind}", float(np.median([b.wall for b, _, _ in rounds])), "s", count)
    report(f"one frame of a build, {kind}, to unpacking", wall, "1", f"rawpy's unpack alone, {count}")
    report(f"one frame of a build, {kind}, to unpacking, processor time", processor, "1", "rawpy's unpack alone")
    before = "processor time of one without lens correction and comparison of every cell"
    report(f"one frame of a build, {kind}, to before", float(np.median(frame)), "1", before)
    report("measure the lens", once, "s", "processor time, once a session")
    report(f"707 lights, {kind}, to before", float(np.median(session_of_707)), "1", f"{before}, chart found in either")
    if dcraw is not None:
        report(f"one frame of a build, {kind}, to dcraw", against_dcraw, "1", "dcraw -D -4 -T of it alone")


def lens_measured(session: Session) -> float:
    """Return the processor time that measuring the lens takes, seconds; once for each session."""
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    baseline = baseline_of(session.chart, first)
    return min(timed(lambda: with_lens(baseline, first, primaries, ()), 1).processor for _ in range(RUNS))


def unpack(path: Path) -> None:
    """Read and unpack a raw file, and do nothing with it."""
    with rawpy.imread(BytesIO(path.read_bytes())) as raw:
        _ = raw.raw_image.shape


def memory(folder: Path, lights: int) -> None:
    """Print the most memory that a build of the EOS 6D Mark II takes, in a program of its own."""
    session, _ = take(folder / f"session_{lights}", "EOS 6D Mark II", lights=lights)
    session.close()
    # Not wait4's figure, which begins with what the parent holds.
    program = (
        "import pathlib, sys\nfrom calibration.cli import main\ncode = main()\n"
        "print(*(line for line in pathlib.Path('/proc/self/status').open() if line.startswith('VmHWM')))\n"
        "sys.exit(code)"
    )
    command = [sys.executable, "-c", program, session.folder, folder / f"lut_{lights}"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    peak = float(output.rsplit("VmHWM:", 1)[1].split()[0]) / 1e6
    against = f"{lights} lights, {thread_count()} threads; below 2 GB wanted whatever the number"
    report(f"memory of a build, EOS 6D Mark II, {lights} lights", peak, "GB", against)


def chart_and_sampling(session: Session, world: World) -> None:
    """Print what reading a frame, finding the chart and sampling cost."""
    chart, path = session.chart, session.folder / "frames/0000_white.dng"
    copying = least(lambda: np.fromfile(path, dtype=np.uint8).sum())
    reading = least(lambda: read_raw(path))
    report("read a raw frame", reading, "s", "-")
    report("read a raw frame, ratio", reading / copying, "1", "reading the file's bytes and adding them up")
    mosaic = read_raw(path)
    registering = least(lambda: register(mosaic, chart), runs=2)
    report("find the chart and its 32 768 cells", registering, "s", "once a session, and after a bump")
    report("find the chart, ratio", registering / reading, "1", "reading a frame")
    registration = register(mosaic, chart)
    distance = np.linalg.norm(registration.to_pixels(chart.centres_mm) - world.project(chart.centres_mm), axis=1)
    report("cell centres, RMS", float(np.sqrt((distance**2).mean())), "px", "World.project, default room")
    report("cell centres, worst", float(distance.max()), "px", "World.project, default room")
    black = frame_black(mosaic)
    sites = sites_at(registration.to_pixels(chart.centres_mm), (mosaic.counts.shape[0] // 2, 2601))
    even = np.ones((len(chart.colours), 3))
    sampling = least(lambda: gather_values(mosaic, black, sites, even))
    report("sample a frame", sampling, "s", "-")
    report("sample a frame, ratio", sampling / reading, "1", "reading a frame")


PARTS = ("memory", "chart", "DNG", "CR2")


def main() -> None:
    """Measure and print the parts named on the command line, or all."""
    parts = words_given(__doc__, PARTS) or PARTS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for lights in (4, 12) if "memory" in parts else ():
            memory(folder, lights)
            shutil.rmtree(folder / f"session_{lights}")
        if {"chart", "DNG"} & set(parts):
            session, world = take(folder / "session")
            if "chart" in parts:
                chart_and_sampling(session, world)
            if "DNG" in parts:
                compare(session, folder / "lut", "DNG")
            session.close()
            shutil.rmtree(session.folder)
        if "CR2" in parts:
            session, _ = take(folder / "session_cr2", cr2=True)
            compare(session, folder / "lut_cr2", "CR2")
            session.close()


if __name__ == "__main__":
    main()
