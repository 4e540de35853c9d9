"""The lamp's drift taken out of a table, so that all its lights are of one lamp; and what else is done to the counts.

Every light is brought to the lamp at its brightest, never to a dimmer one: samples are multiplied by one or more, so
that integers that differed still differ afterwards, and the counts as measured come back exactly
(`as_measured`). Samples and ground truth are divided by the same numbers, channel by channel, so that the truth of
every image stays what it was relative to it (docs/decisions/0030-drift-is-taken-out-on-request.md).

`corrections` says in words and numbers, for `lut.json`, what was done to the counts of a table, drift or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.measures.paper import FlatField

_Array = npt.NDArray[np.float64]

SaturationSource = Literal["frames", "raw files", "settings"]

# Decimals of the gains, as `lut.json` stores them: samples are divided by the stored number, which undoes it.
DIGITS = 6

# How `lut.json` says what the saturation of a table is known from.
_SATURATION_FROM: dict[SaturationSource, str] = {
    "frames": "measured: photosites of this session reached it",
    "raw files": "the raw files' statement, which may be too high, as no photosite of a cell came near; "
    "no sample is affected, but white_level may be",
    "settings": "the settings of the computed camera",
}

LEAST_WHITES = 2  # White frames that a drift needs: one shows a lamp, and not what becomes of it

_Samples = npt.NDArray[np.uint16]


def corrections(
    page_mm: tuple[float, float],
    black: _Array,
    saturation_counts: int,
    fields: Sequence[FlatField],
    *,
    saturation_from: SaturationSource,
    gains: _Array | None = None,
    subtracted: _Array | None = None,
    at_zero: _Array | None = None,
) -> list[dict[str, Any]]:
    """Return what was done to the counts, in order, for `lut.json`.

    `black`: (L, 2, 2) float64 counts, black level of each light's frame. `saturation_counts`: raw count of saturation.
    `saturation_from`: what says so. `gains`: (L, 3) the lamp's drift at each light; None without white
    frames. `subtracted`: (L, 3) counts, dark light of bare paper that was subtracted; None where none was to be.
    `at_zero`: (L,) share of each light's samples that are 0; None where it was not counted.
    """
    done: list[dict[str, Any]] = [
        {
            "name": "black",
            "how": "subtracted: mean of the frame's masked border for each position of the 2x2 block, "
            "or the metadata's where no border is masked",
            "unit": "counts",
            "per_light": np.round(black, 3).tolist(),
        },
        {
            "name": "half size",
            "how": "R, mean of both G, B of each 2x2 block; nothing interpolated",
        },
        *([] if subtracted is None else [_dark_correction(subtracted)]),
        {
            "name": "saturation",
            "how": f"cells with a count of {CLIPPING_SHARE:g} of it or more are unfit",
            "unit": "raw counts",
            "value": saturation_counts,
            "from": _SATURATION_FROM[saturation_from],
        },
        {
            "name": "field",
            "how": "samples and ground truth divided by F(x, y), the value at the cell's centre for its 25 samples; "
            "F is the product of its factors, each sum c[k] P_i(u) P_j(v) over total orders 0, 1, 2 ..., "
            "(i, j) = (n, 0), (n-1, 1) ... (0, n) within an order n, P Legendre, u = 2x/w - 1, v = 2y/h - 1, "
            "x, y millimetres on a page of w x h; mean of F over the cells' centres = 1; multiply to undo",
            "page_mm": list(page_mm),
            "per_light": [field.parameters() for field in fields],
        },
        {
            "name": "rounding",
            "how": "to the nearest integer, negative values to 0, which lifts the mean of cells as dark as their "
            "noise, by 0.4 standard deviations of a sample at most; the ground truth is neither rounded nor cut",
            **({} if at_zero is None else {"share_at_zero": np.round(at_zero, 6).tolist()}),
        },
    ]
    if gains is not None:
        done.append(
            {
                "name": "drift",
                "applied": False,
                "how": "the lamp's light over that of the first white frame, linear in time between white frames; "
                "not applied: divide samples and ground truth of a light by it to have all lights of one lamp",
                "per_light": np.round(gains, 6).tolist(),
            }
        )
    return done


def applied_drift(gains: _Array) -> dict[str, Any]:
    """Return the entry of a drift that was taken out, gains (L, 3) float64, which stands last as it was done last."""
    return {
        "name": "drift",
        "applied": True,
        "how": "samples, ground truth and references of a light divided by it, channel by channel: the lamp's light "
        "over that of the brightest white frame, linear in time between white frames, 1 at most; the k-th of S samples "
        "v became floor(v / gain + ((11 k mod S) + 0.5) / S), which no other v becomes, so that it can be undone "
        "exactly (calibration.radiometry.drift.as_measured)",
        "per_light": gains.tolist(),
    }


def _dark_correction(subtracted: _Array) -> dict[str, Any]:
    return {
        "name": "dark",
        "how": "subtracted from samples, ground truth and references before the field is divided out: the light of the "
        "last dark frame before (projector's leak and the room's), which is at a patch that of bare paper times the "
        "dark frame's field times the patch's reflectance under white, corrected by what patches show beyond that in "
        "the dark frames so far, as far as it is more than noise; here that of bare paper, field divided out",
        "unit": "counts",
        "per_light": np.round(subtracted, 4).tolist(),
    }


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
