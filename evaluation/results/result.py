"""What a method made of a data set: its estimates and their errors, and both as CSV text."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.metrics import ErrorKind, Summary, summarise
from evaluation.scene import Scene

COLUMNS = ("method", "mean", "median", "trimean", "best25", "worst25", "avg")


@dataclass(frozen=True, eq=False)
class MapErrors:
    """The errors of one method on the images under several lights, by pixel and by region; see `metrics.MapError`.

    - `images`: (M,) int64, the numbers of those images among the scenes, rising.
    - `pixel`: kind of error to (M,) float64, degrees: the mean over each image's pixels; the recovery error is LSMI's
      MAE_illum. NaN where no pixel of an image is judged.
    - `rgb`: (M,) float64, degrees, LSMI's MAE_rgb; NaN likewise.
    - `region_images`, `region_lights`: (R,) int64 each: of each region, its image among the scenes and its light's
      number in that image.
    - `region_shares`: (R,) float64, the region's part of the image's judged pixels.
    - `region`: kind of error to (R,) float64, degrees: the mean over each region's pixels.
    """

    images: npt.NDArray[np.int64]
    pixel: Mapping[ErrorKind, npt.NDArray[np.float64]]
    rgb: npt.NDArray[np.float64]
    region_images: npt.NDArray[np.int64]
    region_lights: npt.NDArray[np.int64]
    region_shares: npt.NDArray[np.float64]
    region: Mapping[ErrorKind, npt.NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Result:
    """Estimates and errors of one method on one dataset.

    - `method`: the method's name.
    - `estimates`: (N, 3) float64, camera RGB of length 1, in the order of the scenes.
    - `errors`: kind of error to (N,) float64, degrees; of an image under several lights the error against their mean.
    - `guessed`: (N,) bool, True where the method gave no light and grey stands in for it.
    - `causes`: why it gave none, or none for some pixels, by the image's number among the scenes; None where nobody
      asked.
    - `maps`: the errors on images under several lights by pixel and region; None where no image is, or none was
      measured.
    """

    method: str
    estimates: npt.NDArray[np.float64]
    errors: Mapping[ErrorKind, npt.NDArray[np.float64]]
    guessed: npt.NDArray[np.bool_]
    causes: Mapping[int, str] | None = None
    maps: MapErrors | None = None

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

    def summary(self, kind: ErrorKind) -> Summary:
        """Return the numbers that sum up one kind of error, the six of the paper's tables among them."""
        return summarise(self.errors[kind])


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
