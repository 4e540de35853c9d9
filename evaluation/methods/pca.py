"""PCA of bright and dark pixels: the estimate is the principal direction of the brightest and darkest pixels.

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

# Pixels are used if their projection is below a lower or above an upper limit. If an image has this number of
# usable pixels or more, the limits are first estimated from a sample.
_SPARSE_COUNT = 1 << 16
_SPARSE_INTERVAL = 16  # one of this number of pixels is sampled
# A limit is searched within this number of standard deviations around its estimated rank. If it is not there, all
# pixels are counted.
_MARGIN_SIGMAS = 4.0


@dataclass(frozen=True)
class BrightDark(PreparedMethod):
    """Principal direction of the brightest and darkest pixels.

    Pixels are projected on the direction of their mean. The pixels with the smallest and largest projections are
    selected. The estimate is the first eigenvector of their second-moment matrix, without subtraction of the mean.

    - `name`: name in tables.
    - `share`: fraction of all pixels that is used at each end, 0 … 0.5; the authors use 0.035.

    Examples
    --------
    >>> shades = np.linspace(10, 1000, 200)[:, None] * np.array([0.5, 1.0, 0.7])
    >>> BrightDark().estimate(shades.reshape(10, 20, 3)).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "PCA bright and dark"
    share: float = 0.035

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        sums, _, peaks, counts = prepared.moments()
        if not sums.any():
            return GREY
        count = int(counts[0])
        total = _sum_of_products(prepared, unit(sums), peaks, max(1, math.ceil(count * self.share)), count)
        return unit(np.abs(np.linalg.eigh(total)[1][:, -1]))


def _sum_of_products(
    prepared: PreparedImage, direction: npt.NDArray[np.float64], peaks: npt.NDArray[np.float64], tail: int, count: int
) -> npt.NDArray[np.float64]:
    """Return the sum of x xᵀ (3, 3) over the `tail` darkest and the `tail` brightest of the `count` usable pixels."""
    # A histogram of projections shows which bins contain the two limits, and only the pixels of these bins are sorted.
    # So no array of the size of the image is needed. Pixels with equal projections keep their order in the image.
    from evaluation.methods.pixel_loops import BINS, count_projections, sum_outer_bins

    image: Any = prepared.image
    step = BINS / float(direction @ peaks)
    pixels = (image, prepared.usable_or_empty(), direction, step)
    if 2 * tail >= count:  # The ends overlap: every pixel is used once.
        return sum_outer_bins(*pixels, np.full(4, BINS), np.empty((0, 4)))[0]
    # In large images, the limits are estimated from a sample. If this fails, all pixels are counted.
    for interval in (_SPARSE_INTERVAL, 1) if count >= _SPARSE_COUNT else (1,):
        histogram = count_projections(*pixels, interval)
        rank = tail * int(histogram.sum()) / count
        margin = 0.0 if interval == 1 else _MARGIN_SIGMAS * math.sqrt(rank) + 1
        first, low = _bracket(histogram, rank, margin)
        last, high = (BINS - 1 - bin_index for bin_index in _bracket(histogram[::-1], rank, margin))
        brackets = np.array([first, low, high, last])
        capacity = interval * int(histogram[first : low + 1].sum() + histogram[high : last + 1].sum())
        collected = np.empty((capacity, 4))
        total, below_count, above_count, inside_count = sum_outer_bins(*pixels, brackets, collected)
        if inside_count > capacity:
            collected = np.empty((inside_count, 4))
            total, below_count, above_count, _ = sum_outer_bins(*pixels, brackets, collected)
        collected = collected[:inside_count]
        bins = np.minimum(BINS - 1, (collected[:, 3] * step).astype(np.int64))
        bin_counts = np.bincount(bins, minlength=BINS)
        low_ranks, high_ranks = below_count + bin_counts.cumsum(), above_count + bin_counts[::-1].cumsum()
        if below_count < tail <= low_ranks[low] and above_count < tail <= high_ranks[BINS - 1 - high]:
            low = int(np.searchsorted(low_ranks, tail))
            high = BINS - 1 - int(np.searchsorted(high_ranks, tail))
            ends = [collected[(bins < low) | (bins > high)]]
            lower, upper = collected[bins == low], collected[bins == high]
            needed_count = tail - int(low_ranks[low] - bin_counts[low])
            ends.append(lower[np.argsort(lower[:, 3], kind="stable")][:needed_count])
            needed_count = tail - int(high_ranks[BINS - 1 - high] - bin_counts[high])
            ends.append(upper[np.argsort(upper[:, 3], kind="stable")][len(upper) - needed_count :])
            selected = np.concatenate(ends)[:, :3]
            return total + selected.T @ selected
    raise AssertionError("all pixels were counted, but no bin contains the limits")


def _bracket(histogram: npt.NDArray[np.int64], rank: float, margin: float) -> tuple[int, int]:
    # First and last bin that may contain the pixel with this rank ± margin, counted from the first bin.
    cumulated = histogram.cumsum()
    first, last = np.searchsorted(cumulated, [max(0.0, rank - margin), rank + margin])
    return int(first), min(int(last), len(histogram) - 1)
