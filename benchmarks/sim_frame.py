"""Time for a simulated 18 Mpx frame: `python -m benchmarks.sim_frame` prints one JSON object per line.

Times are processor seconds of all threads, the shortest of several runs, so that other load has little effect. Each
time is also given relative to a simple calculation on the same number of pixels.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from datetime import UTC, datetime
from io import BytesIO

import numpy as np

from drivers.presenter import WHITE
from sim.camera.film import write_dng
from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import REFERENCE_EXPOSURE, Room, World

PAGE_MM = (1189.0, 841.0)
CELLS = (221, 155)
RUNS = 5


def sheet() -> Print:
    """Return an A0 sheet with as many random patches as the chart."""
    cell = 5.29
    x, y = (grid.ravel() for grid in np.meshgrid(10 + cell * np.arange(CELLS[0]), 10 + cell * np.arange(CELLS[1])))
    boxes = np.stack([x, y, x + cell, y + cell], axis=-1).astype(np.float64)
    rgb = (np.random.default_rng(0).integers(0, 32, (len(boxes), 3)) * 8).astype(np.uint8)
    return Print(PAGE_MM, boxes, rgb)


def fastest_s(work: Callable[[], object], runs: int = RUNS) -> float:
    """Return the shortest processor time of several runs, in seconds."""
    times: list[float] = []
    for _ in range(runs):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def main() -> None:
    body = BODIES["EOS 550D"]
    # A small world first compiles the loops, or reads them from the cache of numba.
    World(sheet(), BODIES["Test"], Room()).expose(WHITE, REFERENCE_EXPOSURE, key=(0,))

    world = World(sheet(), body, Room())
    rendering = fastest_s(lambda: world.expose(WHITE, REFERENCE_EXPOSURE, key=(0,)), runs=1)
    frame = world.expose(WHITE, REFERENCE_EXPOSURE, key=(0,))
    exposing = fastest_s(lambda: world.expose(WHITE, REFERENCE_EXPOSURE, key=(1,)))

    def write() -> None:
        write_dng(BytesIO(), frame, body, settings=REFERENCE_EXPOSURE, taken_at=datetime(2021, 1, 1, tzinfo=UTC))

    writing = fastest_s(write)
    random = np.random.Generator(np.random.SFC64(0))
    noise = np.empty(body.sensor, dtype=np.float32)
    drawing = fastest_s(lambda: random.standard_normal(out=noise, dtype=np.float32))
    planes = np.ones((3, *body.sensor), dtype=np.float32)
    passing = fastest_s(lambda: planes.sum(axis=0).astype(np.uint16))
    copying = fastest_s(lambda: BytesIO().write(frame.data))

    report("rendering of one world", rendering - exposing, "s", "none; once per world")
    report("frame", exposing, "s", "none")
    report("frame / noise", exposing / drawing, "1", "numpy standard_normal, float32, same size")
    report("frame / one pass of memory", exposing / passing, "1", "numpy sum of three float32 planes to uint16")
    report("DNG", writing, "s", "none")
    report("DNG / copy", writing / copying, "1", "copying the counts into a BytesIO")
    report("frame and DNG", exposing + writing, "s", "limit 1.5 s on one core")


if __name__ == "__main__":
    main()
