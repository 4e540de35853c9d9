"""How fast training crops are drawn: `python -m benchmarks.batches [--lut LUT]` prints one JSON object a line.

Crops of 128×128 px, each under a light of its own, from a table on disk; without `--lut` one of full size, 707 lights
and 3.5 GB, is made of shot noise in a temporary folder first. Programs and modes, by codes and by colour, take turns in
one run. With one thread the time is the processor's, else the clock's.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
import numpy.typing as npt

from benchmarks.generator import natural_picture, noisy_table, report
from calibration.table.lut import Lut, open_lut
from foundation.compiled import processor_count
from generator.rendering.black_points import BlackPoint
from generator.training.crops import Crops
from generator.training.gallery import Gallery, gallery_of

SIDE = 128
BATCH = 512
ROUNDS = 9
IN_A_ROW = 5
LIGHTS = 707


def numpy_crops(
    lut: Lut, gallery: Gallery, count: int, random: np.random.Generator
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """Return what a straightforward program makes: the same kind of crops, by numpy's take."""
    images = np.empty((count, 3, SIDE, SIDE), np.float32)
    lights: npt.NDArray[np.int64] = random.integers(len(lut.samples), size=count)
    for image, light in zip(images, lights.tolist(), strict=True):
        picture = gallery.picture(int(random.random() * len(gallery)))
        top, left = (int(random.random() * (side - SIDE + 1)) for side in picture.shape[:2])
        codes: npt.NDArray[np.int32] = (picture[top : top + SIDE, left : left + SIDE] >> 3).astype(np.int32)
        cells = (codes[..., 0] << 10 | codes[..., 1] << 5 | codes[..., 2]) * 25
        cells += random.integers(25, size=cells.shape, dtype=np.int32)
        crop = lut.samples[light].reshape(-1, 3).take(cells, axis=0)
        if random.random() < 0.5:
            crop = crop[:, ::-1]
        np.multiply(crop.transpose(2, 0, 1), 2 ** random.uniform(-1, 0) / lut.provenance.white_level, out=image)
    return images, lut.ground_truth[lights]


def rate(seconds: list[float], crops: int) -> float:
    """Return crops a second of the median round."""
    return crops / median(seconds)


def _by_colour(crops: Crops) -> Crops:
    """Return the same crops rendered by colour, a random share of the print's black taken out."""
    return Crops(
        crops.lut,
        crops.gallery,
        crops.size,
        exposure=crops.exposure,
        threads=crops.threads,
        rendering="colorimetric",
        black_point=BlackPoint("random"),
    )


def measure(lut: Lut) -> None:
    """Print every figure of a table."""
    gallery = gallery_of([np.roll(natural_picture(1536, 1024), 97 * turn, axis=1) for turn in range(8)])
    random = np.random.default_rng(1)
    size = np.prod(lut.samples.shape) * 2 / 1e9
    what = f"crops of {SIDE}x{SIDE} from {len(lut.samples)} lights, {size:.2f} GB"
    # Every page of the table is read once, so that no round waits for the disk.
    int(np.asarray(lut.samples).reshape(-1)[::2048].max())
    ours = {
        threads: Crops(lut, gallery, (SIDE, SIDE), exposure=(0.5, 1.0), threads=threads, rendering="codes")
        for threads in sorted({1, processor_count()})
    }
    coloured: dict[int, list[float]] = {threads: [] for threads in ours}
    spent: dict[int, list[float]] = {threads: [] for threads in ours}
    by_colour = {threads: _by_colour(crops) for threads, crops in ours.items()}
    peer: list[float] = []
    for turn in range(ROUNDS + 1):
        start = time.thread_time()
        numpy_crops(lut, gallery, BATCH // 4, random)
        peer.append(time.thread_time() - start)
        for threads, crops in ours.items():
            clock = time.thread_time if threads == 1 else time.perf_counter
            # The first of a row finds the processor's memory full of the other program's numbers.
            for number in range(turn * IN_A_ROW, (turn + 1) * IN_A_ROW):
                for mode, times in ((crops, spent), (by_colour[threads], coloured)):
                    start = clock()
                    mode.batch(np.arange(number * BATCH, (number + 1) * BATCH))
                    if number % IN_A_ROW:
                        times[threads].append(clock() - start)
    slow = rate(peer[1:], BATCH // 4)
    report("numpy take, one thread", slow, "crops/s", what)
    for threads, seconds in spent.items():
        fast = rate(seconds[IN_A_ROW - 1 :], BATCH)
        report(f"batches, {threads} threads", fast, "crops/s", what)
        report(f"batches, {threads} threads", fast / slow, "ratio", "numpy take, one thread")
        with_cells = rate(coloured[threads][IN_A_ROW - 1 :], BATCH)
        report(f"batches by colour, black taken out, {threads} threads", with_cells, "crops/s", what)
        report(f"batches by colour, black taken out, {threads} threads", with_cells / fast, "ratio", "batches by codes")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lut", type=Path, help="folder of a table of 5 bits")
    parser.add_argument("--lights", type=int, default=LIGHTS, help="lights of the table that is made without --lut")
    chosen = parser.parse_args()
    if chosen.lut is not None:
        measure(open_lut(chosen.lut))
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(noisy_table(Path(folder) / "lut", chosen.lights))


if __name__ == "__main__":
    main()
