"""Speed of JPEG folders to 16-bit PNG: `python -m benchmarks.folder [--small]` prints one JSON object per line.

`generate` is compared with three other programs:

- a simple program in which OpenCV reads and writes and NumPy draws, in one process and in as many processes as workers.
  Processes are started and have opened the LUT before the measurement starts;
- the encoder alone with the finished images, with as many threads: once with writing of the files, once in memory. In
  contrast to a data set, no data are hashed and nothing waits for the disk;
- the fastest encoder of our libraries, which is ISA-L's deflate at level 1 without PNG filters. With a faster encoder,
  less of the other work can overlap with encoding.

If all processors are busy, other work cannot overlap with encoding. The ratio of processor times, which is also
reported, is then the limit.

Runs alternate and the fastest run of each program counts. Files of an earlier run are truncated and moved away before
the measurement, and removed at the end. The reason is that without a journal, ext4 searches past every recently freed
inode for a new file. This doubled the system time of programs that write many files.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from benchmarks.encode import METADATA, call_in_threads, photograph
from benchmarks.generator import SAMPLES, noisy_table, report
from calibration.table.lut import Lut, open_lut
from foundation.compiled import processor_count
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.files import encode_pieces
from generator.pictures.sources import find_pictures
from generator.rendering import Rendering
from generator.stores import LocalStore

# Number of 512 px pictures; with so many, the start and the end of a data set take a small part of the time.
SMALL_PICTURES = 400

LARGE_REPEATS = 3
SMALL_REPEATS = 5


def fastest(
    calls: Mapping[str, Callable[[], object]], repeats: int, prepare: Callable[[], object]
) -> dict[str, tuple[float, float]]:
    """Return the shortest wall and processor times of the calls, in seconds; the calls take turns.

    `prepare` is called before each call, outside the measured time.
    """
    fastest_s = dict.fromkeys(calls, (float("inf"), float("inf")))
    for _ in range(repeats):
        for name, call in calls.items():
            prepare()
            start, start_processor_s = time.perf_counter(), time.process_time()
            call()
            fastest_s[name] = (
                min(fastest_s[name][0], time.perf_counter() - start),
                min(fastest_s[name][1], time.process_time() - start_processor_s),
            )
    return fastest_s


def draw_with_numpy(samples: npt.NDArray[np.uint16], paths: Sequence[Path], out: Path) -> None:
    """Make an image of each picture without CroP; `samples` (32768, 25, 3) of one illuminant."""
    rng = np.random.default_rng(0)
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture is not None
        blue, green, red = (picture[..., channel].astype(np.int64) >> 3 for channel in range(3))
        image = samples[(red << 10) | (green << 5) | blue, rng.integers(0, SAMPLES, red.shape)]
        cv2.imwrite(str(out / f"{path.stem}.png"), image[..., ::-1])


def draw_in_process(folder: Path, paths: Sequence[Path], out: Path) -> None:
    """Run `draw_with_numpy` in a process of a pool, which opens the LUT once and uses one thread."""
    draw_with_numpy(_samples(folder), paths, out)


@lru_cache
def _samples(folder: Path) -> npt.NDArray[np.uint16]:
    cv2.setNumThreads(1)
    return np.array(open_lut(folder).samples[0])


def images_of(folder: Path) -> list[npt.NDArray[np.uint16]]:
    """Return the finished images of a data set."""
    images: list[npt.NDArray[np.uint16]] = []
    for path in sorted((folder / "images").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        images.append(np.ascontiguousarray(image[..., ::-1], dtype=np.uint16))
    return images


def by_isal(image: npt.NDArray[np.uint16]) -> int:
    """Return the size of an image compressed by ISA-L as PNG rows with filter 0, in bytes."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 6 * width), np.uint8)
    rows[:, 1:] = image.astype(">u2").reshape(height, -1).view(np.uint8)
    return len(isal_zlib.compress(rows.data, 1))


def encode_and_discard(image: npt.NDArray[np.uint16]) -> None:
    """Encode an image and discard the bytes."""
    for _ in encode_pieces(image, "png", METADATA):
        pass


def compare(scratch: Path, lut: Lut, name: str, pictures: list[npt.NDArray[np.uint8]], repeats: int) -> None:
    sources, plain, ours, encoded_folder, old_folder = (
        scratch / folder for folder in ("sources", "usual", "ours", "written", "aside")
    )
    sources.mkdir()
    old_folder.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(sources / f"{number:04d}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    workers = processor_count()

    table, paths = np.array(lut.samples[0]), sorted(sources.iterdir())

    def clear() -> None:
        for folder in (plain, ours, encoded_folder):
            if folder.is_dir():
                for path in folder.rglob("*"):
                    if path.is_file():
                        os.truncate(path, 0)
                folder.rename(tempfile.mkdtemp(dir=old_folder))

    def run_numpy() -> None:
        plain.mkdir()
        draw_with_numpy(table, paths, plain)

    def run_numpy_processes(processes: ProcessPoolExecutor) -> None:
        plain.mkdir()
        futures = [
            processes.submit(draw_in_process, lut.folder, paths[part::workers], plain) for part in range(workers)
        ]
        for future in futures:
            future.result()

    def run_crop(previews: bool = False, rendering: Rendering = "codes") -> None:
        options = DatasetOptions(previews=previews, rendering=rendering)
        generate_dataset(lut, ours, find_pictures([sources]), [0], options=options, workers=workers)

    run_crop()
    images = images_of(ours)
    with (
        ThreadPoolExecutor(workers) as pool,
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as processes,
    ):
        run_numpy_processes(processes)
        sizes = [sum(path.stat().st_size for path in folder.iterdir()) for folder in (plain, ours / "images")]

        def encode() -> None:
            call_in_threads(pool, [partial(encode_and_discard, image) for image in images])

        packed: list[int] = []

        def pack() -> None:
            packed[:] = pool.map(by_isal, images)

        def write() -> None:
            encoded_folder.mkdir()
            put = LocalStore(encoded_folder).put
            call_in_threads(
                pool,
                [
                    lambda number=number, image=image: put(f"{number:04d}.png", encode_pieces(image, "png", METADATA))
                    for number, image in enumerate(images)
                ],
            )

        times_by_call = fastest(
            {
                "usual": run_numpy,
                "processes": lambda: run_numpy_processes(processes),
                "encoder": encode,
                "files": write,
                "isal": pack,
                "previews": lambda: run_crop(previews=True),
                "colour": lambda: run_crop(rendering="colorimetric"),
                "ours": run_crop,
            },
            repeats,
            clear,
        )
    wall, processor = ({call: times[column] for call, times in times_by_call.items()} for column in (0, 1))
    label = f"folder to folder, {name}, {workers} workers"
    against = "cv2.imread, numpy gather, cv2.imwrite, one process"
    encoder_alone = "the encoder alone on the finished images, as many threads"
    report(f"{label}, by colour", len(pictures) / wall["colour"], "images/s")
    report(label, len(pictures) / wall["ours"], "images/s")
    report(f"{label}, by colour", wall["ours"] / wall["colour"], "ratio", "by codes")
    report(label, wall["usual"] / wall["ours"], "ratio", against)
    many = "cv2.imread, numpy gather, cv2.imwrite, as many processes as workers"
    report(label, wall["processes"] / wall["ours"], "ratio", many)
    report(f"{label}, with previews", wall["processes"] / wall["previews"], "ratio", f"{many}, without previews")
    report(f"folder to folder, {name}, processor time", processor["usual"] / processor["ours"], "ratio", against)
    report(f"folder to folder, {name}, size of the images", sizes[1] / sizes[0], "ratio", against)
    report(label, wall["files"] / wall["ours"], "ratio", f"{encoder_alone}, files written")
    report(label, wall["encoder"] / wall["ours"], "ratio", f"{encoder_alone}, in memory")
    isal = "ISA-L's deflate alone on the finished images, level 1, as many threads, in memory"
    report(label, wall["isal"] / wall["ours"], "ratio", isal)
    report(f"folder to folder, {name}, size of the images", sizes[1] / sum(packed), "ratio", isal)
    report(
        f"folder to folder, {name}, processor time",
        processor["files"] / processor["ours"],
        "ratio",
        f"{encoder_alone}, files written",
    )
    report(f"folder to folder, {name}, with previews", wall["ours"] / wall["previews"], "ratio", "without previews")
    clear()
    shutil.rmtree(old_folder)
    shutil.rmtree(sources)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="only the 400 pictures of 512 px")
    small = parser.parse_args(arguments).small
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        lut = noisy_table(scratch / "lut", 1)
        large = photograph(5184, 3456)
        if not small:
            compare(scratch, lut, "18 Mpx", 2 * [large, large[::-1], large[:, ::-1], large[::-1, ::-1]], LARGE_REPEATS)
        tops, lefts = range(0, 3456 - 511, 512), range(0, 5184 - 511, 512)
        crops = [np.ascontiguousarray(large[top : top + 512, left : left + 512]) for top in tops for left in lefts]
        photo = photograph(512, 512)
        shifted = [np.roll(photo, 17 * index, axis=1) for index in range(len(crops))]
        compare(scratch, lut, "512 px", (4 * [*crops, *shifted])[:SMALL_PICTURES], SMALL_REPEATS)


if __name__ == "__main__":
    main()
