"""Pictures for the generator from real raw images whose light is known: sRGB codes as a raw converter would make them.

The paper prints "the sRGB images of the Canon 1Ds Mark III" (section 4.3), which the camera or a program of its maker
had developed; nobody has published how. Ours, with the ground truth at hand:

1. the image is divided by its light, green kept;
2. the camera's colour matrix takes it to linear sRGB (D. Coffin, dcraw: XYZ of D65 to camera RGB in ten-thousandths,
   Adobe's numbers; the matrix from sRGB has rows of sum 1, so that white stays white);
3. it is scaled so that one in a hundred of the values of the channel that reaches highest lies above 1, dcraw's
   "99th-percentile white point", and cut to 0 … 1;
4. the curve of IEC 61966-2-1 and eight bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image, Scene, SceneSet
from foundation.errors import InputError
from foundation.srgb import srgb_codes
from generator.pictures.sources import SourcePicture

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Rows of a 3 × 3 matrix."""

CAMERAS: Final[Mapping[str, Matrix]] = {
    "Canon EOS-1Ds Mark III": ((5859, -211, -930), (-8255, 16017, 2353), (-1732, 1887, 7448)),
    "Canon EOS 550D": ((6941, -1164, -857), (-3825, 11597, 2534), (-416, 1540, 6039)),
    "Canon EOS 600D": ((6461, -907, -882), (-4300, 12184, 2378), (-819, 1944, 5931)),
}
"""From XYZ to camera RGB under D65, in ten-thousandths: the numbers in dcraw 9.28, which it has from Adobe."""

_XYZ_OF_SRGB: Final = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))
"""Linear sRGB to XYZ, IEC 61966-2-1, clause 5.2."""

WHITE_PERCENTILE: Final = 99.0
"""Percentile that becomes white; dcraw's."""

_DARKEST: Final = 1e-12
"""What replaces a white level of 0: an image that is black stays black."""


def camera_from_srgb(camera: str) -> npt.NDArray[np.float64]:
    """Return the matrix (3, 3) float64 from linear sRGB to balanced camera RGB; each row sums to 1.

    Raises
    ------
    InputError
        The camera is not one of `CAMERAS`.

    Examples
    --------
    >>> camera_from_srgb("Canon EOS 550D").round(2)
    array([[0.58, 0.34, 0.08],
           [0.09, 0.67, 0.24],
           [0.04, 0.22, 0.75]])
    """
    if camera not in CAMERAS:
        raise InputError(f"no colour matrix of {camera!r} is known; the cameras are {', '.join(CAMERAS)}")
    matrix = np.array(CAMERAS[camera]) @ np.array(_XYZ_OF_SRGB)
    return matrix / matrix.sum(axis=1, keepdims=True)


def develop(
    image: Image,
    light: npt.NDArray[np.float64],
    mask: npt.NDArray[np.bool_] | None = None,
    camera: str | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the sRGB picture of a raw image; the steps stand at the head of this file.

    Parameters
    ----------
    image
        (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black subtracted, any unit.
    light
        (3,) float64 > 0, linear camera RGB of any length: the ground truth.
    mask
        (H, W) bool, True where a pixel has no say in the white level; None if all have.
    camera
        One of `CAMERAS`; None takes balanced camera RGB for linear sRGB.

    Returns
    -------
    ndarray
        (H, W, 3) uint8, sRGB codes.

    Raises
    ------
    InputError
        The light has a channel that is not above 0, or the camera is not known.

    Examples
    --------
    A grey wedge stays grey, whatever the light and the camera; one in a hundred values is clipped:

    >>> wedge = np.linspace(0, 1, 5)[:, None, None] * np.array([400.0, 1000.0, 700.0])
    >>> develop(wedge, np.array([0.4, 1.0, 0.7]), camera="Canon EOS 550D")[:, 0]
    array([[  0,   0,   0],
           [138, 138, 138],
           [188, 188, 188],
           [226, 226, 226],
           [255, 255, 255]], dtype=uint8)
    """
    if not (np.isfinite(light).all() and light.min() > 0):
        raise InputError(f"a picture cannot be balanced for the light {light.tolist()}; expected three numbers above 0")
    linear: npt.NDArray[np.float64] = np.asarray(image, dtype=np.float64) * (light[1] / light)
    if camera is not None:
        linear = linear @ np.linalg.inv(camera_from_srgb(camera)).T
    seen = linear.reshape(-1, 3) if mask is None else linear[~mask]
    white = float(np.percentile(seen, WHITE_PERCENTILE, axis=0).max()) if len(seen) else 0.0
    return srgb_codes(linear / max(white, _DARKEST))


@dataclass(frozen=True, eq=False)
class DevelopedSource:
    """A real image as a source picture of the generator, developed with its ground truth.

    Attributes
    ----------
    scene
        The image.
    camera
        Whose colour matrix is used; None for none.
    """

    scene: Scene
    camera: str | None = None

    @property
    def name(self) -> str:
        """The image's name."""
        return self.scene.name

    def to_json(self) -> dict[str, Any]:
        """Return how the picture is made, as a JSON object."""
        return {"developed": self.scene.name, "camera": self.camera}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; masked pixels are black."""
        image, mask = self.scene.read()
        picture = develop(image, self.scene.truth, mask, self.camera)
        if mask is not None:
            picture[mask] = 0
        return SourcePicture(picture)


def developed(data: SceneSet, camera: str | None) -> tuple[DevelopedSource, ...]:
    """Return the images of a data set as source pictures.

    Raises
    ------
    InputError
        The camera is not one of `CAMERAS`.
    """
    if camera is not None:
        camera_from_srgb(camera)
    return tuple(DevelopedSource(scene, camera) for scene in data.scenes)
