"""The lamp's drift taken out of a table, so that all its lights are of one lamp; where white frames determine it.

Every light is brought to the lamp at its brightest, never to a dimmer one: samples are multiplied by one or more, so
that integers that differed still differ afterwards, and the counts as measured come back exactly
(`as_measured`). Samples and ground truth are divided by the same numbers, channel by channel, so that the truth of
every image stays what it was relative to it (docs/decisions/0030-drift-is-taken-out-on-request.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

DIGITS = 6
"""Decimals of the gains, as `lut.json` stores them: samples are divided by the stored number, which undoes it."""

LEAST_WHITES = 2
"""White frames that a drift needs: one shows a lamp, and not what becomes of it."""

_Array = npt.NDArray[np.float64]
_Samples = npt.NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class DriftCorrection:
    """How a table's lights are brought to one lamp.

    - `gains`: (L, 3) float64, above 0 and at most 1: the lamp's light at each light over the brightest white frame's,
      linear in time between white frames, rounded to `DIGITS`.
    - `left`: how far white frames leave the lamp undetermined between them, a share (`undetermined`).
    """

    gains: _Array
    left: float


def drift_correction(at_s: _Array, white_at_s: _Array, white: _Array) -> DriftCorrection:
    """Return how lights are brought to the lamp at its brightest.

    `at_s`: (L,) when each light was taken. `white_at_s`, `white`: (W,) and (W, 3) when the white frames were taken,
    rising, and paper in them; at least `LEAST_WHITES`.
    """
    if len(white) < LEAST_WHITES:
        raise ValueError(f"{len(white)} white frames do not show a drift; {LEAST_WHITES} needed")
    share = white / white.max(axis=0)
    gains: _Array = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, share[:, channel])
    return DriftCorrection(np.round(gains, DIGITS), undetermined(at_s, white_at_s, white))


def undetermined(at_s: _Array, white_at_s: _Array, white: _Array) -> float:
    """Return how far the lamp may be from the line between white frames, a share, as these themselves show it.

    Each white frame is predicted from its two neighbours, as if it had not been taken; the worst miss of a channel
    counts. A lamp that changes smoothly is then missed by a quarter of that where the frame was taken, and one that
    jumps by twice as much at most. Of two white frames all that lies between them may be a jump. Lights before the
    first white frame, or behind the last, have the nearest one's light, and what the lamp did in as much time beside it
    is added.

    `at_s`, `white_at_s`, `white`: as for `drift_correction`; (L,), (W,) seconds and (W, 3) float64 counts.
    """
    steps = np.abs(np.diff(white, axis=0)) / white[:-1]
    if len(white) == LEAST_WHITES:
        return float(steps.max())
    span = white_at_s[2:] - white_at_s[:-2]
    share = ((white_at_s[1:-1] - white_at_s[:-2]) / np.maximum(span, 1e-9))[:, None]
    between = white[:-2] + share * (white[2:] - white[:-2])
    worst = float(np.abs(white[1:-1] / between - 1).max())
    pace = steps.max(axis=1) / np.maximum(np.diff(white_at_s), 1e-9)
    before, behind = max(white_at_s[0] - at_s.min(), 0.0), max(at_s.max() - white_at_s[-1], 0.0)
    return max(worst, float(pace[0] * before), float(pace[-1] * behind))


def corrected(samples: _Samples, gain: _Array) -> _Samples:
    """Return a light's samples as the brightest lamp would have given them, integers whose mean is not rounded.

    A sample v, the k-th of S, becomes ⌊v / g + u⌋ with u = ((11 k mod S) + ½) / S. Plain rounding would shift all
    samples of a cell alike, by up to half a count, as they are integers near one another; with thresholds spread evenly
    over the cell its mean is right to some hundredths.

    `samples`: (C, S, 3) uint16. `gain`: (3,) float64 of the light, above 0 and at most 1. Returns (C, S, 3) uint16.
    """
    return np.clip(_scaled(samples.astype(np.float64), gain), 0, 65535).astype(np.uint16)


def as_measured(samples: _Samples, gain: _Array) -> _Samples:
    """Return the samples (C, S, 3) uint16 that `corrected` was given, exactly; `gain` (3,) float64 as there.

    Two samples that differ by one differ by one or more afterwards, as g ≤ 1, so each result is that of one sample
    only.
    """
    after = samples.astype(np.float64)
    near = np.floor(gain * (after - _thresholds(samples.shape[1]) + 1))
    # The last bit of a product may lead to the next integer; which one it was, the rule itself tells.
    for step in (-1.0, 1.0):
        other = near + step
        near = np.where((_scaled(near, gain) != after) & (_scaled(other, gain) == after), other, near)
    return near.astype(np.uint16)


def _scaled(samples: _Array, gain: _Array) -> _Array:
    return np.floor(samples / gain + _thresholds(samples.shape[1]))


def _thresholds(count: int) -> _Array:
    """Return (S, 1) float64, thresholds in 0 … 1 spread evenly over a cell's samples; 11 divides no window's number."""
    return ((np.arange(count) * 11 % count + 0.5) / count)[:, None]
