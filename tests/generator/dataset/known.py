"""A LUT with known numbers, and the content of data sets for pinned tests."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from calibration.citation import OriginRecord
from calibration.table.lut import UNCERTAINTY, Lut, Provenance, Unfit, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illuminant
from generator.dataset.reader import Dataset, file_faults, open_dataset
from generator.kernels.choice import channels_of

# Spectra of the illuminants in three bands.
SPECTRA = ((9, 5, 2), (7, 6, 4), (5, 6, 6), (3, 5, 9), (4, 9, 3))

# Sensitivities of the camera in these bands.
CAMERA = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.2], [0.0, 0.1, 0.8]])


def table_in(folder: Path, bits: int = 2, samples: int = 25, order: tuple[int, ...] = (0, 1, 2, 3, 4)) -> Lut:
    """Make a LUT with noise, unfit patches, uncertainties, names and an origin; illuminants are in `order`."""
    folder.mkdir()
    rng = np.random.default_rng(11)
    codes = channels_of(np.arange(1 << 3 * bits), bits) / (2**bits - 1)
    writer = LutWriter(folder, len(order), 8**bits, samples)
    spectra = [SPECTRA[light] for light in order]
    white = [400 * np.asarray(light) @ CAMERA.T for light in spectra]
    for number, light in enumerate(spectra):
        means = 400 * ((0.04 + 0.96 * codes**2.2) * light) @ CAMERA.T
        photons = np.asarray(rng.poisson(means[:, None].repeat(samples, axis=1) / 3), np.float64)
        drawn = photons * 3 + rng.normal(0, 6, (8**bits, samples, 3))
        writer.put(number, np.clip(np.rint(drawn), 0, 4600).astype(np.uint16))
    kelvins = (2500.0, 3800.0, 5500.0, 9000.0, None)
    plan = [
        Illuminant(number, "blackbody" if kelvins[light] else "uniform", kelvins[light], Colour(9, 8, light))
        for number, light in enumerate(order)
    ]
    if order == (0, 1, 2, 3, 4):
        plan[4] = Illuminant(4, "spectrum", None, Colour(9, 8, 4), "E")
    provenance = Provenance(
        camera="Known camera",
        bits=bits,
        white_level=4600,
        session_sha256="1" * 64,
        chart_sha256="2" * 64,
        software="test 1",
        unfit=[Unfit(colour=colour, cause="a test") for colour in (0, 37, 8**bits - 3)],
        origin=OriginRecord(rig="lab", iso=100, aperture=8, shutter_s=0.5, lens="a lens", authors=["One", "Other"]),
    )
    uncertainty = "illumination,expanded_deg\n" + "".join(
        f"{n},{0.1 * (n + 1) ** 1.5:.4f}\n" for n in range(len(order))
    )
    writer.finish(plan, np.array(white), provenance, files={UNCERTAINTY: uncertainty})
    return open_lut(folder)


def plain_text(text: str) -> Any:
    """Return the number in a text, or the text."""
    try:
        return float(text) if "." in text or "e" in text else int(text)
    except ValueError:
        return text


def rows_of(text: str) -> list[list[Any]]:
    """Return the cells of a CSV file, with numbers parsed."""
    return [[plain_text(cell) for cell in row] for row in csv.reader(io.StringIO(text))]


def data_set_content(out: Path) -> dict[str, Any]:
    """Return the numbers of every list of a data set, and shape and bytes of each image and map."""
    dataset = open_dataset(out)
    described = json.loads((out / "dataset.json").read_text(encoding="utf-8"))
    lists = {path.name: rows_of(path.read_text(encoding="utf-8")) for path in sorted(out.glob("*.csv"))}
    splits = {path.stem: path.read_text().split() for path in sorted(out.glob("splits/*"))}
    sums = [line.split("  ")[1] for line in (out / "SHA256SUMS").read_text().splitlines()]
    return {
        "pixels": [described["pixels"], described["replaced_pixels"]],
        "lists": lists,
        "truths": [[float(number) for number in line.split()] for line in (out / "gt.txt").read_text().splitlines()],
        "parts": {name: len(images) for name, images in splits.items()},
        "files": len(sums),
        "faults": len(list(file_faults(out))),
        "images": [image_content(dataset, number) for number in range(len(dataset.entries))],
    }


def image_content(dataset: Dataset, number: int) -> list[Any]:
    """Return shape and bytes of an image, and the bytes of its maps."""
    entry = dataset.entries[number]
    image = dataset.read_image(entry)
    values: list[Any] = [image.shape, image.tobytes()]
    if len(entry.lights) > 1:
        values += [dataset.read_weights(entry).tobytes(), dataset.read_ground_truth_map(entry).tobytes()]
    return values
