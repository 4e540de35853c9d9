"""Light added to a place of the print, as a reflection does: the same to all cells there, whatever their colour.

A stain takes of each cell a share of its light, a reflection adds to each as much. So the light that cells of a place
show is a line over the light that they should have: its slope is the share of their own that they keep, and what it
leaves at 0 is the light added (dichromatic reflection: S. Shafer, Color Research & Application 10, 1985, eq. 1).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import least_absolute_line
from experiment.measures.stains import Stains

LEAST_CELLS = 6
"""Cells of a place for a line through them to mean anything."""

LARGE_SPOT = 0.005
"""Share of the cells from which on a place counts: that of the limit on unfit cells. A glint on fewer is listed, and
what it leaves around them is a few cells' error."""

OWN_KEPT = 0.85
"""Share of their own light that cells keep under a reflection at least: less, and something covers them (as in the
table of causes, where a hand is named below it)."""

_BRIGHT_PERCENTILE = 99.0
"""Of the cells' levels, what is taken for paper white."""

_BESIDE = 2.3
"""Distance, in sides of a cell, up to which deviating cells are of one place: one may lie between them."""

_AROUND = 2.5
"""Distance, in sides of a cell, from the cells of a spot up to which light is looked for in cells that are not listed:
two rings, of which the first is half in the neighbourhoods of the spot (chosen)."""

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]


def cell_mm(stains: Stains) -> float:
    """Return the side of the square that a cell stands for, mm."""
    size = np.ptp(stains.places_mm, axis=0)
    return float(np.sqrt(size[0] * size[1] / len(stains.places_mm)))


def joined_cells(stains: Stains, cells: _Index) -> list[_Index]:
    """Return cells (N,) int64 in groups of those that lie next to each other, the largest first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

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
    from scipy.spatial import cKDTree

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
