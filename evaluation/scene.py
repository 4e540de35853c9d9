"""Images of data sets as all commands and methods use them: pixels, mask and ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt

from foundation.errors import counted

# (H, W, 3), linear camera RGB ≥ 0, black level subtracted, in any unit.
Image = npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64]


class Scene(Protocol):
    """One image of a data set with its ground truth; `read` decodes the image file."""

    @property
    def name(self) -> str:
        """Name of the image, unique in its data set."""
        ...

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth: the illuminant (3,) float64, linear camera RGB of any scale.

        If the scene has several illuminants, the ground truth is their mean over the pixels. Estimates of a single
        illuminant are compared with this mean.
        """
        ...

    @property
    def saturation(self) -> float | None:
        """Value from which a pixel is clipped; None if no pixel is clipped."""
        ...

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Read the image file; each call returns a new image, which the caller may change.

        Returns
        -------
        image
            (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black level subtracted.
        mask
            (H, W) bool, True for pixels that must not be used; None if all pixels may be used.
        """
        ...


@runtime_checkable
class MixedScene(Scene, Protocol):
    """A scene under several illuminants."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The illuminants (K, 3) float64, linear camera RGB of any scale, K ≥ 2."""
        ...

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the fraction of each illuminant in each pixel: (H, W, K) float32, 0 … 1, sum 1; NaN if unknown."""
        ...

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the illuminant of each pixel: (H, W, 3) float32, r + g + b = 1; NaN if unknown."""
        ...


_Item = TypeVar("_Item")


def report_progress(items: Iterable[_Item], on_scene: Callable[[], None] | None) -> Iterator[_Item]:
    """Yield the items; `on_scene` is called after the consumer has used each item."""
    for item in items:
        yield item
        if on_scene:
            on_scene()


@dataclass(frozen=True)
class SceneSet:
    """Images of a data set and their treatment before a method receives them.

    Parameters
    ----------
    name
        Name of the data set in the spelling of its authors, for headings: "Cube+".
    layout
        Name of the layout of its files: "cube-plus".
    location
        Folder, file or URL as given.
    scenes
        Images in the order of the data set; at least one.
    treatment
        How the images are treated, printed with every result: "black level", "saturation", "mask" and "ground truth",
        each with the applied value and its source. "reader" is given if the reader was never tested on a published
        copy.
    folds
        Fold of each scene, from 0, as the authors of the data set define it; None if they define no folds.
    truth_uncertainty_deg
        Largest uncertainty (k = 2) of a ground truth, degrees; None if the data set does not report it.
    black_bodies
        Camera RGB of the black bodies among the illuminants, by their temperature in K; empty if unknown.
    """

    name: str
    layout: str
    location: str
    scenes: tuple[Scene, ...]
    treatment: Mapping[str, str] = field(default_factory=dict[str, str])
    folds: tuple[int, ...] | None = None
    truth_uncertainty_deg: float | None = None
    black_bodies: Mapping[float, tuple[float, float, float]] = field(
        default_factory=dict[float, tuple[float, float, float]]
    )

    def __repr__(self) -> str:
        """Return one line, because the list of images may be very long."""
        return f"SceneSet({self.name!r}, {counted(len(self.scenes), 'image')}, layout {self.layout})"
