"""The distribution of a data set's lights in the plane of ln(R/G) and ln(B/G)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from generator.statistics import log_chroma

_COMPARED: Final = 1000
"""Lights of a set that the energy distance is taken of, at most: distances of all pairs are held."""

_SHUFFLES: Final = 199
"""Permutations of a test: the least p is then 1/200."""


@dataclass(frozen=True)
class LightDistribution:
    """Where lights lie in the plane of ln(R/G) and ln(B/G).

    - `count`: lights.
    - `mean`: of ln(R/G) and ln(B/G).
    - `covariance`: the two variances and the covariance between them: red, both, blue.
    - `axis_deg`: direction of the principal axis, -90 … 90 degrees from the axis of ln(R/G); daylight and incandescent
      lamps lie along a line that falls.
    - `along`, `across`: standard deviations along the principal axis and across it.
    - `hull_area`: area of the convex hull; 0 of lights on a line.
    """

    count: int
    mean: tuple[float, float]
    covariance: tuple[float, float, float]
    axis_deg: float
    along: float
    across: float
    hull_area: float


def light_distribution(lights: npt.ArrayLike) -> LightDistribution:
    """Return the distribution of lights (N, 3) float, linear camera RGB of any length, N ≥ 1.

    Examples
    --------
    >>> found = light_distribution([[1, 1, 2], [2, 1, 1], [1.5, 1, 1.4]])
    >>> round(found.axis_deg), found.along > 10 * found.across
    (-45, True)
    """
    from scipy.spatial import ConvexHull, QhullError

    points = log_chroma(lights)
    centred = points - points.mean(axis=0)
    covariance = centred.T @ centred / len(points)
    values, vectors = np.linalg.eigh(covariance)
    across, along = np.sqrt(np.maximum(values, 0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    try:
        # Of points in a plane Qhull calls the area volume.
        area = float(ConvexHull(points).volume) if len(points) > 2 else 0.0
    except QhullError:
        area = 0.0
    return LightDistribution(
        count=len(points),
        mean=(float(points[:, 0].mean()), float(points[:, 1].mean())),
        covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        axis_deg=(angle + 90) % 180 - 90,
        along=float(along),
        across=float(across),
        hull_area=area,
    )


def energy_distance(one: npt.ArrayLike, other: npt.ArrayLike, seed: int = 0) -> tuple[float, float]:
    """Return the energy distance of two sets of points as a share of its largest, and its p.

    G. J. Székely, M. L. Rizzo, "Energy statistics", J. Statistical Planning and Inference 143 (2013) 1249-1272: the
    coefficient of inhomogeneity, 0 of equal distributions and 1 of two single points.

    `one`, `other`: (N, D) and (M, D) float; of more than 1000 points a random 1000 are taken. Returns the share, 0 … 1,
    and the share of 200 random divisions of all points into two such sets that lie as far apart.

    Examples
    --------
    >>> energy_distance([[0, 0]] * 5, [[1, 1]] * 5)[0]
    1.0
    """
    from scipy.spatial.distance import cdist

    random = np.random.default_rng(seed)
    sides = [
        points if len(points) <= _COMPARED else points[random.choice(len(points), _COMPARED, replace=False)]
        for points in (np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64))
    ]
    count, total = len(sides[0]), sum(map(len, sides))
    together = np.concatenate(sides)
    distances = cdist(together, together)
    sums = distances.sum(axis=0)

    # Each row says which points are of the first set: as they are, then at random.
    member = np.zeros((_SHUFFLES + 1, total))
    member[:, :count] = 1
    member[1:] = random.permuted(member[1:], axis=1)
    apart = member @ distances
    between = 2 * (apart * (1 - member)).sum(axis=1) / (count * (total - count))
    within = (apart * member).sum(axis=1) / count**2
    within += ((sums - apart) * (1 - member)).sum(axis=1) / (total - count) ** 2
    found = between - within
    farther = int((found >= found[0] - 1e-12).sum())
    return (float(found[0] / between[0]) if between[0] > 0 else 0.0), farther / (_SHUFFLES + 1)
