"""Speed of writing image files, and their size: `python -m benchmarks.encode` prints one JSON object per line.

Our encoder and `cv2.imencode` encode the same image in turns. The fastest call of each counts, so the ratios are valid
on a machine with other load. Three images are drawn from a LUT: a photograph of 512 px, the same photograph enlarged to
18 Mpx with camera grain, and a smooth picture of 18 Mpx in which few pixels have the same colour.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import skimage.data

from benchmarks.generator import in_turns, natural_picture, noisy_table, report
from generator.files import FORMATS, ImageMetadata, encode_image
from generator.kernels.rendering import draw_samples

REPEATS = 3
# Standard deviation of the grain, in 8-bit codes.
GRAIN = 2.0
METADATA = ImageMetadata(12000, (4000.0, 4000.0, 4000.0), "Canon EOS 550D")


def photograph(width: int, height: int) -> npt.NDArray[np.uint8]:
    """Return a photograph (height, width, 3); a larger size than the original is interpolated and gets grain."""
    picture = np.asarray(skimage.data.astronaut(), dtype=np.uint8)
    if (height, width) == picture.shape[:2]:
        return picture
    larger = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)
    grain = np.random.default_rng(3).normal(0, GRAIN, larger.shape)
    return np.clip(np.rint(larger + grain), 0, 255).astype(np.uint8)


def call_in_threads(pool: ThreadPoolExecutor, calls: Sequence[Callable[[], object]]) -> None:
    """Make calls in the threads of the pool and wait for all."""
    for future in [pool.submit(call) for call in calls]:
        future.result()


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        samples = np.array(noisy_table(Path(scratch) / "lut", 1).samples[0])
    pictures = {
        "photograph 512 px": photograph(512, 512),
        "photograph 18 Mpx": photograph(5184, 3456),
        "smooth 18 Mpx": natural_picture(5184, 3456),
    }
    for (name, picture), form in itertools.product(pictures.items(), FORMATS):
        image = draw_samples(samples, picture)
        reference_size = cv2.imencode(".png", image[..., ::-1])[1].size
        size = len(encode_image(image, form, METADATA))
        report(f"{form}, {name}, size", size / image.nbytes, "ratio", "the image in memory")
        report(f"{form}, {name}, size", size / reference_size, "ratio", "PNG by cv2.imencode")
        with ThreadPoolExecutor(2) as pool:
            encode = partial(encode_image, image, form, METADATA)
            calls: dict[str, Callable[[], object]] = {
                "cv2": partial(cv2.imencode, ".png", image),
                "ours": encode,
                "two": partial(call_in_threads, pool, [encode, encode]),
            }
            seconds = in_turns(calls, time.perf_counter, REPEATS if picture.size > 10**7 else 20)
        pixels = picture.size / 3e6
        report(f"{form}, {name}, one thread", pixels / seconds["ours"], "Mpx/s")
        report(f"{form}, {name}, one thread", seconds["cv2"] / seconds["ours"], "ratio", "PNG by cv2.imencode")
        report(f"{form}, {name}, two threads", 2 * seconds["ours"] / seconds["two"], "ratio", "one thread")


if __name__ == "__main__":
    main()
