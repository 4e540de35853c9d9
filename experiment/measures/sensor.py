"""The sensor as frames show it: how its black level drifts, and whether its counts are proportional to the light.

Black is each frame's own, one value for each position of the 2×2 block. Raw counts are never scaled in time.

EMVA 1288 (release 4.0, linearity error) plots a sensor's mean against exposure and measures its deviation from a
straight line between 5 and 95 % of saturation. Here every patch of the chart is such a curve, and since patches are of
all brightnesses, a frame's stated exposure is not needed: from one frame to the next, the counts of all patches must
rise by one and the same factor, and a factor that depends on the level is the sensor's nonlinearity. One nonlinearity
cannot be seen so, a power of the light, and for it the exposure times are needed: stated to some per cent only, as
cameras write 0.3 s for 0.315 s, they enter all together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import least_squares

# Counts that the black level may drift over a session without a remark (judgement): a sixth of the read noise of a
# photosite, and a thirtieth of the darkest cells of use.
MAX_BLACK_DRIFT = 1.0

LOWEST, HIGHEST = 0.05, 0.95  # Between which shares of saturation a sensor has to be linear (EMVA 1288)

_NODES = 10  # Levels at which the deviation is measured: about half a stop apart

_LEAST_PATCHES = 50.0  # Patches near a level for it to be measured: their mean is good to a seventh of a patch's noise

_STOPS = 3  # Shutter speeds are set in thirds of a stop

_LEAST_POWER = 0.1  # Below, the frames did not follow their times at all, and the figure is as bad as can be

# Weights of the constraints on deviations, beside patches of weight 1: mean and slope are 0, each one is near 0.
_HARD, _SOFT = 1e2, 0.1

_Array = npt.NDArray[np.float64]


def black_drift(blacks: Sequence[_Array]) -> float:
    """Return the largest drift of the black level of any position of the block over frames, counts.

    `blacks` are (2, 2) float64 counts each.
    """
    if not blacks:
        return 0.0
    return float(np.ptp(np.stack(blacks), axis=0).max())


def deviations(seen: _Array, exposure_s: _Array) -> tuple[_Array, _Array]:
    """Return levels and by how much counts deviate there from proportion to the light.

    `seen`: (K, P, 3) float64 mean counts of patches, shares of saturation; NaN where one cannot be used. `exposure_s`:
    (K,) float64 s, stated exposure times, rising. Returns (B,) float64, shares of saturation. Returns (3, B) float64,
    relative, of R, G and B; NaN where no patch has data.
    """
    nodes = np.geomspace(LOWEST, HIGHEST, _NODES)
    found = np.full((3, _NODES), np.nan)
    for channel in range(3):
        fits = [_bend(seen[..., channel], np.log(times), nodes) for times in (exposure_s, _stops(exposure_s))]
        # Cameras write 0.3 s for a third of a stop, and some expose for 0.3 s: the times that the frames follow count.
        found[channel] = min(fits, key=lambda fit: fit[1])[0]
    return nodes, found


def _stops(exposure_s: _Array) -> _Array:
    """Return the times that a camera means by its nominal ones: powers of two in thirds of a stop."""
    return np.asarray(2.0 ** (np.round(_STOPS * np.log2(exposure_s)) / _STOPS), dtype=np.float64)


def _bend(seen: _Array, log_times: _Array, nodes: _Array) -> tuple[_Array, float]:
    """Return the deviation at nodes, and how far the frames' factors are from their times.

    `seen`: (K, P) float64 shares of saturation, of one channel. `log_times`: (K,) float64, logarithms of exposure times
    in s. `nodes`: (B,) float64 levels, shares of saturation. Returns (B,) float64, relative; NaN where too few patches
    are near.
    """
    frames = len(seen)
    rows: list[_Array] = []
    factors_seen: list[_Array] = []
    hats = np.zeros(len(nodes))
    for number in range(frames - 1):
        before, after = seen[number], seen[number + 1]
        with np.errstate(invalid="ignore"):
            used = (before >= LOWEST) & (before <= HIGHEST) & (after >= LOWEST) & (after <= HIGHEST)
        if not used.any():
            continue
        row = np.zeros((int(used.sum()), frames - 1 + len(nodes)))
        row[:, number] = 1
        low, high = _hat(before[used], nodes), _hat(after[used], nodes)
        row[:, frames - 1 :] = high - low
        hats += low.sum(axis=0) + high.sum(axis=0)
        rows.append(row)
        factors_seen.append(np.log(after[used] / before[used]))
    measured = hats >= _LEAST_PATCHES
    if not rows or measured.sum() < 2:
        return np.full(len(nodes), np.nan), np.inf
    # A power of the light is a slope here, and each patch's noise, which is on both sides, would be taken for one; a
    # pattern that repeats with the frames' steps cannot be seen. Both are constrained to 0, hard and softly.
    at = np.where(measured, np.log(nodes) - np.log(nodes)[measured].mean(), 0)
    held = np.zeros((2 + len(nodes), frames - 1 + len(nodes)))
    held[0, frames - 1 :], held[1, frames - 1 :] = _HARD * measured, _HARD * at
    held[2:, frames - 1 :] = _SOFT * np.eye(len(nodes))
    design = np.concatenate([*rows, held])
    values = np.concatenate([*factors_seen, np.zeros(len(held))])
    solution = least_squares(design, values, np.ones(len(values)))
    # The slope of the frames' factors against their times is the power.
    seen_frames = np.array([row[:, : frames - 1].any(axis=0) for row in rows]).any(axis=0)
    steps, factors = np.diff(log_times)[seen_frames], solution[: frames - 1][seen_frames]
    course, stated = (np.concatenate([[0.0], np.cumsum(each)]) for each in (factors, steps))
    course, stated = course - course.mean(), stated - stated.mean()
    power = max(float(course @ stated) / max(float(stated @ stated), 1e-12), _LEAST_POWER)
    bend = np.where(measured, solution[frames - 1 :] + (1 - 1 / power) * at, np.nan)
    off = course - power * stated
    return np.asarray(bend - np.nanmean(bend), dtype=np.float64), float(np.sqrt((off**2).mean()))


def _hat(level: _Array, nodes: _Array) -> _Array:
    """Return the weights (N, B) of nodes for linear interpolation in the logarithm of a level."""
    at = (np.log(level) - np.log(nodes[0])) / (np.log(nodes[1]) - np.log(nodes[0]))
    return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(len(nodes))), 0), dtype=np.float64)
