"""Detect room light that is in some frames and not in the dark frames, for example through an open door.

The counts of white paper under an illuminant are a weighted sum of its counts under red, green and blue at full code.
The weights are the amounts of the primaries. They follow from three equations, one for each camera channel, and are
checked in two ways:

- *Codes of 0.* The amount of a primary with code 0 must be 0. If it is positive, room light is in the frame of this
  illuminant. If it is negative, room light is in the frame of a primary that the illuminant contains.
- *White.* The amounts in white frames must be 1. If all three are below 1 by the same value, and the lamp is steady,
  room light is in the frames of the primaries. A projector that reduces full white has the same effect; a projector
  that boosts white hides the room light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

# Number of standard uncertainties subtracted from an amount, so that noise does not appear as light.
CERTAIN_SIGMAS = 4.0

# A projector that boosts white also boosts mixtures of two primaries, and part of the added light may look like the
# third primary. This tolerance is relative to the boost of white. A fault in the frame of a primary also looks like a
# boost, so a larger tolerance could disable the check. Chosen by judgement.
BOOST_TOLERANCE = 0.25

# Largest amount that is reported as room light. A larger amount means a wrong illuminant or exposure, which other
# figures detect. Chosen by judgement.
_MAX_ROOM_LIGHT = 0.1

# Minimum ratio of the smallest to the largest singular value of the counts under the primaries. Cameras have 0.1 or
# more; below the minimum, the camera cannot separate the primaries. Chosen by judgement.
_MIN_SINGULAR_RATIO = 0.02

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Room light in some frames of L illuminants that is not in the dark frames."""

    # (L,) amount, relative to full code, of the primary with code 0 that differs most from 0; NaN: not checked
    at_zero: _Array
    certain: _Array  # (L,) absolute amount beyond four standard uncertainties, ≥ 0; 0 if not checked
    of_primaries: float  # certain room light in the frames of the primaries, relative to white; 0 if not checked
    primaries: tuple[int, int, int]  # indices of red, green and blue
    has_primary: _Mask  # (L, 3) whether the code of a primary is above 0

    @property
    def share(self) -> float:
        """Largest amount of room light, 0 … 1 of white."""
        return max(float(self.certain.max(initial=0.0)), self.of_primaries)

    @property
    def checked(self) -> _Mask:
        """(L,) bool, illuminants with a code of 0 that were checked."""
        return np.isfinite(self.at_zero)

    def lights_beyond(self, accepted: float) -> list[int]:
        """Return the illuminants with more room light than `accepted` in their frames, worst first; primaries last."""
        worst = [int(light) for light in np.argsort(-self.certain, kind="stable") if self.certain[light] > accepted]
        positive = [light for light in worst if self.at_zero[light] > 0]
        negative = [light for light in worst if self.at_zero[light] < 0]
        exceeds_white = self.of_primaries > accepted
        affected_primaries = [
            light
            for primary, light in enumerate(self.primaries)
            if exceeds_white or any(self.has_primary[mixture, primary] for mixture in negative)
        ]
        return positive + [light for light in affected_primaries if light not in positive]

    def to_json(self) -> dict[str, Any]:
        """Return the figures for `report.json`; null for illuminants that were not checked."""
        at_zero = [None if value != value else round(value, 6) for value in self.at_zero.tolist()]
        return {
            "at_zero_codes": at_zero,
            "certain": np.round(self.certain, 6).tolist(),
            "of_primaries": round(self.of_primaries, 6),
            "primaries": list(self.primaries),
            "lights_checked": int(self.checked.sum()),
        }


def stray_light(
    codes: npt.NDArray[np.int64],
    white: _Array,
    error: _Array,
    full_white: _Array,
    primaries: tuple[int, int, int] | None,
) -> StrayLight | None:
    """Measure room light that is not in the dark frames.

    Parameters
    ----------
    codes : (L, 3) int64
        0 … 255.
    white, error : (L, 3) float64
        Counts of paper, corrected for dark frames, drift and exposure, and their standard uncertainties.
    full_white : (W, 3) float64
        Counts of paper in all white frames, corrected for dark frames and exposure; they scatter with the lamp.
    primaries : (int, int, int) or None
        Indices of pure red, green and blue.

    Returns
    -------
    StrayLight or None
        None if a primary is missing, if the camera cannot separate the primaries, or if counts are unknown.
    """
    if primaries is None or not (np.isfinite(white).all() and np.isfinite(error).all()):
        return None
    primary_whites = white[list(primaries)]
    singular_values = np.linalg.svd(primary_whites, compute_uv=False)
    if not singular_values[-1] > _MIN_SINGULAR_RATIO * singular_values[0]:
        return None
    inverse = np.linalg.inv(primary_whites)
    amounts = white @ inverse
    # Each primary adds the variance of its counts, multiplied by the square of its amount.
    variance = error**2 + amounts**2 @ error[list(primaries)] ** 2
    spread = np.sqrt(variance @ inverse**2)
    has_primary = codes > 0
    full = full_white @ inverse
    is_checked = np.ones(len(codes), dtype=np.bool_)
    is_checked[list(primaries)] = False
    boost = max(float(full.max()) - 1, 0.0) if len(full) else 0.0
    tolerance = CERTAIN_SIGMAS * spread + np.where(has_primary.sum(axis=1) > 1, BOOST_TOLERANCE * boost, 0.0)[:, None]
    beyond = np.where(~has_primary & is_checked[:, None], np.maximum(np.abs(amounts) - tolerance, 0), 0.0)
    # A wrong illuminant or exposure changes all amounts, and by more than room light.
    beyond[(beyond > _MAX_ROOM_LIGHT).any(axis=1)] = 0
    zero_amounts = np.where(~has_primary & is_checked[:, None], np.abs(amounts), -1.0)
    worst = np.argmax(np.where(beyond.any(axis=1, keepdims=True), beyond, zero_amounts), axis=1)
    at_zero = amounts[np.arange(len(codes)), worst]
    has_zero = is_checked & ~has_primary.all(axis=1)
    of_primaries = _primary_excess(codes[list(primaries)], full, spread[list(primaries)])
    is_mixture = has_zero & (has_primary.sum(axis=1) > 1)
    if of_primaries and _are_clean(amounts[is_mixture], has_primary[is_mixture], spread[is_mixture], of_primaries):
        of_primaries = 0.0
    return StrayLight(
        at_zero=np.where(has_zero, at_zero, np.nan),
        certain=beyond.max(axis=1, initial=0.0),
        of_primaries=of_primaries,
        primaries=primaries,
        has_primary=has_primary,
    )


def _primary_excess(codes: npt.NDArray[np.int64], full: _Array, spread: _Array) -> float:
    """Return the room light in the primaries' frames from the amounts (W, 3) in white frames; 0 if unknown."""
    # The sum of the primaries is white only at full code. Two white frames show whether the lamp is steady.
    if len(full) < 2 or int(codes.max(axis=1).min()) < _FULL_CODE:
        return 0.0
    excess = 1 - full.mean(axis=0)
    flicker = float(np.ptp(full.mean(axis=1)))
    # The frames of the primaries have the same flicker and slow changes as the white frames.
    error = float(np.sqrt((spread**2).max() + (_DEVIATION_PER_RANGE * flicker) ** 2))
    share = float(excess.min()) - CERTAIN_SIGMAS * error
    is_equal = float(np.ptp(excess)) <= _MAX_EXCESS_RANGE * float(excess.mean())
    return share if is_equal and 0 < share <= _MAX_ROOM_LIGHT else 0.0


def _are_clean(amounts: _Array, has_primary: _Mask, spread: _Array, share: float) -> bool:
    """Return whether mixtures of two primaries prove that the frames of the primaries contain no room light.

    `share`: supposed room light.
    """
    contains = np.where(has_primary, amounts, 0.0) >= _MIN_AMOUNT
    if not (contains.sum(axis=0) >= _MIN_MIXTURES).all():
        return False
    missing = np.where(has_primary, 0.0, np.abs(amounts) + CERTAIN_SIGMAS * spread).max(axis=1)
    return bool(missing[contains.any(axis=1)].max() <= _MAX_CLEAN_AMOUNT * share)


# Smallest amount of a primary with which a mixture shows whether the frame of this primary contains room light. If it
# does, the primary with code 0 gets a negative amount, at least half as large as the room light.
_MIN_AMOUNT = 0.5

_MIN_MIXTURES = 3  # Number of mixtures per primary that must agree, because errors may cancel in one of them

# The frames of the primaries are clean if the amounts of primaries with code 0, including their uncertainty, are below
# this fraction of the supposed room light.
_MAX_CLEAN_AMOUNT = 0.25

_FULL_CODE = 255  # Largest code

# Assumed ratio of the lamp's standard deviation to the range of the white frames; 0.6 is expected for three frames.
_DEVIATION_PER_RANGE = 0.5

# Largest range of the three excesses relative to their mean. Daylight has a smaller range, although its colour differs
# from the lamp. Flicker in the frames of the primaries has a larger range. Chosen by judgement.
_MAX_EXCESS_RANGE = 0.6
