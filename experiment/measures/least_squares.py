"""Weighted linear least squares in the calling thread, and polynomial bases for the fits.

Frames are processed in parallel threads, so a linear-algebra library with threads of its own would be slower. The
compiled loops keep the order of sums, so that a look-up table (LUT) is the same on every processor. The bases are
Legendre polynomials, which keep the normal equations well conditioned.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from foundation.robust import MAD_TO_SIGMA

# Highest order of flat fields. The basis of this order is cached, and its first columns are the bases of lower orders.
_CACHED_ORDER: Final = 8


_LINE_ROUNDS = 8  # Iterations of a line fit

# Lower limit of the residuals in the weights, relative to the median residual. It limits the weight of a point that is
# exactly on the line.
_LEAST_RESIDUAL = 0.1

# Number of points that are summed at a time; their data fit into the level 2 cache.
_POINTS_AT_A_TIME = 2048

_RIDGE = 1e-10  # Ridge relative to the mean diagonal of the normal matrix; it allows designs with equal columns

_BIWEIGHT_SIGMAS = 6.0  # Residuals beyond this many robust standard deviations get no weight (J. W. Tukey's biweight).

_Array = npt.NDArray[np.float64]


def product(matrix: _Array, vector: _Array) -> _Array:
    """Return a matrix (N, K) float64 times a vector (K,) or matrix (K, M), computed in the calling thread."""
    return np.asarray(np.einsum("nk,k...->n...", matrix, vector), dtype=np.float64)


def linear_combinations(basis: _Array, factors: _Array) -> _Array:
    """Return the sums (3, N) float64 over k of factors[c, k] · basis[k, n], computed in the calling thread.

    `basis`: (K, N) float64, so that the compiled loop runs along the points. `factors`: (3, K) float64; a factor of 0
    costs no time.
    """
    sums = np.empty((len(factors), basis.shape[1]))
    _fill_combinations(basis, factors, sums)
    return sums


def least_squares(design: _Array, values: _Array, weights: _Array) -> _Array:
    """Return the x (K,) float64 that minimises Σ w (values − design x)².

    The normal equations square the condition number of the design. Its columns should be nearly orthogonal, with values
    of about 1.

    `design`: (N, K) float64. `values`: (N,) float64. `weights`: (N,) float64, ≥ 0.
    """
    return _weighted_fit(*(_contiguous(array) for array in (design, values, weights)))


def robust_least_squares(design: _Array, values: _Array, rounds: int) -> tuple[_Array, _Array, _Array]:
    """Fit by least squares with low weights for outliers.

    The fit is repeated with weights by Tukey's biweight of the residuals, which is 0 beyond six robust standard
    deviations (P. J. Huber, E. M. Ronchetti, *Robust Statistics*, 2nd edition, chapter 7).

    Parameters
    ----------
    design, values
        (N, K) and (N,) float64.
    rounds
        Number of iterations.

    Returns
    -------
        Solution (K,), weights (N,) 0 … 1, and residuals (N,), values − design x.
    """
    return _robust_fit(_contiguous(design), _contiguous(values), rounds)


def least_absolute_line(x: _Array, y: _Array) -> tuple[float, float]:
    """Return intercept and slope of the line through points x, y (N,) that minimises Σ ``|y − line|``.

    Reweighted least squares (E. J. Schlossmacher, J. Am. Stat. Assoc. 68 (1973) 857).
    """
    design, weights = np.column_stack([np.ones(len(x)), x]), np.ones(len(x))
    solution = np.array([0.0, 1.0])
    for _ in range(_LINE_ROUNDS):
        solution = least_squares(design, y, weights)
        residual = np.abs(y - design @ solution)
        weights = 1 / np.maximum(residual, _LEAST_RESIDUAL * float(np.median(residual)) + 1e-9)
    return float(solution[0]), float(solution[1])


def held_out_squares(design: _Array, values: _Array, weights: _Array, counts: tuple[int, ...]) -> _Array:
    """Return the cross-validated mean squared error of fits by the first `counts[m]` columns of a design.

    Every point is predicted by a fit to all other points.

    Parameters
    ----------
    design, values
        (N, K) and (N,) float64.
    weights
        (N,) float64, ≥ 0. Points of weight 0 are not used, neither in the fits nor in the errors.
    counts
        Numbers of columns, in ascending order, at most K.

    Returns
    -------
        Weighted mean error (M,) float64.
    """
    fits = np.array(counts, dtype=np.int64)
    return _held_out_squares(_contiguous(design), _contiguous(values), _contiguous(weights), fits)


def _contiguous(array: _Array) -> _Array:
    # float64, C order and writable, because numba compiles a function again for each other kind of array.
    return np.require(array, np.float64, ["C", "W"])


def page_powers(order: int) -> list[tuple[int, int]]:
    """Return the degrees (i, j) in x and y of all terms up to the total order `order`, in ascending order.

    >>> page_powers(2)
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    """
    return [(total - j, j) for total in range(order + 1) for j in range(total + 1)]


def order_of(count: int) -> int:
    """Return the total order of a polynomial with `count` terms, as in `page_powers`.

    >>> order_of(6)
    2
    """
    return round((np.sqrt(8 * count + 1) - 3) / 2)


def page_polynomial(points_mm: npt.ArrayLike, page_mm: tuple[float, float], order: int) -> _Array:
    """Return the values of the Legendre polynomials P_i(x) P_j(y) at points of the page; x and y are scaled to −1 … 1.

    `points_mm`: (N, 2) float, mm on the page. Returns (N, terms) float64, read-only, terms as in `page_powers`.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 2)
    # The first columns of the cached basis are the basis of the lower order.
    return _page_basis(points.tobytes(), page_mm, max(order, _CACHED_ORDER))[:, : len(page_powers(order))]


# Cached, because every frame has the same patches and references.
@lru_cache(maxsize=8)
def _page_basis(points: bytes, page_mm: tuple[float, float], order: int) -> _Array:
    unit = 2 * np.frombuffer(points).reshape(-1, 2) / np.asarray(page_mm, dtype=np.float64) - 1
    x, y = (np.polynomial.legendre.legvander(unit[:, axis], order) for axis in (0, 1))
    basis = np.stack([x[:, i] * y[:, j] for i, j in page_powers(order)], axis=1)
    basis.setflags(write=False)
    return basis


def light_terms(page_mm: tuple[float, float], outside_only: bool = False) -> tuple[_Array, tuple[int, ...]]:
    """Return polynomials over the page that describe the fall-off of light, simplest shapes first.

    The fall-off of a lens is a sum of even powers of the distance from its axis: cos⁴ of the angle, and the shadow of
    the mount. The fall-off of a projector is a smooth function of the distance from another point.

    Parameters
    ----------
    page_mm
        Width and height of the page.
    outside_only
        Whether all references are around the patches and none between them. The polynomials then have at most order 3.

    Returns
    -------
        Terms (L, T) float64: each column has the L coefficients of a polynomial, in the order of `page_powers`. The
        polynomials are orthogonal, and their mean square over the page is 1. The second value lists the numbers of
        leading terms that a fit may use.
    """
    half = float(np.hypot(*page_mm)) / 2
    node, _ = np.polynomial.legendre.leggauss(_CACHED_ORDER + 2)
    u, v = (np.asarray(axis, dtype=np.float64).ravel() for axis in np.meshgrid(node, node))
    x, y = u * page_mm[0] / 2 / half, v * page_mm[1] / 2 / half
    r2 = x * x + y * y

    def power(order: int) -> list[_Array]:
        return [x ** (order - j) * y**j for j in range(order + 1)]

    def radial(half_power: int) -> list[_Array]:
        return [x * r2 ** (half_power - 1), y * r2 ** (half_power - 1), r2**half_power]

    # Order of the groups, with the distance r from the centre: constant, slope, curvature; r⁴ and r⁶; other terms of
    # third and fourth order; r⁸; other terms of fifth and sixth order. The group of r⁴ also contains x·r² and y·r²,
    # which describe a shift of the centre. The groups of r⁶ and r⁸ contain similar terms. Up to the sixth order, each
    # radial term replaces a monomial of its order.
    groups = (
        [power(0), power(1), power(2), power(3)]
        if outside_only
        else [
            power(0), power(1), power(2), radial(2), radial(3), power(3)[:2], power(4)[:4], radial(4),
            [*power(5)[:4], *power(6)[:6]],
        ]
    )  # fmt: skip
    columns = np.stack([column for group in groups for column in group], axis=1)
    powers = page_powers(_CACHED_ORDER)
    along, across = (
        np.asarray(np.polynomial.legendre.legvander(axis, _CACHED_ORDER), dtype=np.float64) for axis in (u, v)
    )
    basis = np.stack([along[:, i] * across[:, j] for i, j in powers], axis=1)
    norm = np.sqrt([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in powers])
    exact = np.asarray(np.linalg.lstsq(basis, columns, rcond=None)[0], dtype=np.float64)
    orthogonal, triangle = np.linalg.qr(exact * norm[:, None])
    terms = orthogonal * np.sign(np.diag(triangle)) / norm[:, None]
    return np.ascontiguousarray(terms), tuple(np.cumsum([len(group) for group in groups]).tolist())


def code_powers(degree: int) -> list[tuple[int, int, int]]:
    """Return the degrees in red, green and blue of all terms with a total degree up to `degree`.

    >>> code_powers(1)
    [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]
    """
    return [(i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(degree + 1 - i - j)]


def code_polynomial(rgb: npt.ArrayLike, degree: int) -> _Array:
    """Return the values of products of three Legendre polynomials at printed codes, which are scaled to −1 … 1.

    `rgb`: (C, 3) int, printed codes 0 … 255. Returns (C, terms) float64, terms as in `code_powers`.
    """
    unit = 2 * np.asarray(rgb, dtype=np.float64) / 255 - 1
    axes = [np.asarray(np.polynomial.legendre.legvander(unit[:, axis], degree), dtype=np.float64) for axis in range(3)]
    return np.stack([axes[0][:, i] * axes[1][:, j] * axes[2][:, k] for i, j, k in code_powers(degree)], axis=-1)


@compiled
def _fill_combinations(basis: _Array, factors: _Array, out: _Array) -> None:
    out[:] = 0
    for start in range(0, basis.shape[1], _POINTS_AT_A_TIME):
        end = min(start + _POINTS_AT_A_TIME, basis.shape[1])
        for term in range(basis.shape[0]):
            line = basis[term, start:end]
            for channel in range(3):
                factor = factors[channel, term]
                if factor != 0:
                    sums = out[channel, start:end]
                    for point in range(end - start):
                        sums[point] += factor * line[point]


@compiled
def _weighted_fit(design: _Array, values: _Array, weights: _Array) -> _Array:
    gram, solution = _normal_equations(design, values, weights)
    _solve_positive_definite(gram, solution)
    return solution


@compiled
def _robust_fit(design: _Array, values: _Array, rounds: int) -> tuple[_Array, _Array, _Array]:
    count, unknowns = design.shape
    weights, residual = np.ones(count), values.copy()
    solution = np.zeros(unknowns)
    for _ in range(rounds):
        solution = _weighted_fit(design, values, weights)
        for point in range(count):
            predicted = 0.0
            for i in range(unknowns):
                predicted += design[point, i] * solution[i]
            residual[point] = values[point] - predicted
        scale = MAD_TO_SIGMA * np.median(np.abs(residual)) + 1e-9
        for point in range(count):
            inside = max(1 - (residual[point] / (_BIWEIGHT_SIGMAS * scale)) ** 2, 0.0)
            weights[point] = inside * inside
    return solution, weights, residual


@compiled
def _held_out_squares(design: _Array, values: _Array, weights: _Array, counts: npt.NDArray[np.int64]) -> _Array:
    # The error of a held-out point is its residual / (1 − leverage), so no fit is repeated (R. D. Cook, S. Weisberg,
    # *Residuals and Influence in Regression*, section 2.2). The design is transformed so that the normal matrix becomes
    # the identity. Then the leverage in a smaller fit is a partial sum over one row of the design.
    points, unknowns = design.shape
    gram, right = _normal_equations(design, values, weights)
    _factorise(gram)
    _solve_lower(gram, right)
    squares, row = np.zeros(len(counts)), np.zeros(unknowns)
    total = 0.0
    for point in range(points):
        total += weights[point]
        if weights[point] == 0:
            continue
        leverage, predicted, column = 0.0, 0.0, 0
        for fit in range(len(counts)):
            while column < counts[fit]:
                value = design[point, column]
                for k in range(column):
                    value -= gram[column, k] * row[k]
                value /= gram[column, column]
                row[column] = value
                leverage += weights[point] * value * value
                predicted += value * right[column]
                column += 1
            error = (values[point] - predicted) / max(1 - leverage, 1e-3)
            squares[fit] += weights[point] * error * error
    return squares / max(total, 1e-300)


@compiled
def _normal_equations(design: _Array, values: _Array, weights: _Array) -> tuple[_Array, _Array]:
    """Return the lower half of the normal matrix (K, K) with its ridge, and the right side (K,)."""
    count, unknowns = design.shape
    gram, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for point in range(count):
        line = design[point]
        for i in range(unknowns):
            weighted = weights[point] * line[i]
            right[i] += weighted * values[point]
            for j in range(i + 1):
                gram[i, j] += weighted * line[j]
    trace = 0.0
    for i in range(unknowns):
        trace += gram[i, i]
    for i in range(unknowns):
        gram[i, i] += _RIDGE * max(trace / unknowns, 1e-30)
    return gram, right


@compiled
def _factorise(gram: _Array) -> None:
    unknowns = len(gram)
    for j in range(unknowns):
        for k in range(j):
            for i in range(j, unknowns):
                gram[i, j] -= gram[i, k] * gram[j, k]
        pivot = np.sqrt(max(gram[j, j], 1e-300))
        for i in range(j, unknowns):
            gram[i, j] /= pivot


@compiled
def _solve_lower(factor: _Array, solution: _Array) -> None:
    for i in range(len(solution)):
        for k in range(i):
            solution[i] -= factor[i, k] * solution[k]
        solution[i] /= factor[i, i]


@compiled
def _solve_positive_definite(gram: _Array, solution: _Array) -> None:
    # Cholesky decomposition; `gram` contains the lower half of the matrix.
    unknowns = len(solution)
    _factorise(gram)
    _solve_lower(gram, solution)
    for i in range(unknowns - 1, -1, -1):
        for k in range(i + 1, unknowns):
            solution[i] -= gram[k, i] * solution[k]
        solution[i] /= gram[i, i]
