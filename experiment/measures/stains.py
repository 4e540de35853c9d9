"""Stains, folds, shadows and reflections on the print: cells whose colour is not that of their code.

A stain leaves its cells of one colour each, so that neither rim nor noise of a cell shows it, and the table would hold
the colours of a dirty print. It is recognised by a whole neighbourhood that deviates at once, while the same codes,
which lie at random over the sheet, are right everywhere else.

Rules that hold inside:

- What a code gives is predicted from the codes next to it in colour, which lie elsewhere on the sheet: no model of ink
  or paper, and next to nothing in common with the cell's own place.
- A cell is judged by its neighbourhood: one deviating cell is the prediction's error or noise. Next to a stain it is
  judged alone as well, for only half of the neighbourhood of a cell at a stain's rim is stained; that half must show.
- Codes of which two values are equal are predicted by others of which they are.
- Charts of less than `LEAST_BITS` cannot be judged: between four levels of a code curvature does not change slowly.
- A deviation must be significant and large enough to matter. What is found is listed, never corrected.
- A stain takes of each cell a share of its light, a reflection adds to each as much. So the light that cells of a place
  show is a line over the light that they should have: its slope is the share of their own that they keep, and what it
  leaves at 0 is the light added (dichromatic reflection: S. Shafer, Color Research & Application 10, 1985, eq. 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from experiment.measures.least_squares import least_absolute_line
from foundation.robust import robust_sigma

NEIGHBOURS = 13  # A cell and the twelve within two cells of it: a tenth of a thumb's stain at 5 mm a cell

STAINED = 0.02  # Deviation of a neighbourhood from its codes, a share, from which its cells are listed as unfit

# Deviation from which cells are counted and shown. Clean prints in the simulated room stay below, to one cell.
DOUBTFUL = 0.01

SIGNIFICANT = 6.0  # Standard errors that it must be, too; by chance one neighbourhood in 5·10⁸

RIM_SIGMA = 4.0  # Usual deviations of single cells that a cell next to a stain must deviate by to belong to it

LEAST_COUNTS = 30.0  # Darker cells are not judged: a count of stray light is 3 % of them

# Bits of a channel: with 2, curvature changes too fast between the four levels of a code to be predicted.
LEAST_BITS = 3


LEAST_CELLS = 6  # Cells of a place for a line through them to mean anything

# Share of the cells from which on a place counts: that of the limit on unfit cells. A glint on fewer is listed, and
# what it leaves around them is a few cells' error.
LARGE_SPOT = 0.005

# Share of their own light that cells keep under a reflection at least: less, and something covers them (as in the
# table of causes, where a hand is named below it).
OWN_KEPT = 0.85

_ROUNDS = 3  # Repetitions at most, each without the stained cells of the one before in the predictions

_LEAST_KNOWN = 9  # Codes of the 25 across an axis that must be known for their median to be a curvature

_LEAST_TIED = 3  # Codes with two equal values that must be known for their median to be a bend

_LEAST_NEIGHBOURS = 5  # Cells of a neighbourhood that must be known for its mean to count

# Stained cells of a neighbourhood from which on it need not deviate itself for a cell to belong to the stain.
_MANY_BESIDE = 2

_BRIGHT_PERCENTILE = 99.0  # Of the cells' levels, what is taken for paper white

_BESIDE = 2.3  # Distance, in sides of a cell, up to which deviating cells are of one place: one may lie between them

# Distance, in sides of a cell, from the cells of a spot up to which light is looked for in cells that are not listed:
# two rings, of which the first is half in the neighbourhoods of the spot (chosen).
_AROUND = 2.5

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stains:
    """How cells differ from what their codes give elsewhere.

    - `deviation`: (C, 3) float64, of each cell's neighbourhood, seen over expected less 1; NaN where it is not known.
    - `error`: (C, 3) float64, its standard error.
    - `alone`: (C, 3) float64, deviation of each cell by itself, noise and the prediction's error included; NaN
      likewise.
    - `stained`: (C,) bool, cells to be listed.
    - `level`: (C, 3) float64, mean counts above black that were judged.
    - `places_mm`: (C, 2) where the cells lie on the sheet.
    """

    deviation: _Array
    error: _Array
    alone: _Array
    stained: _Mask
    level: _Array
    places_mm: _Array

    @property
    def doubtful(self) -> _Mask:
        """(C,) bool, cells in neighbourhoods that deviate by 1 % or more: a fold's flanks, a faint stain, a shadow."""
        return _beyond(self.deviation, self.error, DOUBTFUL)

    @property
    def known(self) -> bool:
        """Whether anything is known of the print."""
        return bool(np.isfinite(self.deviation).any())

    def largest_deviation(self) -> _Array:
        """Return (C,) float64 the signed deviation of the channel that deviates most; 0 where it is not known."""
        return _largest(self.deviation)

    def deviation_of(self, cell: int) -> float:
        """Return a stained cell's deviation, with its sign: of its neighbourhood, or its own where that is larger."""
        both = np.array([_largest(self.deviation[[cell]])[0], _largest(self.alone[[cell]])[0]])
        return float(both[np.abs(both).argmax()])


def _largest(deviation: _Array) -> _Array:
    """Return (N,) the deviation (N, 3), with its sign, of the channel that deviates most; 0 where none is known."""
    known = np.nan_to_num(deviation)
    return np.take_along_axis(known, np.abs(known).argmax(axis=1)[:, None], axis=1)[:, 0]


def find_stains(level: _Array, centres_mm: _Array, bits: int, usable: _Mask | None = None) -> Stains:
    """Return which cells lie in neighbourhoods that are not of their codes' colours.

    `level`: (8**bits, 3) float64, mean counts above black of each colour under even light, in the order of colour
    indices, the field divided out; best the mean of all white frames. `centres_mm`: (8**bits, 2) mm, where each colour
    lies on the sheet. `usable`: (8**bits,) bool, cells whose level means anything: not covered, cut off or clipped; all
    if not given.
    """
    if bits < LEAST_BITS:
        unknown = np.full(level.shape, np.nan)
        return Stains(unknown, unknown, unknown, np.zeros(len(level), dtype=np.bool_), level, centres_mm)
    usable = np.ones(len(level), dtype=np.bool_) if usable is None else usable
    near = np.asarray(cKDTree(centres_mm).query(centres_mm, k=min(NEIGHBOURS, len(level)))[1])
    near = near.reshape(len(level), -1)
    trusted = usable.copy()
    deviation, error, log_ratios = (np.full(level.shape, np.nan) for _ in range(3))
    stained = np.zeros(len(level), dtype=np.bool_)
    # A stain spoils the predictions that rest on its cells, too; without them, its rim and depth are sharper.
    for _ in range(_ROUNDS):
        log_ratios = _log_ratios(np.where(trusted[:, None], level, np.nan), level, usable, bits)
        deviation, error = _of_neighbourhoods(log_ratios, near)
        found = _beyond(deviation, error, STAINED)
        if (found == stained).all():
            break
        stained = found
        trusted = usable & ~stained
    with np.errstate(invalid="ignore"):
        off = (np.abs(np.expm1(log_ratios)) > np.maximum(RIM_SIGMA * _usual(log_ratios), STAINED)).any(axis=1)
    # Part of a neighbourhood that a stain reaches deviates, too; a cell that does so alone is its prediction's error.
    beside = stained[near].sum(axis=1)
    reached = (np.abs(np.nan_to_num(deviation)) >= DOUBTFUL).any(axis=1) | (beside >= _MANY_BESIDE)
    rim = off & reached & (beside > 0)
    return Stains(deviation, error, np.expm1(log_ratios), stained | rim, level, centres_mm)


def _usual(log_ratios: _Array) -> _Array:
    """Return (3,) the standard deviation of single cells, by the median of their sizes."""
    there = np.isfinite(log_ratios)
    return np.array([robust_sigma(log_ratios[there[:, c], c]) if there[:, c].any() else 0 for c in range(3)])


def _beyond(deviation: _Array, error: _Array, least: float) -> _Mask:
    """Return (C,) where a deviation is both significant and at least `least`; NaN is not."""
    return np.asarray((np.abs(deviation) > np.maximum(SIGNIFICANT * error, least)).any(axis=1))


def _log_ratios(trusted: _Array, level: _Array, usable: _Mask, bits: int) -> _Array:
    """Return (C, 3) log of each cell over what its neighbours in colour predict, NaN where they cannot.

    Along each axis of the code the mean of both neighbours' logarithms predicts the cell's, but for the curvature,
    which changes slowly across the axis and is taken out as the median over the codes beside. Where two values of a
    code are equal there is a bend, too: black replaces as much ink as all three have in common.
    """
    side = 1 << bits
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(np.where(trusted > LEAST_COUNTS, trusted, np.nan)).reshape(side, side, side, 3)
        own = np.log(np.where((level > LEAST_COUNTS) & usable[:, None], level, np.nan)).reshape(side, side, side, 3)
    total, count = np.zeros_like(own), np.zeros_like(own)
    for axis in range(3):
        before, after = (np.roll(logs, step, axis=axis) for step in (1, -1))
        second = own - 0.5 * (before + after)
        edge: list[slice | list[int]] = [slice(None)] * 3
        edge[axis] = [0, side - 1]
        second[tuple(edge)] = np.nan
        second -= _beside(second, axis)
        second -= _at_ties(second, axis)
        there = np.isfinite(second)
        total += np.where(there, second, 0)
        count += there
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / np.where(count > 0, count, np.nan)).reshape(-1, 3)


def _beside(cube: _Array, axis: int) -> _Array:
    """Return the median (n, n, n, 3) over the 25 codes of one value along an axis, up to two steps away across it."""
    across = [other for other in range(3) if other != axis]
    reach = [(2, 2) if other in across else (0, 0) for other in range(3)]
    padded = np.pad(cube, (*reach, (0, 0)), constant_values=np.nan)
    n = cube.shape[0]
    shifted: list[_Array] = []
    for one in range(5):
        for other in range(5):
            window = [slice(None)] * 3
            window[across[0]], window[across[1]] = slice(one, one + n), slice(other, other + n)
            shifted.append(padded[tuple(window)])
    around = np.stack(shifted)
    # NaN sorts last, so the middle of what is known stands at half their number.
    known = np.isfinite(around).sum(axis=0)
    ranked = np.sort(around, axis=0)
    low, high = (np.maximum(known - 1, 0) // 2)[None], (known // 2)[None]
    middle = 0.5 * (np.take_along_axis(ranked, low, axis=0) + np.take_along_axis(ranked, high, axis=0))[0]
    return np.where(known >= _LEAST_KNOWN, middle, np.nan)


def _at_ties(second: _Array, axis: int) -> _Array:
    """Return the median (n, n, n, 3) over the codes whose value along an axis equals one across it; 0 elsewhere.

    Of codes of like values, in which the third value is below, equal or above; NaN where too few are known.
    """
    values = np.indices(second.shape[:3])
    found = np.zeros_like(second)
    for other in {0, 1, 2} - {axis}:
        third = np.sign(values[3 - axis - other] - values[axis])
        for side in (-1, 0, 1):
            tied = np.nonzero((values[axis] == values[other]) & (third == side))
            value, bends = values[axis][tied], second[tied]
            known = np.isfinite(bends).all(axis=1)
            usual = np.full_like(bends, np.nan)
            for one in np.unique(value):
                alike = bends[known & (np.abs(value - one) <= 1)]
                if len(alike) >= _LEAST_TIED:
                    usual[value == one] = np.median(alike, axis=0)
            found[tied] = usual
    return found


def _of_neighbourhoods(log_ratios: _Array, near: npt.NDArray[np.intp]) -> tuple[_Array, _Array]:
    """Return the mean (C, 3) over each neighbourhood and its standard error; NaN where too few cells are known."""
    there = np.isfinite(log_ratios)
    spread = _usual(log_ratios)
    # A single cell may be far off; in a neighbourhood it weighs no more than four usual deviations beyond the median.
    values = log_ratios[near]
    with np.errstate(invalid="ignore"):
        known = there[near]
        count = known.sum(axis=1)
        middle = np.nanmedian(np.where(known.any(axis=1, keepdims=True), values, 0.0), axis=1)
        bounded = np.clip(values, (middle - 4 * spread)[:, None], (middle + 4 * spread)[:, None])
        mean = np.where(known, bounded, 0).sum(axis=1) / np.maximum(count, 1)
        inside = np.where(known, (bounded - mean[:, None]) ** 2, 0).sum(axis=1) / np.maximum(count - 1, 1)
        error = np.sqrt(np.maximum(inside, spread**2) / np.maximum(count, 1))
    enough = count >= _LEAST_NEIGHBOURS
    return np.where(enough, np.expm1(mean), np.nan), np.where(enough, error, np.nan)


def cell_mm(stains: Stains) -> float:
    """Return the side of the square that a cell stands for, mm."""
    size = np.ptp(stains.places_mm, axis=0)
    return float(np.sqrt(size[0] * size[1] / len(stains.places_mm)))


def joined_cells(stains: Stains, cells: _Index) -> list[_Index]:
    """Return cells (N,) int64 in groups of those that lie next to each other, the largest first."""
    if not len(cells):
        return []
    pairs = cKDTree(stains.places_mm[cells]).query_pairs(_BESIDE * cell_mm(stains), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, label = connected_components(graph, directed=False)
    return sorted((cells[label == number] for number in range(int(count))), key=len, reverse=True)


def spots_of(stains: Stains) -> list[_Index]:
    """Return the cells (N,) int64 of each spot of deviating cells, the largest first."""
    return joined_cells(stains, np.flatnonzero(stains.stained | stains.doubtful))


def spot_colour(stains: Stains, spot: _Index) -> _Array:
    """Return the median deviation (3,) float64 of a spot's cells by channel, a share; 0 where none is known."""
    alone = stains.alone[spot]
    return np.array([float(np.median(one[np.isfinite(one)])) if np.isfinite(one).any() else 0.0 for one in alone.T])


def light_of_spot(stains: Stains, spot: _Index, channel: int) -> tuple[float, float]:
    """Return the light added in a spot, of paper white, and the share of their own that its cells (N,) int64 keep.

    By least absolute deviations in one channel; NaN of too few cells.
    """
    seen, alone = stains.level[:, channel], stains.alone[:, channel]
    there = spot[np.isfinite(alone[spot]) & (alone[spot] > -0.99)]
    if len(there) < LEAST_CELLS:
        return np.nan, np.nan
    top = float(np.nanpercentile(seen, _BRIGHT_PERCENTILE))
    y = seen[there] / top
    x = y / (1 + alone[there])
    return least_absolute_line(x, y)


def added_light(stains: Stains) -> float:
    """Return the light that a large reflection adds to cells that are not listed, 0 … 1 of paper white; 0 without one.

    Spots are those of more than `LARGE_SPOT` of the cells that are brighter than their codes and keep `OWN_KEPT` of
    their own light. What deviates enough is listed as unfit and does no harm; a broad reflection goes on around it, and
    there the light is measured. Of several spots the most.
    """
    found = 0.0
    for spot in spots_of(stains):
        if len(spot) <= LARGE_SPOT * len(stains.places_mm):
            break
        colour = spot_colour(stains, spot)
        channel = int(np.argmax(np.abs(colour)))
        if not (colour[channel] > 0 and light_of_spot(stains, spot, channel)[1] >= OWN_KEPT):
            continue
        away = np.asarray(cKDTree(stains.places_mm[spot]).query(stains.places_mm)[0])
        around = np.flatnonzero((away < _AROUND * cell_mm(stains)) & ~stains.stained)
        added, _ = light_of_spot(stains, around, channel)
        found = max(found, float(np.nan_to_num(added)))
    return found
