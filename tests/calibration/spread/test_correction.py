"""The lens measured on prints that another renderer has blurred, with spreads that are none of the fitted kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from calibration.kernels import PARTS
from calibration.pipeline.measuring import GreyLevels
from calibration.registration.register import Registration
from calibration.sampling import sites_at
from calibration.spread.correction import (
    FrameCorrection,
    LensFigures,
    PrintView,
    SpreadFrame,
    measure_spread,
)
from calibration.spread.fitting import (
    LEAST_COUNTS,
    MOST_VEIL,
    TERMS,
    USUAL_UNEVENNESS,
    PointSpread,
    far_groups,
)
from calibration.spread.surroundings import (
    PAD,
    FrameLevels,
    Surroundings,
    UsualLight,
    printed_grid,
    unsuitable,
)
from experiment.chart.layout import A_SERIES_MM, design_chart, paper_chart
from experiment.chart.model import Chart
from experiment.measures.least_squares import page_polynomial
from experiment.measures.paper import FlatField

pytestmark = pytest.mark.slow

_Array = npt.NDArray[np.float64]
PX_MM = 0.5
"""Half-size pixels are half a millimetre: cells of 10.6."""

PAPER = np.array([5000.0, 9000.0, 6000.0])
CHART = design_chart(4, seed=3)
SMALL = design_chart(3, A_SERIES_MM["A5"], seed=3)


@dataclass(frozen=True)
class Place:
    """A registration of a print that hangs flat, upright and undistorted."""

    at_px: tuple[float, float]

    def to_pixels(self, points_mm: npt.ArrayLike, channel: str = "G") -> _Array:
        """Return the pixels of points of the print."""
        return np.asarray(points_mm, dtype=np.float64) / PX_MM + self.at_px


def reflectance(rgb: npt.NDArray[np.integer]) -> _Array:
    """Return smooth colours of codes, 0.03 … 0.9, each channel with a little of the others."""
    share = (np.asarray(rgb, dtype=np.float64) / 255) ** 2.2
    mixed = share @ np.array([[0.86, 0.1, 0.04], [0.08, 0.84, 0.08], [0.03, 0.12, 0.85]])
    return 0.03 + 0.87 * mixed


@dataclass(frozen=True)
class Photograph:
    """What a lens makes of a print: the levels as seen, and as they would be without it."""

    chart: Chart
    printed: npt.NDArray[np.int64] | None
    view: PrintView
    around: Surroundings
    seen: FrameLevels
    clean: _Array
    true: _Array
    field: _Array

    def measured(self, left_out: str = "") -> tuple[PointSpread, LensFigures]:
        """Return the spread that the photograph shows."""
        usable = np.ones(len(self.true), dtype=np.bool_)
        # Paper as it is seen, and its field: a veil lifts it too.
        white = np.median(self.seen.patches[self.view.whites] / self.field[self.view.whites], axis=0)
        frame = SpreadFrame(self.seen, self.field, white, usable, USUAL_UNEVENNESS, self.printed)
        found = measure_spread([frame], self.around, self.chart.page_mm, self.chart.bits, LEAST_COUNTS, left_out)
        assert found is not None
        return found

    def corrected(self, spread: PointSpread) -> _Array:
        """Return the levels once the spread is corrected, without noise, which the correction does not touch."""
        return self.clean - FrameCorrection.of(spread, self.view, self.around).added(self.seen)

    def white_error(self, spread: PointSpread) -> _Array:
        """Return the relative error (3,) of white once the spread is corrected."""
        return (self.corrected(spread) / self.true)[self.view.whites].mean(axis=0) - 1

    def error(self, levels: _Array) -> float:
        """Return the RMS relative error of cells above 300 counts, relative to paper."""
        whites, cells = self.view.whites, slice(0, self.chart.colour_count)
        scale = (levels[whites] / self.true[whites]).mean(axis=0)
        off = (levels / scale / self.true)[cells] - 1
        return float(np.sqrt((off[self.true[cells] > LEAST_COUNTS] ** 2).mean()))


def white_angles(error: _Array, covariance: _Array) -> tuple[float, float]:
    """Return by how many degrees relative errors (3,) turn white, and the standard deviation by their covariance."""
    unit = PAPER / np.linalg.norm(PAPER)
    across = (np.eye(3) - np.outer(unit, unit)) @ np.diag(unit)
    return tuple(np.degrees([np.linalg.norm(across @ error), np.sqrt(np.trace(across @ covariance @ across.T))]))


def power_law(light: _Array, exponent: float, core: float, beyond: float) -> _Array:
    """Return light (rows, columns) spread as (r² + core²)^(−exponent / 2), half the frame's width around."""
    rows, columns = (2 * n for n in light.shape)
    y, x = np.arange(rows, dtype=np.float64), np.arange(columns, dtype=np.float64)
    square = np.minimum(y, rows - y)[:, None] ** 2 + np.minimum(x, columns - x) ** 2
    kernel = np.where(square < (max(light.shape) / 2) ** 2, (square + core**2) ** (-exponent / 2), 0.0)
    scene = np.full((rows, columns), beyond)
    scene[: light.shape[0], : light.shape[1]] = light
    found = np.fft.irfft2(np.fft.rfft2(scene) * np.fft.rfft2(kernel / kernel.sum()), scene.shape)
    return np.asarray(found[: light.shape[0], : light.shape[1]], dtype=np.float64)


def photograph(
    shoulder: float = 0.0,
    veil: float | tuple[float, float, float] = 0.0,
    growing: bool = False,
    falloff: float = 0.35,
    seed: int = 0,
    chart: Chart = CHART,
    rough: float = 0.0,
    tails: tuple[float, float, tuple[float, float, float]] | None = None,
) -> Photograph:
    """Return a photograph: exponential shoulders of 2.5 px, growing threefold to the corner if asked, and a veil.

    `tails` are a power law's exponent, its core in pixels, and the shares of R, G and B that are in it.
    `rough` is by how much the print's colours differ from smooth ones, as inks do: standard deviation, a share.
    """
    grid = printed_grid(chart)
    margin = 30
    low = grid.slots_mm.min(axis=0) - np.array(grid.pitch_mm) / 2
    place = Place((float(-low[0] / PX_MM) + margin, float(-low[1] / PX_MM) + margin))
    rows, columns = (
        int(np.ceil(n / PARTS * side / PX_MM)) + 2 * margin
        for n, side in zip(grid.parts.shape, grid.pitch_mm[::-1], strict=True)
    )
    shape = rows, columns
    where = place.to_pixels(grid.points_mm)
    whites = [reference for reference in chart.references if reference.is_white]
    greys = [reference for reference in chart.references if not reference.is_white]
    codes = np.concatenate([chart.rgb[chart.cell_of_colour], *([reference.rgb] for reference in [*whites, *greys])])
    of_patches = np.where((codes == 255).all(axis=1)[:, None], 1.0, reflectance(codes))
    of_patches[: chart.colour_count] *= np.random.default_rng([seed, 7]).normal(1, rough, (chart.colour_count, 3))
    colours = np.concatenate([of_patches, np.ones((1, 3)), reflectance(np.zeros((1, 3), dtype=int)), [[0.04] * 3]])
    # The scene pixel by pixel, by the part of the print that lies in its middle.
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    points = (np.stack([x, y], axis=-1) - place.at_px) * PX_MM
    part = np.floor((points - low) / np.array(grid.pitch_mm) * PARTS).astype(int)
    part = np.clip(part, 0, np.array(grid.parts.shape[::-1]) - 1)
    radius2 = ((x - columns / 2) ** 2 + (y - rows / 2) ** 2) / ((columns / 2) ** 2 + (rows / 2) ** 2)
    light = 1.1 * (1 - falloff * radius2)
    scene = (colours[grid.parts[part[..., 1], part[..., 0]]] * light[..., None] * PAPER).astype(np.float64)
    image = scene.copy()
    if shoulder:
        away = np.hypot(
            *(
                np.minimum(np.arange(n), n - np.arange(n))[s]
                for n, s in ((rows, np.s_[:, None]), (columns, np.s_[None, :]))
            )
        )
        kernel = np.exp(-away / 2.5)
        answer = np.fft.rfft2(kernel / kernel.sum())[..., None]
        spread = np.fft.irfft2(np.fft.rfft2(scene, axes=(0, 1)) * answer, shape, axes=(0, 1))
        share = shoulder * (0.5 + radius2 if growing else np.ones(shape))
        image = scene + share[..., None] * (spread - scene)
    if tails is not None:
        exponent, core, shares = tails
        for channel, share in enumerate(shares):
            spread = power_law(scene[..., channel], exponent, core, float(scene[0, 0, channel]))
            image[..., channel] += share * (spread - scene[..., channel])
    image = (1 - np.array(veil)) * image + np.array(veil) * image.mean(axis=(0, 1))
    sites = sites_at(where, shape)
    steps = np.arange(-2, 3)
    near_y, near_x = sites.rows[:, None, None] + steps[:, None], sites.columns[:, None, None] + steps
    random = np.random.default_rng([seed, 5])
    clean = image[near_y, near_x].mean(axis=(1, 2))
    noisy = clean + np.asarray(random.normal(size=clean.shape), dtype=np.float64) * np.sqrt(clean / 1.8 / 25 + 0.5)
    field_at = light[sites.rows, sites.columns][:, None].repeat(3, axis=1)
    cells, references = chart.colour_count, len(where)
    uniform = FlatField.uniform(chart.page_mm)
    # The window's pixels are whole, so that its places need no filter's offset here.
    view = PrintView.of(
        grid, slice(cells, cells + len(whites)), np.zeros((3, 2)), uniform, cast(Registration, place), shape, 5
    )
    around = view.around(
        cast(Registration, place), sites_at(where[:cells], shape), sites_at(where[cells:references], shape)
    )
    of_slots = ndimage.map_coordinates(
        light, (grid.slots_mm / PX_MM + place.at_px).T[::-1], order=1, mode="nearest"
    )[:, None].repeat(3, axis=1)  # fmt: skip
    around = replace(around, light=UsualLight.of(grid, field_at, of_slots))
    beyond = image[:margin, :margin].mean(axis=(0, 1))
    levels = GreyLevels.of(greys).level
    printed = np.concatenate([np.full(cells, -1), np.zeros(len(whites), dtype=np.int64), 1 + levels])
    true = of_patches * field_at * PAPER
    # The field as its fit through the white references has it, what the lens does to them included.
    at_all = page_polynomial(grid.points_mm, chart.page_mm, 6 if len(whites) >= 84 else 2)
    seen = noisy[view.whites] / field_at[view.whites] / PAPER
    changed: _Array = np.asarray(at_all @ np.linalg.lstsq(at_all[view.whites], seen, rcond=None)[0], dtype=np.float64)
    field_at = field_at * changed / changed[:cells].mean(axis=0)
    return Photograph(chart, printed, view, around, FrameLevels(noisy, beyond), clean, true, field_at)


@pytest.fixture(scope="module")
def sharp() -> Photograph:
    return photograph()


def test_a_sharp_lens_is_left_alone(sharp: Photograph) -> None:
    spread, figures = sharp.measured()
    assert not spread.shares.any()
    assert not spread.proven
    assert not figures.corrected
    assert (figures.rms, figures.worst, figures.beyond_cell) == (0, 0, 0)
    assert 0 < figures.residual < 0.012
    added = FrameCorrection.of(spread, sharp.view, sharp.around).added(sharp.seen)
    assert not added.any()


@pytest.mark.parametrize(
    ("lens", "least", "most"),
    [
        ({"shoulder": 0.03, "veil": 0.015}, 0.015, 0.0055),
        ({"shoulder": 0.06, "veil": 0.003, "growing": True}, 0.02, 0.01),
    ],
)
def test_what_a_lens_spreads_is_found_and_taken_out(lens: dict[str, float], least: float, most: float) -> None:
    shot = photograph(**lens)  # pyrefly: ignore[bad-argument-type]
    spread, figures = shot.measured()
    assert figures.corrected
    assert spread.held_out > 0
    before, after = shot.error(shot.clean), shot.error(shot.corrected(spread))
    assert before > least
    assert after < most
    assert figures.rms == pytest.approx(before, rel=0.35)
    # What is said to be left is what is left.
    assert after < 2 * figures.residual + 0.001


@pytest.mark.parametrize("shoulder", [0.0, 0.03])
def test_a_chart_of_few_colours_shows_the_lens_on_its_references(shoulder: float) -> None:
    """512 cells, whose codes stand too far apart to predict each other to a per cent."""
    shot = photograph(shoulder=shoulder, chart=SMALL)
    spread, figures = shot.measured()
    before, after = shot.error(shot.clean), shot.error(shot.corrected(spread))
    assert after < 0.005
    # What is said to be left covers what is left, and is no less for not being known.
    assert 0.5 * after < figures.residual < 0.03
    if not shoulder:
        assert after == before
        assert figures.residual > before
        return
    # White is hardly tinted by it.
    tint, stated = white_angles(shot.white_error(spread), figures.white_covariance)
    assert tint < min(0.05, 2 * stated)


def test_references_show_the_lens_where_colours_do_not_predict_each_other() -> None:
    """512 colours of real inks: what the nearest codes predict of a cell is 6 % off, references of a code are alike.

    The same fit without its references leaves .7 to 1.2 %, and knows less.
    """
    shot = photograph(shoulder=0.03, chart=SMALL, rough=0.06)
    spread, figures = shot.measured()
    assert shot.error(shot.clean) > 0.035
    assert shot.error(shot.corrected(spread)) < 0.0055
    assert figures.residual < 0.03
    without = replace(shot, printed=None)
    less, unsure = without.measured()
    assert less.held_out < 0.2 * spread.held_out
    assert unsure.residual > 1.25 * figures.residual


def test_shoulders_that_grow_are_no_veil_where_cells_are_too_few_to_see_it() -> None:
    """And the figure says what is not known: no table is made beyond 3 %."""
    shot = photograph(shoulder=0.03, growing=True, chart=SMALL)
    spread, figures = shot.measured()
    before, after = shot.error(shot.clean), shot.error(shot.corrected(spread))
    assert figures.veil < MOST_VEIL
    assert after < 0.2 * before
    assert figures.residual > max(after, 0.03)


def test_a_veil_in_even_light_is_not_known_and_that_is_said() -> None:
    even, falling = photograph(veil=0.01, falloff=0.0), photograph(veil=0.01)
    _, unknown = even.measured()
    _, known = falling.measured()
    assert unknown.veil_error > 0.008
    assert unknown.residual > 0.01
    assert known.veil_error < 0.004
    assert known.veil == pytest.approx(0.01, abs=3 * known.veil_error)


def test_a_veil_that_is_not_certain_is_taken_out_beside_shoulders_that_are() -> None:
    shot = photograph(shoulder=0.03, veil=0.006, falloff=0.25, seed=1)
    spread, figures = shot.measured()
    assert figures.corrected
    assert 0 < figures.veil < 4 * figures.veil_error
    assert figures.veil == pytest.approx(0.006, abs=2 * figures.veil_error)
    kernels = spread.shares.copy()
    kernels[far_groups()[-1]] = 0
    left, with_veil = (shot.error(shot.corrected(one)) for one in (spread, replace(spread, shares=kernels)))
    assert left < 0.7 * with_veil
    assert left < figures.residual


def test_what_is_likely_and_not_subtracted_is_said_to_be_left() -> None:
    """A lens of which nothing is certain: no sample is changed, and the figures are those of its likely veil."""
    shot = photograph(veil=0.006, seed=1)
    spread, figures = shot.measured()
    assert not figures.corrected
    assert not spread.shares.any()
    assert figures.veil == pytest.approx(0.006, abs=2 * figures.veil_error)
    assert figures.veil_at_most > 0.006
    true = shot.true[: shot.chart.colour_count]
    white = (shot.clean[shot.view.whites] / shot.true[shot.view.whites]).mean(axis=0)
    off = np.abs(shot.clean[: shot.chart.colour_count] / white / true - 1)[true > LEAST_COUNTS]
    assert 0.8 * shot.error(shot.clean) < figures.residual
    assert 0.7 * off.max() < figures.residual_worst
    # It is the darkest cells that are furthest off.
    assert figures.worst_level < 0.05


def test_light_of_the_surroundings_is_that_of_an_even_print_where_all_is_even(sharp: Photograph) -> None:
    grid, count = sharp.around.grid, len(sharp.true)
    even = UsualLight.of(grid, np.ones((count, 3)), np.ones((len(grid.slots_mm), 3)))
    flat = replace(sharp.around, light=even)
    levels = FrameLevels(np.full((count, 3), 700.0), np.full(3, 700.0))
    whole = np.zeros((9, 3, 3))
    whole[0] = 0.2
    near = flat.near(whole)
    assert near.total == pytest.approx(0.6)
    inks = flat.inks(levels)
    assert near.at(levels, inks) == pytest.approx(0.6 * 700, rel=1e-5)
    assert flat.mean(levels, inks) == pytest.approx(700)
    assert flat.far(flat.image(levels, inks), 24.0) == pytest.approx(700, rel=1e-5)


def test_the_mean_light_is_that_of_the_print_slot_by_slot(sharp: Photograph) -> None:
    around, levels = sharp.around, sharp.seen
    inks = around.inks(levels)
    slots = around.image(levels, inks).reshape(-1, 3).astype(np.float64)
    as_large = replace(around, frame_slots=float(len(slots)))
    assert as_large.mean(levels, inks) == pytest.approx(slots.mean(axis=0), rel=1e-6)
    # What lies behind fills the rest of the frame.
    beside = (slots.sum(axis=0) + 1000 * levels.beyond) / (len(slots) + 1000)
    larger = replace(around, frame_slots=float(len(slots) + 1000))
    assert larger.mean(levels, inks) == pytest.approx(beside, rel=1e-6)
    assert around.frame_slots > len(slots)


_COLOURED = [
    {"veil": (0.003, 0.005, 0.009)},
    {"veil": (0.016, 0.008, 0.004)},
    {"tails": (3.0, 2.0, (0.02, 0.03, 0.07))},
    {"tails": (3.0, 4.0, (0.06, 0.04, 0.02))},
    {"tails": (2.0, 2.0, (0.02, 0.03, 0.05))},
    {"shoulder": 0.03, "veil": (0.003, 0.005, 0.009)},
]
"""Lenses whose channels differ, some of forms that are no sums of the kernels."""


def test_what_a_lens_leaves_in_white_is_as_much_as_is_said() -> None:
    """On a chart of 512 colours, which shows little of it: said is neither less nor several times as much."""
    ratios: list[float] = []
    for seed, lens in enumerate(_COLOURED):
        shot = photograph(**lens, chart=SMALL, rough=0.03, seed=seed)  # pyrefly: ignore[bad-argument-type]
        spread, figures = shot.measured()
        tint, stated = white_angles(shot.white_error(spread), figures.white_covariance)
        ratios.append(tint / stated)
    assert np.mean(np.array(ratios) < 2) > 0.8
    assert max(ratios) < 4
    assert 0.2 < float(np.median(ratios)) < 1.5


def test_a_chart_of_many_colours_shows_the_lens_channel_by_channel() -> None:
    shot = photograph(veil=(0.003, 0.005, 0.009))
    spread, figures = shot.measured()
    error = shot.white_error(spread)
    before, _ = white_angles(shot.white_error(replace(spread, shares=np.zeros(TERMS))), figures.white_covariance)
    tint, stated = white_angles(error, figures.white_covariance)
    assert tint < 0.75 * before
    assert tint < 2 * stated
    cells = slice(0, shot.chart.colour_count)
    relative = (shot.corrected(spread) / shot.true)[cells] / (1 + error) - 1
    seen = shot.true[cells] > LEAST_COUNTS
    assert figures.cells_error.shape == seen.shape
    assert np.mean(np.abs(relative)[seen] < 2 * figures.cells_error[seen]) > 0.95


def test_what_lies_beside_cells_tells_what_far_light_turns_white() -> None:
    """512 cells hardly show it themselves: here it falls by the square of the distance, of other size by channel."""
    shot = photograph(tails=(2.0, 1.5, (0.016, 0.067, 0.07)), chart=SMALL)
    spread, figures = shot.measured()
    before, _ = white_angles(shot.white_error(replace(spread, shares=np.zeros(TERMS))), figures.white_covariance)
    tint, stated = white_angles(shot.white_error(spread), figures.white_covariance)
    assert tint < 0.4 * before
    assert tint < 2 * stated


def test_what_is_left_in_on_purpose_counts_in_full() -> None:
    shot = photograph(veil=(0.003, 0.005, 0.012), shoulder=0.02, chart=SMALL)
    spread, with_it = shot.measured()
    _, without = shot.measured("left out")
    assert spread.proven
    assert with_it.corrected
    assert not without.corrected
    assert without.why_not == "left out"
    nothing = shot.white_error(replace(spread, shares=np.zeros(TERMS)))
    tint, stated = white_angles(nothing, without.white_covariance)
    assert tint < 2 * stated
    assert (np.abs(nothing) < 2 * np.sqrt(np.diag(without.white_covariance))).all()
    assert (np.diag(without.white_covariance) > np.diag(with_it.white_covariance)).all()
    assert (without.cells_error > with_it.cells_error).mean() > 0.9


def test_a_lens_that_is_not_measured_has_a_usual_veil(sharp: Photograph) -> None:
    levels = (sharp.true / sharp.field / PAPER)[: sharp.chart.colour_count]
    levels[7] = np.nan
    figures = LensFigures.unknown("no tags", levels)
    assert not figures.measured
    assert figures.to_json()["assumed"] is True
    assert sharp.measured()[1].measured
    veiled = photograph(veil=(0.005, 0.008, 0.011))
    nothing = PointSpread(np.zeros(TERMS), np.zeros((TERMS, TERMS)), 0, 0, 1, np.zeros(TERMS))
    tint, stated = white_angles(veiled.white_error(nothing), figures.white_covariance)
    assert 0.5 * tint < stated < 2 * tint
    assert np.isfinite(figures.cells_error).all()
    dark, bright = np.argmin(np.nan_to_num(levels, nan=1)[:, 1]), np.argmax(np.nan_to_num(levels)[:, 1])
    assert figures.cells_error[dark, 1] > 0.02 > figures.cells_error[bright, 1]


def test_charts_that_show_no_lens_are_named() -> None:
    assert "no tags" in unsuitable(paper_chart("A4", 2))
    assert "64 cells" in unsuitable(design_chart(2))
    assert not unsuitable(CHART)


def test_the_grid_has_every_patch_once() -> None:
    grid = printed_grid(CHART)
    found = grid.source[grid.source >= 0]
    assert sorted(found.tolist()) == list(range(len(grid.points_mm)))
    assert (grid.source[:PAD] < 0).all()
    # Tags: 64 modules of two parts by two in a rim of one module.
    black = (grid.parts == len(grid.points_mm) + 1).sum()
    assert black > 0
