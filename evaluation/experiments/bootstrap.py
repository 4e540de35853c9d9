"""Confidence intervals of error statistics by the bootstrap: what other images of the same kind would have given.

Images are drawn anew, as many as there are and with replacement; the statistic of each such resample is a replicate.
Intervals are bias-corrected and accelerated (BCa): B. Efron, "Better bootstrap confidence intervals", JASA 82 (1987)
171-185. Errors of colour constancy are skewed, and plain percentiles of the replicates of a mean or of the worst
quarter then lie too low. The bias correction counts replicates equal to the estimate half, as those of a median often
are; the acceleration is that of the jackknife. Two independent samples share one acceleration: A. C. Davison,
D. V. Hinkley, *Bootstrap Methods and their Application* (1997), section 5.4.

Nothing here corrects for images that belong together, such as frames of one scene: their intervals are too narrow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from evaluation.experiments.resampling import ErrorSample, Floats, bca, resamples
from foundation.errors import InputError

Statistic = Literal["mean", "median", "trimean", "best25", "worst25", "avg"]
"""The numbers of `evaluation.metrics.Summary`, by their names there."""

STATISTICS: tuple[Statistic, ...] = ("mean", "median", "trimean", "best25", "worst25", "avg")
"""All of them, in the order of the paper's tables."""

_COUNT: Final = 2000
"""Resamples: the ends of a 95 % interval then vary by some 2 % of its length (one standard deviation) between seeds."""

_LEVEL: Final = 0.95
"""Confidence of an interval: the usual one."""

_Rule = Callable[[Floats, Floats], Floats]


def interval(
    errors: npt.ArrayLike, statistic: Statistic, seed: int = 0, count: int = _COUNT, level: float = _LEVEL
) -> tuple[float, float]:
    """Return the confidence interval of a statistic of errors.

    `errors`: (N,) float, N ≥ 1, finite: degrees, or any other number an image.

    Examples
    --------
    >>> errors = [1.2, 0.4, 3.1, 2.2, 0.9, 1.7, 5.0, 2.8]
    >>> low, high = interval(errors, "mean")
    >>> low < sum(errors) / 8 < high
    True
    """
    return intervals(errors, seed, count, level)[_known(statistic)]


def intervals(
    errors: npt.ArrayLike, seed: int = 0, count: int = _COUNT, level: float = _LEVEL
) -> dict[Statistic, tuple[float, float]]:
    """Return the interval of every statistic of errors (N,) float, from the same resamples; see `interval`."""
    sample = ErrorSample.of(errors)
    replicates = np.concatenate([sample.statistics(drawn) for drawn in resamples(len(sample.order), seed, count)])
    left_out = sample.without_each()
    estimate = sample.estimate()
    return {
        name: bca(estimate[place], replicates[:, place], [left_out[:, place]], level)
        for place, name in enumerate(STATISTICS)
    }


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


def paired_difference(
    errors_a: npt.ArrayLike,
    errors_b: npt.ArrayLike,
    statistic: Statistic,
    seed: int = 0,
    count: int = _COUNT,
    level: float = _LEVEL,
) -> tuple[float, float, float]:
    """Return the difference a - b of a statistic of two methods' errors on the same images, and its interval.

    The same images are drawn for both, so what makes an image hard for both methods does not widen the interval.

    `errors_a`, `errors_b`: (N,) float each, N ≥ 1, finite, in the same order of images.

    Examples
    --------
    >>> worse = np.arange(1.0, 41.0)
    >>> [round(number, 6) for number in paired_difference(worse, worse - 0.5, "median")]
    [0.5, 0.5, 0.5]
    """
    return _paired(errors_a, errors_b, _known(statistic), seed, count, level).difference


def paired_ratio(
    errors_a: npt.ArrayLike,
    errors_b: npt.ArrayLike,
    statistic: Statistic,
    seed: int = 0,
    count: int = _COUNT,
    level: float = _LEVEL,
) -> tuple[float, float, float]:
    """Return the ratio a / b of a statistic of two methods' errors on the same images, and its interval.

    `errors_a`, `errors_b`: (N,) float each, N ≥ 1, finite, in the same order of images. Returns ratio, lower end, upper
    end; all NaN where the statistic of b is 0.

    Examples
    --------
    >>> errors = np.arange(1.0, 41.0)
    >>> [round(number, 6) for number in paired_ratio(1.2 * errors, errors, "worst25")]
    [1.2, 1.2, 1.2]
    """
    return _paired(errors_a, errors_b, _known(statistic), seed, count, level).ratio


def paired(
    errors_a: npt.ArrayLike, errors_b: npt.ArrayLike, seed: int = 0, count: int = _COUNT, level: float = _LEVEL
) -> tuple[Compared, ...]:
    """Return difference and ratio of every statistic for two methods on the same images; see `paired_difference`.

    `errors_a`, `errors_b`: (N,) float each, N ≥ 1, finite, in the same order of images.
    """
    one, other = ErrorSample.of(errors_a), ErrorSample.of(errors_b)
    if len(one.order) != len(other.order):
        raise InputError(
            f"{len(one.order)} errors of one method and {len(other.order)} of the other; expected those of the same "
            "images in the same order: match them by name first"
        )
    drawn = [(one.statistics(some), other.statistics(some)) for some in resamples(len(one.order), seed, count)]
    replicates = [np.concatenate(side) for side in zip(*drawn, strict=True)]
    left_out = [one.without_each(), other.without_each()]

    def spread(rule: _Rule, place: int, estimate: float) -> tuple[float, float]:
        across = [rule(left_out[0][:, place], left_out[1][:, place])]
        return bca(estimate, rule(replicates[0][:, place], replicates[1][:, place]), across, level)

    return _compare(one, other, spread)


def independent(
    errors_a: npt.ArrayLike, errors_b: npt.ArrayLike, seed: int = 0, count: int = _COUNT, level: float = _LEVEL
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
    replicates = [
        np.concatenate([sample.statistics(some) for some in resamples(len(sample.order), stream, count)])
        for sample, stream in zip((one, other), seeds, strict=True)
    ]
    left_out = [one.without_each(), other.without_each()]
    whole = [one.estimate(), other.estimate()]

    def spread(rule: _Rule, place: int, estimate: float) -> tuple[float, float]:
        across = [
            rule(left_out[0][:, place], whole[1][place : place + 1]),
            rule(whole[0][place : place + 1], left_out[1][:, place]),
        ]
        return bca(estimate, rule(replicates[0][:, place], replicates[1][:, place]), across, level)

    return _compare(one, other, spread)


def _compare(
    one: ErrorSample, other: ErrorSample, spread: Callable[[_Rule, int, float], tuple[float, float]]
) -> tuple[Compared, ...]:
    compared: list[Compared] = []
    for place, name in enumerate(STATISTICS):
        a, b = float(one.estimate()[place]), float(other.estimate()[place])
        difference = (a - b, *spread(np.subtract, place, a - b))
        ratio = (a / b, *spread(_divide, place, a / b)) if b else (np.nan, np.nan, np.nan)
        compared.append(Compared(name, a, b, difference, ratio))
    return tuple(compared)


def _paired(
    errors_a: npt.ArrayLike, errors_b: npt.ArrayLike, statistic: Statistic, seed: int, count: int, level: float
) -> Compared:
    return paired(errors_a, errors_b, seed, count, level)[STATISTICS.index(statistic)]


def _divide(one: Floats, other: Floats) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return one / other


def _known(statistic: Statistic) -> Statistic:
    if statistic not in STATISTICS:
        raise InputError(f"{statistic!r} is no statistic; the statistics are {', '.join(STATISTICS)}")
    return statistic
