"""What an installation weighs, how fast it starts, and whether it works away from the repository.

`python -m benchmarks.install [--python PYTHON]… [--keep FOLDER]` makes the wheel, installs it with pip into a fresh
environment in a folder of its own, runs the tutorial's commands there, without the repository, and prints one JSON
object a line: megabytes of each large package, seconds of imports beside those of numpy and OpenCV, of `generate` for
one picture, and of the tutorial's steps. Needs a package index, as any installation does, and 2 GB of disk.
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

# From so many megabytes on a package is listed; docs/decisions/ says why it is there.
LARGE_MB = 20

# Times that an import is repeated; the fastest counts, since the first reads the disk.
ROUNDS = 5

# What is imported, by the name under which it is printed.
IMPORTS = {
    "nothing": "pass",
    "numpy and cv2": "import numpy, cv2",
    "generator": "import generator",
    "generator.training": "import generator.training",
}

# What `import generator` must not load: nothing of the laboratory's, and nothing that takes long.
LAB = ("acquisition", "calibration.pipeline", "sim", "rawpy", "usb", "serial", "scipy", "matplotlib", "numba")


def main(arguments: Sequence[str] | None = None) -> int:
    """Install, run, measure, print; return 1 if a step of the tutorial failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", action="append", help="which Python; several times for several")
    parser.add_argument("--keep", type=Path, help="where the environment stays; else it is removed")
    given = parser.parse_args(arguments)
    failed = False
    for python in given.python or [sys.executable]:
        folder = Path(tempfile.mkdtemp(prefix="install-")) if given.keep is None else given.keep.absolute()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            failed |= not _tried(python, folder)
        finally:
            if given.keep is None:
                shutil.rmtree(folder)
    return int(failed)


def _tried(python: str, folder: Path) -> bool:
    """Install with one Python and try what was installed; return whether all of the tutorial ran."""
    _run([python, "-m", "venv", str(folder / "env")], folder)
    binaries = folder / "env" / "bin"
    version = _run([str(binaries / "python"), "-c", "import sys; print(sys.version.split()[0])"], folder).strip()
    bare = _size_mb(folder / "env")
    _run([str(binaries / "pip"), "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)], folder)
    (wheel,) = folder.glob("*.whl")
    _say(version, "wheel", wheel.stat().st_size / 1e6, "MB")
    _run([str(binaries / "pip"), "install", "--quiet", "--disable-pip-version-check", str(wheel)], folder)
    packages = next((folder / "env" / "lib").glob("python3.*")) / "site-packages"
    _say(version, "installation without Python and pip", _size_mb(folder / "env") - bare, "MB")
    for path in sorted(packages.iterdir(), key=_size_mb, reverse=True):
        if (size := _size_mb(path)) >= LARGE_MB and path.name != "pip":
            _say(version, f"of it {path.name}", size, "MB")
    fastest = {name: min(_seconds(binaries, code, folder) for _ in range(ROUNDS)) for name, code in IMPORTS.items()}
    for name in list(IMPORTS)[1:]:
        _say(version, f"import {name}", fastest[name] - fastest["nothing"], "s")
    loaded = _run(
        [str(binaries / "python"), "-c", f"import sys, generator; print([m for m in {LAB!r} if m in sys.modules])"],
        folder,
    )
    print(json.dumps({"python": version, "name": "import generator loads of the lab's", "value": loaded.strip()}))
    _one_picture(version, binaries, folder)
    return _tutorial(version, binaries, folder)


def _one_picture(version: str, binaries: Path, folder: Path) -> None:
    """Print how long `generate` takes for one picture once its kernels are compiled, the table made and files read."""
    (picture,) = (ROOT / "docs" / "images").glob("prints.png")
    environment = _away() | {"XDG_CACHE_HOME": str(folder / "cache")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    took: list[tuple[float, float]] = []
    for number in range(1 + ROUNDS):
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        words = [str(binaries / "generate"), "demo:", f"one-{number}", "--sources", str(picture)]
        subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        took.append((time.perf_counter() - started, busy))
    _say(version, "generate, one picture, first start", took[0][0], "s")
    _say(version, "generate, one picture, warm", min(wall for wall, _ in took[1:]), "s")
    _say(version, "generate, one picture, warm, processor time", min(busy for _, busy in took[1:]), "s")


def _tutorial(version: str, binaries: Path, folder: Path) -> bool:
    """Run the tutorial's commands in a folder away from the repository; return whether all of them ran."""
    work = folder / "first"
    work.mkdir()
    examples = ROOT / "examples"
    for line in commands_of_the_tutorial():
        words = line.replace("../../examples", str(examples)).split()
        if words[:2] == ["python", str(examples / "photographs.py")]:
            _photographs(work / words[2])
            continue
        program = shutil.which(words[0]) if words[0] == "cp" else str(binaries / words[0])
        started = time.perf_counter()
        done = subprocess.run([str(program), *words[1:]], cwd=work, env=_away(), capture_output=True, text=True)
        _say(version, line, time.perf_counter() - started, "s")
        if done.returncode:
            print(json.dumps({"python": version, "name": line, "failed": done.returncode, "says": done.stderr[-2000:]}))
            return False
    return True


def commands_of_the_tutorial() -> Iterator[str]:
    """Yield the tutorial's commands from the first on that makes something, without those that need the repository."""
    text = (ROOT / "docs" / "tutorials" / "first-dataset.md").read_text(encoding="utf-8")
    for line in re.findall(r"^    (\S.*)$", text, re.MULTILINE):
        if re.match(r"(acquire|build-lut|generate|evaluate|python|cp) ", line):
            yield line


def _photographs(folder: Path) -> None:
    """Put two pictures there; the tutorial's own come with a library that a plain installation has not."""
    shutil.copytree(ROOT / "docs" / "images", folder, ignore=shutil.ignore_patterns("*.svg"))


def _seconds(binaries: Path, code: str, folder: Path) -> float:
    started = time.perf_counter()
    _run([str(binaries / "python"), "-c", code], folder)
    return time.perf_counter() - started


def _run(words: list[str], folder: Path) -> str:
    return subprocess.run(words, cwd=folder, env=_away(), check=True, capture_output=True, text=True).stdout


def _away() -> dict[str, str]:
    """Return the environment without what would lead back to the repository."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def _size_mb(path: Path) -> float:
    if path.is_file():
        return path.lstat().st_size / 2**20
    return sum(file.lstat().st_blocks * 512 for file in path.rglob("*") if not file.is_symlink()) / 2**20


def _say(version: str, name: str, value: float, unit: str) -> None:
    print(json.dumps({"python": version, "name": name, "value": round(value, 3), "unit": unit}), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
