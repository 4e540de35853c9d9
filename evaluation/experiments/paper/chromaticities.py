"""The rb-chromaticities of a table's lights as the camera sees them on an achromatic surface (section 3.1 and 3.3).

What the paper's two figures show for the EOS 550D and the 6D Mark II, and beside them the ground truths of real data
sets: which of their lights a table can stand for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from evaluation.results.tables import Table
from generator.lights.choices import nearest_lights

if TYPE_CHECKING:
    from generator import Lut


@dataclass(frozen=True, eq=False)
class TableLights:
    """The lights of a table.

    - `camera`: of the table.
    - `rb`: (L, 2) float64, r = R / (R + G + B) and b = B / (R + G + B) of linear camera RGB.
    - `black_body`: (L,) bool, True for a black body of the plan.
    """

    camera: str
    rb: npt.NDArray[np.float64]
    black_body: npt.NDArray[np.bool_]


def rb_of(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rb-chromaticities (N, 2) float64 of lights (N, 3) float64, linear camera RGB of any length.

    Examples
    --------
    >>> rb_of(np.array([[1.0, 2.0, 1.0]]))
    array([[0.25, 0.25]])
    """
    return (lights / lights.sum(axis=1, keepdims=True))[:, [0, 2]]


def table_lights(lut: Lut) -> TableLights:
    """Return the chromaticities of a table's lights."""
    kinds = np.array([light.kind == "blackbody" for light in lut.illuminations], dtype=np.bool_)
    return TableLights(lut.provenance.camera, rb_of(lut.white), kinds)


def chromaticity_rows(luts: Sequence[Lut]) -> Table:
    """Return every light of tables with its kind and chromaticity, for CSV."""
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        found = table_lights(lut)
        for light, (r, b) in zip(lut.illuminations, found.rb, strict=True):
            rows.append((found.camera, light.index, light.kind, light.cct_k, float(r), float(b)))
    return Table("rb-chromaticities of lights", ("camera", "light", "kind", "cct_k", "r", "b"), tuple(rows), digits=4)


def coverage_table(luts: Sequence[Lut], sets: Mapping[str, npt.NDArray[np.float64]]) -> Table:
    """Return how near the lights of tables come to the ground truths of data sets.

    `sets`: name of a data set to its ground truths, (N, 3) float64, linear camera RGB of any length.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        for name, truths in sets.items():
            matches = nearest_lights(lut, truths).matches
            angles = np.array([match.angle for match in matches])
            different = len({match.mixture.label for match in matches})
            rows.append(
                (
                    lut.provenance.camera,
                    name,
                    len(truths),
                    different,
                    float(np.median(angles)),
                    float(np.percentile(angles, 95, method="hazen")),
                    float(angles.max()),
                )
            )
    return Table(
        "Angle from ground truths to the nearest light of a table, degrees",
        ("Table", "Data set", "Ground truths", "Lights that are nearest", "Median", "95th percentile", "Largest"),
        tuple(rows),
    )
