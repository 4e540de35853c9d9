"""Bootstrap intervals: coverage, agreement with scipy, and the same statistics as in the tables."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from evaluation.experiments.bootstrap import (
    STATISTICS,
    ErrorSample,
    PairedFigure,
    Statistic,
    bounded_figures,
    compare_paired,
    group_ids,
)
from evaluation.metrics import summarise
from foundation.errors import InputError

pytestmark = pytest.mark.slow

WORLDS = 100
"""Data sets drawn from one population: a share of .95 of them has a standard error of .02."""


def intervals(errors: npt.ArrayLike, seed: int = 0, count: int = 2000) -> dict[Statistic, tuple[float, float]]:
    """Return the confidence interval of every statistic of errors (N,)."""
    sample = ErrorSample.of(errors)
    figures = bounded_figures(sample.statistics, len(sample.order), seed=seed, count=count)
    return {name: (figure.low, figure.high) for name, figure in zip(STATISTICS, figures, strict=True)}


def skewed(random: np.random.Generator, count: int) -> npt.NDArray[np.float64]:
    """Return errors with the distribution of colour constancy errors: the mean exceeds the median."""
    return random.gamma(1.5, 2.0, count)


def median(compared: tuple[PairedFigure, ...]) -> PairedFigure:
    return compared[STATISTICS.index("median")]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 17, 64])
def test_resample_statistics_match_metrics(count: int) -> None:
    random = np.random.default_rng(count)
    # Rounded, so that many errors are equal.
    errors = random.gamma(1.5, 2.0, count).round(1) + 0.1
    drawn = random.multinomial(count, np.full(count, 1 / count), 40)
    left_out = 1 - np.eye(count, dtype=np.int64)
    counts = np.concatenate([drawn, left_out]) if count > 1 else drawn
    expected = [summarise(np.repeat(errors, row)).as_tuple() for row in counts]
    np.testing.assert_allclose(ErrorSample.of(errors).statistics(counts), expected, rtol=1e-12)


def test_interval_matches_scipy() -> None:
    random = np.random.default_rng(5)
    errors_a, errors_b = skewed(random, 80), skewed(random, 80)
    expected = stats.bootstrap((errors_a,), np.mean, n_resamples=20_000, method="BCa", rng=1).confidence_interval
    ours = intervals(errors_a, count=20_000)["mean"]
    np.testing.assert_allclose(ours, expected, atol=0.02 * (expected.high - expected.low))

    def ratio(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> float:
        return float(np.median(first) / np.median(second))

    expected = stats.bootstrap((errors_a, errors_b), ratio, n_resamples=9_000, paired=True, vectorized=False, rng=1)
    figure = median(compare_paired(errors_a, errors_b, count=9_000)).ratio
    width = np.ptp(expected.confidence_interval)
    np.testing.assert_allclose(figure[1:], expected.confidence_interval, atol=0.04 * width)


def test_intervals_have_nominal_coverage() -> None:
    random = np.random.default_rng(8)
    truth = dict(zip(STATISTICS, summarise(skewed(random, 1_000_000)).as_tuple(), strict=True))
    hits = dict.fromkeys(truth, 0)
    for _ in range(WORLDS):
        for name, (low, high) in intervals(skewed(random, 80), count=1000).items():
            hits[name] += low <= truth[name] <= high
    # Worst 5 % of 80 images has no interval in tables (`TAIL_GROUPS`): too few contain the true value.
    assert hits.pop("worst5") / WORLDS < 0.8
    assert {name: hit for name, hit in hits.items() if not 0.88 < hit / WORLDS < 0.99} == {}


def test_pairing_narrows_intervals_and_keeps_coverage() -> None:
    random = np.random.default_rng(10)
    hits = np.zeros(2)
    widths = np.zeros(2)
    for _ in range(WORLDS):
        hard = skewed(random, 60)
        errors_a = hard * random.uniform(0.9, 1.3, 60)
        # The population's means are 3.3 and 3.
        compared = compare_paired(errors_a, hard, count=300)[0]
        hits += [
            compared.difference.low <= 0.3 <= compared.difference.high,
            compared.ratio.low <= 1.1 <= compared.ratio.high,
        ]
        apart = compare_paired(random.permutation(errors_a), hard, count=300)[0]
        widths += [np.ptp(compared.difference[1:]), np.ptp(apart.difference[1:])]
    assert ((hits / WORLDS > 0.88) & (hits / WORLDS < 0.99)).all()
    assert widths[0] < 0.25 * widths[1]


def test_order_of_images_and_methods_does_not_matter() -> None:
    random = np.random.default_rng(12)
    errors_a, errors_b = skewed(random, 90), skewed(random, 90)
    for reversed_pair, back in zip(compare_paired(errors_a, errors_b), compare_paired(errors_b, errors_a), strict=True):
        difference, low, high = reversed_pair.difference
        turned = -back.difference[0], -back.difference[2], -back.difference[1]
        assert (difference, low, high) == pytest.approx(turned, abs=0.02, nan_ok=True)
        ours, theirs = (getattr(summarise(errors), reversed_pair.statistic) for errors in (errors_a, errors_b))
        assert (reversed_pair.value_a, reversed_pair.value_b) == pytest.approx((ours, theirs))
        assert difference == pytest.approx(ours - theirs)
        assert reversed_pair.ratio[0] == pytest.approx(ours / theirs)


def test_interval_is_reproducible_for_any_batch_size(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = skewed(np.random.default_rng(13), 70)
    first = intervals(errors, seed=4)
    assert intervals(errors, seed=4) == first
    assert intervals(errors, seed=5) != first
    monkeypatch.setattr("evaluation.experiments.bootstrap._MAX_ELEMENTS", 1)
    for name, ends in intervals(errors, seed=4).items():
        assert ends == pytest.approx(first[name], rel=1e-12)


def test_equal_errors_give_interval_without_width() -> None:
    assert np.isnan(intervals([2.5])["worst25"]).all()
    assert intervals([2.5] * 9)["avg"] == pytest.approx((2.5, 2.5))
    assert intervals([0, 0, 0])["avg"] == (0, 0)
    assert all(np.isnan(compared.ratio).all() for compared in compare_paired([1, 2, 3], [0, 0, 0]))
    # The best quarter of the other is 0 in some resamples: no upper end then, but a lower one.
    value, low, high = median(compare_paired(np.arange(1.0, 9), np.arange(8.0) * 0.1)).ratio
    assert np.isfinite([value, low]).all()
    assert high > value


@pytest.mark.parametrize(
    ("errors_a", "errors_b", "groups"),
    [
        ([], [], None),
        ([1, np.nan], [1, 2], None),
        ([1, 2], [np.inf, 2], None),
        ([1, 2], [1], None),
        ([1, 2], [1, 2], ["a"]),
    ],
)
def test_refuses_unpaired_errors(errors_a: list[float], errors_b: list[float], groups: list[str] | None) -> None:
    with pytest.raises(InputError):
        compare_paired(errors_a, errors_b, groups=groups)


def test_draws_whole_groups() -> None:
    names = [str(index) for index in np.random.default_rng(14).permutation(np.repeat(np.arange(7), np.arange(1, 8)))]
    groups, collected = group_ids(names), list[npt.NDArray[np.int64]]()

    def note(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        collected.append(counts)
        return counts[:, :1].astype(np.float64)

    bounded_figures(note, len(names), names, count=40)
    drawn = np.concatenate(collected)
    row = np.stack([drawn[:, groups == number][:, 0] for number in range(7)], axis=1)
    assert all((drawn[:, groups == number] == row[:, [number]]).all() for number in range(7))
    # Seven groups of the whole and of resamples, six of the jackknife.
    assert sorted(set(row.sum(axis=1).tolist())) == [6, 7]
    left_out = row[row.sum(axis=1) == 6]
    assert sorted(left_out.tolist()) == sorted((1 - np.eye(7, dtype=np.int64)).tolist())


def test_group_intervals_cover_dependent_images() -> None:
    random = np.random.default_rng(15)
    hits = np.zeros(2)
    kinds = [str(number // 8) for number in range(200)]
    for _ in range(WORLDS):
        # 25 pictures under 8 lights: what a picture adds to a method's error is the same under each.
        shift = np.repeat(random.normal(0.3, 1, 25), 8)
        hard = skewed(random, 200)
        for index, groups in enumerate((kinds, None)):
            _, low, high = compare_paired(hard + shift, hard, count=200, groups=groups)[0].difference
            hits[index] += low <= 0.3 <= high
    assert 0.86 < hits[0] / WORLDS < 0.99
    assert hits[1] / WORLDS < 0.7
