"""Detect light in single frames that no dark frame shows, such as an open door, a lamp or daylight.

Two sums are more precise than the prediction of a white from its codes:

- *Codes of 0.* A white has no light of a primary with code 0. A positive amount is room light in its own frame; a
  negative amount was in the frame of a primary that it contains.
- *White.* The sum of the red, green and blue frames is white. An excess that is equal for all primaries, with a steady
  lamp, is additional light in their frames. A projector that reduces full white looks the same; a projector that boosts
  white hides the excess.

The amounts of the primaries in the whites on paper are the solution of three equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

CERTAIN = 4.0  # Standard uncertainties subtracted from each amount, so that noise does not appear as light

# Tolerance for mixtures of two primaries: this fraction of the white boost may appear as the third primary, because
# overlaps add mostly light of the two. Faults in the primary frames also look like a boost. They make the check less
# sensitive, but cannot disable it (judgement).
BOOST_ELSEWHERE = 0.25

# Largest amount of room light; more is a wrong illuminant or exposure, which other figures detect (judgement).
_LARGEST = 0.1

# Minimum ratio of the smallest and the largest singular value of the primaries' whites (judgement): cameras have 0.1 or
# more.
_LEAST_SHARE = 0.02

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Light in some frames of L illuminants that is not in the dark frames."""

    at_zero: _Array  # (L,) worst amount of a primary with code 0, relative to that primary; NaN: not checked
    certain: _Array  # (L,) its size beyond four standard uncertainties; 0: not checked
    of_primaries: float  # excess of the sum of primaries over white beyond uncertainty: least excess of the three
    primaries: tuple[int, int, int]  # indices of red, green and blue
    lights_of: _Mask  # (L, 3) primaries with a code above 0

    @property
    def share(self) -> float:
        """Largest amount of all, 0 … 1 of white."""
        return max(float(self.certain.max(initial=0.0)), self.of_primaries)

    @property
    def checked(self) -> _Mask:
        """(L,) bool, illuminants with a code of 0 that were checked."""
        return np.isfinite(self.at_zero)

    def lights_beyond(self, accepted: float) -> list[int]:
        """Return the illuminants with affected frames, worst first: a primary if its own frame has the light."""
        worst = [int(light) for light in np.argsort(-self.certain, kind="stable") if self.certain[light] > accepted]
        positive = [light for light in worst if self.at_zero[light] > 0]
        negative = [light for light in worst if self.at_zero[light] < 0]
        exceeds_white = self.of_primaries > accepted
        affected_primaries = [
            light
            for primary, light in enumerate(self.primaries)
            if exceeds_white or any(self.lights_of[mixture, primary] for mixture in negative)
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
    """Measure light in frames that the dark frames do not show.

    Parameters
    ----------
    codes : (L, 3) int64
        0 … 255.
    white, error : (L, 3) float64
        Counts on paper, without dark light, drift and exposure differences, and their standard uncertainties.
    full_white : (W, 3) float64
        Counts of all white frames, corrected in the same way; their scatter is the scatter of the lamp.
    primaries : (int, int, int) or None
        Indices of pure red, green and blue.

    Returns
    -------
    StrayLight or None
        None without the three primaries, if the camera cannot separate them, or if a white is unknown.
    """
    if primaries is None or not (np.isfinite(white).all() and np.isfinite(error).all()):
        return None
    primary_whites = white[list(primaries)]
    singular_values = np.linalg.svd(primary_whites, compute_uv=False)
    if not singular_values[-1] > _LEAST_SHARE * singular_values[0]:
        return None
    inverse = np.linalg.inv(primary_whites)
    amounts = white @ inverse
    # Errors of a primary's white count in proportion to the amount of that primary.
    variance = error**2 + amounts**2 @ error[list(primaries)] ** 2
    spread = np.sqrt(variance @ inverse**2)
    lights_of = codes > 0
    full = full_white @ inverse
    is_checked = np.ones(len(codes), dtype=np.bool_)
    is_checked[list(primaries)] = False
    boost = max(float(full.max()) - 1, 0.0) if len(full) else 0.0
    tolerance = CERTAIN * spread + np.where(lights_of.sum(axis=1) > 1, BOOST_ELSEWHERE * boost, 0.0)[:, None]
    beyond = np.where(~lights_of & is_checked[:, None], np.maximum(np.abs(amounts) - tolerance, 0), 0.0)
    # With a wrong name or exposure all amounts deviate, and much more.
    beyond[(beyond > _LARGEST).any(axis=1)] = 0
    zero_amounts = np.where(~lights_of & is_checked[:, None], np.abs(amounts), -1.0)
    worst = np.argmax(np.where(beyond.any(axis=1, keepdims=True), beyond, zero_amounts), axis=1)
    at_zero = amounts[np.arange(len(codes)), worst]
    has_zero = is_checked & ~lights_of.all(axis=1)
    of_primaries = _primary_excess(codes[list(primaries)], full, spread[list(primaries)])
    is_mixture = has_zero & (lights_of.sum(axis=1) > 1)
    if of_primaries and _are_pure(amounts[is_mixture], lights_of[is_mixture], spread[is_mixture], of_primaries):
        of_primaries = 0.0
    return StrayLight(
        at_zero=np.where(has_zero, at_zero, np.nan),
        certain=beyond.max(axis=1, initial=0.0),
        of_primaries=of_primaries,
        primaries=primaries,
        lights_of=lights_of,
    )


def _primary_excess(codes: npt.NDArray[np.int64], full: _Array, spread: _Array) -> float:
    """Return the excess of the primaries over white from their amounts (W, 3) in white frames; 0 if unknown."""
    # Unknown if primaries are not at full code as white is, or without two white frames for the stability of the lamp.
    if len(full) < 2 or int(codes.max(axis=1).min()) < _FULL:
        return 0.0
    excess = 1 - full.mean(axis=0)
    flicker = float(np.ptp(full.mean(axis=1)))
    # Frames of primaries have the same flicker, and lasting changes between two white frames.
    error = float(np.sqrt((spread**2).max() + (_FLICKERS * flicker) ** 2))
    share = float(excess.min()) - CERTAIN * error
    is_equal = float(np.ptp(excess)) <= _ALIKE * float(excess.mean())
    return share if is_equal and 0 < share <= _LARGEST else 0.0


def _are_pure(amounts: _Array, lights_of: _Mask, spread: _Array, share: float) -> bool:
    """Return whether mixtures of two primaries show that the frames of primaries contain no other light."""
    contains = np.where(lights_of, amounts, 0.0) >= _MUCH
    if not (contains.sum(axis=0) >= _WITNESSES).all():
        return False
    missing = np.where(lights_of, 0.0, np.abs(amounts) + CERTAIN * spread).max(axis=1)
    return bool(missing[contains.any(axis=1)].max() <= _LITTLE * share)


_MUCH = 0.5  # Minimum amount of a primary in a mixture that misses half of the other light in the primary's frame

_WITNESSES = 3  # Number of mixtures per primary that must agree (judgement: in one, errors may cancel)

# Largest missing light of a mixture, noise included, relative to the excess of the primaries.
_LITTLE = 0.25

_FULL = 255  # Largest code

# Standard deviation of brightness relative to the range of two or three white frames; 0.6 for three.
_FLICKERS = 0.5

# Excesses are equal if their range relative to the mean is below this: daylight has less against the white of a lamp,
# flicker in the frames of primaries has more (judgement).
_ALIKE = 0.6
