"""Results of each room for made-up inputs, compared with pinned numbers."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from calibration import kernels, sampling
from calibration.causes.rules import RULES, Evidence, Subject, decide, evidence_names
from calibration.checks import light_codes
from calibration.checks.small_places import CoveredPatchFinder, cells_without_hot
from calibration.figures.all_figures import FIGURES
from calibration.radiometry import drift, primaries, table_noise
from calibration.radiometry.dark_frames import HotPixels
from calibration.registration import colours, matching, tiles
from calibration.registration.geometry import Displacement, LateralColour, Lens, fit_lens
from calibration.sampling import photon_transfer
from calibration.spread import added_light, fitting, predicting
from experiment.chart.layout import paper_chart
from tests.calibration.checks.test_frame_consistency import Sheet
from tests.calibration.checks.test_light_codes import SESSIONS, agreement, random_session
from tests.calibration.checks.test_stray_light import measured as stray_found
from tests.calibration.comparison.test_comparing import written
from tests.calibration.radiometry.test_superposition import LEVELS, compressed, measured, proportional, short_of_counts
from tests.calibration.registration.test_matching import CHART, RASTER, compared
from tests.calibration.registration.test_tiles import RASTER as TILED
from tests.calibration.registration.test_tiles import TILE, moved, texture, to_pixels
from tests.calibration.spread.test_added_light import NOISE, PAGE_MM, levels, positions
from tests.calibration.spread.test_fitting import equations
from tests.calibration.spread.test_predicting import ALL, printed_levels
from tests.calibration.whole import brief, of_fields
from tests.pinned import Pinned

_Array = npt.NDArray[np.float64]
# Tolerance for results of iterative fits.
LOOSE = {"same": 1e-4, "nothing": 1e-8}


def test_limits_of_figures(pinned: Pinned) -> None:
    pinned("limits of figures", {one.name: [one.accept, one.refuse] for one in FIGURES})


def test_causes(pinned: Pinned) -> None:
    """Evidence at the limits of every rule, and slightly beyond: number of subjects with its cause."""
    random = np.random.default_rng(1)
    decided: dict[str, list[int]] = {}
    for number, rule in enumerate(RULES):
        result = decided.setdefault(f"{rule.cause.name} {number}", [])
        for by in (0.0, 1e-6, -1e-6):
            at = {one.name: (one.low if np.isfinite(one.low) else one.high) + by for one in rule.conditions}
            beside = {
                name: float(random.choice([0, 0.02, 0.5, 1])) for name in evidence_names() if random.random() < 0.1
            }
            for evidence in (Evidence(**at), Evidence(**(beside | at))):
                result.append(sum(decide(subject, evidence).cause is rule.cause for subject in get_args(Subject)))
    pinned("causes at the limits of the rules", decided)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two", "red and white", "primaries", "eight"])
def test_lights_against_their_codes(name: str, pinned: Pinned) -> None:
    white, error = random_session(SESSIONS[name], len(name))
    result = [agreement(SESSIONS[name], white, error)]
    if name != "eight":
        codes = np.array(SESSIONS[name])
        white[[0, 1]] = white[[1, 0]]
        result.append(light_codes.code_agreement(codes, white, error, dark_known=False, drift_known=True))
        result.append(light_codes.code_agreement(codes, white, error, dark_known=True, drift_known=False))
    pinned(f"lights against their codes, {name}", [brief(one) for one in result], **LOOSE)


def test_stray_light(pinned: Pinned) -> None:
    cases: list[dict[str, Any]] = [
        {},
        {"stray": {4: 0.01}},
        {"stray": {0: 0.01, 1: 0.01, 2: 0.01}},
        {"boost": 0.3},
        {"flicker": 0.01},
    ]
    runs = [stray_found(seed, **more) for seed, more in product((1, 2), cases)]
    pinned("stray light", [[brief(one), one.share, one.lights_beyond(0.002), one.to_json()] for one in runs])


@pytest.mark.slow
def test_frames_against_the_print(pinned: Pinned) -> None:
    sheet = Sheet(7, 32)
    near = np.abs(sheet.places - sheet.places.mean(axis=0)).max(axis=1)
    usable = sheet.random.random(len(near)) < 0.9
    cases = [sheet.other, 0.3 * sheet.other, *(sheet.other * np.where(near < size, left, 1.0)[:, None]
             for size, left in ((30, 0.9), (8, 0.3), (12, 1.5), (60, 0.97)))]  # fmt: skip
    cases += [sheet.other + 200 * (near < 30)[:, None], sheet.random.permutation(sheet.other)]
    pinned("frames against the print", [brief(sheet.compare(true, usable)) for true in cases], **LOOSE)


def test_small_places(pinned: Pinned) -> None:
    sheet, random = Sheet(4, 32), np.random.default_rng(3)
    result: list[Any] = []
    for scale in (1.0, 1.3):
        deviation = scale * random.normal(0, 0.01, (2, len(sheet.places)))
        tree = cKDTree(sheet.places)
        for cells, mismatched in ((2, -0.2), (3, 0.07), (6, -0.05), (1, 0.5), (12, 0.045)):
            deviation[:, tree.query(sheet.places[random.integers(len(sheet.places))], k=cells)[1]] += mismatched
        deviation[1, ::17] = np.nan
        usable = random.random(len(sheet.places)) < 0.95
        one = CoveredPatchFinder(sheet.rgb, sheet.places, usable).disturbed(deviation, np.full_like(deviation, 0.01))
        hot = random.random(len(sheet.places)) < 0.2
        result.append([*one, *cells_without_hot(one[0], one[2], hot, sheet.places)])
    pinned("small places that something covers", result)


@pytest.mark.slow
def test_superposition(pinned: Pinned) -> None:
    kinds: list[dict[str, Any]] = [
        {},
        {"boost": 0.01, "noise": 3.0},
        {"lamp": (0.99, 1.0, 1.02), "bits": 2},
        {"bits": 1},
    ]
    runs = {
        f"{sensor.__name__} {more}": measured(sensor, **more)
        for sensor in (proportional, compressed, short_of_counts)
        for more in kinds
    }
    numbers = {
        name: [brief(one), *map(brief, one.relative(LEVELS)), brief(one.errors(LEVELS, LEVELS[::-1])), one.to_json(),
               *map(brief, one.difference(LEVELS, LEVELS[::-1])), brief(one.white_covariance(LEVELS[:3] * np.eye(3)))]
        for name, one in runs.items()
    }  # fmt: skip
    pinned("superposition of three sensors", numbers, **LOOSE)


def test_the_lamp_s_drift(pinned: Pinned) -> None:
    at, every = np.linspace(-50, 4000, 60), np.array([0.0, 300, 900, 1000, 2500, 3600])
    lamp = 1 + 0.01 * np.random.default_rng(2).standard_normal((6, 3))
    white = np.array([3000.0, 7000.0, 4000.0]) * lamp
    samples = np.random.default_rng(3).integers(0, 16000, (5, 25, 3)).astype(np.uint16)
    pinned(
        "drift of a lamp",
        [
            [drift.drift_correction(at, every[:n], white[:n]) for n in (2, 3, 6)],
            [drift.drift_uncertainty(at[:n], every, white) for n in (5, 30, 60)],
            primaries.drift_gains(at, every, white),
            [drift.corrected(samples, np.array([0.93, 0.99, 1.0])), drift.applied_drift(lamp / lamp.max())],
        ],
    )


def test_noise(pinned: Pinned) -> None:
    random, result = np.random.default_rng(8), []
    for cells, samples, response in ((3000, 25, 0.004), (512, 25, 0.0), (40, 9, 0.01), (12, 81, 0.004)):
        level = np.exp(random.uniform(np.log(15), np.log(9000), (cells, 3)))
        variance = np.array([36.0, 18, 30]) + level / [1.8, 3.6, 1.9] + (response * level) ** 2
        seen_there = level[:, None] + np.sqrt(variance)[:, None] * random.standard_normal((cells, samples, 3))
        seen_there[: cells // 20, : samples // 2] *= 1.1
        one = photon_transfer(seen_there.mean(axis=1), seen_there.var(axis=1, ddof=1), samples)
        noise = sampling.sample_noise(seen_there)
        result.append([brief(one), one.noisy.nonzero()[0], brief(one.variance(level)), brief(noise)])
        result.append(
            [brief(sampling.unevenness(seen_there, noise)), *map(brief, sampling.rim_difference(seen_there, noise))]
        )
        result.append([brief(one) for one in sampling.noise_levels(level[:, 1], variance[:, 1], samples)])
    sizes = list(product((7.9, 8.6, 10.0, 12.4, 17.0), (0.3, 0.5, 0.7, 1.1)))
    windows = [sampling.largest_window(*size) for size in sizes]
    shares = [sampling.bleed(*size, window) for size in sizes for window in (3, 5, 7)]
    means = [
        sampling.mean_bleed(cell, np.array([0.2, 0.5, 0.9, 2.0]), window) for cell in (8.0, 11.0) for window in (3, 5)
    ]
    medians = [sampling.median_of_variance(degrees) for degrees in (1, 2, 8, 24, 80)]
    pinned("noise of samples and light of neighbours", [result, windows, shares, means, medians], **LOOSE)


@pytest.mark.slow
def test_values_among_their_neighbours(pinned: Pinned) -> None:
    values = np.array([5.0, 1, 9, 3, np.nan, 7, 2, 8, np.nan, np.nan])
    around = np.array([[n, *((n + k) % 10 for k in (1, 2, 4, 5))] for n in range(10)])
    out = np.empty(10)
    kernels.clipped_to_neighbours(values, around, out)
    few = np.empty(10)
    kernels.clipped_to_neighbours(values, np.ascontiguousarray(around[:, :3]), few)
    pinned("values among their neighbours", [out, few])


def test_dark_frames(pinned: Pinned) -> None:
    random, hot = np.random.default_rng(5), HotPixels.start(40, 25)
    for _ in range(5):
        excess = random.normal(0, 6, (40, 25, 3))
        excess[7, 3] += 90
        excess[9, 5, 1] += 33
        hot = hot.with_frame(np.rint(excess).astype(np.int16))
    noise = np.array([6.0, 4.2, 6.0])
    pinned("hot photosites of dark frames", [brief(hot.hottest(noise)), brief(hot.restarted(noise).hottest(noise))])


class Followed:
    """A displacement with its own error."""

    def errors_px(self, points: _Array, information: _Array, at: _Array) -> _Array:
        return 0.02 + 1e-4 * at[:, 0] + 1e-9 * float(information.sum()) + 0 * points[: len(at), 0]


def test_places_of_cells(pinned: Pinned) -> None:
    rows, columns = RASTER.shape
    random = np.random.default_rng(11)
    shift = np.stack(np.meshgrid(np.linspace(-0.3, 0.2, columns), np.linspace(0, 0.4, rows)), axis=-1)
    result: list[Any] = []
    for strength, noise in ((100.0, 0.0), (1e4, 0.05), (1.0, 0.5)):
        comparison = compared(shift + random.normal(0, noise, shift.shape), strength)
        anchors = np.array([[1.0, 2.0]]), np.eye(2)[None]
        blocks = [
            matching.fit_blocks(comparison, RASTER, 1, CHART, size, known) for size in (6, 9) for known in (False, True)
        ]
        followed: Any = Followed()
        errors = [
            matching.place_errors(comparison, RASTER, 1, followed, anchors, 0.01, alike) for alike in (False, True)
        ]
        result.append([*map(brief, blocks), *(brief(one.error_px) for one in errors)])
    marks = random.uniform(0, 100, (300, 2))
    unfollowed = matching.unfollowed_wave_sigma_px(marks[:40] + 0.5, marks, random.normal(0, 0.2, (300, 2)), 0.7, 20.0)
    pinned("places of cells", [result, brief(unfollowed)], **LOOSE)


@pytest.mark.slow
def test_tiles(pinned: Pinned) -> None:
    image = texture()
    seen_there = np.float32(0.7) * moved(image, 0.4, -0.3) + np.float32(100)
    weight = np.ones(TILED.shape, dtype=np.float32)
    weight[30:60, 20:90] = 0
    result: list[Any] = []
    for size, window, without in ((TILE, 80, False), (TILE, 40, True), (16, 64, False)):
        one = tiles.compare_tiles(TILED, size, image, seen_there, weight, window, to_pixels, 10.0, without)
        result.append([brief(one), brief(one.weakened(3)), brief(one.after(one.pull * 0 + 0.1))])
    blocks = tiles.find_blocks(TILED, image, seen_there, weight > 0.5, 40, 6, 64)
    jacobians = tiles.jacobians(lambda points: points**2 / 50, np.array([[3.0, 4.0], [50, 9]]), np.array([0.5, 2.0]))
    match = ndimage.gaussian_filter(np.random.default_rng(1).random((9, 11)), 1.5)
    pinned(
        "tiles of a picture that moved",
        [result, brief(blocks), jacobians, *tiles._peak(match), brief(tiles.box_mean(image[..., 0], 5)),
         brief(tiles.sums_of(image[..., 1], 7)), brief(tiles.tile_middles(image[..., 2], 7))],
        **LOOSE,
    )  # fmt: skip


@pytest.mark.slow
def test_colours_of_a_print(pinned: Pinned) -> None:
    random, result = np.random.default_rng(12), []
    for bits, finely in ((1, False), (2, False), (3, False), (4, True)):
        chart = paper_chart("A4", bits) if bits > 2 else paper_chart("A6", bits)
        points = chart.centres_mm
        light = 1 - 0.1 * (points / chart.page_mm)[:, :1] * (points / chart.page_mm)[:, 1:]
        ink = (0.03 + 0.9 * (chart.rgb / 255.0) ** 2.2) @ np.array([[0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.0, 0.2, 0.8]])
        seen_there = 6000 * ink * light * random.normal(1, 0.004, ink.shape)
        seen_there[::37] *= 0.6
        model = colours.fit_colours(chart.rgb.astype(np.float64), points, seen_there, chart.page_mm, finely)
        expected = model.predict(chart.rgb, points)
        paper = np.full_like(expected, 6000.0)
        mismatched = colours.mismatched(seen_there, expected, paper, chart)
        result.append(
            [
                brief(model),
                brief(expected),
                mismatched.nonzero()[0][:60],
                int(mismatched.sum()),
                colours.agreement(seen_there, expected),
            ]
        )
    pinned("colours of a print", result, **LOOSE)


@pytest.mark.slow
def test_lenses_and_sheets(pinned: Pinned) -> None:
    random, result = np.random.default_rng(13), []
    points = np.stack(np.meshgrid(np.linspace(0, 1189, 7), np.linspace(0, 841, 5)), axis=-1).reshape(-1, 2)
    homography = np.array([[2.0, 0.03, 90], [-0.02, 2.1, 60], [1e-5, -2e-5, 1]])
    lens = Lens(homography, np.array([1300.0, 866]), 1500.0, np.array([-0.05, 0.02, 1e-3, -5e-4]))
    exact = lens.to_pixels(points)
    for noise, count in ((0.0, 35), (0.3, 35), (0.1, 8)):
        fitted, residual = fit_lens(points[:count], exact[:count] + random.normal(0, noise, (count, 2)), (2601, 1733))
        result.append([brief(fitted.to_pixels(points[:count])), brief(residual)])
    result.append([brief(exact), brief(lens.parallax(points))])
    scale = random.uniform(0.5, 2, (len(points), 1, 1)) * 100 * np.eye(2)
    pull = np.einsum("nij,nj->ni", scale, 0.3 * np.sin(points / 150))
    for through, knot in ((None, 120.0), (lens, 120.0), (None, 300.0)):
        sheet = Displacement.over(np.zeros(2), np.array([1189.0, 841]), knot, through)
        for roughness in (0.3, 1.5):
            bent = sheet.fitted(points, scale, pull, roughness)
            error = bent.errors_px(points, scale, points[::3] + 7)
            result.append(
                [brief(bent.at(points - 3)), brief(error), bent.likely_roughness_px(points, scale, roughness)]
            )
    lateral = LateralColour.unmeasured((2601, 1733)).remeasured(
        exact, np.tile(scale, (3, 1, 1, 1)), random.normal(0, 30, (3, *exact.shape))
    )
    shifts = [lateral.shift_px(exact, channel) for channel in ("R", "G", "B")]
    corners = [[lateral.corner_px(channel), lateral.corner_error_px(channel)] for channel in ("R", "B")]
    pinned("lenses and sheets", [result, brief(of_fields(lateral)), brief(shifts), corners], same=1e-4, nothing=1e-6)


@pytest.mark.slow
def test_levels_that_codes_predict(pinned: Pinned) -> None:
    random = np.random.default_rng(14)
    usable = random.random(512) < 0.9
    level = printed_levels(0.1) + 0.002 * random.standard_normal(512)
    models = [predicting.LevelModel.of(level, known, 3) for known in (ALL, usable)]
    large = predicting.LevelModel.of(np.linspace(0.1, 0.9, 4096), np.arange(4096) % 7 > 0, 4)
    result = [
        [one.freedom, brief(one.predicted), brief(one.residual_of(level)), int(one.is_predicted.sum())]
        for one in models
    ]
    columns = random.standard_normal((4096, 3))
    pinned(
        "levels that codes predict",
        [result, large.freedom, brief(large.residual(columns)), int(large.is_predicted.sum()),
         *(brief(predicting.neighbour_residual(columns[: 8**bits], bits)) for bits in (2, 3, 4))],
        **LOOSE,
    )  # fmt: skip


@pytest.mark.slow
def test_light_added_to_a_print(pinned: Pinned) -> None:
    cells, level, result = positions(), levels(), []
    for size, middle, height in ((25, (80.0, 80.0), 0.02), (12, (200.0, 50.0), 0.05), (60, (20.0, 140.0), 0.01)):
        spot = height * np.exp(-0.5 * (np.linalg.norm(cells - middle, axis=1) / size) ** 2)[:, None] * [1.0, 0.5, 0.1]
        seen_there = level + spot + NOISE * np.random.default_rng(15).standard_normal(level.shape)
        usable = np.arange(512) % 11 > 0
        one = added_light.added_light(seen_there, np.full_like(level, NOISE**2), usable, cells, PAGE_MM, 3)
        result.append([brief(one), brief(one.certain_share_of(level)), brief(one.mean_square)])
    shapes = [brief(added_light._bumps(cells * [1.0, by])) for by in (0.2, 1.0, 3.0)]
    pinned("light added to a print", [result, shapes], **LOOSE)


def test_shares_of_a_lens(pinned: Pinned) -> None:
    result: list[Any] = []
    for seed, size in ((1, fitting.TERMS), (2, fitting.TERMS + 4)):
        _, value, matrix, vector = equations(2 * size, size, seed)
        prior = np.diag(np.linspace(0.5, 2, size))
        free = np.flatnonzero(fitting.free_terms())
        result.append(brief(fitting._solve_all(matrix, vector, prior, free)))
        left = np.random.default_rng(seed).standard_normal(size * 2)
        result.append(brief(fitting._weights(left, np.abs(value) * 1000)))
        if size == fitting.TERMS:
            shares, gain = fitting._solve_nonnegative(matrix, vector, np.arange(size)[::2])
            result.append(
                [brief(shares), gain, fitting._proven_terms(100 * matrix, 100 * vector, 1.0, fitting.groups_of_terms())]
            )
    random = np.random.default_rng(16)
    spots = random.uniform(-5, 60, (30, 2))
    laws = [fitting._law_shares(power) for power in (0.5, 1.0, 1.5, 3.0, 6.0)]
    pinned("shares of a lens", [result, brief(fitting.frame_terms(spots, (40, 50))), laws], **LOOSE)


def brighter(means: _Array) -> _Array:
    """Return cells of which every fiftieth is 2 % brighter."""
    return means * np.where(np.arange(len(means)) % 50 == 7, 1.02, 1.0)[:, None]


@pytest.mark.slow
@pytest.mark.parametrize("case", ["noise", "gain", "colour", "cells", "samples"])
def test_noise_of_a_table(case: str, tmp_path: Path, pinned: Pinned) -> None:
    more: dict[str, Any] = {
        "noise": {},
        "gain": {"gain": np.array([1.01, 1.0, 0.98])},
        "colour": {"gain": np.linspace(0.97, 1.03, 300).reshape(100, 3)},
        "cells": {"cells": brighter},
        "samples": {"samples": 9},
    }[case]
    other = written(tmp_path / "other", 11, **more)
    curve = table_noise.noise_curve(other)
    assert curve is not None
    pinned(f"noise of a table, {case}", brief(curve), **LOOSE)
