"""PCA of bright and dark pixels: the light is the main direction of an image's brightest and darkest pixels.

D. Cheng, D. K. Prasad, M. S. Brown, "Illuminant estimation for color constancy: why spatial-domain methods work and
the role of the color distribution", Journal of the Optical Society of America A 31(5), 2014, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import unit, usable


@dataclass(frozen=True)
class BrightDark:
    """Principal direction of the brightest and darkest pixels.

    Pixels are projected on the direction of their mean. The light is the first eigenvector of the uncentred
    second-moment matrix of the lowest and the highest `share` of them.

    Attributes
    ----------
    name
        Its name in tables.
    share
        Part of the pixels kept at either end, 0 … 0.5; the authors' value is 0.035.

    Examples
    --------
    >>> shades = np.linspace(10, 1000, 200)[:, None] * np.array([0.5, 1.0, 0.7])
    >>> BrightDark().estimate(shades.reshape(10, 20, 3)).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "PCA bright and dark"
    share: float = 0.035

    def estimate(
        self,
        image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
        saturation: float | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        values = image[usable(image, saturation, mask, 0)].astype(np.float64)
        if not values.any():
            return unit(np.zeros(3))
        along = values @ unit(values.mean(axis=0))
        count = max(1, int(np.ceil(len(along) * self.share)))
        if 2 * count < len(along):
            order = np.argpartition(along, (count - 1, len(along) - count))
            values = np.concatenate([values[order[:count]], values[order[-count:]]])
        return unit(np.abs(np.linalg.eigh(values.T @ values)[1][:, -1]))
