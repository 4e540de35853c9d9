"""Speed of the methods: `python -m benchmarks.evaluation` prints one JSON object per line.

Each method is compared with a short NumPy and OpenCV version of the same method, on one thread. Both run in turns, and
the shortest processor time of each counts. Both exclude saturated pixels and their neighbours; 0.1 % of the image are
saturated. The short versions use float32 and `cv2.mean`, which are the fastest choice in OpenCV.

"Files to results" compares two times, also in turns and with as many threads as processors: the time of `evaluate` for
the PNG files of a generated data set, and the time of only reading these files. The benchmark takes three to four
minutes.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks import parse_words
from benchmarks.generator import noisy_table, photograph, report
from evaluation.methods.gaussian import gaussian_kernel
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.standard import standard_methods
from evaluation.scene import Scene

SIZES = {"512 x 512": (512, 512), "18 Mpx": (5184, 3456)}
SATURATION = 12000.0
Image = npt.NDArray[np.uint16]


def main() -> None:
    parse_words(__doc__)
    cv2.setNumThreads(1)
    for size, (width, height) in SIZES.items():
        report_methods(size, test_image(width, height))
    files_to_results()


def report_methods(size: str, image: Image) -> None:
    """Report the speed of each method relative to its short version, and the gain by shared intermediate images."""
    pixels = image.size / 3e6
    turns = 15 if pixels < 1 else 3
    methods: list[Method] = []
    for name, method in standard_methods().items():
        peer = peer_of(method)
        if peer is None:
            continue
        methods.append(method)
        method_s, peer_s = in_turns(
            lambda method=method: method.estimate(image, SATURATION), peer_call(peer, image), turns
        )
        report(f"{name}, {size}, one thread", pixels / method_s, "Mpx/s", f"{peer_s / method_s:.2f} x NumPy and OpenCV")
    method_s, separate_s = in_turns(
        lambda: estimate_shared(methods, image), lambda: estimate_separately(methods, image), turns
    )
    report(f"all of these, {size}, one thread", pixels / method_s, "Mpx/s", f"{separate_s / method_s:.2f} x one by one")


def test_image(width: int, height: int) -> Image:
    """Return a photograph as linear values, with 0.1 % of its pixels saturated."""
    image = (photograph(width, height).astype(np.float32) ** 2.2 / 20).astype(np.uint16)
    # Spots of 6 × 6 px cover 0.1 % of the image.
    random = np.random.default_rng(0)
    for _ in range(width * height // 36000):
        y, x = random.integers(0, height - 6), random.integers(0, width - 6)
        image[y : y + 6, x : x + 6] = int(SATURATION)
    return image


def peer_of(method: Method) -> Callable[[Image, npt.NDArray[np.uint8]], npt.NDArray[np.float64]] | None:
    """Return the short NumPy and OpenCV version of a method; it takes the image and the mask of used pixels."""
    if isinstance(method, BrightDark):
        return lambda image, used: bright_dark(image[used > 0], method.share)
    if isinstance(method, GrayEdge):
        return lambda image, used: gray_edge(image, used, method)
    return None


def peer_call(
    peer: Callable[[Image, npt.NDArray[np.uint8]], npt.NDArray[np.float64]], image: Image
) -> Callable[[], object]:
    def call() -> npt.NDArray[np.float64]:
        clipped = np.asarray((image >= SATURATION).any(axis=2), dtype=np.uint8)
        dilated = np.asarray(cv2.dilate(clipped, np.ones((3, 3), np.uint8)), dtype=np.uint8)
        return peer(image, 1 - dilated)

    return call


def gray_edge(image: Image, used: npt.NDArray[np.uint8], method: GrayEdge) -> npt.NDArray[np.float64]:
    border = method.border_width
    if border:
        inside = np.zeros_like(used)
        inside[border:-border, border:-border] = used[border:-border, border:-border]
        used = inside
    if not method.sigma and method.p == 1:
        return np.array(cv2.mean(image, mask=used)[:3])
    values = image.astype(np.float32)
    if method.sigma:
        g, d, b = (gaussian_kernel(method.sigma, order) for order in range(3))
        if method.order == 0:
            values = cv2.sepFilter2D(values, -1, g, g, borderType=cv2.BORDER_REPLICATE)
        elif method.order == 1:
            x = cv2.sepFilter2D(values, -1, d, g, borderType=cv2.BORDER_REPLICATE)
            y = cv2.sepFilter2D(values, -1, g, d, borderType=cv2.BORDER_REPLICATE)
            values = np.sqrt(x * x + y * y)
        else:
            xx = cv2.sepFilter2D(values, -1, b, g, borderType=cv2.BORDER_REPLICATE)
            xy = cv2.sepFilter2D(values, -1, d, d, borderType=cv2.BORDER_REPLICATE)
            yy = cv2.sepFilter2D(values, -1, g, b, borderType=cv2.BORDER_REPLICATE)
            values = np.sqrt(xx * xx + 4 * xy * xy + yy * yy)
    if np.isinf(method.p):
        return values[used > 0].max(axis=0)
    scale = values.max()
    powers = values if method.p == 1 else (values / scale) ** method.p
    return np.array(cv2.mean(powers, mask=used)[:3]) ** (1 / method.p)


def bright_dark(pixels: Image, share: float) -> npt.NDArray[np.float64]:
    values = pixels.astype(np.float32)
    mean = values.mean(axis=0, dtype=np.float64)
    along = values @ (mean / np.linalg.norm(mean)).astype(np.float32)
    count = int(np.ceil(len(along) * share))
    order = np.argpartition(along, (count - 1, len(along) - count))
    ends = np.concatenate([values[order[:count]], values[order[-count:]]]).astype(np.float64)
    return np.abs(np.linalg.eigh(ends.T @ ends)[1][:, -1])


def estimate_shared(methods: list[Method], image: Image) -> object:
    from evaluation.methods.prepared import estimate_all

    return estimate_all(methods, image, SATURATION)


def estimate_separately(methods: list[Method], image: Image) -> object:
    return [method.estimate(image, SATURATION) for method in methods]


def files_to_results() -> None:
    """Report the share of decoding in the time from files to results, in wall time."""
    from evaluation.datasets import open_scenes
    from evaluation.experiments.running import evaluate
    from foundation.compiled import processor_count

    method_groups: Mapping[str, list[str]] = {
        "the paper's three": ["white-patch", "gray-world", "shades-of-gray"],
        "the first seven": [
            name for name, method in standard_methods().items() if isinstance(method, GrayEdge | BrightDark)
        ],
    }
    with tempfile.TemporaryDirectory() as folder:
        scenes = open_scenes(make_dataset(Path(folder))).scenes
        workers = processor_count()

        def decode() -> None:
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(_read, scenes))

        for title, names in method_groups.items():
            methods = [standard_methods()[name] for name in names]
            evaluate_s, decode_s = in_turns(
                lambda methods=methods: evaluate(scenes, methods, workers), decode, 5, time.perf_counter
            )
            report(f"files to results, {title}, {workers} threads", decode_s / evaluate_s, "of decoding alone", "0.9")


def _read(scene: Scene) -> int:
    return scene.read()[0].size


def make_dataset(folder: Path) -> Path:
    """Generate a data set of 24 PNG images of 1536 × 1024 px from a photograph, with shot noise."""
    from generator.dataset.making import generate_dataset
    from generator.dataset.plan import DatasetOptions
    from generator.pictures.sources import find_pictures

    (folder / "pictures").mkdir()
    picture = photograph(1536, 1024)
    for number in range(24):
        cv2.imwrite(str(folder / "pictures" / f"{number:02}.png"), np.roll(picture, 53 * number, axis=(0, 1)))
    table, sources = noisy_table(folder / "lut", 1), find_pictures([str(folder / "pictures")])
    generate_dataset(table, folder / "dataset", sources, [0], options=DatasetOptions(previews=False))
    return folder / "dataset"


def in_turns(
    first: Callable[[], object],
    second: Callable[[], object],
    turns: int,
    clock: Callable[[], float] = time.process_time,
) -> tuple[float, float]:
    """Return the seconds of the fastest call of each; the first call of each does not count."""
    times: list[list[float]] = [[], []]
    for turn in range(turns + 1):
        for call, seconds in zip((first, second), times, strict=True):
            start = clock()
            call()
            if turn:
                seconds.append(clock() - start)
    return min(times[0]), min(times[1])


if __name__ == "__main__":
    main()
