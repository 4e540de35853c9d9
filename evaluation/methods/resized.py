"""A method on a smaller image: methods of edges want the size, and the noise, of the images they were tuned on.

Published numbers of the Gray-Edge family come from images of some hundred pixels across (van de Weijer et al. had
360 x 240); at the size of a sensor each pixel's noise is the strongest edge. Shrinking averages it away. Only the mean
of usable pixels counts: a smaller pixel is masked where half or more of what it stands for must not be used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.methods.prepared import PreparedImage, estimate
from evaluation.scene import Image


@dataclass(frozen=True)
class ResizedMethod:
    """A method that sees images no larger than a given size.

    `longest`: longer side that images are shrunk to, px; smaller images are left as they are.

    Examples
    --------
    >>> from evaluation.methods.standard import standard_methods
    >>> small = ResizedMethod(standard_methods()["gray-edge-2"], longest=512)
    >>> small.name
    '2nd-order Gray-Edge at 512 px'
    """

    method: Method
    longest: int

    def __post_init__(self) -> None:
        if self.longest < 1:
            raise ValueError(f"images of {self.longest} px, expected 1 or more")

    @property
    def name(self) -> str:
        """The method's name in tables, with the size."""
        return f"{self.method.name} at {self.longest} px"

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        return estimate(self.method, prepared.at_most(self.longest))
