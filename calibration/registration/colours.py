"""Predict the camera RGB of printed codes in one frame, and compare patches with the prediction.

The colour model is fitted to the frame itself, so print and illuminant may be unknown. Patches that differ from the
model are covered or damaged, or the registration is displaced by a patch. Camera RGB is in counts above black level;
codes are 0 … 255; positions are millimetres on the page.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from experiment.chart.model import Chart
from experiment.measures.least_squares import code_powers, least_squares
from foundation.robust import MAD_TO_SIGMA, huber_weights, robust_sigma

# Minimum number of colours for detecting mismatched patches; with fewer colours the model is not good enough.
MIN_COLOURS = 64

# A patch is mismatched if its deviation from the model exceeds both limits. The first limit, in standard deviations, is
# high because model errors are not normally distributed.
_MISMATCH_SIGMA = 10.0

# The second limit, relative to paper. At the corners of the gamut, the model has smaller errors.
_MISMATCH_SHARE = 0.08

_NEIGHBOUR_COUNT = 13  # The patch itself and the twelve patches within a distance of two patches

# Share of mismatched neighbours above which a patch is also mismatched. Chosen by judgement.
_MISMATCH_NEIGHBOURS = 0.35

_MAX_AREA_CELLS = 16  # Largest width of an area that is tested for a displacement, in patches

_MIN_SHIFT_CELLS = 0.5  # Smallest apparent displacement of a displaced area, in patches

_MIN_SHIFT_SIGMAS = 6.0  # Smallest apparent displacement of a displaced area, in standard uncertainties

# Number of independent measurements in an area. It is small, because model errors of neighbouring patches are
# correlated.
_AREA_MEASUREMENTS = 8

# Error of the colour model, and upper limit of the noise; both relative to paper.
_MODEL_ERROR, _MAX_NOISE = 0.003, 0.01

_MAX_ERROR_SIGMAS = 20.0  # Colour errors are clipped to this number of standard deviations

# Ratio of the standard deviation of normal noise to the median absolute difference of neighbours: 1 / (√2 Φ⁻¹(3/4)).
_DIFFERENCE_TO_SIGMA = 1.0484

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def mismatched(measured: _Array, expected: _Array, paper: _Array, chart: Chart) -> _Mask:
    """Return the mismatched patches (C,) bool: their colours are far from the model, or most neighbours are mismatched.

    `measured`, `expected`: (C, 3) colours of the patches in chart order, or (C + R, 3) with the references last; NaN
    outside the frame. `paper`: (3,) colour of the paper.
    """
    count = chart.colour_count
    if count < MIN_COLOURS:
        return np.zeros(count, dtype=np.bool_)
    residual = np.abs(measured - expected)
    sigma = MAD_TO_SIGMA * np.nanmedian(residual, axis=0)
    is_mismatched = ((residual > _MISMATCH_SIGMA * sigma) & (residual > _MISMATCH_SHARE * paper)).any(axis=1)
    return _with_neighbours(np.asarray(is_mismatched)[:count], chart.centres_mm / np.array(chart.cell_mm))


def _with_neighbours(is_mismatched: _Mask, centres: _Array) -> _Mask:
    # A covered patch may match by chance, if the cover has its colour. Its neighbours show that it is covered.
    neighbours = cKDTree(centres).query(centres, k=min(_NEIGHBOUR_COUNT, len(centres)))[1]
    mismatched_share = is_mismatched[np.asarray(neighbours).reshape(len(centres), -1)].mean(axis=1)
    return np.asarray(is_mismatched | (mismatched_share > _MISMATCH_NEIGHBOURS))


def agreement(measured: _Array, expected: _Array) -> float:
    """Return the correlation of `measured` and `expected` colours, (N, 3), mean over the bright channels."""
    light = np.median(measured, axis=0)
    channels = np.flatnonzero(light >= 0.3 * light.max())
    return float(np.mean([np.corrcoef(measured[:, channel], expected[:, channel])[0, 1] for channel in channels]))


def displaced_areas(
    measured: _Array,
    expected: _Array,
    paper: _Array,
    ignored: _Mask,
    indices: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
    shape: tuple[int, int],
) -> tuple[_Array, int]:
    """Find areas of the chart that show the colours of the neighbouring patches.

    In each area, the colour error is fitted with the change of colour from patch to patch. The fit gives an apparent
    displacement in patches. Unlike registration, this test uses the absolute level of the colours.

    `measured`, `expected`: (C, 3) colours of the patches. `paper`: (3,) colour of the paper. `ignored`: (C,) bool.
    `indices`: row and column of each patch, (C,) each. `shape`: rows and columns. Returns the centres (B, 2) of the
    displaced areas, column then row, in patches from the corner of the grid, and the number of tested areas.
    """
    rows, columns = shape
    row, column = indices
    grid = np.full((2, rows + 2, columns + 2, 3), np.nan)
    for image, colours in zip(grid, (measured, expected), strict=True):
        image[row + 1, column + 1] = colours
    grid[0, row[ignored] + 1, column[ignored] + 1] = np.nan
    error = (grid[0] - grid[1])[1:-1, 1:-1]
    # Noise and error of the colour model. The noise is limited, because a displacement also increases the differences.
    noise = _DIFFERENCE_TO_SIGMA * np.nanmedian(np.abs(np.diff(error, axis=1)), axis=(0, 1))
    sigma = np.hypot(np.minimum(noise, _MAX_NOISE * paper), _MODEL_ERROR * paper) + 1e-9
    steps = ((grid[1, 1:-1, 2:] - grid[1, 1:-1, :-2]) / 2 / sigma, (grid[1, 2:, 1:-1] - grid[1, :-2, 1:-1]) / 2 / sigma)
    error = np.clip(error / sigma, -_MAX_ERROR_SIGMAS, _MAX_ERROR_SIGMAS)
    displaced: list[_Array] = []
    area_count = 0
    size = int(np.clip(min(rows, columns) // 2, 4, _MAX_AREA_CELLS))
    for first_row in range(0, rows, size):
        for first_column in range(0, columns, size):
            area = np.s_[first_row : first_row + size, first_column : first_column + size]
            values = [image[area].ravel() for image in (*steps, error)]
            is_known = np.isfinite(values).all(axis=0)
            if is_known.sum() < size**2:
                continue
            area_count += 1
            design = np.stack([slope[is_known] for slope in values[:2]], axis=1)
            gram = design.T @ design
            shift = np.linalg.solve(gram + 1e-9 * np.eye(2), design.T @ values[2][is_known])
            precision = np.sqrt(np.diag(gram) * _AREA_MEASUREMENTS / is_known.sum())
            if ((np.abs(shift) > _MIN_SHIFT_CELLS) & (np.abs(shift) * precision > _MIN_SHIFT_SIGMAS)).any():
                displaced.append(np.array([first_column, first_row]) + size / 2)
    return np.array(displaced).reshape(-1, 2), area_count


@dataclass(frozen=True, eq=False)
class ColourModel:
    """Camera RGB of printed codes in one frame: a polynomial of the codes, times a smooth illumination of the page."""

    degree: int
    coefficients: _Array  # (terms, 3) counts
    light: _Array  # (6, 3) illumination: polynomial of second order in page coordinates −1 … 1, mean about 1
    page_mm: tuple[float, float]

    def predict_flat(self, rgb: npt.ArrayLike) -> _Array:
        """Return camera RGB (N, 3) float64, counts, of printed codes (N, 3), 0 … 255, under uniform illumination."""
        return _code_terms(rgb, self.degree) @ self.coefficients

    def light_at(self, points_mm: _Array) -> _Array:
        """Return the relative illumination (N, 3) float64 at points (N, 2) mm of the page, mean about 1."""
        return _page_terms(points_mm, self.page_mm) @ self.light

    def predict(self, rgb: npt.ArrayLike, points_mm: _Array) -> _Array:
        """Return camera RGB (N, 3) float64, counts, of printed codes (N, 3) at points (N, 2) mm of the page."""
        return self.predict_flat(rgb) * self.light_at(points_mm)


def _code_terms(rgb: npt.ArrayLike, degree: int) -> _Array:
    r, g, b = (np.asarray(rgb, dtype=np.float64) / 255).T
    return np.column_stack([r**i * g**j * b**k for i, j, k in code_powers(degree)])


def _page_terms(points_mm: _Array, page_mm: tuple[float, float]) -> _Array:
    x, y = (2 * np.asarray(points_mm, dtype=np.float64) / page_mm - 1).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def fit_colours(
    rgb: _Array, points_mm: _Array, measured: _Array, page_mm: tuple[float, float], is_fine: bool = False
) -> ColourModel:
    """Fit the colour model to patches; covered or displaced patches get low weights.

    Polynomial and illumination are fitted in turn by least squares with Huber's weights.

    `rgb`: (N, 3) printed codes, 0 … 255. `points_mm`: (N, 2) centres. `measured`: (N, 3) float64 camera RGB, counts
    above black level. `is_fine`: use degree 6 or 8 in place of 3 if there are enough patches. Charts without tags
    need this accuracy, because their neighbouring patches are similar.
    """
    degree = (
        (8 if len(rgb) >= 4000 else 6)
        if is_fine and len(rgb) >= 2000
        else 3
        if len(rgb) >= 200
        else 2
        if len(rgb) >= 60
        else 1
    )
    terms, page = _code_terms(rgb, degree), _page_terms(points_mm, page_mm)
    coefficients, light = np.zeros((terms.shape[1], 3)), np.zeros((6, 3))
    for channel in range(3):
        field = np.array([1.0, 0, 0, 0, 0, 0])
        weights = np.ones(len(rgb))
        value = measured[:, channel]
        model = np.zeros(terms.shape[1])
        for _ in range(6):
            model = least_squares(terms * (page @ field)[:, None], value, weights)
            flat = terms @ model
            field = least_squares(page * flat[:, None], value, weights)
            residual = np.abs(value - flat * (page @ field))
            sigma = max(robust_sigma(residual), 1e-9)
            weights = huber_weights(residual, sigma)
        level = float((page @ field).mean())
        coefficients[:, channel], light[:, channel] = model * level, field / level
    return ColourModel(degree, coefficients, light, page_mm)
