"""What is said of light and print, by numbers, of light and patches that are made up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.check.light_and_print import (
    LIGHT_ORDER,
    PrintState,
    Spot,
    judge_evenness,
    judge_flicker,
    judge_primaries,
    judge_print,
    judge_room_light,
    light_share,
    measure_print,
)
from acquisition.check.places import Levels
from experiment.chart.layout import design_chart

Array = npt.NDArray[np.float64]
CHART = design_chart(2)
WIDTH, HEIGHT = CHART.page_mm
REFERENCES = np.array([reference.centre_mm for reference in CHART.references])
PATCHES = np.concatenate([CHART.centres_mm, REFERENCES])


@dataclass(frozen=True)
class Light:
    """Light as a function (N, 3) of shares (N, 2) of the page."""

    of: Callable[[Array], Array]

    def at(self, points_mm: npt.ArrayLike) -> Array:
        return self.of(np.asarray(points_mm, dtype=np.float64) / CHART.page_mm)


EVEN = Light(lambda at: np.ones((len(at), 3)))


def test_evenness_is_what_is_missing_at_the_darkest_cell_and_changes_of_colour_are_ratios() -> None:
    # Red falls to the right, green to the bottom, blue nowhere.
    light = Light(lambda at: np.stack([1 - 0.5 * at[:, 0], 1 - 0.7 * at[:, 1], np.ones(len(at))], axis=1))
    even, coloured = judge_evenness(light, CHART)
    left, top = CHART.centres_mm.min(axis=0) / CHART.page_mm
    right, bottom = CHART.centres_mm.max(axis=0) / CHART.page_mm
    red = 1 - (1 - 0.5 * right) / (1 - 0.5 * left)
    green = 1 - (1 - 0.7 * bottom) / (1 - 0.7 * top)
    assert even.details["falloff"] == pytest.approx([red, green, 0])
    assert even.value == pytest.approx(green)
    middle = np.array([0.75, 0.65, 1.0])
    corners = {"top left": (left, top), "top right": (right, top), "bottom left": (left, bottom)}
    for name, (x, y) in corners.items():
        seen = np.array([1 - 0.5 * x, 1 - 0.7 * y, 1]) / middle
        assert even.details["corners_of_centre"][name] == pytest.approx(seen.tolist())
    assert even.details["darkest_mm"][1] == pytest.approx(bottom * HEIGHT)
    x, y = (CHART.centres_mm / CHART.page_mm).T
    ratio = (1 - 0.5 * x) / (1 - 0.7 * y)
    assert coloured.details["red_over_green"] == pytest.approx(ratio.max() / ratio.min() - 1)
    assert coloured.details["blue_over_green"] == pytest.approx((1 - 0.7 * top) / (1 - 0.7 * bottom) - 1)
    assert coloured.value == max(coloured.details["red_over_green"], coloured.details["blue_over_green"])
    shares = light_share(light, [(0, 0), (WIDTH, 0), (0, HEIGHT)])
    np.testing.assert_allclose(shares, [[1, 1, 1], [0.5, 1, 1], [1, 0.3, 1]])


@pytest.mark.parametrize(
    ("muted_share", "own", "said"),
    [
        (0.001, 0.019, "of it the projector's black"),
        (0.015, 0.005, "with the picture muted"),
        (None, None, "told apart"),
    ],
)
def test_room_light_is_that_of_the_brightest_area_and_channel(
    muted_share: float | None, own: float | None, said: str
) -> None:
    white = np.full((len(PATCHES), 3), 4000.0)
    white[::7] = 250
    dark = 0.002 * white
    # Two hundredths of white in blue at the right; a dim patch may have any.
    across, down = (PATCHES / CHART.page_mm).T
    lit = (across > 0.8) & (down > 1 / 3) & (down < 2 / 3)
    dark[lit, 2] = 80.0
    dark[::7] = 200
    muted = None if muted_share is None else muted_share * white
    found = judge_room_light(CHART, PATCHES, white, dark, muted, "no remote control")
    assert found.value == pytest.approx(0.02)
    assert found.details["where"] == "the middle far right"
    assert said in found.said
    if own is not None:
        assert (found.details["muted"], found.details["projector"]) == pytest.approx((muted_share, own))
    assert judge_room_light(CHART, PATCHES, 0.05 * white, dark, muted, "").grade == "not checked"


def test_primaries_are_held_against_white_without_the_black_that_each_has() -> None:
    black = np.array([10.0, 20.0, 30.0])
    seen = np.array([[800.0, 100, 50], [150, 1500, 200], [40, 300, 900]])
    alone = dict(zip(("red", "green", "blue"), seen, strict=True))
    whole = seen.sum(axis=0) - 2 * black
    white = whole / [1.02, 0.97, 1.0]
    brightest, additive = judge_primaries({**alone, "white": white, "black": black}, plan_has=True)
    assert additive.details["by_channel"] == pytest.approx([0.02, -0.03, 0.0], abs=1e-9)
    assert additive.value == pytest.approx(-0.03)
    assert "3.0 % below white" in additive.said
    assert brightest.value == max(800 / white[0], 1500 / white[1], 900 / white[2])


def test_flicker_and_brightness_are_those_between_repeated_frames() -> None:
    white = np.array([3000.0, 7000.0, 4000.0])
    ratios = np.array([0, 0.01, -0.01, 0.02, 0, -0.02])
    angle, bright = judge_flicker([white * (1 + ratio, 1, 1) for ratio in ratios], 0.5)
    turned = [white * (1 + ratio, 1, 1) for ratio in ratios]
    cosines = [one @ white / np.linalg.norm(one) / np.linalg.norm(white) for one in turned]
    assert angle.value == pytest.approx(np.degrees(np.arccos(min(cosines))))
    assert "standard deviation of 1.4 %" in angle.said
    assert bright.value == pytest.approx(0.04)
    assert bright.details["counts"] == [7000.0] * 6


def of_codes(counts: float = 6000.0) -> Levels:
    """Return what references of equal codes show alike."""
    codes = np.array([reference.rgb for reference in CHART.references]) / 255
    return Levels(counts * (0.1 + 0.9 * codes), np.zeros(len(codes), dtype=np.bool_))


def test_a_reference_that_is_not_as_others_of_its_code_is_off() -> None:
    references, cells = of_codes(), Levels(np.full((64, 3), 3000.0), np.zeros(64, dtype=np.bool_))
    white = [number for number, reference in enumerate(CHART.references) if reference.is_white]
    references.mean[white[3]] *= (0.95, 0.9, 0.85)
    state = measure_print(CHART, cells, references, EVEN)
    assert np.flatnonzero(state.off).tolist() == [white[3]]
    (spot,) = state.spots
    assert (spot.centre_mm, spot.patches) == (pytest.approx(CHART.references[white[3]].centre_mm), 1)
    assert spot.deviation == pytest.approx(-0.15)
    assert spot.size_mm == pytest.approx(2 * (WIDTH * HEIGHT / len(REFERENCES) / np.pi) ** 0.5)
    assert (spot.crease, spot.width_mm, spot.angle_deg) == (False, spot.size_mm, 0)
    found = judge_print(state, CHART, 1.0)
    assert found.grade == "remark"
    assert found.value == pytest.approx(1 / len(REFERENCES))
    assert "15 % darker" in found.said
    assert "is not seen on a chart of few colours" in found.said
    clean = judge_print(measure_print(CHART, cells, of_codes(), EVEN), CHART, 1.0)
    assert (clean.grade, clean.value) == ("good", 0.0)
    assert judge_print(state, CHART, 0.49).grade == "not checked"


@pytest.mark.slow
def test_cells_that_are_off_together_are_one_spot_and_in_a_row_a_crease() -> None:
    chart = design_chart(3)
    codes = np.stack(np.unravel_index(np.arange(512), (8, 8, 8)), axis=1) / 7
    level = np.zeros((512, 3))
    # The light falls off towards the edge, even along both axes, which references cannot show.
    at = 2 * chart.centres_mm / chart.page_mm - 1
    level[chart.cell_of_colour] = 500 + 5000 * codes**1.3
    level *= (1 - 0.05 * (at**LIGHT_ORDER).sum(axis=1))[:, None]
    middle = chart.centres_mm[np.argmin(np.linalg.norm(at - (0.4, 0.1), axis=1))]
    stained = np.linalg.norm(chart.centres_mm - middle, axis=1) < 2.6 * chart.cell_mm[0]
    level[stained] *= (0.95, 0.85, 0.75)
    folded = (np.abs(chart.centres_mm[:, 1] - chart.centres_mm[:, 1].max()) < 1.5 * chart.cell_mm[1]) & (at[:, 0] < 0)
    level[folded] *= 1.25
    nowhere = Levels(np.zeros((len(chart.references), 3)), np.ones(len(chart.references), dtype=np.bool_))
    light = Light(EVEN.of)
    state = measure_print(chart, Levels(level, np.zeros(512, dtype=np.bool_)), nowhere, light)
    assert not state.by_references
    by_place = sorted(state.spots, key=lambda spot: spot.crease)
    assert [spot.crease for spot in by_place] == [False, True]
    stain, crease = by_place
    assert stain.centre_mm == pytest.approx(tuple(chart.centres_mm[stained].mean(axis=0)), abs=3)
    assert stain.patches == pytest.approx(stained.sum(), rel=0.35)
    assert stain.deviation == pytest.approx(-0.25, abs=0.08)
    assert crease.deviation == pytest.approx(0.25, abs=0.08)
    assert min(crease.angle_deg, 180 - crease.angle_deg) < 5
    assert crease.width_mm == pytest.approx(2 * chart.cell_mm[1], rel=0.3)


def test_four_spots_are_named_and_more_are_counted() -> None:
    spots = tuple(Spot((10.0 * n, 20.0), 5.0, 2, 0.07, False, 5.0, 0.0) for n in range(6))
    state = PrintState(PATCHES, np.zeros(len(PATCHES)), np.zeros(len(PATCHES), dtype=np.bool_), spots, False)
    found = judge_print(state, CHART, 1.0)
    assert found.said.count("7.0 % brighter") == 4
    assert "; and 2 more, " in found.said
    assert found.value == pytest.approx(12 / len(PATCHES))
    unknown = PrintState(PATCHES, np.full(len(PATCHES), np.nan), state.off, (), False)
    assert judge_print(unknown, CHART, 1.0).grade == "not checked"
