"""Every number of a comparison of two small tables, against a computation of its own."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from calibration.comparison import comparing
from calibration.comparison.comparing import (
    CELL_FLOOR,
    CellDifferences,
    LightDifferences,
    differing_cells,
    differing_lights,
)

_Array = npt.NDArray[np.float64]

WHITE = np.array([[9000.0, 8000, 7000], [6000, 250, 4000], [50, 60, 40], [8000, 8000, 200]])
OTHER = np.array([[9090.0, 8000, 7070], [6060, 400, 4100], [55, 66, 44], [8200, 8100, 900]])
ERRORS = np.array([[90.0, 40, 70], [30, 10, 20], [5, 2, 1], [80, 60, 10]])
PAIRS = [(light, light) for light in range(4)]


def table(folder: Path, white: _Array, errors: _Array, samples: int, unfit: int) -> Any:
    """Return what is compared of a table of eight colours, some of which are dark."""
    folder.mkdir()
    rows = [f"{light},white,{','.join(map(str, row))}" for light, row in enumerate(errors.tolist())]
    (folder / "references.csv").write_text("\n".join(["light,name,r_error,g_error,b_error", *rows, ""]))
    random = np.random.default_rng(samples)
    means = np.linspace(0.02, 0.9, 8)[:, None] * white[:, None]
    counts = random.normal(means[:, :, None], 3.0, (len(white), 8, samples, 3)).clip(0)
    # One cell without any scatter: integers have that of rounding.
    counts[0, 5] = 4000 + samples
    return SimpleNamespace(
        folder=folder,
        white=white,
        samples=np.rint(counts).astype(np.uint16),
        provenance=SimpleNamespace(unfit=[SimpleNamespace(colour=unfit)]),
        require_unchanged=lambda light: None,  # pyrefly: ignore[implicit-any-lambda]
    )


@pytest.fixture
def tables(tmp_path: Path) -> tuple[Any, Any]:
    return table(tmp_path / "one", WHITE, ERRORS, 4, 6), table(tmp_path / "other", OTHER, 2 * ERRORS, 9, 7)


def test_lights_differ_in_colour_and_brightness_with_a_chance(tables: tuple[Any, Any]) -> None:
    lights = comparing._compare_lights(*tables, PAIRS, np.zeros(4))
    for light in range(4):
        a, b = WHITE[light], OTHER[light]
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        assert lights.angle_deg[light] == pytest.approx(np.degrees(np.arccos(cosine)))
        # Least squares of a common ratio of three channels: its estimate, and χ² of what it leaves.
        variance = 1.3**2 * ((ERRORS[light] / a) ** 2 + (2 * ERRORS[light] / b) ** 2)
        ratio = np.log(b / a)
        mean, weight = np.average(ratio, weights=1 / variance, returned=True)
        assert lights.brightness[light] == pytest.approx(np.exp(mean) - 1)
        assert lights.angle_p[light] == pytest.approx(stats.chi2.sf(((ratio - mean) ** 2 / variance).sum(), 2))
        assert lights.brightness_p[light] == pytest.approx(2 * stats.norm.sf(abs(mean) * np.sqrt(weight)))


def test_cells_differ_over_their_own_whites_in_units_of_their_noise(
    tables: tuple[Any, Any],
) -> None:
    one, other = tables
    cells, scores = comparing._compare_cells(one, other, PAIRS, lambda done, total: None)
    # By Welch and Satterthwaite, 4 and 9 samples of one variance have so many freedoms.
    freedoms = (1 / 4 + 1 / 9) ** 2 / ((1 / 4) ** 2 / 3 + (1 / 9) ** 2 / 8)
    widening = float(stats.t(freedoms).std())
    share, variance = np.full((4, 8, 3), np.nan), np.full((4, 8, 3), np.nan)
    for light, colour, channel in np.ndindex(4, 6, 3):
        seen = [each.samples[light, colour, :, channel].astype(float) for each in (one, other)]
        if min(values.mean() for values in seen) > 300:
            a, b = (values.mean() / each.white[light, channel] for values, each in zip(seen, (one, other), strict=True))
            share[light, colour, channel] = b / a - 1
            variance[light, colour, channel] = sum(
                max(values.var(ddof=1), 1 / 12) / len(values) / values.mean() ** 2 for values in seen
            )
    score = share / np.sqrt(variance) / widening
    there = np.isfinite(share)
    assert 20 < there.sum() < 60
    assert np.isnan(scores[2]), "nothing is bright enough under the third light"
    for light in (0, 1, 3):
        assert scores[light] ** 2 == pytest.approx((score**2)[light][there[light]].mean())
    count = there.sum(axis=0)
    np.testing.assert_array_equal(cells.lights, count)
    known = count > 0
    np.testing.assert_array_equal(np.isfinite(cells.mean), known)
    np.testing.assert_allclose(cells.mean[known], np.nansum(share, axis=0)[known] / count[known])
    np.testing.assert_allclose(cells.noise[known], np.sqrt(np.nansum(variance, axis=0)[known]) / count[known])
    overall = np.sqrt([np.nanmean(score**2), np.nanmean(share**2), np.nanmean(variance)])
    assert [cells.score, cells.rms, cells.rms_by_noise] == pytest.approx(overall)
    assert cells.offset == pytest.approx([np.nanmean(share[..., channel]) for channel in range(3)])


def lights_with(count: int = 4, **more: npt.ArrayLike) -> LightDifferences:
    """Return lights that do not differ, but for what is given."""
    plain = {name: np.zeros(count) for name in ("angle_deg", "brightness", "cell_score")}
    plain |= {name: np.ones(count) for name in ("angle_p", "brightness_p")}
    given = plain | {name: np.asarray(value, dtype=np.float64) for name, value in more.items()}
    number = np.arange(count) + 10
    return LightDifferences(one=number, other=number, **given)


def cells_with(mean: _Array, noise: float, score: float = 1.0) -> CellDifferences:
    """Return cells that differ by means (C, 3) of a noise."""
    count = np.ones(mean.shape, dtype=np.int64)
    return CellDifferences(count, mean, np.full(mean.shape, noise), np.array([0.1, 0, 0]), 0, 0, score)


def test_what_differs_is_beyond_noise_and_beyond_what_is_called_none() -> None:
    # A chance of one in a hundred in any of four lights.
    lights = lights_with(angle_deg=[0.0051, 0.0049, 0.02, 0.03], angle_p=[0.0024, 0.0024, 0.0026, 0.0024])
    assert differing_lights(lights).tolist() == [10, 13]
    # Six standard errors and the two per cent of a stain, less the offset of all.
    assert CELL_FLOOR == 0.02
    mean = np.array(
        [[0.1, 0, CELL_FLOOR * 1.01], [0.1 - 2 * CELL_FLOOR, 0, 0], [0.1, 0.99 * CELL_FLOOR, 0], [0.1, 0, 0]]
    )
    assert differing_cells(cells_with(mean, CELL_FLOOR / 6.1)).tolist() == [1, 0]
    assert differing_cells(cells_with(mean, 1.05 * CELL_FLOOR / 6)).tolist() == [1]
    assert differing_cells(cells_with(0 * mean + [0.1, 0, 0], 1e-9)).tolist() == []


@pytest.mark.parametrize(
    ("off", "chance", "same"), [(0.0019, 1e-9, True), (-0.0021, 0.0024, False), (0.0021, 0.0026, True)]
)
def test_brightness_is_the_same_within_noise_or_its_floor(off: float, chance: float, same: bool) -> None:
    lights = lights_with(brightness=[off, 0, 0, 0], brightness_p=[chance, 1, 1, 1])
    assert comparing._brightness_answer(lights).same_within_noise is same


def test_the_interval_of_the_median_holds_it_and_a_single_light_has_none() -> None:
    one = comparing._brightness_answer(lights_with(1, brightness=[0.015]))
    assert "+1.500 % on the median (95 % interval +1.500 to +1.500 %)" in one.said
    many = comparing._brightness_answer(lights_with(101, brightness=np.linspace(-0.01, 0.03, 101)))
    # Ranks 41 and 61 of the 101 lights, by the binomial distribution: +0.6 to +1.4 %.
    low, high = map(float, re.findall(r"interval (\S+) to (\S+) %", many.said)[0])
    assert (low, high) == pytest.approx((0.6, 1.4), abs=0.05)


@pytest.mark.parametrize(("score", "of_light", "same"), [(1.1, 1.3, True), (1.11, 1.3, False), (1.1, 1.31, False)])
def test_cells_are_the_same_up_to_their_scores(score: float, of_light: float, same: bool) -> None:
    calm = cells_with(np.tile([0.1, 0, 0], (4, 1)), 1e-9)
    lights = lights_with(cell_score=[0, of_light, 0, 0])
    assert comparing._cells_answer(lights, replace(calm, score=score)).same_within_noise is same
