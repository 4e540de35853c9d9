"""What bare paper shows in a frame: the shape of the light over the print, and the ground truth.

- The flat field is fitted to the frame's white references, channel by channel. The ground truth of a light is what is
  left of them when it is divided out, and comes from the very frame of the light's samples.
- A frame too dark to show its own shape is given the shape of a brighter one: the order of its own polynomial sinks to
  0 by itself (Bayesian information criterion; G. Schwarz, Annals of Statistics 1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.measures.flat_field import LEAST_FIELD, FlatField
from acquisition.measures.least_squares import linear_combinations, robust_least_squares
from acquisition.measures.polynomials import page_polynomial, page_powers
from foundation.errors import QualityError

MAX_ORDER = 6
"""Highest order of a frame's flat field: a light whose corners have 42 to 52 % of the centre needs it; order 4 leaves
1.1 % there, on simulated frames."""

MAX_ORDER_AROUND = 3
"""The same where references lie around the cells and not among them: from order 4 on there are shapes that vanish in
all the margin."""

MIN_REFERENCES = 6
"""White references that a frame must show (judgement): with fewer, their mean has no error that means anything."""

_ROUNDS = 4
"""Solutions in a row of the robust fit; of references few are covered or dirty, and the weights settle at once."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Paper:
    """What the white references of a frame show.

    Attributes
    ----------
    field
        The frame's field.
    white
        (3,) float64, counts above black of bare paper after the field is divided out: the ground truth.
    error
        (3,) float64, standard error of `white`.
    references
        White references used.
    spread
        (3,) float64, RMS of all references about the field, stained ones included, relative to `white`.
    """

    field: FlatField
    white: _Array
    error: _Array
    references: int
    spread: _Array


class PaperReader:
    """Reads field and white of frames in which paper is seen at the same places; threads may share one.

    Parameters
    ----------
    places_mm
        (N, 2) white references on the print.
    centres_mm
        (C, 2) the chart's cells, over which the field's mean is 1.
    page_mm
        Width and height of the page.
    base
        The flat field of a brighter frame, on which others are fitted; none for the brightest itself.
    order
        The highest order that is fitted on a frame itself: `MAX_ORDER_AROUND` where references lie around the cells and
        not among them.
    """

    def __init__(
        self,
        places_mm: _Array,
        centres_mm: _Array,
        page_mm: tuple[float, float],
        base: FlatField | None = None,
        order: int = MAX_ORDER,
    ) -> None:
        self.base = FlatField.uniform(page_mm) if base is None else base
        self._page_mm, self._order = page_mm, order
        self._at_places, self._base_at_places = page_polynomial(places_mm, page_mm, MAX_ORDER), self.base.at(places_mm)
        self._base_at_centres = self.base.at(centres_mm)
        # Term by term, so that the compiled loop runs along the cells.
        self._at_centres = np.ascontiguousarray(page_polynomial(centres_mm, page_mm, MAX_ORDER).T)

    def read(self, seen: _Array, what: str = "the frame") -> tuple[Paper, _Array]:
        """Return what a frame's paper shows, and the frame's field (C, 3) float64 at the cells' centres.

        Parameters
        ----------
        seen
            (N, 3) float64, the references' mean counts above black; NaN where one cannot be used.
        what
            The frame's name for messages.

        Raises
        ------
        QualityError
            Fewer than six references can be used.
        """
        there = np.isfinite(seen).all(axis=1)
        if there.sum() < MIN_REFERENCES:
            raise QualityError(
                f"{what}: {int(there.sum())} white references can be used, at least {MIN_REFERENCES} expected; uncover "
                "the chart, bring all of it into the picture, and expose so that bare paper stays below saturation"
            )
        basis, values, known = self._at_places[there], seen[there], self._base_at_places[there]
        fits = [_best_fit(basis, known[:, channel], values[:, channel], self._order) for channel in range(3)]
        solutions = np.zeros((3, basis.shape[1]))
        for channel, (solution, _) in enumerate(fits):
            solutions[channel, : len(solution)] = solution
        local = linear_combinations(self._at_centres, solutions)
        factors: list[tuple[_Array, ...]] = []
        shape = self._base_at_centres.copy()
        white, error, spread = np.zeros(3), np.zeros(3), np.zeros(3)
        for channel, (solution, weights) in enumerate(fits):
            base = self.base.coefficients[channel]
            level = float((local[channel] * self._base_at_centres[:, channel]).mean())
            # Light too weak to show a shape of its own, or none at all.
            own = solution / level if level > 0 and local[channel].min() > 0.05 * level else np.ones(1)
            if len(own) > 1:
                shape[:, channel] *= local[channel] / level
            factors.append((*base, own) if len(own) > 1 else base)
            flat = values[:, channel] / (known[:, channel] * (basis[:, : len(own)] @ own))
            white[channel] = float((weights * flat).sum() / weights.sum())
            residual = flat - white[channel]
            scatter = float(np.sqrt((weights * residual**2).sum() / weights.sum()))
            error[channel] = scatter / np.sqrt(float(weights.sum()))
            # All references count here: a stain that the fit rightly ignores must still be seen.
            spread[channel] = float(np.sqrt((residual**2).mean())) / max(abs(white[channel]), 1e-9)
        field = FlatField(self._page_mm, (factors[0], factors[1], factors[2]))
        return Paper(field, white, error, int(there.sum()), spread), np.maximum(shape, LEAST_FIELD)


def _best_fit(basis: _Array, known: _Array, values: _Array, highest: int) -> tuple[_Array, _Array]:
    """Return solution (terms,) and weights (N,) of the order with the least BIC; `known` (N,) is the base's shape."""
    best: tuple[float, _Array, _Array] | None = None
    for order in range(highest + 1):
        count = len(page_powers(order))
        if 3 * count > len(values):
            break
        solution, weights, residual = robust_least_squares(basis[:, :count] * known[:, None], values, _ROUNDS)
        variance = float((weights * residual**2).sum() / weights.sum())
        criterion = len(values) * np.log(max(variance, 1e-12)) + count * np.log(len(values))
        if best is None or criterion < best[0]:
            best = (criterion, solution, weights)
    assert best is not None
    return best[1], best[2]
