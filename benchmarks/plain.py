"""How true the places of a chart without tags are: the paper's grid of 256 × 128 cells on A0, on sheets that wave.

`python -m benchmarks.plain [--rooms N]` registers N rooms for each camera and waviness and prints one JSON object a
line: RMS and worst distance of the cells' centres from `World.project`, the worst of the rooms. Limits: 0.05 px RMS and
0.5 px worst at 3 mm, 0.1 and 0.7 px at 6 mm; 1 when one is exceeded. About half a minute a room on one core.
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

# RMS and worst, px, for each waviness in mm.
LIMITS_PX = {0.5: (0.05, 0.5), 3.0: (0.05, 0.5), 6.0: (0.1, 0.7)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Register rooms and print how far cells lie from the truth; 1 when a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=2, help="for each camera and waviness")
    rooms: int = parser.parse_args(arguments).rooms
    chart = paper_chart()
    exceeded = False
    for body in (name for name in sorted(BODIES) if name != "Test"):
        for waviness, (rms_limit, worst_limit) in LIMITS_PX.items():
            rms = worst = 0.0
            for seed in range(1, rooms + 1):
                hung = photographed(Case(seed, body, "white", Room(waviness_mm=waviness, seed=seed)), chart)
                error = hung.miss_px(register(hung.mosaic, chart, f"room {seed}", hung.corners_px()))
                rms = max(rms, float(np.sqrt((error**2).mean())))
                worst = max(worst, float(error.max()))
            exceeded |= rms > rms_limit or worst > worst_limit
            for name, value, limit in (("RMS", rms, rms_limit), ("worst", worst, worst_limit)):
                figure = {"name": f"plain chart, {body}, waves of {waviness:g} mm, cell centres' {name}"}
                against = f"World.project, worst of {rooms} rooms, limit {limit:g}"
                print(json.dumps(figure | {"value": round(value, 4), "unit": "px", "against": against}), flush=True)
    return int(exceeded)


if __name__ == "__main__":
    raise SystemExit(main())
