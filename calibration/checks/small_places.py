"""Cells next to each other that are far off: what covers too few to move a block's mean, as a finger's tip does.

A cell counts as far off that is beyond noise and the model's usual error, and beyond those whose codes are next to its
own. What a polynomial cannot follow is spread over the print at random and a hot photosite stands alone, so that two
such cells next to each other are a place; how many are enough follows from how many of the frame are far off at all.
What touches such a place and is off by less, or is too dark to be compared, belongs to it. On a chart whose colours lie
in order nothing is found.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_FAR = 5.0  # Standard deviations from which on a cell is far off: noise alone has one in a million comparisons there

# Standard deviations from which on a cell that stands alone is not what the print shows elsewhere (chosen: 707 frames
# of a full chart are 70 million comparisons, and no polynomial is exact at the cube's corners).
_ALONE = 8.0

_LEAST_ALONE = 0.05  # Deviation of such a cell, at least, as a share (chosen)

_ALSO = 3.0  # Standard deviations from which on a cell is part of a place that it touches

# Standard deviation of what a cell's code predicts, at least, as a share: photosites answer to some 0.4 % alike.
LEAST_MODEL_ERROR = 0.004

# Number of places of a size that a frame has by chance, from which on one of that size says nothing (chosen; in
# frames of healthy rooms hardly a cell is far off, and two next to each other need two).
_BY_CHANCE = 0.1

_NEXT = 1.6  # Distance, in distances of the nearest cell, up to which cells touch: diagonal ones do, 1.41

AROUND = 8  # Cells that touch one, at most

_ALIKE = 6  # Nearest codes that a cell is held against: one step along each axis of a cube of colours, either way


class SmallPlaces:
    """Finds cells that something covers in a frame, from how far each is off.

    `rgb`: (C, 3) printed codes. `cells_mm`: (C, 2) places. `usable`: (C,) bool, cells that are inside the frame and
    were not covered from the start.
    """

    def __init__(self, rgb: npt.ArrayLike, cells_mm: _Array, usable: _Mask) -> None:
        count = len(cells_mm)
        found = cKDTree(cells_mm).query(cells_mm, k=min(AROUND + 1, count))
        far, self._near = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int64)
        self._touching: _Mask = far <= _NEXT * float(np.median(far[:, 1]))
        self._touching[:, 0] = False
        codes = np.asarray(rgb, dtype=np.float64)
        self._alike: _Index = np.asarray(cKDTree(codes).query(codes, k=min(_ALIKE + 1, count))[1])[:, 1:]
        self._usable = usable

    def disturbed(self, deviation: _Array, sigma: _Array) -> tuple[_Index, _Array, _Index, _Index]:
        """Return the cells (N,) int64 that something covers, ascending, how far each is off (N,), a share, and others.

        The others are those of them that are far off by themselves (K,) int64, and cells that stand alone (M,) int64.

        `deviation`: (K, C) float64 of each channel that is lit, a share of what the code gives; NaN of cells not
        compared. `sigma`: (K, C) float64, its standard deviation: noise of both frames, and the model's usual error.
        """
        no_cells = np.zeros(0, dtype=np.int64)
        far = np.abs(deviation)
        far /= sigma
        candidates = np.flatnonzero((far > _FAR).any(axis=0))
        if not len(candidates):
            return no_cells, np.zeros(0), no_cells, no_cells
        own = deviation[:, candidates]
        alike = self._alike[candidates]
        like = np.where(np.isfinite(far[:, alike]), deviation[:, alike], np.nan)
        known = np.asarray(np.isfinite(like).any(axis=2))
        usual = np.where(known, np.nanmedian(np.where(known[..., None], like, 0.0), axis=2), 0.0)
        apart = np.abs(own - usual) / sigma[:, candidates]
        # As far off from its code as from those next to it.
        certain = np.nan_to_num(np.minimum(apart, far[:, candidates]))
        large = np.nan_to_num(np.minimum(np.abs(own), np.abs(own - usual))) > _LEAST_ALONE
        usable = self._usable[candidates]
        seeds = candidates[usable & (certain > _FAR).any(axis=0)]
        alone = candidates[usable & ((certain > _ALONE) & large).any(axis=0)]
        places = self._places(seeds)
        if not places.any():
            return no_cells, np.zeros(0), no_cells, alone
        compared = np.isfinite(far)
        far[~compared] = 0.0
        found = self._grown(places, self._usable & (far.max(axis=0) > _ALSO))
        # Nothing is known of those that are too dark, so that a place does not grow through them.
        found |= self._touched(found) & self._usable & ~compared.any(axis=0)
        cells = np.flatnonzero(found)
        worst = np.argmax(far[:, cells], axis=0)
        return cells, np.nan_to_num(deviation[worst, cells]), seeds[found[seeds]], alone[~found[alone]]

    def _places(self, seeds: _Index) -> _Mask:
        """Return which cells (C,) lie at places that chance does not make, given those far off (N,), ascending."""
        count, cells = len(self._usable), len(seeds)
        kept = np.zeros(count, dtype=np.bool_)
        number = np.full(count, -1)
        number[seeds] = np.arange(cells)
        other = np.where(self._touching[seeds], number[self._near[seeds]], -1)
        one, column = np.nonzero(other >= 0)
        if not len(one):
            return kept
        pairs = coo_matrix((np.ones(len(one)), (one, other[one, column])), shape=(cells, cells))
        label = connected_components(pairs, directed=False)[1]
        size = np.bincount(label)[label]
        # Of n cells strewn at random, n/2 (8 n / C)^(k - 1) places of k or more are to be expected.
        by_chance = 0.5 * cells * (AROUND * cells / count) ** (size - 1.0)
        # Where most of a print is far off, places are as large as it is.
        kept[seeds[(size > 1) & ((by_chance < _BY_CHANCE) | (size > cells // 2))]] = True
        return kept

    def _grown(self, places: _Mask, joins: _Mask) -> _Mask:
        """Return the places with all cells that touch them, directly or by way of others, and may join."""
        while True:
            more = self._touched(places) & joins & ~places
            if not more.any():
                return places
            places = places | more

    def _touched(self, places: _Mask) -> _Mask:
        """Return which cells (C,) touch one of the places."""
        touched, cells = np.zeros_like(places), np.flatnonzero(places)
        touched[self._near[cells][self._touching[cells]]] = True
        return touched


def cells_without_hot(cells: _Index, seeds: _Index, hot: _Mask, cells_mm: _Array) -> tuple[_Mask, _Index]:
    """Return which disturbed cells (N,) something covers, and which cells (M,) int64 stand alone, given the hot ones.

    A place counts on where two of its cells are far off without a hot photosite of their own. Of other places no more
    than one such cell is left.

    `cells`, `seeds`: (N,) int64, ascending, what `SmallPlaces.disturbed` found, and (K,) int64, those far off by
    themselves. `hot`: (C,) bool, cells that hold a photosite which is hot in the dark frames. `cells_mm`: (C, 2)
    places.
    """
    nearest = np.asarray(cKDTree(cells_mm).query(cells_mm, k=2)[0])[:, 1]
    pairs = cKDTree(cells_mm[cells]).query_pairs(_NEXT * float(np.median(nearest)), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    label = connected_components(graph, directed=False)[1]
    of_seed, own = label[np.searchsorted(cells, seeds)], ~hot[seeds]
    counts = np.bincount(of_seed[own], minlength=len(cells))
    return (counts[label] > 1) & ~hot[cells], seeds[own & (counts[of_seed] == 1)]
