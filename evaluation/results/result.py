"""Values of a run: the answer of each method for each image, the results of each method, and the whole run."""

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
from foundation.errors import counted, first_few


@dataclass(frozen=True, eq=False)
class Result:
    """Estimates and errors of one method on one data set.

    - `method`: name of the method.
    - `estimates`: (N, 3) float64, camera RGB of length 1, in the order of the scenes.
    - `errors`: (N,) float64 for each kind of error, degrees. Under several illuminants, it is the error against their
      mean.
    - `guessed`: (N,) bool, True if the method returned no illuminant and grey replaces it.
    - `causes`: reason why an image or some of its pixels have no estimate, by index of the image; None if not
      recorded.
    - `maps`: errors by pixel and region of images under several illuminants, by index of the image, ascending; None if
      there are none.
    """

    method: str
    estimates: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    causes: Mapping[int, str] | None = None
    maps: Mapping[int, MapError] | None = None

    def __repr__(self) -> str:
        """Return one line, because there may be thousands of images."""
        return f"Result({self.method!r}, {counted(len(self.estimates), 'image')})"

    def at(self, indices: npt.NDArray[np.int64]) -> Result:
        """Return the results of the scenes with these indices (P,) int64, in this order, without `maps`.

        Examples
        --------
        >>> result = Result("Mine", np.eye(3), {"recovery": np.array([1.0, 2.0, 3.0])}, np.zeros(3, bool), {2: "dark"})
        >>> selected = result.at(np.array([2, 0]))
        >>> selected.errors["recovery"], selected.causes
        (array([3., 1.]), {0: 'dark'})
        """
        causes = self.causes
        return Result(
            self.method,
            self.estimates[indices],
            {metric: errors[indices] for metric, errors in self.errors.items()},
            self.guessed[indices],
            None if causes is None else {new: causes[old] for new, old in enumerate(indices.tolist()) if old in causes},
        )

    @property
    def marked_name(self) -> str:
        """Name of the method for tables, with the number of images without an estimate.

        Examples
        --------
        >>> Result("Mine", np.eye(3), {}, np.array([True, False, True])).marked_name
        'Mine (no estimate: 2 of 3)'
        """
        missing = int(self.guessed.sum())
        return f"{self.method} (no estimate: {missing} of {len(self.guessed)})" if missing else self.method

    def summary(self, metric: ErrorKind) -> Summary:
        """Return the statistics of one kind of error."""
        return summarise(self.errors[metric])


# Cause if a method of this suite returned no illuminant, because the image is too small, clipped, black or uniform.
NO_PIXEL = "no usable pixel"


@dataclass(frozen=True)
class SceneAnswer:
    """Answer of one method for one image."""

    # Estimate, camera RGB of length 1; None if there is none, and grey replaces it
    light: tuple[float, float, float] | None = None
    # Reason for no estimate: "no usable pixel", or the returned value; "" if every pixel has an estimate
    cause: str = ""
    by_pixel: MapError | None = None  # Errors by pixel and region, if several illuminants reach the image


def read_estimate(returned_value: object, grey: npt.NDArray[np.float64] = GREY) -> SceneAnswer:
    """Return the answer for the value that a method returned: (3,) numbers, or None.

    `grey`: the array object that methods return for an image without a usable pixel; it is compared by identity.

    Examples
    --------
    >>> read_estimate([3, 0, 4]).light
    (0.6, 0.0, 0.8)
    >>> read_estimate([1, float("nan"), 1]).cause
    'returned 1 nan 1'
    """
    if returned_value is grey:
        return SceneAnswer(None, NO_PIXEL)
    if returned_value is None:
        return SceneAnswer(None, "returned None")
    dtype_text = ""
    try:
        # Complex, boolean and masked numbers are refused, because a conversion would lose a part without a warning.
        array = np.asarray(returned_value)
        dtype_text = f" of {array.dtype}" if array.dtype.kind in "bc" else ""
        if array.dtype.kind not in "iufO" or hasattr(returned_value, "mask"):
            raise TypeError(array.dtype)
        light = array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"returned {type(returned_value).__name__}{dtype_text}, expected three real numbers: red, green, blue"
        ) from error
    if light.shape != (3,):
        raise ValueError(f"returned an array of shape {light.shape}, expected (3,): red, green, blue")
    length = math.hypot(*light)
    if not (math.isfinite(length) and length > 0 and light.min() >= 0):
        return SceneAnswer(None, f"returned {' '.join(f'{channel:g}' for channel in light)}")
    red, green, blue = (float(channel) / length for channel in light)
    return SceneAnswer((red, green, blue))


def collect_results(
    methods: Sequence[str], truths: npt.NDArray[np.float64], answers: Sequence[Sequence[SceneAnswer]]
) -> tuple[Result, ...]:
    """Return one result for each method; `truths`: (N, 3) float64, ground truths of the scenes."""
    results: list[Result] = []
    for method_index, method in enumerate(methods):
        answered = [scene_answers[method_index] for scene_answers in answers]
        estimates = np.array([GREY if answer.light is None else answer.light for answer in answered], dtype=np.float64)
        results.append(
            Result(
                method,
                estimates,
                {"recovery": recovery_error(estimates, truths), "reproduction": reproduction_error(estimates, truths)},
                np.array([answer.light is None for answer in answered]),
                {index: answer.cause for index, answer in enumerate(answered) if answer.cause},
                {index: answer.by_pixel for index, answer in enumerate(answered) if answer.by_pixel} or None,
            )
        )
    return tuple(results)


@dataclass(frozen=True)
class Subject:
    """Data set of the results."""

    name: str
    images: tuple[str, ...]
    mixed: tuple[bool, ...]  # For each image, whether several illuminants reach it
    # For each image, the group of related images, for example from the same source picture; None if every image is its
    # own group.
    groups: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """Methods on a data set, with their results."""

    subject: Subject
    # These three as in `scene.SceneSet`
    layout: str
    location: str
    treatment: Mapping[str, str]
    data_sha256: str  # Hash of image names and ground truths; see `learning.model_files.scenes_sha256`
    truths: npt.NDArray[np.float64]  # (N, 3) float64, camera RGB of any scale
    results: tuple[Result, ...]  # One for each method
    methods: tuple[Mapping[str, Any], ...]  # A JSON object for each method; see `method_records.describe_method`
    # Other settings of the run, such as a seed, as JSON
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    # (N,) int64, fold of each image if the methods were cross-validated, else None
    folds: npt.NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()  # Sentences printed with the results
    software: str = ""  # Name and version of the software
    truth_uncertainty_deg: float | None = None
    black_bodies: Mapping[float, tuple[float, float, float]] = field(
        default_factory=dict[float, tuple[float, float, float]]
    )


def indistinct_methods(results: Sequence[Result], uncertainty_deg: float | None) -> tuple[str, ...]:
    """Return a note on methods that cannot be ranked, if there are any.

    `uncertainty_deg`: expanded uncertainty (k = 2) of ground truths, degrees; None if the data set does not report it.
    """
    if uncertainty_deg is None:
        return ()
    medians = [(result.method, result.summary("reproduction").median) for result in results]
    pairs = [
        f"{name_a} and {name_b}"
        for (name_a, median_a), (name_b, median_b) in combinations(medians, 2)
        if abs(median_a - median_b) < uncertainty_deg
    ]
    note = (
        f"medians of {first_few(pairs, 3)} differ by less than {uncertainty_deg:.2g} degrees, the uncertainty of "
        "ground truths (k = 2); this data set cannot rank these methods"
    )
    return (note,) if pairs else ()
