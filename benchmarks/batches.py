"""Speed of drawing training crops: `python -m benchmarks.batches [--lut LUT]` prints one JSON object per line.

Crops of 128 × 128 px are drawn from a LUT on disk; each crop has its own illuminant. Without `--lut`, a full-size LUT
with photon noise only (707 illuminants, 3.5 GB) is first written to a temporary folder. CroP by codes, CroP by colour
and a NumPy program are run alternately. With one thread the measured time is processor time, otherwise wall time.
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
    """Draw the same kind of crops with a simple NumPy program."""
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
    """Return crops per second in the median round."""
    return crops / median(seconds)


def _by_colour(crops: Crops) -> Crops:
    """Return the same crops rendered by colour, with a random share of the print's black removed."""
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
    """Print all figures of one LUT."""
    gallery = gallery_of([np.roll(natural_picture(1536, 1024), 97 * turn, axis=1) for turn in range(8)])
    random = np.random.default_rng(1)
    size_gb = np.prod(lut.samples.shape) * 2 / 1e9
    description = f"crops of {SIDE}x{SIDE} from {len(lut.samples)} lights, {size_gb:.2f} GB"
    # Read every page of the LUT once, so that no round waits for the disk.
    int(np.asarray(lut.samples).reshape(-1)[::2048].max())
    crops_by_threads = {
        threads: Crops(lut, gallery, (SIDE, SIDE), exposure=(0.5, 1.0), threads=threads, rendering="codes")
        for threads in sorted({1, processor_count()})
    }
    seconds_by_colour: dict[int, list[float]] = {threads: [] for threads in crops_by_threads}
    seconds_by_codes: dict[int, list[float]] = {threads: [] for threads in crops_by_threads}
    colour_crops = {threads: _by_colour(crops) for threads, crops in crops_by_threads.items()}
    numpy_s: list[float] = []
    for turn in range(ROUNDS + 1):
        start = time.thread_time()
        numpy_crops(lut, gallery, BATCH // 4, random)
        numpy_s.append(time.thread_time() - start)
        for threads, crops in crops_by_threads.items():
            clock = time.thread_time if threads == 1 else time.perf_counter
            # The first batch of each program does not count, because the caches still hold data of the other program.
            for number in range(turn * IN_A_ROW, (turn + 1) * IN_A_ROW):
                for mode, times in ((crops, seconds_by_codes), (colour_crops[threads], seconds_by_colour)):
                    start = clock()
                    mode.batch(np.arange(number * BATCH, (number + 1) * BATCH))
                    if number % IN_A_ROW:
                        times[threads].append(clock() - start)
    numpy_rate = rate(numpy_s[1:], BATCH // 4)
    report("numpy take, one thread", numpy_rate, "crops/s", description)
    for threads, seconds in seconds_by_codes.items():
        code_rate = rate(seconds[IN_A_ROW - 1 :], BATCH)
        report(f"batches, {threads} threads", code_rate, "crops/s", description)
        report(f"batches, {threads} threads", code_rate / numpy_rate, "ratio", "numpy take, one thread")
        colour_rate = rate(seconds_by_colour[threads][IN_A_ROW - 1 :], BATCH)
        report(f"by colour, black removed, {threads} threads", colour_rate, "crops/s", description)
        report(f"by colour, black removed, {threads} threads", colour_rate / code_rate, "ratio", "batches by codes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lut", type=Path, help="folder of a LUT with 5 bits")
    parser.add_argument(
        "--lights", type=int, default=LIGHTS, help="number of illuminants of the LUT that is made without --lut"
    )
    options = parser.parse_args()
    if options.lut is not None:
        measure(open_lut(options.lut))
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(noisy_table(Path(folder) / "lut", options.lights))


if __name__ == "__main__":
    main()
