"""Red, green and blue alone: the flat field of coloured cells, whether the primaries add up, and how the lamp drifts.

A projector's red, green and blue do not fade alike towards the corners. The field of a light that mixes them, as bare
paper shows it, is the mean of their fields, weighted by what paper reflects of each; a coloured cell reflects other
shares, and its mean is another. The frames of the primaries alone show both
(`docs/decisions/0014-fields-of-the-primaries.md`). Additivity and drift alter no table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from calibration.radiometry.superposition import Superposition
from experiment.lights import Illumination
from experiment.measures.least_squares import product
from experiment.measures.paper import FlatField, Paper

_Array = npt.NDArray[np.float64]

# Counts above black that paper must show under a primary for its field to be known well enough (judgement).
LEAST_PAPER = 300.0

_LARGEST = 0.2  # Share by which a cell's field may differ from paper's; beyond, the difference is noise and left out


@dataclass(frozen=True, eq=False)
class Additivity:
    """How white is made of the primaries.

    - `off`: (3,) float64, by how much they together differ from white in each channel, relative to white.
    - `error`: (3,) float64, its standard error by what is not known of the sensor.
    - `amounts`: (3,) float64, how much of red, green and blue alone white has, 1 where it adds.
    """

    off: _Array
    error: _Array
    amounts: _Array


def additivity(
    lights: Sequence[Illumination],
    white: _Array,
    full_white: _Array | None,
    dark: _Array,
    gains: _Array,
    sensor: Superposition,
) -> Additivity | None:
    """Return how white is made of the primaries; None when one of them or white is missing.

    red + green + blue − 2 black = white where light adds: each of the three brings the projector's black along. A
    projector with a white segment on its wheel, or one that processes colours, gives more or less. It harms no table,
    since each light's ground truth is measured; it means that a light cannot be predicted from its codes. A sensor that
    compresses white would hide that too much dark light was subtracted: what is measured of that is taken out first.

    `lights`: L lights; used are the three with one full primary, and full white if `full_white` is None. `white`: (L,
    3) their ground truths. `full_white`: (3,) paper under full white from the white frames, None without. `dark`: (3,)
    paper in the dark frames; zeros where already subtracted. `gains`: (L, 3) the lamp's drift at each light, of which
    white frames are free; `drift_gains`. `sensor`: how its counts deviate from proportion to light.
    """
    index_of: dict[tuple[int, int, int], int] = {light.colour: light.index for light in lights}
    primaries = [index_of[codes] for codes in ((255, 0, 0), (0, 255, 0), (0, 0, 255)) if codes in index_of]
    full = index_of.get((255, 255, 255))
    if len(primaries) < 3 or (full_white is None and full is None) or not np.isfinite(dark).all():
        return None
    counts = np.array([white[full] if full_white is None else full_white, *white[primaries]])
    deviation, weights = sensor.relative(np.maximum(counts, 0))
    drift = np.ones(3) if full_white is not None else gains[full]
    total, *alone = counts / (1 + deviation) / np.array([drift, *gains[primaries]]) - dark
    off = (np.sum(alone, axis=0) - total) / (total + dark)
    together = np.einsum("pc,pck->ck", np.array(alone) / (total + dark), weights[1:]) - weights[0]
    error = np.sqrt(np.einsum("ck,kl,cl->c", together, sensor.covariance, together))
    amounts: _Array = np.asarray(np.linalg.lstsq(np.array(alone).T, total, rcond=None)[0], dtype=np.float64)
    return Additivity(off, error, amounts)


def drift_gains(at_s: _Array, white_at_s: _Array, white: _Array) -> _Array:
    """Return the lamp's light at times over that of the first white frame, linear between white frames.

    `at_s`: (L,) when each light was taken. `white_at_s`, `white`: (W,) and (W, 3) when the white frames were taken,
    rising, and paper in them. Returns (L, 3) float64; ones where there are fewer than two white frames.
    """
    if len(white) < 2:
        return np.ones((len(at_s), 3))
    gains = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, white[:, channel] / white[0, channel])
    return gains


def pure_lights(illuminations: Sequence[Illumination]) -> tuple[int, int, int] | None:
    """Return the index of the brightest light of red alone, of green and of blue; None where one is not planned."""
    found: list[int] = []
    for channel in range(3):
        alone: list[tuple[int, int]] = []
        for light in illuminations:
            code = light.colour[channel]
            if code > 0 and sum(light.colour) == code:
                alone.append((code, -light.index))
        if not alone:
            return None
        found.append(-max(alone)[1])
    return found[0], found[1], found[2]


@dataclass(frozen=True, eq=False)
class Primaries:
    """The three primaries of a session, each from a frame of it alone.

    - `lights`: index of the light of red alone, of green and of blue.
    - `fields`: the flat field of each, from the channel in which it is brightest, the same for all channels.
    - `paper`: (3, 3) float64 counts above black of bare paper by primary and channel, field divided out.
    - `at_cells`: (3, C) float64, the fields at the cells.
    - `cells`: (3, C, 3) float64 mean counts of each cell by primary, as in the table's samples of that light.
    """

    lights: tuple[int, int, int]
    fields: tuple[FlatField, FlatField, FlatField]
    paper: _Array
    at_cells: _Array
    cells: _Array

    @staticmethod
    def of(
        lights: Sequence[int], papers: Sequence[Paper], cells: Sequence[_Array], cells_mm: _Array
    ) -> Primaries | None:
        """Return the primaries, None where paper shows less than `LEAST_PAPER` counts under one.

        `cells`: (C, 3) float64 mean counts of each cell in each frame, field divided out. `cells_mm`: (C, 2) float64
        mm, the cells' centres.
        """
        white = np.array([paper.white for paper in papers])
        if white.max(axis=1).min() < LEAST_PAPER:
            return None
        best = white.argmax(axis=1).tolist()
        red, green, blue = (
            replace(paper.field, coefficients=(paper.field.coefficients[channel],) * 3)
            for paper, channel in zip(papers, best, strict=True)
        )
        at_cells = np.array([shape.at(cells_mm)[:, 0] for shape in (red, green, blue)])
        one, two, three = lights
        return Primaries(
            (one, two, three), (red, green, blue), np.maximum(white, 0), at_cells, np.maximum(np.array(cells), 0)
        )

    def amounts(self, white: _Array) -> _Array:
        """Return how much of each primary (3,) float64, ≥ 0, a light is made of, given its paper (3,) in counts.

        By non-negative least squares; 1 is the primary as bright as in its own frame.
        """
        return np.asarray(nnls(self.paper.T, np.maximum(white, 0))[0])

    def field_ratio(self, white: _Array) -> _Array:
        """Return the field of each cell over the field of paper in its place, (C, 3) float64, near 1.

        `white`: (3,) counts of bare paper under the light, field divided out.
        """
        amounts = self.amounts(white)
        shares = amounts[:, None] * self.paper
        total = shares.sum(axis=0)
        of_paper = np.where(total > 1, product(self.at_cells.T, shares) / np.maximum(total, 1), 1.0)
        plain, lit = np.zeros(self.cells.shape[1:]), np.zeros(self.cells.shape[1:])
        for amount, at_cells, cells in zip(amounts, self.at_cells, self.cells, strict=True):
            if amount > 0:
                part = amount * cells
                plain += part
                lit += at_cells[:, None] * part
        ratio = np.where((plain > 1) & (total > 1), lit / np.maximum(plain, 1) / of_paper, 1.0)
        return np.where(np.abs(ratio - 1) < _LARGEST, ratio, 1.0)

    @property
    def difference(self) -> float:
        """Largest difference of two primaries' fields at a cell, as a share."""
        return float((self.at_cells.max(axis=0) / self.at_cells.min(axis=0)).max() - 1)

    def correction(self, white: _Array) -> dict[str, Any]:
        """Return what was done, for `lut.json`; `white` is (L, 3) counts, paper under each light."""
        return {
            "name": "primaries",
            "how": "samples divided by R besides the field: R = [sum w F a / sum w a] / [sum w F p / sum w p], sums "
            "over the primaries; F the field of each at the cell, factors as under field; w how much of each a light "
            "is made of; p paper under each, by channel; a the mean of the cell's samples in the light of each; R = 1 "
            "where a divisor is below 1 count or R further from 1 than 0.2; multiply to undo, to within rounding",
            "lights": list(self.lights),
            "field": [field.parameters()[0] for field in self.fields],
            "paper": np.round(self.paper, 4).tolist(),
            "per_light": np.round([self.amounts(light) for light in white], 7).tolist(),
        }
