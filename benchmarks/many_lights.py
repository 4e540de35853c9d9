"""An image under two lights, with the maps of where each falls: `python -m benchmarks.many_lights`.

Prints one JSON object a line. The usual program makes the same of the same picture: a soft edge, samples of both lights
mixed with their noise, the light of each pixel, and four PNG files in memory, with numpy and OpenCV. Calls take turns,
the fastest counts, and the time is the processor's with one thread. The time of each step is reported as its share.
Takes about two minutes.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks import words_given
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


def usual(lut: Lut, picture: npt.NDArray[np.uint8]) -> None:
    """Make image and maps in the most obvious manner."""
    height, width, _ = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    along = np.clip((0.8 * (x / width - 0.5) + 0.6 * (y / height - 0.5)) / 0.4 + 0.5, 0, 1)
    second = np.rint(FULL * along * along * (3 - 2 * along)) / np.float32(FULL)
    weights = np.stack([1 - second, second], axis=-1)
    colour = (picture >> 3).astype(np.int64) @ np.array([1024, 32, 1])
    rng = np.random.default_rng(0)
    image = np.zeros(picture.shape, np.float32)
    for light, table in enumerate(np.asarray(lut.samples)):
        weight = weights[..., light, None]
        mean = table.mean(axis=1, dtype=np.float32)[colour]
        drawn = table[colour, rng.integers(0, SAMPLES, colour.shape)]
        image += weight * mean + np.sqrt(weight) * (drawn - mean)
    light = weights @ lut.white.astype(np.float32)
    truth = np.rint(FULL * light / light.sum(axis=-1, keepdims=True)).astype(np.uint16)
    files = [np.clip(np.rint(image), 0, WHITE).astype(np.uint16)[..., ::-1], truth[..., ::-1]]
    for values in (*files, *np.rint(FULL * np.moveaxis(weights, -1, 0)).astype(np.uint16)):
        cv2.imencode(".png", values)


def measure(name: str, lut: Lut, picture: npt.NDArray[np.uint8], repeats: int) -> None:
    height, width, _ = picture.shape
    image = mix_samples(lut.samples, picture, mask_weights("soft-edge", height, width), white_level=WHITE)
    calls: dict[str, Callable[[], object]] = {"usual": lambda: usual(lut, picture)}
    for kind in KINDS:
        lighting = Lighting((single_mixture(0), single_mixture(1)), parse_masks(kind, 2, 1).maker(0))
        its = lighting.weights_of(height, width)
        calls[f"{kind}, masks"] = lambda lighting=lighting: lighting.weights_of(height, width)
        calls[f"{kind}, mixing"] = lambda its=its: mix_samples(lut.samples, picture, its, white_level=WHITE)
        calls[f"{kind}, maps"] = lambda its=its, lighting=lighting: encode_maps(its, lighting.whites(lut))
    calls["image"] = lambda: sum(len(piece) for piece in encode_pieces(image, "png", METADATA))
    seconds = in_turns(calls, time.thread_time, repeats)
    for kind in KINDS:
        steps = {step: seconds[f"{kind}, {step}"] for step in ("masks", "mixing", "maps")} | {"image": seconds["image"]}
        whole = sum(steps.values())
        report(f"{name}, {kind}", seconds["usual"] / whole, "ratio", "numpy and cv2.imencode, a soft edge")
        for step, took in steps.items():
            report(f"{name}, {kind}, {step}", took / whole, "share", "image and maps")


def main() -> None:
    words_given(__doc__)
    with tempfile.TemporaryDirectory() as scratch:
        lut = noisy_table(Path(scratch) / "lut", 2)
        measure("18 Mpx", lut, photograph(5184, 3456), 3)
        measure("512 px", lut, photograph(512, 512), 9)


if __name__ == "__main__":
    main()
