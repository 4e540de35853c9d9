"""Stains, folds, shadows and reflections on the print: patches that do not have the colour of their code.

A stain changes whole patches, so that neither edges nor noise of a patch show it, and the look-up table (LUT) would
contain the colours of a dirty print. It is detected as a neighbourhood that deviates from patches
with similar codes elsewhere on the sheet. A deviation must be significant and exceed a limit. It is listed and never
corrected.

A stain absorbs a fraction of the light of a patch; a reflection adds the same light to all patches. In a spot, the
measured light is therefore a linear function of the expected light. The slope is the fraction that remains, the
intercept is the added light (dichromatic reflection: S. Shafer, Color Research & Application 10, 1985, eq. 1).
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

# A patch and the twelve patches within two patch sides: a tenth of a stain the size of a thumb, with patches of 5 mm
NEIGHBOURS = 13

STAINED = 0.02  # Relative deviation of a neighbourhood from which its patches are listed as unfit

# Relative deviation from which patches are counted and shown. In clean prints of the simulated laboratory, only one
# patch exceeds it.
DOUBTFUL = 0.01

# Deviation that is required in addition, in standard errors; by chance, one neighbourhood in 5·10⁸ exceeds it
SIGNIFICANT = 6.0

# Deviation of a patch next to a stain, in standard deviations of single patches, from which it belongs to the stain
RIM_SIGMA = 4.0

LEAST_COUNTS = 30.0  # Darker patches are not judged: one count of stray light is 3 % of them

# Fewest bits per channel: with 2, the curvature over the four levels of a code cannot be predicted.
LEAST_BITS = 3


LEAST_CELLS = 6  # Fewest patches for a line fit

# Fraction of the patches from which a spot is large: the limit of unfit patches. A smaller reflection is listed too,
# and outside its listed patches it affects only a few others.
LARGE_SPOT = 0.005

# Smallest fraction of its own light that a patch keeps under a reflection. Below this value, an object covers the patch
# (the table of causes reports a hand).
OWN_KEPT = 0.85

_ROUNDS = 3  # Largest number of repetitions, each without the previously stained patches in the predictions

_LEAST_KNOWN = 9  # Fewest known codes of the 25 across an axis for a median curvature

_LEAST_TIED = 3  # Fewest known codes with two equal values for a median bend

_LEAST_NEIGHBOURS = 5  # Fewest known patches of a neighbourhood for its mean

# With this many stained neighbours, a patch belongs to the stain even if its neighbourhood does not deviate.
_MANY_STAINED = 2

_BRIGHT_PERCENTILE = 99.0  # Percentile of the patch levels that counts as white paper

_SPOT_DISTANCE = 2.3  # Largest distance between patches of one spot, in patch sides: one patch may lie between them

# Largest distance from a spot, in patch sides, at which added light is measured in unlisted patches: two rings of
# patches. Half of the first ring is in neighbourhoods of the spot (judgement).
_SURROUNDING_DISTANCE = 2.5

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stains:
    """Deviations of C patches from the prediction by patches with similar codes elsewhere on the sheet."""

    deviation: _Array  # (C, 3), measured / expected − 1 of the neighbourhood of each patch; NaN if unknown
    error: _Array  # (C, 3), standard error of `deviation`
    alone: _Array  # (C, 3), deviation of each patch alone, with noise and error of the prediction; NaN if unknown
    stained: _Mask  # (C,), patches to be listed
    level: _Array  # (C, 3), mean counts above black
    places_mm: _Array  # (C, 2), positions of the patches on the sheet

    @property
    def doubtful(self) -> _Mask:
        """(C,) bool, patches in neighbourhoods that deviate by 1 % or more: folds, faint stains, shadows."""
        return _is_significant(self.deviation, self.error, DOUBTFUL)

    @property
    def is_known(self) -> bool:
        """Whether any deviation is known."""
        return bool(np.isfinite(self.deviation).any())

    def largest_deviation(self) -> _Array:
        """Return the signed deviation (C,) float64 of the channel that deviates most; 0 if unknown."""
        return _largest_of_channels(self.deviation)

    def deviation_of(self, cell: int) -> float:
        """Return the signed deviation of a stained patch: of its neighbourhood or its own, whichever is larger."""
        deviations = np.array(
            [_largest_of_channels(self.deviation[[cell]])[0], _largest_of_channels(self.alone[[cell]])[0]]
        )
        return float(deviations[np.abs(deviations).argmax()])


def _largest_of_channels(deviation: _Array) -> _Array:
    """Return the signed deviation (N,) of the channel that deviates most; 0 if none is known."""
    finite = np.nan_to_num(deviation)
    return np.take_along_axis(finite, np.abs(finite).argmax(axis=1)[:, None], axis=1)[:, 0]


def find_stains(level: _Array, centres_mm: _Array, bits: int, usable: _Mask | None = None) -> Stains:
    """Find patches in neighbourhoods that do not have the colours of their codes.

    Parameters
    ----------
    level
        (8**bits, 3) float64, mean counts above black by colour index, divided by the flat field; best averaged over
        all white frames.
    centres_mm
        (8**bits, 2) float64, position of each colour on the sheet.
    bits
        Bits per channel of the chart.
    usable
        (8**bits,) bool, patches that are not covered, cut off or clipped; all by default.
    """
    if bits < LEAST_BITS:
        unknown = np.full(level.shape, np.nan)
        return Stains(unknown, unknown, unknown, np.zeros(len(level), dtype=np.bool_), level, centres_mm)
    usable = np.ones(len(level), dtype=np.bool_) if usable is None else usable
    neighbours = np.asarray(cKDTree(centres_mm).query(centres_mm, k=min(NEIGHBOURS, len(level)))[1])
    neighbours = neighbours.reshape(len(level), -1)
    clean = usable.copy()
    deviation, error, log_ratios = (np.full(level.shape, np.nan) for _ in range(3))
    stained = np.zeros(len(level), dtype=np.bool_)
    # Patches of neighbouring codes, which lie elsewhere on the sheet, predict a patch. The prediction needs no model of
    # ink or paper, and hardly depends on the position. It is repeated without stained patches, which reduce accuracy.
    for _ in range(_ROUNDS):
        log_ratios = _log_ratios(np.where(clean[:, None], level, np.nan), level, usable, bits)
        deviation, error = _neighbourhood_means(log_ratios, neighbours)
        significant = _is_significant(deviation, error, STAINED)
        if (significant == stained).all():
            break
        stained = significant
        clean = usable & ~stained
    with np.errstate(invalid="ignore"):
        limit = np.maximum(RIM_SIGMA * _patch_sigma(log_ratios), STAINED)
        is_deviating = (np.abs(np.expm1(log_ratios)) > limit).any(axis=1)
    # Next to a stain a patch is judged alone, because only half of its neighbourhood is stained. That half must
    # deviate too; otherwise, the prediction of the patch is wrong.
    stained_neighbours = stained[neighbours].sum(axis=1)
    is_affected = (np.abs(np.nan_to_num(deviation)) >= DOUBTFUL).any(axis=1) | (stained_neighbours >= _MANY_STAINED)
    rim = is_deviating & is_affected & (stained_neighbours > 0)
    return Stains(deviation, error, np.expm1(log_ratios), stained | rim, level, centres_mm)


def _patch_sigma(log_ratios: _Array) -> _Array:
    is_finite = np.isfinite(log_ratios)
    return np.array([robust_sigma(log_ratios[is_finite[:, c], c]) if is_finite[:, c].any() else 0 for c in range(3)])


def _is_significant(deviation: _Array, error: _Array, threshold: float) -> _Mask:
    return np.asarray((np.abs(deviation) > np.maximum(SIGNIFICANT * error, threshold)).any(axis=1))


def _log_ratios(clean_level: _Array, level: _Array, usable: _Mask, bits: int) -> _Array:
    """Return the log ratio (C, 3) of each patch to the prediction by its neighbours in colour; NaN without them."""
    # Along each axis of the code, the mean logarithm of both neighbours predicts the patch, except for the curvature.
    # The curvature changes slowly across the axis, so its median over neighbouring codes is subtracted. At equal values
    # of a code there is a bend, because black replaces the ink that all three colours have in common.
    side = 1 << bits
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(np.where(clean_level > LEAST_COUNTS, clean_level, np.nan)).reshape(side, side, side, 3)
        own_logs = np.log(np.where((level > LEAST_COUNTS) & usable[:, None], level, np.nan)).reshape(logs.shape)
    sums, count = np.zeros_like(own_logs), np.zeros_like(own_logs)
    for axis in range(3):
        previous, following = (np.roll(logs, step, axis=axis) for step in (1, -1))
        curvature = own_logs - 0.5 * (previous + following)
        edge: list[slice | list[int]] = [slice(None)] * 3
        edge[axis] = [0, side - 1]
        curvature[tuple(edge)] = np.nan
        curvature -= _median_over_neighbour_codes(curvature, axis)
        curvature -= _median_at_equal_codes(curvature, axis)
        is_finite = np.isfinite(curvature)
        sums += np.where(is_finite, curvature, 0)
        count += is_finite
    with np.errstate(invalid="ignore", divide="ignore"):
        return (sums / np.where(count > 0, count, np.nan)).reshape(-1, 3)


def _median_over_neighbour_codes(cube: _Array, axis: int) -> _Array:
    """Return the median (n, n, n, 3) over the 25 codes with the same value on an axis, up to two steps away."""
    across = [other_axis for other_axis in range(3) if other_axis != axis]
    padding = [(2, 2) if other_axis in across else (0, 0) for other_axis in range(3)]
    padded = np.pad(cube, (*padding, (0, 0)), constant_values=np.nan)
    n = cube.shape[0]
    shifted: list[_Array] = []
    for i in range(5):
        for j in range(5):
            window = [slice(None)] * 3
            window[across[0]], window[across[1]] = slice(i, i + n), slice(j, j + n)
            shifted.append(padded[tuple(window)])
    stack = np.stack(shifted)
    # NaN is sorted last, so the median is at half the number of finite values.
    known_count = np.isfinite(stack).sum(axis=0)
    ranked = np.sort(stack, axis=0)
    low, high = (np.maximum(known_count - 1, 0) // 2)[None], (known_count // 2)[None]
    middle = 0.5 * (np.take_along_axis(ranked, low, axis=0) + np.take_along_axis(ranked, high, axis=0))[0]
    return np.where(known_count >= _LEAST_KNOWN, middle, np.nan)


def _median_at_equal_codes(curvature: _Array, axis: int) -> _Array:
    """Return the median (n, n, n, 3) over similar codes with equal values on an axis and another one; 0 elsewhere.

    Codes with a third value below, equal to or above the two equal ones are separate groups. NaN if too few are known.
    """
    values = np.indices(curvature.shape[:3])
    medians = np.zeros_like(curvature)
    for other_axis in {0, 1, 2} - {axis}:
        third = np.sign(values[3 - axis - other_axis] - values[axis])
        for side in (-1, 0, 1):
            tied = np.nonzero((values[axis] == values[other_axis]) & (third == side))
            value, bends = values[axis][tied], curvature[tied]
            is_finite = np.isfinite(bends).all(axis=1)
            group_medians = np.full_like(bends, np.nan)
            for code in np.unique(value):
                similar = bends[is_finite & (np.abs(value - code) <= 1)]
                if len(similar) >= _LEAST_TIED:
                    group_medians[value == code] = np.median(similar, axis=0)
            medians[tied] = group_medians
    return medians


def _neighbourhood_means(log_ratios: _Array, neighbours: npt.NDArray[np.intp]) -> tuple[_Array, _Array]:
    """Return the mean (C, 3) over each neighbourhood and its standard error; NaN if too few patches are known."""
    is_finite = np.isfinite(log_ratios)
    sigma = _patch_sigma(log_ratios)
    # Limit the deviation of a single patch to four standard deviations from the median.
    values = log_ratios[neighbours]
    with np.errstate(invalid="ignore"):
        is_known = is_finite[neighbours]
        count = is_known.sum(axis=1)
        median = np.nanmedian(np.where(is_known.any(axis=1, keepdims=True), values, 0.0), axis=1)
        bounded = np.clip(values, (median - 4 * sigma)[:, None], (median + 4 * sigma)[:, None])
        mean = np.where(is_known, bounded, 0).sum(axis=1) / np.maximum(count, 1)
        variance = np.where(is_known, (bounded - mean[:, None]) ** 2, 0).sum(axis=1) / np.maximum(count - 1, 1)
        error = np.sqrt(np.maximum(variance, sigma**2) / np.maximum(count, 1))
    has_enough = count >= _LEAST_NEIGHBOURS
    return np.where(has_enough, np.expm1(mean), np.nan), np.where(has_enough, error, np.nan)


def cell_mm(stains: Stains) -> float:
    """Return the side of the square area of one patch, mm."""
    size = np.ptp(stains.places_mm, axis=0)
    return float(np.sqrt(size[0] * size[1] / len(stains.places_mm)))


def joined_cells(stains: Stains, cells: _Index) -> list[_Index]:
    """Group adjacent patches (N,) int64, the largest group first."""
    if not len(cells):
        return []
    pairs = cKDTree(stains.places_mm[cells]).query_pairs(_SPOT_DISTANCE * cell_mm(stains), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, label = connected_components(graph, directed=False)
    return sorted((cells[label == number] for number in range(int(count))), key=len, reverse=True)


def spots_of(stains: Stains) -> list[_Index]:
    """Return the patches (N,) int64 of each spot of deviating patches, the largest first."""
    return joined_cells(stains, np.flatnonzero(stains.stained | stains.doubtful))


def spot_colour(stains: Stains, spot: _Index) -> _Array:
    """Return the median deviation (3,) float64 of the patches of a spot, relative; 0 if unknown."""
    alone = stains.alone[spot]
    finite = [channel[np.isfinite(channel)] for channel in alone.T]
    return np.array([float(np.median(values)) if len(values) else 0.0 for values in finite])


def light_of_spot(stains: Stains, spot: _Index, channel: int) -> tuple[float, float]:
    """Return the light added in a spot, relative to white paper, and the fraction of their light that its patches keep.

    A line is fitted to one channel by least absolute deviations. NaN if there are too few patches.
    """
    levels, alone = stains.level[:, channel], stains.alone[:, channel]
    patches = spot[np.isfinite(alone[spot]) & (alone[spot] > -0.99)]
    if len(patches) < LEAST_CELLS:
        return np.nan, np.nan
    white_level = float(np.nanpercentile(levels, _BRIGHT_PERCENTILE))
    y = levels[patches] / white_level
    x = y / (1 + alone[patches])
    return least_absolute_line(x, y)


def added_light(stains: Stains) -> float:
    """Return the light that a large reflection adds to patches that are not listed, 0 … 1 of white paper.

    A reflection is a spot of more than `LARGE_SPOT` of the patches that are brighter than predicted and keep `OWN_KEPT`
    of their own light. The patches of the spot are listed as unfit, so they are not used. A broad reflection continues
    around the spot, and is measured there. Return the largest value of all reflections; 0 without one.
    """
    largest = 0.0
    for spot in spots_of(stains):
        if len(spot) <= LARGE_SPOT * len(stains.places_mm):
            break
        colour = spot_colour(stains, spot)
        channel = int(np.argmax(np.abs(colour)))
        if not (colour[channel] > 0 and light_of_spot(stains, spot, channel)[1] >= OWN_KEPT):
            continue
        distances = np.asarray(cKDTree(stains.places_mm[spot]).query(stains.places_mm)[0])
        surrounding = np.flatnonzero((distances < _SURROUNDING_DISTANCE * cell_mm(stains)) & ~stains.stained)
        added, _ = light_of_spot(stains, surrounding, channel)
        largest = max(largest, float(np.nan_to_num(added)))
    return largest
