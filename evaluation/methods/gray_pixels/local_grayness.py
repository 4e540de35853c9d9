"""Gray pixels under several lights: their places are clustered, each cluster gives a light, near clusters weigh more.

K.-F. Yang, S.-B. Gao, Y.-J. Li, "Efficient illuminant estimation for color constancy using grey pixels", CVPR 2015,
section 3.3, equations 15 to 17, with the grayness index of Qian et al., CVPR 2019, as in the program of the latter. A
reconstruction in this: k-means starts from evenly spread gray pixels, so that a map is always the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.gray_pixels.grayness import GraynessIndex
from evaluation.methods.pixels import GREY
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

_WIDTH = 0.2
"""σ of a cluster's weight exp(-d / 2σ²), d in parts of the image's diagonal, as in the paper."""
_ROUNDS = 50
"""Rounds of k-means, more than it takes."""


@dataclass(frozen=True)
class LocalGraynessIndex(GraynessIndex):
    """The grayness index with a map of lights; `estimate` is that of the global method with the same share.

    - `name`: its name in tables.
    - `share`: part of the pixels that are taken, 0 … 1; for several lights the authors take 10 %.
    - `lights`: number of clusters.
    """

    name: str = "Grayness Index, local"
    share: float = 0.1
    lights: int = 2

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1; see `method.LocalMethod.estimate_map`."""
        prepared = PreparedImage(image, saturation, mask)
        height, width = prepared.height, prepared.width
        chosen = self.find(prepared)
        places = np.argwhere(chosen).astype(np.float64)
        colours = prepared.image[chosen].astype(np.float64)
        if not colours.any():
            return np.tile((GREY / GREY.sum()).astype(np.float32), (height, width, 1))
        centres, member = _clusters(places, self.lights)
        sums = np.stack([colours[member == one].sum(axis=0) for one in range(len(centres))])
        kept = sums.sum(axis=1) > 0
        lights, centres = sums[kept] / sums[kept].sum(axis=1, keepdims=True), centres[kept]
        total = np.zeros((height, width, 3), dtype=np.float32)
        weights = np.zeros((height, width, 1), dtype=np.float32)
        rows, columns = np.ogrid[:height, :width]
        for centre, light in zip(centres, lights, strict=True):
            distance = np.hypot(rows - centre[0], columns - centre[1]) / np.hypot(height, width)
            weight = np.exp(-distance / (2 * _WIDTH**2)).astype(np.float32)[..., None]
            total += weight * light.astype(np.float32)
            weights += weight
        return total / weights


def _clusters(places: npt.NDArray[np.float64], count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return the centres (K, 2) of k-means of places (N, 2), and the cluster (N,) of each."""
    count = min(count, len(places))
    along = np.argsort(places @ np.array([1.0, 1.0]), kind="stable")
    centres = places[along[(np.arange(count) * 2 + 1) * len(places) // (2 * count)]]
    member = np.zeros(len(places), dtype=np.int64)
    for _ in range(_ROUNDS):
        distances = np.stack([((places - centre) ** 2).sum(axis=1) for centre in centres])
        nearest = distances.argmin(axis=0)
        centres = np.stack(
            [places[nearest == one].mean(axis=0) if (nearest == one).any() else centres[one] for one in range(count)]
        )
        if (nearest == member).all():
            break
        member = nearest
    return centres, member
