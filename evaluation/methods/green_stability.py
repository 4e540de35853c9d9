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

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Method
from evaluation.methods.prepared import GREY, estimate_all
from evaluation.scene import Scene
from foundation.errors import InputError

FAMILIES = ("shades-of-gray", "general-gray-world", "gray-edge-1", "gray-edge-2")
"""The families that `family` makes."""

_FEWEST_IMAGES = 2
"""Images that a spread is found of."""


@dataclass(frozen=True)
class Tuned:
    """What tuning found.

    - `best`: the candidate with the least spread, the first of equals.
    - `candidates`: all of them.
    - `spreads`: standard deviation of the green chromaticity of each one's estimates.
    - `images`: number of images that count.
    """

    best: Method
    candidates: tuple[Method, ...]
    spreads: tuple[float, ...]
    images: int


def tune(candidates: Sequence[Method], scenes: Sequence[Scene], on_scene: Callable[[], None] | None = None) -> Tuned:
    """Return the candidate whose estimates spread least in green chromaticity; ground truths are not looked at.

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
    >>> tune(family("shades-of-gray"), walls).best.name
    'Shades-of-Gray (p=1)'
    """
    require_enough(len(candidates), len(scenes))
    lights: list[npt.NDArray[np.float64]] = []
    for scene in scenes:
        lights.append(lights_of(candidates, scene))
        if on_scene:
            on_scene()
    return choose(candidates, np.stack(lights))


def lights_of(candidates: Sequence[Method], scene: Scene) -> npt.NDArray[np.float64]:
    """Return the candidates' estimates of a scene, (C, 3) float64; NaN for one that gives no light.

    The scene's ground truth is not looked at.
    """
    image, mask = scene.read()
    lights = estimate_all(candidates, image, scene.saturation, mask)
    return np.array([np.full(3, np.nan) if light is GREY else light for light in lights])


def choose(candidates: Sequence[Method], lights: npt.NDArray[np.float64]) -> Tuned:
    """Return the candidate whose estimates spread least in green chromaticity.

    `lights`: (N, C, 3) float64, camera RGB of any length: the estimates of `lights_of` for N images.

    Examples
    --------
    >>> steady, loose = [1.0, 2.0, 1.0], [1.0, 1.0, 1.0]
    >>> choose(family("shades-of-gray")[:2], np.array([[steady, steady], [steady, loose]])).spreads
    (0.0, 0.0833...)
    """
    require_enough(len(candidates), len(lights))
    given = lights[counted(lights)]
    if len(given) < _FEWEST_IMAGES:
        raise InputError(
            f"only {len(given)} of {len(lights)} images give a light with every set of parameters; expected 2 or "
            "more: use larger images or smaller scales"
        )
    spreads = np.std(given[:, :, 1] / given.sum(axis=2), axis=0)
    return Tuned(
        candidates[int(spreads.argmin())],
        tuple(candidates),
        tuple(float(spread) for spread in spreads),
        len(given),
    )


def counted(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool, True for an image that counts: each of its C estimates (N, C, 3) float64 is a light."""
    return np.asarray(np.isfinite(lights).all(axis=(1, 2)))


def require_enough(candidates: int, images: int) -> None:
    """Raise where so many candidates and images are too few to choose by."""
    if candidates < 2 or images < _FEWEST_IMAGES:
        raise InputError(f"{candidates} sets of parameters on {images} images; expected 2 or more of each")


def family_names(name: str) -> tuple[str, ...]:
    """Return what `naming.find_method` takes for each candidate of a family, in the order of `family`.

    Examples
    --------
    >>> family_names("shades-of-gray")[:2], family_names("gray-edge-1")[-1]
    (('shades-of-gray:p=1', 'shades-of-gray:p=2'), 'gray-edge-1:p=13:sigma=9')
    """
    return tuple(
        f"{name}:p={member.p:g}" + (f":sigma={member.sigma:g}" if member.sigma else "") for member in family(name)
    )


def family(name: str) -> tuple[GrayEdge, ...]:
    """Return the candidates of a family, each with its parameters in its name.

    Norms 1 to 15 without a scale; with scales of 1 to 9 px six norms up to 13.

    Examples
    --------
    >>> [len(family(name)) for name in FAMILIES]
    [15, 30, 30, 30]
    """
    norms, scales = (1, 2, 4, 6, 9, 13), (1.0, 2.0, 4.0, 6.0, 9.0)
    if name == "shades-of-gray":
        return tuple(GrayEdge(f"Shades-of-Gray (p={p})", 0, p, 0) for p in range(1, 16))
    titles = {
        "general-gray-world": ("General Gray-world", 0),
        "gray-edge-1": ("1st-order Gray-Edge", 1),
        "gray-edge-2": ("2nd-order Gray-Edge", 2),
    }
    if name not in titles:
        raise InputError(f"{name!r} is no family of methods to tune; the families are {', '.join(FAMILIES)}")
    title, order = titles[name]
    return tuple(GrayEdge(f"{title} (p={p}, σ={sigma:g})", order, p, sigma) for sigma in scales for p in norms)
