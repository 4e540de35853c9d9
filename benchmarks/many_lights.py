"""Images under two illuminants with their maps: `python -m benchmarks.many_lights` prints one JSON object per line.

CroP is compared with a simple NumPy and OpenCV program that makes the same data: a soft edge, mixed samples of both
illuminants with their noise, the illuminant of each pixel, and four PNG files in memory. Both run in turns on one
thread, and the shortest processor time of each counts. The time of each step is reported as a share. The benchmark
takes about two minutes.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks import parse_words
from benchmarks.encode import METADATA, photograph
from benchmarks.generator import SAMPLES, WHITE, in_turns, mask_weights, noisy_table, report
from calibration.table.lut import Lut
from generator.files import encode_pieces
from generator.kernels.mixing import mix_samples
from generator.lights.lighting import Lighting, single_mixture
from generator.masks.making import parse_masks
from generator.masks.maps import encode_maps

KINDS = ("half-plane", "soft-edge", "spots", "smooth", "window")
FULL = 65535


def draw_with_numpy(lut: Lut, picture: npt.NDArray[np.uint8]) -> None:
    """Make the image and the maps with simple NumPy code."""
    height, width, _ = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    position = np.clip((0.8 * (x / width - 0.5) + 0.6 * (y / height - 0.5)) / 0.4 + 0.5, 0, 1)
    second = np.rint(FULL * position * position * (3 - 2 * position)) / np.float32(FULL)
    weights = np.stack([1 - second, second], axis=-1)
    colour = (picture >> 3).astype(np.int64) @ np.array([1024, 32, 1])
    rng = np.random.default_rng(0)
    image = np.zeros(picture.shape, np.float32)
    for light, table in enumerate(np.asarray(lut.samples)):
        weight = weights[..., light, None]
        mean = table.mean(axis=1, dtype=np.float32)[colour]
        samples = table[colour, rng.integers(0, SAMPLES, colour.shape)]
        image += weight * mean + np.sqrt(weight) * (samples - mean)
    light = weights @ lut.white.astype(np.float32)
    truth = np.rint(FULL * light / light.sum(axis=-1, keepdims=True)).astype(np.uint16)
    files = [np.clip(np.rint(image), 0, WHITE).astype(np.uint16)[..., ::-1], truth[..., ::-1]]
    for values in (*files, *np.rint(FULL * np.moveaxis(weights, -1, 0)).astype(np.uint16)):
        cv2.imencode(".png", values)


def measure(name: str, lut: Lut, picture: npt.NDArray[np.uint8], repeats: int) -> None:
    height, width, _ = picture.shape
    image = mix_samples(lut.samples, picture, mask_weights("soft-edge", height, width), white_level=WHITE)
    calls: dict[str, Callable[[], object]] = {"numpy": lambda: draw_with_numpy(lut, picture)}
    for kind in KINDS:
        lighting = Lighting((single_mixture(0), single_mixture(1)), parse_masks(kind, 2, 1).maker(0))
        weights = lighting.weights_of(height, width)
        calls[f"{kind}, masks"] = lambda lighting=lighting: lighting.weights_of(height, width)
        calls[f"{kind}, mixing"] = lambda weights=weights: mix_samples(lut.samples, picture, weights, white_level=WHITE)
        calls[f"{kind}, maps"] = lambda weights=weights, lighting=lighting: encode_maps(weights, lighting.whites(lut))
    calls["image"] = lambda: sum(len(piece) for piece in encode_pieces(image, "png", METADATA))
    seconds = in_turns(calls, time.thread_time, repeats)
    for kind in KINDS:
        steps = {step: seconds[f"{kind}, {step}"] for step in ("masks", "mixing", "maps")} | {"image": seconds["image"]}
        total_s = sum(steps.values())
        report(f"{name}, {kind}", seconds["numpy"] / total_s, "ratio", "numpy and cv2.imencode, a soft edge")
        for step, step_s in steps.items():
            report(f"{name}, {kind}, {step}", step_s / total_s, "share", "image and maps")


def main() -> None:
    parse_words(__doc__)
    with tempfile.TemporaryDirectory() as scratch:
        lut = noisy_table(Path(scratch) / "lut", 2)
        measure("18 Mpx", lut, photograph(5184, 3456), 3)
        measure("512 px", lut, photograph(512, 512), 9)


if __name__ == "__main__":
    main()
