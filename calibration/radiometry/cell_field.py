"""The light on a print whose bare paper is only around its cells: read from the cells themselves.

References in a margin leave the middle of a sheet to guesswork: three per cent beside the truth at the worst cell, and
no residual to show for it. The cells of the paper's arrangement lie as their codes do, in blocks that run forwards and
backwards by turns, so a colour's rise and the light's can be told apart: the logarithm of counts is a polynomial in the
codes and another over the page. References belong to both, as paper of its own colour.

It takes the print to be even: a sheet printed darker on one side looks like one lit so.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calibration.radiometry.fitting import least_squares
from calibration.radiometry.paper import Field, polynomial
from calibration.registration.colour_model import code_polynomial, code_powers
from foundation.robust import huber_weights, sigma_of

CODE_DEGREE = 8
LIGHT_ORDER = 4
_LEAST_CELLS_A_TERM = 5
_LEAST_COUNTS = 10.0
_EVEN_COUNTS = 300.0
"""Counts from which on a cell says no more by being brighter: the polynomial's own error is larger than the noise."""

_PAPER_WORTH = 10.0
"""Cells that a white reference counts for."""

_ROUNDS = 5

_Array = npt.NDArray[np.float64]


def field_of_cells(
    rgb: npt.ArrayLike,
    cells_mm: _Array,
    level: _Array,
    usable: npt.NDArray[np.bool_],
    paper_mm: _Array,
    paper: _Array,
    page_mm: tuple[float, float],
) -> Field:
    """Return the field of a frame from its cells.

    Parameters
    ----------
    rgb
        (C, 3) printed codes.
    cells_mm
        (C, 2) places.
    level
        (C, 3) mean counts above black.
    usable
        (C,) bool, cells that are there.
    paper_mm, paper
        (N, 2) white references and (N, 3) their mean counts above black; NaN where one cannot be used.
    page_mm
        Width and height of the page.
    """
    degree = CODE_DEGREE
    while degree > 1 and len(cells_mm) < _LEAST_CELLS_A_TERM * len(code_powers(degree)):
        degree -= 1
    # Few cells in few blocks cannot tell more light apart from a colour that reacts to another ink.
    order = LIGHT_ORDER if degree == CODE_DEGREE else min(2, degree)
    codes = code_polynomial(rgb, degree)
    light, at_paper = polynomial(cells_mm, page_mm, order), polynomial(paper_mm, page_mm, order)
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
        known = seen[there] / (seen[there] + _EVEN_COUNTS)
        known *= np.where(np.arange(len(seen))[there] < len(codes), 1.0, _PAPER_WORTH)
        weights, solution = known, np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            solution = least_squares(rows, value, weights)
            off = np.abs(value - rows @ solution)
            spread = max(sigma_of(off), 1e-6)
            weights = known * huber_weights(off, spread) ** 2
        shape = np.exp(light[:, 1:] @ solution[codes.shape[1] : -1])
        smooth = least_squares(np.ascontiguousarray(light), shape, np.ones(len(shape)))
        factors.append((smooth / float((light @ smooth).mean()),))
    red, green, blue = factors
    return Field(page_mm, (red, green, blue))
