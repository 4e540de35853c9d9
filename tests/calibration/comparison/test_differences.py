"""Every number of a comparison of two small tables, against a computation of its own."""

from __future__ import annotations

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
    GROUPS,
    CellDifferences,
    LightDifferences,
    answers_of,
    colour_groups,
    differing_cells,
    differing_lights,
    geometry_difference,
    recorded_drift,
)

_Array = npt.NDArray[np.float64]

WHITE = np.array([[9000.0, 8000, 7000], [6000, 250, 4000], [50, 60, 40], [8000, 8000, 200]])
OTHER = np.array([[9090.0, 8000, 7070], [6060, 400, 4100], [55, 66, 44], [8200, 8100, 900]])
ERRORS = np.array([[9.0, 4, 7], [3, 1, 2], [0.5, 0.2, 0.1], [8, 6, 1]])
PAIRS = [(light, light) for light in range(4)]


def table(folder: Path, white: _Array, errors: _Array, samples: int, drift: _Array | None, unfit: int) -> Any:
    """Return what is compared of a table of eight colours, some of which are dark."""
    folder.mkdir()
    rows = [f"{light},white,{','.join(map(str, row))}" for light, row in enumerate(errors.tolist())]
    (folder / "references.csv").write_text("\n".join(["light,name,r_error,g_error,b_error", *rows, ""]))
    random = np.random.default_rng(samples)
    means = np.linspace(0.02, 0.9, 8)[:, None] * white[:, None]
    counts = random.normal(means[:, :, None], 3.0, (len(white), 8, samples, 3)).clip(0)
    # One cell without any scatter: integers have that of rounding.
    counts[0, 5] = 4000 + samples
    done = [] if drift is None else [{"name": "drift", "applied": False, "per_light": drift.tolist()}]
    provenance = SimpleNamespace(unfit=[SimpleNamespace(colour=unfit)], corrections=done)
    return SimpleNamespace(
        folder=folder,
        white=white,
        samples=np.rint(counts).astype(np.uint16),
        provenance=provenance,
        require_unchanged=lambda light: None,  # pyrefly: ignore[implicit-any-lambda]
    )


@pytest.fixture
def found(tmp_path: Path) -> tuple[Any, Any, LightDifferences, CellDifferences]:
    drift = np.array([[1.0, 1, 1], [1.01, 1.02, 1.01], [1.1, 1.1, 1.1], [0.98, 0.97, 0.99]])
    one = table(tmp_path / "one", WHITE, ERRORS, 4, drift, 6)
    other = table(tmp_path / "other", OTHER, 2 * ERRORS, 9, None, 7)
    return one, other, *comparing._differences(one, other, PAIRS, None)


def test_lights_differ_by_angle_and_length_in_units_of_their_errors(
    found: tuple[Any, Any, LightDifferences, CellDifferences],
) -> None:
    one, _, lights, _ = found
    for light in range(4):
        a, b = WHITE[light], OTHER[light]
        size_a, size_b = np.linalg.norm(a), np.linalg.norm(b)
        difference = b / size_b - a / size_a
        assert lights.angle_deg[light] == pytest.approx(np.degrees(2 * np.arcsin(np.linalg.norm(difference) / 2)))
        along = a / size_a + b / size_b
        along /= np.linalg.norm(along)
        covariance = np.diag((ERRORS[light] / size_a) ** 2 + (2 * ERRORS[light] / size_b) ** 2)
        across = np.eye(3) - np.outer(along, along)
        plane = across @ covariance @ across
        assert lights.angle_noise_deg[light] == pytest.approx(np.degrees(np.sqrt(np.trace(plane))))
        inverse = np.linalg.pinv(plane, rcond=1e-9)
        assert lights.angle_score[light] ** 2 == pytest.approx(difference @ inverse @ difference / 2)
        assert lights.brightness[light] == pytest.approx(size_b / size_a - 1)
        assert lights.brightness_noise[light] == pytest.approx(np.sqrt(along @ covariance @ along))
    drift = np.array(one.provenance.corrections[0]["per_light"])
    steady = np.linalg.norm(OTHER, axis=1) / np.linalg.norm(WHITE / drift, axis=1)
    assert lights.brightness_left == pytest.approx(steady / np.median(steady) - 1)
    # A channel counts that has a twentieth of the largest of its own light in both tables, however dim the light.
    ratio = OTHER / WHITE
    expected = [np.median(ratio[:, 0]), np.median(ratio[[0, 2, 3], 1]), np.median(ratio[:3, 2])]
    assert lights.gains == pytest.approx(expected)


def test_cells_differ_over_their_own_whites_in_units_of_their_noise(
    found: tuple[Any, Any, LightDifferences, CellDifferences],
) -> None:
    one, other, lights, cells = found
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
    assert np.isnan(lights.cell_rms[2]), "nothing is bright enough under the third light"
    for light in (0, 1, 3):
        for seen, values in ((lights.cell_rms, share**2), (lights.cell_noise, variance), (lights.cell_score, score**2)):
            assert seen[light] ** 2 == pytest.approx(values[light][there[light]].mean())
    count = there.sum(axis=0)
    np.testing.assert_array_equal(cells.lights, count)
    known = count > 0
    np.testing.assert_array_equal(np.isfinite(cells.mean), known)
    np.testing.assert_allclose(cells.mean[known], np.nansum(share, axis=0)[known] / count[known])
    np.testing.assert_allclose(cells.spread[known], np.nanstd(share[:, known], axis=0), atol=1e-9)
    np.testing.assert_allclose(cells.noise[known], np.sqrt(np.nansum(variance, axis=0)[known]) / count[known])
    filled = np.where(there, score, 0)
    worst = np.abs(filled).argmax(axis=0)
    np.testing.assert_array_equal(cells.worst_light, np.where(known, worst, -1))
    np.testing.assert_allclose(cells.worst[known], np.take_along_axis(filled, worst[None], axis=0)[0][known])
    np.testing.assert_allclose(cells.worst_share[known], np.take_along_axis(share, worst[None], axis=0)[0][known])
    overall = np.sqrt([np.nanmean(score**2), np.nanmean(share**2), np.nanmean(variance)])
    assert [cells.score, cells.rms, cells.predicted_rms] == pytest.approx(overall)
    assert cells.beyond_noise == pytest.approx(np.sqrt(overall[1] ** 2 - overall[2] ** 2))
    assert cells.offset == pytest.approx([np.nanmean(share[..., channel]) for channel in range(3)])
    assert (cells.unfit_one, cells.unfit_other) == ((6,), (7,))


def test_groups_of_colours_are_halves_of_each_channel_s_code(
    found: tuple[Any, Any, LightDifferences, CellDifferences],
) -> None:
    random = np.random.default_rng(2)
    mean = random.normal(0, 0.01, (64, 3))
    mean[[3, 40]] = np.nan
    # Of two bits a channel: red is the first digit of base four, and the upper half of each is 2 and 3.
    codes = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1)
    mean[(codes < 2).all(axis=1)] = np.nan
    for number, group in enumerate(colour_groups(replace(found[3], mean=mean), 2)):
        assert group.name == GROUPS[number]
        halves = [bool(number & bit) for bit in (4, 2, 1)]
        here = np.flatnonzero(((codes >= 2) == halves).all(axis=1) & np.isfinite(mean).all(axis=1))
        assert group.cells == len(here)
        if number == 0:
            assert group.worst_colour == -1
            continue
        assert (group.mean, group.spread) == pytest.approx((mean[here].mean(), mean[here].std()))
        place = np.unravel_index(np.abs(mean[here]).argmax(), (len(here), 3))
        assert group.worst_colour == here[place[0]]
        assert group.worst == mean[here][place]


def lights_with(count: int = 4, **more: npt.ArrayLike) -> LightDifferences:
    """Return lights that do not differ, but for what is given."""
    none = np.zeros(count)
    plain: dict[str, _Array] = dict.fromkeys(
        ("angle_deg", "angle_noise_deg", "angle_score", "brightness", "brightness_left", "brightness_noise",
         "cell_rms", "cell_noise", "cell_score"), none,
    )  # fmt: skip
    given = plain | {name: np.asarray(value, dtype=np.float64) for name, value in more.items()}
    number = np.arange(count) + 10
    return LightDifferences(one=number, other=number, gains=np.ones(3), **given)


def cells_with(mean: _Array, noise: float, score: float = 1.0) -> CellDifferences:
    """Return cells that differ by means (C, 3) of a noise."""
    none, one = np.zeros_like(mean), np.ones(mean.shape, dtype=np.int64)
    return CellDifferences(one, mean, none, none + noise, none, one, none, (), (), score, 0, 0, np.array([0.1, 0, 0]))


def test_what_is_beyond_noise_is_beyond_both_its_errors_and_what_is_called_none() -> None:
    # χ² of two freedoms over two, with the errors' own error, at a chance of one in a hundred in any of four lights.
    most = 1.3 * np.sqrt(float(stats.chi2(2).isf(0.01 / 4)) / 2)
    lights = lights_with(
        angle_deg=[0.0051, 0.0049, 0.02, 0.03], angle_score=[1.01 * most, 1.01 * most, 0.99 * most, 1.01 * most]
    )
    assert differing_lights(lights).tolist() == [3, 0]
    # Six standard errors and the two per cent of a stain, less the offset of all.
    assert CELL_FLOOR == 0.02
    mean = np.array(
        [[0.1, 0, CELL_FLOOR * 1.01], [0.1 - 2 * CELL_FLOOR, 0, 0], [0.1, 0.99 * CELL_FLOOR, 0], [0.1, 0, 0]]
    )
    assert differing_cells(cells_with(mean, CELL_FLOOR / 6.1)).tolist() == [1, 0]
    assert differing_cells(cells_with(mean, 1.05 * CELL_FLOOR / 6)).tolist() == [1]
    assert differing_cells(cells_with(0 * mean + [0.1, 0, 0], 1e-9)).tolist() == []
    calm = cells_with(0 * mean + [0.1, 0, 0], 1e-9)
    limit = most * np.sqrt(2)
    for off, noise, same in (
        (0.0019, 1e-6, True),
        (0.0021, 1e-6, False),
        (0.99 * limit, 1, True),
        (-1.01 * limit, 1, False),
    ):
        brightness = lights_with(brightness=[off, 0, 0, 0], brightness_noise=[noise] * 4)
        assert answers_of(brightness, calm)[1].same is same
    for score, of_light, same in ((1.1, 1.3, True), (1.11, 1.3, False), (1.1, 1.31, False)):
        lights = lights_with(cell_score=[0, of_light, 0, 0])
        assert answers_of(lights, replace(calm, score=score))[2].same is same


def test_what_shift_turn_and_scale_leave_is_a_bend() -> None:
    places = np.array([[0.0, 0], [100, 0], [100, 100], [0, 100], [50, 50]])
    bent = places + np.array([[1.0, 1], [-1, 1], [1, 1], [-1, 1], [0, -4]])
    found = geometry_difference(places, bent)
    assert found.bent_px == pytest.approx(np.sqrt((4 * 2 + 16) / 5), rel=0.02)
    assert found.shift_px == pytest.approx((0, 0))


def test_drift_that_is_applied_or_not_of_these_lights_is_not_used() -> None:
    def drift(gains: npt.ArrayLike, **more: object) -> _Array:
        done = {"name": "drift", "per_light": np.asarray(gains).tolist(), **more}
        lut: Any = SimpleNamespace(white=WHITE, provenance=SimpleNamespace(corrections=[{"name": "black"}, done]))
        return recorded_drift(lut)

    gains = np.linspace(0.9, 1.1, 12).reshape(4, 3)
    np.testing.assert_array_equal(drift(gains), gains)
    for unused in (drift(gains, applied=True), drift(gains[:3]), drift(gains - 0.9), drift(gains, name="field")):
        np.testing.assert_array_equal(unused, np.ones((4, 3)))
