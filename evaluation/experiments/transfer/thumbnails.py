"""Images made small for learning: training and test images of one size, noise and fine detail averaged alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import shrink
from evaluation.scene import Image, Scene
from foundation.processors import ordered_map

_COVERED: Final = 1e-3
"""Share of a pixel's area of which more must be usable; less is rounding of areas rather than a colour."""


@dataclass(frozen=True, eq=False)
class SmallScene:
    """A scene made small, in memory.

    - `name`: the image's name.
    - `truth`: (3,) float64, linear camera RGB of the light, of any length.
    - `image`: (H, W, 3) float32, linear camera RGB, in the unit of the image that it was.
    - `mask`: (H, W) bool, True where no pixel was usable; None if every one was.
    - `saturation`: none where clipped pixels were left out; that of the image where it was small already.
    """

    name: str
    truth: npt.NDArray[np.float64]
    image: Image
    mask: npt.NDArray[np.bool_] | None
    saturation: float | None

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3) and its mask (H, W) bool."""
        return self.image, self.mask


def make_small(
    scenes: Sequence[Scene], side: int, workers: int = 1, on_scene: Callable[[], None] | None = None
) -> tuple[SmallScene, ...]:
    """Return scenes of which no side is longer than `side`, px; see `shrink_image`.

    `side`: longest side allowed, px.
    """

    def small(scene: Scene) -> SmallScene:
        image, mask = scene.read()
        if max(image.shape[:2]) <= side:
            return SmallScene(scene.name, scene.truth, image, mask, scene.saturation)
        return SmallScene(scene.name, scene.truth, *shrink_image(image, side, scene.saturation, mask), None)

    made: list[SmallScene] = []
    for scene in ordered_map(small, scenes, workers):
        made.append(scene)
        if on_scene:
            on_scene()
    return tuple(made)


def shrink_image(
    image: Image, side: int, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image made small by averaging areas, without clipped and masked pixels.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB. `side`: longest side of the result, px.
    `saturation`: value from which a channel is clipped; None if none is. `mask`: (H, W) bool, True where a pixel must
    not be used, or None. Returns the image (h, w, 3) float32, and (h, w) bool, True where no pixel was usable; the
    image is 0 there.

    Examples
    --------
    >>> image = np.zeros((2, 4, 3), np.float32)
    >>> image[:, 0], image[:, 1], image[0, 2] = 10, 30, 900
    >>> small, mask = shrink_image(image, side=2, saturation=900)
    >>> small[..., 0], mask
    (array([[20.,  0.]], dtype=float32), array([[False, False]]))
    """
    usable = np.ones(image.shape[:2], dtype=bool)
    if saturation is not None:
        usable &= (image < saturation).all(axis=2)
    if mask is not None:
        usable &= ~mask
    small, empty = shrink(image, usable, side, _COVERED)
    small[empty] = 0
    return small, empty
