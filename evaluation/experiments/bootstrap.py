"""Confidence intervals of error statistics by the bootstrap: the range expected for other images of the same kind.

Intervals are bias-corrected and accelerated (BCa), computed by `scipy.stats.bootstrap`. Errors of colour constancy have
a skewed distribution, so percentile intervals of a mean or of the worst 25 % would be too low.

Related images, such as one picture under several illuminants, are drawn together (cluster bootstrap: A. C. Davison,
D. V. Hinkley, *Bootstrap Methods and their Application* (1997), section 3.8). Drawing them separately would give
intervals that are too narrow.
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

# Errors count as equal if they differ by less than this angle, in degrees. Files have six decimals.
TIE_DEG: Final = 2e-6

# Largest number of elements (resamples × images) of an array. Arrays of 1.6 MB stay in the processor's cache.
_MAX_ELEMENTS: Final = 200_000

# Number of resamples. The ends of an interval then vary by about 2 % of its length (one standard deviation) between
# seeds.
RESAMPLES: Final = 2000

# Confidence level of all intervals, as usual in the field.
LEVEL: Final = 0.95

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

# Statistics by their names in `evaluation.metrics.Summary`.
Statistic = Literal["mean", "median", "trimean", "best25", "worst25", "avg", "worst5"]

# All statistics. The first six are in the order of the tables in the CroP paper; avg is the geometric mean of the first
# five.
STATISTICS: tuple[Statistic, ...] = ("mean", "median", "trimean", "best25", "worst25", "avg", "worst5")


# Smallest number of groups for an interval of worst 5 %. In a simulation with 80 gamma-distributed errors, the mean was
# over only 4 errors, and 68 % of the 95 % intervals contained the true value. With 320 errors, 96 % contained it.
TAIL_GROUPS: Final = 200


class BoundedFigure(NamedTuple):
    """A value with the ends of its confidence interval; NaN if unknown."""

    value: float
    low: float
    high: float


def group_ids(groups: Sequence[str]) -> Indices:
    """Return the number of each image's group, (N,) int64 from 0, in the order of first occurrence.

    Examples
    --------
    >>> group_ids(["cat", "dog", "cat"])
    array([0, 1, 0])
    """
    numbers = {group: number for number, group in enumerate(dict.fromkeys(groups))}
    return np.array([numbers[group] for group in groups], dtype=np.int64)


def bounded_figures(
    statistics: Callable[[Indices], Floats],
    images: int,
    groups: Sequence[str] | None = None,
    seed: int = 0,
    count: int = RESAMPLES,
) -> tuple[BoundedFigure, ...]:
    """Return K statistics of a sample of images with their confidence intervals.

    `statistics`: function of an array (B, N) int64 that tells how often each of N images was drawn in B resamples. It
    returns the statistics (B, K) float64 of these resamples. `groups`: group of each image; images of a group are drawn
    together. None if every image is its own group. With a single group, the ends are NaN, because the variation between
    groups is unknown.
    """
    group_indices = np.arange(images) if groups is None else group_ids(groups)
    group_count = int(group_indices.max()) + 1

    def resample_statistics(drawn: Indices, axis: int = -1) -> Floats:
        rows = drawn.reshape(-1, drawn.shape[axis])
        shifted = rows + np.arange(len(rows))[:, None] * group_count
        counts = np.bincount(shifted.ravel(), minlength=len(rows) * group_count).reshape(-1, group_count)
        # Values are rounded, so that resamples that differ only by rounding errors are equal.
        rounded = np.round(statistics(counts if groups is None else counts[:, group_indices]), 12)
        return rounded.T.reshape(-1, *drawn.shape[:-1])

    all_groups = np.arange(group_count)
    if group_count == 1:
        single_values = resample_statistics(all_groups)
        return tuple(
            BoundedFigure(float(value), np.nan, np.nan)
            for value in np.where(np.isfinite(single_values), single_values, np.nan)
        )
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        values = resample_statistics(all_groups)
        bootstrap: Any = stats.bootstrap(
            (all_groups,),
            resample_statistics,
            n_resamples=count,
            batch=max(1, _MAX_ELEMENTS // images),
            confidence_level=LEVEL,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
        # BCa gives no ends if all resamples are equal, or if some ratios are infinite. Percentiles then replace them.
        probabilities = [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
        percentile_ends = np.quantile(bootstrap.bootstrap_distribution, probabilities, axis=-1, method="inverted_cdf")
    ends = np.where(np.isnan(bootstrap.confidence_interval), percentile_ends, bootstrap.confidence_interval)
    rows = np.where(np.isfinite(values), [values, *ends], np.nan).T
    return tuple(BoundedFigure(*map(float, row)) for row in rows)


def hide_tails(figures: Sequence[BoundedFigure], groups: int) -> tuple[BoundedFigure, ...]:
    """Return the figures; with fewer than `TAIL_GROUPS` groups, the intervals of worst 5 % are NaN.

    `figures`: one for each of `STATISTICS`, in this order, or several such series in succession.
    """
    return tuple(
        figure._replace(low=np.nan, high=np.nan)
        if groups < TAIL_GROUPS and STATISTICS[index % len(STATISTICS)] == "worst5"
        else figure
        for index, figure in enumerate(figures)
    )


def _hazen_position(count: Indices, percent: float) -> tuple[Indices, Indices, Floats]:
    # A percentile by Hazen's definition lies between two sorted errors. Returns the indices of both, and the weight of
    # the upper one.
    position: Floats = np.clip(np.multiply(count, percent / 100) - 0.5, 0, np.subtract(count, 1))
    low: Indices = position.astype(np.int64)
    return low, np.minimum(low + 1, np.subtract(count, 1)), position - low


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Sorted errors (N,) float64; `order` (N,) int64 has the image index of each error."""

    order: Indices
    errors: Floats

    @classmethod
    def of(cls, errors: npt.ArrayLike) -> ErrorSample:
        """Return the errors (N,) float, sorted. Raises InputError if the list is empty or a value is not finite."""
        values = np.asarray(errors, dtype=np.float64).ravel()
        if not values.size or not np.isfinite(values).all():
            raise InputError(
                f"{values.size} errors, {int((~np.isfinite(values)).sum())} of them NaN or infinite, expected one "
                "finite error for each image; omit images without an error"
            )
        order = np.argsort(values, kind="stable")
        return cls(order, values[order])

    def estimate(self) -> Floats:
        """Return the statistics (7,) float64 of the sample itself."""
        return self.statistics(np.ones((1, len(self.order)), np.int64))[0]

    def statistics(self, counts: Indices) -> Floats:
        """Return statistics (B, 7) float64 of B resamples; `counts` (B, N): how often each image was drawn."""
        # Statistics follow `evaluation.metrics.summarise`, with its percentiles and its treatment of equal errors.
        rows, images = counts.shape
        counts = counts[:, self.order]
        cumulative_counts = np.cumsum(counts, axis=1)
        sums = np.cumsum(counts * self.errors, axis=1)
        # Each row is raised by the totals of the rows before it. The cumulative counts of all rows then form one
        # ascending list, so one search finds the errors of all rows.
        row: Indices = np.arange(rows, dtype=np.int64)
        totals: Indices = cumulative_counts[:, -1]
        offsets: Indices = np.cumsum(totals) - totals
        ascending: Indices = (cumulative_counts + offsets[:, None]).ravel()

        def quantile(percent: float) -> Floats:
            low, high, weight = _hazen_position(totals, percent)
            lower, upper = (
                self.errors[np.searchsorted(ascending, offsets + position, side="right") - row * images]
                for position in (low, high)
            )
            return lower + (upper - lower) * weight

        def mean_from(threshold: Floats) -> Floats:
            last_below = np.searchsorted(self.errors, threshold, side="left") - 1
            sum_below = np.where(last_below >= 0, sums[row, last_below], 0)
            count_below = np.where(last_below >= 0, cumulative_counts[row, last_below], 0)
            return (sums[:, -1] - sum_below) / (totals - count_below)

        q1, q2, q3, p95 = (quantile(percent) for percent in (25, 50, 75, 95))
        best_end = np.searchsorted(self.errors, q1, side="right") - 1
        best_mean = sums[row, best_end] / cumulative_counts[row, best_end]
        first_five = np.stack([sums[:, -1] / totals, q2, (q1 + 2 * q2 + q3) / 4, best_mean, mean_from(q3)], axis=-1)
        # If all errors are 0, rounding of sums may give a small negative value.
        non_negative = np.where(first_five < 0, np.nan, first_five)
        average = np.prod(non_negative**0.2, axis=-1)
        return np.concatenate([first_five, np.stack([average, mean_from(p95)], axis=-1)], axis=-1)


@dataclass(frozen=True)
class PairedFigure:
    """One statistic of two sets of errors."""

    statistic: Statistic
    # In the unit of the errors
    value_a: float
    value_b: float
    difference: BoundedFigure  # value_a - value_b
    ratio: BoundedFigure  # value_a / value_b; all NaN if `value_b` is 0


def compare_paired(
    errors_a: npt.ArrayLike,
    errors_b: npt.ArrayLike,
    seed: int = 0,
    count: int = RESAMPLES,
    groups: Sequence[str] | None = None,
) -> tuple[PairedFigure, ...]:
    """Return difference and ratio of every statistic for two methods on the same images.

    The same images are drawn for both methods, so images that are difficult for both methods do not widen the
    intervals. `errors_a`, `errors_b`: (N,) float, N ≥ 1, finite, in the same order of images. `groups`: see
    `bounded_figures`.
    """
    sample_a, sample_b = ErrorSample.of(errors_a), ErrorSample.of(errors_b)
    images = len(sample_a.order)
    if images != len(sample_b.order) or (groups is not None and images != len(groups)):
        raise InputError(
            f"{images} errors of one method, {len(sample_b.order)} of the other and {len(groups or ())} groups, "
            "expected the same images in the same order; match them by name first"
        )

    def statistics(counts: Indices) -> Floats:
        value_a, value_b = sample_a.statistics(counts), sample_b.statistics(counts)
        return np.concatenate([value_a - value_b, safe_ratio(value_a, value_b)], axis=-1)

    count_of_groups = images if groups is None else len(set(groups))
    figures = hide_tails(bounded_figures(statistics, images, groups, seed, count), count_of_groups)
    values = zip(STATISTICS, sample_a.estimate().tolist(), sample_b.estimate().tolist(), strict=True)
    return tuple(
        PairedFigure(statistic, value_a, value_b, figures[index], figures[index + len(STATISTICS)])
        for index, (statistic, value_a, value_b) in enumerate(values)
    )


def safe_ratio(numerator: Floats, denominator: Floats) -> Floats:
    """Return the ratio. Denominators up to `TIE_DEG` count as 0: the ratio is then infinite, or NaN for 0 / 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / np.where(np.abs(denominator) > TIE_DEG, denominator, 0)
