"""What a table costs: `python -m benchmarks.build_lut` prints one JSON object a line for each figure; takes a minute.

A short session of full-size frames of the EOS 550D (uncompressed DNG, as the simulated camera writes them) is built as
`build-lut` builds it. Times are the least of several runs; each is given beside a plain pass over the same file, so
that the machine's speed cancels. A CR2 costs its decoding on top: about 0.5 s of one thread.
"""

from __future__ import annotations

import hashlib
import json
import resource
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path

import numpy as np

from acquisition.framing import frame_black, strongest_plane
from acquisition.illuminations import plan_illuminations
from acquisition.layout import design_chart
from acquisition.printing import drawing
from acquisition.session import ACCEPTED, Session, plan_steps
from calibration.build import build
from calibration.registration import register
from calibration.sampling import gather, sites_at, table_values
from drivers.rawfile import read_raw
from sim.bodies import BODIES
from sim.dng import write_dng
from sim.world import REFERENCE_EXPOSURE, Print, Room, World

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


def take(folder: Path) -> tuple[Session, World]:
    """Return a session of eleven lights, and the room it was taken in."""
    chart = design_chart()
    picture = drawing(chart)
    world = World(Print(picture.page_mm, picture.rectangles_mm, picture.rgb), BODIES["EOS 550D"], Room())
    lights = plan_illuminations(grid=1, ccts_k=range(2500, 10001, 1000))
    session = Session.create(folder, "", chart, lights)
    at = datetime(2024, 3, 1, tzinfo=UTC)
    for step in plan_steps(lights, 25):
        stream = BytesIO()
        counts = world.expose(step.colour, REFERENCE_EXPOSURE, key=(step.number,))
        write_dng(stream, counts, world.body, settings=REFERENCE_EXPOSURE, taken_at=at)
        data, file = stream.getvalue(), f"frames/{step.stem}.dng"
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
        marks: list[float] = []
        build(session, folder / "lut", lambda done, total, what: marks.append(time.perf_counter()))
        # The first mark is set before the chart is sought, the last when all frames are done.
        frames = len(marks) - 3
        report("one frame of a build", (marks[-2] - marks[1]) / frames, "s", "two threads decode")
        report("one frame of a build, ratio", (marks[-2] - marks[1]) / frames / reading, "1", "reading a frame alone")
        session.close()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    report("memory at most, the simulated room included", peak, "GB", "0.35 GB of which are the room's light")


if __name__ == "__main__":
    main()
