"""What a user may choose about a data set that its layout leaves open."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, fields

from foundation.errors import InputError


@dataclass(frozen=True)
class DataOptions:
    """What to take of a data set, and levels that replace those of its layout; None leaves the layout's own.

    - `camera`: one of the cameras of a data set of several, as its files name it: "Canon600D".
    - `subset`: a part that the data set's authors name: "test", "lab_printouts".
    - `truth`: which ground truth, where the authors give several for an image: "left", "recommended".
    - `black`: black level in the units of the files, ≥ 0.
    - `saturation`: value from which a pixel is clipped, in the units of the files, before black is subtracted, > 0.
    - `partial`: whether images that the data set should have, but this copy has not, are left out and counted; else
      they are an error.

    Raises `InputError`: a level is none.

    Examples
    --------
    >>> DataOptions(camera="Canon600D", black=2048).given
    ('camera', 'black')
    """

    camera: str | None = None
    subset: str | None = None
    truth: str | None = None
    black: float | None = None
    saturation: float | None = None
    partial: bool = False

    def __post_init__(self) -> None:
        if self.black is not None and not (math.isfinite(self.black) and self.black >= 0):
            raise InputError(f"black level {self.black:g}: expected a number from 0, in the units of the files")
        if self.saturation is not None and not (math.isfinite(self.saturation) and self.saturation > 0):
            raise InputError(f"saturation {self.saturation:g}: expected a number above 0, in the units of the files")
        if self.black is not None and self.saturation is not None and self.saturation <= self.black:
            raise InputError(f"saturation {self.saturation:g} is not above the black level {self.black:g}; correct one")

    @property
    def given(self) -> tuple[str, ...]:
        """The names of those that were given."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) not in (None, False))


def choose(given: str | None, known: Collection[str], option: str, place: str) -> str | None:
    """Return `given` as `known` spells it, or None if nothing was given.

    `given`: what the user gave; upper and lower case, "_" and "-" are the same. `known`: what there is. `option`: the
    option's name in the message: "camera". `place`: where it was looked for, for the message.

    Raises `InputError`: there is none of that name.

    Examples
    --------
    >>> choose("left-white", ["left", "left_white"], "truth", "Cube++")
    'left_white'
    """
    if given is None:
        return None
    found = [name for name in known if _plain(name) == _plain(given)]
    if not found:
        raise InputError(f"{place} has no {option} {given!r}; it has {', '.join(known) or 'none'}")
    return found[0]


def stated(given: float | None, otherwise: str) -> str:
    """Return how a level is stated with results: that the user gave it, or else where the layout has it from.

    Examples
    --------
    >>> stated(512.0, "2048 (the data set's page)")
    '512, as the user gave it'
    """
    return otherwise if given is None else f"{given:g}, as the user gave it"


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
