"""Differences between a computed and a photographed LUT of the same camera and chart, relative to their noise.

`python -m benchmarks.computed [COMPUTED PHOTOGRAPHED] [--every N]` prints one JSON object per result and line. Without
LUTs it takes a session of 13 illuminants in a simulated room (chart of 512 colours, small body) and computes the same
LUT; this takes a minute.

The patch means of both LUTs are compared under every N-th illuminant. The lamp of a photographed session ages, so both
LUTs are first scaled to the same green value of white. If two LUTs differ by noise alone, difference / standard error
has Student's t distribution with 2 · 24 degrees of freedom: mean 0, standard deviation 1.02.
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
from experiment.lights import plan_illuminants, save_illuminants
from experiment.session.folder import Session
from sim.world.sensors import find_body
from synthesis.settings import TableSettings, table_room
from synthesis.table import TableTask, compute_table

# Mean count of a channel below which clipping at 0 distorts the noise; such channels are excluded.
LEAST_COUNTS = 30.0


def report(name: str, value: float, unit: str, against: str) -> None:
    print(json.dumps({"name": name, "value": float(f"{value:.3g}"), "unit": unit, "against": against}), flush=True)


def compare(computed: Lut, photographed: Lut, every: int) -> None:
    """Print the differences of two LUTs."""
    require_match(computed, photographed)
    unfit = {cell.colour for lut in (computed, photographed) for cell in lut.provenance.unfit}
    fit = np.array([colour for colour in range(computed.samples.shape[1]) if colour not in unfit])
    scores: list[np.ndarray] = []
    ratios_by_light: list[np.ndarray] = []
    offsets_by_light: list[np.ndarray] = []
    for light in range(0, len(computed.white), every):
        gain = float(computed.white[light, 1] / photographed.white[light, 1])
        computed_dn, photo_dn = (
            np.asarray(lut.samples[light], dtype=np.float64)[fit] / scale
            for lut, scale in ((computed, gain), (photographed, 1.0))
        )
        lit = photo_dn.mean(axis=(0, 1)) > LEAST_COUNTS
        variances = computed_dn.var(axis=1, ddof=1), photo_dn.var(axis=1, ddof=1)
        diffs = computed_dn.mean(axis=1) - photo_dn.mean(axis=1)
        scores.append((diffs / np.sqrt((variances[0] + variances[1]) / computed_dn.shape[1]))[:, lit].ravel())
        ratios_by_light.append(np.sqrt(variances[0].mean(axis=0) / variances[1].mean(axis=0))[lit])
        offsets_by_light.append((diffs.mean(axis=0) / photo_dn.mean(axis=(0, 1)))[lit])
    z = np.concatenate(scores)
    student = "1.02: noise alone, Student's t of 48 degrees of freedom"
    report("difference / standard error, standard deviation", float(z.std()), "", student)
    report("difference / standard error, mean", float(z.mean()), "", "0")
    report("difference / standard error, beyond 4", float((np.abs(z) > 4).mean()), "share", "0.00022 for Student's t")
    report(
        "difference / standard error, largest",
        float(np.abs(z).max()),
        "",
        f"{z.size} patches, illuminants and channels",
    )
    ratios = np.concatenate(ratios_by_light)
    report("standard deviation of samples, ratio, mean over illuminants", float(ratios.mean()), "", "1")
    report("the same ratio, most extreme illuminant and channel", float(ratios[np.abs(ratios - 1).argmax()]), "", "1")
    offsets = np.concatenate(offsets_by_light)
    report(
        "mean of all patches, largest relative difference under an illuminant", float(np.abs(offsets).max()), "", "0"
    )
    log_ratios = np.log(computed.ground_truth / photographed.ground_truth)
    report("ground truth chromaticity, median relative difference", float(np.median(np.abs(log_ratios))), "", "0")
    dark = [
        np.asarray(lut.samples[light, 0], dtype=np.float64).mean() / lut.white[light].mean()
        for lut in (computed, photographed)
        for light in range(0, len(lut.white), every)
    ]
    half = len(dark) // 2
    report("black patch / white, computed", float(np.mean(dark[:half])), "", f"{np.mean(dark[half:]):.4f}")
    brightness = computed.white[:, 1] / photographed.white[:, 1]
    report("brightness, mean ratio", float(brightness.mean()), "", "1, and the ageing of the lamp over a session")


def small_tables(folder: Path) -> tuple[Lut, Lut]:
    """Return a computed and a photographed LUT of a small chart."""
    chart = design_chart(3, A_SERIES_MM["A5"], 1)
    lights = plan_illuminants(3, (2500, 4500, 6500))
    chart.save(folder / "chart.json")
    save_illuminants(lights, folder / "illuminations.csv")
    settings = LabSettings(
        rig="simulated",
        chart=folder / "chart.json",
        illuminations=folder / "illuminations.csv",
        simulated=SimulatedSettings(body="Test", room={"waviness_mm": 0.5, "vignetting": 0.08}),
    )
    run_session(settings, folder / "session", lambda count, total: None)
    with Session.open(folder / "session") as session:
        build(session, folder / "photographed")
    room = replace(table_room(TableSettings(), "here"), waviness_mm=0.5, vignetting=0.08)
    task = TableTask(
        chart, find_body("Test"), room, settings.camera.exposure, lights, None, 5, {"by": "benchmarks.computed"}
    )
    compute_table(task, folder / "computed", threads=2)
    return open_lut(folder / "computed"), open_lut(folder / "photographed")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", type=Path, metavar="LUT", help="a computed and a photographed LUT")
    parser.add_argument("--every", type=int, default=1, help="compare every N-th illuminant")
    options = parser.parse_args()
    if len(options.tables) == 2:
        compare(open_lut(options.tables[0]), open_lut(options.tables[1]), options.every)
        return
    if options.tables:
        parser.error(f"{len(options.tables)} LUT given, two expected; name a computed and a photographed LUT, or none")
    with tempfile.TemporaryDirectory() as folder:
        compare(*small_tables(Path(folder)), options.every)


if __name__ == "__main__":
    main()
