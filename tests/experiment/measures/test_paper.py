"""The flat field and the ground truth, read from bare paper."""

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


def read_paper(seen: npt.NDArray[np.float64], base: FlatField | None = None) -> Paper:
    return PaperReader(PLACES, CENTRES, PAGE, base).read(seen)[0]


def falloff(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    x, y = (2 * points / PAGE - 1).T
    return np.stack([1 / (1 + 0.2 * (x * x + y * y)), 1 / (1 + 0.25 * ((x - 0.1) ** 2 + y * y)), 1 - 0.1 * x], axis=-1)


def test_the_field_is_found_and_its_mean_over_the_cells_is_one() -> None:
    level = np.array([3000.0, 8000.0, 5000.0])
    paper = read_paper(falloff(PLACES) * level)
    assert paper.field.at(CENTRES).mean(axis=0) == pytest.approx(1, abs=1e-6)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    # Corners that no reference reaches are extrapolated.
    assert paper.field.at(CENTRES) == pytest.approx(expected, rel=0.01)
    assert np.sqrt(((paper.field.at(CENTRES) / expected - 1) ** 2).mean()) < 3e-4
    assert paper.white == pytest.approx(level * falloff(CENTRES).mean(axis=0), rel=1e-3)


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 10_000), st.sampled_from([20.0, 300.0, 9000.0]))
def test_noise_is_not_taken_for_shape(seed: int, level: float) -> None:
    random = np.random.default_rng(seed)
    noise = np.sqrt(level / 1.8 + 36) / 5
    seen = level * falloff(PLACES) + random.normal(0, noise, (len(PLACES), 3))
    base = read_paper(9000 * falloff(PLACES)).field
    paper = read_paper(seen, base)
    true = level * falloff(CENTRES).mean(axis=0)
    assert (np.abs(paper.white - true) < 6 * paper.error + 1e-3 * true).all()
    assert paper.error == pytest.approx(np.full(3, noise / 20), rel=0.35)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    assert np.sqrt(((paper.field.at(CENTRES) / expected - 1) ** 2).mean()) < 0.002 + 0.25 * noise / level


@pytest.mark.slow
def test_the_error_of_white_holds_that_of_its_field() -> None:
    """Cells where no reference is: by the references' scatter alone errors were 1.5 times as large, and up to 12."""
    random, level = np.random.default_rng(8), np.array([3000.0, 700.0, 5000.0])
    off: list[npt.NDArray[np.float64]] = []
    true = level * falloff(CENTRES).mean(axis=0)
    for _ in range(3):
        places = random.random((144, 2)) * PAGE * (0.85, 1)
        lamp = PaperReader(places, CENTRES, PAGE).read(9000 * falloff(places) * (1 + places[:, :1] / 8000))[0]
        reader = PaperReader(places, CENTRES, PAGE, lamp.field)
        for _ in range(40):
            noise = random.normal(0, np.sqrt(level / 1.8 + 36) / 5, (len(places), 3))
            paper, _ = reader.read(level * falloff(places) + noise)
            off.append((paper.white - true) / paper.error)
    assert 0.9 < np.sqrt(np.square(off).mean()) < 1.3
    assert np.abs(off).max() < 6


def test_references_that_are_covered_or_dirty_do_not_count() -> None:
    seen = 5000 * falloff(PLACES)
    seen[:30] *= 0.5
    seen[30:40] = np.nan
    paper = read_paper(seen)
    assert paper.references == 390
    assert paper.white == pytest.approx(5000 * falloff(CENTRES).mean(axis=0), rel=0.002)


def test_a_channel_without_light_has_the_shape_of_a_brighter_frame() -> None:
    base = read_paper(9000 * falloff(PLACES)).field
    seen = np.random.default_rng(0).normal(0, 1, (len(PLACES), 3))
    field = read_paper(seen, base).field
    assert field.at(CENTRES) == pytest.approx(base.at(CENTRES), rel=0.02)
    assert (field.at(CENTRES) > 0).all()


def test_too_few_references_are_refused() -> None:
    with pytest.raises(QualityError, match=r"5 white.*6 expected"):
        PaperReader(PLACES[:5], CENTRES, PAGE).read(np.ones((5, 3)))


def test_the_table_says_enough_to_undo_the_field() -> None:
    """Evaluated by the words of `lut.json`, with NumPy's Legendre series and nothing of ours."""
    base = read_paper(9000 * falloff(PLACES)).field
    tilted = falloff(PLACES) * (1 + 0.05 * (2 * PLACES[:, :1] / PAGE[0] - 1))
    field = read_paper(9000 * tilted, base).field
    done = corrections(PAGE, np.zeros((1, 2, 2)), 13584, [field], saturation_from="frames")
    record = next(one for one in done if one["name"] == "field")
    u, v = (2 * CENTRES / PAGE - 1).T
    for channel in range(3):
        product = np.ones(len(CENTRES))
        for factor in record["per_light"][0][channel]:
            weights, order, rest = np.zeros((9, 9)), 0, list(factor)
            while rest:
                for j in range(order + 1):
                    weights[order - j, j] = rest.pop(0)
                order += 1
            product *= np.asarray(np.polynomial.legendre.legval2d(u, v, weights), dtype=np.float64)
        assert product == pytest.approx(field.at(CENTRES)[:, channel], rel=1e-5)


def test_a_stain_is_ignored_by_the_white_and_shown_by_the_spread() -> None:
    random = np.random.default_rng(8)
    seen = falloff(PLACES) * 6000 + random.normal(0, 12, (len(PLACES), 3))
    clean = read_paper(seen)
    stained = seen.copy()
    stained[np.linalg.norm(PLACES - (200, 150), axis=1) < 40] *= 0.8
    found = read_paper(stained)
    assert found.white == pytest.approx(clean.white, rel=0.003)
    assert (clean.spread < 0.004).all()
    assert (found.spread > 0.02).all()


def lit(
    points: npt.NDArray[np.float64], corner: float, centre: tuple[float, float], rim: bool
) -> npt.NDArray[np.float64]:
    """Return lens times projector: cos⁴ of the angle, or with a rim that the mount shades; the truth of no fit here."""
    half = np.hypot(*PAGE) / 2
    from_axis = (((points - np.array(PAGE) * (0.51, 0.49)) / half) ** 2).sum(axis=1)
    from_spot = (((points - np.array(PAGE) / 2) / half - centre) ** 2).sum(axis=1)
    lens = np.cos(np.arctan(np.sqrt(from_axis * (corner**-0.5 - 1)))) ** 4
    if rim:
        lens = np.sqrt(lens) * (1 - (1 - corner**0.5) * from_axis**2.5)
    return lens / (1 + 0.2 * from_spot)


@pytest.mark.parametrize("rim", [False, True])
@pytest.mark.parametrize(("corner", "centre"), [(0.52, (0.0, 0.0)), (0.6, (0.1, 0.12))])
def test_dark_corners_are_within_three_thousandths(corner: float, centre: tuple[float, float], rim: bool) -> None:
    """Corners at 40 to 52 % of the centre's light, by 467 references of 9000 counts, as a full chart on A0 has them.

    As BIC chose them, polynomials of fourth and sixth order left .3 to .6 % in the worst hundredth of the cells.
    """
    random = np.random.default_rng(17)
    places, centres = random.random((467, 2)) * PAGE, random.random((8000, 2)) * PAGE
    true = lit(centres, corner, centre, rim)
    assert 0.38 < true.min() / true.max() < 0.54
    seen = 9000 * lit(places, corner, centre, rim)[:, None] * np.ones(3)
    seen += random.normal(0, 1, seen.shape) * np.sqrt(seen / 1.8 + 36) / 5
    field = PaperReader(places, centres, PAGE).read(seen)[0].field.at(centres)
    off = field / (true / true.mean())[:, None] - 1
    far = np.argsort(-np.linalg.norm(centres - np.array(PAGE) / 2, axis=1))[:80]
    assert np.sqrt((off[far] ** 2).mean(axis=0)).max() < 0.003
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.0006


@pytest.mark.slow
@pytest.mark.parametrize("level", [60.0, 300.0])
def test_dim_light_has_no_more_noise_than_a_few_terms_bring(level: float) -> None:
    """Without a base: sixth order alone has .67 % at 60 counts and BIC's choice .8 %, of which most was its bias."""
    random = np.random.default_rng(18)
    places, centres = random.random((467, 2)) * PAGE, random.random((8000, 2)) * PAGE
    true = lit(centres, 0.52, (0.0, 0.0), rim=False)
    off: list[float] = []
    for _ in range(10):
        seen = level * lit(places, 0.52, (0.0, 0.0), rim=False)[:, None] * np.ones(3)
        noise = np.asarray(np.sqrt(seen / 1.8 + 36) / 5, dtype=np.float64)
        field = PaperReader(places, centres, PAGE).read(seen + noise * random.normal(0, 1, seen.shape))[0].field
        left = field.at(centres) / (true / true.mean())[:, None] - 1
        off.append(float((left * left).mean()))
    relative = float((level / 1.8 + 36) ** 0.5) / 5 / level
    # Twelve terms of three channels' references, and one of each channel's own.
    assert float(np.mean(off)) < (1.5 * relative) ** 2 * (12 / 3 + 1) / 467


def test_a_hand_in_a_corner_is_no_fall_off() -> None:
    """A twelfth of the references is dark in one frame; the field of the others is its base, and stays."""
    random = np.random.default_rng(21)
    even = 6000 * falloff(PLACES)
    base = read_paper(even + random.normal(0, 12, even.shape)).field
    seen = even + random.normal(0, 12, even.shape)
    seen[np.linalg.norm(PLACES - PAGE, axis=1) < 115] *= 0.2
    found = read_paper(seen, base)
    expected = falloff(CENTRES) / falloff(CENTRES).mean(axis=0)
    assert np.abs(found.field.at(CENTRES) / expected - 1).max() < 0.01
    assert np.linalg.norm(np.array(found.left.at_mm) - PAGE) < 115
    assert found.left.deviation == pytest.approx((-0.8, -0.8, -0.8), abs=0.02)
    assert 0.03 < found.left.share < 0.15


def test_references_in_the_margin_give_no_shape_that_vanishes_there() -> None:
    """The light bends by 4 % in the middle, which the base knows; noise in the margin must not undo it."""
    side = RANDOM.random((300, 2)) * PAGE
    side[:150, 1] = np.where(RANDOM.random(150) < 0.5, 0.02, 0.98) * PAGE[1]
    side[150:, 0] = np.where(RANDOM.random(150) < 0.5, 0.02, 0.98) * PAGE[0]
    base = PaperReader(PLACES, CENTRES, PAGE).read(falloff(PLACES) * 5000)[0].field
    x, y = (2 * side / PAGE - 1).T
    seen = falloff(side) * 3000 * (1 + 0.02 * x - 0.01 * y * y)[:, None] * RANDOM.normal(1, 0.002, (300, 3))
    # A smear on some, as margins have them.
    seen[:12] *= 0.97
    u, v = (2 * CENTRES / PAGE - 1).T
    true = falloff(CENTRES) * (1 + 0.02 * u - 0.01 * v * v)[:, None]
    true /= true.mean(axis=0)
    field = PaperReader(side, CENTRES, PAGE, base, MAX_ORDER_AROUND).read(seen)[0].field
    assert max(order_of(len(factors[-1])) for factors in field.coefficients) <= MAX_ORDER_AROUND
    assert np.abs(field.at(CENTRES) / true - 1).max() < 0.01
