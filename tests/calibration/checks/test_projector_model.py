"""What a projector is taken to give, against the formulas and numbers that the model states, and what it predicts."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import numpy.typing as npt
import pytest

from calibration.checks import light_codes, projector_model
from calibration.checks.light_codes import EXCHANGED, ExchangedLights
from calibration.checks.projector_model import ProjectorFit, fit_projector
from sim.spectral import projector_primaries, sensitivities
from tests.calibration.checks.test_light_codes import CAMERAS

_Array = npt.NDArray[np.float64]

SUBSETS = ((0, 1), (0, 2), (1, 2), (0, 1, 2))
SCALE, REST = 9000.0, 0.02
NUMBERS = 9 + 4 * 12 + 9 * 5 + 3
"""Of the model: primaries, tone curves, light of overlaps, and what is left at black."""


def test_primaries_are_those_of_measured_cameras_and_lamps() -> None:
    seen = np.array(
        [
            np.einsum("pl,lc->cp", projector_primaries(lamp), sensitivities(camera))  # pyrefly: ignore[bad-argument-type]
            for lamp, camera in product(("uhp", "led"), CAMERAS)
        ]
    )
    white = seen.sum(axis=2)
    shares = np.median(seen / white[:, :, None], axis=0)
    np.testing.assert_allclose(projector_model._SEEN, shares, rtol=0.15)
    # A logarithm's deviation is what they differ by, up to three times.
    off = np.log(seen / white[:, :, None] / projector_model._SEEN) / projector_model._SEEN_SD
    differ = np.sqrt((off**2).mean(axis=0))
    assert 1 / 3 < differ.min() < differ.max() < 0.9
    np.testing.assert_allclose(projector_model._CHANNELS, np.median(white / white[:, 1:2], axis=0), rtol=0.1)


CODES = np.array([(255, 0, 0), (0, 255, 40), (255, 255, 255), (12, 200, 90), (0, 0, 0), (64, 3, 128), (130, 131, 7)])


def whites_of(state: _Array) -> _Array:
    """Return whites (L, 3) of a state by the docstring's formula, light by light."""
    bases, overlap_basis = projector_model._curve_basis(), projector_model._overlap_basis()
    root = projector_model._primary_root()
    middle = projector_model._SEEN * projector_model._CHANNELS[:, None] * SCALE
    primaries = middle * np.exp((root @ state[:9]).reshape(3, 3))
    shared, *alone = state[9:57].reshape(4, 12)
    overlaps = iter(state[57:102].reshape(9, 5))
    by_term = {(p, subset): next(overlaps) for p in range(3) for subset in SUBSETS if p in subset}

    def curve(p: int, code: int) -> float:
        bend = bases[code] @ (math.sqrt(1 - 0.2**2) * shared + 0.2 * alone[p])
        return (code / 255) ** 2.2 * math.exp(bend) if code else 0.0

    found: list[_Array] = []
    for codes in CODES.tolist():
        white = np.zeros(3)
        for p in range(3):
            amount = curve(p, codes[p]) + REST * state[102 + p]
            for subset in SUBSETS:
                if p in subset:
                    least = min(codes[q] for q in subset)
                    amount += float(overlap_basis[least] @ by_term[p, subset]) * curve(p, least)
            white += primaries[:, p] * amount
        found.append(white)
    return np.array(found)


def test_a_white_is_its_primaries_times_their_curves_with_overlaps_and_a_rest() -> None:
    state = np.random.default_rng(1).normal(0, 0.5, NUMBERS)
    white, slopes = projector_model._model(state, projector_model._Codes.of(CODES), SCALE, REST)
    np.testing.assert_allclose(white, whites_of(state))
    for direction in np.random.default_rng(2).normal(0, 1, (4, NUMBERS)):
        tangent = (whites_of(state + 1e-6 * direction) - whites_of(state - 1e-6 * direction)) / 2e-6
        np.testing.assert_allclose(slopes @ direction, tangent, atol=1e-7 * SCALE, rtol=1e-6)


def linear_fit(count: int, trust: _Array, seed: int = 3) -> ProjectorFit:
    """Return the fit of whites that are linear in a model of eight numbers."""
    random = np.random.default_rng(seed)
    slopes, white = random.normal(0, 1, (count, 3, 8)), random.normal(5, 1, (count, 3))
    root = random.normal(0, 0.3, (count, 3, 3)) + np.eye(3)
    noise = root @ root.swapaxes(1, 2)
    return ProjectorFit(white, slopes, *posterior(white, slopes, noise, trust), noise, trust)


def posterior(white: _Array, slopes: _Array, noise: _Array, trust: _Array) -> tuple[_Array, _Array]:
    weights = np.linalg.inv(noise) * trust[:, None, None]
    precision = np.eye(8) + np.einsum("lck,lcd,ldm->km", slopes, weights, slopes)
    covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
    state = covariance @ np.einsum("lck,lcd,ld->k", slopes, weights, white)
    return covariance, white - slopes @ state


def test_what_others_predict_is_what_a_fit_without_a_light_gives() -> None:
    trust = np.array([1.0, 0.3, 1.0, 0.6, 1.0])
    fit = linear_fit(5, trust)
    sets = np.array([[0, 3], [2, 1]])
    mean, spread = fit.predicted(sets)
    for lights, found, covariance in zip(sets.tolist(), mean, spread, strict=True):
        others = trust.copy()
        others[lights] = 0
        known, left = posterior(fit.white, fit.slopes, fit.noise, others)
        np.testing.assert_allclose(found, (fit.white - left)[lights].ravel())
        both = fit.slopes[lights].reshape(6, 8)
        expected = both @ known @ both.T
        expected[:3, :3] += fit.noise[lights[0]]
        expected[3:, 3:] += fit.noise[lights[1]]
        np.testing.assert_allclose(covariance, expected)


def test_a_white_scatters_by_its_error_the_lamp_and_stray_light() -> None:
    codes = np.array([(255, 255, 255), (255, 0, 0), (0, 0, 255)])
    white = np.array([[3000.0, 10000, 4000], [2000, 300, 40], [0.0, 500, 2500]])
    used = np.array([True, True, False])
    fit = fit_projector(
        codes, white, np.full((3, 3), 2.0), dark_known=True, chroma_sd=0.01, brightness_sd=0.05, used=used
    )
    # Errors of 2, and of 2e-4 of the brightest channel, 10 000; a channel of none scatters as one of that.
    level = np.array([[3000.0, 10000, 4000], [2000, 300, 40], [2, 500, 2500]])
    for light in range(3):
        expected = np.diag(4 + 4 + (0.01 * level[light]) ** 2) + 0.05**2 * np.outer(level[light], level[light])
        np.testing.assert_allclose(fit.noise[light], expected)
    assert fit.trust.tolist() == [1, 1, 0]


def test_a_white_is_off_in_direction_and_brightness_by_standard_errors_of_what_is_predicted() -> None:
    mean, spread = np.array([[300.0, 400, 0]] * 3), np.array([25 * np.eye(3)] * 3)
    # 30 counts across; half as bright again; a tenth as bright.
    white = np.array([[300.0, 400, 30], [450, 600, 0], [30, 40, 0]])
    angle, deviation, error = light_codes._directions(mean, spread, white)
    assert angle == pytest.approx([math.degrees(math.atan(0.06)), 0, 0], abs=1e-5)
    assert deviation == pytest.approx([6, 0, 0], abs=1e-6)
    assert error == pytest.approx(math.degrees(5 / 500))
    more, beyond = light_codes._brightness(mean, spread, white)
    assert more == pytest.approx([0, 0.5, -0.9])
    assert beyond == pytest.approx([0, 0.5 - 4 * 5 / 500, 0.9 - 4 * 5 / 500])
    unknown = light_codes._directions(mean[:1], 1e9 * spread[:1], white[:1])[2]
    assert unknown == 180


def test_a_light_off_its_codes_is_named_after_the_one_whose_codes_give_its_white() -> None:
    mean = np.array([[100.0, 0, 0], [0, 100, 0], [0, 0, 100], [60, 0, 80]])
    spread = np.array([np.eye(3)] * 4)
    white = np.array([[0.0, 50, 0], [0, 100, 0], [0, 0, 100], [30, 100, 40]])
    # The second is within its error, and nothing gives the last, which lies 7° from it at best.
    found = light_codes._seen_as(mean, spread, white, np.array([80.0, 0, 0, 60]))
    assert found.tolist() == [1, -1, -1, -1]
    # One that is as far from that light as from its own is not named after it.
    near = np.array([[99.0, 0, 2], *white[1:]])
    mean[1] = (99, 0, 6)
    assert light_codes._seen_as(mean, spread, near, np.array([1.0, 0, 0, 0])).tolist() == [-1] * 4


def test_an_exchange_is_weighed_by_what_both_names_leave() -> None:
    certain = ProjectorFit(
        np.array([[0.0, 9, 0], [9, 0, 0], [0, 0, 9]]), np.zeros((3, 3, 8)), np.eye(8),
        np.array([[-9.0, 9, 0], [9, -9, 0], [0, 0, 0]]), np.array([2.0 * np.eye(3)] * 3), np.ones(3),
    )  # fmt: skip
    pairs = np.array([[0, 1], [0, 2]])
    evidence, expected, apart = light_codes._weighed(certain, pairs)
    # Twice 9² + 9², over a variance of 2; the last two would not fit exchanged either.
    assert expected == pytest.approx([162, 162])
    assert evidence == pytest.approx([162, 0])
    assert apart == pytest.approx([90, 90])
    mean, spread = certain.predicted(np.arange(3)[:, None])
    found, *_ = light_codes._pairs(certain, mean, spread, np.zeros(3, np.bool_))
    assert found.tolist() == [[0, 1], [0, 2], [1, 2]]


def test_each_light_is_named_in_one_exchange_the_surest() -> None:
    pairs = [ExchangedLights(one, other, 9.0, 50.0) for one, other in ((1, 2), (2, 3), (0, 3), (4, 1))]
    assert [(pair.one, pair.other) for pair in light_codes._each_once(pairs)] == [(1, 2), (0, 3)]


def test_limits_are_those_of_their_odds() -> None:
    # Ten to one, among all pairs of 707 lights.
    assert pytest.approx(2 * math.log(10 * math.comb(707, 2)), abs=1) == EXCHANGED
    for lights in range(2, 21):
        # Random healthy rooms, and those with two names exchanged.
        assert 6 + 1.7 * lights < light_codes._healthy(lights) < 12 + 3.3 * lights
