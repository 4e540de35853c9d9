"""Find stains, folds, shadows and reflections on the print.

A stain changes whole patches, so neither the edges nor the noise of a patch reveal it. It is detected because
neighbouring patches deviate from patches with similar codes elsewhere on the sheet. If this deviation is statistically
significant and exceeds a limit, the patch is listed as unfit for use. No patch is corrected.

A stain absorbs a fraction of the light of a patch. A reflection adds the same light to all patches. In a spot, the
measured light is therefore a linear function of the predicted light. The slope is the remaining fraction of the patch's
light, and the intercept is the added light (dichromatic reflection: S. Shafer, Color Research & Application 10, 1985,
eq. 1).
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

# Number of patches in a neighbourhood: a patch and the twelve patches within two patch sides.
NEIGHBOURS = 13

STAINED = 0.02  # Smallest relative deviation of a neighbourhood whose central patch is listed as unfit

# Smallest relative deviation of a neighbourhood whose central patch is counted as doubtful. Clean simulated prints have
# almost no doubtful patches.
DOUBTFUL = 0.01

# Smallest significant deviation, in standard errors. By chance, one neighbourhood in 5·10⁸ exceeds it.
SIGNIFICANT = 6.0

# Smallest deviation of a patch at the rim of a stain, in standard deviations of single patches.
RIM_SIGMA = 4.0

LEAST_COUNTS = 30.0  # Smallest level of a judged patch: one count of stray light is already 3 % of it

# Smallest number of bits per channel. Two bits give four levels, too few to predict the curvature of the ink curve.
LEAST_BITS = 3


LEAST_CELLS = 6  # Smallest number of patches for the fit of a line (`light_of_spot`)

# A spot is large if it contains more than this fraction of all patches. Around a smaller reflection, few unlisted
# patches are affected.
LARGE_SPOT = 0.005

# Under a reflection, a patch keeps at least this fraction of its own light. If less is left, an object covers the
# patch.
OWN_KEPT = 0.85

_ROUNDS = 3  # Largest number of rounds; the patches that are stained in one round are not used in the next

# Smallest numbers of patches for a median of the curvature (see `_log_ratios`): among 25 similar codes, and among codes
# with two equal values.
_LEAST_SIMILAR_CODES, _LEAST_EQUAL_CODES = 9, 3

_LEAST_NEIGHBOURS = 5  # Smallest number of known patches in a neighbourhood for its mean

# With this many stained neighbours, a deviating patch belongs to the stain even if its neighbourhood does not deviate.
_MANY_STAINED = 2

_BRIGHT_PERCENTILE = 99.0  # Percentile of the patch levels that represents white paper

# Largest distance between neighbouring patches of one spot, in patch sides. One clean patch may lie between them.
_SPOT_DISTANCE = 2.3

# The added light of a spot is measured in unlisted patches within this distance, in patch sides. Two rings of patches
# are chosen by judgement.
_SURROUNDING_DISTANCE = 2.5

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stains:
    """Deviations of C patches from the prediction by patches with similar codes elsewhere on the sheet."""

    deviation: _Array  # (C, 3), measured / predicted light − 1, mean over the neighbourhood of a patch; NaN if unknown
    error: _Array  # (C, 3), standard error of `deviation`
    patch_deviation: _Array  # (C, 3), measured / predicted light − 1 of each patch alone; NaN if unknown
    stained: _Mask  # (C,), whether each patch is listed as unfit
    level: _Array  # (C, 3), mean counts above black
    places_mm: _Array  # (C, 2), positions of the patches on the sheet

    @property
    def doubtful(self) -> _Mask:
        """(C,) bool, whether the neighbourhood of each patch deviates by 1 % or more (fold, faint stain, shadow)."""
        return _is_significant(self.deviation, self.error, DOUBTFUL)

    @property
    def is_known(self) -> bool:
        """Whether any deviation is known."""
        return bool(np.isfinite(self.deviation).any())

    def largest_deviation(self) -> _Array:
        """Return the signed deviation (C,) float64 of the channel that deviates most; 0 if unknown."""
        return _largest_of_channels(self.deviation)

    def deviation_of(self, cell: int) -> float:
        """Return the signed deviation of a patch or of its neighbourhood, whichever is larger."""
        deviations = np.array(
            [_largest_of_channels(self.deviation[[cell]])[0], _largest_of_channels(self.patch_deviation[[cell]])[0]]
        )
        return float(deviations[np.abs(deviations).argmax()])


def _largest_of_channels(deviation: _Array) -> _Array:
    """Return the signed deviation (N,) of the channel that deviates most; 0 if none is known."""
    finite = np.nan_to_num(deviation)
    return np.take_along_axis(finite, np.abs(finite).argmax(axis=1)[:, None], axis=1)[:, 0]


def find_stains(level: _Array, centres_mm: _Array, bits: int, usable: _Mask | None = None) -> Stains:
    """Find neighbourhoods whose patches do not have the colours of their codes.

    Parameters
    ----------
    level
        (8**bits, 3) float64, mean counts above black by colour index, divided by the flat field; if possible averaged
        over all white frames.
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
    # A patch is predicted from patches with neighbouring codes, which are elsewhere on the sheet. The prediction is
    # repeated without the stained patches.
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
    # At the rim of a stain, only half of a neighbourhood is stained, so a patch is judged by its own deviation. Stained
    # neighbours must confirm it, because the prediction of a single patch may be wrong.
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
    """Return the logarithm (C, 3) of measured / predicted level of each patch; NaN without a prediction."""
    # Along each axis of the code, a patch is predicted by the mean logarithm of its two neighbours. The curvature of
    # the ink curve is missing in this mean. The curvature changes slowly, so its median over neighbouring codes is
    # subtracted. If two values of a code are equal, the curve has a bend, because printers replace equal amounts of
    # three inks by black.
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
    """Return the median (n, n, n, 3) over 25 codes: equal on `axis`, and up to two steps away on the other axes."""
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
    # NaN is sorted to the end, so the index of the median is half the number of finite values.
    known_count = np.isfinite(stack).sum(axis=0)
    ranked = np.sort(stack, axis=0)
    low, high = (np.maximum(known_count - 1, 0) // 2)[None], (known_count // 2)[None]
    middle = 0.5 * (np.take_along_axis(ranked, low, axis=0) + np.take_along_axis(ranked, high, axis=0))[0]
    return np.where(known_count >= _LEAST_SIMILAR_CODES, middle, np.nan)


def _median_at_equal_codes(curvature: _Array, axis: int) -> _Array:
    """Return the median curvature (n, n, n, 3) of similar codes with equal values on `axis` and on another axis.

    Codes are grouped by their third value: below, equal to or above the two equal values. NaN if too few codes are
    known; 0 for codes without equal values.
    """
    values = np.indices(curvature.shape[:3])
    medians = np.zeros_like(curvature)
    for other_axis in {0, 1, 2} - {axis}:
        third = np.sign(values[3 - axis - other_axis] - values[axis])
        for side in (-1, 0, 1):
            equal_codes = np.nonzero((values[axis] == values[other_axis]) & (third == side))
            value, bends = values[axis][equal_codes], curvature[equal_codes]
            is_finite = np.isfinite(bends).all(axis=1)
            group_medians = np.full_like(bends, np.nan)
            for code in np.unique(value):
                similar = bends[is_finite & (np.abs(value - code) <= 1)]
                if len(similar) >= _LEAST_EQUAL_CODES:
                    group_medians[value == code] = np.median(similar, axis=0)
            medians[equal_codes] = group_medians
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
    """Return the side of a square with the mean area of a patch, mm."""
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
    """Return the median relative deviation (3,) float64 of the patches of a spot; 0 if unknown."""
    own_deviation = stains.patch_deviation[spot]
    finite = [channel[np.isfinite(channel)] for channel in own_deviation.T]
    return np.array([float(np.median(values)) if len(values) else 0.0 for values in finite])


def light_of_spot(stains: Stains, spot: _Index, channel: int) -> tuple[float, float]:
    """Return the light added in a spot, relative to white paper, and the remaining fraction of the patches' own light.

    These are intercept and slope of a line fitted to one channel by least absolute deviations. NaN if there are too few
    patches.
    """
    levels, own_deviation = stains.level[:, channel], stains.patch_deviation[:, channel]
    patches = spot[np.isfinite(own_deviation[spot]) & (own_deviation[spot] > -0.99)]
    if len(patches) < LEAST_CELLS:
        return np.nan, np.nan
    white_level = float(np.nanpercentile(levels, _BRIGHT_PERCENTILE))
    y = levels[patches] / white_level
    x = y / (1 + own_deviation[patches])
    return least_absolute_line(x, y)


def added_light(stains: Stains) -> float:
    """Return the light that a large reflection adds to patches that are not listed, 0 … 1 of white paper.

    A spot is a large reflection if it has more than `LARGE_SPOT` of all patches, is brighter than predicted, and keeps
    at least `OWN_KEPT` of its own light. The patches of the spot are listed as unfit, but a broad reflection continues
    around them. There the added light is measured. The result is the largest value of all reflections; 0 without
    reflections.
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
