"""Flat field and ground truth of a frame, measured on its white references.

The flat field is the spatial distribution of the light over the print, fitted to each channel of the white references.
The ground truth of an illuminant is their level after division by the flat field. The mean of the flat field over the
patches is 1, so that dividing by it keeps the mean level of the look-up table (LUT).

The number of terms is chosen by cross-validation over references. A criterion on residuals of the fit (BIC) was worse
for dark corners: few references show them, so their misfit counts less than the price of the terms.
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

# Lower limit of the flat field relative to its mean, for extrapolated polynomials: samples are divided by it, and no
# print is lit so unevenly.
LEAST_FIELD = 0.05


# Highest order of a flat field. On simulated frames, corners with 42 to 52 % of the light of the centre need the sixth
# power of the distance, and the eighth if the mount shades the rim.
MAX_ORDER = 8

# The same if references surround the patches and are not between them: from order 4 on, some shapes vanish in all the
# margin.
MAX_ORDER_AROUND = 3

# Fewest white references of a frame (judgement): with fewer, the error of their mean is meaningless.
MIN_REFERENCES = 6

REFERENCES_A_TERM = 3  # Fewest references for each term of a fit

# References for each term of the fit that detects covered or dirty references: with three, the terms would describe a
# stain over a tenth of the references.
JUDGING_A_TERM = 12

_PLAIN = 6  # Number of terms of slope and bend

# Price of a term, as decrease of N log(cross-validated mean squared error of N references), chosen by tests: 0 accepts
# a shape in a quarter of the frames without one, and adds noise of 0.2 % at 60 counts; 4 misses shapes of 0.3 % at 300
# counts.
TERM_PRICE = 1.0

# Signal with a photon noise equal to the read noise, counts: 6 counts at 1.8 electrons a count. It is added to the
# light of a reference to get its variance, so that dim corners get the right weight.
READ_COUNTS = 65.0

# Iterations of the robust fit; few references are covered or dirty, so the weights settle at once.
_ROUNDS = 4

# Rings with equal numbers of references around the centre of the page, for detecting a remaining fall-off.
_RINGS = 10

_NEAR = 4  # Number of references in the worst deviation, one and its neighbours: a tenth of a page side on A0

_USUAL = 5.0  # Outlier limit of references in standard deviations: by chance one in two million

_UNLIKELY = 0.01  # Numbers of terms with a lower likelihood are ignored in the error

_EXACT = 1e-9  # Smaller coefficients of terms are rounding errors

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlatField:
    """Spatial distribution of the light over the print, mean 1 over the patches."""

    page_mm: tuple[float, float]
    # For each channel, polynomials (terms,) float64; their product is the flat field.
    coefficients: tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]

    @classmethod
    def uniform(cls, page_mm: tuple[float, float]) -> FlatField:
        """Return the flat field that is 1 everywhere on a page."""
        return cls(page_mm, ((), (), ()))

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the flat field (N, 3) float64, > 0, at points (N, 2) mm."""
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
    """Residuals of the references after the flat field, for diagnosing their cause."""

    at_mm: tuple[float, float] = (0.0, 0.0)  # position of the largest residual on the print
    deviation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # relative residual there, R, G, B
    share: float = 0.0  # fraction of references beyond five standard deviations
    rim: float = 0.0  # mean relative residual of the tenth of the references farthest from the centre of the page
    radial: float = 0.0  # fraction of the variance that the distance from the centre explains, 0 … 1


@dataclass(frozen=True, eq=False)
class Paper:
    """Measurements on the white references of a frame."""

    field: FlatField
    white: FloatArray  # (3,), ground truth: level of bare paper divided by the flat field, counts above black
    error: FloatArray  # (3,), standard error of `white`, counts
    references: int  # number of white references used
    spread: FloatArray  # (3,), RMS residual of all references, also stained ones, relative to `white`
    left: FieldResidual = FieldResidual()  # residuals of the references


class PaperReader:
    """Measures flat field and ground truth of frames with the same references. Threads may share a reader.

    `places_mm`: (N, 2) white references on the print. `centres_mm`: (C, 2) patches, over which the mean of the flat
    field is 1. `base`: common factor of the flat fields of the frames. `order`: highest order of the flat field.
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
        # Terms first, so that the compiled loop runs along the patches.
        self._at_centres = np.ascontiguousarray((page_polynomial(centres_mm, page_mm, MAX_ORDER) @ self._terms).T)
        self._means = product(self._at_centres, self._base_at_centres) / len(centres_mm)

    def read(self, levels: _Array, frame_name: str = "the frame") -> tuple[Paper, _Array]:
        """Measure flat field and ground truth of a frame.

        Parameters
        ----------
        levels
            (N, 3) float64, mean counts above black of the references; NaN if not usable.
        frame_name
            Name of the frame in error messages.

        Returns
        -------
            The measurements, and the flat field (C, 3) float64 at the patches.
        """
        is_usable = np.isfinite(levels).all(axis=1)
        if is_usable.sum() < MIN_REFERENCES:
            raise QualityError(
                f"{frame_name}: {int(is_usable.sum())} white references are usable, expected at least "
                f"{MIN_REFERENCES}; uncover the chart, bring all of it into the frame, and expose so that paper is "
                "not saturated"
            )
        basis, values, base = self._at_places[is_usable], levels[is_usable], self._base_at_places[is_usable]
        shape, means = self._base_at_centres.copy(), self._means
        factors: list[tuple[_Array, ...]] = list(self.base.coefficients)
        if not any(factors):
            shared = self._shared_shape(basis, values)
            # A lens darkens its corners equally in all channels, so without a base the channels first get a common
            # shape, from their sum, and then each its own on top.
            if shared is not None:
                base = base * shared[0][:, None]
                shape *= shared[1][:, None]
                means = product(self._at_centres, shape) / len(shape)
                factors = [(shared[2],), (shared[2],), (shared[2],)]
        # On a base, the remaining light has a simple shape: slope and bend are enough for detecting outliers.
        limit = self._counts[-1] if not any(self.base.coefficients) else _PLAIN
        fits = [_best_fit(basis, base[:, channel], values[:, channel], self._counts, limit) for channel in range(3)]
        solutions = np.zeros((3, basis.shape[1]))
        for channel, fit in enumerate(fits):
            solutions[channel, : len(fit.solution)] = fit.solution
        local, shape_before = linear_combinations(self._at_centres, solutions), shape.copy()
        white, error, spread = np.zeros(3), np.zeros(3), np.zeros(3)
        residuals = np.zeros_like(values)
        for channel, fit in enumerate(fits):
            solution, weights = fit.solution, fit.weights
            level = float((local[channel] * shape_before[:, channel]).mean())
            # The light may be too weak for a shape of its own, or absent.
            terms = solution / level if level > 0 and local[channel].min() > LEAST_FIELD * level else np.ones(1)
            if len(terms) > 1:
                shape[:, channel] *= local[channel] / level
                factors[channel] = (*factors[channel], self._factor(terms))
            flat = values[:, channel] / (base[:, channel] * (basis[:, : len(terms)] @ terms))
            white[channel] = float((weights * flat).sum() / weights.sum())
            residual = flat - white[channel]
            if len(terms) == len(solution):
                error[channel] = fit.level_error(means[:, channel])
            else:
                error[channel] = np.sqrt(float((weights * residual**2).sum())) / float(weights.sum())
            # All references count here: a stain that the fit correctly ignores must still be reported.
            residuals[:, channel] = residual / max(abs(white[channel]), 1e-9)
            spread[channel] = float(np.sqrt((residuals[:, channel] ** 2).mean()))
        field = FlatField(self._page_mm, (factors[0], factors[1], factors[2]))
        residual = _field_residual(residuals, self._places_mm[is_usable], self._page_mm, int(np.argmax(white)))
        return Paper(field, white, error, int(is_usable.sum()), spread, residual), np.maximum(shape, LEAST_FIELD)

    def _shared_shape(self, basis: _Array, values: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return the common shape of all channels at references (N,) and patches (C,), and its coefficients."""
        # An unweighted sum, so that each channel counts by its light, as photon noise requires.
        total, ones = values.sum(axis=1), np.ones(len(values))
        first = self._shape(basis, _best_fit(basis, ones, total, self._counts, self._counts[-1]).solution)
        if first is None:
            return None
        # Repeat with the references weighted by the light of the first fit.
        return self._shape(basis, _best_fit(basis, ones, total, self._counts, self._counts[-1], first[0]).solution)

    def _shape(self, basis: _Array, solution: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return the normalised shape at references and patches, and its coefficients; None if it is uniform."""
        count = len(solution)
        level = float((solution @ self._at_centres[:count]).mean())
        if count == 1 or level <= 0:
            return None
        terms = solution / level
        at_centres = terms @ self._at_centres[:count]
        if at_centres.min() <= LEAST_FIELD:
            return None
        return np.maximum(basis[:, :count] @ terms, LEAST_FIELD), at_centres, self._factor(terms)

    def _factor(self, terms: _Array) -> _Array:
        """Return the coefficients in `page_powers` of terms (K,), of the lowest order that contains them."""
        factor = self._terms[:, : len(terms)] @ terms
        order = order_of(len(factor))
        while order > 0 and np.abs(self._terms[len(page_powers(order - 1)) :, : len(terms)]).max() < _EXACT:
            order -= 1
        return factor[: len(page_powers(order))]


def falloff(light: _Array) -> _Array:
    """Return the difference (3,) between the brightest and darkest of N positions, relative; `light` (N, 3)."""
    return np.asarray(1 - light.min(axis=0) / light.max(axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of the light at N references with the best number of terms."""

    solution: _Array  # (terms,)
    weights: _Array  # (N,), 0 … 1
    design: _Array  # (N, T), all tried terms, divided by the noise of the references
    values: _Array  # (N,), counts divided by the noise of the references
    likelihoods: tuple[tuple[int, float], ...]  # tried numbers of terms, and their likelihoods

    def level_error(self, term_means: _Array) -> float:
        """Return the standard error of the mean light, counts. `term_means`: (T,) float64, mean of each term."""
        weighted, terms = self.design * self.weights[:, None], len(self.solution)
        normal, right = weighted.T @ self.design, weighted.T @ self.values
        residual = self.values - self.design[:, :terms] @ self.solution
        variance = float(self.weights @ residual**2) / max(float(self.weights.sum()) - terms, 1.0)
        # Scatter of the references, plus the differences to the means by other likely numbers of terms.
        variance_sum, level = 0.0, float(term_means[:terms] @ self.solution)
        for count, likelihood in self.likelihoods:
            if count == terms or likelihood > _UNLIKELY:
                mean_per_right = np.linalg.lstsq(normal[:count, :count], term_means[:count], rcond=None)[0]
                if count == terms:
                    variance_sum += variance * float(mean_per_right @ term_means[:count])
                else:
                    variance_sum += likelihood * (float(mean_per_right @ right[:count]) - level) ** 2
        return float(np.sqrt(variance_sum))


def _best_fit(
    basis: _Array,
    base: _Array,
    values: _Array,
    counts: tuple[int, ...],
    outlier_terms: int,
    light: _Array | None = None,
) -> _Fit:
    """Return the fit with the best cross-validated number of terms in `counts`.

    `basis`: (N, T), the terms. `base`: (N,), shape of the base. `values`: (N,), counts above black. `light`: (N,),
    relative light that determines the noise; by default the base. At most `outlier_terms` terms are used to detect
    outliers.
    """
    light = base if light is None else light
    level = max(float(np.median(values / light)), 0.0)
    inverse_noise = 1 / np.sqrt(level * light + READ_COUNTS)
    inverse_noise /= inverse_noise.max()
    design, scaled_values = basis * (base * inverse_noise)[:, None], values * inverse_noise
    allowed_counts = tuple(count for count in counts if REFERENCES_A_TERM * count <= len(values)) or counts[:1]
    # A large fit keeps dim corners from being outliers. One larger than the references allow would follow a stain.
    outlier_limit = min(outlier_terms, len(values) // JUDGING_A_TERM)
    outlier_count = max((count for count in allowed_counts if count <= outlier_limit), default=allowed_counts[0])
    weights = robust_least_squares(design[:, :outlier_count], scaled_values, _ROUNDS)[1]
    held_out = held_out_squares(design[:, : allowed_counts[-1]], scaled_values, weights, allowed_counts)
    used_count = int((weights > 0).sum())
    prices = used_count * np.log(np.maximum(held_out, 1e-12)) + TERM_PRICE * np.array(allowed_counts)
    best_count = allowed_counts[int(np.argmin(prices))]
    likelihoods = np.exp(-0.5 * (prices - prices.min()))
    likelihoods /= likelihoods.sum()
    # Start with these weights, so that the additional terms do not accept a hand in a corner again.
    root = np.sqrt(weights)
    solution, factor, _ = robust_least_squares(design[:, :best_count] * root[:, None], scaled_values * root, _ROUNDS)
    likely = tuple(zip(allowed_counts, likelihoods.tolist(), strict=True))
    return _Fit(solution, weights * factor, design, scaled_values, likely)


def _field_residual(residuals: _Array, places_mm: _Array, page_mm: tuple[float, float], channel: int) -> FieldResidual:
    channel_residuals = residuals[:, channel]
    sigma = max(robust_sigma(channel_residuals), 1e-9)
    worst = int(np.argmax(np.abs(channel_residuals)))
    squared_distances = ((places_mm - places_mm[worst]) ** 2).sum(axis=1)
    nearest = np.argsort(squared_distances)[:_NEAR]
    # Average over the neighbours with the same sign.
    same_sign = nearest[np.sign(channel_residuals[nearest]) == np.sign(channel_residuals[worst])]
    red, green, blue = residuals[same_sign].mean(axis=0).tolist()
    x, y = places_mm[worst].tolist()
    from_centre = np.linalg.norm(places_mm - np.asarray(page_mm) / 2, axis=1)
    by_distance = np.argsort(from_centre)
    rings = [channel_residuals[ring] for ring in np.array_split(by_distance, min(_RINGS, len(channel_residuals)))]
    explained_squares = sum(len(ring) * (ring.mean() - channel_residuals.mean()) ** 2 for ring in rings)
    total_squares = float(((channel_residuals - channel_residuals.mean()) ** 2).sum())
    return FieldResidual(
        at_mm=(x, y),
        deviation=(red, green, blue),
        share=float((np.abs(channel_residuals) > _USUAL * sigma).mean()),
        rim=float(rings[-1].mean()),
        radial=float(explained_squares / total_squares) if total_squares > 0 else 0.0,
    )
