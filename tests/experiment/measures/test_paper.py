"""Flat field and ground truth, measured on bare paper."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.radiometry.drift import corrections
from experiment.measures.least_squares import order_of
from experiment.measures.paper import MAX_ORDER_AROUND, FlatField, Paper, PaperReader
from foundation.errors import QualityError

PAGE = (400.0, 300.0)
RANDOM = np.random.default_rng(3)
PLACES = RANDOM.random((400, 2)) * PAGE
CENTRES = RANDOM.random((1000, 2)) * PAGE


def read_paper(levels: npt.NDArray[np.float64], base: FlatField | None = None) -> Paper:
    return PaperReader(PLACES, CENTRES, PAGE, base).read(levels)[0]


def falloff(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    x, y = (2 * points / PAGE - 1).T
    return np.stack([1 / (1 + 0.2 * (x * x + y * y)), 1 / (1 + 0.25 * ((x - 0.1) ** 2 + y * y)), 1 - 0.1 * x], axis=-1)


def test_measures_flat_field_with_mean_one() -> None:
    level = np.array([3000.0, 8000.0, 5000.0])
    paper = read_paper(falloff(PLACES) * level)
    assert paper.field.at(CENTRES).mean(axis=0) == pytest.approx(1, abs=1e-6)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    # Corners without references are extrapolated.
    assert paper.field.at(CENTRES) == pytest.approx(expected, rel=0.01)
    assert np.sqrt(((paper.field.at(CENTRES) / expected - 1) ** 2).mean()) < 3e-4
    assert paper.white == pytest.approx(level * falloff(CENTRES).mean(axis=0), rel=1e-3)


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 10_000), st.sampled_from([20.0, 300.0, 9000.0]))
def test_noise_does_not_change_the_shape(seed: int, level: float) -> None:
    random = np.random.default_rng(seed)
    noise = np.sqrt(level / 1.8 + 36) / 5
    levels = level * falloff(PLACES) + random.normal(0, noise, (len(PLACES), 3))
    base = read_paper(9000 * falloff(PLACES)).field
    paper = read_paper(levels, base)
    true = level * falloff(CENTRES).mean(axis=0)
    assert (np.abs(paper.white - true) < 6 * paper.error + 1e-3 * true).all()
    assert paper.error == pytest.approx(np.full(3, noise / 20), rel=0.35)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    assert np.sqrt(((paper.field.at(CENTRES) / expected - 1) ** 2).mean()) < 0.002 + 0.25 * noise / level


@pytest.mark.slow
def test_error_of_white_includes_the_flat_field() -> None:
    """Without the error of the flat field, deviations are 1.5 standard errors RMS and at most 12."""
    random, level = np.random.default_rng(8), np.array([3000.0, 700.0, 5000.0])
    deviations: list[npt.NDArray[np.float64]] = []
    true = level * falloff(CENTRES).mean(axis=0)
    for _ in range(3):
        places = random.random((144, 2)) * PAGE * (0.85, 1)
        lamp = PaperReader(places, CENTRES, PAGE).read(9000 * falloff(places) * (1 + places[:, :1] / 8000))[0]
        reader = PaperReader(places, CENTRES, PAGE, lamp.field)
        for _ in range(40):
            noise = random.normal(0, np.sqrt(level / 1.8 + 36) / 5, (len(places), 3))
            paper, _ = reader.read(level * falloff(places) + noise)
            deviations.append((paper.white - true) / paper.error)
    assert 0.9 < np.sqrt(np.square(deviations).mean()) < 1.3
    assert np.abs(deviations).max() < 6


def test_ignores_covered_references() -> None:
    seen = 5000 * falloff(PLACES)
    seen[:30] *= 0.5
    seen[30:40] = np.nan
    paper = read_paper(seen)
    assert paper.references == 390
    assert paper.white == pytest.approx(5000 * falloff(CENTRES).mean(axis=0), rel=0.002)


def test_dark_channel_keeps_the_shape_of_the_base() -> None:
    base = read_paper(9000 * falloff(PLACES)).field
    seen = np.random.default_rng(0).normal(0, 1, (len(PLACES), 3))
    field = read_paper(seen, base).field
    assert field.at(CENTRES) == pytest.approx(base.at(CENTRES), rel=0.02)
    assert (field.at(CENTRES) > 0).all()


def test_refuses_too_few_references() -> None:
    with pytest.raises(QualityError, match=r"5 white.*at least 6"):
        PaperReader(PLACES[:5], CENTRES, PAGE).read(np.ones((5, 3)))


def test_lut_json_describes_the_flat_field() -> None:
    """Evaluated as documented for `lut.json`, with NumPy's Legendre series only."""
    base = read_paper(9000 * falloff(PLACES)).field
    tilted = falloff(PLACES) * (1 + 0.05 * (2 * PLACES[:, :1] / PAGE[0] - 1))
    field = read_paper(9000 * tilted, base).field
    records = corrections(PAGE, np.zeros((1, 2, 2)), 13584, [field], saturation_from="frames")
    record = next(entry for entry in records if entry["name"] == "field")
    u, v = (2 * CENTRES / PAGE - 1).T
    for channel in range(3):
        product = np.ones(len(CENTRES))
        for factor in record["per_light"][0][channel]:
            weights, order, remaining = np.zeros((9, 9)), 0, list(factor)
            while remaining:
                for j in range(order + 1):
                    weights[order - j, j] = remaining.pop(0)
                order += 1
            product *= np.asarray(np.polynomial.legendre.legval2d(u, v, weights), dtype=np.float64)
        assert product == pytest.approx(field.at(CENTRES)[:, channel], rel=1e-5)


def test_stain_changes_the_spread_and_not_the_white() -> None:
    random = np.random.default_rng(8)
    levels = falloff(PLACES) * 6000 + random.normal(0, 12, (len(PLACES), 3))
    clean = read_paper(levels)
    stained = levels.copy()
    stained[np.linalg.norm(PLACES - (200, 150), axis=1) < 40] *= 0.8
    dirty = read_paper(stained)
    assert dirty.white == pytest.approx(clean.white, rel=0.003)
    assert (clean.spread < 0.004).all()
    assert (dirty.spread > 0.02).all()


def light_at(
    points: npt.NDArray[np.float64], corner: float, centre: tuple[float, float], rim: bool
) -> npt.NDArray[np.float64]:
    """Return lens times projector: cos⁴ of the angle, or with a rim shaded by the mount. No fit has this form."""
    half = np.hypot(*PAGE) / 2
    from_axis = (((points - np.array(PAGE) * (0.51, 0.49)) / half) ** 2).sum(axis=1)
    from_spot = (((points - np.array(PAGE) / 2) / half - centre) ** 2).sum(axis=1)
    lens = np.cos(np.arctan(np.sqrt(from_axis * (corner**-0.5 - 1)))) ** 4
    if rim:
        lens = np.sqrt(lens) * (1 - (1 - corner**0.5) * from_axis**2.5)
    return lens / (1 + 0.2 * from_spot)


@pytest.mark.parametrize("rim", [False, True])
@pytest.mark.parametrize(("corner", "centre"), [(0.52, (0.0, 0.0)), (0.6, (0.1, 0.12))])
def test_dark_corners_have_small_errors(corner: float, centre: tuple[float, float], rim: bool) -> None:
    """Corners have 40 to 52 % of the light of the centre; 467 references of 9000 counts, as on a full chart on A0.

    Polynomials of fourth and sixth order, chosen by BIC, had errors of 0.3 to 0.6 % in the worst hundredth of the
    patches.
    """
    random = np.random.default_rng(17)
    places, centres = random.random((467, 2)) * PAGE, random.random((8000, 2)) * PAGE
    true = light_at(centres, corner, centre, rim)
    assert 0.38 < true.min() / true.max() < 0.54
    levels = 9000 * light_at(places, corner, centre, rim)[:, None] * np.ones(3)
    levels += random.normal(0, 1, levels.shape) * np.sqrt(levels / 1.8 + 36) / 5
    field = PaperReader(places, centres, PAGE).read(levels)[0].field.at(centres)
    errors = field / (true / true.mean())[:, None] - 1
    corner_indices = np.argsort(-np.linalg.norm(centres - np.array(PAGE) / 2, axis=1))[:80]
    assert np.sqrt((errors[corner_indices] ** 2).mean(axis=0)).max() < 0.003
    assert np.sqrt((errors**2).mean(axis=0)).max() < 0.0006


@pytest.mark.slow
@pytest.mark.parametrize("level", [60.0, 300.0])
def test_dim_light_has_little_noise(level: float) -> None:
    """Without a base, sixth order has an error of 0.67 % at 60 counts, and the choice of BIC 0.8 %."""
    random = np.random.default_rng(18)
    places, centres = random.random((467, 2)) * PAGE, random.random((8000, 2)) * PAGE
    true = light_at(centres, 0.52, (0.0, 0.0), rim=False)
    squared_errors: list[float] = []
    for _ in range(10):
        levels = level * light_at(places, 0.52, (0.0, 0.0), rim=False)[:, None] * np.ones(3)
        noise = np.asarray(np.sqrt(levels / 1.8 + 36) / 5, dtype=np.float64)
        field = PaperReader(places, centres, PAGE).read(levels + noise * random.normal(0, 1, levels.shape))[0].field
        errors = field.at(centres) / (true / true.mean())[:, None] - 1
        squared_errors.append(float((errors * errors).mean()))
    relative = float((level / 1.8 + 36) ** 0.5) / 5 / level
    # Twelve terms for all three channels together, and one for each channel.
    assert float(np.mean(squared_errors)) < (1.5 * relative) ** 2 * (12 / 3 + 1) / 467


def test_hand_in_a_corner_is_no_fall_off() -> None:
    """A twelfth of the references is dark in one frame; its base is kept."""
    random = np.random.default_rng(21)
    levels = 6000 * falloff(PLACES)
    base = read_paper(levels + random.normal(0, 12, levels.shape)).field
    covered = levels + random.normal(0, 12, levels.shape)
    covered[np.linalg.norm(PLACES - PAGE, axis=1) < 115] *= 0.2
    paper = read_paper(covered, base)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    assert np.abs(paper.field.at(CENTRES) / expected - 1).max() < 0.01
    assert np.linalg.norm(np.array(paper.left.at_mm) - PAGE) < 115
    assert paper.left.deviation == pytest.approx((-0.8, -0.8, -0.8), abs=0.02)
    assert 0.03 < paper.left.share < 0.15


def test_references_in_the_margin_keep_the_centre() -> None:
    """The base knows a bend of 4 % in the centre; noise in the margin must not change it."""
    side = RANDOM.random((300, 2)) * PAGE
    side[:150, 1] = np.where(RANDOM.random(150) < 0.5, 0.02, 0.98) * PAGE[1]
    side[150:, 0] = np.where(RANDOM.random(150) < 0.5, 0.02, 0.98) * PAGE[0]
    base = PaperReader(PLACES, CENTRES, PAGE).read(falloff(PLACES) * 5000)[0].field
    x, y = (2 * side / PAGE - 1).T
    seen = falloff(side) * 3000 * (1 + 0.02 * x - 0.01 * y * y)[:, None] * RANDOM.normal(1, 0.002, (300, 3))
    # A smear on some references.
    seen[:12] *= 0.97
    u, v = (2 * CENTRES / PAGE - 1).T
    true = falloff(CENTRES) * (1 + 0.02 * u - 0.01 * v * v)[:, None]
    true /= true.mean(axis=0)
    field = PaperReader(side, CENTRES, PAGE, base, MAX_ORDER_AROUND).read(seen)[0].field
    assert max(order_of(len(factors[-1])) for factors in field.coefficients) <= MAX_ORDER_AROUND
    assert np.abs(field.at(CENTRES) / true - 1).max() < 0.01
