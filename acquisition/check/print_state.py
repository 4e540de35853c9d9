"""The print: stains, creases and shadows on it, each with its place and size.

Cells are held against cells of nearly their code, which lie elsewhere on the sheet (`experiment.measures.stains`);
references against references of their own code. What deviates together in one place is one spot.

Rules that hold inside:

- Smooth light is removed first, by the white references; where there are none, nothing is said.
- A chart of one or two bits has too few colours to predict one from the others: there references alone are looked at,
  and what lies between them is not seen. The finding says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, judged, not_checked, percent
from acquisition.check.light import SmoothLight, no_light
from acquisition.check.places import Levels
from experiment.chart.model import Chart
from experiment.measures.least_squares import page_polynomial, page_powers, robust_least_squares
from experiment.measures.stains import LEAST_BITS, LEAST_COUNTS, find_stains
from foundation.robust import sigma_of

LEAST_CELLS = 3
"""Cells of a spot: fewer are a speck of dirt or one misprinted cell, which build-lut lists by itself."""

CREASE = 3.0
"""Length over width of a spot from which on it is called a crease."""

REFERENCE_OFF = 0.04
"""Deviation of a reference from the others of its code, a share, from which on it counts (judgement): misplacement and
noise leave 1 %."""

REFERENCE_SIGMAS = 6.0
"""Usual deviations that it must be, too: by chance one reference in 5·10⁸."""

REFERENCE_SURE = 0.08
"""Deviation that always counts: where a stain covers half of a small chart, the usual deviation is the stain's own."""

LIGHT_ORDER = 4
"""Of what is left of the light after the references' field, as the cells themselves show it: few references show a
slope and a bend only. Of the third and fourth order only terms that are even along both axes: the falloff of lenses and
lamps is, a crease's flanks, one bright and one dark, are not."""

LEAST_ALIKE = 3
"""References of one code by which one is recognised as off."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Spot:
    """A place of the print that has not its codes' colours.

    - `centre_mm`: its middle, from the sheet's top-left corner.
    - `size_mm`: diameter of a circle of the area of its cells; of a crease its length.
    - `patches`: its cells, or references.
    - `deviation`: light there over what is expected, less 1, of the channel that deviates most.
    - `crease`: whether it is long and narrow.
    - `width_mm`, `angle_deg`: of a crease: its width, and its direction, clockwise from the right.
    """

    centre_mm: tuple[float, float]
    size_mm: float
    patches: int
    deviation: float
    crease: bool
    width_mm: float = 0.0
    angle_deg: float = 0.0

    def __str__(self) -> str:
        """Return "a stain or shadow of 58 mm at 420, 310 mm, 34 % darker"."""
        x, y = self.centre_mm
        what = "a crease" if self.crease else "a stain or shadow"
        word = "darker" if self.deviation < 0 else "brighter"
        return f"{what} of {self.size_mm:.0f} mm at {x:.0f}, {y:.0f} mm, {percent(abs(self.deviation))} {word}"


@dataclass(frozen=True, eq=False)
class PrintState:
    """How the print deviates from its codes.

    - `points_mm`: (N, 2) patches that were judged.
    - `deviation`: (N,) float64 of the channel that deviates most, signed; NaN where it is not known.
    - `off`: (N,) bool, patches of spots.
    - `by_references`: whether references alone were judged.
    """

    points_mm: _Array
    deviation: _Array
    off: _Mask
    spots: tuple[Spot, ...]
    by_references: bool


def measure_print(chart: Chart, cells: Levels, references: Levels, field: SmoothLight) -> PrintState:
    """Return how the print deviates from its codes."""
    by_references = chart.bits < LEAST_BITS
    if by_references:
        points = np.array([reference.centre_mm for reference in chart.references], dtype=np.float64).reshape(-1, 2)
        deviation = _of_references(chart, references, field, points)
        known = deviation[np.isfinite(deviation)]
        usual = sigma_of(known) if len(known) else 0.0
        with np.errstate(invalid="ignore"):
            off = np.abs(deviation) > np.clip(REFERENCE_SIGMAS * usual, REFERENCE_OFF, REFERENCE_SURE)
        page = chart.page_mm[0] * chart.page_mm[1]
        area = page / max(len(points), 1)
        return PrintState(points, deviation, off, _spots(points, deviation, off, area, 1), True)
    points = chart.centres_mm
    of_colour = chart.cell_of_colour
    usable = np.isfinite(cells.mean).all(axis=1) & ~cells.clipped
    level = np.nan_to_num(cells.mean) / field.at(points)
    stains = find_stains(level[of_colour], points[of_colour], chart.bits, usable[of_colour])
    left = _light_left(stains.alone, points[of_colour], chart.page_mm)
    stains = find_stains(level[of_colour] / left, points[of_colour], chart.bits, usable[of_colour])
    deviation = np.full(len(points), np.nan)
    known = np.isfinite(stains.deviation).any(axis=1)
    deviation[of_colour] = np.where(known, stains.largest_deviation(), np.nan)
    off = np.zeros(len(points), dtype=np.bool_)
    off[of_colour] = stains.stained
    # A neighbourhood's mean is bounded; how dark a spot is, its cells tell themselves.
    for colour in np.flatnonzero(stains.stained).tolist():
        deviation[of_colour[colour]] = stains.deviation_of(colour)
    area = chart.cell_mm[0] * chart.cell_mm[1]
    spots = _spots(points, deviation, off, area, LEAST_CELLS)
    return PrintState(points, deviation, off, spots, False)


def judge_print(state: PrintState | None, chart: Chart, matched: float) -> Finding:
    """Return the finding on stains.

    `state`: none where the light on the chart is not known.
    """
    if state is None:
        return not_checked("stains", no_light(chart))
    if matched < 0.5:
        return not_checked(
            "stains", f"{percent(matched)} of the chart's places are sure: cells may be read beside their places",
            "hang the print flatter, focus, and name the chart.json of this print",
        )  # fmt: skip
    judged_patches = int(np.isfinite(state.deviation).sum())
    if judged_patches < LEAST_ALIKE:
        return not_checked("stains", f"{judged_patches} patches can be compared with others of their code")
    share = sum(spot.patches for spot in state.spots) / len(state.points_mm)
    what = "references" if state.by_references else "cells"
    between = "; what lies between them is not seen on a chart of few colours" if state.by_references else ""
    if not state.spots:
        return judged(LIMITS["stains"], 0.0, f"none seen on {judged_patches} {what}{between}", "")
    told = "; ".join(str(spot) for spot in state.spots[:4])
    more = f"; and {len(state.spots) - 4} more" if len(state.spots) > 4 else ""
    return judged(
        LIMITS["stains"],
        share,
        f"{told}{more}, {percent(share)} of the {what}{between}",
        "clean or flatten the print there, look for a shadow on it, or print it anew",
        {
            "spots": [
                {"centre_mm": list(spot.centre_mm), "size_mm": spot.size_mm, "deviation": spot.deviation,
                 "patches": spot.patches, "crease": spot.crease}
                for spot in state.spots
            ]
        },
    )  # fmt: skip


def _light_left(alone: _Array, points_mm: _Array, page_mm: tuple[float, float]) -> _Array:
    """Return the smooth light (C, 3) that cells' deviations (C, 3) from their codes show; no local one counts."""
    left = np.ones(alone.shape)
    terms = [
        number
        for number, (i, j) in enumerate(page_powers(LIGHT_ORDER))
        if i + j <= 2 or (i + j == LIGHT_ORDER and i % 2 == j % 2 == 0)
    ]
    basis = np.ascontiguousarray(page_polynomial(points_mm, page_mm, LIGHT_ORDER)[:, terms])
    for channel in range(3):
        there = np.isfinite(alone[:, channel]) & (np.nan_to_num(alone[:, channel]) > -0.9)
        if there.sum() < 5 * basis.shape[1]:
            continue
        values = np.log1p(alone[there, channel])
        solution = robust_least_squares(np.ascontiguousarray(basis[there]), values, 6)[0]
        left[:, channel] = np.exp(basis @ solution)
    return left


def _of_references(chart: Chart, references: Levels, field: SmoothLight, points: _Array) -> _Array:
    """Return (N,) how each reference deviates from those of its code; NaN where there are too few of them."""
    codes = np.array([reference.rgb for reference in chart.references]).reshape(-1, 3)
    light = np.where(references.clipped[:, None], np.nan, references.mean) / field.at(points)
    deviation = np.full(len(points), np.nan)
    for code in np.unique(codes, axis=0):
        here = (codes == code).all(axis=1)
        seen = light[here]
        whole = np.isfinite(seen).all(axis=1) & (np.nan_to_num(seen).min(axis=1) > LEAST_COUNTS)
        if whole.sum() < LEAST_ALIKE:
            continue
        ratio = seen / np.median(seen[whole], axis=0) - 1
        largest = np.take_along_axis(ratio, np.abs(np.nan_to_num(ratio)).argmax(axis=1)[:, None], axis=1)[:, 0]
        deviation[here] = np.where(whole, largest, np.nan)
    return deviation


def _spots(points: _Array, deviation: _Array, off: _Mask, area_mm2: float, least: int) -> tuple[Spot, ...]:
    """Return the spots that patches which are off form, the largest first; `area_mm2` is what each stands for."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    places = points[off]
    if not len(places):
        return ()
    pairs = cKDTree(places).query_pairs(2.3 * area_mm2**0.5, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    count, label = connected_components(graph, directed=False)
    found = [_spot(places[label == k], deviation[off][label == k], area_mm2) for k in range(int(count))]
    return tuple(sorted((spot for spot in found if spot.patches >= least), key=lambda spot: -spot.patches))


def _spot(places: _Array, deviation: _Array, area_mm2: float) -> Spot:
    centre = places.mean(axis=0)
    _, lengths, axes = np.linalg.svd(places - centre, full_matrices=False)
    spread = lengths / len(places) ** 0.5
    # A square's standard deviation is its side over √12; a single row of cells has a width, too.
    length, width = (
        float((12 * value**2 + area_mm2) ** 0.5) for value in (spread[0], spread[1] if len(spread) > 1 else 0.0)
    )
    crease = len(places) >= 6 and length > CREASE * width
    size = length if crease else 2 * float((len(places) * area_mm2 / np.pi) ** 0.5)
    known = deviation[np.isfinite(deviation)]
    value = float(np.median(known)) if len(known) else float("nan")
    angle = float(np.degrees(np.arctan2(axes[0, 1], axes[0, 0]))) % 180
    at = float(centre[0]), float(centre[1])
    return Spot(at, size, len(places), value, crease, width if crease else size, angle if crease else 0.0)


def names_of(spots: Sequence[Spot]) -> list[str]:
    """Return a label for each spot in a picture."""
    return [f"{spot.size_mm:.0f} mm" for spot in spots]
