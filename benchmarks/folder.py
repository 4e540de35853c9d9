"""Folder to folder, JPEG in, 16-bit PNG out: `python -m benchmarks.folder [--small]` prints one JSON object a line.

Against the program that first comes to mind (OpenCV reads and writes, numpy draws), in one process and in as many as
there are workers, which are started and have the table before the clock runs; and against the
encoder alone on the finished images with as many threads: once with the writing of its files, which is what a folder
takes however its images came about, and once in memory, where what is encoded is thrown away. Neither of the two
hashes, nor waits for the disk, as a dataset does. Where every processor is busy, nothing but waiting can be hidden
behind an encoder, so its share of the processor time is reported too: no arrangement of the same work goes beyond. The
faster the encoder, the less there is to hide behind, so the fastest in our libraries, ISA-L's deflate at level 1 of the
same bytes unfiltered, is measured beside it.

Runs alternate and the fastest of each counts. What an earlier run wrote is emptied and put aside before the clock runs,
and removed at the end: where a file system has no journal, ext4 looks for a new file's inode past every one that was
freed some seconds ago, which doubled the system time of whatever made many files.
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

from benchmarks.encode import METADATA, at_once, photograph
from benchmarks.generator import SAMPLES, noisy_table, report
from calibration.table.lut import Lut, open_lut
from foundation.compiled import processor_count
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.files import encode_pieces
from generator.pictures.sources import find_pictures
from generator.rendering import Rendering
from generator.stores import LocalStore

# Pictures of 512 px: as many make what a data set takes once a small part.
SMALL_PICTURES = 400

LARGE_REPEATS = 3
SMALL_REPEATS = 5


def fastest(
    calls: Mapping[str, Callable[[], object]], repeats: int, prepare: Callable[[], object]
) -> dict[str, tuple[float, float]]:
    """Return the least seconds, and the least processor seconds, of some calls of each, taken in turn.

    `prepare` is called before each, and not timed.
    """
    took = dict.fromkeys(calls, (float("inf"), float("inf")))
    for _ in range(repeats):
        for name, call in calls.items():
            prepare()
            start, busy = time.perf_counter(), time.process_time()
            call()
            took[name] = (
                min(took[name][0], time.perf_counter() - start),
                min(took[name][1], time.process_time() - busy),
            )
    return took


def straightforward(samples: npt.NDArray[np.uint16], paths: Sequence[Path], out: Path) -> None:
    """Make an image of each picture as one would without this suite; `samples` (32768, 25, 3) of one light."""
    rng = np.random.default_rng(0)
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture is not None
        blue, green, red = (picture[..., channel].astype(np.int64) >> 3 for channel in range(3))
        image = samples[(red << 10) | (green << 5) | blue, rng.integers(0, SAMPLES, red.shape)]
        cv2.imwrite(str(out / f"{path.stem}.png"), image[..., ::-1])


def in_a_process(folder: Path, paths: Sequence[Path], out: Path) -> None:
    """Do the same in a process of a pool, which opens the table once and uses one thread."""
    straightforward(_samples(folder), paths, out)


@lru_cache
def _samples(folder: Path) -> npt.NDArray[np.uint16]:
    cv2.setNumThreads(1)
    return np.array(open_lut(folder).samples[0])


def images_of(folder: Path) -> list[npt.NDArray[np.uint16]]:
    """Return the finished images of a dataset."""
    images: list[npt.NDArray[np.uint16]] = []
    for path in sorted((folder / "images").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        images.append(np.ascontiguousarray(image[..., ::-1], dtype=np.uint16))
    return images


def by_isal(image: npt.NDArray[np.uint16]) -> int:
    """Return the bytes of an image packed by ISA-L as PNG holds them: each row begins with its filter, none."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 6 * width), np.uint8)
    rows[:, 1:] = image.astype(">u2").reshape(height, -1).view(np.uint8)
    return len(isal_zlib.compress(rows.data, 1))


def encode_away(image: npt.NDArray[np.uint16]) -> None:
    """Encode an image and keep nothing."""
    for _ in encode_pieces(image, "png", METADATA):
        pass


def compare(scratch: Path, lut: Lut, name: str, pictures: list[npt.NDArray[np.uint8]], repeats: int) -> None:
    sources, usual, ours, written, aside = (
        scratch / folder for folder in ("sources", "usual", "ours", "written", "aside")
    )
    sources.mkdir()
    aside.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(sources / f"{number:04d}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    workers = processor_count()

    table, paths = np.array(lut.samples[0]), sorted(sources.iterdir())

    def clear() -> None:
        for folder in (usual, ours, written):
            if folder.is_dir():
                for path in folder.rglob("*"):
                    if path.is_file():
                        os.truncate(path, 0)
                folder.rename(tempfile.mkdtemp(dir=aside))

    def by_hand() -> None:
        usual.mkdir()
        straightforward(table, paths, usual)

    def by_hands(processes: ProcessPoolExecutor) -> None:
        usual.mkdir()
        shares = [processes.submit(in_a_process, lut.folder, paths[share::workers], usual) for share in range(workers)]
        for share in shares:
            share.result()

    def by_suite(previews: bool = False, rendering: Rendering = "codes") -> None:
        options = DatasetOptions(previews=previews, rendering=rendering)
        generate_dataset(lut, ours, find_pictures([sources]), [0], options=options, workers=workers)

    by_suite()
    images = images_of(ours)
    with (
        ThreadPoolExecutor(workers) as pool,
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as processes,
    ):
        by_hands(processes)
        sizes = [sum(path.stat().st_size for path in folder.iterdir()) for folder in (usual, ours / "images")]

        def encode() -> None:
            at_once(pool, [partial(encode_away, image) for image in images])

        packed: list[int] = []

        def pack() -> None:
            packed[:] = pool.map(by_isal, images)

        def write() -> None:
            written.mkdir()
            put = LocalStore(written).put
            at_once(
                pool,
                [
                    lambda number=number, image=image: put(f"{number:04d}.png", encode_pieces(image, "png", METADATA))
                    for number, image in enumerate(images)
                ],
            )

        took = fastest(
            {
                "usual": by_hand,
                "processes": lambda: by_hands(processes),
                "encoder": encode,
                "files": write,
                "isal": pack,
                "previews": lambda: by_suite(previews=True),
                "colour": lambda: by_suite(rendering="colorimetric"),
                "ours": by_suite,
            },
            repeats,
            clear,
        )
    wall, busy = ({call: times[which] for call, times in took.items()} for which in (0, 1))
    what = f"folder to folder, {name}, {workers} workers"
    against = "cv2.imread, numpy gather, cv2.imwrite, one process"
    alone = "the encoder alone on the finished images, as many threads"
    report(f"{what}, by colour", len(pictures) / wall["colour"], "images/s")
    report(what, len(pictures) / wall["ours"], "images/s")
    report(f"{what}, by colour", wall["ours"] / wall["colour"], "ratio", "by codes")
    report(what, wall["usual"] / wall["ours"], "ratio", against)
    many = "cv2.imread, numpy gather, cv2.imwrite, as many processes as workers"
    report(what, wall["processes"] / wall["ours"], "ratio", many)
    report(f"{what}, with previews", wall["processes"] / wall["previews"], "ratio", f"{many}, without previews")
    report(f"folder to folder, {name}, processor time", busy["usual"] / busy["ours"], "ratio", against)
    report(f"folder to folder, {name}, size of the images", sizes[1] / sizes[0], "ratio", against)
    report(what, wall["files"] / wall["ours"], "ratio", f"{alone}, files written")
    report(what, wall["encoder"] / wall["ours"], "ratio", f"{alone}, in memory")
    isal = "ISA-L's deflate alone on the finished images, level 1, as many threads, in memory"
    report(what, wall["isal"] / wall["ours"], "ratio", isal)
    report(f"folder to folder, {name}, size of the images", sizes[1] / sum(packed), "ratio", isal)
    report(
        f"folder to folder, {name}, processor time", busy["files"] / busy["ours"], "ratio", f"{alone}, files written"
    )
    report(f"folder to folder, {name}, with previews", wall["ours"] / wall["previews"], "ratio", "without previews")
    clear()
    shutil.rmtree(aside)
    shutil.rmtree(sources)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="the 400 pictures of 512 px alone")
    small = parser.parse_args(arguments).small
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        lut = noisy_table(scratch / "lut", 1)
        large = photograph(5184, 3456)
        if not small:
            compare(scratch, lut, "18 Mpx", 2 * [large, large[::-1], large[:, ::-1], large[::-1, ::-1]], LARGE_REPEATS)
        tops, lefts = range(0, 3456 - 511, 512), range(0, 5184 - 511, 512)
        cut = [np.ascontiguousarray(large[top : top + 512, left : left + 512]) for top in tops for left in lefts]
        photo = photograph(512, 512)
        moved = [np.roll(photo, 17 * place, axis=1) for place in range(len(cut))]
        compare(scratch, lut, "512 px", (4 * [*cut, *moved])[:SMALL_PICTURES], SMALL_REPEATS)


if __name__ == "__main__":
    main()
