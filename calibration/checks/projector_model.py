"""Fit a projector model to the whites of a session, and predict each white from all others.

The white of an illuminant is the camera RGB of bare paper under it. It is the sum of three primaries, each with a tone
curve. Projectors add light if two or three primaries overlap (colour wheels with white, yellow, cyan or magenta
segments):

    white(codes) = Σ_p P_p [f_p(code_p) + Σ_S u_Sp(m_S) f_p(m_S) + k_p],   m_S the least code of the primaries in S

P_p is the camera RGB of primary p, and f_p is its tone curve. u_Sp is the light added where the primaries S overlap.
k_p is the light that remains at code 0 after subtraction of dark frames. All parameters have priors: the red channel of
a camera is mostly sensitive to the red primary, and a tone curve is about a power of 2.2. With few illuminants, the
priors dominate; with many, they have almost no effect. The uncertainty of each prediction includes the priors.

The posterior is approximated by a Gaussian about its mode (Laplace), and Gauss-Newton steps find the mode. Each
illuminant is compared with its prediction from all others. If it is far from this prediction, it gets a small weight,
by Student's t distribution with `_FREEDOM` degrees of freedom. The assumed noise starts large and is reduced to its
actual value (graduated non-convexity), so that frames with wrong codes do not mislead the first steps.

Sources: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.22 to 2.26, 5.12
(leaving out); K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t distribution",
JASA 84 (1989) 881; A. Blake, A. Zisserman, "Visual Reconstruction", 1987 (graduated non-convexity).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]

# Contribution of each primary (columns) to white in R, G and B (rows): means of the measured sensitivities of five
# cameras, with a mercury lamp and LEDs.
_CONTRIBUTIONS = np.array([[0.70, 0.28, 0.015], [0.055, 0.83, 0.11], [0.013, 0.25, 0.70]])

# Prior standard deviations of the logarithms of these contributions: 1.5 times the differences between these cameras
# and lamps.
_CONTRIBUTION_SD = np.array([[0.25, 0.45, 0.9], [0.6, 0.2, 0.6], [1.0, 0.7, 0.25]])

_CHANNELS = np.array([0.45, 1.0, 0.70])  # White in R, G and B relative to green, for these cameras and lamps

# Prior standard deviations of the logarithms of levels: of a channel, of a primary, and of all together. They cover
# projectors from 5000 to 11 000 K, and any exposure.
_CHANNEL_SD, _PRIMARY_SD, _SCALE_SD = 0.35, 0.3, 2.0

# Nodes of the tone curves, in codes; interpolation errors are below 0.001.
_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])

_POWER = 2.2  # Mean exponent of tone curves; displays have 1.8 to 2.6

# Prior standard deviations of the exponent and of bends of the logarithm of a tone curve, and the length scale of the
# bends in log code. sRGB, S-shaped curves and exponents from 1.5 to 2.9 lie within two standard deviations.
_POWER_SD, _BEND_SD, _BEND_LENGTH = 0.4, 0.2, 0.4

# Weight of the part of a tone curve that differs between primaries. Most of it is common to the three primaries.
_OWN_WEIGHT = 0.2

# Nodes of the light added in overlaps, in codes, for linear interpolation.
_OVERLAP_NODES = np.array([0.0, 64.0, 128.0, 192.0, 255.0])

# Light added in overlaps, relative to the primary: prior standard deviations of the mean and of the variation with the
# code, and the length scale of the variation in codes. White segments add at most 0.5.
_OVERLAP, _OVERLAP_BEND, _OVERLAP_LENGTH = 0.2, 0.15, 120.0

# Overlaps: each pair of primaries, and all three.
_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))

# Each primary with its three overlaps.
_OVERLAP_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]


# Prior standard deviations of the light at code 0, relative to the primary: after subtraction of dark frames, and
# without dark frames. They cover room light and contrasts of 500 : 1 and more.
_REST_SD, _REST_SD_WITHOUT_DARK = 5e-4, 0.02

# Uncertainty of all whites due to black level and stray light, relative to the brightest white.
_LEVEL_ERROR = 2e-4

_FREEDOM = 4.0  # Degrees of freedom of Student's t: outliers get small weights, others nearly 1

# Relative noise added to whites in successive rounds, from the size of the prior uncertainties down to 0.
_ADDED_NOISES = (0.5, 0.2, 0.06, 0.015, 0.0, 0.0, 0.0)

_MAX_STEPS = 4  # Largest number of Gauss-Newton steps in each round

_SMALLEST_STEP = 1e-6  # Step, in prior standard deviations, that ends a round

_DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0, 100.0)  # Damping factors to try, relative to the curvature

_CURVE_TERMS = 12  # Number of principal components of a tone curve; further ones have standard deviations below 0.003

_CURVES, _OVERLAPS = 4 * _CURVE_TERMS, len(_OVERLAP_TERMS) * len(_OVERLAP_NODES)


def _log_code(codes: npt.ArrayLike) -> _Array:
    return np.log(np.maximum(np.asarray(codes, dtype=np.float64), 0.5) / 255)


def _kernel(a: _Array, b: _Array) -> _Array:
    correlation = np.exp(-0.5 * ((a[:, None] - b[None]) / _BEND_LENGTH) ** 2)
    # Condition the bends on 0 at code 255, because every tone curve is 1 there by definition.
    at_white = np.exp(-0.5 * (a / _BEND_LENGTH) ** 2)[:, None] * np.exp(-0.5 * (b / _BEND_LENGTH) ** 2)[None]
    return _POWER_SD**2 * a[:, None] * b[None] + _BEND_SD**2 * (correlation - at_white)


@cache
def _curve_basis() -> _Array:
    """Return (256, N): derivatives of the log tone curve at each code by the N curve parameters."""
    nodes = _log_code(_NODES)
    variance, components = np.linalg.eigh(_kernel(nodes, nodes))
    variance, components = variance[-_CURVE_TERMS:], components[:, -_CURVE_TERMS:]
    return np.asarray(_kernel(_log_code(np.arange(256)), nodes) @ (components / np.sqrt(variance)), dtype=np.float64)


@cache
def _overlap_basis() -> _Array:
    nodes, codes = _OVERLAP_NODES, np.arange(256.0)
    distance = (nodes[:, None] - nodes[None]) / _OVERLAP_LENGTH
    root = np.linalg.cholesky(_OVERLAP**2 + _OVERLAP_BEND**2 * np.exp(-0.5 * distance**2) + 1e-8 * np.eye(len(nodes)))
    # Hat functions of the linear interpolation
    hats: list[_Array] = [np.asarray(np.interp(codes, nodes, row), dtype=np.float64) for row in np.eye(len(nodes))]
    return np.asarray(np.stack(hats, axis=-1) @ root, dtype=np.float64)


@cache
def _primary_root() -> _Array:
    """Return (9, 9): Cholesky factor of the prior covariance of log primaries, flattened [channel, primary]."""
    channel, primary = (grid.ravel() for grid in np.indices((3, 3)))
    same_channel, same_primary = channel[:, None] == channel[None], primary[:, None] == primary[None]
    covariance = np.diag(_CONTRIBUTION_SD.ravel() ** 2) + _SCALE_SD**2
    covariance += _CHANNEL_SD**2 * same_channel + _PRIMARY_SD**2 * same_primary
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Codes:
    """Codes of L illuminants and the basis functions at these codes.

    The third axis holds each primary itself, then its three overlaps. The code of an overlap is the least code of its
    primaries.
    """

    lit: npt.NDArray[np.bool_]  # (L, 3, 4) whether the code is above 0
    power: _Array  # (L, 3, 4) log light with the mean tone curve
    curves: _Array  # (L, 3, 4, N) derivatives of the log light by the curve parameters
    overlaps: _Array  # (L, 3, 3, M) derivatives of each overlap by its M parameters

    @staticmethod
    def of(codes: npt.NDArray[np.integer]) -> _Codes:
        integers = np.asarray(codes, dtype=np.int64)
        overlap_codes = np.stack([integers[:, subset].min(axis=1) for _, subset in _OVERLAP_TERMS], axis=-1).reshape(
            -1, 3, 3
        )
        stacked = np.concatenate([integers[:, :, None], overlap_codes], axis=2)
        return _Codes(
            stacked > 0, _POWER * _log_code(stacked), _curve_basis()[stacked], _overlap_basis()[overlap_codes]
        )


@dataclass(frozen=True, eq=False)
class ProjectorFit:
    """Whites of L illuminants and the model fitted to them."""

    white: _Array  # (L, 3) counts, as given
    slopes: _Array  # (L, 3, K) derivatives of the fit by the K model parameters, whose priors are N(0, 1)
    covariance: _Array  # (K, K) of the parameters
    residual: _Array  # (L, 3) white minus fit, counts
    noise: _Array  # (L, 3, 3) covariance of each white about the model, from measurement and lamp
    trust: _Array  # (L,) weight of each illuminant in the fit, 0 … 1
    misfit: float = 0.0  # χ² of the whites and of the parameters; without faults at most about 3 per illuminant

    def predicted(self, lights: npt.NDArray[np.int64]) -> tuple[_Array, _Array]:
        """Predict the whites of each set of illuminants from all illuminants outside the set.

        `lights`: (B, n) int64, B sets of n illuminants. Returns (B, 3 n) float64 counts, and their covariance
        (B, 3 n, 3 n) from model, measurement and lamp.
        """
        sets, count = lights.shape
        size = 3 * count
        slopes = self.slopes[lights].reshape(sets, size, -1)
        fitted = slopes @ self.covariance @ slopes.swapaxes(1, 2)
        noise, precision = np.zeros((sets, size, size)), np.zeros((sets, size, size))
        for n in range(count):
            block = slice(3 * n, 3 * n + 3)
            noise[:, block, block] = self.noise[lights[:, n]]
            precision[:, block, block] = np.linalg.inv(self.noise[lights[:, n]]) * self.trust[lights[:, n], None, None]
        # Remove the contribution of the set from the fit (Woodbury's identity).
        removal = np.linalg.inv(np.eye(size) - fitted @ precision)
        residual = (removal @ self.residual[lights].reshape(sets, size, 1))[..., 0]
        covariance = removal @ fitted
        return self.white[lights].reshape(sets, size) - residual, (covariance + covariance.swapaxes(1, 2)) / 2 + noise


def fit_projector(
    codes: npt.NDArray[np.integer],
    white: _Array,
    error: _Array,
    *,
    dark_known: bool,
    chroma_sd: float,
    brightness_sd: float,
    used: npt.NDArray[np.bool_] | None = None,
) -> ProjectorFit:
    """Fit the projector model to the whites of a session.

    `codes`: (L, 3) int64, 0 … 255. `white`: (L, 3) float64 counts on paper at equal exposure. `error`: (L, 3)
    float64, standard uncertainties. `dark_known`: True if dark frames were subtracted. `chroma_sd`, `brightness_sd`:
    relative scatter of the lamp. `used`: (L,) bool, illuminants in the fit; None: all, with robust weights.
    """
    code_basis = _Codes.of(codes)
    level = np.maximum(np.abs(white), _LEVEL_ERROR * white.max())
    scale = float(white.max())
    noise = np.zeros((len(white), 3, 3))
    channels = np.arange(3)
    noise[:, channels, channels] = error**2 + (chroma_sd * level) ** 2 + (_LEVEL_ERROR * scale) ** 2
    noise += brightness_sd**2 * level[:, :, None] * level[:, None, :]
    rest_sd = _REST_SD if dark_known else _REST_SD_WITHOUT_DARK
    state = np.zeros(9 + _CURVES + _OVERLAPS + 3)
    trust = np.ones(len(white)) if used is None else used.astype(np.float64)
    fitted, slopes = _model(state, code_basis, scale, rest_sd)
    for added_noise in _ADDED_NOISES:
        round_noise = noise.copy()
        round_noise[:, channels, channels] += (added_noise * level) ** 2
        weights = np.linalg.inv(round_noise) * trust[:, None, None]
        for _ in range(_MAX_STEPS):
            precision, weighted = _precision(slopes, weights)
            misfit_before = _misfit(state, white - fitted, weights)
            gradient = weighted.T @ (white - fitted).ravel() - state
            # The full step may be too large: increase the damping until the misfit decreases (Levenberg, Marquardt).
            for damping in _DAMPINGS:
                step = np.linalg.solve(precision + damping * np.diag(np.diag(precision)), gradient)
                next_fitted, next_slopes = _model(state + step, code_basis, scale, rest_sd)
                if _misfit(state + step, white - next_fitted, weights) <= misfit_before:
                    state, fitted, slopes = state + step, next_fitted, next_slopes
                    break
            else:
                # Every step increases the misfit, so the state is at the mode within rounding errors.
                break
            if np.abs(step).max() < _SMALLEST_STEP:
                break
        if used is not None:
            continue
        covariance = _inverse(_precision(slopes, weights)[0])
        fit = ProjectorFit(white, slopes, covariance, white - fitted, round_noise, trust)
        mean, covariances = fit.predicted(np.arange(len(white))[:, None])
        difference = white - mean
        distance2 = np.einsum("lc,lcd,ld->l", difference, np.linalg.inv(covariances), difference)
        trust = (_FREEDOM + 3) / (_FREEDOM + np.maximum(distance2, 3))
    weights = np.linalg.inv(noise) * trust[:, None, None]
    covariance = _inverse(_precision(slopes, weights)[0])
    misfit = _misfit(state, white - fitted, weights)
    return ProjectorFit(white, slopes, covariance, white - fitted, noise, trust, misfit)


def _precision(slopes: _Array, weights: _Array) -> tuple[_Array, _Array]:
    size = slopes.shape[2]
    weighted = (weights @ slopes).reshape(-1, size)
    return np.eye(size) + slopes.reshape(-1, size).T @ weighted, weighted


def _inverse(matrix: _Array) -> _Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _misfit(state: _Array, residual: _Array, weights: _Array) -> float:
    # −2 log posterior, without its constant
    return float(state @ state + np.einsum("lc,lcd,ld->", residual, weights, residual))


def _model(state: _Array, code_basis: _Codes, scale: float, rest_sd: float) -> tuple[_Array, _Array]:
    """Return the whites (L, 3) of a parameter vector, and their derivatives (L, 3, K)."""
    count, nodes = len(code_basis.lit), len(_OVERLAP_NODES)
    root = _primary_root()
    prior = np.log(_CONTRIBUTIONS * _CHANNELS[:, None] * scale)
    primaries = np.exp(np.clip(prior + (root @ state[:9]).reshape(3, 3), -40, 40))
    curve_parameters = state[9 : 9 + _CURVES].reshape(4, _CURVE_TERMS)
    curves = np.sqrt(1 - _OWN_WEIGHT**2) * curve_parameters[0] + _OWN_WEIGHT * curve_parameters[1:]
    overlaps = state[9 + _CURVES : 9 + _CURVES + _OVERLAPS].reshape(3, 3, nodes)
    bent = np.einsum("lpjn,pn->lpj", code_basis.curves, curves)
    light = np.where(code_basis.lit, np.exp(np.clip(code_basis.power + bent, -30, 3)), 0.0)
    contributions = light.copy()
    contributions[:, :, 1:] *= np.einsum("lpjm,pjm->lpj", code_basis.overlaps, overlaps)
    curve_slopes = np.einsum("lpj,lpjn->lpn", contributions, code_basis.curves)
    overlap_slopes = (light[:, :, 1:, None] * code_basis.overlaps).reshape(count, 3, -1)
    state_slopes = np.zeros((count, 3, len(state)))
    state_slopes[:, :, 9 : 9 + _CURVE_TERMS] = np.sqrt(1 - _OWN_WEIGHT**2) * curve_slopes
    rest_start = 9 + _CURVES + _OVERLAPS
    for primary in range(3):
        own_start, overlap_start = 9 + _CURVE_TERMS * (1 + primary), 9 + _CURVES + 3 * nodes * primary
        state_slopes[:, primary, own_start : own_start + _CURVE_TERMS] = _OWN_WEIGHT * curve_slopes[:, primary]
        state_slopes[:, primary, overlap_start : overlap_start + 3 * nodes] = overlap_slopes[:, primary]
        state_slopes[:, primary, rest_start + primary] = rest_sd
    amounts = contributions.sum(axis=2) + rest_sd * state[rest_start:]
    slopes = primaries @ state_slopes
    primary_light = amounts[:, None, :] * primaries[None]
    slopes[:, :, :9] += np.einsum("lcp,cpk->lck", primary_light, root.reshape(3, 3, 9))
    return primary_light.sum(axis=2), slopes
