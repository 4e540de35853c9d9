"""How true a table is: a session of full-size frames in the default simulated room, built, and held against the room.

`python -m benchmarks.accuracy` prints one JSON object a line for each figure, for both cameras; takes minutes.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from acquisition.config import LabSettings, SimulatedSettings
from acquisition.illuminations import plan_illuminations, save_illuminations
from acquisition.layout import design_chart
from acquisition.rig import sheet, simulated_body, simulated_room
from acquisition.session import Session
from acquisition.taking import run_session
from calibration.build import build
from calibration.lut import open_lut
from sim.bodies import BODIES
from sim.world import World

WELL_LIT_DN = 300


def report(name: str, value: float, unit: str, against: str) -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def measure(body: str, folder: Path) -> None:
    """Take, build and judge one session of twelve lights."""
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body=body, seed=20),
    )
    chart = design_chart(seed=20)
    chart.save(settings.chart)
    lights = plan_illuminations(grid=2, ccts_k=range(2500, 10001, 1500))
    save_illuminations(lights, settings.illuminations)
    run_session(settings, folder / "session", lambda done, total: None)
    with Session.open(folder / "session") as session:
        result = build(session, folder / "lut")
    lut = open_lut(folder / "lut")
    world = World(sheet(chart), simulated_body(settings), simulated_room(settings))
    assert result.registration is not None
    offset = result.registration.to_pixels(chart.centres_mm) - world.project(chart.centres_mm)
    distance = np.linalg.norm(offset, axis=1)
    report(f"{body}: cell centres, RMS", float(np.sqrt((distance**2).mean())), "px", "World.project, default room")
    report(
        f"{body}: cell centres, worst of {len(distance)}", float(distance.max()), "px", "World.project, default room"
    )
    exposure = settings.camera.exposure
    truth = np.array([world.white(light.colour, exposure) for light in lights])
    cosine = (truth * lut.white).sum(1) / np.linalg.norm(truth, axis=1) / np.linalg.norm(lut.white, axis=1)
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    report(f"{body}: ground truth, median angle", float(np.median(degrees)), "degrees", "World.white, 12 lights")
    report(f"{body}: ground truth, worst angle", float(degrees.max()), "degrees", "World.white, 12 lights")
    errors: list[np.ndarray] = []
    codes = chart.rgb[chart.cell_of_colour]
    for number, light in enumerate(lights):
        mean = lut.samples[number].astype(np.float64).mean(axis=1) / lut.white[number]
        true = world.reflected(codes, light.colour, exposure) / truth[number]
        lit = true * lut.white[number] > WELL_LIT_DN
        errors.append((mean / true - 1)[lit])
    error = np.concatenate(errors)
    report(
        f"{body}: means of 25 samples above {WELL_LIT_DN} counts, relative error, RMS",
        float(np.sqrt((error**2).mean()) * 100),
        "%",
        "World.reflected over World.white",
    )
    report(f"{body}: cells unfit", len(lut.provenance.unfit), "cells", f"{chart.colour_count} cells")


def main() -> int:
    """Measure both full-size bodies."""
    for body in BODIES:
        if body != "Test":
            with tempfile.TemporaryDirectory() as folder:
                measure(body, Path(folder))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
