"""Model of the projector against formulas for one primary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.judge import state
from acquisition.judge.state import LAMP_SIGMA, ProjectorModel
from experiment.session.records import TOP

NODES = len(state._NODES)
LEVELS = 3 * NODES  # First entry of the three levels in the state, after the curves
# Prior scatter of a projector, and standard deviation of an amount in the dark.
CHROMA, BRIGHTNESS, ABSOLUTE = 0.004, 0.002, 3e-4
UNKNOWN = ProjectorModel.unknown()


def exact_model(**overlaps: float) -> ProjectorModel:
    """Return an exact model, gamma 2.2, whose primaries gain light in overlaps: ``p0_of_01=0.3``."""
    model = replace(UNKNOWN, covariance=np.zeros_like(UNKNOWN.covariance), state=UNKNOWN.state.copy())
    terms = [f"p{primary}_of_{''.join(map(str, subset))}" for primary, subset in state._TERMS]
    for name, gain in overlaps.items():
        model.state[LEVELS + 3 + terms.index(name)] = gain
    return model


def at(code: float) -> float:
    return float((code / TOP) ** 2.2)


def test_predicts_only_stray_light_for_black() -> None:
    expected = UNKNOWN.predict((0, 0, 0))
    assert expected.amounts.tolist() == [0, 0, 0]
    np.testing.assert_allclose(expected.covariance, ABSOLUTE**2 * np.eye(3))
    np.testing.assert_allclose(expected.with_lamp, ABSOLUTE**2 * np.eye(3))


def test_prior_covers_usual_tone_curves() -> None:
    covariance = UNKNOWN.covariance
    own, shared = covariance[:NODES, :NODES], covariance[:NODES, NODES : 2 * NODES]
    np.testing.assert_allclose(own, covariance[NODES : 2 * NODES, NODES : 2 * NODES])
    np.testing.assert_allclose(shared, own * (1 - 0.15**2))
    # An exponent off by 0.4, and bends of 0.12 that are alike within a factor of e^0.7 of the code; none at full code.
    x = np.log(state._NODES / TOP)
    full = np.exp(-0.5 * (x / 0.7) ** 2)
    bends = np.exp(-0.5 * ((x[:, None] - x) / 0.7) ** 2) - np.outer(full, full)
    np.testing.assert_allclose(own, 0.4**2 * np.outer(x, x) + 0.12**2 * bends, atol=1.1e-8)
    # Levels of the primaries, light added by each pair and by all three, the lamp.
    np.testing.assert_allclose(covariance[LEVELS:, LEVELS:], np.diag([0.01**2] * 3 + [0.25**2] * 9 + [LAMP_SIGMA**2]))
    assert not covariance[:LEVELS, LEVELS:].any()
    assert (UNKNOWN.chroma_sd, UNKNOWN.brightness_sd) == pytest.approx((CHROMA, BRIGHTNESS))


@pytest.mark.parametrize("code", [1, 10, 60, 128, 200, TOP, 255])
def test_predicts_power_law_with_uncertainty(code: int) -> None:
    expected = UNKNOWN.predict((code, 0, 0))
    assert expected.amounts[0] == pytest.approx(at(code), rel=1e-3)
    assert expected.amounts[1:].tolist() == [0, 0]
    np.testing.assert_allclose(UNKNOWN.curves()[:, code], at(code), rtol=1e-3)
    if code in (60, TOP, 255):
        x = np.log(code / TOP)
        curve = (0.4 * x) ** 2 + 0.12**2 * (1 - np.exp(-((x / 0.7) ** 2)))
        without = (curve + 0.01**2 + CHROMA**2) * at(code) ** 2 + ABSOLUTE**2
        assert expected.covariance[0, 0] == pytest.approx(without, rel=2e-3)
        assert expected.with_lamp[0, 0] == pytest.approx(without + (LAMP_SIGMA * at(code)) ** 2, rel=2e-3)


def test_overlap_follows_least_primary() -> None:
    model = exact_model(p0_of_01=0.3, p1_of_012=-0.1, p2_of_012=0.2)
    np.testing.assert_allclose(model.predict((TOP, 0, TOP)).amounts, [1, 0, 1])
    np.testing.assert_allclose(model.predict((TOP, TOP, 0)).amounts, [1.3, 1, 0])
    np.testing.assert_allclose(model.predict((TOP, TOP, TOP)).amounts, [1.3, 0.9, 1.2])
    prediction = model.predict((TOP, 128, 64))
    amounts = [1 + 0.3 * at(128), at(128) - 0.1 * at(64), at(64) * 1.2]
    np.testing.assert_allclose(prediction.amounts, amounts, rtol=1e-6)
    # What the form lacks: 15 % of the light added, most where the share is a half, as four times its own complement.
    share = at(128)
    lacking = 0.15 * 2 * share * (1 - share) * 0.3 / (1 + share * 0.3)
    assert prediction.covariance[0, 0] == pytest.approx(
        amounts[0] ** 2 * (CHROMA**2 + lacking**2) + ABSOLUTE**2, rel=1e-5
    )
    assert model.overlap == pytest.approx(0.3)
    assert exact_model(p1_of_12=-0.3, p1_of_01=-0.1, p0_of_012=0.35).overlap == pytest.approx(-0.4)
    # At least a fifth of the light remains.
    assert exact_model(p0_of_01=-0.9).predict((TOP, TOP, 0)).amounts[0] == pytest.approx(0.2)


@pytest.mark.parametrize("own", [0.0, 0.01])
def test_learns_level_and_lamp_by_their_variance(own: float) -> None:
    amount = 0.97
    learnt = UNKNOWN.learn(np.array([amount, 0, 0]), (TOP, 0, 0), np.eye(3) * own**2)
    level, lamp = 0.01**2, LAMP_SIGMA**2 + LAMP_SIGMA**2
    noise = CHROMA**2 + BRIGHTNESS**2 + (ABSOLUTE**2 + own**2) / amount**2
    log_amount, total = np.log(amount), level + lamp + noise
    assert learnt.state[LEVELS] == pytest.approx(log_amount * level / total, rel=1e-4)
    assert learnt.state[-1] == pytest.approx(log_amount * lamp / total, rel=1e-4)
    assert learnt.covariance[LEVELS, LEVELS] == pytest.approx(level - level**2 / total, rel=1e-4)
    assert learnt.covariance[-1, -1] == pytest.approx(lamp - lamp**2 / total, rel=1e-4)
    assert learnt.covariance[LEVELS, -1] == pytest.approx(-level * lamp / total, rel=1e-4)
    np.testing.assert_allclose(learnt.state[LEVELS + 1 : -1], 0, atol=1e-9)
    # One amount does not tell how it scatters against others; as far as nothing else was in doubt, the lamp scatters.
    assert learnt.chroma == UNKNOWN.chroma
    weight = BRIGHTNESS**2 / total
    assert learnt.brightness == pytest.approx(
        (12 * BRIGHTNESS**2 + weight * min(log_amount**2, (8 * BRIGHTNESS) ** 2), 12 + weight), rel=1e-4
    )


@pytest.mark.parametrize(
    ("amounts", "angle_deg", "brightness"),
    [((1.05, 1.05, 1.05), 0.0, np.log(1.05)), ((1.0, 1.0, 0.0), np.degrees(np.arccos(2 / np.sqrt(6))), np.log(2 / 3))],
)
def test_compares_amounts_by_angle_and_brightness(
    amounts: tuple[float, float, float], angle_deg: float, brightness: float
) -> None:
    measured: npt.NDArray[np.float64] = np.array(amounts)
    fit = exact_model().compare(measured, (TOP, TOP, TOP))
    assert (fit.angle_deg, fit.brightness) == pytest.approx((angle_deg, brightness), abs=1e-6)
    # All three are as sure: what is left beside the level counts in deviations of one amount.
    sd = np.hypot(CHROMA, ABSOLUTE)
    assert fit.distance == pytest.approx(float(np.linalg.norm(measured - measured.mean())) / sd, abs=1e-6)
    # Their mean is known three times as well; the lamp scatters besides, and drifts.
    assert fit.brightness_sd == pytest.approx(np.sqrt(sd**2 / 3 + BRIGHTNESS**2 + LAMP_SIGMA**2))
    assert fit.angle_limit(5.5) == pytest.approx(fit.angle_deg * 5.5 / max(fit.distance, 1e-3))
