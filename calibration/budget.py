"""Uncertainty budget of a LUT: components and expanded uncertainty of its ground truths and patch means.

Errors of a ground truth are relative to the counts of bare paper, errors of a patch to its mean, in each channel. A
component is a mean square error: a variance, plus the square of an effect that is measured but not corrected.
Components are independent and are added (JCGM 100:2008, 5.1). The expanded uncertainty has k = 2 (6.2), which covers
about 95 %. Noise of the samples is not included, because it is a property of the camera and no error of the LUT.

K components, L illuminants, C patches in the order of colour indices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from calibration.table.lut import CELL_COLUMNS, EXPANDED

COVERAGE: Final = 2.0  # Coverage factor k (JCGM 100, 6.2.1)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Component:
    """Part of the uncertainty with one origin."""

    name: str  # Identifier in files
    title: str  # Name in reports
    assumed: bool  # True if the session does not show the effect, so that its usual size is assumed
    source: str  # How the component was measured, or why it was not
    lights: _Array  # (L, 3, 3) float64, mean products of the relative errors of R, G and B, for each ground truth
    cells: _Array  # (C, 3) float64, mean square relative error of each patch mean, without the error of bare paper


@dataclass(frozen=True, eq=False)
class Budget:
    """All components of the uncertainty of a LUT."""

    components: tuple[Component, ...]
    white: _Array  # (L, 3) float64 counts above black, the ground truth

    @staticmethod
    def none() -> Budget:
        """Return an empty budget."""
        return Budget((), np.zeros((0, 3)))

    @cached_property
    def lights_deg(self) -> _Array:
        """(K, L) float64 degrees, standard uncertainty of each ground truth from each component."""
        return np.array([direction_deg(self.white, component.lights) for component in self.components])

    @cached_property
    def expanded_deg(self) -> _Array:
        """(L,) float64 degrees, expanded uncertainty of each ground truth."""
        return COVERAGE * np.sqrt((self.lights_deg**2).sum(axis=0))

    @cached_property
    def expanded_cells(self) -> _Array:
        """(C, 3) float64, expanded relative uncertainty of each patch mean."""
        return COVERAGE * np.sqrt(np.sum([component.cells for component in self.components], axis=0))

    def main_cause(self, light: int) -> Component:
        """Return the largest component in the uncertainty of an illuminant."""
        return self.components[int(np.argmax(self.lights_deg[:, light]))]

    def lights_csv(self) -> str:
        """Return the text of `uncertainty.csv`: expanded uncertainty of each illuminant, and its components."""
        names = [f"{component.name.replace(' ', '_')}_deg" for component in self.components]
        rows = zip(self.expanded_deg.tolist(), self.lights_deg.T.tolist(), strict=True)
        return _csv(["illumination", EXPANDED, *names], ([expanded, *standard] for expanded, standard in rows))

    def cells_csv(self) -> str:
        """Return the text of `cells.csv`: expanded relative uncertainty of each patch mean in R, G and B."""
        return _csv(["colour", *CELL_COLUMNS], self.expanded_cells.tolist())

    def to_json(self) -> dict[str, Any]:
        """Return the budget for `report.json`."""
        cells = self.expanded_cells
        return {
            "coverage_factor": COVERAGE,
            "light_deg": _rounded(self.expanded_deg),
            "cell_share": {
                "median": _rounded(np.median(cells, axis=0)),
                "worst": _rounded(cells.max(axis=0, initial=0)),
            },
            "components": [
                {
                    "name": component.name,
                    "title": component.title,
                    "assumed": component.assumed,
                    "source": component.source,
                    "light_deg": _rounded(by_light),
                    "cell_share": _rounded(np.sqrt(np.median(component.cells, axis=0))),
                }
                for component, by_light in zip(self.components, self.lights_deg, strict=True)
            ],
        }


def _csv(columns: list[str], rows: Iterable[list[float]]) -> str:
    lines = [",".join([str(number), *(f"{value:.4g}" for value in row)]) for number, row in enumerate(rows)]
    return "\n".join([",".join(columns), *lines]) + "\n"


def direction_deg(white: _Array, relative: _Array) -> _Array:
    """Return the RMS angle (L,) float64, degrees, by which errors turn the vectors `white` (L, 3).

    First-order propagation (JCGM 100, 5.1.2): only the error perpendicular to the vector changes its direction.

    `relative`: (L, 3, 3) float64, mean products of the relative errors of R, G and B.
    """
    length = np.linalg.norm(white, axis=1)
    along = white / np.maximum(length, 1e-9)[:, None]
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    # Maps relative errors of the components to errors perpendicular to the vector, in radians.
    projection = across * along[:, None, :]
    variance = np.einsum("lij,ljk,lik->l", projection, relative, projection)
    return np.degrees(np.sqrt(np.maximum(variance, 0)))


def _rounded(values: _Array) -> list[float]:
    return [float(f"{value:.4g}") for value in np.asarray(values).tolist()]
