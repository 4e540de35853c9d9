"""Compare every frame with the frame registered first (the reference frame): patches, camera, lens and exposure.

A frame may be faulty although the white frames before and after it are correct. For any two illuminants and any inks,
the ratio of a patch to its value in the reference frame is a smooth function of the printed code. In each channel, a
polynomial in the code is fitted to this ratio. The residual consists of noise, errors of the polynomial and faults of
the frame. The codes are in random order on the print, so errors of the polynomial are random over the print as well.
Three values describe the faults:

- `scatter` is the scatter of all patches. It is large if the frame is blurred, because neighbours mix, or if the
  patches have another order. Scatter that noise can cause is subtracted.
- `block` is the mean of neighbouring patches. It is large if a hand, a shadow or a reflection covers an area. A patch
  that differs from all its neighbours, for example by a hot photosite, gets the nearest value of a neighbour.
- `disturbed` lists adjacent patches with large deviations, in areas too small to change the mean of a block
  (`calibration.checks.small_places`).

Charts of 8 and 64 patches cannot be checked, because the polynomial has too many terms for them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from calibration import kernels
from calibration.checks.small_places import LEAST_MODEL_ERROR, NEIGHBOUR_COUNT, CoveredPatchFinder, cells_without_hot
from drivers.raw.rawfile import FrameOrigin
from experiment.measures.least_squares import (
    code_polynomial,
    code_powers,
    least_absolute_line,
    least_squares,
    linear_combinations,
    product,
)
from experiment.session.records import FrameRecord
from foundation.robust import huber_weights, robust_sigma

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

DEGREE = 4  # Degree of the polynomial in the code: 35 terms

LEAST_COUNTS = 60.0  # Patches with fewer expected counts are not compared: the mean of 25 samples has an error of 3 %

# Largest number of patches for scatter and blocks: a quarter of a full chart, to save time in every frame.
MAX_CELLS = 8192

FIT_CELLS = 1500  # Approximate number of patches for fitting the polynomial: forty per term

# Compared patches of a block. On a full A0 chart, where every fourth patch is compared, a block is a square of 60 mm.
BLOCK_CELLS = 32

LEAST_CELLS = 12  # Minimum number of compared patches in a block

CELLS_PER_TERM = 2  # Minimum number of patches per term; with fewer, the polynomial would fit faults

_ROUNDS = 3  # Number of reweighted solutions after the unweighted one

# Number of standard uncertainties subtracted from the mean of a block and from the scatter. With the 256 blocks of a
# full chart, noise alone exceeds them in one of sixty frames.
_CERTAIN_SIGMAS = 4.0

# Variance of the standard deviation of N normal values that is estimated from their median deviation, in units of σ²/N
# (P. Rousseeuw and C. Croux, Journal of the American Statistical Association 88, 1993: an efficiency of 37 %).
_SPREAD_ERROR2 = 1.36

_SAME_FAULT_RATIO = 0.3  # Deviation relative to the worst block above which a block belongs to the same fault

# Percentile of the expected levels of patches that represents the brightest patch.
_BRIGHT_PERCENTILE = 99.0

# Standard uncertainty of a predicted patch: a fraction of its level, plus a number of counts.
_MODEL_ERROR, _LEAST_ERROR = 0.02, 3.0


@dataclass(frozen=True)
class FrameConsistency:
    """Differences between a frame and the reference frame; 0 if no patch can be compared."""

    # relative scatter about the polynomial, minus noise and four standard uncertainties, in the worst channel
    scatter: float = 0.0
    block: float = 0.0  # relative deviation of the worst block, minus four standard uncertainties
    at_mm: tuple[float, float] = (0.0, 0.0)  # centre of the worst block on the print
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)  # relative deviation of this block in R, G, B; 0 if dim
    share: float = 0.0  # share of the blocks with at least 0.3 times this deviation
    extent_mm: float = 0.0  # side of a square with the area of these blocks
    added: float = 0.0  # light added to these blocks, relative to the brightest patch
    kept: float = 1.0  # fraction of their own light that these blocks still have
    # covered patches, and the relative deviation of each: worst channel, 0 if too dark
    disturbed: tuple[tuple[int, float], ...] = ()
    seeds: tuple[int, ...] = ()  # disturbed patches with large deviations; other disturbed patches are adjacent to them
    isolated: tuple[int, ...] = ()  # isolated patches with a large deviation

    def without_hot(self, hot: _Mask, cells_mm: _Array) -> FrameConsistency:
        """Return the same result without patches that deviate because of hot photosites.

        `hot`: (C,) bool, patches with a photosite that is hot in the dark frames. `cells_mm`: (C, 2) positions.
        """
        cells = np.array([cell for cell, _ in self.disturbed], dtype=np.int64)
        if not hot[cells].any():
            return self
        is_disturbed, single = cells_without_hot(cells, np.array(self.seeds, dtype=np.int64), hot, cells_mm)
        disturbed = tuple(patch for patch, valid in zip(self.disturbed, is_disturbed.tolist(), strict=True) if valid)
        seeds = tuple(cell for cell in self.seeds if is_disturbed[np.searchsorted(cells, cell)])
        isolated = tuple(sorted({*self.isolated, *single.tolist()}))
        return replace(self, disturbed=disturbed, seeds=seeds, isolated=isolated)


@dataclass(frozen=True, eq=False)
class _Deviations:
    """Residuals of one channel."""

    solution: _Array  # (K,) coefficients of the polynomial
    measured: _Array  # (N,) counts of the patches compared for blocks; NaN if not comparable
    expected: _Array  # (N,) counts that the polynomial predicts for these patches
    scatter: float  # relative scatter of all patches, without noise
    significant_scatter: float  # part of `scatter` that exceeds its uncertainty
    mean: _Array  # (B,) relative deviation of each block
    excess: _Array  # (B,) part of the absolute deviation that exceeds noise


@dataclass(frozen=True, eq=False)
class _Channel:
    """One channel of the reference frame, prepared for comparisons."""

    terms: _Array  # (N, K) terms of the polynomial for each compared patch
    level: _Array  # (N,) counts of these patches
    bright: npt.NDArray[np.int64]  # indices of patches that are bright enough
    fitted: npt.NDArray[np.int64]  # indices of the F patches to which the polynomial is fitted
    design: _Array  # (F, K) design matrix of the fit

    @staticmethod
    def of(terms: _Array, level: _Array, usable: _Mask) -> _Channel:
        bright = np.flatnonzero(usable & (level > LEAST_COUNTS))
        fitted = bright[:: max(1, len(bright) // FIT_CELLS)]
        return _Channel(terms, level, bright, fitted, terms[fitted] * level[fitted, None])


def has_enough_cells(cells: int) -> bool:
    """Return whether a chart with this number of patches can be checked."""
    return cells >= CELLS_PER_TERM * len(code_powers(DEGREE))


class ConsistencyCheck:
    """Compares frames under any illuminant with one reference frame of the chart.

    Parameters
    ----------
    rgb : (C, 3) int
        Printed codes.
    cells_mm : (C, 2) float64
        Positions of the patches on the print.
    level, variance : (C, 3) float64
        Mean counts above black level in the reference frame, divided by the illumination field, and their variance.
    usable : (C,) bool
        Patches inside the frame that are not covered.
    """

    def __init__(self, rgb: npt.ArrayLike, cells_mm: _Array, level: _Array, variance: _Array, usable: _Mask) -> None:
        # Blocks are means over many patches, so every fourth patch of a full chart is sufficient.
        self._selection = slice(None, None, max(1, len(cells_mm) // MAX_CELLS))
        all_terms = code_polynomial(np.asarray(rgb), DEGREE)
        terms = np.ascontiguousarray(all_terms[self._selection])
        self._usable = usable[self._selection]
        self._channels = [_Channel.of(terms, level[self._selection, channel], self._usable) for channel in range(3)]
        self._basis = np.ascontiguousarray(all_terms.T)
        self._level = np.where(usable[:, None] & (level > LEAST_COUNTS), level, np.nan).T.copy()
        self._noise2 = np.ascontiguousarray((variance / np.maximum(level, 1.0) ** 2).T)
        self._covered_finder = CoveredPatchFinder(rgb, cells_mm, usable)
        compared_mm = cells_mm[self._selection]
        block, self._block_centres, self._block_mm2 = _blocks(compared_mm)
        self._members = _members(block, len(self._block_centres))
        # Each deviation is limited to the deviations of its eight neighbours, so that a single patch cannot change the
        # mean of a block. A covered area contains several patches, so it is not affected.
        neighbours = cKDTree(compared_mm).query(compared_mm, k=min(NEIGHBOUR_COUNT + 1, len(compared_mm)))[1]
        self._around = np.ascontiguousarray(np.atleast_2d(neighbours), dtype=np.int64)

    def compare(self, mean: _Array, variance: _Array) -> FrameConsistency:
        """Compare a frame with the reference.

        `mean`: (C, 3) float64, mean counts above black level of all patches, divided by the illumination field.
        `variance`: (C, 3) float64, of these means.
        """
        means, variances = mean[self._selection], variance[self._selection]
        light = np.median(means[self._usable], axis=0)
        results = {
            int(channel): self._channel_deviations(self._channels[channel], means[:, channel], variances[:, channel])
            for channel in np.flatnonzero(light >= 0.2 * light.max())
        }
        valid = {channel: deviations for channel, deviations in results.items() if deviations is not None}
        if not valid:
            return FrameConsistency()
        disturbed, seeds, isolated = self._disturbed(valid, mean, variance)
        scatter = max(deviations.significant_scatter for deviations in valid.values())
        excess = np.max([deviations.excess for deviations in valid.values()], axis=0)
        worst = int(np.argmax(excess))
        if not excess[worst] > 0:
            return FrameConsistency(scatter, disturbed=disturbed, seeds=seeds, isolated=isolated)
        affected = np.flatnonzero(excess >= _SAME_FAULT_RATIO * excess[worst])
        red, green, blue = (float(valid[c].mean[worst]) if c in valid else 0.0 for c in range(3))
        x, y = self._block_centres[worst].tolist()
        added, kept = _fit_added_light(list(valid.values()), self._members[affected])
        return FrameConsistency(
            scatter=scatter,
            block=float(excess[worst]),
            at_mm=(x, y),
            colour=(red, green, blue),
            share=len(affected) / len(excess),
            extent_mm=float(np.sqrt(len(affected) * self._block_mm2)),
            added=added,
            kept=kept,
            disturbed=disturbed,
            seeds=seeds,
            isolated=isolated,
        )

    def _disturbed(
        self, valid: dict[int, _Deviations], mean: _Array, variance: _Array
    ) -> tuple[tuple[tuple[int, float], ...], tuple[int, ...], tuple[int, ...]]:
        channels = sorted(valid)
        factors = np.zeros((3, len(self._basis)))
        for channel in channels:
            factors[channel] = valid[channel].solution
        sums = linear_combinations(self._basis, factors)
        deviation, sigma = np.empty((2, len(channels), len(mean)))
        for row, channel in enumerate(channels):
            with np.errstate(invalid="ignore"):
                expected = sums[channel] * self._level[channel]
                expected[~(expected > LEAST_COUNTS)] = np.nan
            np.divide(mean[:, channel], expected, out=deviation[row])
            deviation[row] -= 1
            np.divide(variance[:, channel], expected**2, out=sigma[row])
            sigma[row] += self._noise2[channel]
            sigma[row] += max(valid[channel].scatter, LEAST_MODEL_ERROR) ** 2
        np.sqrt(sigma, out=sigma)
        cells, worst_deviation, seeds, isolated = self._covered_finder.disturbed(deviation, sigma)
        disturbed = tuple(zip(cells.tolist(), worst_deviation.round(6).tolist(), strict=True))
        return disturbed, tuple(seeds.tolist()), tuple(isolated.tolist())

    def _channel_deviations(self, reference: _Channel, mean: _Array, variance: _Array) -> _Deviations | None:
        if len(reference.bright) < CELLS_PER_TERM * reference.terms.shape[1]:
            return None
        design, level, measured = reference.design, reference.level[reference.fitted], mean[reference.fitted]
        # The weights depend on expected levels. With measured levels, dark covered patches would have large weights.
        sigma = _MODEL_ERROR * float(np.median(measured / level)) * level + _LEAST_ERROR
        if not sigma.min() > 0:
            return None
        weights = 1 / sigma**2
        solution = least_squares(design, measured, weights)
        for _ in range(_ROUNDS):
            residual = np.abs(measured - product(design, solution)) / sigma
            spread = max(robust_sigma(residual), 1e-9)
            solution = least_squares(design, measured, weights * huber_weights(residual, spread) ** 2)
        expected, bright = product(reference.terms, solution) * reference.level, reference.bright
        bright = bright[expected[bright] > LEAST_COUNTS]
        if len(bright) < LEAST_CELLS:
            return None
        deviation = np.full(len(mean) + 1, np.nan)
        deviation[bright] = np.clip(mean[bright] / expected[bright] - 1, -1, 1)
        scatter2 = robust_sigma(deviation[bright] - np.median(deviation[bright])) ** 2
        noise2 = float(np.median(variance[bright] / expected[bright] ** 2))
        # The relative uncertainty of a square is twice the uncertainty of its root.
        error = _CERTAIN_SIGMAS * 2 * float(np.sqrt(_SPREAD_ERROR2 / len(bright)))
        kernels.clipped_to_neighbours(deviation[:-1].copy(), self._around, deviation[:-1])
        block_deviations = deviation[self._members]
        count = np.isfinite(block_deviations).sum(axis=1)
        average = np.nansum(block_deviations, axis=1) / np.maximum(count, 1)
        excess = np.abs(average) - _CERTAIN_SIGMAS * np.sqrt(scatter2 / np.maximum(count, 1))
        compared = np.isfinite(deviation[:-1])
        return _Deviations(
            solution=solution,
            measured=np.where(compared, mean, np.nan),
            expected=np.where(compared, expected, np.nan),
            scatter=float(np.sqrt(max(scatter2 - noise2, 0))),
            significant_scatter=float(np.sqrt(max(scatter2 / (1 + error) - noise2, 0))),
            mean=average,
            excess=np.where(count >= LEAST_CELLS, excess, 0.0),
        )


def _fit_added_light(channels: list[_Deviations], members: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Return the added light, relative to the brightest patch, and the remaining fraction of the patches' own light.

    They are intercept and slope of measured against expected levels. The line is fitted by least absolute deviations,
    because of outliers. `members`: (B, M) patches of the blocks; −1 for none.
    """
    cells = members[members >= 0]
    own: list[_Array] = []
    measured: list[_Array] = []
    for deviations in channels:
        compared = cells[np.isfinite(deviations.expected[cells])]
        # A dim channel may have no compared patches in these blocks.
        if not len(compared):
            continue
        brightest = float(np.nanpercentile(deviations.expected, _BRIGHT_PERCENTILE))
        own.append(deviations.expected[compared] / brightest)
        measured.append(deviations.measured[compared] / brightest)
    if sum(map(len, own)) < LEAST_CELLS:
        return 0.0, 1.0
    return least_absolute_line(np.concatenate(own), np.concatenate(measured))


def _members(block: npt.NDArray[np.int64], blocks: int) -> npt.NDArray[np.int64]:
    count = np.bincount(block, minlength=blocks)
    members = np.full((blocks, int(count.max(initial=1))), -1, dtype=np.int64)
    order = np.argsort(block, kind="stable")
    begin = np.repeat(np.cumsum(count) - count, count)
    members[block[order], np.arange(len(block)) - begin] = order
    return members


def _blocks(cells_mm: _Array) -> tuple[npt.NDArray[np.int64], _Array, float]:
    low, size = cells_mm.min(axis=0), np.maximum(np.ptp(cells_mm, axis=0), 1e-9)
    cells = min(BLOCK_CELLS, max(LEAST_CELLS + 8, len(cells_mm) // 16))
    side = float(np.sqrt(size[0] * size[1] * cells / len(cells_mm)))
    columns, rows = (max(1, round(float(length) / side)) for length in size)
    grid_size = np.array([columns, rows])
    grid_index = np.minimum((cells_mm - low) / size * grid_size, grid_size - 1e-9).astype(np.int64)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    corners = np.column_stack([x.ravel(), y.ravel()])
    area_mm2 = float(size[0] * size[1]) / (columns * rows)
    return grid_index[:, 1] * columns + grid_index[:, 0], low + (corners + 0.5) * size / grid_size, area_mm2


@dataclass(frozen=True)
class ForeignFrame:
    """A frame with another camera, lens or exposure in its metadata than most frames."""

    record: FrameRecord
    found: str  # value in the file
    expected: str  # value of most files
    ratio: float = 1.0  # exposure relative to most frames; 1 if another property differs


@dataclass(frozen=True)
class OriginFigures:
    """Frames with another camera, lens, ISO speed or exposure (by 1 % or more) in their metadata."""

    other_camera: tuple[ForeignFrame, ...] = ()
    other_lens: tuple[ForeignFrame, ...] = ()
    other_exposure: tuple[ForeignFrame, ...] = ()
    other_iso: tuple[ForeignFrame, ...] = ()

    @property
    def exposure_difference(self) -> float:
        """Largest relative difference of an exposure from most frames; 1 means twice or half of the exposure."""
        return max((max(frame.ratio, 1 / frame.ratio) - 1 for frame in self.other_exposure), default=0.0)


# Exposures with a smaller ratio are equal. Files contain rounded values; shutter times differ by a factor of 1.26.
_SAME_EXPOSURE = 1.01


def origin_figures(frames: Sequence[tuple[FrameRecord, FrameOrigin]], iso: int | None = None) -> OriginFigures:
    """Return the frames with another camera, lens, exposure or ISO speed than most, in the given order.

    `iso`: ISO speed of the session settings; None: the value of most frames is expected.
    """
    bodies = [(record, _body(origin)) for record, origin in frames if origin.camera or origin.serial]
    lenses = [(record, origin.lens) for record, origin in frames if origin.lens]
    return OriginFigures(
        other_camera=_others(_comparable_bodies(bodies)),
        other_lens=_others(lenses),
        other_exposure=_other_exposures(frames),
        other_iso=_others(
            [(record, f"ISO {origin.iso}") for record, origin in frames if origin.iso], f"ISO {iso}" if iso else None
        ),
    )


def _body(origin: FrameOrigin) -> str:
    return f"{origin.camera} no. {origin.serial}" if origin.serial else origin.camera


def _comparable_bodies(bodies: Sequence[tuple[FrameRecord, str]]) -> Sequence[tuple[FrameRecord, str]]:
    # If some frames of a model have no serial number, only the model is compared.
    models = {body.split(" no. ")[0] for _, body in bodies if " no. " not in body}
    return [(record, body.split(" no. ")[0] if body.split(" no. ")[0] in models else body) for record, body in bodies]


def _others(values: Sequence[tuple[FrameRecord, str]], expected: str | None = None) -> tuple[ForeignFrame, ...]:
    if not values:
        return ()
    usual_value = expected or Counter(value for _, value in values).most_common(1)[0][0]
    return tuple(ForeignFrame(record, value, usual_value) for record, value in values if value != usual_value)


def _other_exposures(frames: Sequence[tuple[FrameRecord, FrameOrigin]]) -> tuple[ForeignFrame, ...]:
    with_exposure = [(record, origin) for record, origin in frames if origin.exposure > 0]
    if not with_exposure:
        return ()
    usual = Counter(origin.exposure for _, origin in with_exposure).most_common(1)[0][0]
    example = next(origin for _, origin in with_exposure if origin.exposure == usual)
    foreign: list[ForeignFrame] = []
    for record, origin in with_exposure:
        # If only one of two files gives an f-number, the f-numbers are assumed to be equal.
        is_comparable = bool(origin.aperture) == bool(example.aperture)
        ratio = origin.exposure / usual if is_comparable else _exposure(origin) / _exposure(example)
        if not 1 / _SAME_EXPOSURE < ratio < _SAME_EXPOSURE:
            foreign.append(ForeignFrame(record, origin.exposure_text, example.exposure_text, ratio))
    return tuple(foreign)


def _exposure(origin: FrameOrigin) -> float:
    return (origin.shutter_s or 0.0) * (origin.iso or 0)
