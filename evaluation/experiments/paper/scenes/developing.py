"""Pictures for the generator from real raw images whose light is known: sRGB codes as a raw converter would make them.

The paper prints "the sRGB images of the Canon 1Ds Mark III" (section 4.3), which the camera or a program of its maker
had developed; nobody has published how. Ours, with the ground truth at hand:

1. the image is divided by its light, green kept, and cut where the first channel clips, so that clipped skies become
   white and not pink (dcraw's ``-H 0``); thumbnails do not show what was clipped, and keep a few pink ones;
2. the camera's colour matrix takes it to linear sRGB (`generator.rendering.matrices`: white stays white);
3. it is scaled so that one in a hundred of the values of the channel that reaches highest lies above 1, dcraw's
   "99th-percentile white point", and cut to 0 … 1;
4. the curve of IEC 61966-2-1 and eight bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image, Scene, SceneSet
from foundation.colorimetry import srgb_codes
from foundation.errors import InputError
from generator.pictures.sources import SourcePicture
from generator.rendering.matrices import ColourMatrix

WHITE_PERCENTILE: Final = 99.0
"""Percentile that becomes white; dcraw's."""

_DARKEST: Final = 1e-12
"""What replaces a white level of 0: an image that is black stays black."""


def develop(
    image: Image,
    light: npt.NDArray[np.float64],
    mask: npt.NDArray[np.bool_] | None = None,
    matrix: ColourMatrix | None = None,
    saturation: float | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the sRGB picture of a raw image; the steps stand at the head of this file.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black subtracted, any unit. `light`: (3,)
    float64 > 0, linear camera RGB of any length: the ground truth. `mask`: (H, W) bool, True where a pixel has no say
    in the white level; None if all have. `matrix`: of the camera; None takes balanced camera RGB for linear sRGB.
    `saturation`: value of the image from which a channel is clipped; None if none is. Returns (H, W, 3) uint8, sRGB
    codes.

    Examples
    --------
    A grey wedge stays grey, whatever the light and the camera; one in a hundred values is clipped:

    >>> from generator.rendering.matrices import camera_matrix
    >>> wedge = np.linspace(0, 1, 5)[:, None, None] * np.array([400.0, 1000.0, 700.0])
    >>> develop(wedge, np.array([0.4, 1.0, 0.7]), matrix=camera_matrix("EOS 550D"))[:, 0]
    array([[  0,   0,   0],
           [138, 138, 138],
           [188, 188, 188],
           [226, 226, 226],
           [255, 255, 255]], dtype=uint8)
    """
    if not (np.isfinite(light).all() and light.min() > 0):
        raise InputError(f"a picture cannot be balanced for the light {light.tolist()}; expected three numbers above 0")
    linear: npt.NDArray[np.float64] = np.asarray(image, dtype=np.float64) * (light[1] / light)
    if saturation is not None:
        linear = np.minimum(linear, saturation * float((light[1] / light).min()))
    if matrix is not None:
        linear = linear @ np.linalg.inv(matrix.rows).T
    seen = linear.reshape(-1, 3) if mask is None else linear[~mask]
    white = float(np.percentile(seen, WHITE_PERCENTILE, axis=0).max()) if len(seen) else 0.0
    return srgb_codes(linear / max(white, _DARKEST))


@dataclass(frozen=True, eq=False)
class DevelopedSource:
    """A real image as a source picture of the generator, developed with its ground truth.

    `matrix`: of its camera; None for none.
    """

    scene: Scene
    matrix: ColourMatrix | None = None

    @property
    def name(self) -> str:
        """The image's name."""
        return self.scene.name

    def to_json(self) -> dict[str, Any]:
        """Return how the picture is made, as a JSON object."""
        return {"developed": self.scene.name, "matrix": self.matrix and self.matrix.name}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; masked pixels are black."""
        image, mask = self.scene.read()
        picture = develop(image, self.scene.truth, mask, self.matrix, self.scene.saturation)
        if mask is not None:
            picture[mask] = 0
        return SourcePicture(picture)


def developed(data: SceneSet, matrix: ColourMatrix | None) -> tuple[DevelopedSource, ...]:
    """Return the images of a data set as source pictures, developed with the colour matrix of its camera or none."""
    return tuple(DevelopedSource(scene, matrix) for scene in data.scenes)
