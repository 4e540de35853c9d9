"""Simulate a higher ISO speed: images get the noise of that speed, not of their look-up table (LUT)."""

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
    """Target ISO speed of images, not below the speed of the LUT, because noise cannot be removed.

    - `speed`: ISO speed of the images.
    - `base`: ISO speed at which the LUT was photographed.
    - `sensor_electrons`: read noise of a photosite that arises before the amplifier, electrons; see `sensor_noise`.

    Raises `InputError` if the speed is below that of the LUT, or if a value is out of range.
    """

    speed: float
    base: float
    sensor_electrons: float = SENSOR_ELECTRONS

    def __post_init__(self) -> None:
        if not (0 < self.base < float("inf") and 0 < self.speed < float("inf") and 0 <= self.sensor_electrons < 1e6):
            raise InputError(
                f"the ISO speed is {self.speed:g} for a LUT of ISO {self.base:g} with {self.sensor_electrons:g} "
                "electrons of read noise, expected speeds > 0 and electrons ≥ 0"
            )
        if self.speed < self.base:
            raise InputError(
                f"ISO {self.speed:g} is below the ISO {self.base:g} of the LUT, whose noise cannot be removed; use "
                f"{self.base:g} or more"
            )

    @property
    def ratio(self) -> float:
        """ISO speed relative to the LUT, 1 or more."""
        return self.speed / self.base

    def describe(self) -> dict[str, Any]:
        """Return the speeds and the read noise as plain values."""
        return {"wanted": self.speed, "table": self.base, "sensor_electrons": self.sensor_electrons}


def parse_iso(text: str, base: float | None = None, sensor_electrons: float = SENSOR_ELECTRONS) -> IsoSpeed:
    """Return the ISO speed of a text such as ``1600/100`` (images / LUT). A suffix ``:read=2.8`` gives electrons."""
    speed_text, _, options = text.strip().partition(":")
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(?:/\s*(\d+(?:\.\d*)?)\s*)?", speed_text, re.ASCII)
    table_speed = base if match is None or match[2] is None else float(match[2])
    if match is None or table_speed is None:
        raise InputError(
            f"the ISO speed is {text!r}, expected a number; if the LUT records no ISO speed, write "
            "the speeds of images and LUT, such as 1600/100"
        )
    if base is not None and table_speed != base:
        raise InputError(
            f"{text!r} gives ISO {table_speed:g} for the LUT, which records ISO {base:g}; write {match[1]}"
        )
    numbers = parse_numbers(options, {"read": (0.0, 1000.0)}, "an ISO speed")
    return IsoSpeed(float(match[1]), table_speed, numbers.get("read", sensor_electrons))


def recorded_speed(lut: Lut) -> tuple[float | None, float]:
    """Return the ISO speed of a LUT, None if it is not recorded, and the read noise before the amplifier, electrons.

    Computed LUTs record both. For photographed LUTs, the read noise is `SENSOR_ELECTRONS`.
    """
    computed, origin = lut.provenance.computed or {}, lut.provenance.origin
    try:
        return float(computed["exposure"]["iso"]), float(computed["body"]["sensor_noise_e"])
    except (KeyError, TypeError, ValueError):
        return None if origin is None or origin.iso is None else float(origin.iso), SENSOR_ELECTRONS
