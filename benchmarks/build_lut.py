"""What a table costs: `python -m benchmarks.build_lut` prints one JSON object a line for each figure; takes a minute.

A short session of full-size frames of the EOS 550D is built as `build-lut` builds it, once as the uncompressed DNG that
the simulated camera writes and once with the same counts as CR2 (lossless JPEG, as the real body). Times are the least
of several runs; each is given beside a plain pass over the same files in the same run, so that the machine's speed
cancels: rawpy's unpacking alone, in as many threads as the build decodes with, and dcraw, where it is installed.
"""

from __future__ import annotations

import hashlib
import json
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path

import numpy as np
import rawpy

from acquisition.illuminations import plan_illuminations
from acquisition.layout import design_chart
from acquisition.planes import frame_black, strongest_plane
from acquisition.printing import drawing
from acquisition.session import ACCEPTED, Session, plan_steps
from calibration.build import THREADS, build
from calibration.registration import register
from calibration.sampling import gather, sites_at, table_values
from drivers.rawfile import read_raw
from sim.bodies import BODIES
from sim.dng import write_dng
from sim.world import REFERENCE_EXPOSURE, Print, Room, World
from tests.drivers.raw_files import write_cr2

RUNS = 4


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


def take(folder: Path, cr2: bool = False) -> tuple[Session, World]:
    """Return a session of eleven lights as DNG or CR2, and the room it was taken in."""
    chart = design_chart()
    picture = drawing(chart)
    world = World(Print(picture.page_mm, picture.rectangles_mm, picture.rgb), BODIES["EOS 550D"], Room())
    lights = plan_illuminations(grid=1, ccts_k=range(2500, 10001, 1000))
    session = Session.create(folder, "", chart, lights)
    at = datetime(2024, 3, 1, tzinfo=UTC)
    for step in plan_steps(lights, 25):
        stream = BytesIO()
        counts = world.expose(step.colour, REFERENCE_EXPOSURE, key=(step.number,))
        file = f"frames/{step.stem}.{'cr2' if cr2 else 'dng'}"
        if cr2:
            write_cr2(folder / file, counts, "Canon EOS 550D")
            data = (folder / file).read_bytes()
        else:
            write_dng(stream, counts, world.body, settings=REFERENCE_EXPOSURE, taken_at=at)
            data = stream.getvalue()
        at += timedelta(seconds=4)
        attempt = session.begin(step, file, at)
        (folder / file).write_bytes(data)
        session.commit(
            attempt,
            file=file,
            size=len(data),
            sha256=hashlib.sha256(data).hexdigest(),
            taken_at=at,
            exposure_s=REFERENCE_EXPOSURE.shutter_s,
            ended_at=at,
            verdict=ACCEPTED,
        )
    return session, world


def compare(session: Session, out: Path, kind: str) -> None:
    """Build a session's table and print what a frame costs, beside unpacking and dcraw of the same files."""
    marks: list[float] = []
    build(session, out, lambda done, total, what: marks.append(time.perf_counter()))
    # The first mark is set before the chart is sought, the second when the first frame is done, the last after all.
    each = (marks[-2] - marks[1]) / (len(marks) - 3)
    files = [session.folder / record.file for record in session.frames() if record.kind != "dark"]

    def unpack_all() -> None:
        with ThreadPoolExecutor(THREADS) as threads:
            list(threads.map(unpack, files))

    unpacking = least(unpack_all, runs=2) / len(files)
    report(f"one frame of a build, {kind}", each, "s", f"{THREADS} threads decode")
    report(
        f"one frame of a build, {kind}, to unpacking", each / unpacking, "1", f"rawpy's unpack alone, {THREADS} threads"
    )
    dcraw = shutil.which("dcraw")
    if dcraw is not None:
        command = [dcraw, "-D", "-4", "-T", "-c"]

        def develop() -> None:
            for file in files[:4]:
                subprocess.run([*command, file], stdout=subprocess.DEVNULL, check=True)

        developing = least(develop, runs=1) / 4
        report(f"one frame of a build, {kind}, to dcraw", each / developing, "1", "dcraw -D -4 -T of it alone")


def unpack(path: Path) -> None:
    """Read and unpack a raw file, and do nothing with it."""
    with rawpy.imread(BytesIO(path.read_bytes())) as raw:
        _ = raw.raw_image.shape


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, world = take(folder / "session")
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
        sampling = least(lambda: table_values(gather(mosaic, black, sites)[0], even))
        report("sample a frame", sampling, "s", "-")
        report("sample a frame, ratio", sampling / reading, "1", "reading a frame")
        report("judge a frame's light and planes", least(lambda: strongest_plane(mosaic, black)), "s", "-")
        compare(session, folder / "lut", "DNG")
        session.close()
        # Before CR2 files are written here, which takes gigabytes.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        report("memory at most, the simulated room included", peak, "GB", "0.35 GB of which are the room's light")
        session, _ = take(folder / "session_cr2", cr2=True)
        compare(session, folder / "lut_cr2", "CR2")
        session.close()


if __name__ == "__main__":
    main()
