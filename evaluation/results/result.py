"""A run as values: what methods answered for each image, the results that answers make, and the run of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY
from evaluation.metrics import ErrorKind, MapError, Summary, recovery_error, reproduction_error, summarise
from foundation.errors import first_few


@dataclass(frozen=True, eq=False)
class Result:
    """Estimates and errors of one method on one dataset.

    - `method`: the method's name.
    - `estimates`: (N, 3) float64, camera RGB of length 1, in the order of the scenes.
    - `errors`: kind of error to (N,) float64, degrees; of an image under several lights the error against their mean.
    - `guessed`: (N,) bool, True where the method gave no light and grey stands in for it.
    - `causes`: why it gave none, or none for some pixels, by the image's number among the scenes; None where nobody
      asked.
    - `maps`: the errors on images under several lights by pixel and region, by the image's number, rising; None where
      no image is, or none was measured.
    """

    method: str
    estimates: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    causes: Mapping[int, str] | None = None
    maps: Mapping[int, MapError] | None = None

    def at(self, places: npt.NDArray[np.int64]) -> Result:
        """Return what was made of the scenes at `places` (P,) int64 alone, in that order; errors by pixel are left out.

        Examples
        --------
        >>> result = Result("Mine", np.eye(3), {"recovery": np.array([1.0, 2.0, 3.0])}, np.zeros(3, bool), {2: "dark"})
        >>> some = result.at(np.array([2, 0]))
        >>> some.errors["recovery"], some.causes
        (array([3., 1.]), {0: 'dark'})
        """
        causes = self.causes
        return Result(
            self.method,
            self.estimates[places],
            {kind: errors[places] for kind, errors in self.errors.items()},
            self.guessed[places],
            None if causes is None else {new: causes[old] for new, old in enumerate(places.tolist()) if old in causes},
        )

    @property
    def marked_name(self) -> str:
        """The method's name as tables for people have it: with how often grey stands in, so that a row says it alone.

        Examples
        --------
        >>> Result("Mine", np.eye(3), {}, np.array([True, False, True])).marked_name
        'Mine (no light: 2 of 3)'
        """
        missing = int(self.guessed.sum())
        return f"{self.method} (no light: {missing} of {len(self.guessed)})" if missing else self.method

    def summary(self, kind: ErrorKind) -> Summary:
        """Return the numbers that sum up one kind of error, the six of the paper's tables among them."""
        return summarise(self.errors[kind])


# The cause where a method of the suite gave no light: too small an image for it, clipped, black or even.
NO_PIXEL = "no usable pixel"


@dataclass(frozen=True)
class SceneAnswer:
    """What one method answered for one image.

    - `light`: the estimate, camera RGB of length 1; None where there is none, and grey is taken for it.
    - `cause`: why there is none: "no usable pixel", or what was returned; empty where there is an estimate for every
      pixel.
    - `by_pixel`: the errors by pixel and region, where several lights fall on the image.
    """

    light: tuple[float, float, float] | None = None
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
    kind = ""
    try:
        plain = np.asarray(given)  # Of complex, boolean and masked numbers nothing is to be lost silently.
        kind = f" of {plain.dtype}" if plain.dtype.kind in "bc" else ""
        if plain.dtype.kind not in "iufO" or hasattr(given, "mask"):
            raise TypeError(plain.dtype)
        light = plain.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"returned {type(given).__name__}{kind}, expected three real numbers: red, green, blue"
        ) from error
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
    results: list[Result] = []
    for place, method in enumerate(methods):
        own = [given[place] for given in answers]
        estimates = np.array([GREY if answer.light is None else answer.light for answer in own], dtype=np.float64)
        results.append(
            Result(
                method,
                estimates,
                {"recovery": recovery_error(estimates, truths), "reproduction": reproduction_error(estimates, truths)},
                np.array([answer.light is None for answer in own]),
                {number: answer.cause for number, answer in enumerate(own) if answer.cause},
                {number: answer.by_pixel for number, answer in enumerate(own) if answer.by_pixel} or None,
            )
        )
    return tuple(results)


@dataclass(frozen=True)
class Subject:
    """What results are of.

    - `name`: the data set's name.
    - `images`: the images' names.
    - `mixed`: whether several lights fall on each image.
    - `groups`: what each image shares with others, such as the picture that it was made from; None if every image is
      one of its own.
    """

    name: str
    images: tuple[str, ...]
    mixed: tuple[bool, ...]
    groups: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """Methods on a data set, and their results.

    - `subject`: the data set's name and its images.
    - `layout`, `place`, `treatment`: see `scene.SceneSet`.
    - `data_sha256`: of the images' names and ground truths; see `learning.model_files.scenes_sha256`.
    - `truths`: (N, 3) float64, camera RGB of any length.
    - `results`: one a method.
    - `methods`: a JSON object each; see `method_records.describe_method`.
    - `settings`: what else the results depend on, such as a seed: JSON.
    - `folds`: (N,) int64, the fold of each image, where the methods were cross-validated; else None.
    - `notes`: sentences that belong beside the results.
    - `software`: name and version of what made them.
    """

    subject: Subject
    layout: str
    place: str
    treatment: Mapping[str, str]
    data_sha256: str
    truths: npt.NDArray[np.float64]
    results: tuple[Result, ...]
    methods: tuple[Mapping[str, Any], ...]
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    folds: npt.NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    software: str = ""
    truth_uncertainty_deg: float | None = None


def indistinct(results: Sequence[Result], uncertainty_deg: float | None) -> tuple[str, ...]:
    """Return a sentence on methods whose medians differ by less than ground truths may be off by, if there are any.

    `uncertainty_deg`: expanded (k = 2), degrees; None where the data set does not state it.
    """
    if uncertainty_deg is None:
        return ()
    medians = [(result.method, result.summary("reproduction").median) for result in results]
    pairs = [
        f"{one} and {other}"
        for (one, first), (other, second) in combinations(medians, 2)
        if abs(first - second) < uncertainty_deg
    ]
    told = (
        f"ground truths may be off by {uncertainty_deg:.2g} degrees (k = 2), more than the medians of "
        f"{first_few(pairs, 3)} differ by: they do not tell these apart"
    )
    return (told,) if pairs else ()
