"""Measure the flat field and the ground truth of a frame on its white references.

The flat field is the spatial distribution of the light over the print, fitted to the white references in each channel.
The ground truth of an illuminant is the mean of the white references after division by the flat field. The mean of the
flat field over the patches is 1, so division by it does not change the mean level of the look-up table (LUT).

The number of terms is chosen by cross-validation over the references. The Bayesian information criterion was worse for
dark corners, because few references lie in them.
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

# Lower limit of the flat field relative to its mean, because samples are divided by it. No print is lit so unevenly,
# but an extrapolated polynomial may be lower.
LEAST_FIELD = 0.05


# Highest order of a flat field. A strong fall-off of the lens needs the sixth power of the distance from the centre,
# and the eighth power if the lens mount also shades the corners.
MAX_ORDER = 8

# Highest order if all references are in the margin around the patches. From order 4 on, some shapes are zero everywhere
# in the margin.
MAX_ORDER_AROUND = 3

# Smallest number of usable white references in a frame, chosen by judgement.
MIN_REFERENCES = 6

REFERENCES_A_TERM = 3  # Smallest number of references for each term of a fit

# Smallest number of references for each term of the fit that detects covered or dirty references. With fewer, the fit
# would follow a large stain.
OUTLIER_REFERENCES_A_TERM = 12

_SECOND_ORDER_TERMS = 6  # Number of terms up to second order: constant, slope and curvature

# A further term is used if it decreases N log(E) by more than this price. E is the cross-validated mean squared error
# of N references. The price was chosen in simulations: with 0, terms fit noise; with 4, weak shapes are missed.
TERM_PRICE = 1.0

# Signal at which photon noise equals read noise, counts. The variance of a reference is proportional to its signal plus
# this value.
READ_COUNTS = 65.0

# Number of iterations of the robust fit.
_ROUNDS = 4

# Number of rings around the centre of the page, with equal numbers of references, in which a remaining fall-off is
# detected.
_RINGS = 10

_AVERAGED_REFERENCES = 4  # Number of neighbouring references over which the largest residual is averaged

_OUTLIER_SIGMAS = 5.0  # Largest usual residual of a reference, in standard deviations

# Numbers of terms with a lower likelihood are ignored in the error of the ground truth.
_UNLIKELY = 0.01

_ROUNDING_ERROR = 1e-9  # Smaller coefficients are rounding errors

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FlatField:
    """Spatial distribution of the light over the print, mean 1 over the patches."""

    page_mm: tuple[float, float]
    # For each channel, one or more polynomials, whose product is the flat field: coefficients (terms,) float64 of each.
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
    """Residuals of the references after division by the flat field, for the diagnosis of their cause."""

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
    spread: FloatArray  # (3,), RMS residual of all references including stained ones, relative to `white`
    left: FieldResidual = FieldResidual()  # what is left: details of the residuals


class PaperReader:
    """Measures flat field and ground truth of frames with the same references. Threads may share a reader.

    `places_mm`: (N, 2), centres of the white references on the print. `centres_mm`: (C, 2), centres of the patches,
    over which the mean of the flat field is 1. `base`: factor that all flat fields have in common. `order`: highest
    order of the flat field.
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
        # The terms are the first axis, so that the compiled loop runs along the patches.
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
            # A lens darkens its corners equally in all channels. Without a base, a common shape is therefore fitted
            # to the sum of the channels first. Then each channel gets an additional shape.
            if shared is not None:
                base = base * shared[0][:, None]
                shape *= shared[1][:, None]
                means = product(self._at_centres, shape) / len(shape)
                factors = [(shared[2],), (shared[2],), (shared[2],)]
        # After division by a base, the light has a simple shape. Slope and curvature are then enough to detect
        # outliers.
        limit = self._counts[-1] if not any(self.base.coefficients) else _SECOND_ORDER_TERMS
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
            # If a channel has too little light, its shape is constant.
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
            # Use all references, because a stain must be reported even if the fit ignores it.
            residuals[:, channel] = residual / max(abs(white[channel]), 1e-9)
            spread[channel] = float(np.sqrt((residuals[:, channel] ** 2).mean()))
        field = FlatField(self._page_mm, (factors[0], factors[1], factors[2]))
        residual = _field_residual(residuals, self._places_mm[is_usable], self._page_mm, int(np.argmax(white)))
        return Paper(field, white, error, int(is_usable.sum()), spread, residual), np.maximum(shape, LEAST_FIELD)

    def _shared_shape(self, basis: _Array, values: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return the common shape of all channels at references (N,) and patches (C,), and its coefficients."""
        # Photon noise grows with the light, so the unweighted sum of the channels has the smallest error.
        total, ones = values.sum(axis=1), np.ones(len(values))
        first = self._shape(basis, _best_fit(basis, ones, total, self._counts, self._counts[-1]).solution)
        if first is None:
            return None
        # Repeat the fit with weights from the light of the first fit.
        return self._shape(basis, _best_fit(basis, ones, total, self._counts, self._counts[-1], first[0]).solution)

    def _shape(self, basis: _Array, solution: _Array) -> tuple[_Array, _Array, _Array] | None:
        """Return the normalised shape at references and patches, and its coefficients; None if it cannot be used."""
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
        """Convert terms (K,) to coefficients in the order of `page_powers`, up to the lowest sufficient order."""
        factor = self._terms[:, : len(terms)] @ terms
        order = order_of(len(factor))
        while order > 0 and np.abs(self._terms[len(page_powers(order - 1)) :, : len(terms)]).max() < _ROUNDING_ERROR:
            order -= 1
        return factor[: len(page_powers(order))]


def falloff(light: _Array) -> _Array:
    """Return 1 − darkest / brightest of N positions in each channel, (3,) float64. `light`: (N, 3) float64."""
    return np.asarray(1 - light.min(axis=0) / light.max(axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of the light at N references with the best number of terms."""

    solution: _Array  # (terms,)
    weights: _Array  # (N,), 0 … 1
    design: _Array  # (N, T), all tried terms, divided by the noise of the references
    values: _Array  # (N,), counts divided by the noise of the references
    likelihoods: tuple[tuple[int, float], ...]  # tried numbers of terms with their likelihoods

    def level_error(self, term_means: _Array) -> float:
        """Return the standard error of the mean light, counts. `term_means`: (T,) float64, mean of each term."""
        weighted, terms = self.design * self.weights[:, None], len(self.solution)
        normal, right = weighted.T @ self.design, weighted.T @ self.values
        residual = self.values - self.design[:, :terms] @ self.solution
        variance = float(self.weights @ residual**2) / max(float(self.weights.sum()) - terms, 1.0)
        # One part of the variance comes from the scatter of the references, the other from the choice of terms.
        variance_sum, level = 0.0, float(term_means[:terms] @ self.solution)
        for count, likelihood in self.likelihoods:
            if count == terms or likelihood > _UNLIKELY:
                right_weights = np.linalg.lstsq(normal[:count, :count], term_means[:count], rcond=None)[0]
                if count == terms:
                    variance_sum += variance * float(right_weights @ term_means[:count])
                else:
                    variance_sum += likelihood * (float(right_weights @ right[:count]) - level) ** 2
        return float(np.sqrt(variance_sum))


def _best_fit(
    basis: _Array,
    base: _Array,
    values: _Array,
    counts: tuple[int, ...],
    outlier_terms: int,
    light: _Array | None = None,
) -> _Fit:
    """Fit with the number of terms in `counts` that has the smallest cross-validated error.

    `basis`: (N, T), the terms. `base`: (N,), factor of the flat field. `values`: (N,), counts above black. `light`:
    (N,), relative light, from which the noise is calculated; by default the base. Outliers are detected with at most
    `outlier_terms` terms.
    """
    light = base if light is None else light
    level = max(float(np.median(values / light)), 0.0)
    inverse_noise = 1 / np.sqrt(level * light + READ_COUNTS)
    inverse_noise /= inverse_noise.max()
    design, scaled_values = basis * (base * inverse_noise)[:, None], values * inverse_noise
    allowed_counts = tuple(count for count in counts if REFERENCES_A_TERM * count <= len(values)) or counts[:1]
    # A fit with few terms would treat dim corners as outliers. A fit with too many terms would follow a stain.
    outlier_limit = min(outlier_terms, len(values) // OUTLIER_REFERENCES_A_TERM)
    outlier_count = max((count for count in allowed_counts if count <= outlier_limit), default=allowed_counts[0])
    weights = robust_least_squares(design[:, :outlier_count], scaled_values, _ROUNDS)[1]
    held_out = held_out_squares(design[:, : allowed_counts[-1]], scaled_values, weights, allowed_counts)
    used_count = int((weights > 0).sum())
    prices = used_count * np.log(np.maximum(held_out, 1e-12)) + TERM_PRICE * np.array(allowed_counts)
    best_count = allowed_counts[int(np.argmin(prices))]
    likelihoods = np.exp(-0.5 * (prices - prices.min()))
    likelihoods /= likelihoods.sum()
    # Keep these weights, so that additional terms do not fit a hand in a corner.
    root = np.sqrt(weights)
    solution, factor, _ = robust_least_squares(design[:, :best_count] * root[:, None], scaled_values * root, _ROUNDS)
    likely = tuple(zip(allowed_counts, likelihoods.tolist(), strict=True))
    return _Fit(solution, weights * factor, design, scaled_values, likely)


def _field_residual(residuals: _Array, places_mm: _Array, page_mm: tuple[float, float], channel: int) -> FieldResidual:
    channel_residuals = residuals[:, channel]
    sigma = max(robust_sigma(channel_residuals), 1e-9)
    worst = int(np.argmax(np.abs(channel_residuals)))
    squared_distances = ((places_mm - places_mm[worst]) ** 2).sum(axis=1)
    nearest = np.argsort(squared_distances)[:_AVERAGED_REFERENCES]
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
        share=float((np.abs(channel_residuals) > _OUTLIER_SIGMAS * sigma).mean()),
        rim=float(rings[-1].mean()),
        radial=float(explained_squares / total_squares) if total_squares > 0 else 0.0,
    )
