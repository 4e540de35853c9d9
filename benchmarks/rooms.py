"""Rooms that nothing was tuned for: whole charts hung in random rooms, registered, and held against the truth.

`python -m benchmarks.rooms [--rooms N] [--first SEED]` prints one JSON object a line for each room, then a summary.
A room fails loudly when registration refuses it, which is honest, and silently when it is accepted and a cell lies
`SILENT_PX` or more from the truth, which must not happen. About 10 s a room on one core.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.layout import A_SERIES_MM, design_chart
from acquisition.printing import drawing
from calibration.registration import register
from drivers.camera import ExposureSettings
from drivers.errors import CropError
from drivers.presenter import WHITE, Colour
from drivers.rawfile import read_raw
from sim.bodies import BODIES
from sim.dng import write_dng
from sim.world import Print, Room, World

SILENT_PX = 1.0
"""A cell this far off lies beyond what its samples' window allows for, 0.25 px, by enough to hold another colour."""

SETTINGS = ExposureSettings(iso=100, aperture=8.0, shutter_s=0.5)
TAKEN_AT = datetime(2024, 3, 1, 9, 0, tzinfo=UTC)
LIGHTS = {"white": WHITE, "deep red": Colour(255, 0, 0), "deep blue": Colour(0, 0, 255), "dim": Colour(110, 70, 20)}


@dataclass(frozen=True)
class Case:
    """A room, a camera and a light."""

    seed: int
    body: str
    light: str
    room: Room


def random_case(seed: int) -> Case:
    """Return the case of a seed: perspective to 15°, waves to 6 mm, blur 0.4 to 0.9 px, vignetting to 40 %."""
    random = np.random.default_rng([20, seed])
    tilt, pan = random.uniform(-10.6, 10.6, 2)
    room = Room(
        seed=seed + 1000,
        # Perspective and rotation take room in the frame.
        fill=float(random.uniform(0.86, 0.92)),
        focal_diagonals=float(random.uniform(0.9, 2.0)),
        tilt_deg=float(tilt),
        pan_deg=float(pan),
        roll_deg=float(random.uniform(-2, 2) + (180 if random.random() < 0.15 else 0)),
        k1=float(random.uniform(-0.08, 0.05)),
        k2=float(random.uniform(-0.02, 0.02)),
        p1=float(random.uniform(-5e-4, 5e-4)),
        p2=float(random.uniform(-5e-4, 5e-4)),
        waviness_mm=float(random.uniform(0, 6)),
        blur_px=float(random.uniform(0.4, 0.9)),
        vignetting=float(random.uniform(0, 0.4)),
        projector_falloff=float(random.uniform(0, 0.3)),
        primary_difference=float(random.uniform(0, 0.3)),
        lamp_spectrum="led" if random.random() < 0.5 else "uhp",
        ambient=float(random.choice([0, 0.002, 0.01])),
    )
    body = str(random.choice([name for name in sorted(BODIES) if name != "Test"]))
    return Case(seed, body, str(random.choice(sorted(LIGHTS), p=[0.2, 0.2, 0.1, 0.5])), room)


def miss(case: Case, bits: int = 5, page: str = "A0") -> npt.NDArray[np.float64]:
    """Return how far each registered cell lies from the truth, px.

    Raises
    ------
    QualityError
        The room was refused.
    """
    chart = design_chart(bits, A_SERIES_MM[page], case.seed)
    drawn = drawing(chart)
    world = World(Print(drawn.page_mm, drawn.rectangles_mm, drawn.rgb), BODIES[case.body], case.room)
    stream = BytesIO()
    write_dng(
        stream, world.expose(LIGHTS[case.light], SETTINGS, key=(1,)), world.body, settings=SETTINGS, taken_at=TAKEN_AT
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.dng"
        path.write_bytes(stream.getvalue())
        mosaic = read_raw(path)
    visible = world.body.visible
    aside = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
    found = register(mosaic, chart, f"room {case.seed}").to_pixels(chart.centres_mm)
    return np.linalg.norm(found - world.project(chart.centres_mm) + aside, axis=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Try rooms and print what became of each; 1 when one failed silently."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args(arguments)
    worst: list[tuple[float, float]] = []
    loud = silent = 0
    for seed in range(given.first, given.first + given.rooms):
        case, started = random_case(seed), time.perf_counter()
        told: dict[str, object] = {"room": seed, "body": case.body, "light": case.light}
        try:
            error = miss(case)
        except CropError as refused:
            loud += 1
            told["refused"] = str(refused)
        else:
            worst.append((float(np.sqrt((error**2).mean())), float(error.max())))
            told |= {"rms_px": round(worst[-1][0], 4), "max_px": round(worst[-1][1], 3)}
            silent += worst[-1][1] >= SILENT_PX
        told["seconds"] = round(time.perf_counter() - started, 1)
        print(json.dumps(told), flush=True)
    against = f"{given.rooms} random rooms"
    figures = {"rooms refused": loud, "rooms wrong without a word": silent}
    for name, value in figures.items():
        print(json.dumps({"name": name, "value": value, "unit": "rooms", "against": against}))
    if worst:
        rms, largest = np.array(worst).T
        for name, value in (
            ("cell centres, worst room's RMS", rms.max()),
            ("cell centres, median room's RMS", np.median(rms)),
            ("cell centres, worst of all", largest.max()),
        ):
            print(json.dumps({"name": name, "value": round(float(value), 4), "unit": "px", "against": against}))
    return int(silent > 0)


if __name__ == "__main__":
    raise SystemExit(main())
