"""The uncertainty budget of a table: what ground truth and cells may be off by, cause by cause, and altogether.

Errors are relative, of the white of bare paper under each light and of the mean of each cell, channel by channel. Each
component is a mean square error: its variance and, where an effect is measured but not taken out, its square.
Components are independent and add up (JCGM 100:2008, GUM, 5.1); what is stated is expanded, k = 2 (6.2), for about 95 %
of cases. The noise of samples is no error of a cell: it is the camera's. `calibration.pipeline.table_figures` fills it.

L lights, C cells in the order of colour indices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from calibration.table.lut import CELL_COLUMNS, EXPANDED

COVERAGE: Final = 2.0  # Factor k by which a standard uncertainty is expanded (JCGM 100, 6.2.1)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Component:
    """One cause of errors.

    - `name`, `title`: for programs and for people.
    - `assumed`: whether it is what is usual, since the session does not show it.
    - `lights`: (L, 3, 3) float64, mean square relative error of each light's white in R, G and B.
    - `cells`: (C, 3) float64, mean square relative error of each cell's mean, bare paper's error aside, under the light
      that the chart was registered in.
    """

    name: str
    title: str
    assumed: bool
    source: str
    lights: _Array
    cells: _Array


@dataclass(frozen=True, eq=False)
class Budget:
    """All components of a table.

    `white`: (L, 3) float64 counts above black, the ground truth.
    """

    components: tuple[Component, ...]
    white: _Array

    @staticmethod
    def none() -> Budget:
        """Return the budget of what is not yet stated."""
        return Budget((), np.zeros((0, 3)))

    @cached_property
    def lights_deg(self) -> _Array:
        """(K, L) float64 degrees, standard uncertainty of each ground truth's direction by component."""
        return np.array([direction_deg(self.white, one.lights) for one in self.components])

    @cached_property
    def expanded_deg(self) -> _Array:
        """(L,) float64 degrees, expanded uncertainty of each ground truth's direction."""
        return COVERAGE * np.sqrt((self.lights_deg**2).sum(axis=0))

    @cached_property
    def expanded_cells(self) -> _Array:
        """(C, 3) float64, expanded relative uncertainty of each cell's mean."""
        return COVERAGE * np.sqrt(np.sum([one.cells for one in self.components], axis=0))

    def main_cause(self, light: int) -> Component:
        """Return the largest component of a light."""
        return self.components[int(np.argmax(self.lights_deg[:, light]))]

    def lights_csv(self) -> str:
        """Return the text of `uncertainty.csv`: each light's expanded uncertainty, and standard ones by component."""
        names = [f"{one.name.replace(' ', '_')}_deg" for one in self.components]
        rows = zip(self.expanded_deg.tolist(), self.lights_deg.T.tolist(), strict=True)
        return _csv(["illumination", EXPANDED, *names], ([expanded, *parts] for expanded, parts in rows))

    def cells_csv(self) -> str:
        """Return the text of `cells.csv`: the expanded relative uncertainty of each cell's mean in R, G and B."""
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
                    "name": one.name,
                    "title": one.title,
                    "assumed": one.assumed,
                    "source": one.source,
                    "light_deg": _rounded(by_light),
                    "cell_share": _rounded(np.sqrt(np.median(one.cells, axis=0))),
                }
                for one, by_light in zip(self.components, self.lights_deg, strict=True)
            ],
        }


def _csv(columns: list[str], rows: Iterable[list[float]]) -> str:
    lines = [",".join([str(number), *(f"{value:.4g}" for value in row)]) for number, row in enumerate(rows)]
    return "\n".join([",".join(columns), *lines]) + "\n"


def direction_deg(white: _Array, relative: _Array) -> _Array:
    """Return the root mean square angle (L,) float64, degrees, of vectors (L, 3) whose components are off.

    First-order propagation (JCGM 100, 5.1.2): of each error the part across the vector counts.

    `relative`: (L, 3, 3) float64, mean square of the components' relative errors.
    """
    length = np.linalg.norm(white, axis=1)
    along = white / np.maximum(length, 1e-9)[:, None]
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    # Relative errors times the vector, over its length.
    turned = across * along[:, None, :]
    found = np.einsum("lij,ljk,lik->l", turned, relative, turned)
    return np.degrees(np.sqrt(np.maximum(found, 0)))


def _rounded(values: _Array) -> list[float]:
    return [float(f"{value:.4g}") for value in np.asarray(values).tolist()]
