"""Make a full-size LUT: 707 illuminants, 32 768 colours, full-size frames of a simulated camera.

The camera is an EOS 550D; ``--body`` selects the other camera of the paper, the EOS 6D Mark II.

`make full-session` makes chart and illuminants, takes the session in the simulated laboratory, and builds and verifies
the LUT. It prints the time, memory and disk space of each step. At the end, the session with about 27 GB of raw files
is removed, unless `--keep-session` is given. If the program is interrupted, the next call resumes the session.
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
    """Return the disk space of a folder, GB."""
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if path.is_file()) / 1e9


def step(out: Path, result: str, command: str, *arguments: str) -> None:
    """Run one of our commands in the folder `out` and print its time, its memory and the size of its result."""
    start = time.perf_counter()
    program = Path(sys.executable).with_name(command)
    child = subprocess.Popen([program, *arguments], cwd=out)
    _, status, usage = os.wait4(child.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code:
        sys.exit(f"{command} {' '.join(arguments)} ended with exit code {code}; see its message above")
    path = out / result
    print(
        f"{command:18}{time.perf_counter() - start:8.1f} s{usage.ru_utime + usage.ru_stime:8.1f} s processor"
        f"{usage.ru_maxrss / 1e6:8.2f} GB memory"
        f"{size_gb(path) if path.is_dir() else path.stat().st_size / 1e9:8.2f} GB disk",
        flush=True,
    )


def main() -> None:
    """Make, build and verify."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for all files")
    parser.add_argument("--body", choices=BODIES, default=BODIES[0], help="simulated camera")
    parser.add_argument("--keep-session", action="store_true", help="keep the raw files")
    options = parser.parse_args()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    free_gb = shutil.disk_usage(out).free / 1e9
    if free_gb < NEEDED_GB and not (out / "session").exists():
        sys.exit(f"{out}: {free_gb:.0f} GB are free, expected {NEEDED_GB} GB; give a folder on a larger disk")
    if not (out / "illuminations.csv").exists():
        step(out, "chart", "acquire", "chart", "chart", "--no-tiff")
        step(out, "illuminations.csv", "acquire", "illuminations", "illuminations.csv")
        (out / "LAB.toml").write_text(LAB.format(body=options.body))
    step(out, "session", "acquire", "run", "LAB.toml", "session")
    if not (out / "lut").exists():
        step(out, "lut", "build-lut", "session", "lut")
    step(out, "lut", "build-lut", "verify", "lut", "session")
    step(out, "lut", "build-lut", "info", "lut")
    if not options.keep_session:
        shutil.rmtree(out / "session")


if __name__ == "__main__":
    main()
