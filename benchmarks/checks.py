"""Results of `acquire check` in simulated rooms: verdicts on both sides of the limits, and false alarms in good rooms.

    python -m benchmarks.checks              # charts of 1 to 3 bits with a small sensor: two minutes
    python -m benchmarks.checks --full       # adds the full chart with an EOS 550D: three minutes more

Good rooms are the default room with other seeds: other paper, waves, noise and photosites.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from acquisition.check.check import check_lab
from acquisition.check.findings import CheckReport, not_checked
from experiment.chart.layout import design_chart
from experiment.config import load_lab
from experiment.lights import plan_illuminants, save_illuminants

# Seeds of the good rooms.
SEEDS = range(30)

# Figure of interest, bits of the chart, and differences from the default room. If the shutter time `shutter_s` differs,
# lamp brightness is changed so that the exposure is the same.
ROOMS: tuple[tuple[str, int, dict[str, Any]], ...] = (
    *(
        ("brightest_share", 2, {"white_level_share": share})
        for share in (2e-4, 0.02, 0.35, 0.65, 0.85, 0.93, 4.0, 40.0)
    ),
    *(("leak_share", 2, {"ambient": share}) for share in (0.002, 0.01, 0.04)),
    *(("leak_share", 2, {"black_leak": share}) for share in (0.002, 0.01, 0.03)),
    *(("evenness", 3, {"projector_falloff": share}) for share in (0.3, 0.6, 0.8)),
    *(("evenness", 3, {"vignetting": share}) for share in (0.4, 0.7)),
    *(("bleed", 2, {"blur_px": blur}) for blur in (0.5, 0.8, 1.1)),
    *(("turn", 2, {"roll_deg": angle, "fill": 0.6}) for angle in (2.0, 8.0, 25.0, 90.0, 180.0)),
    *(("keystone", 2, {"pan_deg": angle, "fill": 0.7}) for angle in (5.0, 14.0, 30.0)),
    *(("unfit_share", bits, {"stain_mm": 60.0}) for bits in (1, 2, 3)),
    *(("doubtful_share", 3, {"stain_mm": 25.0, "stain_depth": depth}) for depth in (0.02, 0.1, 0.5)),
    *(("doubtful_share", 3, {"fold_mm": height}) for height in (1.0, 3.0, 5.0)),
    *(("white_drift_deg", 2, {"wheel_hz": 60.0, "shutter_s": time}) for time in (1 / 60, 0.1, 0.5)),
    *(("unfit_share", 2, {"hot_per_million": rate}) for rate in (20.0, 300.0)),
)

# The same for the full chart on A0.
FULL: tuple[tuple[str, int, dict[str, Any]], ...] = (
    *(
        ("doubtful_share", 5, {"stain_mm": size, "stain_depth": depth})
        for size, depth in ((60.0, 0.5), (25.0, 0.1), (8.0, 0.1))
    ),
    ("doubtful_share", 5, {"fold_mm": 5.0}),
    ("evenness", 5, {"vignetting": 0.4}),
)


def check(folder: Path, bits: int, room: dict[str, Any], seed: int = 1) -> CheckReport:
    """Check a room; full charts are photographed by an EOS 550D."""
    chart = folder / f"chart{bits}.json"
    if not chart.exists():
        design_chart(bits).save(chart)
        save_illuminants(plan_illuminants(1, ()), folder / "illuminations.csv")
    room = dict(room)
    shutter_s = room.pop("shutter_s", 0.5)
    if shutter_s != 0.5:
        room["white_level_share"] = 0.7 * 0.5 / shutter_s
    lab = folder / "LAB.toml"
    lab.write_text(
        f'rig = "simulated"\nchart = "{chart.name}"\nilluminations = "illuminations.csv"\n'
        f"[camera]\nshutter_s = {shutter_s:.8f}\n"
        f'[simulated]\nbody = "{"EOS 550D" if bits == 5 else "Test"}"\nseed = {seed}\n[simulated.room]\n'
        + "".join(f"{key} = {json.dumps(value)}\n" for key, value in room.items())
    )
    return check_lab(load_lab(lab))


def main() -> None:
    full = "--full" in sys.argv[1:]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        print(f"{'figure':<18}{'bits':<6}{'room':<52}{'grade':<13}message")
        for name, bits, room in (*ROOMS, *(FULL if full else ())):
            report = check(folder, bits, room)
            found = next((found for found in report.findings if found.name == name), not_checked(name, "not measured"))
            other_faults = [found.name for found in report.with_grade("fault") if found.name != name]
            differences = ", ".join(f"{key} {value:g}" for key, value in room.items())
            suffix = f" [also at fault: {', '.join(other_faults)}]" if other_faults else ""
            print(f"{name:<18}{bits:<6}{differences:<52}{found.grade:<13}{found.said[:110]}{suffix}", flush=True)
        alarm_count = 0
        for bits in (1, 2, 3):
            for seed in SEEDS:
                report = check(folder, bits, {}, seed)
                for found in (*report.with_grade("fault"), *report.with_grade("remark")):
                    alarm_count += 1
                    print(f"false alarm: {bits} bits, seed {seed}: {found.name}: {found.sentence()}")
        print(f"false alarms in {3 * len(SEEDS)} good rooms: {alarm_count}")
        if full:
            reports = [check(folder, 5, {}, seed) for seed in range(3)]
            full_alarms = [
                found for report in reports for found in (*report.with_grade("fault"), *report.with_grade("remark"))
            ]
            print(f"false alarms in 3 good rooms with the full chart: {len(full_alarms)}")


if __name__ == "__main__":
    main()
