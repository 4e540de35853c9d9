"""Color Beaver: restrict the estimates of another method to a learned region of illuminants.

K. Koščević, N. Banić, S. Lončarić, "Color Beaver: bounding illumination estimations for higher accuracy", VISAPP 2019.
The estimate of an underlying method (Gray-world in the table of the paper) is moved into a region of the chromaticity
plane. A genetic algorithm fits the region: it minimises the median angular error of the training images.

The paper was not accessible, so the following is our reconstruction. The plane has the axes r and b, for r + g + b = 1.
The region is a band along the locus of illuminants: a polyline of `corners` points with a half-width at each end.
Estimates outside the band move to its nearest point. A genome has the corners, the half-widths and the index of the
underlying method. The first genomes are near the main axis of the training illuminants. The best genomes survive
unchanged. Parents are selected by tournaments. Genes of children are blended (BLX-α, L. J. Eshelman, J. D. Schaffer
1993) and mutated by normally distributed steps, which decrease over the generations. The error is the recovery error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.learning.working_size import lights_from_chromaticities
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.prepared import GREY
from evaluation.scene import Image

_ELITE_SIZE = 4  # genomes that survive unchanged: few, so that most genomes of a generation are new
_TOURNAMENT_SIZE = 3  # genomes in a tournament; the best one becomes a parent
# A child's gene may be outside the interval of its parents' genes by this fraction of the interval (BLX-α).
_CROSSOVER_MARGIN = 0.3
_MUTATION_PROBABILITY = 0.15  # probability of a mutation per gene: one or two per genome
# Standard deviation of a mutation in the first and in the last generation, relative to the spread of the illuminants.
_STEPS = (0.5, 0.02)


@dataclass(frozen=True)
class ColorBeaver(FeatureLearner):
    """Settings of the method.

    - `norms`: Minkowski norms of the underlying methods, separated by spaces; training selects one. "1" is Gray-world.
    - `corners`: number of corners of the polyline, 2 or more.
    - `population`: number of genomes in a generation.
    - `generations`: number of generations.
    """

    key: ClassVar[str] = "color-beaver"

    norms: str = "1"
    corners: int = 3
    population: int = 80
    generations: int = 120

    @property
    def name(self) -> str:
        """Name in tables."""
        return "Color Beaver (using Gray-world)" if self.norms == "1" else f"Color Beaver (norms {self.norms})"

    def bases(self) -> tuple[GrayEdge, ...]:
        """Return the underlying methods, which use all pixels up to the edge of the image."""
        return tuple(GrayEdge(f"norm {norm}", 0, float(norm), 0, border=0) for norm in self.norms.split())

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64] | None:
        """Return r and b of the estimate of each underlying method, (B, 2) float64; see `FeatureLearner.features`."""
        estimates = [base.estimate(image, saturation, mask) for base in self.bases()]
        if any(estimate is GREY for estimate in estimates):
            return None
        lights = np.stack(estimates)
        return (lights / lights.sum(axis=1, keepdims=True))[:, [0, 2]]

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightBand:
        """Return the band fitted to estimates (N, B, 2) float64 and ground truths (N, 3) float64."""
        return _evolve(self, features.astype(np.float64), truths, np.random.default_rng(seed))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightBand:
        """Return the model with the arrays of `LightBand`; see `FeatureLearner.restore`."""
        loaded: dict[str, Any] = {name: arrays[name] for name in ("corners", "widths", "base")}
        shapes = [array.shape for array in loaded.values()]
        if shapes != [(self.corners, 2), (2,), ()] or not 0 <= int(loaded["base"]) < len(self.bases()):
            raise ValueError(
                f"arrays have the shapes {shapes} and base {loaded['base']}, expected shapes ({self.corners}, 2), (2,) "
                f"and (), and a base below {len(self.bases())}"
            )
        if not all(np.isfinite(array).all() for array in loaded.values()):
            raise ValueError("arrays have infinite or NaN values, expected finite ones")
        return LightBand(**loaded)


@dataclass(frozen=True, eq=False)
class LightBand:
    """Fitted band.

    - `corners`: (K, 2) float64, polyline in the plane of r and b.
    - `widths`: (2,) float64, half-width of the band at its first and last corner, linear in between.
    - `base`: () int64, index of the underlying method.
    """

    corners: npt.NDArray[np.float64]
    widths: npt.NDArray[np.float64]
    base: npt.NDArray[np.int64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name."""
        return {"corners": self.corners, "widths": self.widths, "base": self.base}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for features (N, B, 2) float64."""
        estimates = features[:, int(self.base)].astype(np.float64)
        (red_blue,) = clip_to_band(estimates, self.corners[None], self.widths[None])
        return lights_from_chromaticities(np.stack([red_blue[:, 0], 1 - red_blue.sum(axis=1)], axis=1))


def clip_to_band(
    points: npt.NDArray[np.float64], corners: npt.NDArray[np.float64], widths: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return points (N, 2) moved to the nearest points of each of P bands, (P, N, 2) float64.

    `corners`: (P, K, 2) float64, polyline of each band. `widths`: (P, 2) float64 ≥ 0, half-width at the first and the
    last corner.

    Examples
    --------
    >>> band, width = np.array([[[0.0, 0.0], [4.0, 0.0]]]), np.array([[1.0, 1.0]])
    >>> clip_to_band(np.array([[2.0, 5.0], [2.0, 0.5], [-9.0, 0.0]]), band, width)[0].tolist()
    [[2.0, 1.0], [2.0, 0.5], [-1.0, 0.0]]
    """
    start, segments = corners[:, None, :-1], np.diff(corners, axis=1)[:, None]
    length = np.maximum((segments**2).sum(axis=3), np.finfo(float).tiny)
    fraction = np.clip(((points[None, :, None] - start) * segments).sum(axis=3) / length, 0, 1)
    segment_feet = start + fraction[..., None] * segments
    distances = np.linalg.norm(points[None, :, None] - segment_feet, axis=3)
    nearest = distances.argmin(axis=2)[..., None]
    foot = np.take_along_axis(segment_feet, nearest[..., None], axis=2)[:, :, 0]
    distance = np.take_along_axis(distances, nearest, axis=2)
    position = (nearest + np.take_along_axis(fraction, nearest, axis=2)) / (corners.shape[1] - 1)
    width = widths[:, None, :1] * (1 - position) + widths[:, None, 1:] * position
    direction = (points - foot) / np.maximum(distance, np.finfo(float).tiny)
    return np.where(distance > width, foot + direction * width, points)


def _evolve(
    settings: ColorBeaver, estimates: npt.NDArray[np.float64], truths: npt.NDArray[np.float64], rng: np.random.Generator
) -> LightBand:
    red_blue = truths[:, [0, 2]]
    centre = np.median(red_blue, axis=0)
    _, spreads, axes = np.linalg.svd(red_blue - centre, full_matrices=False)
    scale = float(max(spreads[0] / np.sqrt(len(truths)), np.finfo(np.float32).eps))
    positions = (red_blue - centre) @ axes[0]
    count, corners, bases = settings.population, settings.corners, estimates.shape[1]
    shares = np.linspace(0.02, 0.98, corners)
    initial_corners = centre + np.quantile(positions, shares)[:, None] * axes[0]
    width = float(np.std((red_blue - centre) @ axes[-1]))
    genes = np.concatenate([initial_corners.ravel(), [width, width]])
    population = genes + rng.normal(0, _STEPS[0] * scale, (count, len(genes)))
    population[0] = genes
    base_indices = rng.integers(0, bases, count)

    def errors(genomes: npt.NDArray[np.float64], base: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        medians = np.empty(len(genomes))
        for base_index in range(bases):
            uses_base = base == base_index
            if uses_base.any():
                bounded_estimates = clip_to_band(estimates[:, base_index], *_decode(genomes[uses_base], corners))
                medians[uses_base] = np.median(_angles(bounded_estimates, truths), axis=1)
        return medians

    fitness = errors(population, base_indices)
    for generation in range(settings.generations):
        best = np.argsort(fitness, kind="stable")[:_ELITE_SIZE]
        parents = rng.integers(count, size=(2, count - _ELITE_SIZE, _TOURNAMENT_SIZE))
        first, second = np.take_along_axis(parents, fitness[parents].argmin(axis=2)[..., None], axis=2)[..., 0]
        mix = rng.uniform(-_CROSSOVER_MARGIN, 1 + _CROSSOVER_MARGIN, (count - _ELITE_SIZE, len(genes)))
        children = population[first] + mix * (population[second] - population[first])
        step = scale * _STEPS[0] * (_STEPS[1] / _STEPS[0]) ** (generation / max(1, settings.generations - 1))
        children += (rng.random(children.shape) < _MUTATION_PROBABILITY) * rng.normal(0, step, children.shape)
        is_mutated = rng.random(len(children)) < _MUTATION_PROBABILITY
        child_bases = np.where(is_mutated, rng.integers(0, bases, len(children)), base_indices[first])
        population = np.concatenate([population[best], children])
        base_indices = np.concatenate([base_indices[best], child_bases])
        fitness = np.concatenate([fitness[best], errors(children, child_bases)])
    winner = int(np.argmin(fitness))
    line, widths = _decode(population[winner : winner + 1], corners)
    return LightBand(line[0], widths[0], np.array(base_indices[winner], dtype=np.int64))


def _decode(genomes: npt.NDArray[np.float64], corners: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    # A genome is (2 K + 2,): K corners and two half-widths.
    return genomes[:, : 2 * corners].reshape(-1, corners, 2), np.maximum(genomes[:, 2 * corners :], 0)


def _angles(red_blue: npt.NDArray[np.float64], truths: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # Angles (P, N), degrees, between illuminants given by r and b, (P, N, 2), and ground truths (N, 3).
    red, blue = red_blue[..., 0], red_blue[..., 1]
    green = 1 - red - blue
    units = truths / np.linalg.norm(truths, axis=1, keepdims=True)
    cosine = (red * units[:, 0] + green * units[:, 1] + blue * units[:, 2]) / np.sqrt(red**2 + green**2 + blue**2)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
