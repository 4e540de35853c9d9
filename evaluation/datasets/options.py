"""Options for reading a data set, as given by the user."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, fields

from foundation.errors import InputError


@dataclass(frozen=True)
class DataOptions:
    """Selected part of a data set, and black and saturation levels that replace those of its layout.

    Parameters
    ----------
    camera
        Name of one camera as in the file names: "Canon600D"; None for all.
    subset
        Name of one subset as its authors write it: "test", "lab_printouts"; None for all.
    truth
        Name of the ground truth if there are several: "left", "recommended"; None for the layout's default.
    black
        Black level ≥ 0, in the units of the files; None for the level of the layout.
    saturation
        Value > 0 from which a pixel is clipped, in the units of the files, black level not subtracted; None for the
        level of the layout.
    partial
        True to exclude and count missing images; False to raise an error for them.

    Raises
    ------
    InputError
        A level is out of range, or the saturation is not above the black level.

    Examples
    --------
    >>> DataOptions(camera="Canon600D", black=2048).set_options
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
            raise InputError(f"black level {self.black:g}, expected 0 or more, in the units of the files; correct it")
        if self.saturation is not None and not (math.isfinite(self.saturation) and self.saturation > 0):
            raise InputError(f"saturation {self.saturation:g}, expected above 0, in the units of the files; correct it")
        if self.black is not None and self.saturation is not None and self.saturation <= self.black:
            raise InputError(f"saturation {self.saturation:g}, expected above black level {self.black:g}; correct it")

    @property
    def set_options(self) -> tuple[str, ...]:
        """Names of the options that were given."""
        return tuple(field.name for field in fields(self) if getattr(self, field.name) not in (None, False))


def choose_name(requested: str | None, available: Collection[str], option: str, location: str) -> str | None:
    """Return the available name that equals `requested`; None if none was requested. Case and "_" or "-" do not matter.

    Raises InputError if there is no such name; `option` and `location` are for its message.

    Examples
    --------
    >>> choose_name("left-white", ["left", "left_white"], "truth", "Cube++")
    'left_white'
    """
    if requested is None:
        return None
    matches = [name for name in available if _normalised(name) == _normalised(requested)]
    if not matches:
        raise InputError(f"{location} has no {option} {requested!r}, expected one of {', '.join(available) or 'none'}")
    return matches[0]


def level_note(level: float | None, otherwise: str) -> str:
    """Return a text with the level given by the user; if it is None, return `otherwise`, the text of the layout.

    Examples
    --------
    >>> level_note(512.0, "2048 (the data set's page)")
    '512, given by the user'
    """
    return otherwise if level is None else f"{level:g}, given by the user"


def _normalised(name: str) -> str:
    return name.lower().replace("-", "_")
