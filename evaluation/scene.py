"""What an image of a data set is to everything that uses it: pixels, a mask, and the light that is to be estimated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt

# (H, W, 3), linear camera RGB ≥ 0 with black subtracted, in any unit.
Image = npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64]


class Scene(Protocol):
    """One image of a data set with its ground truth; the image is read from its file by `read`."""

    @property
    def name(self) -> str:
        """The image's name, unique in its data set."""
        ...

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB of any length: the ground truth.

        Where several lights fall on the image, the mean over its pixels, which single-light methods are held to.
        """
        ...

    @property
    def saturation(self) -> float | None:
        """Value of the image from which a pixel is clipped; None if none is."""
        ...

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3), linear camera RGB with black subtracted, and its mask.

        The mask is (H, W) bool, True where a pixel must not be used, or None if every pixel may be.
        """
        ...


@runtime_checkable
class MixedScene(Scene, Protocol):
    """A scene that several lights fall on."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64, linear camera RGB of any length, K ≥ 2."""
        ...

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        ...

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1; NaN where it is not known."""
        ...


_Made = TypeVar("_Made")


def told_of(made: Iterable[_Made], on_scene: Callable[[], None] | None) -> Iterator[_Made]:
    """Yield what is made of one scene after another; `on_scene` is called when each was taken."""
    for one in made:
        yield one
        if on_scene:
            on_scene()


@dataclass(frozen=True)
class SceneSet:
    """The images of a data set, and what was done to them before a method sees them.

    - `name`: the data set's name as its authors write it, for the heads of tables: "Cube+".
    - `layout`: the name of the layout it was read by: "cube-plus".
    - `place`: its folder, file or URL as it was given.
    - `scenes`: its images, in the data set's own order; at least one.
    - `treatment`: stated with every result: "black level", "saturation", "mask" and "ground truth", each with a
      sentence that gives the value applied and its source. "reader" stands beside them where the layout's reader was
      never tried on a published copy.
    - `folds`: the fold of each scene, counted from 0, where the data set's authors divide it; else None.
    - `truth_uncertainty_deg`: what the direction of a ground truth may be off by at worst, degrees, expanded (k = 2),
      where the data set states it; else None.
    """

    name: str
    layout: str
    place: str
    scenes: tuple[Scene, ...]
    treatment: Mapping[str, str] = field(default_factory=dict[str, str])
    folds: tuple[int, ...] | None = None
    truth_uncertainty_deg: float | None = None
