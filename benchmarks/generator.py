"""Speed of the kernels: `python -m benchmarks.generator` prints one JSON object per line. It takes some minutes.

Each kernel is compared with the fastest possible memory traffic: a streaming copy of the same picture with as many
threads, which reads 3 bytes and writes 6 bytes per pixel. All calls take turns with the whole picture, which no cache
can hold, and the fastest turn counts. With one thread the time is processor time, otherwise wall time. Therefore the
ratios for one thread are valid on a machine with other load; the ratios for several threads are less certain.

Two illuminants are mixed with random weights per pixel, which is the most work, and with two kinds of masks. The kernel
must also read the weights (8 bytes per pixel), which the copy does not.

By colour, each pixel is interpolated between four nodes and has a recorded deviation. This kernel is compared with the
kernel by codes in the same turns. Means and deviations are random numbers here, which takes the same time.

The result "fetching" is the limit of the caches: a compiled loop only copies the samples that the kernel uses, from
given positions to one place in the nearest cache. With two illuminants, it copies one sample of each.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import skimage.data

from benchmarks import parse_words
from calibration.table.lut import Lut, Provenance, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from foundation.compiled import compiled
from generator.kernels.choice import SCRATCH_BYTES, choose_group, prefetch_once, row_keys
from generator.kernels.mixing import mix_samples
from generator.kernels.printing import NODES, PrintedLight, draw_printed
from generator.kernels.rendering import draw_samples
from generator.kernels.vector import GROUP, LINE, copy8, offset_at
from generator.masks.making import parse_masks
from generator.rendering.black_points import BlackSubtraction, subtract_black

SAMPLES = 25
REPEATS = 7
WHITE = 12000

Call = Callable[[], object]


def fastest_s(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the seconds of the fastest call; the first call does not count."""
    call()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def report(name: str, value: float, unit: str, against: str = "") -> None:
    print(json.dumps({"name": name, "value": round(value, 3), "unit": unit, "against": against}), flush=True)


def natural_picture(width: int, height: int) -> npt.NDArray[np.uint8]:
    """Return a synthetic picture with smooth areas, edges and texture, as in photographs."""
    rng = np.random.default_rng(1)
    layers = np.zeros((height, width, 3), np.float32)
    for octave in (3, 12, 48, 192):
        coarse = rng.uniform(-1, 1, (octave, octave * width // height, 3)).astype(np.float32)
        layers += np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)) / octave**0.5
    low, high = np.percentile(layers, [1, 99])
    return np.clip((layers - low) / (high - low) * 255, 0, 255).astype(np.uint8)


def noisy_table(folder: Path, lights: int) -> Lut:
    """Return a LUT of 32768 colours with photon noise."""
    from experiment.lights import Illuminant

    index = np.arange(32768)
    code = np.stack([index >> 10, index >> 5 & 31, index & 31], axis=-1) / 31
    means = 60 + 8000 * (0.04 + 0.8 * code**2.2) * [0.6, 1.0, 0.7]
    rng = np.random.default_rng(2)
    folder.mkdir()
    writer = LutWriter(folder, lights, 32768, SAMPLES)
    for light in range(lights):
        writer.put(light, rng.poisson(means[:, None].repeat(SAMPLES, axis=1)).astype(np.uint16))
    origin = Provenance(
        camera="Benchmark", bits=5, white_level=12000, session_sha256="0", chart_sha256="0", software="benchmark"
    )
    plan = [Illuminant(light, "uniform", None, Colour(255, 255, 255)) for light in range(lights)]
    writer.finish(plan, np.full((lights, 3), 4000.0), origin)
    return open_lut(folder)


def mask_weights(kind: str, height: int, width: int) -> npt.NDArray[np.float32]:
    """Return the weights (height, width, 2) of two illuminants for one kind of mask of `generate`."""
    return parse_masks(kind, 2, 1).maker(0).weights(height, width, 2)


def photograph(width: int, height: int) -> npt.NDArray[np.uint8]:
    """Return a photograph (height, width, 3), enlarged to camera size, with camera grain."""
    small = np.asarray(skimage.data.coffee(), dtype=np.uint8)
    larger = np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    grain = np.random.default_rng(3).normal(0, 3, larger.shape)
    return np.clip(larger + grain, 0, 255).astype(np.uint8)


def by_numpy(samples: npt.NDArray[np.uint16], picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """Return a raw image, drawn with simple NumPy code."""
    colour = (picture >> 3).astype(np.int64) @ np.array([1024, 32, 1])
    choice = np.random.default_rng(0).integers(0, SAMPLES, colour.shape)
    return np.take(samples.reshape(-1, 3), colour * SAMPLES + choice, axis=0)


@compiled
def _choose_all(
    picture: int, width: int, height: int, light: int, count: Any, bits: Any, target: int, scratch: int
) -> None:
    groups = width // GROUP
    for y in range(height):
        keys = row_keys(y, light, 0, np.uint64(0))
        for group in range(groups):
            address = target + 4 * GROUP * (y * groups + group)
            choose_group(picture + 3 * y * width, width, group, keys, count, bits, scratch, address)


@compiled
def _fetch(samples: Any, places: Any, count: int, target: int) -> None:
    for i in range(0, count, GROUP):
        for light in range(len(samples)):
            base, first = samples[light], places[light] + 4 * i
            for line in range(0, 4 * GROUP, LINE):
                prefetch_once(first + 2048 + line)
            for k in range(GROUP):
                copy8(base + offset_at(first + 4 * k), target + 8 * k)


def fetching(tables: npt.NDArray[np.uint16], picture: npt.NDArray[np.uint8]) -> Call:
    """Return a call that loads the samples of all pixels from each table; the width must be a multiple of GROUP."""
    height, width = picture.shape[:2]
    sites = np.zeros((len(tables), height, width), np.uint32)
    scratch = np.empty(SCRATCH_BYTES, np.uint8)
    table_shape = np.uint32(SAMPLES), np.uint32(5)
    for light, target in enumerate(sites):
        _choose_all(picture.ctypes.data, width, height, light, *table_shape, target.ctypes.data, scratch.ctypes.data)
    starts = np.array([table.ctypes.data for table in tables])
    return lambda: _fetch(
        starts, sites.ctypes.data + sites.strides[0] * np.arange(len(sites)), width * height, scratch.ctypes.data
    )


def random_print() -> tuple[PrintedLight, npt.NDArray[np.uint32]]:
    """Return random numbers in the format of a printed illuminant, and the patches of its nodes."""
    rng = np.random.default_rng(6)
    means, bases = rng.uniform(500, 9000, (NODES, 4)), rng.uniform(500, 9000, (1, NODES, 2, 4))
    factors = 1e-3 * bases.astype(np.float32)
    light = PrintedLight(means.astype(np.float32), factors, np.zeros(1, np.int64), np.ones(1, np.float32))
    return light, rng.integers(0, 32768, NODES).astype(np.uint32)


def in_turns(calls: Mapping[str, Call], clock: Callable[[], float], repeats: int = REPEATS) -> dict[str, float]:
    """Return the seconds of the fastest turn of each call; the first turn does not count."""
    fastest = dict.fromkeys(calls, np.inf)
    for turn in range(repeats + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if turn:
                fastest[name] = min(fastest[name], clock() - start)
    return fastest


def measure_picture(name: str, picture: npt.NDArray[np.uint8], tables: npt.NDArray[np.uint16]) -> None:
    """Report the kernels on a picture of 18 Mpx."""
    height, width = picture.shape[:2]
    pixels = width * height / 1e6
    samples = tables[0]
    out = np.empty(picture.shape, np.uint16)
    weights = np.random.default_rng(4).random((height, width, 2), dtype=np.float32)
    masks = {kind: mask_weights(kind, height, width) for kind in ("soft-edge", "half-plane")}
    light, cells = random_print()
    printed = partial(draw_printed, tables[:1], picture, [light], cells, out=out)
    calls: dict[str, Call] = {
        "kernel by colour": printed,
        "streaming copy": lambda: np.copyto(out, picture),
        "bound of fetching": fetching(tables[:1], picture),
        "bound of fetching for two illuminants": fetching(tables, picture),
        "kernel": lambda: draw_samples(samples, picture, out=out),
        "two illuminants": lambda: mix_samples(tables, picture, weights, white_level=WHITE, out=out),
    }
    for kind, mask in masks.items():
        calls[f"two illuminants, {kind}"] = lambda mask=mask: mix_samples(
            tables, picture, mask, white_level=WHITE, out=out
        )
    seconds = in_turns(calls, time.thread_time)
    seconds |= in_turns({"numpy take": lambda: by_numpy(samples, picture)}, time.thread_time, 2)
    for call, call_s in seconds.items():
        report(f"{call}, {name}, one thread", pixels / call_s, "Mpx/s")
    limit = seconds["streaming copy"]
    for call in (name for name in calls if name != "streaming copy"):
        report(f"{call}, {name}, one thread", limit / seconds[call], "ratio", "streaming copy, 3 bytes in and 6 out")
    report(f"kernel, {name}, one thread", seconds["numpy take"] / seconds["kernel"], "ratio", "numpy take")
    by_colour = seconds["kernel"] / seconds["kernel by colour"]
    report(f"kernel by colour, {name}, one thread", by_colour, "ratio", "kernel by codes")

    threads = os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:

        def copy(top: int, bottom: int) -> None:
            np.copyto(out[top:bottom], picture[top:bottom])

        def copy_together() -> None:
            edges = [height * thread // threads for thread in range(threads + 1)]
            list(pool.map(copy, edges[:-1], edges[1:]))

        def mix_together(weights: npt.NDArray[np.float32]) -> None:
            mix_samples(tables, picture, weights, white_level=WHITE, threads=threads, out=out)

        threaded_calls: dict[str, Call] = {
            "streaming copy": copy_together,
            "kernel": lambda: draw_samples(samples, picture, threads=threads, out=out),
            "kernel by colour": partial(printed, threads=threads),
            "two illuminants": partial(mix_together, weights),
            **{f"two illuminants, {kind}": partial(mix_together, mask) for kind, mask in masks.items()},
        }
        seconds = in_turns(threaded_calls, time.perf_counter, 4 * REPEATS)
    for call, call_s in seconds.items():
        report(f"{call}, {name}, {threads} threads", pixels / call_s, "Mpx/s")
    for call in (name for name in threaded_calls if name != "streaming copy"):
        ratio = seconds["streaming copy"] / seconds[call]
        report(f"{call}, {name}, {threads} threads", ratio, "ratio", "streaming copy in as many threads")
    by_colour = seconds["kernel"] / seconds["kernel by colour"]
    report(f"kernel by colour, {name}, {threads} threads", by_colour, "ratio", "kernel by codes in as many threads")


def measure_small(samples: npt.NDArray[np.uint16]) -> None:
    """Report the kernel on 512 × 512 pixels, which fit in the caches."""
    picture = np.ascontiguousarray(photograph(5184, 3456)[:512, :512])
    out = np.empty(picture.shape, np.uint16)
    call = partial(draw_samples, samples, picture, out=out)
    seconds = in_turns({"kernel": call}, time.thread_time, 300)["kernel"]
    report("kernel, 512 x 512 px, one thread", picture.size / 3e6 / seconds, "Mpx/s")


START = """
import time
import numpy as np
begin = time.process_time()
import generator.kernels.rendering as kernel
middle = time.process_time()
kernel.draw_samples(np.zeros((8, 25, 3), np.uint16), np.zeros((9, 99, 3), np.uint8))
print(middle - begin, time.process_time() - middle)
"""


def measure_black(samples: npt.NDArray[np.uint16]) -> None:
    """Report the time for subtracting the print's black from all samples of an illuminant."""
    veil = BlackSubtraction(np.array([300.0, 380.0, 330.0]), np.array([1.04, 1.04, 1.04]))
    call = partial(subtract_black, samples, veil, WHITE)
    report("black subtracted from samples, one thread", in_turns({"": call}, time.thread_time)[""], "s")


def measure_start() -> None:
    """Report the processor time of the first call, with and without machine code on disk."""

    def child(cache: str) -> tuple[float, float]:
        process = subprocess.run(
            [sys.executable, "-c", START],
            env={**os.environ, "NUMBA_CACHE_DIR": cache},
            capture_output=True,
            text=True,
            check=True,
        )
        imported, called = map(float, process.stdout.split())
        return imported, called

    with tempfile.TemporaryDirectory() as cache:
        _, compiling = child(cache)
        warm_starts = [child(cache) for _ in range(3)]
    report("import of the kernel after numpy", min(imported for imported, _ in warm_starts), "s")
    report("first call, compiled", compiling, "s")
    report("first call, machine code from disk", min(called for _, called in warm_starts), "s")


def main() -> None:
    parse_words(__doc__)
    with tempfile.TemporaryDirectory() as scratch:
        tables = np.array(noisy_table(Path(scratch) / "lut", 2).samples)
    measure_start()
    measure_small(tables[0])
    measure_black(tables[0])
    pictures = {
        "photograph of 18 Mpx": photograph(5184, 3456),
        "synthetic picture of 18 Mpx": natural_picture(5184, 3456),
        "random colours of 18 Mpx": np.random.default_rng(5).integers(0, 256, (3456, 5184, 3), np.uint8),
    }
    for name, picture in pictures.items():
        measure_picture(name, picture, tables)


if __name__ == "__main__":
    main()
