"""PCA of bright and dark pixels: the light is the main direction of an image's brightest and darkest pixels.

D. Cheng, D. K. Prasad, M. S. Brown, "Illuminant estimation for color constancy: why spatial-domain methods work and
the role of the color distribution", Journal of the Optical Society of America A 31(5), 2014, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, unit

# Pixels from which some of them say where the limits are: below, counting all takes under a millisecond.
_MANY = 1 << 16
_SPARSE = 16  # One pixel of so many is counted then
# Standard deviations, of pixels drawn independently, that the limits may lie off; beyond, all pixels are counted.
_DEVIATIONS = 4.0


@dataclass(frozen=True)
class BrightDark(PreparedMethod):
    """Principal direction of the brightest and darkest pixels.

    Pixels are projected on the direction of their mean. The light is the first eigenvector of the uncentred
    second-moment matrix of the lowest and the highest `share` of them.

    - `name`: its name in tables.
    - `share`: part of the pixels kept at either end, 0 … 0.5; the authors' value is 0.035.

    Examples
    --------
    >>> shades = np.linspace(10, 1000, 200)[:, None] * np.array([0.5, 1.0, 0.7])
    >>> BrightDark().estimate(shades.reshape(10, 20, 3)).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "PCA bright and dark"
    share: float = 0.035

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1.

        The pixels at either end are found by a histogram of the projections and by sorting its two bins at the limits,
        so nothing of the image's size is made. Of pixels with equal projections those that come first are the lower.
        """
        sums, _, peaks, counts = prepared.moments()
        if not sums.any():
            return GREY
        count = int(counts[0])
        total = _sum_of_products(prepared, unit(sums), peaks, max(1, math.ceil(count * self.share)), count)
        return unit(np.abs(np.linalg.eigh(total)[1][:, -1]))


def _sum_of_products(
    prepared: PreparedImage, direction: npt.NDArray[np.float64], peaks: npt.NDArray[np.float64], wanted: int, count: int
) -> npt.NDArray[np.float64]:
    """Return the sum of x xᵀ (3, 3) over so many of the `count` usable pixels at either end.

    Of large images some pixels say between which bins the limits are; where they prove wrong, all pixels say it.
    """
    from evaluation.methods.pixel_loops import BINS, count_projections, sum_outer_bins

    image: Any = prepared.image
    step = BINS / float(direction @ peaks)
    pixels = (image, prepared.free(), direction, step)
    if 2 * wanted >= count:  # Both ends together are the whole: every pixel counts once.
        return sum_outer_bins(*pixels, np.full(4, BINS), np.empty((0, 4)))[0]
    for every in (_SPARSE, 1) if count >= _MANY else (1,):
        counted = count_projections(*pixels, every)
        rank = wanted * int(counted.sum()) / count
        margin = 0.0 if every == 1 else _DEVIATIONS * math.sqrt(rank) + 1
        first, low = _bracket(counted, rank, margin)
        last, high = (BINS - 1 - at for at in _bracket(counted[::-1], rank, margin))
        brackets = np.array([first, low, high, last])
        room = every * int(counted[first : low + 1].sum() + counted[high : last + 1].sum())
        bordering = np.empty((room, 4))
        total, below, above, inside = sum_outer_bins(*pixels, brackets, bordering)
        if inside > room:
            bordering = np.empty((inside, 4))
            total, below, above, _ = sum_outer_bins(*pixels, brackets, bordering)
        bordering = bordering[:inside]
        bins = np.minimum(BINS - 1, (bordering[:, 3] * step).astype(np.int64))
        held = np.bincount(bins, minlength=BINS)
        low_ranks, high_ranks = below + held.cumsum(), above + held[::-1].cumsum()
        if below < wanted <= low_ranks[low] and above < wanted <= high_ranks[BINS - 1 - high]:
            low = int(np.searchsorted(low_ranks, wanted))
            high = BINS - 1 - int(np.searchsorted(high_ranks, wanted))
            ends = [bordering[(bins < low) | (bins > high)]]
            lower, upper = bordering[bins == low], bordering[bins == high]
            rest = wanted - int(low_ranks[low] - held[low])
            ends.append(lower[np.argsort(lower[:, 3], kind="stable")][:rest])
            rest = wanted - int(high_ranks[BINS - 1 - high] - held[high])
            ends.append(upper[np.argsort(upper[:, 3], kind="stable")][len(upper) - rest :])
            chosen = np.concatenate(ends)[:, :3]
            return total + chosen.T @ chosen
    raise AssertionError("all pixels were counted, and the limits lie in no bin")


def _bracket(counted: npt.NDArray[np.int64], rank: float, margin: float) -> tuple[int, int]:
    """Return the first and the last bin of a histogram (N,) that a rank from below, give or take a margin, lies in."""
    below = counted.cumsum()
    first, last = np.searchsorted(below, [max(0.0, rank - margin), rank + margin])
    return int(first), min(int(last), len(counted) - 1)
