"""The algebra behind a lens's shares: which unknown is whose, and solutions against those of general solvers."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats
from scipy.optimize import lsq_linear

from calibration.spread import fitting
from calibration.spread.fitting import (
    FAR_PX,
    LEAST_GAIN,
    NEAR_PX,
    PLACES,
    TERMS,
    PointSpread,
    far_groups,
    free_terms,
    groups_of_terms,
    terms_of,
)
from calibration.spread.surroundings import far_taps

KERNELS = len(NEAR_PX) + len(FAR_PX) + 1


def equations(rows: int, size: int, seed: int) -> tuple[npt.NDArray[np.float64], ...]:
    """Return a design, values, and their normal equations."""
    random = np.random.default_rng(seed)
    design, value = random.standard_normal((rows, size)), random.standard_normal(rows)
    return design, value, design.T @ design, design.T @ value


def test_each_unknown_belongs_to_one_channel_and_one_group() -> None:
    assert np.concatenate([terms_of(channel) for channel in range(3)]).tolist() == list(range(TERMS))
    groups = groups_of_terms()
    assert sorted(np.concatenate(groups).tolist()) == list(range(TERMS))
    # Near kernels' means and changes, then what is the same all over, a number a channel.
    assert [len(group) for group in groups] == [3, 3 * (PLACES - 1)] * len(NEAR_PX) + [3] * (len(FAR_PX) + 1)
    assert [group.tolist() for group in far_groups()] == [group.tolist() for group in groups[2 * len(NEAR_PX) :]]
    assert np.flatnonzero(~free_terms()).tolist() == sorted(np.concatenate(far_groups()).tolist())


def test_shares_stand_by_term_channel_and_kernel_and_what_is_left_out_is_an_error() -> None:
    shares = np.arange(TERMS, dtype=np.float64)
    spread = PointSpread(shares, np.diag(shares**2), 99.0, 2 * LEAST_GAIN, 1.0, shares + 1)
    amounts = spread.amounts()
    assert amounts.shape == (PLACES, 3, KERNELS)
    for channel in range(3):
        own = shares[terms_of(channel)]
        near = own[: PLACES * len(NEAR_PX)].reshape(len(NEAR_PX), PLACES).T
        np.testing.assert_array_equal(amounts[:, channel, : len(NEAR_PX)], near)
        np.testing.assert_array_equal(amounts[0, channel, len(NEAR_PX) :], own[PLACES * len(NEAR_PX) :])
    assert not amounts[1:, :, len(NEAR_PX) :].any()
    np.testing.assert_allclose(spread.errors(), amounts)
    np.testing.assert_allclose(spread.unexplained, np.diag(shares**2) + 1)
    assert spread.proven
    assert not PointSpread(shares, spread.covariance, 99.0, LEAST_GAIN, 1.0, shares).proven
    assert not PointSpread(0 * shares, spread.covariance, 99.0, 2 * LEAST_GAIN, 1.0, shares).proven


@pytest.mark.parametrize("seed", range(3))
def test_far_light_is_never_negative_and_the_rest_is_least_squares(seed: int) -> None:
    design, value, matrix, vector = equations(2 * TERMS, TERMS, seed)
    kept = np.sort(np.random.default_rng(seed).permutation(TERMS)[: TERMS // 2])
    shares, gain = fitting._positive(matrix, vector, kept)
    low = np.where(free_terms()[kept], -np.inf, 0.0)
    expected = np.zeros(TERMS)
    expected[kept] = lsq_linear(design[:, kept], value, (low, np.inf), tol=1e-12).x
    np.testing.assert_allclose(shares, expected, atol=1e-6)
    assert (shares[~free_terms()] >= 0).all()
    assert not shares[~np.isin(np.arange(TERMS), kept)].any()
    assert gain == pytest.approx((value**2).sum() - ((value - design @ shares) ** 2).sum())


def test_kernels_that_gain_less_than_chance_and_four_standard_errors_are_left_out() -> None:
    groups = groups_of_terms()
    matrix = np.eye(TERMS)
    worth = np.zeros(len(groups))
    # A kernel gains the sum of its squares here: just enough, and just not.
    worth[[0, 1, -1]] = [LEAST_GAIN + 3 - 1 + 0.1, LEAST_GAIN + 24 - 1 - 0.1, LEAST_GAIN + 3 - 1 + 0.1]
    vector = np.zeros(TERMS)
    for group, gain in zip(groups, worth, strict=True):
        vector[group] = np.sqrt(gain / len(group))
    for misfit, kept in ((1.0, [0, len(groups) - 1]), (1.1, [])):
        found = fitting._selected(matrix, vector, misfit, groups)
        assert found.tolist() == sorted(np.concatenate([np.zeros(0, int), *(groups[k] for k in kept)]).tolist())


@pytest.mark.slow
@pytest.mark.parametrize("power", [1.0, 2.0, 3.0, 4.5])
def test_a_kernel_s_share_of_a_power_law_is_that_of_the_sizes_about_its_own(power: float) -> None:
    scale = np.array(NEAR_PX + FAR_PX)
    # σ^(1 - power) dσ, summed over sizes that are nearest to each kernel's by their ratio, as far out as in.
    ratio = np.sqrt([scale[1] / scale[0], scale[-1] / scale[-2]])
    low, high = float(np.log(scale[0] / ratio[0])), float(np.log(scale[-1] * ratio[1]))
    sizes = np.exp(low + (high - low) / 400_000 * np.arange(400_001.0))
    middle = np.sqrt(sizes[1:] * sizes[:-1])
    amount: npt.NDArray[np.float64] = middle ** (1 - power) * np.diff(sizes)
    nearest = np.abs(np.log(middle[:, None] / scale)).argmin(axis=1)
    expected = np.bincount(nearest, amount) / amount.sum()
    np.testing.assert_allclose(fitting._law(power), expected, rtol=1e-3)


@pytest.mark.parametrize("few", [False, True])
def test_what_is_supposed_of_lenses_has_odds_that_sum_to_one_and_a_covariance(few: bool) -> None:
    lenses = fitting._supposed_lenses(few)
    assert sum(lens.odds for lens in lenses) == pytest.approx(1)
    assert min(lens.odds for lens in lenses) > 0
    veil = far_groups()[-1]
    for lens in lenses[:: max(1, len(lenses) // 6)]:
        usual = fitting._usual_shares(3 if few else 5, lens)
        np.testing.assert_allclose(usual, usual.T)
        assert np.linalg.eigvalsh(usual).min() > 0
        np.testing.assert_allclose(np.diag(usual)[veil], (lens.veil * fitting.USUAL_VEIL) ** 2)
        # Channels share what is not their own.
        alike = usual[veil[0], veil[1]] / usual[veil[0], veil[0]]
        assert alike == pytest.approx(1 - lens.veil_apart**2)


def test_a_sensor_that_falls_short_bends_neither_black_nor_white() -> None:
    level = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(fitting.bent(level, np.array([1.0, 1.0, 0.8, 1.0])), [0, 3 / 16, 0.2, 0])


def test_folds_are_patches_of_the_page_and_none_is_lost() -> None:
    random = np.random.default_rng(1)
    places, points = random.uniform(0, 1, (900, 2)) * (300, 200), random.permutation(900)[:600]
    ordered, folds = fitting._by_fold(points, places, (300.0, 200.0))
    assert sorted(ordered.tolist()) == sorted(points.tolist())
    assert [fold.start for fold in folds] == [0, *(fold.stop for fold in folds[:-1])]
    assert folds[-1].stop == len(ordered)
    side = 300 / fitting._PATCHWORK
    fold_of = np.empty(900, dtype=np.int64)
    for number, fold in enumerate(folds):
        fold_of[ordered[fold]] = number
        assert fold.stop - fold.start > 50
    patches = np.floor(places / side).astype(np.int64)
    for patch in np.unique(patches[points], axis=0):
        assert len(set(fold_of[points][(patches[points] == patch).all(axis=1)].tolist())) == 1


@pytest.mark.parametrize(("few", "clean", "clear"), [(False, 0.3, 0.0), (True, 0.7, 0.3)])
def test_lenses_that_scatter_and_have_a_veil_are_as_likely_as_is_said(few: bool, clean: float, clear: float) -> None:
    lenses = fitting._supposed_lenses(few)

    def odds(of: Callable[[Any], bool]) -> float:
        return sum(lens.odds for lens in lenses if of(lens))

    assert odds(lambda lens: lens.near < 1) == pytest.approx(clean)
    # Half of those that scatter follow a law, each as likely; of the others each size is as likely.
    assert odds(lambda lens: lens.power > 0) == pytest.approx((1 - clean) / 2)
    for power, far in ((2.0, 1.0), (3.0, 1.0), (3.0, 0.001)):
        found = odds(lambda lens, power=power, far=far: (lens.power, lens.far) == (power, far))
        assert found == pytest.approx((1 - clean) / 6)
    assert {lens.far_apart for lens in lenses if lens.power} == {0.5}
    others = (1 - clean) / 2
    for size in (0.3, 1.0, 3.0):
        found = odds(lambda lens, size=size: not lens.power and lens.near == 1 and lens.far == size)
        assert found == pytest.approx(others / 3)
    # Without a veil are clean lenses as often as they are clean, others where cells are few.
    without = clean * clean + (1 - clean) * clear
    assert odds(lambda lens: lens.veil < 1) == pytest.approx(without)
    for apart, part in ((0.03, 0.4), (1 / 3, 0.4), (0.7, 0.2)):
        found = odds(lambda lens, apart=apart: not lens.power and lens.near == 1 and lens.far_apart == apart)
        assert found == pytest.approx(others * part)
        found = odds(lambda lens, apart=apart: lens.veil == 1 and lens.veil_apart == apart)
        assert found == pytest.approx((1 - without) * part)
    assert {(lens.near, lens.veil) for lens in lenses} == {
        *((near, veil) for near in (0.001, 1.0) for veil in (0.001, 1.0) if few or near < 1 or veil == 1)
    }


def test_far_shares_hand_on_half_and_channels_share_them() -> None:
    lens = fitting._Lens(far=2.0, far_apart=0.6)
    few, many = (fitting._usual_shares(bits, lens) for bits in (3, 5))
    # Steps of .01, .01, .004 and .003, twice as large; the last two follow the kernel before by a half.
    steps = np.array([0.02, 0.02, 0.008, 0.006])
    handed = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0.5, 1, 0], [0, 0.25, 0.5, 1]]) * steps
    sizes = handed @ handed.T
    *far, veil = far_groups()
    for one, other in product(range(4), repeat=2):
        block = few[np.ix_(far[one], far[other])]
        assert block[0, 0] == pytest.approx(sizes[one, other])
        assert block[0, 1] == pytest.approx(sizes[one, other] * (1 - 0.6**2))
    assert few[veil[0], veil[2]] == pytest.approx(0.01**2 * (1 - 1 / 9))
    means, changes = groups_of_terms()[:2]
    for usual, of_changes in ((few, 0.002), (many, 0.1)):
        assert np.diag(usual)[means] == pytest.approx(0.1**2)
        assert np.diag(usual)[changes] == pytest.approx(of_changes**2)
    clean = fitting._usual_shares(3, fitting._Lens(near=0.001, veil=0.001))
    assert np.diag(clean)[[*means, *veil]] == pytest.approx([1e-8] * 3 + [1e-10] * 3)
    # A law's kernels follow it all, near ones as well, and deviate by a third of their own.
    law = fitting._law(3.0)
    usual = fitting._usual_shares(3, fitting._Lens(power=3.0, far=0.5, far_apart=0.6))
    law[len(NEAR_PX) :] *= 0.5
    groups = [group for group in groups_of_terms() if len(group) == 3][:-1]
    for one, other in product(range(len(groups)), repeat=2):
        both = 0.04**2 * law[one] * law[other]
        alone = 0.35**2 * both if one == other else 0.0
        block = usual[np.ix_(groups[one], groups[other])]
        assert block[0, 0] == pytest.approx(both + alone)
        assert block[0, 1] == pytest.approx(both * (1 - 0.6**2) + alone * (1 - 0.7**2))


def test_equations_are_weighted_sums_of_their_rows_fold_by_fold() -> None:
    random = np.random.default_rng(6)
    unknowns = np.array([1, 3, 4])
    design, value = random.normal(size=(400, 3)), random.normal(size=400)
    folds = tuple(slice(100 * n, 100 * n + 100) for n in range(4))
    rows = fitting._Rows(value, design, np.linspace(0, 1, 400), folds, unknowns, freedom=0.7)
    solution = random.normal(size=6)
    normal, right = fitting._normal_equations([rows], solution)
    weights = 0.7 * fitting._weights(value - design @ solution[unknowns], rows.level)
    for number, fold in enumerate(folds):
        own = design[fold] * weights[fold, None]
        np.testing.assert_allclose(normal[number][np.ix_(unknowns, unknowns)], own.T @ design[fold])
        np.testing.assert_allclose(right[number][unknowns], own.T @ value[fold])
    assert not normal[:, [0, 2, 5]].any()
    # Twice the same rows are twice the equations.
    twice, _ = fitting._normal_equations([rows, rows], solution)
    np.testing.assert_allclose(twice, 2 * normal)


def test_a_spread_is_written_kernel_by_kernel_with_its_sizes() -> None:
    shares = np.linspace(0, 0.01, TERMS)
    spread = PointSpread(shares, np.diag(shares**2), 123.456, 99.99, 1.23456, shares)
    written = spread.to_json()
    assert written["sigma_px"] == [1.5, 3.0, 6.0, 12.0, 24.0, 96.0, 384.0, None]
    np.testing.assert_allclose(written["share"], spread.amounts(), atol=1e-7)
    np.testing.assert_allclose(written["standard_error"], spread.errors(), atol=1e-7)
    assert (written["gain"], written["gain_held_out"], written["misfit"]) == (123.5, 99.99, 1.235)
    # Held out, as much must be gained as by a share of four standard errors, where smooth light leaves no more.
    assert PointSpread(shares, spread.covariance, 99.0, 17.0, 1.0, shares).proven
    assert not PointSpread(shares, spread.covariance, 99.0, 17.0, 1.1, shares).proven


@pytest.mark.parametrize("scale", [0.1, 0.7, 3.0])
def test_far_light_is_shared_among_slots_as_a_gaussian_lies_over_them(scale: float) -> None:
    taps = far_taps(scale)
    reach = len(taps) // 2
    assert reach == max(1, int(np.ceil(3 * scale)))
    between = stats.norm(0, scale).cdf(np.arange(-reach, reach + 2) - 0.5)
    np.testing.assert_allclose(taps, np.diff(between) / np.diff(between).sum(), rtol=1e-5)
    assert taps.sum() == pytest.approx(1)


def test_shares_are_the_mean_of_what_is_supposed_and_err_by_how_that_differs() -> None:
    random = np.random.default_rng(7)
    roots = random.normal(size=(2, TERMS, 2 * TERMS))
    matrices, vector = roots @ roots.swapaxes(1, 2), random.normal(size=TERMS) + 1
    covariances = np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    weights, kept = np.array([0.3, 0.7]), np.arange(0, TERMS, 2)
    lenses = fitting._Lenses(matrices, vector, covariances, weights, matrices[0])
    mean, covariance = lenses.shares(kept)
    one, other = (fitting._positive(matrix, vector, kept)[0] for matrix in matrices)
    np.testing.assert_allclose(mean, 0.3 * one + 0.7 * other, atol=1e-7)
    # Of two values that differ by d, with these weights, the variance is .21 d².
    expected = 0.3 * covariances[0] + 0.7 * covariances[1] + 0.21 * np.outer(one - other, one - other)
    np.testing.assert_allclose(covariance, expected, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("scatters", [False, True])
def test_wide_light_is_as_usual_as_lenses_have_it_on_average(scatters: bool) -> None:
    supposed = fitting._supposed_lenses(True)
    chosen = [lens for lens in supposed if lens.near == 1.0] if scatters else supposed
    odds = np.array([lens.odds for lens in chosen])
    usual = np.average([fitting._usual_shares(3, lens) for lens in chosen], axis=0, weights=odds)
    # Of the veil and the two widest kernels.
    wide = np.zeros(TERMS, np.bool_)
    wide[np.concatenate(far_groups()[-3:])] = True
    found = fitting._usual_wide_light(3, scatters)
    np.testing.assert_allclose(found, np.where(wide[:, None] & wide, usual, 0.0), atol=1e-15)
