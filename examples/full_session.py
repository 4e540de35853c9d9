"""A complete table, for once not in small: 707 lights, 32 768 colours, full-size frames of a simulated camera.

The camera is an EOS 550D unless ``--body`` names the paper's other one, the EOS 6D Mark II.

`make full-session` prints chart and lights, takes the session in the simulated lab, builds and verifies the table, and
tells what each step took: time, memory, disk. The table stays; the session's raw files, some 27 GB, are removed at the
end unless asked for. A session that was interrupted is taken up again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

NEEDED_GB = 60
BODIES = ("EOS 550D", "EOS 6D Mark II")
LAB = """\
rig = "simulated"
chart = "chart/chart.json"
illuminations = "illuminations.csv"

[simulated]
body = "{body}"
"""


def size_gb(folder: Path) -> float:
    """Return what a folder takes on the disk, GB."""
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if path.is_file()) / 1e9


def step(out: Path, result: str, command: str, *arguments: str) -> None:
    """Run one of our commands in the folder `out` and tell what it took and what its result takes on the disk."""
    start = time.perf_counter()
    program = Path(sys.executable).with_name(command)
    child = subprocess.Popen([program, *arguments], cwd=out)
    _, status, used = os.wait4(child.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code:
        sys.exit(f"{command} {' '.join(arguments)} ended with {code}")
    place = out / result
    print(
        f"{command:18}{time.perf_counter() - start:8.1f} s{used.ru_utime + used.ru_stime:8.1f} s of processor"
        f"{used.ru_maxrss / 1e6:8.2f} GB of memory"
        f"{size_gb(place) if place.is_dir() else place.stat().st_size / 1e9:8.2f} GB on the disk",
        flush=True,
    )


def main() -> None:
    """Take, build, verify, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for everything")
    parser.add_argument("--body", choices=BODIES, default=BODIES[0], help="the simulated camera")
    parser.add_argument("--keep-session", action="store_true", help="do not remove the raw files at the end")
    chosen = parser.parse_args()
    out: Path = chosen.out
    out.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out).free / 1e9
    if free < NEEDED_GB and not (out / "session").exists():
        sys.exit(f"{out}: {free:.0f} GB are free, expected {NEEDED_GB} GB; give a folder on a larger disk")
    if not (out / "illuminations.csv").exists():
        step(out, "chart", "acquire", "chart", "chart", "--no-tiff")
        step(out, "illuminations.csv", "acquire", "illuminations", "illuminations.csv")
        (out / "LAB.toml").write_text(LAB.format(body=chosen.body))
    step(out, "session", "acquire", "run", "LAB.toml", "session")
    if not (out / "lut").exists():
        step(out, "lut", "build-lut", "session", "lut")
    step(out, "lut", "build-lut", "verify", "lut", "session")
    step(out, "lut", "build-lut", "info", "lut")
    if not chosen.keep_session:
        shutil.rmtree(out / "session")


if __name__ == "__main__":
    main()
