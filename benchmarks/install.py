"""Size and start-up time of an installation, and a test that it works outside the repository.

`python -m benchmarks.install [--python PYTHON]… [--keep FOLDER]` builds the wheel, installs it with pip into a fresh
environment and runs the commands of the tutorial there, without the repository. It prints one JSON object per line: the
size of each large package, the import times of our packages, of numpy and of OpenCV, the time of `generate` for one
picture, and the time of each step of the tutorial. It needs a package index and 2 GB of disk space.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]

# Smallest size of a listed package, MB; docs/decisions/ gives the reasons for large packages.
LARGE_MB = 20

# Repetitions of an import; the fastest counts, because the first reads the disk.
ROUNDS = 5

# Code of each import, by printed name.
IMPORTS = {
    "nothing": "pass",
    "numpy and cv2": "import numpy, cv2",
    "generator": "import generator",
    "generator.training": "import generator.training",
}

# Modules that `import generator` must not load: parts of the laboratory, and slow imports.
LAB = ("acquisition", "calibration.pipeline", "sim", "rawpy", "usb", "serial", "scipy", "matplotlib", "numba")


def main(arguments: Sequence[str] | None = None) -> int:
    """Install, run, measure and print; return 1 if a step of the tutorial failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", action="append", help="Python interpreter; repeat for several")
    parser.add_argument("--keep", type=Path, help="folder that keeps the environment; otherwise it is removed")
    options = parser.parse_args(arguments)
    failed = False
    for python in options.python or [sys.executable]:
        folder = Path(tempfile.mkdtemp(prefix="install-")) if options.keep is None else options.keep.absolute()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            failed |= not _test_installation(python, folder)
        finally:
            if options.keep is None:
                shutil.rmtree(folder)
    return int(failed)


def _test_installation(python: str, folder: Path) -> bool:
    """Install with one Python and measure; return whether the whole tutorial ran."""
    _run([python, "-m", "venv", str(folder / "env")], folder)
    binaries = folder / "env" / "bin"
    version = _run([str(binaries / "python"), "-c", "import sys; print(sys.version.split()[0])"], folder).strip()
    bare = _size_mb(folder / "env")
    _run([str(binaries / "pip"), "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)], folder)
    (wheel,) = folder.glob("*.whl")
    _report(version, "wheel", wheel.stat().st_size / 1e6, "MB")
    _run([str(binaries / "pip"), "install", "--quiet", "--disable-pip-version-check", str(wheel)], folder)
    packages = next((folder / "env" / "lib").glob("python3.*")) / "site-packages"
    _report(version, "installation without Python and pip", _size_mb(folder / "env") - bare, "MB")
    for path in sorted(packages.iterdir(), key=_size_mb, reverse=True):
        if (size := _size_mb(path)) >= LARGE_MB and path.name != "pip":
            _report(version, f"installation: {path.name}", size, "MB")
    fastest = {name: min(_seconds(binaries, code, folder) for _ in range(ROUNDS)) for name, code in IMPORTS.items()}
    for name in list(IMPORTS)[1:]:
        _report(version, f"import {name}", fastest[name] - fastest["nothing"], "s")
    loaded = _run(
        [str(binaries / "python"), "-c", f"import sys, generator; print([m for m in {LAB!r} if m in sys.modules])"],
        folder,
    )
    print(json.dumps({"python": version, "name": "lab modules loaded by import generator", "value": loaded.strip()}))
    _one_picture(version, binaries, folder)
    return _tutorial(version, binaries, folder)


def _one_picture(version: str, binaries: Path, folder: Path) -> None:
    """Print the time of `generate` for one picture: first start, and warm (kernels compiled, files read)."""
    (picture,) = (ROOT / "docs" / "images").glob("prints.png")
    environment = _outside_environment() | {"XDG_CACHE_HOME": str(folder / "cache")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    times: list[tuple[float, float]] = []
    for number in range(1 + ROUNDS):
        usage_before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        words = [str(binaries / "generate"), "demo:", f"one-{number}", "--sources", str(picture)]
        subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True)
        usage_after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy_s = usage_after.ru_utime + usage_after.ru_stime - usage_before.ru_utime - usage_before.ru_stime
        times.append((time.perf_counter() - start_s, busy_s))
    _report(version, "generate, one picture, first start", times[0][0], "s")
    _report(version, "generate, one picture, warm", min(wall for wall, _ in times[1:]), "s")
    _report(version, "generate, one picture, warm, processor time", min(busy_s for _, busy_s in times[1:]), "s")


def _tutorial(version: str, binaries: Path, folder: Path) -> bool:
    """Run the commands of the tutorial outside the repository; return whether all ran."""
    work = folder / "first"
    work.mkdir()
    examples = ROOT / "examples"
    for line in commands_of_the_tutorial():
        words = line.replace("../../examples", str(examples)).split()
        if words[:2] == ["python", str(examples / "photographs.py")]:
            _photographs(work / words[2])
            continue
        program = shutil.which(words[0]) if words[0] == "cp" else str(binaries / words[0])
        start_s = time.perf_counter()
        run = subprocess.run(
            [str(program), *words[1:]], cwd=work, env=_outside_environment(), capture_output=True, text=True
        )
        _report(version, line, time.perf_counter() - start_s, "s")
        if run.returncode:
            print(json.dumps({"python": version, "name": line, "failed": run.returncode, "says": run.stderr[-2000:]}))
            return False
    return True


def commands_of_the_tutorial() -> Iterator[str]:
    """Yield the commands of the tutorial after the installation, without commands that need the repository."""
    text = (ROOT / "docs" / "tutorials" / "first-dataset.md").read_text(encoding="utf-8")
    for line in re.findall(r"^    (\S.*)$", text, re.MULTILINE):
        if re.match(r"(acquire|build-lut|generate|evaluate|python|cp) ", line):
            yield line


def _photographs(folder: Path) -> None:
    """Copy two pictures, because the photographs of the tutorial need a library that is not installed here."""
    shutil.copytree(ROOT / "docs" / "images", folder, ignore=shutil.ignore_patterns("*.svg"))


def _seconds(binaries: Path, code: str, folder: Path) -> float:
    start_s = time.perf_counter()
    _run([str(binaries / "python"), "-c", code], folder)
    return time.perf_counter() - start_s


def _run(words: list[str], folder: Path) -> str:
    return subprocess.run(
        words, cwd=folder, env=_outside_environment(), check=True, capture_output=True, text=True
    ).stdout


def _outside_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def _size_mb(path: Path) -> float:
    if path.is_file():
        return path.lstat().st_size / 2**20
    return sum(file.lstat().st_blocks * 512 for file in path.rglob("*") if not file.is_symlink()) / 2**20


def _report(version: str, name: str, value: float, unit: str) -> None:
    print(json.dumps({"python": version, "name": name, "value": round(value, 3), "unit": unit}), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
