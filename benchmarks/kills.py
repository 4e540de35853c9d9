"""Whether kills change a byte: `python -m benchmarks.kills [IMAGES]` prints one JSON object a line.

A data set of 10 000 small images is made by threads, undisturbed, and then by 1, 2 and 3 Dask workers while workers, or
the whole program, are killed by SIGKILL at times of chance; a killed program is started again. The last figure of each
run is the number of files that differ from the undisturbed ones: 0 is the only good one.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from foundation.console import run
from foundation.errors import DeviceError
from generator.dataset.making import Workers, generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.lights.lighting import RandomLights
from generator.pictures.random_scenes import random_scenes

IMAGES = 10_000
LIGHTS = 2
# So many times as long as between two kills, on the average, the undisturbed run takes.
KILLS = 8


def report(name: str, value: float, unit: str, against: str = "") -> None:
    print(json.dumps({"name": name, "value": round(value, 3), "unit": unit, "against": against}), flush=True)


def small_table(folder: Path) -> Lut:
    """Return a table of 64 colours and 8 lights."""
    from experiment.lights import Illumination

    folder.mkdir()
    rng = np.random.default_rng(1)
    writer = LutWriter(folder, 8, 64, 25)
    for light in range(8):
        writer.put(light, rng.poisson(900 + 100 * light, (64, 25, 3)).astype(np.uint16))
    known = Provenance(
        camera="Benchmark", bits=2, white_level=8000, session_sha256="0", chart_sha256="0", software="benchmark"
    )
    plan = [Illumination(light, "uniform", None, Colour(255, 255, 255 - light)) for light in range(8)]
    writer.finish(plan, 4000.0 + np.arange(24.0).reshape(8, 3), known)
    return open_lut(folder)


def make(lut: Lut, out: Path, images: int, engine: str, workers: int) -> None:
    scenes = random_scenes(images // LIGHTS, 24, 16, 5)
    generate_dataset(
        lut,
        out,
        scenes,
        RandomLights(LIGHTS, 8, 5),
        seed=5,
        options=DatasetOptions(previews=False, split=(0.8, 0.1, 0.1), shard_images=100),
        workers=Workers(engine, workers),
    )


def contents(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def start(lut: Path, out: Path, images: int, workers: int) -> subprocess.Popen[bytes]:
    """Start the program whose workers are to be killed."""
    command = [sys.executable, "-m", "benchmarks.kills", "make", str(lut), str(out), str(images), str(workers)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def disturbed(
    lut: Path, out: Path, images: int, workers: int, mean_s: float, chance: random.Random
) -> tuple[int, int, int]:
    """Make the data set while killing, every `mean_s` seconds on the average.

    Returns how many workers and how many programs were killed, and how many programs gave up by themselves, because a
    cluster whose worker is killed while it starts does not start.
    """
    killed_workers = killed_programs = gave_up = 0
    while not (out / "dataset.json").is_file():
        program = start(lut, out, images, workers)
        try:
            while True:
                try:
                    code = program.wait(chance.expovariate(1 / mean_s))
                    if code not in (0, DeviceError.exit_code):
                        raise RuntimeError(f"the program ended with {code} and not by a kill")
                    gave_up += code != 0
                    break
                except subprocess.TimeoutExpired:
                    pass
                if chance.random() < 0.25:
                    program.kill()
                    program.wait()
                    killed_programs += 1
                    break
                below = psutil.Process(program.pid).children(recursive=True)
                found = [process for process in below if "spawn_main" in _words(process)]
                if found:
                    chance.choice(found).kill()
                    killed_workers += 1
        finally:
            _end(program.pid)
    # A program that is killed while it ends has made the whole data set.
    return killed_workers, killed_programs, gave_up


def _words(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def _end(session: int) -> None:
    """End what a killed program left of itself, as a machine that goes down would."""
    try:
        os.killpg(session, signal.SIGKILL)
    except ProcessLookupError:
        return


def main() -> None:
    if sys.argv[1:2] == ["make"]:
        lut, out, images, workers = sys.argv[2:]
        raise SystemExit(run(lambda: make(open_lut(Path(lut)), Path(out), int(images), "dask", int(workers))))
    images = int(sys.argv[1]) if sys.argv[1:] else IMAGES
    chance = random.Random(20190601)
    with tempfile.TemporaryDirectory() as scratch:
        lut = small_table(Path(scratch) / "lut")
        begun = time.perf_counter()
        make(lut, Path(scratch) / "undisturbed", images, "local", 2)
        undisturbed = time.perf_counter() - begun
        expected = contents(Path(scratch) / "undisturbed")
        report(f"{images} images by two threads, undisturbed", images / undisturbed, "images/s")
        for workers in (1, 2, 3):
            out = Path(scratch) / f"out-{workers}"
            name = f"{images} images by {workers} Dask workers with kills"
            begun = time.perf_counter()
            killed, programs, gave_up = disturbed(lut.folder, out, images, workers, undisturbed / KILLS, chance)
            report(f"{name}: time", (time.perf_counter() - begun) / undisturbed, "ratio", "undisturbed, two threads")
            report(f"{name}: workers killed", killed, "kills")
            report(f"{name}: programs killed", programs, "kills")
            report(f"{name}: clusters that did not start for a kill", gave_up, "programs")
            found = contents(out)
            differing = sum(found.get(file) != expected.get(file) for file in {*found, *expected})
            report(f"{name}: files that differ", differing, "files", f"{len(expected)} undisturbed files")


if __name__ == "__main__":
    main()
