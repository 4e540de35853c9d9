"""Tune parameters of a method on images without ground truth, based on the green stability assumption.

N. Banić, S. Lončarić, "Green stability assumption: unsupervised learning for statistics-based illumination estimation",
Journal of Imaging 4(11), 2018 (arXiv 1802.00776). Illuminants differ much in red and blue chromaticity, but little in
green. The best parameters are therefore those whose estimates vary least in green chromaticity. We chose the measure of
this variation: the standard deviation of g / (r + g + b) over the images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.methods.naming import FAMILIES
from evaluation.methods.prepared import GREY, estimate_all
from evaluation.scene import Scene, report_progress
from foundation.compiled import ordered_map
from foundation.errors import InputError

_MIN_IMAGES = 2  # smallest number of images for a standard deviation


@dataclass(frozen=True, eq=False)
class TuningResult:
    """Result of tuning.

    - `best`: candidate with the smallest spread; the first one if several are equal.
    - `candidates`: the C methods that were compared.
    - `spreads`: standard deviation of the green chromaticity of the estimates, for each candidate.
    - `lights`: (M, C, 3) float64, camera RGB of length 1: estimates for the M images that are True in `has_estimates`.
    - `has_estimates`: (N,) bool, True for images with estimates of all candidates; other images are excluded.
    """

    best: Method
    candidates: tuple[Method, ...]
    spreads: tuple[float, ...]
    lights: npt.NDArray[np.float64]
    has_estimates: npt.NDArray[np.bool_]


def tune(
    candidates: Sequence[Method], scenes: Sequence[Scene], on_scene: Callable[[], None] | None = None, workers: int = 1
) -> TuningResult:
    """Return the candidate whose estimates vary least in green chromaticity; ground truths are not used.

    `on_scene` is called after each image; `workers` is the number of threads. Raises InputError if fewer than two
    images have estimates of all candidates.

    Examples
    --------
    >>> class Wall:
    ...     name, truth, saturation = "wall", np.ones(3), None
    ...
    ...     def __init__(self, light):
    ...         image = np.full((8, 8, 3), 0.25)
    ...         image[0, 0] = [1, 0.5, 0.5] if light[0] > 1 else [0.5, 1, 0.5]
    ...         self.image = image * light
    ...
    ...     def read(self):
    ...         return self.image, None
    >>> walls = [Wall([2, 1, 1]), Wall([1, 1, 2]), Wall([1.5, 1, 1.5])]
    >>> from evaluation.methods.naming import find_method
    >>> tune([find_method(text) for text in family_names("shades-of-gray")], walls).best.name
    'Shades-of-Gray (p=1)'
    """
    if len(candidates) < 2 or len(scenes) < _MIN_IMAGES:
        raise InputError(f"{len(candidates)} candidates and {len(scenes)} images, expected 2 or more of each; add some")

    def estimates(scene: Scene) -> list[npt.NDArray[np.float64]]:
        image, mask = scene.read()
        lights = estimate_all(candidates, image, scene.saturation, mask)
        return [np.full(3, np.nan) if light is GREY else light for light in lights]

    all_estimates = np.array(list(report_progress(ordered_map(estimates, scenes, workers), on_scene)))
    is_complete = np.asarray(np.isfinite(all_estimates).all(axis=(1, 2)))
    complete = all_estimates[is_complete]
    if len(complete) < _MIN_IMAGES:
        raise InputError(
            f"{len(complete)} of {len(scenes)} images have estimates for all parameters, expected 2 or more; use "
            "larger images or smaller scales"
        )
    spreads = np.std(complete[:, :, 1] / complete.sum(axis=2), axis=0)
    best = candidates[int(spreads.argmin())]
    return TuningResult(best, tuple(candidates), tuple(map(float, spreads)), complete, is_complete)


def family_names(name: str) -> tuple[str, ...]:
    """Return the names of the candidates of a family, see `naming.find_method`.

    Candidates of Shades-of-Gray have p from 1 to 15. Other families combine six values of p with five values of sigma.

    Examples
    --------
    >>> family_names("shades-of-gray")[:2], family_names("gray-edge-1")[-1]
    (('shades-of-gray:p=1', 'shades-of-gray:p=2'), 'gray-edge-1:p=13:sigma=9')
    """
    if name not in FAMILIES:
        raise InputError(f"family {name!r} cannot be tuned, expected {', '.join(FAMILIES)}; choose one of these")
    if name == "shades-of-gray":
        return tuple(f"{name}:p={p}" for p in range(1, 16))
    return tuple(f"{name}:p={p}:sigma={sigma}" for sigma in (1, 2, 4, 6, 9) for p in (1, 2, 4, 6, 9, 13))
