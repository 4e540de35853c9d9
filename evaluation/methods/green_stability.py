"""Tune a method's parameters on images whose light nobody knows, by the green stability assumption.

N. Banić, S. Lončarić, "Green stability assumption: unsupervised learning for statistics-based illumination estimation",
Journal of Imaging 4(11), 2018 (arXiv 1802.00776): lights differ much in red and blue chromaticity and little in green,
so of several sets of parameters the one whose estimates spread least in green chromaticity is taken to be the best.
Here the spread is the standard deviation of g / (r + g + b) over the images; that is our reading of the paper, a
reconstruction. Images for which any of the candidates gives no light are left out for all of them.
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

_FEWEST_IMAGES = 2  # Images that a spread is found of


@dataclass(frozen=True, eq=False)
class Tuned:
    """What tuning found.

    - `best`: the candidate with the least spread, the first of equals.
    - `candidates`: all of them.
    - `spreads`: standard deviation of the green chromaticity of each one's estimates.
    - `lights`: (M, C, 3) float64, camera RGB of length 1: the candidates' estimates for each image that counts.
    - `counted`: (N,) bool, True for an image that counts.
    """

    best: Method
    candidates: tuple[Method, ...]
    spreads: tuple[float, ...]
    lights: npt.NDArray[np.float64]
    counted: npt.NDArray[np.bool_]


def tune(
    candidates: Sequence[Method],
    scenes: Sequence[Scene],
    on_scene: Callable[[], None] | None = None,
    workers: int = 1,
) -> Tuned:
    """Find the candidate whose estimates spread least in green chromaticity; ground truths are not looked at.

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
    if len(candidates) < 2 or len(scenes) < _FEWEST_IMAGES:
        raise InputError(f"{len(candidates)} sets of parameters on {len(scenes)} images; expected 2 or more of each")

    def estimates(scene: Scene) -> list[npt.NDArray[np.float64]]:
        image, mask = scene.read()
        lights = estimate_all(candidates, image, scene.saturation, mask)
        return [np.full(3, np.nan) if light is GREY else light for light in lights]

    every = np.array(list(report_progress(ordered_map(estimates, scenes, workers), on_scene)))
    counted = np.asarray(np.isfinite(every).all(axis=(1, 2)))
    given = every[counted]
    if len(given) < _FEWEST_IMAGES:
        raise InputError(
            f"only {len(given)} of {len(scenes)} images give a light with every set of parameters; expected 2 or "
            "more: use larger images or smaller scales"
        )
    spreads = np.std(given[:, :, 1] / given.sum(axis=2), axis=0)
    best = candidates[int(spreads.argmin())]
    return Tuned(best, tuple(candidates), tuple(map(float, spreads)), given, counted)


def family_names(name: str) -> tuple[str, ...]:
    """Return what `naming.find_method` takes for each candidate of a family.

    Norms 1 to 15 without a scale; with scales of 1 to 9 px six norms up to 13.

    Examples
    --------
    >>> family_names("shades-of-gray")[:2], family_names("gray-edge-1")[-1]
    (('shades-of-gray:p=1', 'shades-of-gray:p=2'), 'gray-edge-1:p=13:sigma=9')
    """
    if name not in FAMILIES:
        raise InputError(f"{name!r} is no family of methods to tune; the families are {', '.join(FAMILIES)}")
    if name == "shades-of-gray":
        return tuple(f"{name}:p={p}" for p in range(1, 16))
    return tuple(f"{name}:p={p}:sigma={sigma}" for sigma in (1, 2, 4, 6, 9) for p in (1, 2, 4, 6, 9, 13))
