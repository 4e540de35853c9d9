"""Accuracy of patch positions without tags: the grid of the paper (256 × 128 patches on A0) on sheets with waves.

`python -m benchmarks.plain [--rooms N]` registers a frame in each of N rooms, for each camera and waviness. It prints
one JSON object per line: the RMS and the largest distance of the registered patch centres from the true ones
(`World.project`), in the worst room. The exit code is 1 if a limit (`LIMITS_PX`) is exceeded. A room takes about half a
minute on one core.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

import numpy as np

from benchmarks.rooms import Case, photographed
from calibration.registration.register import register
from experiment.chart.layout import paper_chart
from sim.world.sensors import BODIES
from sim.world.world import Room

# Limits of the RMS and the largest distance, px, for each waviness in mm.
LIMITS_PX = {0.5: (0.05, 0.5), 3.0: (0.05, 0.5), 6.0: (0.1, 0.7)}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=2, help="number of rooms for each camera and waviness")
    rooms: int = parser.parse_args(arguments).rooms
    chart = paper_chart()
    exceeded = False
    for body in (name for name in sorted(BODIES) if name != "Test"):
        for waviness, (rms_limit, worst_limit) in LIMITS_PX.items():
            rms = worst = 0.0
            for seed in range(1, rooms + 1):
                shot = photographed(Case(seed, body, "white", Room(waviness_mm=waviness, seed=seed)), chart)
                error = shot.miss_px(register(shot.mosaic, chart, f"room {seed}", shot.corners_px()))
                rms = max(rms, float(np.sqrt((error**2).mean())))
                worst = max(worst, float(error.max()))
            exceeded |= rms > rms_limit or worst > worst_limit
            for name, value, limit in (("RMS", rms, rms_limit), ("worst", worst, worst_limit)):
                figure = {"name": f"plain chart, {body}, waves of {waviness:g} mm, patch centres, {name}"}
                against = f"World.project, worst of {rooms} rooms, limit {limit:g}"
                print(json.dumps(figure | {"value": round(value, 4), "unit": "px", "against": against}), flush=True)
    return int(exceeded)


if __name__ == "__main__":
    raise SystemExit(main())
