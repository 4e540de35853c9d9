"""Measure the flat field of coloured patches and the additivity of light with frames of red, green and blue alone.

In the projected image, red, green and blue fall off differently towards the corners. The flat field of paper under a
mixture is the mean of their fields, weighted by the light of each primary. A coloured patch reflects other proportions
of the primaries, so its flat field differs from the field of paper. The frames of the primaries show fields and
proportions (`docs/decisions/0014-fields-of-the-primaries.md`). Additivity and lamp drift are measured as well, but do
not change a LUT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from calibration.radiometry.superposition import Superposition
from experiment.lights import Illuminant
from experiment.measures.least_squares import product
from experiment.measures.paper import FlatField, Paper

_Array = npt.NDArray[np.float64]

# Minimum counts of paper above black level, under each primary, for measuring its flat field. Chosen by judgement.
LEAST_PAPER = 300.0

# Largest relative difference of a patch's field from the field of paper. A larger difference is noise and is ignored.
_MAX_FIELD_DIFFERENCE = 0.2


@dataclass(frozen=True, eq=False)
class Additivity:
    """Comparison of white with the sum of the primaries."""

    off: _Array  # (3,) relative difference of the sum from white in each channel
    error: _Array  # (3,) its standard uncertainty from the linearity of the sensor
    amounts: _Array  # (3,) amounts of red, green and blue in white; 1 if light adds


def additivity(
    lights: Sequence[Illuminant],
    white: _Array,
    full_white: _Array | None,
    dark: _Array,
    gains: _Array,
    sensor: Superposition,
) -> Additivity | None:
    """Compare white with the sum of the primaries; None if a primary or white is missing.

    If light adds, red + green + blue − 2 black = white, because each of the three contains the black of the projector.
    With a white segment in the colour wheel, or with colour processing, white differs from this sum. This does not harm
    a LUT, because the ground truth of each illuminant is measured, but whites cannot be predicted from codes. Measured
    nonlinearity is corrected first, because compression of white would hide that too much dark light was subtracted.

    Parameters
    ----------
    lights : sequence of Illuminant
        The L illuminants; the three full primaries are used, and full white if `full_white` is None.
    white : (L, 3) float64
        Ground truths.
    full_white : (3,) float64, optional
        Paper in the white frames.
    dark : (3,) float64
        Paper in the dark frames; zeros if already subtracted.
    gains : (L, 3) float64
        Lamp drift at each illuminant (`drift_gains`), not in white frames.
    sensor : Superposition
        Linearity of the sensor.
    """
    index_of: dict[tuple[int, int, int], int] = {light.colour: light.index for light in lights}
    primaries = [index_of[codes] for codes in ((255, 0, 0), (0, 255, 0), (0, 0, 255)) if codes in index_of]
    white_index = index_of.get((255, 255, 255))
    if len(primaries) < 3 or (full_white is None and white_index is None) or not np.isfinite(dark).all():
        return None
    counts = np.array([white[white_index] if full_white is None else full_white, *white[primaries]])
    deviation, weights = sensor.relative(np.maximum(counts, 0))
    white_gain = np.ones(3) if full_white is not None else gains[white_index]
    total, *alone = counts / (1 + deviation) / np.array([white_gain, *gains[primaries]]) - dark
    difference = (np.sum(alone, axis=0) - total) / (total + dark)
    error_weights = np.einsum("pc,pck->ck", np.array(alone) / (total + dark), weights[1:]) - weights[0]
    error = np.sqrt(np.einsum("ck,kl,cl->c", error_weights, sensor.covariance, error_weights))
    amounts: _Array = np.asarray(np.linalg.lstsq(np.array(alone).T, total, rcond=None)[0], dtype=np.float64)
    return Additivity(difference, error, amounts)


def drift_gains(at_s: _Array, white_at_s: _Array, white: _Array) -> _Array:
    """Return the lamp relative to the first white frame (L, 3) float64, linear between white frames.

    `at_s`: (L,) time of each illuminant, s. `white_at_s`, `white`: (W,) and (W, 3), times in ascending order and paper
    in the white frames. Returns ones with fewer than two white frames.
    """
    if len(white) < 2:
        return np.ones((len(at_s), 3))
    gains = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, white[:, channel] / white[0, channel])
    return gains


def pure_lights(illuminations: Sequence[Illuminant]) -> tuple[int, int, int] | None:
    """Return the indices of the brightest red, green and blue alone; None if one is missing."""
    indices: list[int] = []
    for channel in range(3):
        candidates: list[tuple[int, int]] = []
        for light in illuminations:
            code = light.colour[channel]
            if code > 0 and sum(light.colour) == code:
                candidates.append((code, -light.index))
        if not candidates:
            return None
        indices.append(-max(candidates)[1])
    return indices[0], indices[1], indices[2]


@dataclass(frozen=True, eq=False)
class Primaries:
    """The three primaries of a session, each from its own frame."""

    lights: tuple[int, int, int]  # indices of red, green and blue alone
    # flat field of each primary, from its brightest channel; used for all channels
    fields: tuple[FlatField, FlatField, FlatField]
    paper: _Array  # (3, 3) counts above black level of paper by primary and channel, without field
    at_cells: _Array  # (3, C) fields at the patches
    cells: _Array  # (3, C, 3) mean counts of each patch by primary, as in the LUT samples

    @staticmethod
    def of(
        lights: Sequence[int], papers: Sequence[Paper], cells: Sequence[_Array], cells_mm: _Array
    ) -> Primaries | None:
        """Return the primaries; None if paper has less than `LEAST_PAPER` counts under one.

        `cells`: (C, 3) float64, mean counts of each patch in each frame, without field. `cells_mm`: (C, 2) float64,
        centres of the patches.
        """
        white = np.array([paper.white for paper in papers])
        if white.max(axis=1).min() < LEAST_PAPER:
            return None
        brightest_channels = white.argmax(axis=1).tolist()
        red, green, blue = (
            replace(paper.field, coefficients=(paper.field.coefficients[channel],) * 3)
            for paper, channel in zip(papers, brightest_channels, strict=True)
        )
        at_cells = np.array([shape.at(cells_mm)[:, 0] for shape in (red, green, blue)])
        r, g, b = lights
        return Primaries((r, g, b), (red, green, blue), np.maximum(white, 0), at_cells, np.maximum(np.array(cells), 0))

    def amounts(self, white: _Array) -> _Array:
        """Return the amounts (3,) float64 ≥ 0 of the primaries in an illuminant from its paper (3,), counts.

        By non-negative least squares; 1 is the primary in its own frame.
        """
        return np.asarray(nnls(self.paper.T, np.maximum(white, 0))[0])

    def field_ratio(self, white: _Array) -> _Array:
        """Return the field of each patch relative to paper at its position, (C, 3) float64, near 1.

        `white`: (3,) counts of paper under the illuminant, without field.
        """
        amounts = self.amounts(white)
        shares = amounts[:, None] * self.paper
        total = shares.sum(axis=0)
        paper_field = np.where(total > 1, product(self.at_cells.T, shares) / np.maximum(total, 1), 1.0)
        total_light, field_light = np.zeros(self.cells.shape[1:]), np.zeros(self.cells.shape[1:])
        for amount, at_cells, cells in zip(amounts, self.at_cells, self.cells, strict=True):
            if amount > 0:
                contribution = amount * cells
                total_light += contribution
                field_light += at_cells[:, None] * contribution
        ratio = np.where((total_light > 1) & (total > 1), field_light / np.maximum(total_light, 1) / paper_field, 1.0)
        return np.where(np.abs(ratio - 1) < _MAX_FIELD_DIFFERENCE, ratio, 1.0)

    @property
    def difference(self) -> float:
        """Largest relative difference of two primaries' fields at a patch."""
        return float((self.at_cells.max(axis=0) / self.at_cells.min(axis=0)).max() - 1)

    def correction(self, white: _Array) -> dict[str, Any]:
        """Return the correction for `lut.json`; `white` is (L, 3) counts, paper under each illuminant."""
        return {
            "name": "primaries",
            "how": "samples divided by R in addition to the field: R = [sum w F a / sum w a] / [sum w F p / sum w p], "
            "sums over the primaries; F field of the primary at the patch, factors as under field; w amount of the "
            "primary in the illuminant; p paper under the primary, by channel; a mean of the patch's samples under the "
            "primary; R = 1 if a divisor is below 1 count or R differs from 1 by more than 0.2; multiply to undo, "
            "except rounding",
            "lights": list(self.lights),
            "field": [field.parameters()[0] for field in self.fields],
            "paper": np.round(self.paper, 4).tolist(),
            "per_light": np.round([self.amounts(light) for light in white], 7).tolist(),
        }
