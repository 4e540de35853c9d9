"""Time for variation of images: `python -m benchmarks.variation` prints one JSON object per line.

For a photograph of 6 Mpx and one thread it measures three processor times: drawing the samples; drawing the samples and
varying them, for each kind of variation; and writing the image as PNG, which is done for most data sets. All calls take
turns, and the fastest turn counts.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.generator import in_turns, noisy_table, photograph, report
from generator.files import ImageMetadata, encode_image
from generator.kernels.rendering import draw_samples
from generator.variation.iso_speed import parse_iso
from generator.variation.variation import Variation, parse_exposure, parse_gradient, variation_of

WIDTH, HEIGHT, WHITE = 3000, 2000, 12000


def main() -> None:
    picture = photograph(WIDTH, HEIGHT)
    out = np.empty(picture.shape, np.uint16)
    with tempfile.TemporaryDirectory() as scratch:
        lut = noisy_table(Path(scratch) / "lut", 2)
        start = time.process_time()
        all_variations = variation_of(
            lut, parse_exposure("clip:share=.01"), parse_gradient("smooth:stops=1"), parse_iso("1600/100")
        )
        report("noise of a LUT", time.process_time() - start, "s")
        samples = np.array(lut.samples[0])
    noise = all_variations.noise
    variations = {
        "less light": Variation(parse_exposure(".5"), noise=noise),
        "more light": Variation(parse_exposure("2"), noise=noise),
        "automatic exposure": Variation(parse_exposure("clip:share=.01"), noise=noise),
        "gradient, soft edge": Variation(gradient=parse_gradient("soft-edge:stops=1"), noise=noise),
        "gradient, smooth": Variation(gradient=parse_gradient("smooth:stops=1"), noise=noise),
        "ISO 1600": Variation(iso=parse_iso("1600/100"), noise=noise),
        "all": all_variations,
    }
    metadata = ImageMetadata(WHITE, (0.3, 0.4, 0.3), "Benchmark")

    def draw() -> None:
        draw_samples(samples, picture, out=out)

    def vary(variation: Variation) -> Callable[[], object]:
        def call() -> None:
            draw()
            variation.apply(out, WHITE, 1, 2)

        return call

    calls: dict[str, Callable[[], object]] = {"plain": draw, **{name: vary(kind) for name, kind in variations.items()}}
    seconds = in_turns(calls, time.thread_time)
    draw()
    image = out.copy()
    png_s = in_turns({"PNG": lambda: encode_image(image, "png", metadata)}, time.thread_time, 2)["PNG"]
    pixels = WIDTH * HEIGHT / 1e6
    for name, call_s in seconds.items():
        report(f"{name}, one thread", pixels / call_s, "Mpx/s")
        if name != "plain":
            report(f"{name}, one thread", (call_s - seconds["plain"]) / seconds["plain"], "ratio", "added to drawing")
            report(
                f"{name}, one thread",
                (call_s - seconds["plain"]) / (seconds["plain"] + png_s),
                "ratio",
                "added to drawing and writing a PNG",
            )


if __name__ == "__main__":
    main()
