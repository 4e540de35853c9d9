"""Methods on datasets: the errors that the paper's tables sum up."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.datasets import Scene
from evaluation.methods.method import Method
from evaluation.methods.pixels import GREY
from evaluation.metrics import ErrorKind, Summary, recovery_error, reproduction_error, summarise
from foundation.errors import InputError

COLUMNS = ("method", "mean", "median", "trimean", "best25", "worst25", "avg")


@dataclass(frozen=True, eq=False)
class Result:
    """Estimates and errors of one method on one dataset.

    Attributes
    ----------
    method
        The method's name.
    estimates
        (N, 3) float64, camera RGB of length 1, in the order of the scenes.
    errors
        Kind of error to (N,) float64, degrees.
    guessed
        (N,) bool, True where no pixel was usable and the estimate is therefore grey.
    """

    method: str
    estimates: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]

    def summary(self, kind: ErrorKind) -> Summary:
        """Return the six numbers of the paper's tables for one kind of error."""
        return summarise(self.errors[kind])


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
        return [method.estimate(image, scene.saturation, mask) for method in methods]

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


def table_csv(results: Sequence[Result], kind: ErrorKind) -> str:
    """Return the table of one dataset as CSV text: `method,mean,median,trimean,best25,worst25,avg`, degrees.

    Examples
    --------
    >>> errors = {"reproduction": np.array([1.0, 2.0, 3.0, 4.0])}
    >>> print(table_csv([Result("Gray-world", np.ones((4, 3)), errors, np.zeros(4, bool))], "reproduction"), end="")
    method,mean,median,trimean,best25,worst25,avg
    Gray-world,2.500000,2.500000,2.500000,1.000000,4.000000,2.286525
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for result in results:
        writer.writerow([result.method, *(f"{number:.6f}" for number in result.summary(kind).as_tuple())])
    return text.getvalue()


def images_csv(scenes: Sequence[Scene], results: Sequence[Result]) -> str:
    """Return every estimate and error as CSV text: `image,method,r,g,b,recovery,reproduction`.

    Estimates are scaled to r + g + b = 1, errors are degrees.

    Parameters
    ----------
    scenes
        N scenes, as they were given to `evaluate`.
    results
        The results of `evaluate`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("image", "method", "r", "g", "b", "recovery", "reproduction"))
    for place, scene in enumerate(scenes):
        for result in results:
            light = result.estimates[place] / result.estimates[place].sum()
            errors = (result.errors["recovery"][place], result.errors["reproduction"][place])
            writer.writerow([scene.name, result.method, *(f"{part:.6f}" for part in (*light, *errors))])
    return text.getvalue()
