"""The ISO speed whose noise images are to have, beside that of their table."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from foundation.errors import InputError
from generator.named_numbers import parse_numbers
from generator.variation.sensor_noise import SENSOR_ELECTRONS

if TYPE_CHECKING:
    from calibration.table.lut import Lut


@dataclass(frozen=True)
class IsoSpeed:
    """A speed at or above that of the table: noise can be added, and not be taken away.

    - `wanted`, `base`: the speed that images are to have, and that with which the table was photographed.
    - `sensor_electrons`: read noise of a photosite before the amplifier, electrons; see `sensor_noise`.

    Raises `InputError`: the wanted speed is below that of the table, or a number is not above 0.
    """

    wanted: float
    base: float
    sensor_electrons: float = SENSOR_ELECTRONS

    def __post_init__(self) -> None:
        if not (0 < self.base < float("inf") and 0 < self.wanted < float("inf") and 0 <= self.sensor_electrons < 1e6):
            raise InputError(
                f"ISO {self.wanted:g} of a table of ISO {self.base:g} with {self.sensor_electrons:g} electrons of read "
                "noise was asked for, expected numbers above 0"
            )
        if self.wanted < self.base:
            raise InputError(
                f"ISO {self.wanted:g} was asked for, below the ISO {self.base:g} of the table, whose noise cannot be "
                f"taken away; ask for {self.base:g} or more"
            )

    @property
    def ratio(self) -> float:
        """The wanted speed over that of the table, 1 or more."""
        return self.wanted / self.base

    def describe(self) -> dict[str, Any]:
        """Return the speeds as plain values."""
        return {"wanted": self.wanted, "table": self.base, "sensor_electrons": self.sensor_electrons}


def parse_iso(text: str, base: float | None = None, sensor_electrons: float = SENSOR_ELECTRONS) -> IsoSpeed:
    """Return the speed that a text names: ``1600/100``, wanted over the table's, with ``:read=2.8`` electrons."""
    speeds, _, rest = text.strip().partition(":")
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(?:/\s*(\d+(?:\.\d*)?)\s*)?", speeds, re.ASCII)
    own = base if match is None or match[2] is None else float(match[2])
    if match is None or own is None:
        raise InputError(
            f"{text!r} is no ISO speed of a table that does not say its own; write the wanted one over that with which "
            "the table was photographed, such as 1600/100"
        )
    if base is not None and own != base:
        raise InputError(
            f"{text!r} says that the table is of ISO {own:g}, and the table says {base:g}; write {match[1]}"
        )
    numbers = parse_numbers(rest, {"read": (0.0, 1000.0)}, "an ISO speed")
    return IsoSpeed(float(match[1]), own, numbers.get("read", sensor_electrons))


def known_of_table(lut: Lut) -> tuple[float | None, float]:
    """Return the ISO speed of a table, None if it does not say it, and the read noise before the amplifier, electrons.

    Computed tables say both. Photographed ones say the speed, where they were built by software that keeps it; their
    noise is `SENSOR_ELECTRONS`.
    """
    computed, origin = lut.provenance.computed or {}, lut.provenance.origin
    try:
        return float(computed["exposure"]["iso"]), float(computed["body"]["sensor_noise_e"])
    except (KeyError, TypeError, ValueError):
        return None if origin is None or origin.iso is None else float(origin.iso), SENSOR_ELECTRONS
