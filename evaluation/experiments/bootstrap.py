"""Confidence intervals of error statistics by the bootstrap: the range that other images would give.

Intervals are bias-corrected and accelerated (BCa) and made by `scipy.stats.bootstrap`. Errors of colour constancy are
skewed, and plain percentiles of a mean or of the worst quarter are then too low.

Images that belong together, such as one picture under several lights, are drawn and left out together (the cluster
bootstrap: A. C. Davison, D. V. Hinkley, *Bootstrap Methods and their Application* (1997), section 3.8). Drawn one by
one, such images make intervals too narrow.

A resample is a count of each image. Its statistics are read from the cumulative counts along the sorted errors, so
errors are sorted once. They are those of `evaluation.metrics.summarise`, ties and percentiles included.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from foundation.errors import InputError

# Errors are equal up to twice the last of the six decimals that files hold.
TIE_DEG: Final = 2e-6

# Counts drawn at once, resamples times images: arrays of 1.6 MB stay in a processor's cache.
_AT_ONCE: Final = 200_000

# The ends of a 95 % interval then vary by some 2 % of its length (one standard deviation) between seeds.
RESAMPLES: Final = 2000

# Confidence of an interval: the usual one.
LEVEL: Final = 0.95

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]

# The numbers of `evaluation.metrics.Summary`, by their names there.
Statistic = Literal["mean", "median", "trimean", "best25", "worst25", "avg"]

# All of them, in the order of the paper's tables.
STATISTICS: tuple[Statistic, ...] = ("mean", "median", "trimean", "best25", "worst25", "avg")


class BoundedFigure(NamedTuple):
    """A number with the ends of its confidence interval; NaN if it is not known."""

    value: float
    low: float
    high: float


def numbered(groups: Sequence[str]) -> Places:
    """Return the group of each image by number, (N,) int64 from 0, in the order in which the groups first come.

    Examples
    --------
    >>> numbered(["cat", "dog", "cat"])
    array([0, 1, 0])
    """
    numbers = {group: number for number, group in enumerate(dict.fromkeys(groups))}
    return np.array([numbers[group] for group in groups], dtype=np.int64)


def bounded_figures(
    statistics: Callable[[Places], Floats],
    images: int,
    groups: Sequence[str] | None = None,
    seed: int = 0,
    count: int = RESAMPLES,
) -> tuple[BoundedFigure, ...]:
    """Return K numbers of a sample of images, each with the ends of its confidence interval.

    `statistics`: from counts (B, N) int64 of the N images in B resamples to (B, K) float64. `groups`: what each image
    shares with others; images of one group are drawn together. None: every image is its own group. The ends are NaN
    if there is one group only, which says nothing of others.
    """
    members = np.arange(images) if groups is None else numbered(groups)
    cases = int(members.max()) + 1

    def of_resamples(drawn: Places, axis: int = -1) -> Floats:
        rows = drawn.reshape(-1, drawn.shape[axis])
        shifted = rows + np.arange(len(rows))[:, None] * cases
        counts = np.bincount(shifted.ravel(), minlength=len(rows) * cases).reshape(-1, cases)
        # Rounded, since resamples that agree but for their last digit must count as equal.
        found = np.round(statistics(counts if groups is None else counts[:, members]), 12)
        return found.T.reshape(-1, *drawn.shape[:-1])

    everything = np.arange(cases)
    if cases == 1:
        alone = of_resamples(everything)
        return tuple(
            BoundedFigure(float(value), np.nan, np.nan) for value in np.where(np.isfinite(alone), alone, np.nan)
        )
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        values = of_resamples(everything)
        made: Any = stats.bootstrap(
            (everything,),
            of_resamples,
            n_resamples=count,
            batch=max(1, _AT_ONCE // images),
            confidence_level=LEVEL,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
        # BCa has no ends if all resamples agree, or if a ratio is infinite in some: percentiles have.
        shares = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
        plain = np.quantile(made.bootstrap_distribution, shares, axis=-1, method="inverted_cdf")
    ends = np.where(np.isnan(made.confidence_interval), plain, made.confidence_interval)
    rows = np.where(np.isfinite(values), [values, *ends], np.nan).T
    return tuple(BoundedFigure(*map(float, row)) for row in rows)


def _hazen(count: Places, percent: float) -> tuple[Places, Places, Floats]:
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

    order: Places
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

    def statistics(self, counts: Places) -> Floats:
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
        five = np.stack([sums[:, -1] / number, q2, (q1 + 2 * q2 + q3) / 4, best, worst], axis=-1)
        # Sums that cancel may leave a negative last digit if all errors are 0.
        above = np.where(five < 0, np.nan, five)
        return np.concatenate([five, np.prod(above**0.2, axis=-1, keepdims=True)], axis=-1)


@dataclass(frozen=True)
class Compared:
    """A statistic of one set of errors against that of another.

    - `one`, `other`: its values, in the unit of the errors.
    - `difference`: one - other.
    - `ratio`: one / other; all NaN if `other` is 0.
    """

    statistic: Statistic
    one: float
    other: float
    difference: BoundedFigure
    ratio: BoundedFigure


def paired(
    errors_a: npt.ArrayLike,
    errors_b: npt.ArrayLike,
    seed: int = 0,
    count: int = RESAMPLES,
    groups: Sequence[str] | None = None,
) -> tuple[Compared, ...]:
    """Return difference and ratio of every statistic for two methods on the same images.

    The same images are drawn for both, so what makes an image hard for both methods does not widen the intervals.
    `errors_a`, `errors_b`: (N,) float each, N ≥ 1, finite, in the same order of images. `groups`: see
    `bounded_figures`.
    """
    one, other = ErrorSample.of(errors_a), ErrorSample.of(errors_b)
    images = len(one.order)
    if images != len(other.order) or (groups is not None and images != len(groups)):
        raise InputError(
            f"{images} errors of one method, {len(other.order)} of the other and {len(groups or ())} groups; expected "
            "those of the same images in the same order: match them by name first"
        )

    def statistics(counts: Places) -> Floats:
        first, second = one.statistics(counts), other.statistics(counts)
        return np.concatenate([first - second, ratio_of(first, second)], axis=-1)

    made = bounded_figures(statistics, images, groups, seed, count)
    values = zip(STATISTICS, one.estimate().tolist(), other.estimate().tolist(), strict=True)
    return tuple(
        Compared(statistic, first, second, made[place], made[place + len(STATISTICS)])
        for place, (statistic, first, second) in enumerate(values)
    )


def ratio_of(one: Floats, other: Floats) -> Floats:
    """Return one / other; infinite, or NaN for 0 / 0, if `other` is 0 but for the rounding of angles."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return one / np.where(np.abs(other) > TIE_DEG, other, 0)
