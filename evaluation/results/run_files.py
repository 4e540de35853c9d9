"""The files of a results folder that other programs read, as text."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind
from evaluation.results.result import Result

RUN_FORMAT = "crop.run"
"""What `run.json` says of itself."""

_KINDS: tuple[ErrorKind, ...] = ("recovery", "reproduction")


def errors_csv(images: Sequence[str], truths: npt.NDArray[np.float64], results: Sequence[Result]) -> str:
    """Return every estimate, truth and error as CSV text: `errors.csv`.

    The columns are image, method, r, g, b, truth_r, truth_g, truth_b, recovery, reproduction, guessed, cause. Lights
    have the sum 1, errors are degrees; `guessed` is 1 where the method gave no light and grey stands in for it, `cause`
    says why.

    `truths`: (N, 3) float64, camera RGB of any length.
    """
    shares = truths / truths.sum(axis=1, keepdims=True)
    given = [result.estimates / result.estimates.sum(axis=1, keepdims=True) for result in results]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    lights = ("r", "g", "b", "truth_r", "truth_g", "truth_b")
    writer.writerow(("image", "method", *lights, *_KINDS, "guessed", "cause"))
    for place, image in enumerate(images):
        for result, estimates in zip(results, given, strict=True):
            numbers = (*estimates[place], *shares[place])
            errors = (result.errors[kind][place] for kind in _KINDS)
            cause = (result.causes or {}).get(place, "")
            writer.writerow(
                [
                    *(image, result.method),
                    *(f"{part:.9f}" for part in numbers),
                    *(f"{error:.6f}" for error in errors),
                    int(result.guessed[place]),
                    cause,
                ]
            )
    return text.getvalue()


def several_lights_csv(images: Sequence[str], results: Sequence[Result]) -> tuple[str, str]:
    """Return the errors of images under several lights by pixel and by region as CSV text: `pixels.csv`, `regions.csv`.

    The columns of the first are image, method, pixel_recovery (LSMI's MAE_illum), pixel_reproduction, pixel_rgb (its
    MAE_rgb); of the second image, method, light (its number from 0), share (of the image's judged pixels), recovery,
    reproduction. Degrees; empty where no pixel of an image is judged.
    """
    pixels, regions = io.StringIO(), io.StringIO()
    by_pixel, by_region = csv.writer(pixels, lineterminator="\n"), csv.writer(regions, lineterminator="\n")
    by_pixel.writerow(("image", "method", "pixel_recovery", "pixel_reproduction", "pixel_rgb"))
    by_region.writerow(("image", "method", "light", "share", "recovery", "reproduction"))
    for result in results:
        maps = result.maps
        if maps is None:
            continue
        for place, number in enumerate(maps.images):
            errors = (maps.pixel["recovery"][place], maps.pixel["reproduction"][place], maps.rgb[place])
            by_pixel.writerow([images[number], result.method, *map(_degrees, errors)])
        for place, number in enumerate(maps.region_images):
            errors = (maps.region["recovery"][place], maps.region["reproduction"][place])
            by_region.writerow(
                [
                    *(images[number], result.method, int(maps.region_lights[place])),
                    f"{maps.region_shares[place]:.6f}",
                    *map(_degrees, errors),
                ]
            )
    return pixels.getvalue(), regions.getvalue()


def run_json(content: Mapping[str, Any]) -> str:
    """Return the text of `run.json`."""
    return json.dumps({"format": RUN_FORMAT, "version": 1, **content}, indent=2, ensure_ascii=False) + "\n"


def _degrees(error: float) -> str:
    return f"{error:.6f}" if np.isfinite(error) else ""
