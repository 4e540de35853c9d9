"""Measure the drift of the black level and the linearity of a sensor.

EMVA 1288 (release 4.0, linearity error) plots the mean counts of a sensor against exposure, and measures the deviation
from a straight line between 5 and 95 % of saturation. Here every patch of the chart gives such a curve. If a sensor is
linear, the counts of all patches rise by the same factor from one frame to the next. If this factor depends on the
level, the sensor is not linear.

One nonlinearity is not visible in this way: counts that follow a power of the light. Its exponent is determined from
the exposure times of all frames together, because cameras round the single times (0.3 s for 0.315 s).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import least_squares

# Largest drift of the black level during a session without a remark, counts. Chosen by judgement: a thirtieth of the
# darkest patches in use.
MAX_BLACK_DRIFT = 1.0

LOWEST, HIGHEST = 0.05, 0.95  # Range of levels relative to saturation in which a sensor must be linear (EMVA 1288)

_NODES = 10  # Number of levels at which the deviation is measured: about two per stop

_LEAST_PATCHES = 50.0  # Smallest number of patches near a level for a measurement

_STEPS_PER_STOP = 3  # Number of shutter speeds per stop

_LEAST_POWER = 0.1  # Lower limit of the exponent. It is reached only if the counts do not follow the exposure times.

# Weights of the constraints, relative to the weight of a patch. Hard: mean and slope of the deviations are 0. Soft:
# each deviation is small.
_HARD, _SOFT = 1e2, 0.1

_Array = npt.NDArray[np.float64]


def black_drift(blacks: Sequence[_Array]) -> float:
    """Return the range of the black level over the frames, counts, for the worst position of the Bayer block.

    `blacks`: black level (2, 2) float64 of each frame, counts.
    """
    if not blacks:
        return 0.0
    return float(np.ptp(np.stack(blacks), axis=0).max())


def deviations(levels: _Array, exposure_s: _Array) -> tuple[_Array, _Array]:
    """Measure the deviation of counts from proportionality to the light, at several levels.

    Parameters
    ----------
    levels
        (K, P, 3) float64, mean counts of patches in K frames, relative to saturation; NaN if not usable.
    exposure_s
        (K,) float64, exposure times as recorded by the camera, ascending, s.

    Returns
    -------
        Levels (B,) float64 relative to saturation, and relative deviations (3, B) float64 of R, G and B; NaN at levels
        without patches.
    """
    nodes = np.geomspace(LOWEST, HIGHEST, _NODES)
    deviation = np.full((3, _NODES), np.nan)
    for channel in range(3):
        both_times = (exposure_s, _exact_times(exposure_s))
        fits = [_deviation(levels[..., channel], np.log(times), nodes) for times in both_times]
        # Cameras round times: 0.3 s may be exact, or may be 0.315 s, a time on the scale of thirds of a stop. The times
        # with the better fit are used.
        deviation[channel] = min(fits, key=lambda fit: fit[1])[0]
    return nodes, deviation


def _exact_times(exposure_s: _Array) -> _Array:
    # Exact times are powers of two in steps of a third of a stop. Cameras record rounded times.
    return np.asarray(2.0 ** (np.round(_STEPS_PER_STOP * np.log2(exposure_s)) / _STEPS_PER_STOP), dtype=np.float64)


def _deviation(levels: _Array, log_times: _Array, nodes: _Array) -> tuple[_Array, float]:
    """Return the relative deviation (B,) at the levels `nodes`, and the RMS residual of log exposure against log time.

    `levels`: (K, P), one channel, relative to saturation. The deviation is NaN at levels with too few patches.
    """
    frames = len(levels)
    rows: list[_Array] = []
    log_ratios: list[_Array] = []
    patch_counts = np.zeros(len(nodes))
    for index in range(frames - 1):
        previous, following = levels[index], levels[index + 1]
        with np.errstate(invalid="ignore"):
            is_usable = (previous >= LOWEST) & (previous <= HIGHEST) & (following >= LOWEST) & (following <= HIGHEST)
        if not is_usable.any():
            continue
        row = np.zeros((int(is_usable.sum()), frames - 1 + len(nodes)))
        row[:, index] = 1
        low, high = (
            _interpolation_weights(previous[is_usable], nodes),
            _interpolation_weights(following[is_usable], nodes),
        )
        row[:, frames - 1 :] = high - low
        patch_counts += low.sum(axis=0) + high.sum(axis=0)
        rows.append(row)
        log_ratios.append(np.log(following[is_usable] / previous[is_usable]))
    is_measured = patch_counts >= _LEAST_PATCHES
    if not rows or is_measured.sum() < 2:
        return np.full(len(nodes), np.nan), np.inf
    # A power law appears as a slope of the deviation over the logarithm of the level. Noise causes such a slope, too,
    # so the slope is constrained to 0. Equal deviations at levels one exposure step apart cancel in every ratio, so
    # every deviation gets a weak constraint towards 0.
    centred_log_nodes = np.where(is_measured, np.log(nodes) - np.log(nodes)[is_measured].mean(), 0)
    constraints = np.zeros((2 + len(nodes), frames - 1 + len(nodes)))
    constraints[0, frames - 1 :], constraints[1, frames - 1 :] = _HARD * is_measured, _HARD * centred_log_nodes
    constraints[2:, frames - 1 :] = _SOFT * np.eye(len(nodes))
    design = np.concatenate([*rows, constraints])
    values = np.concatenate([*log_ratios, np.zeros(len(constraints))])
    solution = least_squares(design, values, np.ones(len(values)))
    # The exponent is the slope of the measured log exposures against the log times.
    has_patches = np.array([row[:, : frames - 1].any(axis=0) for row in rows]).any(axis=0)
    steps, factors = np.diff(log_times)[has_patches], solution[: frames - 1][has_patches]
    log_exposures, log_nominal = (np.concatenate([[0.0], np.cumsum(log_steps)]) for log_steps in (factors, steps))
    log_exposures, log_nominal = log_exposures - log_exposures.mean(), log_nominal - log_nominal.mean()
    power = max(float(log_exposures @ log_nominal) / max(float(log_nominal @ log_nominal), 1e-12), _LEAST_POWER)
    deviation = np.where(is_measured, solution[frames - 1 :] + (1 - 1 / power) * centred_log_nodes, np.nan)
    residual = log_exposures - power * log_nominal
    return np.asarray(deviation - np.nanmean(deviation), dtype=np.float64), float(np.sqrt((residual**2).mean()))


def _interpolation_weights(level: _Array, nodes: _Array) -> _Array:
    position = (np.log(level) - np.log(nodes[0])) / (np.log(nodes[1]) - np.log(nodes[0]))
    return np.asarray(np.maximum(1 - np.abs(position[:, None] - np.arange(len(nodes))), 0), dtype=np.float64)
