"""Light in single frames that no dark frame shows: a door that opened, a lamp, daylight, whose share is in some frames.

Its amount is not found by what codes predict of a light. Two sums are known far better:

- *Codes of 0.* Of a primary whose code is 0 a light has nothing beyond the dark light. What it seems to have is room
  light in its own frame; what it seems to lack was in the frame of a primary that it is made of.
- *White.* Red, green and blue alone together give white. Where they give more, by as much in each primary and under a
  lamp that is steady, light that is no projector's was in their frames. A projector that holds full white back looks
  the same; one that brightens white hides it.

The amounts are solved for in the whites of bare paper: three equations for three amounts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

CERTAIN = 4.0  # Standard errors that are taken off each amount, so that noise is not taken for light

# Share of what white has beyond the primaries' sum that lights of two primaries may have of the third: a projector
# that adds light where primaries overlap adds mostly theirs. What is wrong with the primaries' frames looks like such
# a boost, so that the check becomes less sharp by it, but never switches itself off (judgement).
BOOST_ELSEWHERE = 0.25

# Amount beyond which it is no light of a room, but another light's frame or another exposure, which other figures
# find (judgement).
_LARGEST = 0.1

# Least singular value of the primaries' whites over the largest for amounts to be known (judgement): cameras have 0.1
# and more.
_LEAST_SHARE = 0.02

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Light that is in some frames and not in the dark ones; L lights.

    - `at_zero`: (L,) float64, what a light has of a primary whose code is 0, in parts of that primary alone, with its
      sign, the primary that is off most; NaN of lights that are not checked.
    - `certain`: (L,) float64, the size of that beyond four standard errors; 0 where not checked.
    - `of_primaries`: by how much the primaries together exceed white for certain, of white, in the primary that does
      least.
    - `primaries`: lights that are the primaries, red, green and blue.
    - `lights_of`: (L, 3) bool, the primaries that a light has a code above 0 of.
    """

    at_zero: _Array
    certain: _Array
    of_primaries: float
    primaries: tuple[int, int, int]
    lights_of: _Mask

    @property
    def share(self) -> float:
        """The largest of all, 0 … 1 of white."""
        return max(float(self.certain.max(initial=0.0)), self.of_primaries)

    @property
    def checked(self) -> _Mask:
        """(L,) bool, lights that have a code of 0 and could be held against it."""
        return np.isfinite(self.at_zero)

    def lights_beyond(self, accepted: float) -> list[int]:
        """Return the lights whose frames are concerned, the worst first.

        Primaries where they are what has the light.
        """
        worst = [int(light) for light in np.argsort(-self.certain, kind="stable") if self.certain[light] > accepted]
        own = [light for light in worst if self.at_zero[light] > 0]
        lacking = [light for light in worst if self.at_zero[light] < 0]
        together = self.of_primaries > accepted
        of = [
            light
            for primary, light in enumerate(self.primaries)
            if together or any(self.lights_of[one, primary] for one in lacking)
        ]
        return own + [light for light in of if light not in own]

    def to_json(self) -> dict[str, Any]:
        """Return the figures for `report.json`; null for lights that are not checked."""
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
    """Return what light is in frames that the dark frames do not show; None where it cannot be known.

    `codes`: (L, 3) int64, 0 … 255. `white`, `error`: (L, 3) float64 counts of bare paper and their standard errors;
    dark light, drift and stated exposures taken out. `full_white`: (W, 3) float64 counts, likewise, of white frames; of
    all, not of one, as their scatter is the lamp's. `primaries`: the lights of red, green and blue alone; None where
    one is missing. Returns none without the three primaries, or where the camera cannot tell them apart, or where a
    white is not known.
    """
    if primaries is None or not (np.isfinite(white).all() and np.isfinite(error).all()):
        return None
    alone = white[list(primaries)]
    size = np.linalg.svd(alone, compute_uv=False)
    if not size[-1] > _LEAST_SHARE * size[0]:
        return None
    inverse = np.linalg.inv(alone)
    amounts = white @ inverse
    # An error of a primary's white counts as often as the light has that primary.
    variance = error**2 + amounts**2 @ error[list(primaries)] ** 2
    spread = np.sqrt(variance @ inverse**2)
    lights_of = codes > 0
    full = full_white @ inverse
    checked = np.ones(len(codes), dtype=np.bool_)
    checked[list(primaries)] = False
    boost = max(float(full.max()) - 1, 0.0) if len(full) else 0.0
    allowed = CERTAIN * spread + np.where(lights_of.sum(axis=1) > 1, BOOST_ELSEWHERE * boost, 0.0)[:, None]
    beyond = np.where(~lights_of & checked[:, None], np.maximum(np.abs(amounts) - allowed, 0), 0.0)
    # All amounts of a light of another name or exposure are off, by far more.
    beyond[(beyond > _LARGEST).any(axis=1)] = 0
    zero = np.where(~lights_of & checked[:, None], np.abs(amounts), -1.0)
    worst = np.argmax(np.where(beyond.any(axis=1, keepdims=True), beyond, zero), axis=1)
    at_zero = amounts[np.arange(len(codes)), worst]
    has = checked & ~lights_of.all(axis=1)
    of_primaries = _of_primaries(codes[list(primaries)], full, spread[list(primaries)])
    mixed = has & (lights_of.sum(axis=1) > 1)
    if of_primaries and _are_alone(amounts[mixed], lights_of[mixed], spread[mixed], of_primaries):
        of_primaries = 0.0
    return StrayLight(
        at_zero=np.where(has, at_zero, np.nan),
        certain=beyond.max(axis=1, initial=0.0),
        of_primaries=of_primaries,
        primaries=primaries,
        lights_of=lights_of,
    )


def _of_primaries(codes: npt.NDArray[np.int64], full: _Array, spread: _Array) -> float:
    """Return by how much primaries exceed white for certain, given the amounts (W, 3) of them that white frames have.

    Nothing where they are not at full code, as white is, or fewer than two white frames say how steady the lamp is.
    """
    if len(full) < 2 or int(codes.max(axis=1).min()) < _FULL:
        return 0.0
    lacking = 1 - full.mean(axis=0)
    flicker = float(np.ptp(full.mean(axis=1)))
    # Each primary's frame may have been taken in such a flicker, too, and in a lasting change between two white frames.
    error = float(np.sqrt((spread**2).max() + (_FLICKERS * flicker) ** 2))
    share = float(lacking.min()) - CERTAIN * error
    alike = float(np.ptp(lacking)) <= _ALIKE * float(lacking.mean())
    return share if alike and 0 < share <= _LARGEST else 0.0


def _are_alone(amounts: _Array, lights_of: _Mask, spread: _Array, share: float) -> bool:
    """Return whether lights of two primaries show that the primaries' frames hold no other light.

    `amounts`, `spread`: (N, 3) float64, of each primary, and their standard errors. `lights_of`: (N, 3) bool, primaries
    with a code above 0.
    """
    holds = np.where(lights_of, amounts, 0.0) >= _MUCH
    if not (holds.sum(axis=0) >= _WITNESSES).all():
        return False
    lacks = np.where(lights_of, 0.0, np.abs(amounts) + CERTAIN * spread).max(axis=1)
    return bool(lacks[holds.any(axis=1)].max() <= _LITTLE * share)


_MUCH = 0.5  # Amount of a primary from which on a light misses half of what else is in that primary's frame

_WITNESSES = 3  # Lights of each primary that must agree (chosen: one could hold as much other light as it misses)

# Share of what primaries exceed white by that lights may lack of it, noise included, for the primaries to be alone.
_LITTLE = 0.25

_FULL = 255  # Code of a primary at its brightest

# Standard deviation of a frame's brightness over the range of that of two or three white frames: 0.6 of three.
_FLICKERS = 0.5

# Range of what the primaries exceed white by, over its mean, up to which they do alike: daylight against a lamp's
# white differs by less, frames of the primaries in a flicker by more (judgement).
_ALIKE = 0.6
