"""Confidence intervals of error statistics by the bootstrap: what other images of the same kind would have given.

Images are drawn anew, as many as there are and with replacement; the statistic of each such resample is a replicate.
Intervals are bias-corrected and accelerated (BCa): B. Efron, "Better bootstrap confidence intervals", JASA 82 (1987)
171-185. Errors of colour constancy are skewed, and plain percentiles of the replicates of a mean or of the worst
quarter then lie too low. The bias correction counts replicates equal to the estimate half, as those of a median often
are; the acceleration is that of the jackknife. Two independent samples share one acceleration: A. C. Davison,
D. V. Hinkley, *Bootstrap Methods and their Application* (1997), section 5.4.

Images that belong together, such as one picture under several lights, are drawn together where their groups are given
(the cluster bootstrap: Davison and Hinkley, section 3.8), and left out together by the jackknife: what they share would
else count as often as it was seen, and intervals be too narrow. Few groups are still few: of 15 the intervals of means
are somewhat too narrow, as those of 15 images are.

A resample is a count of each image. What it comes to is read off the cumulative counts along the sorted errors, so
nothing is sorted again, and statistics are those of `evaluation.metrics.summarise`, ties and percentiles included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

_AT_ONCE: Final = 200_000
"""Counts drawn at once, resamples times images: arrays of 1.6 MB stay in a processor's cache."""

_NORMAL: Final = NormalDist()

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]


def numbered(groups: Sequence[str]) -> Places:
    """Return the group of each image by number, (N,) int64 from 0, in the order in which the groups first come.

    Examples
    --------
    >>> numbered(["cat", "dog", "cat"])
    array([0, 1, 0])
    """
    numbers = {group: number for number, group in enumerate(dict.fromkeys(groups))}
    return np.array([numbers[group] for group in groups], dtype=np.int64)


def resamples(
    images: int, seed: int | np.random.SeedSequence, count: int, groups: Places | None = None
) -> Iterator[npt.NDArray[np.int64]]:
    """Give the counts (B, N) int64 of images in resamples, some resamples at a time; each row has sum N.

    `groups`: (N,) int64, the group of each image from 0; then groups are drawn, as many as there are, each with all its
    images, and rows have the sum N only where groups are of one size. None: each image is one of its own.
    """
    if count < 1:
        raise InputError(f"{count} resamples; give a count of 1 or more")
    if groups is not None:
        for drawn in resamples(int(groups.max()) + 1, seed, count):
            for start in range(0, len(drawn), some := max(1, _AT_ONCE // images)):
                yield drawn[start : start + some][:, groups]
        return
    random = np.random.default_rng(seed)
    some = max(1, _AT_ONCE // images)
    for start in range(0, count, some):
        rows = min(some, count - start)
        drawn = random.integers(0, images, (rows, images), dtype=np.int32) + np.arange(rows)[:, None] * images
        yield np.bincount(drawn.ravel(), minlength=rows * images).reshape(rows, images)


def _hazen(count: int | Places, percent: float) -> tuple[Places, Places, Floats]:
    """Return the places of the two order statistics that a percentile lies between, and the weight of the second."""
    place: Floats = np.clip(np.multiply(count, percent / 100) - 0.5, 0, np.subtract(count, 1))
    low: Places = place.astype(np.int64)
    return low, np.minimum(low + 1, np.subtract(count, 1)), place - low


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Errors, sorted once.

    - `order`: (N,) int64: the image at each place of the sorted errors.
    - `errors`: (N,) float64, sorted.
    """

    order: npt.NDArray[np.int64]
    errors: Floats

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> ErrorSample:
        """Return errors (N,) float sorted; an InputError if there is none, or one is NaN or infinite."""
        values = np.asarray(errors, dtype=np.float64).ravel()
        if not values.size or not np.isfinite(values).all():
            raise InputError(
                f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them not finite; expected one finite "
                "error an image: leave out images without one"
            )
        order = np.argsort(values, kind="stable")
        return cls(order, values[order])

    def estimate(self) -> Floats:
        """Return the statistics (6,) float64 of the errors themselves."""
        return self.statistics(np.ones((1, len(self.order)), np.int64))[0]

    def statistics(self, counts: npt.NDArray[np.int64]) -> Floats:
        """Return the statistics (B, 6) float64 of resamples given as counts (B, N) of the images, not sorted."""
        rows, images = counts.shape
        counts = counts[:, self.order]
        reached = np.cumsum(counts, axis=1)
        sums = np.cumsum(counts * self.errors, axis=1)
        # Row after row with its total added, the cumulative counts are one ascending list, to be searched at once.
        row: Places = np.arange(rows, dtype=np.int64)
        number: Places = reached[:, -1]
        before: Places = np.cumsum(number) - number
        ascending: Places = (reached + before[:, None]).ravel()

        def quantile(percent: float) -> Floats:
            low, high, weight = _hazen(number, percent)
            first, second = (
                self.errors[np.searchsorted(ascending, before + place, side="right") - row * images]
                for place in (low, high)
            )
            return first + (second - first) * weight

        q1, q2, q3 = (quantile(percent) for percent in (25, 50, 75))
        upto = np.searchsorted(self.errors, q1, side="right") - 1
        below = np.searchsorted(self.errors, q3, side="left") - 1
        best = sums[row, upto] / reached[row, upto]
        under_sum = np.where(below >= 0, sums[row, below], 0)
        under_count = np.where(below >= 0, reached[row, below], 0)
        worst = (sums[:, -1] - under_sum) / (number - under_count)
        return _with_avg(sums[:, -1] / number, q2, (q1 + 2 * q2 + q3) / 4, best, worst)

    def without_each(self, groups: Places | None = None) -> Floats:
        """Return the statistics (N, 6) float64 of the errors without one image, in the images' own order.

        `groups`: (N,) int64, as in `resamples`; the statistics (G, 6) are then those without one group.
        """
        number = len(self.order)
        if groups is not None:
            kinds, some = int(groups.max()) + 1, max(1, _AT_ONCE // number)
            left = [
                self.statistics((groups != np.arange(start, min(start + some, kinds))[:, None]).astype(np.int64))
                for start in range(0, kinds, some)
            ]
            return np.concatenate(left)
        if number == 1:
            return self.estimate()[None]
        errors, place, rest = self.errors, np.arange(number), number - 1
        sums = np.concatenate([[0.0], np.cumsum(errors)])

        def quantile(percent: float) -> Floats:
            low, high, weight = _hazen(rest, percent)
            first, second = (errors[k + (place <= k)] for k in (low, high))
            return first + (second - first) * weight

        q1, q2, q3 = (quantile(percent) for percent in (25, 50, 75))
        upto = np.searchsorted(errors, q1, side="right")
        own = errors <= q1
        best = (sums[upto] - errors * own) / (upto - own)
        above = np.searchsorted(errors, q3, side="left")
        own = errors >= q3
        worst = (sums[-1] - sums[above] - errors * own) / (number - above - own)
        sorted_ones = _with_avg((sums[-1] - errors) / rest, q2, (q1 + 2 * q2 + q3) / 4, best, worst)
        given = np.empty_like(sorted_ones)
        given[self.order] = sorted_ones
        return given


def _with_avg(*parts: Floats) -> Floats:
    """Return the five statistics and their geometric mean (…, 6); numbers below 0 have none (NaN)."""
    five = np.stack(parts, axis=-1)
    # Sums that cancel may leave a negative last digit where all errors are 0.
    above = np.where(five < 0, np.nan, five)
    return np.concatenate([five, np.prod(above**0.2, axis=-1, keepdims=True)], axis=-1)


def bca(estimate: float, replicates: Floats, left_out: list[Floats], level: float) -> tuple[float, float]:
    """Return the ends of the BCa interval (Efron 1987, equations 2.3 and 6.6).

    `replicates`: (B,) float64, that of the resamples; infinite ones, where a ratio's divisor is 0, count as large.
    `left_out`: for each independent sample (N,) float64, the statistic without one of its images, or groups of them.
    """
    if not 0 < level < 1:
        raise InputError(f"a confidence of {level:g}; expected one between 0 and 1, such as .95")
    if np.isnan(estimate) or np.isnan(replicates).any():
        return np.nan, np.nan
    count = len(replicates)
    # A rounded difference must not count as one where resamples are the images themselves.
    near = np.isclose(replicates, estimate, rtol=1e-12, atol=0)
    below = float(((replicates < estimate) & ~near).sum() + near.sum() / 2)
    bias = _NORMAL.inv_cdf(min(max(below, 0.5), count - 0.5) / count)
    cubes = squares = 0.0
    for values in left_out:
        # The influence of each image, or group of them, on the statistic, over their number.
        influence = (values.mean() - values) * (len(values) - 1) / len(values)
        cubes += float((influence**3).sum())
        squares += float((influence**2).sum())
    acceleration = cubes / (6 * squares**1.5) if squares > 0 else 0.0
    ends = [bias + _NORMAL.inv_cdf(share) for share in ((1 - level) / 2, (1 + level) / 2)]
    ranks = np.array([_NORMAL.cdf(bias + end / (1 - acceleration * end)) for end in ends])
    ordered = np.sort(replicates)
    # The (B + 1) α-th replicate, as Davison and Hinkley have it; between two of them, straight.
    places: Floats = np.clip((count + 1) * ranks - 1, 0, count - 1)
    low = np.floor(places).astype(np.int64)
    high = np.minimum(low + 1, count - 1)
    weight = places - low
    with np.errstate(invalid="ignore"):
        between = np.where(weight > 0, ordered[low] * (1 - weight) + ordered[high] * weight, ordered[low])
    return float(between[0]), float(between[1])


Statistic = Literal["mean", "median", "trimean", "best25", "worst25", "avg"]
"""The numbers of `evaluation.metrics.Summary`, by their names there."""

STATISTICS: tuple[Statistic, ...] = ("mean", "median", "trimean", "best25", "worst25", "avg")
"""All of them, in the order of the paper's tables."""

_COUNT: Final = 2000
"""Resamples: the ends of a 95 % interval then vary by some 2 % of its length (one standard deviation) between seeds."""

_LEVEL: Final = 0.95
"""Confidence of an interval: the usual one."""


@dataclass(frozen=True)
class Compared:
    """A statistic of one set of errors against that of another.

    - `one`, `other`: its values, in the unit of the errors.
    - `difference`: one - other, with the ends of its confidence interval.
    - `ratio`: one / other, with the ends of its confidence interval; all NaN where `other` is 0.
    """

    statistic: Statistic
    one: float
    other: float
    difference: tuple[float, float, float]
    ratio: tuple[float, float, float]


def paired(
    errors_a: npt.ArrayLike,
    errors_b: npt.ArrayLike,
    seed: int = 0,
    count: int = _COUNT,
    level: float = _LEVEL,
    groups: Sequence[str] | None = None,
) -> tuple[Compared, ...]:
    """Return difference and ratio of every statistic for two methods on the same images.

    The same images are drawn for both, so what makes an image hard for both methods does not widen the intervals.
    `errors_a`, `errors_b`: (N,) float each, N ≥ 1, finite, in the same order of images. `groups`: what each image
    shares with others, such as its picture: those of one group are drawn together; None if every image is one of its
    own. Of a single group there are no intervals: their ends are NaN.
    """
    one, other = ErrorSample.of(errors_a), ErrorSample.of(errors_b)
    if len(one.order) != len(other.order):
        raise InputError(
            f"{len(one.order)} errors of one method and {len(other.order)} of the other; expected those of the same "
            "images in the same order: match them by name first"
        )
    numbers = None if groups is None else numbered(groups)
    if numbers is not None and len(numbers) != len(one.order):
        raise InputError(f"{len(numbers)} groups of {len(one.order)} errors; expected one an image")
    if numbers is not None and not numbers.any():
        # What one picture comes to says nothing of others: no number of its images makes an interval.
        lost: Floats = np.full((1, len(STATISTICS)), np.nan)
        return _compare(one, other, (lost, lost), [], level)
    drawn = [(one.statistics(some), other.statistics(some)) for some in resamples(len(one.order), seed, count, numbers)]
    first, second = (np.concatenate(side) for side in zip(*drawn, strict=True))
    return _compare(one, other, (first, second), [(one.without_each(numbers), other.without_each(numbers))], level)


def independent(
    errors_a: npt.ArrayLike, errors_b: npt.ArrayLike, seed: int = 0, count: int = _COUNT
) -> tuple[Compared, ...]:
    """Return difference and ratio of every statistic for two sets of images that have nothing to do with each other.

    `errors_a`, `errors_b`: (N,) and (M,) float, N and M ≥ 1, finite: errors, or any other number an image; each is
    resampled by itself.

    Examples
    --------
    >>> some, others = np.linspace(1, 3, 200), np.linspace(2, 6, 100)
    >>> mean = independent(some, others)[0]
    >>> f"{mean.statistic} {mean.ratio[0]:.3f}", mean.ratio[1] < 0.5 < mean.ratio[2]
    ('mean 0.500', True)
    """
    one, other = ErrorSample.of(errors_a), ErrorSample.of(errors_b)
    # Two streams of one seed: independent, unlike two generators of equal or neighbouring states.
    seeds = np.random.SeedSequence(seed).spawn(2)
    first, second = (
        np.concatenate([sample.statistics(some) for some in resamples(len(sample.order), stream, count)])
        for sample, stream in zip((one, other), seeds, strict=True)
    )
    left_out = [(one.without_each(), other.estimate()[None]), (one.estimate()[None], other.without_each())]
    return _compare(one, other, (first, second), left_out, _LEVEL)


def _compare(
    one: ErrorSample,
    other: ErrorSample,
    replicates: tuple[Floats, Floats],
    left_out: Sequence[tuple[Floats, Floats]],
    level: float,
) -> tuple[Compared, ...]:
    """Return difference and ratio of every statistic.

    `replicates`: (B, 6) float64 of either. `left_out`: for each independent sample the statistics of both without one
    of its images, or groups of them, (N, 6) float64, or (1, 6) of the one that has them all.
    """

    def told(rule: Callable[[Floats, Floats], Floats], place: int) -> tuple[float, float, float]:
        a, b = one.estimate()[place], other.estimate()[place]
        estimate = float(rule(a, b))
        drawn = rule(replicates[0][:, place], replicates[1][:, place])
        across = [rule(first[:, place], second[:, place]) for first, second in left_out]
        return (estimate, *bca(estimate, drawn, across, level))

    compared: list[Compared] = []
    for place, name in enumerate(STATISTICS):
        a, b = float(one.estimate()[place]), float(other.estimate()[place])
        ratio = told(_divide, place) if b else (np.nan, np.nan, np.nan)
        compared.append(Compared(name, a, b, told(np.subtract, place), ratio))
    return tuple(compared)


def _divide(one: Floats, other: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return one / other
