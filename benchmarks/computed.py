"""How far a computed table is from a photographed one of the same camera, chart and lights, in units of their noise.

`python -m benchmarks.computed [COMPUTED PHOTOGRAPHED] [--every N]` prints one JSON object a line for each figure.
Without tables it takes a session of 13 lights in the simulated room, with a chart of 512 colours before the small body,
and computes the same; a minute.

Every cell's mean in one table is compared with its mean in the other under every N-th light, the lights' brightness
taken out by their green ground truth (a photographed session's lamp ages). Of two tables that differ by noise alone,
the difference over its standard error follows Student's t: mean 0, standard deviation 1.02 with 2 · 24 degrees of
freedom.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquisition.run.run import run_session
from calibration.pipeline.build import build
from calibration.table.lut import Lut, open_lut
from calibration.table.verification import require_match
from experiment.chart.layout import A_SERIES_MM, design_chart
from experiment.config import LabSettings, SimulatedSettings
from experiment.lights import plan_illuminations, save_illuminations
from experiment.session.folder import Session
from sim.world.sensors import find_body
from synthesis.settings import TableSettings, table_room
from synthesis.table import TableTask, compute_table

# Mean of a channel over the cells below which values cut off at 0 are compared with values cut off at 0.
LEAST_COUNTS = 30.0


def report(name: str, value: float, unit: str, against: str) -> None:
    """Print one figure."""
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def compare(computed: Lut, photographed: Lut, every: int) -> None:
    """Print how two tables differ."""
    require_match(computed, photographed)
    unfit = {cell.colour for lut in (computed, photographed) for cell in lut.provenance.unfit}
    fit = np.array([colour for colour in range(computed.samples.shape[1]) if colour not in unfit])
    normal: list[np.ndarray] = []
    spread: list[np.ndarray] = []
    shift: list[np.ndarray] = []
    for light in range(0, len(computed.white), every):
        gain = float(computed.white[light, 1] / photographed.white[light, 1])
        ours, theirs = (
            np.asarray(lut.samples[light], dtype=np.float64)[fit] / scale
            for lut, scale in ((computed, gain), (photographed, 1.0))
        )
        lit = theirs.mean(axis=(0, 1)) > LEAST_COUNTS
        variances = ours.var(axis=1, ddof=1), theirs.var(axis=1, ddof=1)
        apart = ours.mean(axis=1) - theirs.mean(axis=1)
        normal.append((apart / np.sqrt((variances[0] + variances[1]) / ours.shape[1]))[:, lit].ravel())
        spread.append(np.sqrt(variances[0].mean(axis=0) / variances[1].mean(axis=0))[lit])
        shift.append((apart.mean(axis=0) / theirs.mean(axis=(0, 1)))[lit])
    z = np.concatenate(normal)
    student = "1.02: noise alone, Student's t of 48 degrees of freedom"
    report("difference over its standard error, standard deviation", float(z.std()), "", student)
    report("the same, mean", float(z.mean()), "", "0")
    report("the same, beyond 4", float((np.abs(z) > 4).mean()), "share", "0.00022 of Student's t")
    report("the same, largest", float(np.abs(z).max()), "", f"{z.size} cells, lights and channels")
    ratios = np.concatenate(spread)
    report("standard deviation of a cell's samples, ratio, mean over lights", float(ratios.mean()), "", "1")
    report("the same, furthest light and channel", float(ratios[np.abs(ratios - 1).argmax()]), "", "1")
    shifts = np.concatenate(shift)
    report("mean of all cells, largest relative difference under a light", float(np.abs(shifts).max()), "", "0")
    truth = np.log(computed.ground_truth / photographed.ground_truth)
    report("chromaticity of the ground truth, median relative difference", float(np.median(np.abs(truth))), "", "0")
    dark = [
        np.asarray(lut.samples[light, 0], dtype=np.float64).mean() / lut.white[light].mean()
        for lut in (computed, photographed)
        for light in range(0, len(lut.white), every)
    ]
    half = len(dark) // 2
    report("black cell over white, computed", float(np.mean(dark[:half])), "", f"{np.mean(dark[half:]):.4f}")
    brightness = computed.white[:, 1] / photographed.white[:, 1]
    report("brightness, mean ratio", float(brightness.mean()), "", "1, and what a lamp loses over a session")


def small_tables(folder: Path) -> tuple[Lut, Lut]:
    """Return a computed and a photographed table of a small chart."""
    chart = design_chart(3, A_SERIES_MM["A5"], 1)
    lights = plan_illuminations(3, (2500, 4500, 6500))
    chart.save(folder / "chart.json")
    save_illuminations(lights, folder / "illuminations.csv")
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body="Test", room={"waviness_mm": 0.5, "vignetting": 0.08}),
    )
    run_session(settings, folder / "session", lambda done, total: None)
    with Session.open(folder / "session") as session:
        build(session, folder / "photographed")
    room = replace(table_room(TableSettings(), "here"), waviness_mm=0.5, vignetting=0.08)
    task = TableTask(
        chart, find_body("Test"), room, settings.camera.exposure, lights, None, 5, {"by": "benchmarks.computed"}
    )
    compute_table(task, folder / "computed", threads=2)
    return open_lut(folder / "computed"), open_lut(folder / "photographed")


def main() -> None:
    """Compare two tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", type=Path, metavar="LUT", help="a computed and a photographed table")
    parser.add_argument("--every", type=int, default=1, help="compare every N-th light")
    given = parser.parse_args()
    if len(given.tables) == 2:
        compare(open_lut(given.tables[0]), open_lut(given.tables[1]), given.every)
        return
    if given.tables:
        parser.error("two tables expected, or none")
    with tempfile.TemporaryDirectory() as folder:
        compare(*small_tables(Path(folder)), given.every)


if __name__ == "__main__":
    main()
