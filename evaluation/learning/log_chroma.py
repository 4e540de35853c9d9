"""Convolutional colour constancy in the log-chroma plane.

J. T. Barron, Y.-T. Tsai, "Fast Fourier color constancy", CVPR 2017. A change of light shifts the histogram of log
chromas u = log(g / r), v = log(g / b) (equation 2); so the light is found by convolving the histogram with a learned
filter and looking where the response is high (equations 5 and 6). The histogram lies on a torus, which makes the
convolution a product of Fourier transforms; two histograms are used, of the pixels and of their local absolute
deviations (section 4); a softmax turns the response plus a learned bias of each chroma into probabilities, and the mean
of the bivariate von Mises distribution that has their moments is the light (section 3.1).

*What is ours.* The bias is learned and the gain map of equation 5 is not, as in the authors' published program. The
torus is de-aliased by the lights themselves: of the chromas that fall on one bin, the one nearest to the middle of the
training lights' range is meant, where the paper has grey light or grey world (section 3.3). Training lights that spread
over more than three quarters of the paper's torus of two natural logarithms get bins of twice the width.

*Training* is as in sections 3 and 4 of the paper and in its supplement. The loss of the first iterations is convex, the
cross-entropy between the softmax and the bin of the true light; that of the others is the negative log-likelihood of
the true light under the fitted bivariate von Mises distribution, taken as a normal one on the unrolled torus (equations
9 to 13). The penalties, squares of the parameters and of their differences between neighbouring bins, are diagonal in
Fourier space, where L-BFGS runs on parameters scaled so that the penalty is half their squared length (preconditioning,
section 4.2).

The Fourier transforms of real arrays are symmetric; instead of the paper's packing of their independent parts, the
scaled parameters stay in the plane of bins and pass through Fourier space and back, a symmetric linear map. Gradients
are in single precision, which is what makes the processor's cache hold a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel
from evaluation.learning.working_size import reduce
from evaluation.scene import Image
from foundation.errors import InputError

BINS = 64  # Bins of the torus along each axis (section 5 of the paper)
_BATCH = 16  # Images at a time: their arrays then lie in a processor's second cache
_SHAPE = (BINS, BINS)
_ANGLE = 2 * np.pi / BINS  # Radians a bin
# Least squared length of a mean direction: that of a flat distribution is 0, and its angle nothing to divide by.
_TINY = 1e-12


@dataclass(frozen=True)
class Penalties:
    """Weights of what keeps a model simple.

    - `smoothness`: of squared differences between neighbouring bins: pixel filter, edge filter, bias.
    - `size`: of squares.
    - `spread`: variance that is added to the distribution's along each axis, bins².
    """

    smoothness: tuple[float, float, float]
    size: tuple[float, float, float]
    spread: float


@dataclass(frozen=True, eq=False)
class Moments:
    """Means and covariances of distributions (N, 64, 64) on the torus, in bins.

    - `mean`: (N, 2), the circular means, 0 … 64.
    - `covariance`: (N, 3): of u and u, v and v, u and v, about the means on the unrolled torus.
    - `slopes`: (N, 2, 64), derivative of each mean by the marginal probability of a bin.
    - `steps`: (N, 2, 64), distance of each bin from the nearest bin to the mean, −32 … 31.
    - `centre`: (N, 2), means of the steps.
    """

    mean: npt.NDArray[Any]
    covariance: npt.NDArray[Any]
    slopes: npt.NDArray[Any]
    steps: npt.NDArray[Any]
    centre: npt.NDArray[Any]


def moments(likely: npt.NDArray[np.floating]) -> Moments:
    """Return the moments of distributions (N, 64, 64) of any float dtype and of sum 1, in their dtype."""
    kind = likely.dtype
    bins = np.arange(BINS)
    sine, cosine = np.sin(_ANGLE * bins).astype(kind), np.cos(_ANGLE * bins).astype(kind)
    marginals = np.stack([likely.sum(axis=2), likely.sum(axis=1)], axis=1)
    y, x = marginals @ sine, marginals @ cosine
    mean = np.arctan2(y, x) / kind.type(_ANGLE) % BINS
    length = np.maximum(x * x + y * y, kind.type(_TINY)) * kind.type(_ANGLE)
    slopes = (x[..., None] * sine - y[..., None] * cosine) / length[..., None]
    half = BINS // 2
    steps = ((bins - np.rint(mean)[..., None] + half) % BINS - half).astype(kind)
    centre = (marginals * steps).sum(axis=2)
    variance = (marginals * steps**2).sum(axis=2) - centre**2
    mixed = (np.matmul(likely, steps[:, 1, :, None])[..., 0] * steps[:, 0]).sum(axis=1) - centre.prod(axis=1)
    return Moments(mean, np.concatenate([variance, mixed[:, None]], axis=1), slopes, steps, centre)


def likelihood(
    likely: npt.NDArray[np.floating], found: Moments, places: npt.NDArray[np.floating], spread: float
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the losses (N,) of true places (N, 2), and their derivatives by the responses, (N, 64, 64), float dtypes.

    The loss of an image is the negative log-likelihood less the least it can be, that of a hit with no spread but
    `spread`.

    `likely`: (N, 64, 64) of a float dtype, the distributions. `places`: (N, 2) of a float dtype, the true lights, bins.
    """
    away = found.mean - places
    away = away - BINS * np.rint(away / BINS)
    uu, vv, uv = found.covariance[:, 0] + spread, found.covariance[:, 1] + spread, found.covariance[:, 2]
    determinant = uu * vv - uv * uv
    inverse_u, inverse_v, inverse_uv = vv / determinant, uu / determinant, -uv / determinant
    pull_u = inverse_u * away[:, 0] + inverse_uv * away[:, 1]
    pull_v = inverse_uv * away[:, 0] + inverse_v * away[:, 1]
    loss = 0.5 * (pull_u * away[:, 0] + pull_v * away[:, 1] + np.log(determinant)) - np.log(spread)
    by_uu, by_vv, by_uv = inverse_u - pull_u**2, inverse_v - pull_v**2, inverse_uv - pull_u * pull_v
    step_u, step_v = found.steps[:, 0], found.steps[:, 1]
    centre_u, centre_v = found.centre[:, :1], found.centre[:, 1:]
    along_u = pull_u[:, None] * found.slopes[:, 0] + 0.5 * by_uu[:, None] * step_u * (step_u - 2 * centre_u)
    along_v = pull_v[:, None] * found.slopes[:, 1] + 0.5 * by_vv[:, None] * step_v * (step_v - 2 * centre_v)
    along_u = along_u - by_uv[:, None] * centre_v * step_u
    along_v = along_v - by_uv[:, None] * centre_u * step_v
    ones = np.ones_like(step_u)
    left = np.stack([along_u, ones, by_uv[:, None] * step_u], axis=2)
    right = np.stack([ones, along_v, step_v], axis=1)
    slope = np.matmul(left, right)
    mean = (likely * slope).sum(axis=(1, 2), keepdims=True)
    return loss, likely * (slope - mean)


def crossentropy(
    response: npt.NDArray[np.floating], likely: npt.NDArray[np.floating], places: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[Any]]:
    """Return the cross-entropies (N,) with the bins of true places, and their derivatives (N, 64, 64), a float dtype.

    `response`: (N, 64, 64) of a float dtype, logarithms of the distributions up to a constant. `likely`: (N, 64, 64) of
    a float dtype, the distributions. `places`: (N, 2) of a float dtype, the true lights, bins.
    """
    u, v = (np.rint(places).astype(np.int64) % BINS).T
    image = np.arange(len(places))
    totals = np.log(np.exp(response.astype(np.float64)).sum(axis=(1, 2)))
    slope = likely.copy()
    slope[image, u, v] -= 1
    return totals - response[image, u, v], slope


def train(
    histograms: npt.NDArray[np.float64],
    places: npt.NDArray[np.float64],
    repeats: npt.NDArray[np.float64],
    penalties: Penalties,
    stages: Sequence[tuple[int, float, float]],
) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.float64]]:
    """Return the fitted filters (2, 64, 33) complex128, in Fourier space, and the bias (64, 64) float64.

    `histograms`: (N, 2, 64, 64) float64, each of sum 1. `places`: (N, 2) float64, the true lights in bins; they may lie
    outside 0 … 64. `repeats`: (N,) float64, how many images each stands for.
    """
    import scipy.fft
    import scipy.optimize

    fft: Any = scipy.fft
    minimize: Any = scipy.optimize.minimize
    whiten = np.stack([_scale(*weights) for weights in zip(penalties.smoothness, penalties.size, strict=True)])
    spectra: Any = fft.rfft2(histograms.astype(np.float32))
    wanted = places.astype(np.float32)
    count, times = float(repeats.sum()), repeats.astype(np.float32)

    def spread_out(scaled: npt.NDArray[np.float64]) -> tuple[Any, Any]:
        spectrum: Any = whiten * fft.rfft2(scaled.reshape(3, *_SHAPE))
        return spectrum[:2], fft.irfft2(spectrum[2], s=_SHAPE)

    def loss(scaled: npt.NDArray[np.float64], entropy_weight: float, likelihood_weight: float) -> tuple[float, Any]:
        filters, bias = spread_out(scaled)
        single, level = filters.astype(np.complex64), bias.astype(np.float32)
        total = 0.5 * count * float(scaled @ scaled)
        gradient = np.zeros((3, BINS, BINS // 2 + 1), np.complex128)
        for start in range(0, len(spectra), _BATCH):
            batch, aim, each = (some[start : start + _BATCH] for some in (spectra, wanted, times))
            response: Any = fft.irfft2((batch * single).sum(axis=1), s=_SHAPE) + level
            response -= response.max(axis=(1, 2), keepdims=True)
            likely = np.exp(response)
            likely /= likely.sum(axis=(1, 2), keepdims=True)
            if entropy_weight:
                values, slopes = crossentropy(response, likely, aim)
                weight = entropy_weight
            else:
                values, slopes = likelihood(likely, moments(likely), aim, penalties.spread)
                weight = likelihood_weight
            total += weight * float(values.astype(np.float64) @ each)
            back: Any = fft.rfft2(slopes * each[:, None, None])
            gradient[:2] += weight * (batch.conj() * back[:, None]).sum(axis=0)
            gradient[2] += weight * back.sum(axis=0)
        scaled_gradient: Any = fft.irfft2(whiten * gradient, s=_SHAPE)
        return total, scaled_gradient.ravel() + count * scaled

    scaled = np.zeros(3 * BINS * BINS)
    for iterations, *weights in stages:
        options = {"maxiter": iterations, "maxcor": iterations, "maxfun": 4 + 2 * iterations, "ftol": 0, "gtol": 0}
        found: Any = minimize(loss, scaled, tuple(weights), "L-BFGS-B", jac=True, options=options)
        scaled = found.x
    filters, bias = spread_out(scaled)
    return filters, bias


def _scale(smoothness: float, size: float) -> npt.NDArray[np.float64]:
    """Return what each Fourier coefficient is multiplied by so that the penalty becomes the squared length, (64, 33).

    The authors' penalty is Σ |F|² (smoothness (|1 − e^iα|² + |1 − e^iβ|²) / 8 + size) over all coefficients F. The
    constant one is left out: the softmax does not see it.
    """
    differences = (2 - 2 * np.cos(_ANGLE * np.arange(BINS))) / 8
    weights = smoothness * (differences[:, None] + differences[None, : BINS // 2 + 1]) + size
    weights[0, 0] = np.inf
    return 1 / (BINS * np.sqrt(weights))


# Bins of the histogram that is extracted, along each axis: four natural logarithms. It is folded to 64 bins of 1/32,
# the paper's, or of 1/16 when the training lights are known.
_FINE_BINS = 128
_FINE_SIZE = 1 / 32  # Width of a bin, natural logarithm (section 5 of the paper)
_CHANNELS = 2  # Histograms: of pixels and of edges
_IMAGE = _CHANNELS * _FINE_BINS**2  # Bins of an image
_SPREAD = 0.75  # Share of the torus that the lights may span: the rest tells one turn of it from the next
_LARGEST = 255  # Working size up to which the counts of a histogram fit in 16 bits


@dataclass(frozen=True)
class LogChroma(FeatureLearner):
    """The method with its settings.

    The weights are those that the authors' program publishes for thumbnails of the Gehler-Shi data set, except
    `bias_smoothness` and the three sizes, which were chosen by cross-validation on thumbnails of a Canon 5DSR of
    INTEL-TAU (docs/reference/learned-methods.md).

    - `working_size`: largest side of the image whose colours are counted, px, up to 256.
    - `least`: value below which a channel is not trusted, 1 = the image's brightest usable value.
    - `crossentropy`: weight of the cross-entropy with which training begins.
    - `likelihood`: weight of the von Mises likelihood with which it ends.
    - `pixel_smoothness`, `edge_smoothness`, `bias_smoothness`: weight of the squared differences of neighbouring bins
      in the filter of each histogram and in the bias.
    - `pixel_size`, `edge_size`, `bias_size`: weight of their squares.
    - `spread`: variance that is added to the estimate's along each axis, bins².
    - `pretraining`, `training`: iterations of L-BFGS with each loss.
    """

    key: ClassVar[str] = "log-chroma"
    title: ClassVar[str] = "Log-chroma (FFCC family)"

    working_size: int = 64
    least: float = 2.0**-8
    crossentropy: float = 2.0**-8.25
    likelihood: float = 2.0**1.75
    pixel_smoothness: float = 2.0**-26.25
    edge_smoothness: float = 2.0**-23.5
    bias_smoothness: float = 2.0**-17
    pixel_size: float = 2.0**-33
    edge_size: float = 2.0**-33
    bias_size: float = 2.0**-25
    spread: float = 1.0
    pretraining: int = 16
    training: int = 64

    def __post_init__(self) -> None:
        if not 1 <= self.working_size <= _LARGEST:
            raise ValueError(f"a working size of {self.working_size} px; expected 1 to {_LARGEST}")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.uint16] | None:
        """Return the two histograms, (2, 128, 128) uint16 counts, u along the second axis and v along the third.

        See `FeatureLearner.features`: the image is (H, W, 3), the mask (H, W) bool.
        """
        small, used = reduce(image, saturation, mask, self.working_size)
        counts = _histogram(small[used], self.least)
        if not counts.any():
            return None
        return np.stack([counts, _histogram(_deviations(small, used)[used], self.least)])

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LogChromaModel:
        """Return the model fitted to histograms (N, 2, 128, 128) uint16 and lights (N, 3) float64.

        Nothing in the fit is random.
        """
        model = self._fitted(features, truths, np.ones(len(features)))
        return replace(model, lessons=Lessons.of(features, truths))

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> LogChromaModel:
        """Return the model fitted anew to its own M images, and to histograms (N, 2, 128, 128) uint16, lights (N, 3).

        Each of the N stands for M / worth of the others. A model whose file does not hold its images stays as it is.
        """
        if not isinstance(model, LogChromaModel):
            raise TypeError(f"{type(model).__name__} is no model of {self.key}")
        if model.lessons is None:
            return model
        known, lights = model.lessons.histograms(), model.lessons.lights
        repeats = np.concatenate([np.ones(len(known)), np.full(len(features), max(1.0, len(known) / worth))])
        return self._fitted(np.concatenate([known, features]), np.concatenate([lights, truths]), repeats)

    def _fitted(
        self, features: Features, truths: npt.NDArray[np.float64], repeats: npt.NDArray[np.float64]
    ) -> LogChromaModel:
        logs = np.log(truths)
        chromas = logs[:, 1:2] - logs[:, [0, 2]]
        span = float(np.ptp(chromas, axis=0).max())
        wide = span > _SPREAD * BINS * _FINE_SIZE
        if span > _SPREAD * _FINE_BINS * _FINE_SIZE:
            raise InputError(
                f"the lights to learn from span {span:.2f} natural logarithms of green over red or blue; log-chroma "
                f"tells {_SPREAD * _FINE_BINS * _FINE_SIZE:g}: leave out saturated lights, or take another method"
            )
        grid = (2 * _FINE_SIZE, _FINE_SIZE / 2) if wide else (_FINE_SIZE, 0.0)
        penalties = Penalties(
            smoothness=(self.pixel_smoothness, self.edge_smoothness, self.bias_smoothness),
            size=(self.pixel_size, self.edge_size, self.bias_size),
            spread=self.spread,
        )
        filters, bias = train(
            fold(features, wide),
            (chromas - grid[1]) / grid[0],
            repeats,
            penalties,
            ((self.pretraining, self.crossentropy, 0.0), (self.training, 0.0, self.likelihood)),
        )
        # Half-way between the outermost lights: their median lies so near one end where tungsten is rare that the torus
        # would be cut through the other.
        centre = (chromas.min(axis=0) + chromas.max(axis=0)) / 2
        return LogChromaModel(filters, bias, centre, np.array(grid))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LogChromaModel:
        """Return the model whose arrays are given: filters (2, 64, 33) complex128, bias (64, 64) float64 and others."""
        shapes = {"filters": (_CHANNELS, BINS, BINS // 2 + 1), "bias": (BINS, BINS), "centre": (2,), "grid": (2,)}
        found: dict[str, Any] = {name: arrays[name] for name in shapes}
        for name, shape in shapes.items():
            if found[name].shape != shape or not np.isfinite(found[name]).all():
                raise ValueError(f"{name} of the shape {found[name].shape}; expected {shape}, all finite")
        if tuple(found["grid"]) not in ((_FINE_SIZE, 0.0), (2 * _FINE_SIZE, _FINE_SIZE / 2)):
            raise ValueError(f"bins of {found['grid']}")
        return LogChromaModel(**found, lessons=Lessons.restored(arrays) if "learned_lights" in arrays else None)


@dataclass(frozen=True, eq=False)
class Lessons:
    """The images that a model learned of, as tuning needs them: few of their bins are filled.

    - `places`: (K,) int64, the filled bins in ascending order, of histograms (M, 2, 128, 128) laid end to end.
    - `counts`: (K,) uint16.
    - `lights`: (M, 3) float64, r + g + b = 1.
    """

    places: npt.NDArray[np.int64]
    counts: npt.NDArray[np.uint16]
    lights: npt.NDArray[np.float64]

    @classmethod
    def of(cls, features: Features, lights: npt.NDArray[np.float64]) -> Lessons:
        """Return those of histograms (M, 2, 128, 128) uint16 and lights (M, 3) float64."""
        places = np.flatnonzero(features)
        return cls(places, features.ravel()[places], lights)

    @classmethod
    def restored(cls, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Lessons:
        """Return those that `arrays` holds: places and counts (K,) int64 and uint16, lights (M, 3) float64."""
        found: list[Any] = [arrays[name] for name in ("learned_places", "learned_counts", "learned_lights")]
        places, counts, lights = found
        if places.ndim != 1 or places.shape != counts.shape or lights.ndim != 2 or lights.shape[1] != 3:
            raise ValueError(f"images of the shapes {[one.shape for one in found]}")
        if places.dtype != np.int64 or counts.dtype != np.uint16 or not (np.isfinite(lights) & (lights > 0)).all():
            raise ValueError("images whose numbers are not counts and lights")
        if len(places) and (places[0] < 0 or (np.diff(places) <= 0).any() or places[-1] >= len(lights) * _IMAGE):
            raise ValueError("images with bins that they do not have")
        return cls(places, counts, lights)

    def histograms(self) -> npt.NDArray[np.uint16]:
        """Return the histograms (M, 2, 128, 128)."""
        full = np.zeros(len(self.lights) * _IMAGE, np.uint16)
        full[self.places] = self.counts
        return full.reshape(-1, _CHANNELS, _FINE_BINS, _FINE_BINS)


@dataclass(frozen=True, eq=False)
class LogChromaModel:
    """What was learned.

    - `filters`: (2, 64, 33) complex128, Fourier transforms of the two filters, as `numpy.fft.rfft2` has them.
    - `bias`: (64, 64) float64.
    - `centre`: (2,) float64, u and v about which the torus is cut: the middle of the training lights' range.
    - `grid`: (2,) float64, the width of a bin and the chroma of the first one's centre.
    - `lessons`: what it learned of; None where it was tuned, or is of a file that does not say.
    """

    filters: npt.NDArray[np.complex128]
    bias: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    grid: npt.NDArray[np.float64]
    lessons: Lessons | None = None

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name: filters (2, 64, 33) complex128, others float64, and its lessons if known."""
        own = {"filters": self.filters, "bias": self.bias, "centre": self.centre, "grid": self.grid}
        held = {} if self.lessons is None else {f"learned_{name}": array for name, array in vars(self.lessons).items()}
        return {**own, **held}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of histograms (N, 2, 128, 128) uint16."""
        return np.stack([self._light(one) for one in features])

    def _light(self, feature: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        size, first = self.grid
        (histograms,) = fold(feature[None], wide=bool(size > _FINE_SIZE))
        response = np.fft.irfft2((np.fft.rfft2(histograms) * self.filters).sum(axis=0), s=(BINS, BINS)) + self.bias
        likely = np.exp(response - response.max())
        place = moments((likely / likely.sum())[None]).mean[0]
        turns = np.rint((place * size + first - self.centre) / (BINS * size))
        u, v = place * size + first - turns * BINS * size
        light = np.exp([-u, 0, -v])
        return light / light.sum()


def fold(features: Features, wide: bool) -> npt.NDArray[np.float64]:
    """Return histograms (N, 2, 64, 64) float64 of sum 1, of counts (N, 2, 128, 128) uint16; an empty one stays empty.

    `features`: (N, 2, 128, 128) uint16, the counts on the fine torus.
    """
    shape = (len(features), _CHANNELS, BINS, 2, BINS, 2) if wide else (len(features), _CHANNELS, 2, BINS, 2, BINS)
    counts = features.reshape(shape).sum(axis=(3, 5) if wide else (2, 4), dtype=np.float64)
    return counts / np.maximum(counts.sum(axis=(2, 3), keepdims=True), 1)


def _histogram(pixels: npt.NDArray[np.float32], least: float) -> npt.NDArray[np.uint16]:
    """Return the counts (128, 128) of log chromas on the torus, of pixels (M, 3) whose channels all reach `least`."""
    logs = np.log(pixels[(pixels >= least).all(axis=1)].astype(np.float64))
    places = np.rint((logs[:, 1:2] - logs[:, [0, 2]]) / _FINE_SIZE).astype(np.int64) % _FINE_BINS
    counts = np.bincount(places @ np.array([_FINE_BINS, 1]), minlength=_FINE_BINS**2)
    return counts.reshape(_FINE_BINS, _FINE_BINS).astype(np.uint16)


def _deviations(image: npt.NDArray[np.float32], used: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return the mean absolute difference of each pixel to its usable neighbours among eight, (H, W, 3) float32."""
    height, width = used.shape
    values = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    free = np.pad(used, 1).astype(np.float32)
    total, count = np.zeros_like(image), np.zeros(used.shape, np.float32)
    for down, right in ((d, r) for d in range(3) for r in range(3) if (d, r) != (1, 1)):
        near = (slice(down, down + height), slice(right, right + width))
        total += free[near][..., None] * np.abs(values[near] - image)
        count += free[near]
    return (total / np.maximum(count, 1)[..., None]).astype(np.float32)
