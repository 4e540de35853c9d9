"""What bare paper shows in a frame: the flat field (the shape of the light over the print) and the ground truth.

- The flat field is fitted to the frame's white references, channel by channel. The ground truth of a light is what is
  left of them when it is divided out, and comes from the very frame of the light's samples. The field's mean over the
  centres of the chart's cells is 1, so that dividing it out leaves the table's mean level as it was.
- Which terms it has is decided by references held out: each as the fit to all others predicts it, so that a term stays
  that forecasts references which it has not seen, and none that describes their noise. A criterion on the fit's own
  residuals (BIC) did worse where it matters: a corner at half of the centre's light is shown by few references, and
  their misfit is outvoted by the price of the terms that it needs.
- What the terms may be is what lenses and projectors do (`experiment.measures.least_squares.light_terms`).
- A lens darkens its corners in all channels alike, so that in a frame without a base the channels first have one shape,
  from their sum, and then each its own on it. Other frames have that frame's shape as base, and one too dark to show a
  shape of its own keeps it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import (
    held_out_squares,
    light_terms,
    linear_combinations,
    order_of,
    page_polynomial,
    page_powers,
    product,
    robust_least_squares,
)
from foundation.errors import QualityError
from foundation.records import FloatArray
from foundation.robust import robust_sigma

# Where a polynomial that is extrapolated falls below this share of the mean light, the field is taken to be this:
# samples are divided by it, and no print is lit so unevenly.
LEAST_FIELD = 0.05


# Highest order of a frame's flat field: light whose corners have 42 to 52 % of the centre's needs the sixth power of
# the distance from its centre, and where the mount shades the rim the eighth, on simulated frames.
MAX_ORDER = 8

# The same where references lie around the cells and not among them: from order 4 on there are shapes that vanish in
# all the margin.
MAX_ORDER_AROUND = 3

# White references that a frame must show (judgement): with fewer, their mean has no error that means anything.
MIN_REFERENCES = 6

REFERENCES_A_TERM = 3  # With fewer references for each term, a fit forecasts none of them

# References for each term of the fit that tells which are covered or dirty: with three, the terms describe a stain of
# a tenth of the references.
JUDGING_A_TERM = 12

_PLAIN = 6  # Terms of a slope and a bend

# By how much a term must lower N log(mean squared error of the N references held out), chosen: 0 takes a shape for
# one in four frames that have none, and at 60 counts adds .2 % of noise to the field; 4 misses shapes of .3 % at 300.
TERM_PRICE = 1.0

# Signal whose photon noise is as large as the read noise, counts: 6 counts at 1.8 electrons a count. The variance of
# a reference is taken to be that of the light there and of this, so that dim corners count as they are known.
READ_COUNTS = 65.0

# Solutions in a row of the robust fit; of references few are covered or dirty, and the weights settle at once.
_ROUNDS = 4

# Rings of equally many references about the page's middle, by which a fall-off that is left over is recognised.
_RINGS = 10

_NEAR = 4  # References, one and its neighbours, whose mean deviation is the worst: a tenth of a page's side on A0

_USUAL = 5.0  # Usual deviations beyond which a reference is off: by chance one in two million

_UNLIKELY = 0.01  # Likelihood of a number of terms up to which it is not asked about

_EXACT = 1e-9  # Coefficients of terms below this are rounding errors of their computation

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlatField:
    """The shape of the light over the print, mean 1 over the cells' centres.

    - `page_mm`: width and height of the page.
    - `coefficients`: for each channel, the factors whose product the shape is: each (terms,) float64, of some total
      order.
    """

    page_mm: tuple[float, float]
    coefficients: tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]

    @classmethod
    def uniform(cls, page_mm: tuple[float, float]) -> FlatField:
        """Return the field that is 1 everywhere on a page of that width and height."""
        return cls(page_mm, ((), (), ()))

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the field (N, 3) float64 at points (N, 2) mm, > 0; 1 is its mean over the cells."""
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        shape = np.ones((len(points), 3))
        for channel, factors in enumerate(self.coefficients):
            for factor in factors:
                shape[:, channel] *= product(page_polynomial(points, self.page_mm, order_of(len(factor))), factor)
        return np.maximum(shape, LEAST_FIELD)

    def parameters(self) -> list[list[list[float]]]:
        """Return the coefficients for `lut.json`: [channel][factor][term], seven significant digits."""
        return [
            [[float(f"{value:.7g}") for value in factor.tolist()] for factor in factors]
            for factors in self.coefficients
        ]


@dataclass(frozen=True)
class FieldResidual:
    """What the field leaves of the references, so that the cause of a large residual can be told.

    - `at_mm`: where the references deviate most, on the print.
    - `deviation`: how far the references there are off in R, G and B, as shares with their signs.
    - `share`: share of the references that are off by more than five usual deviations.
    - `rim`: mean residual of the tenth of the references that lie farthest from the page's middle, as a share with its
      sign.
    - `radial`: share of the residuals' variance that their distance from the page's middle explains, 0 … 1.
    """

    at_mm: tuple[float, float] = (0.0, 0.0)
    deviation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    share: float = 0.0
    rim: float = 0.0
    radial: float = 0.0


@dataclass(frozen=True, eq=False)
class Paper:
    """What the white references of a frame show.

    - `field`: the frame's field.
    - `white`: (3,) float64, counts above black of bare paper after the field is divided out: the ground truth.
    - `error`: (3,) float64, standard error of `white`.
    - `references`: white references used.
    - `spread`: (3,) float64, RMS of all references about the field, stained ones included, relative to `white`.
    - `left`: what the field leaves of them, and where.
    """

    field: FlatField
    white: FloatArray
    error: FloatArray
    references: int
    spread: FloatArray
    left: FieldResidual = FieldResidual()


class PaperReader:
    """Reads field and white of frames in which paper is seen at the same places; threads may share one.

    `places_mm`: (N, 2) white references on the print. `centres_mm`: (C, 2) the chart's cells, over which the field's
    mean is 1.
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
        self._page_mm, self._places_mm = page_mm, places_mm
        self._terms, self._counts = light_terms(page_mm, order <= MAX_ORDER_AROUND)
        self._base_at_places, self._base_at_centres = self.base.at(places_mm), self.base.at(centres_mm)
        self._at_places = page_polynomial(places_mm, page_mm, MAX_ORDER) @ self._terms
        # Term by term, so that the compiled loop runs along the cells.
        self._at_centres = np.ascontiguousarray((page_polynomial(centres_mm, page_mm, MAX_ORDER) @ self._terms).T)
        self._means = product(self._at_centres, self._base_at_centres) / len(centres_mm)

    def read(self, seen: _Array, what: str = "the frame") -> tuple[Paper, _Array]:
        """Return what a frame's paper shows, and the frame's field (C, 3) float64 at the cells' centres.

        `seen`: (N, 3) float64, the references' mean counts above black; NaN where one cannot be used.
        """
        there = np.isfinite(seen).all(axis=1)
        if there.sum() < MIN_REFERENCES:
            raise QualityError(
                f"{what}: {int(there.sum())} white references can be used, at least {MIN_REFERENCES} expected; uncover "
                "the chart, bring all of it into the picture, and expose so that bare paper stays below saturation"
            )
        basis, values, known = self._at_places[there], seen[there], self._base_at_places[there]
        shape, means = self._base_at_centres.copy(), self._means
        factors: list[tuple[_Array, ...]] = list(self.base.coefficients)
        if not any(factors):
            shared = self._shared_shape(basis, values)
            if shared is not None:
                known = known * shared[0][:, None]
                shape *= shared[1][:, None]
                means = product(self._at_centres, shape) / len(shape)
                factors = [(shared[2],), (shared[2],), (shared[2],)]
        # On a base that is known, what is left of the light is plain: the frame's references are judged by a bend.
        judging = self._counts[-1] if not any(self.base.coefficients) else _PLAIN
        fits = [_best_fit(basis, known[:, channel], values[:, channel], self._counts, judging) for channel in range(3)]
        solutions = np.zeros((3, basis.shape[1]))
        for channel, fit in enumerate(fits):
            solutions[channel, : len(fit.solution)] = fit.solution
        local, before = linear_combinations(self._at_centres, solutions), shape.copy()
        white, error, spread = np.zeros(3), np.zeros(3), np.zeros(3)
        left = np.zeros_like(values)
        for channel, fit in enumerate(fits):
            solution, weights = fit.solution, fit.weights
            level = float((local[channel] * before[:, channel]).mean())
            # Light too weak to show a shape of its own, or none at all.
            own = solution / level if level > 0 and local[channel].min() > LEAST_FIELD * level else np.ones(1)
            if len(own) > 1:
                shape[:, channel] *= local[channel] / level
                factors[channel] = (*factors[channel], self._factor(own))
            flat = values[:, channel] / (known[:, channel] * (basis[:, : len(own)] @ own))
            white[channel] = float((weights * flat).sum() / weights.sum())
            residual = flat - white[channel]
            if len(own) == len(solution):
                error[channel] = fit.level_error(means[:, channel])
            else:
                error[channel] = np.sqrt(float((weights * residual**2).sum())) / float(weights.sum())
            # All references count here: a stain that the fit rightly ignores must still be seen.
            left[:, channel] = residual / max(abs(white[channel]), 1e-9)
            spread[channel] = float(np.sqrt((left[:, channel] ** 2).mean()))
        field = FlatField(self._page_mm, (factors[0], factors[1], factors[2]))
        residual = _residual(left, self._places_mm[there], self._page_mm, int(np.argmax(white)))
        return Paper(field, white, error, int(there.sum()), spread, residual), np.maximum(shape, LEAST_FIELD)

    def _shared_shape(self, basis: _Array, values: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return the shape of all channels' light at references (N,) and centres (C,), and its factor; None if even.

        The channels are added as they are, so that each counts by its light, as photon noise asks for.
        """
        total, even = values.sum(axis=1), np.ones(len(values))
        first = self._shape(basis, _best_fit(basis, even, total, self._counts, self._counts[-1]).solution)
        if first is None:
            return None
        # Once more, with the references weighted by the light that the first fit shows.
        return self._shape(basis, _best_fit(basis, even, total, self._counts, self._counts[-1], first[0]).solution)

    def _shape(self, basis: _Array, solution: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return a solution's shape at references and at centres, mean 1 there, and its factor; None if it is even."""
        count = len(solution)
        level = float((solution @ self._at_centres[:count]).mean())
        if count == 1 or level <= 0:
            return None
        own = solution / level
        at_centres = own @ self._at_centres[:count]
        if at_centres.min() <= LEAST_FIELD:
            return None
        return np.maximum(basis[:, :count] @ own, LEAST_FIELD), at_centres, self._factor(own)

    def _factor(self, own: _Array) -> _Array:
        """Return the coefficients, as `page_powers` has them, of terms (K,); of the lowest order that holds them."""
        factor = self._terms[:, : len(own)] @ own
        order = order_of(len(factor))
        while order > 0 and np.abs(self._terms[len(page_powers(order - 1)) :, : len(own)]).max() < _EXACT:
            order -= 1
        return factor[: len(page_powers(order))]


def falloff(light: _Array) -> _Array:
    """Return (3,) float64, the share of light that the darkest of N places lacks of the brightest; `light` (N, 3)."""
    return np.asarray(1 - light.min(axis=0) / light.max(axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The light at N references by the terms that forecast best.

    - `solution`: (terms,) float64. `weights`: (N,) float64, 0 … 1.
    - `design`, `values`: (N, T) and (N,) float64, references over their usual noise, by all terms that were tried.
    - `likely`: numbers of terms that were tried, and how likely each is.
    """

    solution: _Array
    weights: _Array
    design: _Array
    values: _Array
    likely: tuple[tuple[int, float], ...]

    def level_error(self, mean: _Array) -> float:
        """Return the standard error of the mean light, counts; `mean`: (T,) float64, that of each term.

        By the references' scatter, and by how much other numbers of terms, as likely as they are, would give another
        mean.
        """
        weighted, terms = self.design * self.weights[:, None], len(self.solution)
        normal, right = weighted.T @ self.design, weighted.T @ self.values
        left = self.values - self.design[:, :terms] @ self.solution
        variance = float(self.weights @ left**2) / max(float(self.weights.sum()) - terms, 1.0)
        square, level = 0.0, float(mean[:terms] @ self.solution)
        for count, likely in self.likely:
            if count == terms or likely > _UNLIKELY:
                by_right = np.linalg.lstsq(normal[:count, :count], mean[:count], rcond=None)[0]
                if count == terms:
                    square += variance * float(by_right @ mean[:count])
                else:
                    square += likely * (float(by_right @ right[:count]) - level) ** 2
        return float(np.sqrt(square))


def _best_fit(
    basis: _Array,
    known: _Array,
    values: _Array,
    counts: tuple[int, ...],
    judging: int,
    light: _Array | None = None,
) -> _Fit:
    """Return the fit that forecasts references best.

    `basis`: (N, T) float64, the terms. `known`: (N,) float64, the base's shape. `values`: (N,) float64 counts above
    black. `light`: (N,) float64, relative light by which the references' noise is known; the base's shape if not given.
    """
    light = known if light is None else light
    level = max(float(np.median(values / light)), 0.0)
    trust = 1 / np.sqrt(level * light + READ_COUNTS)
    trust /= trust.max()
    design, trusted = basis * (known * trust)[:, None], values * trust
    allowed = tuple(count for count in counts if REFERENCES_A_TERM * count <= len(values)) or counts[:1]
    # Judged by a large fit dim corners are no outliers; one larger than references allow would follow a stain.
    enough = [count for count in allowed if count <= judging and JUDGING_A_TERM * count <= len(values)]
    weights = robust_least_squares(design[:, : max(enough, default=allowed[0])], trusted, _ROUNDS)[1]
    held_out = held_out_squares(design[:, : allowed[-1]], trusted, weights, allowed)
    used = int((weights > 0).sum())
    price = used * np.log(np.maximum(held_out, 1e-12)) + TERM_PRICE * np.array(allowed)
    best = allowed[int(np.argmin(price))]
    likely = np.exp(-0.5 * (price - price.min()))
    likely /= likely.sum()
    # Begun with these weights, so that terms which a hand in a corner seems to ask for do not take it in again.
    root = np.sqrt(weights)
    solution, again, _ = robust_least_squares(design[:, :best] * root[:, None], trusted * root, _ROUNDS)
    return _Fit(solution, weights * again, design, trusted, tuple(zip(allowed, likely.tolist(), strict=True)))


def _residual(left: _Array, places_mm: _Array, page_mm: tuple[float, float], channel: int) -> FieldResidual:
    """Return where and how residuals (N, 3), shares, are large, judged in one channel."""
    here = left[:, channel]
    usual = max(robust_sigma(here), 1e-9)
    worst = int(np.argmax(np.abs(here)))
    away = ((places_mm - places_mm[worst]) ** 2).sum(axis=1)
    near = np.argsort(away)[:_NEAR]
    # The worst reference's neighbours tell how far it is off there, where it is not alone.
    alike = near[np.sign(here[near]) == np.sign(here[worst])]
    red, green, blue = left[alike].mean(axis=0).tolist()
    x, y = places_mm[worst].tolist()
    from_middle = np.linalg.norm(places_mm - np.asarray(page_mm) / 2, axis=1)
    order = np.argsort(from_middle)
    rings = [here[part] for part in np.array_split(order, min(_RINGS, len(here)))]
    explained = sum(len(ring) * (ring.mean() - here.mean()) ** 2 for ring in rings)
    total = float(((here - here.mean()) ** 2).sum())
    return FieldResidual(
        at_mm=(x, y),
        deviation=(red, green, blue),
        share=float((np.abs(here) > _USUAL * usual).mean()),
        rim=float(rings[-1].mean()),
        radial=float(explained / total) if total > 0 else 0.0,
    )
