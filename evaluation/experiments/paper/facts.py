"""What a table holds that explains its row of table 1: how noisy the print's white is, and how grey the print is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from evaluation.results.tables import Table
from foundation.colorimetry import angles_deg

if TYPE_CHECKING:
    from generator import Lut

DAYLIGHT_K: Final = 5600.0
"""The black body, kelvin, under which the print's colours are looked at: near what pictures are balanced for."""


@dataclass(frozen=True)
class TableNoise:
    """How bright and how noisy the print's white is in a table.

    - `camera`: the table's camera.
    - `level`: median over the lights of the white cell's brightest channel, share of saturation.
    - `spread`: median over the lights of the standard deviation of the white cell's samples over their mean, R, G and
      B.
    - `largest`: median over the lights of the largest of its samples over their mean, less 1; R, G and B.
    """

    camera: str
    lights: int
    level: float
    spread: tuple[float, float, float]
    largest: tuple[float, float, float]


def table_noise(lut: Lut) -> TableNoise:
    """Return how bright and noisy the white of a table's print is: what White-Patch lives on."""
    white = np.asarray(lut.samples[:, -1], dtype=np.float64)
    mean = np.maximum(white.mean(axis=1), 1.0)
    spread = np.median(white.std(axis=1, ddof=1) / mean, axis=0)
    largest = np.median(white.max(axis=1) / mean - 1, axis=0)
    return TableNoise(
        lut.provenance.camera,
        len(white),
        float(np.median(mean.max(axis=1)) / lut.provenance.white_level),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        (float(largest[0]), float(largest[1]), float(largest[2])),
    )


def noise_table(found: Sequence[TableNoise]) -> Table:
    """Return the noise of tables' white as a table, percent."""
    columns = ("Camera", "Lights", "White, % of saturation", "Spread of its samples R, %", "G, %", "B, %")
    return Table(
        "The print's white in the tables: medians over the lights",
        (*columns, "Largest sample above the mean R, %", "G, %", "B, %"),
        tuple(
            (noise.camera, noise.lights, *(100 * part for part in (noise.level, *noise.spread, *noise.largest)))
            for noise in found
        ),
    )


@dataclass(frozen=True)
class PrintColours:
    """What all colours of a table's print are together: the scene in which every code is as likely.

    - `camera`: the table's camera.
    - `light`: the light they are looked at under: the black body nearest to `DAYLIGHT_K`, or the table's first light.
    - `mean`, `rms`: mean and root mean square of all colours over the light's white, R, G and B.
    """

    camera: str
    light: int
    mean: tuple[float, float, float]
    rms: tuple[float, float, float]


def print_colours(lut: Lut) -> PrintColours:
    """Return the mean and root mean square of all colours of a table's print: what Gray-world and its like see."""
    away = [abs(light.cct_k - DAYLIGHT_K) if light.cct_k else np.inf for light in lut.illuminations]
    light = int(np.argmin(away))
    reflected = np.asarray(lut.samples[light], dtype=np.float64).reshape(-1, 3) / lut.white[light]
    mean, rms = reflected.mean(axis=0), np.sqrt((reflected**2).mean(axis=0))
    return PrintColours(
        lut.provenance.camera,
        light,
        (float(mean[0]), float(mean[1]), float(mean[2])),
        (float(rms[0]), float(rms[1]), float(rms[2])),
    )


def print_table(found: Sequence[PrintColours]) -> Table:
    """Return the prints' mean colours as a table, percent of white, with their angles from grey."""
    rows: list[tuple[str | float | None, ...]] = []
    for colours in found:
        for name, values in (("mean", colours.mean), ("root mean square", colours.rms)):
            angle = float(angles_deg(values, (1.0, 1.0, 1.0)))
            rows.append((colours.camera, colours.light, name, *(100 * part for part in values), angle))
    return Table(
        "All colours of the print together, % of the light's white",
        ("Camera", "Light", "Of all colours", "R, %", "G, %", "B, %", "From grey, degrees"),
        tuple(rows),
    )
