"""How fast images are made: `python -m benchmarks.generator` prints one JSON object a line.

Figures of one run are to be compared with each other, not with another day's: `against` names what a ratio is to.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from calibration.lut import Lut, LutWriter, Provenance, open_lut
from drivers.presenter import Colour
from generator.dataset import default_workers, generate_dataset
from generator.encode import Shot, encode_image
from generator.kernel import draw_samples
from generator.scene import find_pictures

SAMPLES = 25
REPEATS = 5


def best(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the seconds of the fastest of some calls, after one that does not count."""
    call()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def report(name: str, value: float, unit: str, against: str = "") -> None:
    print(json.dumps({"name": name, "value": round(value, 3), "unit": unit, "against": against}), flush=True)


def natural_picture(width: int, height: int) -> npt.NDArray[np.uint8]:
    """Return a picture with the colour statistics of smooth things, edges and texture: no file is needed."""
    rng = np.random.default_rng(1)
    layers = np.zeros((height, width, 3), np.float32)
    for octave in (3, 12, 48, 192):
        coarse = rng.uniform(-1, 1, (octave, octave * width // height, 3)).astype(np.float32)
        layers += np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)) / octave**0.5
    low, high = np.percentile(layers, [1, 99])
    return np.clip((layers - low) / (high - low) * 255, 0, 255).astype(np.uint8)


def noisy_table(folder: Path, lights: int) -> Lut:
    """Return a table of 32768 colours with shot noise."""
    from acquisition.illuminations import Illumination

    index = np.arange(32768)
    code = np.stack([index >> 10, index >> 5 & 31, index & 31], axis=-1) / 31
    means = 60 + 8000 * (0.04 + 0.8 * code**2.2) * [0.6, 1.0, 0.7]
    rng = np.random.default_rng(2)
    folder.mkdir()
    writer = LutWriter(folder, lights, 32768, SAMPLES)
    for light in range(lights):
        writer.put(light, rng.poisson(means[:, None].repeat(SAMPLES, axis=1)).astype(np.uint16))
    known = Provenance(
        camera="Benchmark", bits=5, white_level=12000, session_sha256="0", chart_sha256="0", software="benchmark"
    )
    plan = [Illumination(light, "uniform", None, Colour(255, 255, 255)) for light in range(lights)]
    writer.finish(plan, np.full((lights, 3), 4000.0), known)
    return open_lut(folder)


def by_numpy(samples: npt.NDArray[np.uint16], picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint16]:
    """Return a raw image in the way that first comes to mind."""
    colour = (picture >> 3).astype(np.int64) @ np.array([1024, 32, 1])
    choice = np.random.default_rng(0).integers(0, SAMPLES, colour.shape)
    return np.take(samples.reshape(-1, 3), colour * SAMPLES + choice, axis=0)


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        lut = noisy_table(Path(scratch) / "lut", 2)
        samples = np.array(lut.samples[0])
        for name, width, height in (("18 Mpx", 5184, 3456), ("512 px", 512, 512)):
            picture = natural_picture(width, height)
            pixels = width * height / 1e6
            out = np.empty(picture.shape, np.uint16)
            copy = pixels / best(lambda picture=picture, out=out: np.copyto(out, picture))
            one = pixels / best(lambda picture=picture, out=out: draw_samples(samples, picture, out=out))
            two = pixels / best(lambda picture=picture, out=out: draw_samples(samples, picture, out=out, threads=2))
            plain = pixels / best(lambda picture=picture: by_numpy(samples, picture), 2)
            report(f"streaming copy, {name}", copy, "Mpx/s")
            report(f"kernel, {name}, one thread", one, "Mpx/s")
            report(f"kernel, {name}, one thread", one / copy, "ratio", "streaming copy of 3 bytes in, 6 out")
            report(f"kernel, {name}, two threads", two, "Mpx/s")
            report(f"numpy take with rng.integers, {name}", plain, "Mpx/s")
            report(f"kernel, {name}, one thread", one / plain, "ratio", "numpy take with rng.integers")
        large = natural_picture(5184, 3456)
        image = draw_samples(samples, large)
        shot = Shot(12000, (4000.0, 4000.0, 4000.0), "Benchmark")
        for form in ("png", "tiff"):
            took = best(lambda form=form: encode_image(image, "png" if form == "png" else "tiff", shot), 1)
            size = len(encode_image(image, "png" if form == "png" else "tiff", shot)) / image.nbytes
            report(f"{form} encoder, 18 Mpx", large.size / 3e6 / took, "Mpx/s")
            report(f"{form} encoder, 18 Mpx, size", size, "ratio", "the image's bytes in memory")
        sources = Path(scratch) / "sources"
        sources.mkdir()
        for number in range(2):
            data = cv2.imencode(".jpg", large)[1].tobytes()
            (sources / f"{number}.jpg").write_bytes(data)
        for number in range(32):
            (sources / f"small-{number}.jpg").write_bytes(
                cv2.imencode(".jpg", large[number * 64 :][:512, :512])[1].tobytes()
            )
        workers = default_workers()
        for form in ("png", "tiff"):
            for name, pattern, lights in (("18 Mpx", "[0-9].jpg", (0, 1)), ("512 px", "small-*.jpg", (0, 1))):
                found = find_pictures(sorted(sources.glob(pattern)))
                start = time.perf_counter()
                generate_dataset(
                    lut,
                    Path(scratch) / f"out-{form}-{name}",
                    found,
                    lights,
                    form="png" if form == "png" else "tiff",
                    workers=workers,
                )
                rate = len(found) * len(lights) / (time.perf_counter() - start)
                report(f"whole datasets of {form}, {name}, previews too, {workers} workers", rate, "images/s")


if __name__ == "__main__":
    main()
