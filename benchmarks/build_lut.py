"""Cost of building a LUT: `python -m benchmarks.build_lut [PART …]` prints one JSON object per result and line.

Parts are `memory`, `chart`, `DNG` and `CR2`. Without a part all are measured, which takes some minutes.

A LUT is built from a short session of full-size EOS 550D frames: once from uncompressed DNG files of the simulated
camera, once from the same counts in CR2 files (lossless JPEG, like the real body). Builds alternate with simpler
programs on the same files, so that the speed of the machine cancels in the ratio. These programs are rawpy, which
unpacks the files with as many threads as the build, and dcraw if it is installed.

The cost of lens correction and patch comparison is the additional processor time per frame, relative to a build without
them. The lens is measured once per session, so this cost is divided by the frames of a session with 707 illuminants. It
makes a session of ten illuminants a quarter longer. Memory is measured with the command itself on frames of the EOS 6D
Mark II, with few and with more illuminants.
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

from benchmarks import parse_words
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
from experiment.lights import plan_illuminants
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

# Frames of a session with the illuminants of the paper: a white and a dark frame every 25 illuminants, and at the end.
PAPER_FRAMES = 707 + 2 * 30


def fastest_s(work: Callable[[], object], runs: int = RUNS) -> float:
    """Return the shortest wall time of several runs, in seconds."""
    times: list[float] = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def take(folder: Path, body: str = "EOS 550D", cr2: bool = False, lights: int = 11) -> tuple[Session, World]:
    """Take a session in a simulated room; return both."""
    chart = design_chart()
    print_image = drawing(chart)
    # The spread of this lens is known, so its correction is part of the measurement.
    room = replace(Room(), **MILD_SHOULDERS, veil=0.005)
    world = World(Print(print_image.page_mm, print_image.rectangles_mm, print_image.rgb), BODIES[body], room)
    ccts = np.linspace(2500, 10000, max(lights - 3, 1)).round().tolist()
    planned = plan_illuminants(grid=1, ccts_k=ccts)[:lights]
    session = Session.create(folder, "", chart, planned)
    time = datetime(2024, 3, 1, tzinfo=UTC)
    for step in plan_steps(planned, 25):
        stream = BytesIO()
        counts = world.expose(step.colour, REFERENCE_EXPOSURE, key=(step.number,))
        file = f"frames/{step.stem}.{'cr2' if cr2 else 'dng'}"
        if cr2:
            write_cr2(folder / file, counts, world.body.model)
            data = (folder / file).read_bytes()
        else:
            write_dng(stream, counts, world.body, settings=REFERENCE_EXPOSURE, taken_at=time)
            data = stream.getvalue()
        time += timedelta(seconds=4)
        attempt = session.journal.begin(step, file, time)
        (folder / file).write_bytes(data)
        received = ReceivedFile(
            folder / file, len(data), hashlib.sha256(data).hexdigest(), CapturedFrame(Path(file).name, len(data), time)
        )
        session.journal.commit(attempt, received, Judgement(()), exposure_s=REFERENCE_EXPOSURE.shutter_s, ended_at=time)
    return session, world


class Costs(NamedTuple):
    """Cost of one frame: wall time and processor time, in seconds."""

    wall: float
    processor: float


def timed(work: Callable[[], object], frames: int) -> Costs:
    """Return the cost of `work` per frame."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return Costs((time.perf_counter() - wall) / frames, (time.process_time() - processor) / frames)


def build_timed(session: Session, out: Path, options: BuildOptions = PAPER_OPTIONS) -> Costs:
    """Return the cost per frame after registration; dark frames and the report are excluded."""
    marks: list[Costs] = []

    def mark(count: int, total: int, task: str) -> None:
        marks.append(Costs(time.perf_counter(), time.process_time()))

    result = build(session, out, mark, options=options)
    if result.figures.lens.corrected != options.lens_correction:
        raise SystemExit("the lens of the simulated room was not corrected; correct the room of this benchmark")
    shutil.rmtree(out)
    # The first mark precedes registration, the second follows the first frame, the last comes at the end. The first and
    # the last counted frame have the same number of frames in progress; at the end some threads have no work.
    first, last, frames = marks[1], marks[-2 - thread_count()], len(marks) - 3 - thread_count()
    return Costs((last.wall - first.wall) / frames, (last.processor - first.processor) / frames)


def compare(session: Session, out: Path, kind: str) -> None:
    """Build a LUT and print the cost of one frame, next to unpacking and dcraw of the same files.

    The programs take turns; the median of the ratios is printed, so that other load affects all of them.
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
    ratios: list[float] = []
    session_ratio: list[float] = []
    lens_s = measure_lens_s(session)
    for _ in range(ROUNDS):
        unpacking = timed(unpack_all, len(files))
        with patch.object(ConsistencyCheck, "_disturbed", return_value=((), (), ())):
            plain_build = build_timed(session, out, replace(PAPER_OPTIONS, lens_correction=False))
        full_build = build_timed(session, out)
        ratios.append(full_build.processor / plain_build.processor)
        session_ratio.append((full_build.processor + lens_s / PAPER_FRAMES) / plain_build.processor)
        second_unpacking = timed(unpack_all, len(files))
        unpacking = Costs(*(np.mean([unpacking, second_unpacking], axis=0).tolist()))
        rounds.append((full_build, unpacking, timed(develop, 4).wall if dcraw else np.nan))
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
    against = "processor time of a build without lens correction and patch comparison"
    report(f"one frame of a build, {kind}, to a build without lens correction", float(np.median(ratios)), "1", against)
    report("measure the lens", lens_s, "s", "processor time, once per session")
    report(
        f"707 illuminants, {kind}, to a build without lens correction",
        float(np.median(session_ratio)),
        "1",
        f"{against}, registration in both",
    )
    if dcraw is not None:
        report(f"one frame of a build, {kind}, to dcraw", against_dcraw, "1", "dcraw -D -4 -T alone")


def measure_lens_s(session: Session) -> float:
    """Return the processor time for measuring the lens, in seconds; once per session."""
    selected = select_frames(session)
    first = decode_frame(session, selected.registered)
    primaries = [decode_frame(session, record) for record in selected.primaries]
    baseline = baseline_of(session.chart, first)
    return min(timed(lambda: with_lens(baseline, first, primaries, ()), 1).processor for _ in range(RUNS))


def unpack(path: Path) -> None:
    with rawpy.imread(BytesIO(path.read_bytes())) as raw:
        _ = raw.raw_image.shape


def memory(folder: Path, lights: int) -> None:
    """Print the peak memory of a build of the EOS 6D Mark II, run as a separate program."""
    session, _ = take(folder / f"session_{lights}", "EOS 6D Mark II", lights=lights)
    session.close()
    # The figure of wait4 also counts the memory of the parent.
    program = (
        "import pathlib, sys\nfrom calibration.cli import main\ncode = main()\n"
        "print(*(line for line in pathlib.Path('/proc/self/status').open() if line.startswith('VmHWM')))\n"
        "sys.exit(code)"
    )
    command = [sys.executable, "-c", program, session.folder, folder / f"lut_{lights}"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    peak = float(output.rsplit("VmHWM:", 1)[1].split()[0]) / 1e6
    against = f"{lights} illuminants, {thread_count()} threads; expected below 2 GB for any number of illuminants"
    report(f"memory of a build, EOS 6D Mark II, {lights} illuminants", peak, "GB", against)


def chart_and_sampling(session: Session, world: World) -> None:
    """Print the cost of reading a frame, registration and sampling."""
    chart, path = session.chart, session.folder / "frames/0000_white.dng"
    copying = fastest_s(lambda: np.fromfile(path, dtype=np.uint8).sum())
    reading = fastest_s(lambda: read_raw(path))
    report("read a raw frame", reading, "s", "-")
    report("read a raw frame, ratio", reading / copying, "1", "reading the bytes of the file and adding them")
    mosaic = read_raw(path)
    registering = fastest_s(lambda: register(mosaic, chart), runs=2)
    report("register the chart and its 32 768 patches", registering, "s", "once, and after a bump")
    report("register the chart, ratio", registering / reading, "1", "reading a frame")
    registration = register(mosaic, chart)
    distance = np.linalg.norm(registration.to_pixels(chart.centres_mm) - world.project(chart.centres_mm), axis=1)
    report("patch centres, RMS", float(np.sqrt((distance**2).mean())), "px", "World.project, default room")
    report("patch centres, worst", float(distance.max()), "px", "World.project, default room")
    black = frame_black(mosaic)
    sites = sites_at(registration.to_pixels(chart.centres_mm), (mosaic.counts.shape[0] // 2, 2601))
    flat_field = np.ones((len(chart.colours), 3))
    sampling = fastest_s(lambda: gather_values(mosaic, black, sites, flat_field))
    report("sample a frame", sampling, "s", "-")
    report("sample a frame, ratio", sampling / reading, "1", "reading a frame")


BENCHMARK_PARTS = ("memory", "chart", "DNG", "CR2")


def main() -> None:
    """Measure the parts named on the command line, or all."""
    selected_parts = parse_words(__doc__, BENCHMARK_PARTS) or BENCHMARK_PARTS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for lights in (4, 12) if "memory" in selected_parts else ():
            memory(folder, lights)
            shutil.rmtree(folder / f"session_{lights}")
        if {"chart", "DNG"} & set(selected_parts):
            session, world = take(folder / "session")
            if "chart" in selected_parts:
                chart_and_sampling(session, world)
            if "DNG" in selected_parts:
                compare(session, folder / "lut", "DNG")
            session.close()
            shutil.rmtree(session.folder)
        if "CR2" in selected_parts:
            session, _ = take(folder / "session_cr2", cr2=True)
            compare(session, folder / "lut_cr2", "CR2")
            session.close()


if __name__ == "__main__":
    main()
