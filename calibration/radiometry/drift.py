"""Correct a LUT for lamp drift, and list all corrections of counts for `lut.json`.

Each illuminant is scaled to the brightest state of the lamp. Samples are therefore multiplied by factors of at least 1.
Different integers stay different, so that the measured counts can be recovered exactly (`as_measured`). Samples and
ground truth of an illuminant are divided by the same gain in each channel, so they stay consistent
(docs/decisions/0030-drift-is-taken-out-on-request.md).
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

# Decimals of gains in `lut.json`. Samples are divided by the rounded gains, so that the division can be undone.
GAIN_DIGITS = 6

# Source of the saturation value, for `lut.json`.
_SATURATION_FROM: dict[SaturationSource, str] = {
    "frames": "measured: photosites of this session reached it",
    "raw files": "value of the raw files, which may be too high, because no photosite of a patch came near it; "
    "samples are not affected, but white_level may be",
    "settings": "the settings of the computed camera",
}

LEAST_WHITES = 2  # minimum number of white frames for measuring drift

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
    """Return the list of corrections, in order, for `lut.json`.

    Parameters
    ----------
    page_mm : (float, float)
    black : (L, 2, 2) float64
        Black level of the frame of each illuminant, counts.
    saturation_counts : int
        Raw counts of saturation.
    fields : sequence of FlatField
    saturation_from : SaturationSource
    gains : (L, 3) float64, optional
        Lamp drift at each illuminant; None without white frames.
    subtracted : (L, 3) float64, optional
        Subtracted dark light of paper, counts; None if it was not subtracted.
    at_zero : (L,) float64, optional
        Share of samples with value 0 under each illuminant.
    """
    entries: list[dict[str, Any]] = [
        {
            "name": "black",
            "how": "subtracted: mean of the masked border of the frame for each position of the 2x2 block, "
            "or the value in the metadata if no border is masked",
            "unit": "counts",
            "per_light": np.round(black, 3).tolist(),
        },
        {
            "name": "half size",
            "how": "each 2x2 block gives R, the mean of both G, and B; nothing is interpolated",
        },
        *([] if subtracted is None else [_dark_correction(subtracted)]),
        {
            "name": "saturation",
            "how": f"patches with a count of at least {CLIPPING_SHARE:g} times this value are unfit",
            "unit": "raw counts",
            "value": saturation_counts,
            "from": _SATURATION_FROM[saturation_from],
        },
        {
            "name": "field",
            "how": "samples and ground truth divided by F(x, y), taken at the centre of a patch for all its samples; "
            "F is the product of its factors, each sum c[k] P_i(u) P_j(v) over total orders 0, 1, 2 ..., "
            "(i, j) = (n, 0), (n-1, 1) ... (0, n) within an order n, P Legendre, u = 2x/w - 1, v = 2y/h - 1, "
            "x, y millimetres on a page of w x h; mean of F over the centres of all patches = 1; multiply to undo",
            "page_mm": list(page_mm),
            "per_light": [field.parameters() for field in fields],
        },
        {
            "name": "rounding",
            "how": "to the nearest integer, negative values to 0, which increases the mean of patches as dark as their "
            "noise by up to 0.4 standard deviations of a sample; the ground truth is neither rounded nor clipped",
            **({} if at_zero is None else {"share_at_zero": np.round(at_zero, 6).tolist()}),
        },
    ]
    if gains is not None:
        entries.append(
            {
                "name": "drift",
                "applied": False,
                "how": "lamp relative to the first white frame, linear in time between white frames; not applied: "
                "divide samples and ground truth of an illuminant by it to remove the drift",
                "per_light": np.round(gains, 6).tolist(),
            }
        )
    return entries


def applied_drift(gains: _Array) -> dict[str, Any]:
    """Return the entry of a corrected drift with gains (L, 3) float64; it is the last correction."""
    return {
        "name": "drift",
        "applied": True,
        "how": "samples, ground truth and references of an illuminant divided by it in each channel: lamp relative to "
        "the brightest white frame, linear in time between white frames, at most 1; sample v, number k of S, became "
        "floor(v / gain + ((11 k mod S) + 0.5) / S), which has a unique inverse "
        "(calibration.radiometry.drift.as_measured)",
        "per_light": gains.tolist(),
    }


def _dark_correction(subtracted: _Array) -> dict[str, Any]:
    return {
        "name": "dark",
        "how": "light of the previous dark frame (projector leak and room light), subtracted from samples, ground "
        "truth and references before division by the field; for a patch, it is paper times field of the dark frame "
        "times reflectance of the patch under white, plus the mean residual of the patch in all dark frames so far, "
        "with a weight that is small if noise is large; per_light is this light on paper, without field",
        "unit": "counts",
        "per_light": np.round(subtracted, 4).tolist(),
    }


@dataclass(frozen=True, eq=False)
class DriftCorrection:
    """Gains by which the illuminants of a LUT are divided, so that all have the brightest state of the lamp."""

    gains: _Array  # (L, 3) lamp relative to the brightest white frame, in (0, 1], rounded to `GAIN_DIGITS`
    uncertainty: float  # relative, of the lamp between white frames (`drift_uncertainty`)


def drift_correction(at_s: _Array, white_at_s: _Array, white: _Array) -> DriftCorrection:
    """Return the gains that bring all illuminants to the brightest state of the lamp.

    `at_s`: (L,) time of each illuminant, s. `white_at_s`, `white`: (W,) and (W, 3), times in ascending order and paper
    in the white frames; at least `LEAST_WHITES`.
    """
    if len(white) < LEAST_WHITES:
        raise ValueError(f"{len(white)} white frames, but drift needs at least {LEAST_WHITES}")
    relative = white / white.max(axis=0)
    gains: _Array = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, relative[:, channel])
    return DriftCorrection(np.round(gains, GAIN_DIGITS), drift_uncertainty(at_s, white_at_s, white))


def drift_uncertainty(at_s: _Array, white_at_s: _Array, white: _Array) -> float:
    """Return the largest relative deviation of the lamp from linear changes between white frames.

    Each white frame is predicted from the frames before and after it, and the largest error of a channel is returned.
    The error of interpolated gains is a quarter of this value if the drift is smooth, and at most twice this value if
    the lamp jumps. With two white frames, their whole difference is returned, because it may be a jump. Illuminants
    before the first or after the last white frame get the gain of that frame. Their error is estimated
    from the rate of change next to that frame.

    `at_s`, `white_at_s`, `white`: as for `drift_correction`.
    """
    steps = np.abs(np.diff(white, axis=0)) / white[:-1]
    if len(white) == LEAST_WHITES:
        return float(steps.max())
    span = white_at_s[2:] - white_at_s[:-2]
    fraction = ((white_at_s[1:-1] - white_at_s[:-2]) / np.maximum(span, 1e-9))[:, None]
    interpolated = white[:-2] + fraction * (white[2:] - white[:-2])
    worst = float(np.abs(white[1:-1] / interpolated - 1).max())
    rate = steps.max(axis=1) / np.maximum(np.diff(white_at_s), 1e-9)
    time_before, time_after = max(white_at_s[0] - at_s.min(), 0.0), max(at_s.max() - white_at_s[-1], 0.0)
    return max(worst, float(rate[0] * time_before), float(rate[-1] * time_after))


def corrected(samples: _Samples, gain: _Array) -> _Samples:
    """Return samples (C, S, 3) uint16 scaled to the brightest state of the lamp, as integers with accurate means.

    Sample v, number k of S, becomes ⌊v / g + u⌋ with u = ((11 k mod S) + ½) / S. Rounding to the nearest integer would
    shift all samples of a patch alike, by up to half a count, because they are similar. With distributed thresholds the
    error of the mean is a few hundredths of a count.

    `samples`: (C, S, 3) uint16. `gain`: (3,) float64, in (0, 1].
    """
    return np.clip(_scaled(samples.astype(np.float64), gain), 0, 65535).astype(np.uint16)


def as_measured(samples: _Samples, gain: _Array) -> _Samples:
    """Invert `corrected` exactly: return the original samples (C, S, 3) uint16 for `gain` (3,)."""
    # Different samples stay different by at least one, because g ≤ 1. Each result therefore has a single origin.
    scaled = samples.astype(np.float64)
    original = np.floor(gain * (scaled - _thresholds(samples.shape[1]) + 1))
    # Because of rounding errors, the result may be a neighbouring integer. Both are tested with the forward rule.
    for step in (-1.0, 1.0):
        trial = original + step
        original = np.where((_scaled(original, gain) != scaled) & (_scaled(trial, gain) == scaled), trial, original)
    return original.astype(np.uint16)


def _scaled(samples: _Array, gain: _Array) -> _Array:
    return np.floor(samples / gain + _thresholds(samples.shape[1]))


def _thresholds(count: int) -> _Array:
    # Evenly distributed over the samples of a patch, because 11 and the number of samples have no common divisor.
    return ((np.arange(count) * 11 % count + 0.5) / count)[:, None]
