"""The light on a print whose bare paper is only around its cells: read from the cells themselves.

References in a margin leave the middle of a sheet to extrapolation: an error of three per cent at the worst cell, and
no residual that shows it. The cells of the paper's arrangement lie as their codes do, in blocks that run forwards and
backwards by turns, so that a colour's rise can be separated from the light's: the logarithm of counts is a polynomial
in the codes and another over the page. References belong to both, as paper of its own colour.

The print is assumed to be even: a sheet printed darker on one side cannot be distinguished from one lit so.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import code_polynomial, code_powers, least_squares, page_polynomial
from experiment.measures.paper import FlatField
from foundation.robust import huber_weights, sigma_of

CODE_DEGREE = 8
"""Of the polynomial in the codes, where there are cells enough: describes inks to a fraction of a per cent."""

LIGHT_ORDER = 4
"""Of the polynomial over the page, where there are cells enough."""

_LEAST_CELLS_A_TERM = 5
"""Cells for each term of the polynomial in the codes; with fewer its degree is lowered."""

_LEAST_COUNTS = 10.0
"""Counts above black below which a cell's logarithm is mostly noise."""

_EVEN_COUNTS = 300.0
"""Counts from which on a cell weighs no more by being brighter: the polynomial's own error exceeds the noise."""

_PAPER_WORTH = 10.0
"""Cells that a white reference counts for: its colour needs no polynomial."""

_ROUNDS = 5
"""Reweighted solutions in a row; Huber's weights, squared, have settled by then."""

_Array = npt.NDArray[np.float64]


def field_of_cells(
    rgb: npt.ArrayLike,
    cells_mm: _Array,
    level: _Array,
    usable: npt.NDArray[np.bool_],
    paper_mm: _Array,
    paper: _Array,
    page_mm: tuple[float, float],
) -> FlatField:
    """Return the field of a frame from its cells.

    `rgb`: (C, 3) int printed codes, 0 … 255. `cells_mm`: (C, 2) float64 mm, the cells' centres. `level`: (C, 3) float64
    mean counts above black. `usable`: (C,) bool, cells that lie in the frame and are not covered. `paper_mm`, `paper`:
    (N, 2) mm, white references, and (N, 3) their mean counts above black; NaN where one cannot be used.
    """
    degree = CODE_DEGREE
    while degree > 1 and len(cells_mm) < _LEAST_CELLS_A_TERM * len(code_powers(degree)):
        degree -= 1
    # In few blocks of few cells a light of higher order cannot be separated from the inks' interaction.
    order = LIGHT_ORDER if degree == CODE_DEGREE else min(2, degree)
    codes = code_polynomial(rgb, degree)
    light, at_paper = page_polynomial(cells_mm, page_mm, order), page_polynomial(paper_mm, page_mm, order)
    # Light's constant is the colours' too; bare paper need not be what ink of code 255 is.
    design = np.block(
        [
            [codes, light[:, 1:], np.zeros((len(codes), 1))],
            [np.zeros((len(paper), codes.shape[1])), at_paper[:, 1:], np.ones((len(paper), 1))],
        ]
    )
    factors: list[tuple[_Array, ...]] = []
    for channel in range(3):
        seen = np.concatenate([level[:, channel], paper[:, channel]])
        there = np.concatenate([usable, np.ones(len(paper), dtype=np.bool_)]) & (np.nan_to_num(seen) > _LEAST_COUNTS)
        if there.sum() < 2 * design.shape[1]:
            factors.append(())
            continue
        value, rows = np.log(seen[there]), np.ascontiguousarray(design[there])
        trust = seen[there] / (seen[there] + _EVEN_COUNTS)
        trust *= np.where(np.arange(len(seen))[there] < len(codes), 1.0, _PAPER_WORTH)
        weights, solution = trust, np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            solution = least_squares(rows, value, weights)
            off = np.abs(value - rows @ solution)
            spread = max(sigma_of(off), 1e-6)
            weights = trust * huber_weights(off, spread) ** 2
        shape = np.exp(light[:, 1:] @ solution[codes.shape[1] : -1])
        smooth = least_squares(np.ascontiguousarray(light), shape, np.ones(len(shape)))
        factors.append((smooth / float((light @ smooth).mean()),))
    red, green, blue = factors
    return FlatField(page_mm, (red, green, blue))
