"""Folder to folder, JPEG in, 16-bit PNG out: `python -m benchmarks.folder` prints one JSON object a line.

Against the program that first comes to mind (OpenCV reads and writes, numpy draws, one process), and against the
encoder alone on the finished images with as many threads. Runs alternate and the fastest of each counts.
"""

from __future__ import annotations

import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.encode import SHOT, at_once, fastest, photograph
from benchmarks.generator import SAMPLES, noisy_table, report
from calibration.lut import Lut
from generator.dataset import generate_dataset
from generator.encode import encode_image
from generator.engines import default_workers
from generator.scene import find_pictures

REPEATS = 3


def straightforward(lut: Lut, sources: Path, out: Path) -> None:
    """Make an image of every picture as one would without this suite."""
    out.mkdir()
    rng = np.random.default_rng(0)
    table = np.array(lut.samples[0])
    for path in sorted(sources.iterdir()):
        picture = cv2.imread(str(path))
        assert picture is not None
        blue, green, red = (picture[..., channel].astype(np.int64) >> 3 for channel in range(3))
        image = table[(red << 10) | (green << 5) | blue, rng.integers(0, SAMPLES, red.shape)]
        cv2.imwrite(str(out / f"{path.stem}.png"), image[..., ::-1])


def images_of(folder: Path) -> list[npt.NDArray[np.uint16]]:
    """Return the finished images of a dataset."""
    images: list[npt.NDArray[np.uint16]] = []
    for path in sorted((folder / "images").iterdir()):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        images.append(np.ascontiguousarray(image[..., ::-1], dtype=np.uint16))
    return images


def compare(scratch: Path, lut: Lut, name: str, pictures: list[npt.NDArray[np.uint8]]) -> None:
    sources, usual, ours = scratch / "sources", scratch / "usual", scratch / "ours"
    sources.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(sources / f"{number:04d}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    workers = default_workers()

    def by_hand() -> None:
        shutil.rmtree(usual, ignore_errors=True)
        straightforward(lut, sources, usual)

    def by_suite(previews: bool = False) -> None:
        shutil.rmtree(ours, ignore_errors=True)
        generate_dataset(lut, ours, find_pictures([sources]), [0], previews=previews, workers=workers)

    by_suite()
    images = images_of(ours)
    with ThreadPoolExecutor(workers) as pool:
        took = fastest(
            {
                "usual": by_hand,
                "encoder": lambda: at_once(pool, [partial(encode_image, image, "png", SHOT) for image in images]),
                "previews": lambda: by_suite(previews=True),
                "ours": by_suite,
            },
            REPEATS,
        )
    sizes = [sum(path.stat().st_size for path in folder.iterdir()) for folder in (usual, ours / "images")]
    against = "cv2.imread, numpy gather, cv2.imwrite, one process"
    report(f"folder to folder, {name}, {workers} workers", len(pictures) / took["ours"], "images/s")
    report(f"folder to folder, {name}, {workers} workers", took["usual"] / took["ours"], "ratio", against)
    report(f"folder to folder, {name}, size of the images", sizes[1] / sizes[0], "ratio", against)
    report(
        f"folder to folder, {name}, {workers} workers",
        took["encoder"] / took["ours"],
        "ratio",
        "the encoder alone on the finished images, as many threads",
    )
    report(f"folder to folder, {name}, with previews", took["ours"] / took["previews"], "ratio", "without previews")
    for folder in (sources, usual, ours):
        shutil.rmtree(folder)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        lut = noisy_table(scratch / "lut", 1)
        large = photograph(5184, 3456)
        compare(scratch, lut, "18 Mpx", [large, large[::-1], large[:, ::-1], large[::-1, ::-1]])
        small = [np.ascontiguousarray(large[512 * (n // 10) :][:512, 512 * (n % 10) :][:, :512]) for n in range(60)]
        photo = photograph(512, 512)
        compare(scratch, lut, "512 px", [*small[:30], *(np.roll(photo, 17 * n, axis=1) for n in range(30))])


if __name__ == "__main__":
    main()
