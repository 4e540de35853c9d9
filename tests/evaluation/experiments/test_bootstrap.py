"""Intervals hold what they promise, and are of the statistics that the tables state."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from evaluation.experiments.bootstrap import (
    STATISTICS,
    Compared,
    ErrorSample,
    independent,
    numbered,
    paired,
    resamples,
)
from evaluation.metrics import summarise
from tests.evaluation.experiments.one_sample import intervals

pytestmark = pytest.mark.slow

WORLDS = 100
"""Data sets drawn from one population: a share of .95 of them has a standard error of .02."""


def skewed(random: np.random.Generator, count: int) -> npt.NDArray[np.float64]:
    """Return errors distributed as those of colour constancy: their mean is above their median."""
    return random.gamma(1.5, 2.0, count)


def median(compared: tuple[Compared, ...]) -> Compared:
    """Return what of two sets of errors their medians say."""
    return compared[STATISTICS.index("median")]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 17, 64])
def test_statistics_of_resamples_are_those_of_the_metrics(count: int) -> None:
    # Rounded, so that many errors are equal.
    errors = np.random.default_rng(count).gamma(1.5, 2.0, count).round(1) + 0.1
    sample = ErrorSample.of(errors)
    for drawn in resamples(count, 3, 40):
        expected = [summarise(np.repeat(errors, row)).as_tuple() for row in drawn]
        np.testing.assert_allclose(sample.statistics(drawn), expected, rtol=1e-12)
    if count > 1:
        expected = [summarise(np.delete(errors, place)).as_tuple() for place in range(count)]
        np.testing.assert_allclose(sample.without_each(), expected, rtol=1e-12)


def test_every_resample_has_as_many_images_and_every_image_the_same_chance() -> None:
    drawn = np.concatenate(list(resamples(50, 0, 20_000)))
    assert drawn.shape == (20_000, 50)
    assert (drawn.sum(axis=1) == 50).all()
    # Counts of a multinomial: mean 1, variance 49/50.
    np.testing.assert_allclose(drawn.mean(axis=0), 1, atol=5 * np.sqrt(0.98 / 20_000))
    assert drawn.var() == pytest.approx(0.98, rel=0.01)


def test_interval_is_that_of_scipy() -> None:
    errors = skewed(np.random.default_rng(5), 80)
    known = stats.bootstrap((errors,), np.mean, n_resamples=20_000, method="BCa", rng=1).confidence_interval
    ours = intervals(errors, count=20_000)["mean"]
    np.testing.assert_allclose(ours, known, atol=0.02 * (known.high - known.low))


def test_intervals_cover_the_population_as_often_as_they_say() -> None:
    random = np.random.default_rng(8)
    truth = dict(zip(STATISTICS, summarise(skewed(random, 1_000_000)).as_tuple(), strict=True))
    hits = dict.fromkeys(truth, 0)
    for _ in range(WORLDS):
        for name, (low, high) in intervals(skewed(random, 80), count=400).items():
            hits[name] += low <= truth[name] <= high
    assert {name: hit for name, hit in hits.items() if not 0.88 < hit / WORLDS < 0.99} == {}


def test_lower_confidence_is_narrower_by_what_a_normal_distribution_says() -> None:
    errors = skewed(np.random.default_rng(9), 4000)
    half, usual = (np.ptp(intervals(errors, level=level)["mean"]) for level in (0.5, 0.95))
    assert half / usual == pytest.approx(stats.norm.ppf(0.75) / stats.norm.ppf(0.975), rel=0.05)


def test_paired_and_independent_differences_cover_and_pairing_narrows() -> None:
    random = np.random.default_rng(10)
    hits = np.zeros((2, 2))
    widths = np.zeros(2)
    for _ in range(WORLDS):
        hard = skewed(random, 60)
        one, other = hard * random.uniform(0.9, 1.3, 60), hard
        # The population's means are 3.3 and 3; pairs come from one draw of images, the others from two.
        both = paired(one, other, count=300)[0], independent(one, skewed(random, 90), count=300)[0]
        for place, compared in enumerate(both):
            hits[place, 0] += compared.difference[1] <= 0.3 <= compared.difference[2]
            hits[place, 1] += compared.ratio[1] <= 1.1 <= compared.ratio[2]
            widths[place] += compared.difference[2] - compared.difference[1]
    assert ((hits / WORLDS > 0.88) & (hits / WORLDS < 0.99)).all()
    assert widths[0] < 0.25 * widths[1]


def test_resampling_each_method_alone_would_not_do() -> None:
    # The world in which an interval of pairs is wrong: it is not narrower than that of strangers.
    random = np.random.default_rng(11)
    hard = skewed(random, 300)
    low, high = median(paired(hard * 1.05, hard)).ratio[1:]
    assert low == pytest.approx(1.05)
    assert high == pytest.approx(1.05)
    shuffled = median(paired(random.permutation(hard) * 1.05, hard)).ratio
    assert shuffled[2] - shuffled[1] > 0.1


def test_order_of_images_and_methods() -> None:
    random = np.random.default_rng(12)
    one, other = skewed(random, 90), skewed(random, 90)
    for there, back in zip(paired(one, other), paired(other, one), strict=True):
        difference, low, high = there.difference
        assert (difference, low, high) == pytest.approx((-back.difference[0], -back.difference[2], -back.difference[1]))
        ours, theirs = (getattr(summarise(errors), there.statistic) for errors in (one, other))
        assert difference == pytest.approx(ours - theirs)
        assert there.ratio[0] == pytest.approx(ours / theirs)


def test_ends_are_the_same_every_time_and_at_any_piece_size(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = skewed(np.random.default_rng(13), 70)
    first = intervals(errors, seed=4)
    assert intervals(errors, seed=4) == first
    assert intervals(errors, seed=5) != first
    monkeypatch.setattr("evaluation.experiments.bootstrap._AT_ONCE", 1)
    assert intervals(errors, seed=4) == first


def test_no_spread() -> None:
    assert intervals([2.5])["worst25"] == (2.5, 2.5)
    assert intervals([2.5] * 9)["avg"] == pytest.approx((2.5, 2.5))
    assert intervals([0, 0, 0])["avg"] == (0, 0)
    assert all(np.isnan(compared.ratio).all() for compared in paired([1, 2, 3], [0, 0, 0]))
    # The best quarter of the other is 0 in some resamples: no upper end then, but a lower one.
    value, low, high = median(paired(np.arange(1.0, 9), np.arange(8.0) * 0.1)).ratio
    assert np.isfinite([value, low]).all()
    assert high > value


def test_groups_are_drawn_and_left_out_whole() -> None:
    random = np.random.default_rng(14)
    names = [str(place) for place in random.permutation(np.repeat(np.arange(7), [1, 2, 3, 4, 5, 6, 7]))]
    groups = numbered(names)
    errors = skewed(random, len(names)).round(1) + 0.1
    sample = ErrorSample.of(errors)
    for drawn in resamples(len(names), 3, 40, groups):
        assert all(len(set(row[groups == number])) == 1 for row in drawn for number in range(7))
        assert all(sum(row[groups == number][0] for number in range(7)) == 7 for row in drawn)
        expected = [summarise(np.repeat(errors, row)).as_tuple() for row in drawn]
        np.testing.assert_allclose(sample.statistics(drawn), expected, rtol=1e-12)
    expected = [summarise(errors[groups != number]).as_tuple() for number in range(7)]
    np.testing.assert_allclose(sample.without_each(groups), expected, rtol=1e-12)


def test_intervals_of_groups_cover_where_those_of_images_do_not() -> None:
    random = np.random.default_rng(15)
    hits = np.zeros(2)
    kinds = [str(number // 8) for number in range(200)]
    for _ in range(WORLDS):
        # 25 pictures under 8 lights: what a picture adds to a method's error is the same under each.
        shift = np.repeat(random.normal(0.3, 1, 25), 8)
        hard = skewed(random, 200)
        for place, groups in enumerate((kinds, None)):
            _, low, high = paired(hard + shift, hard, count=200, groups=groups)[0].difference
            hits[place] += low <= 0.3 <= high
    assert 0.86 < hits[0] / WORLDS < 0.99
    assert hits[1] / WORLDS < 0.7
