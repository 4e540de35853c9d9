"""Light and print: even, steady, additive, and dark where it should be; stains, creases and shadows, place and size.

Lens and projector darken the corners together, and one frame does not tell them apart: what is judged is their product,
as it is this that `build-lut` divides out.

Cells are held against cells of nearly their code, which lie elsewhere on the sheet (`experiment.measures.stains`);
references against references of their own code. What deviates together in one place is one spot.

Rules that hold inside:

- Smooth light is removed first, by the white references; where there are none, nothing is said of the print.
- A chart of one or two bits has too few colours to predict one from the others: there references alone are looked at,
  and what lies between them is not seen. The finding says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from acquisition.check.findings import LIMITS, Finding, judged, not_checked, percent
from acquisition.check.places import Levels
from calibration.figures.light import ADDITIVITY
from drivers.raw.rawfile import CHANNELS
from experiment.chart.model import Chart
from experiment.measures.least_squares import least_squares, page_polynomial, page_powers, robust_least_squares
from experiment.measures.paper import MIN_REFERENCES, PaperReader
from experiment.measures.stains import LEAST_BITS, LEAST_COUNTS, find_stains
from foundation.colorimetry import angles_deg
from foundation.robust import huber_weights, sigma_of

MEASURABLE_COUNTS = 300.0
"""Counts above black under white from which on a patch's ratio to another frame is good to 1 %."""

AREAS = (3, 5)
"""Rows and columns of the areas over which stray light is looked for: a lamp lights one end of a chart, not a cell."""

MUTED_SHARE = 0.5
"""Share of the black picture's light that must go when the picture is muted for it to be called the projector's."""

MANY_REFERENCES = 150
"""White references from which on the light is read as `build-lut` reads it, by a polynomial of up to eighth order in
the counts; with fewer such a polynomial runs away beside them."""

FEW_ORDER = 2
"""Order of the light's logarithm where references are few: a slope and a bend."""

_ROUNDS = 6
"""Reweighted solutions in a row; Huber's weights have settled by then."""

_Array = npt.NDArray[np.float64]


class SmoothLight(Protocol):
    """The shape of the light over the print; its mean over the cells is 1."""

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the light (N, 3) float64, > 0, at points (N, 2) mm."""
        ...


class BentLight:
    """Light whose logarithm is a polynomial over the page, for charts of few references: positive everywhere.

    `terms`: (terms, 3) float64 of the logarithm, for R, G and B.
    """

    def __init__(self, page_mm: tuple[float, float], terms: _Array) -> None:
        self._page_mm, self._terms = page_mm, terms
        self._order = next(k for k in range(FEW_ORDER + 1) if len(page_powers(k)) == len(terms))

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the light (N, 3) float64, > 0, at points (N, 2) mm."""
        return np.exp(page_polynomial(points_mm, self._page_mm, self._order) @ self._terms)


def measure_light(chart: Chart, references: Levels) -> SmoothLight | None:
    """Return the light that a chart's references show under white.

    None where fewer than six white ones can be used, or lie among the cells: a margin alone says nothing of the
    middle.
    """
    white = np.array([reference.is_white for reference in chart.references], dtype=np.bool_)
    seen = np.where(references.clipped[:, None], np.nan, references.mean)
    usable = np.isfinite(seen).all(axis=1) & (np.nan_to_num(seen).min(axis=1) > 0)
    if (usable & white).sum() < MIN_REFERENCES or _among_cells(chart) < MIN_REFERENCES:
        return None
    places = np.array([reference.centre_mm for reference in chart.references], dtype=np.float64).reshape(-1, 2)
    if (usable & white).sum() >= MANY_REFERENCES:
        reader = PaperReader(places[white], chart.centres_mm, chart.page_mm)
        return reader.read(np.where(usable[:, None], seen, np.nan)[white])[0].field
    # Greys of one code lie in one light too: each code has a level of its own, which the light does not share.
    codes, group = np.unique([reference.rgb for reference in chart.references], axis=0, return_inverse=True)
    own = np.eye(len(codes))[group.ravel()]
    chosen = usable & (own.sum(axis=0)[group.ravel()] >= 2) & (seen.min(axis=1) > MEASURABLE_COUNTS / 3)
    if chosen.sum() < MIN_REFERENCES:
        return None
    order = max((k for k in range(FEW_ORDER + 1) if 2 * len(page_powers(k)) <= int(chosen.sum())), default=0)
    basis = page_polynomial(places[chosen], chart.page_mm, order)[:, 1:]
    design = np.ascontiguousarray(np.column_stack([own[chosen], basis]))
    terms = np.zeros((len(page_powers(order)), 3))
    for channel in range(3):
        values, weights = np.log(seen[chosen, channel]), np.ones(int(chosen.sum()))
        for _ in range(_ROUNDS):
            solution = least_squares(design, values, weights)
            off = np.abs(values - design @ solution)
            weights = huber_weights(off, max(sigma_of(off), 1e-4)) ** 2
            terms[1:, channel] = solution[len(codes) :]
    light = BentLight(chart.page_mm, terms)
    terms[0] = -np.log(light.at(chart.centres_mm).mean(axis=0))
    return BentLight(chart.page_mm, terms)


def _among_cells(chart: Chart) -> int:
    """Return how many white references lie among the cells."""
    places = np.array([reference.centre_mm for reference in chart.white_references]).reshape(-1, 2)
    low, high = chart.centres_mm.min(axis=0), chart.centres_mm.max(axis=0)
    return int(((places >= low) & (places <= high)).all(axis=1).sum())


def no_light(chart: Chart) -> str:
    """Return why the light on a chart is not known."""
    count = len(chart.white_references)
    if count < MIN_REFERENCES:
        return f"the chart has {count} white references, at least {MIN_REFERENCES} needed"
    if _among_cells(chart) < MIN_REFERENCES:
        return "the chart has bare paper in its margin only, which does not show the light in its middle"
    return f"of the chart's {count} white references too few are bright, whole and not clipped"


def judge_evenness(light: SmoothLight | None, chart: Chart) -> list[Finding]:
    """Return the findings on how evenly the chart is lit, of lens and projector together.

    `light`: what the references show under white; None where there are too few.
    """
    if light is None:
        return [not_checked(name, no_light(chart)) for name in ("evenness", "colour evenness")]
    width, height = chart.page_mm
    left, top = chart.centres_mm.min(axis=0)
    right, bottom = chart.centres_mm.max(axis=0)
    cells = light.at(chart.centres_mm)
    falloff = 1 - cells.min(axis=0) / cells.max(axis=0)
    corners = light.at([(left, top), (right, top), (right, bottom), (left, bottom)])
    centre = light.at([(width / 2, height / 2)])[0]
    shares = corners / centre
    channel = int(np.argmax(falloff))
    names = ("top left", "top right", "bottom right", "bottom left")
    described = ", ".join(f"{name} {percent(share)}" for name, share in zip(names, shares[:, channel], strict=True))
    each = ", ".join(f"{letter} {percent(value)}" for letter, value in zip(CHANNELS, falloff, strict=True))
    darkest = chart.centres_mm[int(np.argmin(cells[:, channel]))]
    even = judged(
        LIMITS["evenness"],
        float(falloff[channel]),
        f"lens and projector together lose {each} over the chart; of the centre's light ({CHANNELS[channel]}) "
        f"{described}",
        "centre the chart in the projector's picture and zoom it out, stop the lens down, or step back and take a "
        "longer lens; one frame cannot tell which of the two it is: turn the camera, what turns with it is the lens's",
        {
            "falloff": falloff.tolist(),
            "corners_of_centre": {name: row.tolist() for name, row in zip(names, shares, strict=True)},
            "darkest_mm": darkest.tolist(),
        },
    )
    ratios = cells[:, [0, 2]] / cells[:, [1]]
    changes = ratios.max(axis=0) / ratios.min(axis=0) - 1
    coloured = judged(
        LIMITS["colour evenness"],
        float(changes.max()),
        f"over the chart white's R/G changes by {percent(changes[0])}, its B/G by {percent(changes[1])}",
        "keep coloured light off the chart, let no coloured wall reflect onto it, clean the print, and switch the "
        "projector's shading correction on",
        {"red_over_green": float(changes[0]), "blue_over_green": float(changes[1])},
    )
    return [even, coloured]


def judge_room_light(
    chart: Chart, points_mm: _Array, white: _Array, dark: _Array, muted: _Array | None, why_not_muted: str
) -> Finding:
    """Return the finding on the light that is there while the projector shows black.

    The ratio of a patch in the dark to the same patch under white does not depend on its colour, so every patch that
    white shows well enough takes part.

    `points_mm`: (N, 2) patches of the print. `white`, `dark`: (N, 3) counts above black under white and under the black
    picture, at one exposure. `muted`: (N, 3) the same with the projector's picture muted; None where it could not be.
    """
    share, place = _worst_share(chart, points_mm, white, dark)
    if share is None:
        return not_checked("room light", "white is too dim for a ratio", "mend the exposure first, then check again")
    said = f"the black picture has {percent(share)} of white's light"
    details: dict[str, object] = {"share": share, "where": place}
    if muted is None:
        said += f" at {place}; projector's black and the room's light are not told apart: {why_not_muted}"
        remedy = "darken the room, cover lamps and displays; what is then left is the projector's own black"
    else:
        left = _worst_share(chart, points_mm, white, muted)[0] or 0.0
        own = max(share - left, 0.0)
        details |= {"muted": left, "projector": own}
        if own >= MUTED_SHARE * share:
            said += f" at {place}, {percent(own)} of it the projector's black, {percent(left)} the room's"
            remedy = "raise the projector's contrast (its iris, its picture mode), and darken the room"
        else:
            said += (
                f" at {place}, {percent(left)} of it with the picture muted: the room's light, or a projector whose "
                "mute shows black"
            )
            remedy = "darken the room, cover lamps and displays, keep daylight out"
    return judged(LIMITS["room light"], share, said, remedy, details)


def _worst_share(chart: Chart, points_mm: _Array, white: _Array, dark: _Array) -> tuple[float | None, str]:
    """Return the largest ratio of areas of the chart and channels, and the area's name; None where white is too dim."""
    area = areas_of(points_mm, chart)
    best: tuple[float | None, str] = (None, "")
    with np.errstate(invalid="ignore"):
        known = white >= MEASURABLE_COUNTS
    for number in range(AREAS[0] * AREAS[1]):
        for channel in range(3):
            here = known[:, channel] & (area == number) & np.isfinite(dark[:, channel])
            if here.sum() < 3:
                continue
            share = float(np.median(dark[here, channel] / white[here, channel]))
            if best[0] is None or share > best[0]:
                best = share, area_name(number)
    return best


def areas_of(points_mm: _Array, chart: Chart) -> npt.NDArray[np.int64]:
    """Return the number (N,) of the area that each point (N, 2) lies in, row by row."""
    rows, columns = AREAS
    across, down = np.clip(points_mm / chart.page_mm, 0, 1 - 1e-9).T
    return (down * rows).astype(np.int64) * columns + (across * columns).astype(np.int64)


def area_name(number: int) -> str:
    """Return where one of the areas lies: "the top left", "the middle"."""
    row, column = divmod(number, AREAS[1])
    down = ("top", "middle", "bottom")[row]
    across = ("far left", "left", "middle", "right", "far right")[column]
    if down == across:
        return "the middle"
    return f"the {down} {across}"


def judge_primaries(levels: Mapping[str, _Array], plan_has: bool) -> list[Finding]:
    """Return the findings on whether white is the brightest light, and the sum of the primaries.

    `levels`: (3,) counts above black of paper under "white", "red", "green", "blue" and "black", at one exposure.
    """
    white, black = levels["white"], levels["black"]
    alone = np.stack([levels[name] for name in ("red", "green", "blue")])
    over = alone / white[None]
    primary, channel = np.unravel_index(int(np.argmax(over)), over.shape)
    share = float(over[primary, channel])
    name = ("red", "green", "blue")[int(primary)]
    brightest = judged(
        LIMITS["brightest light"],
        share,
        f"of the primaries {name} comes nearest to white, with {percent(share)} of it in {CHANNELS[int(channel)]}"
        f"{'' if plan_has else ' (the plan has no lights)'}",
        "switch off what dims a full picture in the projector's menu (dynamic contrast, eco mode), or expose less",
        {"primaries_of_white": over.tolist()},
    )
    signed = (alone.sum(axis=0) - 2 * black) / white - 1
    off = float(signed[int(np.argmax(np.abs(signed)))])
    additive = judged(
        LIMITS[ADDITIVITY.name],
        off,
        f"the three primaries together are {percent(abs(off))} {'above' if off > 0 else 'below'} white",
        "switch off brilliant colour, white boost and dynamic contrast in the projector's menu",
        {"by_channel": signed.tolist()},
    )
    return [brightest, additive]


def judge_flicker(whites: Sequence[_Array], shutter_s: float) -> list[Finding]:
    """Return the findings on how white differs between frames of one exposure.

    `whites`: (3,) counts above black of paper, frame by frame; at least three.
    """
    seen = np.stack(whites)
    ratio = seen[:, 0] / seen[:, 1]
    angle = float(angles_deg(seen, seen[0]).max())
    strongest = int(np.argmax(seen.mean(axis=0)))
    bright = float((np.ptp(seen, axis=0) / seen.mean(axis=0)).max())
    described = f"over {len(seen)} frames of {shutter_s:.4g} s"
    return [
        judged(
            LIMITS["flicker"],
            angle,
            f"white is up to {angle:.2f}° from the first one, its R/G has a standard deviation of "
            f"{percent(float(ratio.std(ddof=1) / ratio.mean()))} {described}",
            "expose for 0.5 s or more, and for whole turns of the colour wheel (set lab.projector.colour_wheel_hz)",
            {"red_over_green": ratio.tolist()},
        ),
        judged(
            LIMITS["brightness"],
            bright,
            f"white changes by {percent(bright)} {described}",
            "let the lamp warm up, switch off its eco mode and dynamic contrast, keep other light away",
            {"counts": seen[:, strongest].tolist()},
        ),
    ]


def light_share(light: SmoothLight, points_mm: npt.ArrayLike) -> _Array:
    """Return the light (N, 3) float64 at points (N, 2) mm as a share of the brightest of them, channel by channel."""
    seen = light.at(points_mm)
    return seen / seen.max(axis=0)


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
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Spot:
    """A place of the print that has not its codes' colours.

    - `centre_mm`: its middle, from the sheet's top-left corner.
    - `size_mm`: diameter of a circle of the area of its cells; of a crease its length.
    - `patches`: its cells, or references.
    - `deviation`: light there over what is expected, less 1, of the channel that deviates most.
    - `crease`: whether it is long and narrow.
    - `width_mm`, `angle_deg`: of a crease: its width, and its direction, clockwise from the right; else `size_mm`, 0.
    """

    centre_mm: tuple[float, float]
    size_mm: float
    patches: int
    deviation: float
    crease: bool
    width_mm: float
    angle_deg: float

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
    described = "; ".join(str(spot) for spot in state.spots[:4])
    more = f"; and {len(state.spots) - 4} more" if len(state.spots) > 4 else ""
    return judged(
        LIMITS["stains"],
        share,
        f"{described}{more}, {percent(share)} of the {what}{between}",
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
