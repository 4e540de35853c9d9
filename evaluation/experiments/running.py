"""Run methods on the scenes of a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.methods.pixels import GREY
from evaluation.methods.prepared import estimate_all
from evaluation.metrics import recovery_error, reproduction_error
from evaluation.results.result import Result
from evaluation.scene import Scene
from foundation.errors import InputError


def evaluate(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[Result, ...]:
    """Return the estimates and errors of every method on every scene; each image is read once.

    Parameters
    ----------
    scenes
        The images with their ground truths, at least one.
    methods
        At least one.
    workers
        Threads, one image each; no number depends on it.
    on_scene
        Called after each scene, from the calling thread.

    Returns
    -------
    tuple of Result
        One a method, in their order.

    Raises
    ------
    InputError
        There is no scene or no method, or the ground truth of a scene is no light.
    FormatError
        An image cannot be read.

    Examples
    --------
    Any value with a name, a ground truth, a saturation and `read` is a scene. Gray-world is right on an image that is
    grey on average under its light:

    >>> from evaluation.methods.standard import standard_methods
    >>> class Wall:
    ...     name, truth, saturation = "wall", np.array([1.0, 2.0, 1.0]), None
    ...
    ...     def read(self):
    ...         return np.ones((8, 8, 3)) * [500, 1000, 500], None
    >>> (result,) = evaluate([Wall()], [standard_methods()["gray-world"]])
    >>> f"{result.method}: {result.summary('reproduction').mean:.2f} degrees"
    'Gray-world: 0.00 degrees'
    """
    if not scenes or not methods:
        raise InputError(f"{len(methods)} methods on {len(scenes)} images: name at least one of each")
    truths = np.stack([_light(scene) for scene in scenes])

    def estimate(scene: Scene) -> list[npt.NDArray[np.float64]]:
        image, mask = scene.read()
        return estimate_all(methods, image, scene.saturation, mask)

    estimates: list[list[npt.NDArray[np.float64]]] = []
    with ThreadPoolExecutor(max(1, workers)) as pool:
        for answer in pool.map(estimate, scenes):
            estimates.append(answer)
            if on_scene:
                on_scene()
    lights = np.stack([np.stack(given) for given in estimates], axis=1)
    guessed = np.array([[light is GREY for light in given] for given in estimates]).T
    return tuple(
        Result(
            method.name,
            given,
            {"recovery": recovery_error(given, truths), "reproduction": reproduction_error(given, truths)},
            blind,
        )
        for method, given, blind in zip(methods, lights, guessed, strict=True)
    )


def _light(scene: Scene) -> npt.NDArray[np.float64]:
    truth = scene.truth
    if not (np.isfinite(truth).all() and truth.min() >= 0 and truth.any()):
        raise InputError(
            f"the ground truth of {scene.name} is {' '.join(f'{part:g}' for part in truth)}, expected red, green and "
            "blue of a light: none below 0, not all 0; correct it"
        )
    return truth
