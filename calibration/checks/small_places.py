"""Find small covered areas of the print, for example by a fingertip, from adjacent patches with large deviations.

Such an area is too small to change the mean of a block of patches. The deviation of a patch from the polynomial of
`calibration.checks.frame_consistency` is large if it exceeds noise and model error, also after subtraction of the
median deviation of patches with similar codes. Model errors are distributed at random over the print, and hot
photosites are isolated. Two adjacent patches with large deviations are therefore evidence of an object. If a frame has
many large deviations, more of them must be adjacent. Neighbours of an area are added to it if they deviate less or are
too dark to be compared. The colours of the chart must be in random order.
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

# Number of standard deviations above which a deviation is large. Noise alone exceeds it once in a million comparisons.
_LARGE_SIGMAS = 5.0

# Number of standard deviations above which an isolated patch is reported. It is larger, because a session has millions
# of comparisons, and the polynomial is less accurate at the corners of the colour cube. Chosen by judgement.
_ISOLATED_SIGMAS = 8.0

_MIN_ISOLATED_DEVIATION = 0.05  # Smallest relative deviation of an isolated patch that is reported; chosen by judgement

_NEIGHBOUR_SIGMAS = 3.0  # Standard deviations above which a patch next to an area is added to it

# Smallest relative standard deviation of a prediction, because the response of photosites differs by 0.4 %.
LEAST_MODEL_ERROR = 0.004

# An area is significant if chance gives fewer areas of this size in a frame than this number. Chosen by judgement.
_MAX_CHANCE_AREAS = 0.1

# Largest distance of adjacent patches, relative to the distance of patches in a row; diagonal neighbours have 1.41.
_ADJACENT_DISTANCE = 1.6

NEIGHBOUR_COUNT = 8  # Largest number of patches adjacent to a patch

_SIMILAR_COUNT = 6  # Number of patches with similar codes: both neighbours along each axis of the colour cube


class CoveredPatchFinder:
    """Finds covered patches in a frame from their deviations.

    `rgb`: (C, 3) printed codes. `cells_mm`: (C, 2) positions. `usable`: (C,) bool, patches inside the frame that were
    not covered in the reference frame.
    """

    def __init__(self, rgb: npt.ArrayLike, cells_mm: _Array, usable: _Mask) -> None:
        count = len(cells_mm)
        nearest = cKDTree(cells_mm).query(cells_mm, k=min(NEIGHBOUR_COUNT + 1, count))
        distance, self._near = np.asarray(nearest[0], dtype=np.float64), np.asarray(nearest[1], dtype=np.int64)
        self._is_adjacent: _Mask = distance <= _ADJACENT_DISTANCE * float(np.median(distance[:, 1]))
        self._is_adjacent[:, 0] = False
        codes = np.asarray(rgb, dtype=np.float64)
        self._similar: _Index = np.asarray(cKDTree(codes).query(codes, k=min(_SIMILAR_COUNT + 1, count))[1])[:, 1:]
        self._usable = usable

    def disturbed(self, deviation: _Array, sigma: _Array) -> tuple[_Index, _Array, _Index, _Index]:
        """Find covered patches and isolated deviations.

        `deviation`: (K, C) float64, relative deviation from the model in each lit channel; NaN if not compared.
        `sigma`: (K, C) float64, its standard deviation: noise of both frames and error of the model.

        Returns covered patches (N,) int64 in ascending order, their relative deviations (N,), the covered patches with
        large deviations (J,) int64, and isolated patches (M,) int64.
        """
        no_cells = np.zeros(0, dtype=np.int64)
        normalised = np.abs(deviation)
        normalised /= sigma
        candidates = np.flatnonzero((normalised > _LARGE_SIGMAS).any(axis=0))
        if not len(candidates):
            return no_cells, np.zeros(0), no_cells, no_cells
        own = deviation[:, candidates]
        similar = self._similar[candidates]
        similar_deviation = np.where(np.isfinite(normalised[:, similar]), deviation[:, similar], np.nan)
        is_known = np.asarray(np.isfinite(similar_deviation).any(axis=2))
        median = np.where(is_known, np.nanmedian(np.where(is_known[..., None], similar_deviation, 0.0), axis=2), 0.0)
        difference = np.abs(own - median) / sigma[:, candidates]
        # Both the deviation from the model and the difference from similar codes must be large.
        reliable = np.nan_to_num(np.minimum(difference, normalised[:, candidates]))
        large = np.nan_to_num(np.minimum(np.abs(own), np.abs(own - median))) > _MIN_ISOLATED_DEVIATION
        usable = self._usable[candidates]
        seeds = candidates[usable & (reliable > _LARGE_SIGMAS).any(axis=0)]
        isolated = candidates[usable & ((reliable > _ISOLATED_SIGMAS) & large).any(axis=0)]
        areas = self._significant_areas(seeds)
        if not areas.any():
            return no_cells, np.zeros(0), no_cells, isolated
        compared = np.isfinite(normalised)
        normalised[~compared] = 0.0
        covered = self._grown(areas, self._usable & (normalised.max(axis=0) > _NEIGHBOUR_SIGMAS))
        # Dark patches are included but not compared, so areas do not grow through them.
        covered |= self._neighbours_of(covered) & self._usable & ~compared.any(axis=0)
        patches = np.flatnonzero(covered)
        worst = np.argmax(normalised[:, patches], axis=0)
        return patches, np.nan_to_num(deviation[worst, patches]), seeds[covered[seeds]], isolated[~covered[isolated]]

    def _significant_areas(self, seeds: _Index) -> _Mask:
        """Return a mask (C,) of the patches with large deviations, `seeds` (N,), in areas too large for chance."""
        count, seed_count = len(self._usable), len(seeds)
        is_significant = np.zeros(count, dtype=np.bool_)
        number = np.full(count, -1)
        number[seeds] = np.arange(seed_count)
        neighbour = np.where(self._is_adjacent[seeds], number[self._near[seeds]], -1)
        first, column = np.nonzero(neighbour >= 0)
        if not len(first):
            return is_significant
        pairs = coo_matrix((np.ones(len(first)), (first, neighbour[first, column])), shape=(seed_count, seed_count))
        label = connected_components(pairs, directed=False)[1]
        size = np.bincount(label)[label]
        # Of n randomly distributed patches, n/2 (8 n / C)^(k - 1) areas with at least k patches are expected.
        expected_count = 0.5 * seed_count * (NEIGHBOUR_COUNT * seed_count / count) ** (size - 1.0)
        # If most of the print deviates, this formula is not valid. An area with most of the patches is significant.
        is_significant[seeds[(size > 1) & ((expected_count < _MAX_CHANCE_AREAS) | (size > seed_count // 2))]] = True
        return is_significant

    def _grown(self, areas: _Mask, joins: _Mask) -> _Mask:
        # Add patches of `joins` to the areas that they touch, until no more patches are added.
        while True:
            added = self._neighbours_of(areas) & joins & ~areas
            if not added.any():
                return areas
            areas = areas | added

    # Mask (C,) of the patches that are adjacent to a patch of `areas` (C,).
    def _neighbours_of(self, areas: _Mask) -> _Mask:
        touched, patches = np.zeros_like(areas), np.flatnonzero(areas)
        touched[self._near[patches][self._is_adjacent[patches]]] = True
        return touched


def cells_without_hot(cells: _Index, seeds: _Index, hot: _Mask, cells_mm: _Array) -> tuple[_Mask, _Index]:
    """Remove deviations that hot photosites cause: return a mask (N,) of the remaining disturbed patches.

    An area remains if at least two of its patches with large deviations have no hot photosite. If only one such patch
    is left, it becomes an isolated patch. The second result is the isolated patches (M,) int64.

    `cells`, `seeds`: (N,) and (J,) int64 in ascending order, from `CoveredPatchFinder.disturbed`: disturbed patches,
    and those of them with large deviations. `hot`: (C,) bool, patches with a photosite that is hot in the dark frames.
    `cells_mm`: (C, 2) positions.
    """
    nearest = np.asarray(cKDTree(cells_mm).query(cells_mm, k=2)[0])[:, 1]
    pairs = cKDTree(cells_mm[cells]).query_pairs(_ADJACENT_DISTANCE * float(np.median(nearest)), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    label = connected_components(graph, directed=False)[1]
    seed_label, is_valid_seed = label[np.searchsorted(cells, seeds)], ~hot[seeds]
    counts = np.bincount(seed_label[is_valid_seed], minlength=len(cells))
    return (counts[label] > 1) & ~hot[cells], seeds[is_valid_seed & (counts[seed_label] == 1)]
