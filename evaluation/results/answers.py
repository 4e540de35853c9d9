"""What methods answered for one image, before it becomes a part of results; a line of JSON each while a run goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY
from evaluation.metrics import MapError, RegionError, recovery_error, reproduction_error
from evaluation.results.result import MapErrors, Result

NO_PIXEL = "no usable pixel"
"""The cause where a method of the suite gave no light: too small an image for it, clipped, black or even."""


@dataclass(frozen=True)
class SceneAnswer:
    """What one method answered for one image.

    - `light`: the estimate, camera RGB of length 1; None where there is none, and grey is taken for it.
    - `cause`: why there is none: "no usable pixel", or what was returned; empty where there is an estimate for every
      pixel.
    - `by_pixel`: the errors by pixel and region, where several lights fall on the image.
    """

    light: tuple[float, float, float] | None
    cause: str = ""
    by_pixel: MapError | None = None


def read_light(given: object, grey: npt.NDArray[np.float64] = GREY) -> SceneAnswer:
    """Return the answer that a returned value is.

    `given`: what a method returned: (3,) numbers, or None. `grey`: (3,) float64, the very array that methods return for
    an image without a usable pixel.

    Examples
    --------
    >>> read_light([3, 0, 4]).light
    (0.6, 0.0, 0.8)
    >>> read_light([1, float("nan"), 1]).cause
    'returned 1 nan 1'
    """
    if given is grey:
        return SceneAnswer(None, NO_PIXEL)
    if given is None:
        return SceneAnswer(None, "returned None")
    try:
        plain = np.asarray(given)  # Of complex, boolean and masked numbers nothing is to be lost silently.
        if plain.dtype.kind not in "iufO" or hasattr(given, "mask"):
            raise TypeError(plain.dtype)
        light = plain.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"returned {type(given).__name__}, expected three real numbers: red, green, blue") from error
    if light.shape != (3,):
        raise ValueError(f"returned an array of shape {light.shape}, expected (3,): red, green, blue")
    length = math.hypot(*light)
    if not (math.isfinite(length) and length > 0 and light.min() >= 0):
        return SceneAnswer(None, f"returned {' '.join(f'{part:g}' for part in light)}")
    red, green, blue = (float(part) / length for part in light)
    return SceneAnswer((red, green, blue))


def results_of(
    methods: Sequence[str], truths: npt.NDArray[np.float64], answers: Sequence[Sequence[SceneAnswer]]
) -> tuple[Result, ...]:
    """Return the results that answers make.

    `truths`: (N, 3) float64, the true lights of the scenes.
    """
    return tuple(_result(method, truths, [given[number] for given in answers]) for number, method in enumerate(methods))


def _result(method: str, truths: npt.NDArray[np.float64], answers: Sequence[SceneAnswer]) -> Result:
    estimates = np.array([GREY if answer.light is None else answer.light for answer in answers], dtype=np.float64)
    return Result(
        method,
        estimates,
        {"recovery": recovery_error(estimates, truths), "reproduction": reproduction_error(estimates, truths)},
        np.array([answer.light is None for answer in answers]),
        {number: answer.cause for number, answer in enumerate(answers) if answer.cause},
        _maps(answers),
    )


def _maps(answers: Sequence[SceneAnswer]) -> MapErrors | None:
    measured = [(number, answer.by_pixel) for number, answer in enumerate(answers) if answer.by_pixel is not None]
    if not measured:
        return None
    regions = [(number, region) for number, error in measured for region in error.regions]
    return MapErrors(
        images=np.array([number for number, _ in measured], dtype=np.int64),
        pixel={
            "recovery": np.array([error.recovery for _, error in measured]),
            "reproduction": np.array([error.reproduction for _, error in measured]),
        },
        rgb=np.array([error.rgb for _, error in measured]),
        region_images=np.array([number for number, _ in regions], dtype=np.int64),
        region_lights=np.array([region.light for _, region in regions], dtype=np.int64),
        region_shares=np.array([region.share for _, region in regions], dtype=np.float64),
        region={
            "recovery": np.array([region.recovery for _, region in regions], dtype=np.float64),
            "reproduction": np.array([region.reproduction for _, region in regions], dtype=np.float64),
        },
    )


def answer_to_json(answer: SceneAnswer) -> dict[str, Any]:
    """Return an answer as a JSON object, from which `answer_from_json` makes the same answer to the last bit."""
    return {key: value for key, value in asdict(answer).items() if value not in (None, "")}


def answer_from_json(stored: dict[str, Any]) -> SceneAnswer:
    """Return the answer that a JSON object is.

    Examples
    --------
    >>> answer = SceneAnswer((0.1, 0.2, 1 / 3), "", MapError(1.0, 2.0, 3.0, (RegionError(0, 0.5, 1.0, 2.0),)))
    >>> answer_from_json(answer_to_json(answer)) == answer
    True
    """
    light, by_pixel = stored.get("light"), stored.get("by_pixel")
    if light is not None:
        red, green, blue = map(float, light)
        light = (red, green, blue)
    if by_pixel is not None:
        regions = tuple(RegionError(**region) for region in by_pixel["regions"])
        by_pixel = MapError(**(by_pixel | {"regions": regions}))
    return SceneAnswer(light, str(stored.get("cause", "")), by_pixel)
