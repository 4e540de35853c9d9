"""Spectra of lights that the CIE and others have published, by their names.

The tables are in `sim/data`, whose README says where they are from: the illuminants of CIE 15:2018 and ISO 7589, and
measured light sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PublishedSpectrum:
    """A spectrum as it was published.

    - `wavelengths_nm`: (W,) float64, ascending in even steps.
    - `power`: (W,) float64, relative, per nm.
    """

    wavelengths_nm: _Array
    power: _Array


@cache
def published_spectra() -> Mapping[str, PublishedSpectrum]:
    """Return every published light by its name, such as ``D65``, ``FL2``, ``LED-B3``, ``Kinoton 75P``."""
    return MappingProxyType(_read("published_lights.csv"))


def daylight(cct_k: float) -> PublishedSpectrum:
    """Return the CIE daylight of a correlated colour temperature (CIE 15:2018, 4.1.2), K, 4000 … 25 000.

    From the components S₀, S₁ and S₂, their factors rounded to three places as the CIE does.
    """
    inverse = 1000 / cct_k
    low = (0.244063, 0.09911, 2.9678, -4.6070)
    high = (0.237040, 0.24748, 1.9018, -2.0064)
    x = sum(factor * inverse**power for power, factor in enumerate(low if cct_k <= 7000 else high))
    y = -3.0 * x**2 + 2.870 * x - 0.275
    scale = 0.0241 + 0.2562 * x - 0.7341 * y
    first = round((-1.3515 - 1.7703 * x + 5.9114 * y) / scale, 3)
    second = round((0.0300 - 31.4424 * x + 30.0717 * y) / scale, 3)
    mean, yellow_blue, pink_green = (_components()[name] for name in ("S0", "S1", "S2"))
    power = mean.power + first * yellow_blue.power + second * pink_green.power
    return PublishedSpectrum(mean.wavelengths_nm, power)


@cache
def _components() -> dict[str, PublishedSpectrum]:
    return _read("daylight_components.csv")


def _read(name: str) -> dict[str, PublishedSpectrum]:
    """Return the spectra of a table in `sim.data`: a line each, name, first wavelength, step, values."""
    found: dict[str, PublishedSpectrum] = {}
    text = resources.files("sim").joinpath("data", name).read_text("utf-8")
    for line in text.splitlines()[1:]:
        light, first, step, values = line.split(";")
        power = np.array(values.split(), dtype=np.float64)
        found[light] = PublishedSpectrum(float(first) + float(step) * np.arange(len(power), dtype=np.float64), power)
    return found
