"""Whether a frame shows the same print as the frame that was registered: a hand, a lost focus, another poster.

White frames are compared cell by cell, but taken only every so often. A light's own frame may be spoilt between two of
them, and its part of the table with it, while the tags are where they were. So every frame is compared with the
registered one. The ratio of a cell's channel to the same under the first light is a smooth function of the printed
code, for any two lights and whatever the inks. It is estimated by a polynomial in the code, fitted on the frame itself.
What is left is noise, the polynomial's own error, which is spread over the sheet at random as the codes are, and what
is wrong with the frame:

- `scatter`, over all cells: blur mixes neighbours, and another order of cells fits nothing;
- `block`, the mean over neighbouring cells: a hand, a shadow or a reflection lies in one place.

Charts of 8 and 64 cells have no more cells than the polynomial has terms, or twice as many, and cannot be checked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.measures.least_squares import least_squares, product
from acquisition.measures.polynomials import code_polynomial, code_powers
from foundation.robust import huber_weights, sigma_of

DEGREE = 4
"""Of the polynomial in the code: 35 terms."""

LEAST_COUNTS = 60.0
"""Mean of 25 samples that a cell is expected to have for it to be compared: good to 3 %."""

CELLS = 8192
"""Cells that are compared, at most: a quarter of a full chart, for every frame is compared."""

FIT_CELLS = 1500
"""Cells that the polynomial is fitted on, about: forty for each of its terms."""

BLOCK_CELLS = 32
"""Compared cells of a block: four times as many cells of a full chart, a square of six centimetres on A0."""

LEAST_CELLS = 12
"""Compared cells that a block must have for its mean to count."""

CELLS_A_TERM = 2
"""With fewer cells for each term, what is wrong would be fitted, or what is right not."""

_ROUNDS = 3
"""Reweighted solutions in a row, after a first with equal weights."""

_CERTAIN = 4.0
"""Standard errors that are taken off a block's mean before it counts: among a full chart's 256 blocks noise alone
exceeds them in one of sixty frames."""

_MODEL_ERROR, _LEAST_ERROR = 0.02, 3.0
"""Standard error of a cell's prediction: a share of its level, and counts."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class FrameConsistency:
    """How a frame differs from the registered print under its light; zeros where nothing can be compared.

    Attributes
    ----------
    scatter
        Spread of the cells about what their codes give, as a share, the noise taken out; of the worst channel.
    block
        How far the worst block of cells is off, as a share, beyond four standard errors.
    at_mm
        The middle of that block on the print.
    """

    scatter: float = 0.0
    block: float = 0.0
    at_mm: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class _Channel:
    """One channel of the reference, prepared for comparisons.

    `terms` (N, K) and `level` (N,) of the compared cells, those `there` that are bright enough, `some` of them to fit
    on, and the fit's `design` (F, K).
    """

    terms: _Array
    level: _Array
    there: npt.NDArray[np.int64]
    some: npt.NDArray[np.int64]
    design: _Array

    @staticmethod
    def of(terms: _Array, level: _Array, usable: _Mask) -> _Channel:
        there = np.flatnonzero(usable & (level > LEAST_COUNTS))
        some = there[:: max(1, len(there) // FIT_CELLS)]
        return _Channel(terms, level, there, some, terms[some] * level[some, None])


def has_enough_cells(cells: int) -> bool:
    """Return whether a chart of so many cells can be checked by its codes at all."""
    return cells >= CELLS_A_TERM * len(code_powers(DEGREE))


class ConsistencyCheck:
    """Compares frames with one reference frame of the print, whatever their lights.

    Parameters
    ----------
    rgb
        (C, 3) printed codes.
    cells_mm
        (C, 2) places.
    level
        (C, 3) float64 mean counts above black in that frame, field divided out.
    usable
        (C,) bool, cells that are inside the frame and not covered.

    Attributes
    ----------
    cells
        Which cells are compared, every so many of them.
    """

    def __init__(self, rgb: npt.ArrayLike, cells_mm: _Array, level: _Array, usable: _Mask) -> None:
        self.cells = slice(None, None, max(1, len(cells_mm) // CELLS))
        terms = code_polynomial(np.asarray(rgb)[self.cells], DEGREE)
        self._usable = usable[self.cells]
        self._channels = [_Channel.of(terms, level[self.cells, channel], self._usable) for channel in range(3)]
        self._block, self._middles = _blocks(cells_mm[self.cells])

    def compare(self, mean: _Array, variance: _Array) -> FrameConsistency:
        """Return how far a frame is consistent with the reference.

        Parameters
        ----------
        mean
            (N, 3) float64 mean counts above black of `cells`, field divided out.
        variance
            (N, 3) float64, of these means.
        """
        worst = FrameConsistency()
        light = np.median(mean[self._usable], axis=0)
        for channel in np.flatnonzero(light >= 0.2 * light.max()):
            here = self._of_channel(self._channels[channel], mean[:, channel], variance[:, channel])
            at_mm = here.at_mm if here.block > worst.block else worst.at_mm
            worst = FrameConsistency(max(worst.scatter, here.scatter), max(worst.block, here.block), at_mm)
        return worst

    def _of_channel(self, known: _Channel, mean: _Array, variance: _Array) -> FrameConsistency:
        if len(known.there) < CELLS_A_TERM * known.terms.shape[1]:
            return FrameConsistency()
        design, level, seen = known.design, known.level[known.some], mean[known.some]
        # Weights are those of the expected levels, not of the levels seen: covered cells would count most.
        sigma = _MODEL_ERROR * float(np.median(seen / level)) * level + _LEAST_ERROR
        if not sigma.min() > 0:
            return FrameConsistency()
        weights = 1 / sigma**2
        solution = least_squares(design, seen, weights)
        for _ in range(_ROUNDS):
            residual = np.abs(seen - product(design, solution)) / sigma
            usual = max(sigma_of(residual), 1e-9)
            solution = least_squares(design, seen, weights * huber_weights(residual, usual) ** 2)
        expected, there = product(known.terms, solution) * known.level, known.there
        there = there[expected[there] > LEAST_COUNTS]
        if len(there) < LEAST_CELLS:
            return FrameConsistency()
        deviation = np.clip(mean[there] / expected[there] - 1, -1, 1)
        spread2 = sigma_of(deviation - np.median(deviation)) ** 2
        noise2 = float(np.median(variance[there] / expected[there] ** 2))
        block = self._block[there]
        count = np.bincount(block, minlength=len(self._middles))
        total = np.bincount(block, deviation, len(self._middles))
        full = np.flatnonzero(count >= LEAST_CELLS)
        scatter = float(np.sqrt(max(spread2 - noise2, 0)))
        if not len(full):
            return FrameConsistency(scatter)
        off = np.abs(total[full] / count[full]) - _CERTAIN * np.sqrt(spread2 / count[full])
        worst = full[int(np.argmax(off))]
        x, y = self._middles[worst].tolist()
        return FrameConsistency(scatter, max(float(off.max()), 0.0), (x, y))


def _blocks(cells_mm: _Array) -> tuple[npt.NDArray[np.int64], _Array]:
    """Return the block (C,) of each cell and the blocks' middles (B, 2): squares of about `BLOCK_CELLS`, or fewer."""
    low, size = cells_mm.min(axis=0), np.maximum(np.ptp(cells_mm, axis=0), 1e-9)
    cells = min(BLOCK_CELLS, max(LEAST_CELLS + 8, len(cells_mm) // 16))
    side = float(np.sqrt(size[0] * size[1] * cells / len(cells_mm)))
    columns, rows = (max(1, round(float(length) / side)) for length in size)
    across = np.array([columns, rows])
    at = np.minimum((cells_mm - low) / size * across, across - 1e-9).astype(np.int64)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    middles = np.column_stack([x.ravel(), y.ravel()])
    return at[:, 1] * columns + at[:, 0], low + (middles + 0.5) * size / across
