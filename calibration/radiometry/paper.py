"""Counts become light: black, saturation, the field's shape, and the ground truth read from bare paper.

Laws that hold inside:

- Black is each frame's own, one value for each position of the 2×2 block. Raw counts are never scaled in time: the
  lamp's drift is recorded, and the ground truth of a light comes from the very frame of its samples.
- The field (how evenly projector and lens light the print) is a smooth shape for each frame and channel, fitted to the
  white references and divided out of samples and ground truth alike. Its mean over the centres of the chart's cells is
  1, so that dividing it out leaves the table's mean level as it was. Its parameters are kept, so it can be undone.
- A frame too dark to tell its own shape is given the shape of a brighter one: the order of its own polynomial sinks to
  0 by itself (Bayesian information criterion; G. Schwarz, Annals of Statistics 1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.radiometry.fitting import product
from drivers.raw.rawfile import Mosaic
from foundation.errors import QualityError

CLIPPED = 0.98
"""Share of saturation from which a count is taken for clipped."""

MAX_BLACK_DRIFT = 1.0
"""Counts that the black level may drift over a session before it is said aloud."""

ORDERS = (0, 1, 2, 3, 4, 5, 6)
AROUND = 3
MIN_REFERENCES = 6
_PLATEAU = 64
_ROUNDS = 4
_LEAST_FIELD = 0.05

_Array = npt.NDArray[np.float64]


def saturation(mosaic: Mosaic) -> int:
    """Return the count at which the sensor saturates, as far as this frame tells.

    What the metadata state, or what the frame shows if that is lower: a plateau of at least 64 photosites at the
    frame's highest count. LibRaw's tables state 15 831 for an EOS 550D that saturates at 13 584 (ISO 100), so a
    session without one clipped photosite keeps the stated value and its clipping limit lies too high; it does no harm
    there, as nothing came near.
    """
    counts = mosaic.counts
    top = int(counts.max())
    if top < mosaic.white_level and int(np.count_nonzero(counts == top)) >= _PLATEAU:
        return top
    return mosaic.white_level


def terms(order: int) -> list[tuple[int, int]]:
    """Return the degrees (i, j) of a polynomial of total order `order`, lower totals first."""
    return [(total - j, j) for total in range(order + 1) for j in range(total + 1)]


def polynomial(points_mm: npt.ArrayLike, page_mm: tuple[float, float], order: int) -> _Array:
    """Return the basis (N, terms) at points: products P_i(x) P_j(y) of Legendre polynomials, x, y −1 … 1 on the page.

    Parameters
    ----------
    points_mm
        (N, 2) on the print.
    page_mm
        Width and height of the page.
    order
        Total order, i + j ≤ order.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 2)
    # Terms stand in rising order, so a lower order's basis is the beginning of a higher one's.
    return _basis(points.tobytes(), page_mm, max(order, ORDERS[-1]))[:, : len(terms(order))]


@lru_cache(maxsize=8)
def _basis(points: bytes, page_mm: tuple[float, float], order: int) -> _Array:
    """Return the basis at points (N, 2) float64, read-only; the same cells and references are asked for every frame."""
    unit = 2 * np.frombuffer(points).reshape(-1, 2) / np.asarray(page_mm, dtype=np.float64) - 1
    x, y = (np.polynomial.legendre.legvander(unit[:, axis], order) for axis in (0, 1))
    basis = np.stack([x[:, i] * y[:, j] for i, j in terms(order)], axis=1)
    basis.setflags(write=False)
    return basis


@dataclass(frozen=True, eq=False)
class Field:
    """The shape of the light over the print, mean 1 over the cells' centres.

    Attributes
    ----------
    page_mm
        Width and height of the page.
    coefficients
        For each channel, the factors whose product the shape is: each (terms,) float64, of some total order.
    """

    page_mm: tuple[float, float]
    coefficients: tuple[tuple[_Array, ...], tuple[_Array, ...], tuple[_Array, ...]]

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the field (N, 3) at points (N, 2) mm, > 0."""
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        shape = np.ones((len(points), 3))
        for channel, factors in enumerate(self.coefficients):
            for factor in factors:
                shape[:, channel] *= product(polynomial(points, self.page_mm, order_of(len(factor))), factor)
        return np.maximum(shape, _LEAST_FIELD)

    def orders(self) -> tuple[int, ...]:
        """Return the total order of each channel's last factor: what the frame itself could tell."""
        return tuple(order_of(len(factors[-1])) if factors else 0 for factors in self.coefficients)

    def parameters(self) -> list[list[list[float]]]:
        """Return the coefficients for `lut.json`: [channel][factor][term], seven significant digits."""
        return [
            [[float(f"{value:.7g}") for value in factor.tolist()] for factor in factors]
            for factors in self.coefficients
        ]


def order_of(count: int) -> int:
    """Return the total order of a polynomial of `count` terms."""
    return round((np.sqrt(8 * count + 1) - 3) / 2)


def even_field(page_mm: tuple[float, float]) -> Field:
    """Return the field that is 1 everywhere."""
    return Field(page_mm, ((), (), ()))


@dataclass(frozen=True, eq=False)
class Paper:
    """What the white references of a frame say.

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

    field: Field
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
        The shape of a brighter frame, to which other frames add what they can tell; none for the brightest itself.
    order
        The highest order that a frame may tell by itself. References that lie around the cells and not among them
        tell no more than `AROUND`: from order 4 on there are shapes that vanish in all the margin.
    """

    def __init__(
        self,
        places_mm: _Array,
        centres_mm: _Array,
        page_mm: tuple[float, float],
        base: Field | None = None,
        order: int = ORDERS[-1],
    ) -> None:
        self.base = even_field(page_mm) if base is None else base
        self._page_mm, self._order = page_mm, order
        self._at_places, self._base_at_places = polynomial(places_mm, page_mm, ORDERS[-1]), self.base.at(places_mm)
        self._base_at_centres = self.base.at(centres_mm)
        # Term by term, so that the compiled loop runs along the cells.
        self._at_centres = np.ascontiguousarray(polynomial(centres_mm, page_mm, ORDERS[-1]).T)

    def read(self, seen: _Array, what: str = "the frame") -> tuple[Paper, _Array]:
        """Return what a frame's paper says, and the frame's field (C, 3) at the cells' centres.

        Parameters
        ----------
        seen
            (N, 3) the references' mean counts above black; NaN where one cannot be used.
        what
            The frame's name for messages.

        Raises
        ------
        QualityError
            Fewer than six references can be used.
        """
        from calibration.sampling import loops

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
        local = np.empty((3, self._at_centres.shape[1]))
        loops.combined(self._at_centres, solutions, local)
        factors: list[tuple[_Array, ...]] = []
        shape = self._base_at_centres.copy()
        white, error, spread = np.zeros(3), np.zeros(3), np.zeros(3)
        for channel, (solution, weights) in enumerate(fits):
            base = self.base.coefficients[channel]
            level = float((local[channel] * self._base_at_centres[:, channel]).mean())
            # Light too weak to have a shape of its own, or none at all.
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
        field = Field(self._page_mm, (factors[0], factors[1], factors[2]))
        return Paper(field, white, error, int(there.sum()), spread), np.maximum(shape, _LEAST_FIELD)


def _best_fit(basis: _Array, known: _Array, values: _Array, highest: int) -> tuple[_Array, _Array]:
    """Return solution (terms,) and weights (N,) of the order that says most with least (BIC), shape `known` given."""
    from calibration.sampling import loops

    best: tuple[float, _Array, _Array] | None = None
    for order in ORDERS[: highest + 1]:
        count = len(terms(order))
        if 3 * count > len(values):
            break
        solution, weights, residual = loops.robust_fit(basis[:, :count] * known[:, None], values, _ROUNDS)
        variance = float((weights * residual**2).sum() / weights.sum())
        criterion = len(values) * np.log(max(variance, 1e-12)) + count * np.log(len(values))
        if best is None or criterion < best[0]:
            best = (criterion, solution, weights)
    assert best is not None
    return best[1], best[2]


def black_drift(blacks: Sequence[_Array]) -> float:
    """Return how far the black level of any position of the block drifted over frames (each (2, 2)), counts."""
    if not blacks:
        return 0.0
    return float(np.ptp(np.stack(blacks), axis=0).max())


def corrections(
    page_mm: tuple[float, float],
    black: _Array,
    saturation_counts: int,
    fields: Sequence[Field],
    *,
    measured: bool = False,
    gains: _Array | None = None,
    subtracted: _Array | None = None,
    at_zero: _Array | None = None,
) -> list[dict[str, Any]]:
    """Return what was done to the counts, in order, for `lut.json`.

    Parameters
    ----------
    page_mm
        Width and height of the page.
    black
        (L, 2, 2) black level of each light's frame.
    saturation_counts
        Raw count of saturation.
    fields
        The field divided out of each light.
    measured
        Whether saturation was seen, rather than stated by the raw file.
    gains
        (L, 3) the lamp's drift at each light; None where no white frame tells.
    subtracted
        (L, 3) dark light of bare paper that was subtracted; None where none was to be.
    at_zero
        (L,) share of each light's samples that are 0; None where it was not counted.
    """
    done: list[dict[str, Any]] = [
        {
            "name": "black",
            "how": "subtracted: mean of the frame's masked border for each position of the 2x2 block, "
            "or the metadata's where no border is masked",
            "unit": "counts",
            "per_light": np.round(black, 3).tolist(),
        },
        {
            "name": "half size",
            "how": "R, mean of both G, B of each 2x2 block; nothing interpolated",
        },
        *([] if subtracted is None else [_dark_correction(subtracted)]),
        {
            "name": "saturation",
            "how": f"cells with a count of {CLIPPED:g} of it or more are unfit",
            "unit": "raw counts",
            "value": saturation_counts,
            "from": "measured: photosites of this session reached it"
            if measured
            else "the raw files' statement, which may be too high, as no photosite of a cell came near; "
            "no sample is affected, but white_level may be",
        },
        {
            "name": "field",
            "how": "samples and ground truth divided by F(x, y), the value at the cell's centre for its 25 samples; "
            "F is the product of its factors, each sum c[k] P_i(u) P_j(v) over total orders 0, 1, 2 ..., "
            "(i, j) = (n, 0), (n-1, 1) ... (0, n) within an order n, P Legendre, u = 2x/w - 1, v = 2y/h - 1, "
            "x, y millimetres on a page of w x h; mean of F over the cells' centres = 1; multiply to undo",
            "page_mm": list(page_mm),
            "per_light": [field.parameters() for field in fields],
        },
        {
            "name": "rounding",
            "how": "to the nearest integer, negative values to 0, which lifts the mean of cells as dark as their "
            "noise, by 0.4 standard deviations of a sample at most; the ground truth is neither rounded nor cut",
            **({} if at_zero is None else {"share_at_zero": np.round(at_zero, 6).tolist()}),
        },
    ]
    if gains is not None:
        done.append(
            {
                "name": "drift",
                "applied": False,
                "how": "the lamp's light over that of the first white frame, linear in time between white frames; "
                "not applied: divide samples and ground truth of a light by it to have all lights of one lamp",
                "per_light": np.round(gains, 6).tolist(),
            }
        )
    return done


def _dark_correction(subtracted: _Array) -> dict[str, Any]:
    return {
        "name": "dark",
        "how": "subtracted from samples, ground truth and references before the field is divided out: the light of the "
        "last dark frame before (projector's leak and the room's), which is at a patch that of bare paper times the "
        "dark frame's field times the patch's reflectance under white, corrected by what patches show beyond that in "
        "the dark frames so far, as far as it is more than noise; here that of bare paper, field divided out",
        "unit": "counts",
        "per_light": np.round(subtracted, 4).tolist(),
    }
