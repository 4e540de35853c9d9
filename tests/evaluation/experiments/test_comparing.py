"""Paired comparisons: matching by name, the signed-rank test, and refusals."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments import comparing
from evaluation.experiments.bootstrap import STATISTICS
from evaluation.experiments.comparing import (
    MatchedErrors,
    compare,
    holm,
    images_table,
    match,
    signed_rank,
    statistics_table,
    verdict,
)
from evaluation.results.files import MethodErrors
from foundation.errors import InputError


def errors(
    images: Sequence[str], values: npt.ArrayLike, truths: npt.NDArray[np.float64] | None = None, method: str = "Mine"
) -> MethodErrors:
    """Return errors of images named by letters; recovery errors are half the reproduction errors."""
    all_truths = np.asarray(values, dtype=np.float64)
    return MethodErrors(
        method,
        tuple(images),
        np.ones((len(all_truths), 3)) if truths is None else truths,
        {"recovery": all_truths / 2, "reproduction": all_truths},
        np.zeros(len(all_truths), bool),
    )


def exact_p_value(difference: list[float]) -> float:
    """Return the exact two-sided p of the signed-rank test: fraction of sign patterns at least as uneven."""
    ranks = np.argsort(np.argsort(np.abs(difference))) + 1
    middle = ranks.sum() / 2
    observed = abs(ranks[np.array(difference) > 0].sum() - middle)
    sums = [ranks[np.array(signs)].sum() for signs in itertools.product([True, False], repeat=len(ranks))]
    return float(np.mean([abs(total - middle) >= observed for total in sums]))


@pytest.mark.parametrize("difference", [[1, 2, -3, 4, 5, 6.5], [-1, 2, 3, 4, 5, 6, 7, 8.5], [1, -2, 3, -4, 5.5]])
def test_p_matches_enumeration_of_signs(difference: list[float]) -> None:
    base = np.full(len(difference), 10.0)
    assert signed_rank(base + difference, base).p == pytest.approx(exact_p_value(difference))


def test_wins_losses_and_effect() -> None:
    base = np.arange(5.0, 45)
    better, worse = signed_rank(base - 1, base), signed_rank(base + np.linspace(0.1, 1, 40), base)
    assert (better.wins, better.losses, better.ties, better.effect) == (40, 0, 0, -1)
    assert (worse.wins, worse.losses, worse.ties, worse.effect) == (0, 40, 0, 1)
    assert max(better.p, worse.p) < 1e-6
    same = signed_rank(base, base + 1e-7)
    assert (same.wins, same.losses, same.ties, same.p, same.effect) == (0, 0, 40, 1, 0)


def test_equal_errors_keep_their_ranks() -> None:
    difference = np.concatenate([np.zeros(10), [1, 2, -3, 4, 5, 6, -7, 8, 9, 10, 11, 12]])
    test = signed_rank(20 + difference, np.full(22, 20.0))
    assert (test.wins, test.losses, test.ties) == (2, 10, 10)
    # Pratt: ten zeros have the ranks 1 to 10, so the others have 11 to 22; wins are 13 and 17 of their sum of 198.
    assert test.effect == pytest.approx((198 - 2 * 30) / 198)
    ranks = np.arange(11, 23)
    sums = np.array([ranks[np.array(signs)].sum() for signs in itertools.product([True, False], repeat=12)])
    exact = np.mean(abs(sums - 99) >= abs(30 - 99))
    assert test.p == pytest.approx(exact, rel=0.25)


@pytest.mark.slow
def test_false_alarm_rate_matches_p() -> None:
    random = np.random.default_rng(3)
    probabilities = [signed_rank(*random.gamma(1.5, 2, (2, 60))).p for _ in range(400)]
    assert np.mean(np.array(probabilities) < 0.05) == pytest.approx(0.05, abs=0.033)
    assert np.mean(np.array(probabilities) < 0.5) == pytest.approx(0.5, abs=0.075)


def test_holm_matches_hand_calculation() -> None:
    # Holm 1979: 4 x .005, 3 x .01, 2 x .03, then not below the one before.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1, 1]
    assert holm([0.2]) == [0.2]


def test_verdict_names_better_method_only_if_significant() -> None:
    random = np.random.default_rng(4)
    hard = random.gamma(1.5, 2, 26)
    letters = "abcdefghijklmnopqrstuvwxyz"
    better, equal = errors(letters, hard * 0.8), errors(letters, random.permutation(hard))
    pairs = [match(better, errors(letters, hard), ("A", "B"), "reproduction")]
    pairs.append(match(equal, errors(letters, hard), ("C", "B"), "reproduction"))
    first, second = compare(pairs)
    assert first.p_holm == pytest.approx(2 * first.test.p)
    assert second.p_holm >= second.test.p > 0.05
    assert re.search("A .*26 of 26 images.*: A is better", verdict(first))
    assert "not significant" in verdict(second)
    assert tuple(figure.statistic for figure in first.statistics) == STATISTICS
    *others, worst5 = (tuple(figure.ratio) for figure in first.statistics)
    assert others == [pytest.approx((0.8, 0.8, 0.8))] * 6
    assert worst5 == pytest.approx((0.8, np.nan, np.nan), nan_ok=True), "two of 26 errors have no interval"


def test_rounding_does_not_make_a_difference() -> None:
    lights, base = np.ones((3, 3)), np.full(3, 5.0)
    for off_deg, is_same in ((0.009, True), (0.011, False)):
        # Away from white by an angle: its tangent times the length of 1 1 1, across it.
        turned = lights + np.tan(np.radians(off_deg)) * np.sqrt(3 / 2) * np.array([1, -1, 0])
        first, second = errors("abc", base, lights), errors("abc", base, turned)
        if is_same:
            match(first, second, ("A", "B"), "recovery")
        else:
            with pytest.raises(InputError):
                match(first, second, ("A", "B"), "recovery")
    # Files hold six decimals, so that the last may differ by one on either side.
    matched = signed_rank(np.add(base, [1.9e-6, 2.1e-6, -2.1e-6]), base)
    assert (matched.wins, matched.losses, matched.ties) == (1, 1, 1)
    comparison = match(errors("abc", np.add(base, [1.9e-6, 2.1e-6, 0])), errors("abc", base), ("", ""), "reproduction")
    assert [row[0] for row in images_table(compare([comparison])[0]).rows] == ["b"]


@pytest.mark.slow
def test_images_of_one_picture_count_as_one_case() -> None:
    """40 illuminants of 12 pictures are 12 cases: false alarms stay rare, unlike in a test by image."""
    random = np.random.default_rng(5)
    images = [f"{picture} {light}" for picture in range(12) for light in range(40)]
    groups = tuple(image.partition(" ")[0] for image in images)
    alarms = np.zeros(2)
    matched: list[MatchedErrors] = []
    for _ in range(200):
        # Neither is better: the order of both on a picture is random, but equal under every illuminant.
        first, second = np.repeat(random.gamma(3, 1, (2, 12)), 40, axis=1) + random.uniform(0, 0.1, (2, 480))
        alarm_counts = [
            replace(errors(images, 2 * picture_errors), groups=groups) for picture_errors in (first, second)
        ]
        matched.append(tested := match(alarm_counts[0], alarm_counts[1], ("A", "B"), "recovery"))
        alarms += [signed_rank(*tested.case_errors()).p < 0.05, signed_rank(first, second).p < 0.05]
    assert alarms[0] / 200 < 0.1
    assert alarms[1] / 200 > 0.5
    (comparison,) = compare(matched[-1:])
    assert comparison.matched.cases == "12 groups of 480 images"
    assert comparison.test.wins + comparison.test.losses == 12
    assert "12 groups of 480 images" in verdict(comparison)
    table = comparing.tests_table([comparison])
    assert dict(zip(table.columns, table.rows[0], strict=True))["Groups"] == 12


def test_single_group_has_no_interval() -> None:
    method_errors = replace(errors("abcdefghi", np.arange(9.0) + 1), groups=("cat.png",) * 9)
    result = match(method_errors, errors("abcdefghi", np.arange(9.0) + 2), ("A", "B"), "recovery")
    (comparison,) = compare([result])
    assert comparison.test.p == 1
    assert "not significant" in verdict(comparison)
    assert np.isnan(comparison.statistics[0].difference[1:]).all()
    assert statistics_table([comparison]).rows[0][6:8] == (None, None)


def test_groups_of_one_image_do_not_change_results() -> None:
    method_errors, other_errors = errors("abcdef", [1, 2, 3, 4, 5, 7]), errors("abcdef", [2, 1, 4, 6, 7, 8])
    plain = compare([match(method_errors, other_errors, ("A", "B"), "recovery")])[0]
    grouped = compare([match(replace(method_errors, groups=tuple("uvwxyz")), other_errors, ("A", "B"), "recovery")])[0]
    assert grouped.test == plain.test
    assert grouped.statistics == plain.statistics
