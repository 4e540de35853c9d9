"""Mean-shifted gray pixels: of the candidates' colours, the largest cluster gives the light.

Y. Qian, S. Pertuz, J. Nikkanen, J.-K. Kämäräinen, J. Matas, "Revisiting gray pixel for statistical illumination
estimation", VISAPP 2019 (and 2020 in its longer form): candidates are the pixels whose derivatives of ln R, ln G, ln B
point most nearly to grey; they are clustered by mean shift. Constants and distances are those of the authors' program.
What differs: edges are continued and not wrapped round; saturated pixels are those that the data set calls so; at most
`MOST_CANDIDATES` of the candidates are clustered, evenly over their order in the image, since the time grows with the
square of their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.gray_pixels.indices import greyest, index_map, logarithm, slope
from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

MOST_CANDIDATES = 2000
"""Candidates that are clustered: as many as a photograph of 0.2 megapixels has."""
BANDWIDTH = 0.1
"""h of the mean shift (the authors' `bandwidth`)."""
_REACH = 0.01 * BANDWIDTH
"""Angle in radians times squared distance below which a colour belongs to a mean."""
_STILL = 1e-3 * BANDWIDTH
"""Distance times angle of a step below which a mean has arrived."""
_MERGED = BANDWIDTH / 2
"""Distance times angle below which two means are one cluster."""
_MOST_STEPS = 100
"""Steps of a mean, many times what it takes."""


def angle_to_grey(strip: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the angle of the log derivatives of a strip (H, W, 3) float32 to grey.

    Returns the angle (H, W) float32, radians; and (H, W) bool, True where no channel changes.
    """
    slopes = slope(logarithm(strip))
    missing = (slopes <= np.finfo(np.float64).eps).all(axis=2)
    lengths = np.sqrt((slopes**2).sum(axis=2))
    cosine = slopes.sum(axis=2) / np.maximum(lengths * np.float32(3**0.5), np.finfo(np.float32).tiny)
    return np.arccos(np.clip(cosine, -1, 1)), np.asarray(missing, dtype=bool)


@dataclass(frozen=True)
class MeanShiftedGrayPixel:
    """Mean colour of the largest cluster of gray pixels.

    - `name`: its name in tables.
    - `share`: part of the pixels that are candidates, 0 … 1; 0.01 is the authors' choice.
    """

    name: str = "Mean-shifted Gray Pixel"
    share: float = 0.01

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        index, usable = index_map(prepared, angle_to_grey)
        chosen = greyest(index, usable, self.share)
        if not chosen.any():
            return GREY
        colours, indices = prepared.image[chosen].astype(np.float64), index[chosen]
        if len(colours) > MOST_CANDIDATES:
            taken = np.arange(MOST_CANDIDATES) * len(colours) // MOST_CANDIDATES
            colours, indices = colours[taken], indices[taken]
        if not colours.any():
            return GREY
        return unit(colours[largest_cluster(colours / colours.max(), indices)].mean(axis=0))


def largest_cluster(colours: npt.NDArray[np.float64], order: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool, True for the colours of the largest cluster that mean shift finds.

    `colours`: (N, 3) float64, the largest number 1. `order`: (N,) float32; means start from the colours in this order
    that no mean has met yet.

    Examples
    --------
    >>> near = np.array([0.5, 0.8, 0.6]) * np.linspace(0.9, 1, 20)[:, None]
    >>> far = np.array([0.9, 0.3, 0.1]) * np.linspace(0.9, 1, 10)[:, None]
    >>> int(largest_cluster(np.concatenate([near, far]), np.arange(30, dtype=np.float32)).sum())
    20
    """
    directions = colours / np.maximum(np.linalg.norm(colours, axis=1, keepdims=True), np.finfo(float).tiny)
    met = np.zeros(len(colours), dtype=bool)
    centres: list[npt.NDArray[np.float64]] = []
    votes: list[npt.NDArray[np.int64]] = []
    for start in np.argsort(order, kind="stable"):
        if met[start]:
            continue
        mean, counted = _shift(colours, directions, int(start))
        met |= counted > 0
        met[start] = True
        merged = [_step(mean, centre) < _MERGED for centre in centres]
        if any(merged):
            # The authors weigh the two means by their members; the cluster's own members do not move.
            at = merged.index(True)
            shares = np.array([counted.sum(), votes[at].sum()], dtype=np.float64)
            centres[at] = (mean * shares[0] + centres[at] * shares[1]) / shares.sum()
            votes[at] = votes[at] + counted
        else:
            centres.append(mean)
            votes.append(counted)
    member = np.stack(votes).argmax(axis=0)
    return member == np.bincount(member).argmax()


def _shift(
    colours: npt.NDArray[np.float64], directions: npt.NDArray[np.float64], start: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return where a mean comes to rest, (3,), and how often each colour was in its reach, (N,)."""
    mean, counted = colours[start], np.zeros(len(colours), dtype=np.int64)
    for _ in range(_MOST_STEPS):
        direction = mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny)
        angles = np.arccos(np.clip(directions @ direction, -1, 1))
        inside = angles * ((colours - mean) ** 2).sum(axis=1) < _REACH
        if not inside.any():
            break
        counted += inside
        following = directions[inside].mean(axis=0)
        following /= np.linalg.norm(following)
        arrived = _step(following, direction) < _STILL
        mean = following
        if arrived:
            break
    return mean, counted


def _step(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.linalg.norm(one - other) * np.arccos(np.clip(cosine, -1, 1)))
