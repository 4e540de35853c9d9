"""Color Beaver: the estimates of another method, kept within a learned region of lights.

K. Koščević, N. Banić, S. Lončarić, "Color Beaver: bounding illumination estimations for higher accuracy", VISAPP 2019.
The estimate of an underlying method, in the paper's table Gray-world, is moved into a region of the chromaticity
plane; the region is found by a genetic algorithm that minimises the median angular error on the training images.

*Reconstruction*, from the abstract and from what this house recollects of the paper: the plane is that of r and b of r
+ g + b = 1; the region is a polyline of `corners` points with a half-width at each end, that is a band along the locus
of lights; an estimate outside it moves to its nearest point. A genome holds the corners, the two half-widths, and
which of `bases` is used, so that the parameters of the underlying method are found with it. The first generation lies
about the training lights' own axis; parents are chosen by tournaments of three, genes are crossed one by one between
the parents (BLX-α, L. J. Eshelman, J. D. Schaffer 1993) and mutated by a normal step that shrinks over the
generations; the best few survive unchanged. The error is the recovery error.
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

_ELITE = 4  # Genomes that survive unchanged: few, so that a generation is not made of copies
_TOURNAMENT = 3  # Genomes of which the best becomes a parent
_BLEND = 0.3  # How far beyond its parents' genes a child's may lie, share of their distance (BLX-α)
_MUTATED = 0.15  # Probability that a gene of a child is mutated: one or two a genome
# Standard deviation of a mutation in the first and in the last generation, spreads of the training lights.
_STEP = (0.5, 0.02)


@dataclass(frozen=True)
class ColorBeaver(FeatureLearner):
    """The method with its settings.

    - `norms`: minkowski norms of the underlying method between spaces, of which the training chooses one: "1" is
      Gray-world.
    - `corners`: corners of the polyline, from 2.
    - `population`: genomes a generation.
    - `generations`: generations.
    """

    key: ClassVar[str] = "color-beaver"

    norms: str = "1"
    corners: int = 3
    population: int = 80
    generations: int = 120

    @property
    def name(self) -> str:
        """Its name in tables."""
        return "Color Beaver (using Gray-world)" if self.norms == "1" else f"Color Beaver (norms {self.norms})"

    def bases(self) -> tuple[GrayEdge, ...]:
        """Return the underlying methods, on every usable pixel up to the edge of the image."""
        return tuple(GrayEdge(f"norm {norm}", 0, float(norm), 0, border=0) for norm in self.norms.split())

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64] | None:
        """Return the chromaticities r and b of each base's estimate, (B, 2) float64; see `FeatureLearner.features`.

        The image is (H, W, 3), the mask (H, W) bool.
        """
        estimates = [base.estimate(image, saturation, mask) for base in self.bases()]
        if any(estimate is GREY for estimate in estimates):
            return None
        lights = np.stack(estimates)
        return (lights / lights.sum(axis=1, keepdims=True))[:, [0, 2]]

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightBand:
        """Return the band found for estimates (N, B, 2) float64 and lights (N, 3) float64."""
        return _evolve(self, features.astype(np.float64), truths, np.random.default_rng(seed))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightBand:
        """Return the model whose arrays are given: the corners (K, 2) float64 and so on as `LightBand` has them."""
        found: dict[str, Any] = {name: arrays[name] for name in ("corners", "widths", "base")}
        shapes = [array.shape for array in found.values()]
        if shapes != [(self.corners, 2), (2,), ()] or not 0 <= int(found["base"]) < len(self.bases()):
            raise ValueError(f"arrays of the shapes {shapes}")
        if not all(np.isfinite(array).all() for array in found.values()):
            raise ValueError("numbers that are not finite")
        return LightBand(**found)


@dataclass(frozen=True, eq=False)
class LightBand:
    """What was learned.

    - `corners`: (K, 2) float64, the polyline in the plane of r and b.
    - `widths`: (2,) float64, half-width of the band at its first and at its last corner, linear in between along the
      corners.
    - `base`: () int64, which of the underlying methods is used.
    """

    corners: npt.NDArray[np.float64]
    widths: npt.NDArray[np.float64]
    base: npt.NDArray[np.int64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays, (K, 2) float64, (2,) float64 and a scalar int64, by their names."""
        return {"corners": self.corners, "widths": self.widths, "base": self.base}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of estimates (N, B, 2) float64."""
        red_blue = bounded(features[:, int(self.base)].astype(np.float64), self.corners[None], self.widths[None])[0]
        return lights_from_chromaticities(np.stack([red_blue[:, 0], 1 - red_blue.sum(axis=1)], axis=1))


def bounded(
    points: npt.NDArray[np.float64], corners: npt.NDArray[np.float64], widths: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return points (N, 2) moved into each of P bands, (P, N, 2) float64: those inside stay.

    `points`: (N, 2) float64. `corners`: (P, K, 2) float64, the polyline of each band. `widths`: (P, 2) float64 ≥ 0, its
    half-width at the first and the last corner.

    Examples
    --------
    >>> band, width = np.array([[[0.0, 0.0], [4.0, 0.0]]]), np.array([[1.0, 1.0]])
    >>> bounded(np.array([[2.0, 5.0], [2.0, 0.5], [-9.0, 0.0]]), band, width)[0].tolist()
    [[2.0, 1.0], [2.0, 0.5], [-1.0, 0.0]]
    """
    start, along = corners[:, None, :-1], np.diff(corners, axis=1)[:, None]
    length = np.maximum((along**2).sum(axis=3), np.finfo(float).tiny)
    share = np.clip(((points[None, :, None] - start) * along).sum(axis=3) / length, 0, 1)
    feet = start + share[..., None] * along
    apart = np.linalg.norm(points[None, :, None] - feet, axis=3)
    nearest = apart.argmin(axis=2)[..., None]
    foot = np.take_along_axis(feet, nearest[..., None], axis=2)[:, :, 0]
    distance = np.take_along_axis(apart, nearest, axis=2)
    where = (nearest + np.take_along_axis(share, nearest, axis=2)) / (corners.shape[1] - 1)
    width = widths[:, None, :1] * (1 - where) + widths[:, None, 1:] * where
    away = (points - foot) / np.maximum(distance, np.finfo(float).tiny)
    return np.where(distance > width, foot + away * width, points)


def _evolve(
    settings: ColorBeaver, estimates: npt.NDArray[np.float64], truths: npt.NDArray[np.float64], rng: np.random.Generator
) -> LightBand:
    red_blue = truths[:, [0, 2]]
    centre = np.median(red_blue, axis=0)
    _, spreads, axes = np.linalg.svd(red_blue - centre, full_matrices=False)
    scale = float(max(spreads[0] / np.sqrt(len(truths)), np.finfo(np.float32).eps))
    places = (red_blue - centre) @ axes[0]
    count, corners, bases = settings.population, settings.corners, estimates.shape[1]
    shares = np.linspace(0.02, 0.98, corners)
    typical = centre + np.quantile(places, shares)[:, None] * axes[0]
    across = float(np.std((red_blue - centre) @ axes[-1]))
    genes = np.concatenate([typical.ravel(), [across, across]])
    population = genes + rng.normal(0, _STEP[0] * scale, (count, len(genes)))
    population[0] = genes
    used = rng.integers(0, bases, count)

    def errors(genomes: npt.NDArray[np.float64], base: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        found = np.empty(len(genomes))
        for which in range(bases):
            own = base == which
            if own.any():
                moved = bounded(estimates[:, which], *_decoded(genomes[own], corners))
                found[own] = np.median(_angles(moved, truths), axis=1)
        return found

    fitness = errors(population, used)
    for generation in range(settings.generations):
        best = np.argsort(fitness, kind="stable")[:_ELITE]
        parents = rng.integers(count, size=(2, count - _ELITE, _TOURNAMENT))
        first, second = np.take_along_axis(parents, fitness[parents].argmin(axis=2)[..., None], axis=2)[..., 0]
        mix = rng.uniform(-_BLEND, 1 + _BLEND, (count - _ELITE, len(genes)))
        children = population[first] + mix * (population[second] - population[first])
        step = scale * _STEP[0] * (_STEP[1] / _STEP[0]) ** (generation / max(1, settings.generations - 1))
        children += (rng.random(children.shape) < _MUTATED) * rng.normal(0, step, children.shape)
        which = np.where(rng.random(len(children)) < _MUTATED, rng.integers(0, bases, len(children)), used[first])
        population = np.concatenate([population[best], children])
        used = np.concatenate([used[best], which])
        fitness = np.concatenate([fitness[best], errors(children, which)])
    winner = int(np.argmin(fitness))
    line, widths = _decoded(population[winner : winner + 1], corners)
    return LightBand(line[0], widths[0], np.array(used[winner], dtype=np.int64))


def _decoded(genomes: npt.NDArray[np.float64], corners: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the polylines (P, K, 2) and half-widths (P, 2) ≥ 0 of genomes (P, 2 K + 2)."""
    return genomes[:, : 2 * corners].reshape(-1, corners, 2), np.maximum(genomes[:, 2 * corners :], 0)


def _angles(red_blue: npt.NDArray[np.float64], truths: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the angle of lights r and b, (P, N, 2), to the true lights (N, 3): (P, N) degrees."""
    red, blue = red_blue[..., 0], red_blue[..., 1]
    green = 1 - red - blue
    units = truths / np.linalg.norm(truths, axis=1, keepdims=True)
    cosine = (red * units[:, 0] + green * units[:, 1] + blue * units[:, 2]) / np.sqrt(red**2 + green**2 + blue**2)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
