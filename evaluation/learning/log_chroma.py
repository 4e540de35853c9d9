"""Convolutional colour constancy in the log-chroma plane.

J. T. Barron, Y.-T. Tsai, "Fast Fourier color constancy", CVPR 2017. A change of the illuminant shifts the histogram of
log chromas u = log(g / r), v = log(g / b) (equation 2). The histogram is convolved with a learned filter, and the
illuminant is at the largest response (equations 5 and 6). The histogram is on a torus, so the convolution is a product
of Fourier transforms. There are two histograms: of pixels, and of their local absolute deviations (section 4). A
softmax of the response plus a learned bias gives probabilities. The estimate is the mean of a bivariate von Mises
distribution with the same moments (section 3.1).

*Differences from the paper.* As in the authors' program, a bias is learned, but no gain map (equation 5). Each bin of
the torus stands for several chromas. Here, the chroma nearest to the middle of the training illuminants is the
estimate. In the paper, it is the chroma nearest to grey light or to the grey-world estimate (section 3.3).

*Training* follows sections 3 and 4 of the paper and its supplement. The first iterations minimise a convex loss, the
cross-entropy between the softmax and the bin of the ground truth. Later iterations minimise the negative log-likelihood
of the ground truth under the fitted von Mises distribution, approximated by a normal distribution on the unrolled torus
(equations 9 to 13). Penalties are squares of the parameters and of their differences between neighbouring bins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel
from evaluation.learning.working_size import reduce_image
from evaluation.scene import Image
from foundation.errors import InputError

BINS = 64  # bins of the torus along each axis (section 5 of the paper)
_BATCH_SIZE = 16  # images per batch; the arrays of a batch fit into the second-level cache
_SHAPE = (BINS, BINS)
_BIN_ANGLE = 2 * np.pi / BINS  # radians per bin
# Smallest squared length of a mean direction. A uniform distribution has the length 0, for which the angle is
# undefined.
_SMALLEST_LENGTH = 1e-12


@dataclass(frozen=True)
class Penalties:
    """Weights of the regularisation.

    - `smoothness`: weights of squared differences between neighbouring bins of pixel filter, edge filter and bias.
    - `size`: weights of the squares of the bins of these three, in the same order.
    - `spread`: variance added to the distribution along each axis, bins².
    """

    smoothness: tuple[float, float, float]
    size: tuple[float, float, float]
    spread: float


@dataclass(frozen=True, eq=False)
class Moments:
    """Means and covariances of distributions (N, 64, 64) on the torus, in bins.

    - `mean`: (N, 2), circular means, 0 … 64.
    - `covariance`: (N, 3), uu, vv and uv, about the means on the unrolled torus.
    - `slopes`: (N, 2, 64), derivative of each mean with respect to the marginal probability of a bin.
    - `steps`: (N, 2, 64), distance of each bin from the bin nearest to the mean, −32 … 31.
    - `centre`: (N, 2), means of the steps.
    """

    mean: npt.NDArray[Any]
    covariance: npt.NDArray[Any]
    slopes: npt.NDArray[Any]
    steps: npt.NDArray[Any]
    centre: npt.NDArray[Any]


def moments(probabilities: npt.NDArray[np.floating]) -> Moments:
    """Return the moments of distributions (N, 64, 64) with sum 1, in their float dtype."""
    dtype = probabilities.dtype
    bins = np.arange(BINS)
    sine, cosine = np.sin(_BIN_ANGLE * bins).astype(dtype), np.cos(_BIN_ANGLE * bins).astype(dtype)
    marginals = np.stack([probabilities.sum(axis=2), probabilities.sum(axis=1)], axis=1)
    y, x = marginals @ sine, marginals @ cosine
    mean = np.arctan2(y, x) / dtype.type(_BIN_ANGLE) % BINS
    length = np.maximum(x * x + y * y, dtype.type(_SMALLEST_LENGTH)) * dtype.type(_BIN_ANGLE)
    slopes = (x[..., None] * sine - y[..., None] * cosine) / length[..., None]
    half = BINS // 2
    steps = ((bins - np.rint(mean)[..., None] + half) % BINS - half).astype(dtype)
    centre = (marginals * steps).sum(axis=2)
    variance = (marginals * steps**2).sum(axis=2) - centre**2
    mixed = (np.matmul(probabilities, steps[:, 1, :, None])[..., 0] * steps[:, 0]).sum(axis=1) - centre.prod(axis=1)
    return Moments(mean, np.concatenate([variance, mixed[:, None]], axis=1), slopes, steps, centre)


def likelihood(
    probabilities: npt.NDArray[np.floating], fit: Moments, truth_bins: npt.NDArray[np.floating], spread: float
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the losses (N,) and their derivatives with respect to the responses (N, 64, 64).

    The loss of an image is its negative log-likelihood minus the smallest possible value. An exact estimate with the
    variance `spread` has this smallest value. `probabilities` are (N, 64, 64), `truth_bins` (N, 2) ground truths in
    bins.
    """
    offset = fit.mean - truth_bins
    offset = offset - BINS * np.rint(offset / BINS)
    uu, vv, uv = fit.covariance[:, 0] + spread, fit.covariance[:, 1] + spread, fit.covariance[:, 2]
    determinant = uu * vv - uv * uv
    inverse_u, inverse_v, inverse_uv = vv / determinant, uu / determinant, -uv / determinant
    pull_u = inverse_u * offset[:, 0] + inverse_uv * offset[:, 1]
    pull_v = inverse_uv * offset[:, 0] + inverse_v * offset[:, 1]
    loss = 0.5 * (pull_u * offset[:, 0] + pull_v * offset[:, 1] + np.log(determinant)) - np.log(spread)
    by_uu, by_vv, by_uv = inverse_u - pull_u**2, inverse_v - pull_v**2, inverse_uv - pull_u * pull_v
    step_u, step_v = fit.steps[:, 0], fit.steps[:, 1]
    centre_u, centre_v = fit.centre[:, :1], fit.centre[:, 1:]
    along_u = pull_u[:, None] * fit.slopes[:, 0] + 0.5 * by_uu[:, None] * step_u * (step_u - 2 * centre_u)
    along_v = pull_v[:, None] * fit.slopes[:, 1] + 0.5 * by_vv[:, None] * step_v * (step_v - 2 * centre_v)
    along_u = along_u - by_uv[:, None] * centre_v * step_u
    along_v = along_v - by_uv[:, None] * centre_u * step_v
    ones = np.ones_like(step_u)
    left_factors = np.stack([along_u, ones, by_uv[:, None] * step_u], axis=2)
    right_factors = np.stack([ones, along_v, step_v], axis=1)
    slope = np.matmul(left_factors, right_factors)
    mean = (probabilities * slope).sum(axis=(1, 2), keepdims=True)
    return loss, probabilities * (slope - mean)


def crossentropy(
    response: npt.NDArray[np.floating], probabilities: npt.NDArray[np.floating], truth_bins: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[Any]]:
    """Return the cross-entropies (N,) and their derivatives with respect to the responses (N, 64, 64).

    `response` is the logarithm of the `probabilities`, (N, 64, 64), plus a constant. `truth_bins`: (N, 2), in bins.
    """
    u, v = (np.rint(truth_bins).astype(np.int64) % BINS).T
    image = np.arange(len(truth_bins))
    log_sums = np.log(np.exp(response.astype(np.float64)).sum(axis=(1, 2)))
    slope = probabilities.copy()
    slope[image, u, v] -= 1
    return log_sums - response[image, u, v], slope


def train(
    histograms: npt.NDArray[np.float64],
    truth_bins: npt.NDArray[np.float64],
    repeats: npt.NDArray[np.float64],
    penalties: Penalties,
    stages: Sequence[tuple[int, float, float]],
) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.float64]]:
    """Return the fitted filters (2, 64, 33) complex128, in Fourier space, and the bias (64, 64) float64.

    `histograms`: (N, 2, 64, 64) float64, each with sum 1. `truth_bins`: (N, 2) float64, ground truths in bins;
    values outside 0 … 64 are allowed. `repeats`: (N,) float64, weight of each image. `stages`: for each stage, number
    of iterations, weight of the cross-entropy and weight of the likelihood.
    """
    # Penalties are diagonal in Fourier space. L-BFGS uses parameters scaled so that the penalty is half their squared
    # length (preconditioning, section 4.2). Each batch is calculated in single precision, so that it fits into the
    # cache.
    import scipy.fft
    import scipy.optimize

    fft: Any = scipy.fft
    minimize: Any = scipy.optimize.minimize
    scale = np.stack([_fourier_scale(*weights) for weights in zip(penalties.smoothness, penalties.size, strict=True)])
    spectra: Any = fft.rfft2(histograms.astype(np.float32))
    targets = truth_bins.astype(np.float32)
    image_count, image_weights = float(repeats.sum()), repeats.astype(np.float32)

    def to_model(scaled: npt.NDArray[np.float64]) -> tuple[Any, Any]:
        spectrum: Any = scale * fft.rfft2(scaled.reshape(3, *_SHAPE))
        return spectrum[:2], fft.irfft2(spectrum[2], s=_SHAPE)

    def loss(scaled: npt.NDArray[np.float64], entropy_weight: float, likelihood_weight: float) -> tuple[float, Any]:
        filters, bias = to_model(scaled)
        single_filters, single_bias = filters.astype(np.complex64), bias.astype(np.float32)
        total = 0.5 * image_count * float(scaled @ scaled)
        gradient = np.zeros((3, BINS, BINS // 2 + 1), np.complex128)
        for start in range(0, len(spectra), _BATCH_SIZE):
            rows = slice(start, start + _BATCH_SIZE)
            batch, batch_truths, batch_weights = spectra[rows], targets[rows], image_weights[rows]
            response: Any = fft.irfft2((batch * single_filters).sum(axis=1), s=_SHAPE) + single_bias
            response -= response.max(axis=(1, 2), keepdims=True)
            probabilities = np.exp(response)
            probabilities /= probabilities.sum(axis=(1, 2), keepdims=True)
            if entropy_weight:
                values, slopes = crossentropy(response, probabilities, batch_truths)
                weight = entropy_weight
            else:
                values, slopes = likelihood(probabilities, moments(probabilities), batch_truths, penalties.spread)
                weight = likelihood_weight
            total += weight * float(values.astype(np.float64) @ batch_weights)
            spectrum: Any = fft.rfft2(slopes * batch_weights[:, None, None])
            gradient[:2] += weight * (batch.conj() * spectrum[:, None]).sum(axis=0)
            gradient[2] += weight * spectrum.sum(axis=0)
        scaled_gradient: Any = fft.irfft2(scale * gradient, s=_SHAPE)
        return total, scaled_gradient.ravel() + image_count * scaled

    scaled = np.zeros(3 * BINS * BINS)
    for iterations, *weights in stages:
        options = {"maxiter": iterations, "maxcor": iterations, "maxfun": 4 + 2 * iterations, "ftol": 0, "gtol": 0}
        result: Any = minimize(loss, scaled, tuple(weights), "L-BFGS-B", jac=True, options=options)
        scaled = result.x
    filters, bias = to_model(scaled)
    return filters, bias


def _fourier_scale(smoothness: float, size: float) -> npt.NDArray[np.float64]:
    # Factors (64, 33) from scaled parameters to Fourier coefficients, see `train`. The authors' penalty is
    # Σ |F|² (smoothness (|1 − e^iα|² + |1 − e^iβ|²) / 8 + size) over all coefficients F with the
    # angular frequencies α and β. The constant coefficient is omitted, because it does not change the softmax.
    differences = (2 - 2 * np.cos(_BIN_ANGLE * np.arange(BINS))) / 8
    weights = smoothness * (differences[:, None] + differences[None, : BINS // 2 + 1]) + size
    weights[0, 0] = np.inf
    return 1 / (BINS * np.sqrt(weights))


# Bins of extracted histograms along each axis. `fold` reduces them to 64. It adds bins 64 apart, so the width remains
# 1/32 as in the paper. If training illuminants are widely spread, it adds neighbours, so the width becomes 1/16.
_FINE_BINS = 128
_FINE_WIDTH = 1 / 32  # width of a bin, natural logarithm (section 5 of the paper)
_CHANNELS = 2  # histograms per image: pixels and edges
_IMAGE_BINS = _CHANNELS * _FINE_BINS**2
_LARGEST_SPAN = 0.75  # training illuminants may span this fraction of the torus; the gap makes chromas unambiguous
_LARGEST_SIZE = 255  # largest working size for which counts fit into 16 bits, px


@dataclass(frozen=True)
class LogChroma(FeatureLearner):
    """Settings of the method.

    Most default weights are from the authors' program for thumbnails of Gehler-Shi. `bias_smoothness` and the three
    weights of squares were selected by cross-validation with the Canon 5DSR of INTEL-TAU
    (docs/decisions/0056-settings-of-learned-methods.md).

    - `working_size`: longer side of the reduced image, px, up to 255.
    - `least`: smallest used value of a channel, as a fraction of the largest usable value of the image.
    - `crossentropy`: weight of the cross-entropy, the first loss.
    - `likelihood`: weight of the von Mises likelihood, the second loss.
    - `pixel_smoothness`, `edge_smoothness`, `bias_smoothness`: weights of squared differences of neighbouring bins.
    - `pixel_size`, `edge_size`, `bias_size`: weights of the squares of the bins.
    - `spread`: variance added to the distribution along each axis, bins².
    - `pretraining`, `training`: iterations of L-BFGS with the first and the second loss.
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
        if not 1 <= self.working_size <= _LARGEST_SIZE:
            raise ValueError(f"the working size is {self.working_size} px, expected 1 to {_LARGEST_SIZE}")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.uint16] | None:
        """Return both histograms, (2, 128, 128) uint16 counts, u along the second axis and v along the third.

        See `FeatureLearner.features`.
        """
        small, used = reduce_image(image, saturation, mask, self.working_size)
        counts = _histogram(small[used], self.least)
        if not counts.any():
            return None
        return np.stack([counts, _histogram(_deviations(small, used)[used], self.least)])

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LogChromaModel:
        """Return the model fitted to histograms (N, 2, 128, 128) and ground truths (N, 3); `seed` is not used."""
        model = self._fit(features, truths, np.ones(len(features)))
        return replace(model, examples=TrainingImages.of(features, truths))

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> LogChromaModel:
        """Return the model fitted to its own M images and N new images, which have the weight max(1, M / `worth`).

        A model without its training images is returned unchanged.
        """
        if not isinstance(model, LogChromaModel):
            raise TypeError(f"the model is {type(model).__name__}, expected LogChromaModel")
        if model.examples is None:
            return model
        own, lights = model.examples.histograms(), model.examples.lights
        repeats = np.concatenate([np.ones(len(own)), np.full(len(features), max(1.0, len(own) / worth))])
        return self._fit(np.concatenate([own, features]), np.concatenate([lights, truths]), repeats)

    def _fit(
        self, features: Features, truths: npt.NDArray[np.float64], repeats: npt.NDArray[np.float64]
    ) -> LogChromaModel:
        logs = np.log(truths)
        chromas = logs[:, 1:2] - logs[:, [0, 2]]
        span = float(np.ptp(chromas, axis=0).max())
        is_wide = span > _LARGEST_SPAN * BINS * _FINE_WIDTH
        if span > _LARGEST_SPAN * _FINE_BINS * _FINE_WIDTH:
            raise InputError(
                f"ln(G/R) or ln(G/B) of the training illuminants has a range of {span:.2f}, expected at most "
                f"{_LARGEST_SPAN * _FINE_BINS * _FINE_WIDTH:g}; exclude saturated illuminants, or use another method"
            )
        grid = (2 * _FINE_WIDTH, _FINE_WIDTH / 2) if is_wide else (_FINE_WIDTH, 0.0)
        penalties = Penalties(
            smoothness=(self.pixel_smoothness, self.edge_smoothness, self.bias_smoothness),
            size=(self.pixel_size, self.edge_size, self.bias_size),
            spread=self.spread,
        )
        filters, bias = train(
            fold(features, is_wide),
            (chromas - grid[1]) / grid[0],
            repeats,
            penalties,
            ((self.pretraining, self.crossentropy, 0.0), (self.training, 0.0, self.likelihood)),
        )
        # The torus is cut opposite to the centre. The centre is the middle of the range of chromas. With the median as
        # centre, the cut could be inside the range, because the median can be near one end.
        centre = (chromas.min(axis=0) + chromas.max(axis=0)) / 2
        return LogChromaModel(filters, bias, centre, np.array(grid))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LogChromaModel:
        """Return the model with the arrays of `LogChromaModel`; see `FeatureLearner.restore`."""
        shapes = {"filters": (_CHANNELS, BINS, BINS // 2 + 1), "bias": (BINS, BINS), "centre": (2,), "grid": (2,)}
        loaded: dict[str, Any] = {name: arrays[name] for name in shapes}
        for name, shape in shapes.items():
            if loaded[name].shape != shape or not np.isfinite(loaded[name]).all():
                raise ValueError(f"{name} has the shape {loaded[name].shape}, expected {shape}, finite")
        if tuple(loaded["grid"]) not in ((_FINE_WIDTH, 0.0), (2 * _FINE_WIDTH, _FINE_WIDTH / 2)):
            raise ValueError(f"the grid is {loaded['grid']}, expected bins of 1/32 or 1/16")
        return LogChromaModel(
            **loaded, examples=TrainingImages.restored(arrays) if "learned_lights" in arrays else None
        )


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Training images of a model, stored sparsely for tuning.

    - `places`: (K,) int64, ascending indices of the filled bins of the flattened histograms (M, 2, 128, 128).
    - `counts`: (K,) uint16, counts of these bins.
    - `lights`: (M, 3) float64, ground truths, r + g + b = 1.
    """

    places: npt.NDArray[np.int64]
    counts: npt.NDArray[np.uint16]
    lights: npt.NDArray[np.float64]

    @classmethod
    def of(cls, features: Features, lights: npt.NDArray[np.float64]) -> TrainingImages:
        """Return the sparse form of histograms (M, 2, 128, 128) uint16 with ground truths (M, 3) float64."""
        places = np.flatnonzero(features)
        return cls(places, features.ravel()[places], lights)

    @classmethod
    def restored(cls, arrays: Mapping[str, npt.NDArray[np.generic]]) -> TrainingImages:
        """Return the training images in the arrays of a model file; raise ValueError if they are not valid."""
        stored: list[Any] = [arrays[name] for name in ("learned_places", "learned_counts", "learned_lights")]
        places, counts, lights = stored
        if places.ndim != 1 or places.shape != counts.shape or lights.ndim != 2 or lights.shape[1] != 3:
            raise ValueError(f"images have the shapes {[array.shape for array in stored]}, expected (K,) twice, (M, 3)")
        if places.dtype != np.int64 or counts.dtype != np.uint16 or not (np.isfinite(lights) & (lights > 0)).all():
            raise ValueError("images have wrong types or values, expected counts and ground truths")
        if len(places) and (places[0] < 0 or (np.diff(places) <= 0).any() or places[-1] >= len(lights) * _IMAGE_BINS):
            raise ValueError("images have wrong bins, expected ascending indices inside the histograms")
        return cls(places, counts, lights)

    def histograms(self) -> npt.NDArray[np.uint16]:
        """Return the histograms (M, 2, 128, 128)."""
        full = np.zeros(len(self.lights) * _IMAGE_BINS, np.uint16)
        full[self.places] = self.counts
        return full.reshape(-1, _CHANNELS, _FINE_BINS, _FINE_BINS)


@dataclass(frozen=True, eq=False)
class LogChromaModel:
    """Fitted model.

    - `filters`: (2, 64, 33) complex128, Fourier transforms of both filters, see `numpy.fft.rfft2`.
    - `bias`: (64, 64) float64, added to the response.
    - `centre`: (2,) float64, u and v of the middle of the training illuminants, opposite to the cut of the torus.
    - `grid`: (2,) float64, width of a bin and chroma of the centre of the first bin.
    - `examples`: training images of the model; None if the model was tuned or its file has no training images.
    """

    filters: npt.NDArray[np.complex128]
    bias: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    grid: npt.NDArray[np.float64]
    examples: TrainingImages | None = None

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name, with the arrays of the training images if the model has them."""
        model_arrays = {"filters": self.filters, "bias": self.bias, "centre": self.centre, "grid": self.grid}
        examples = {} if self.examples is None else vars(self.examples)
        return {**model_arrays, **{f"learned_{name}": array for name, array in examples.items()}}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for histograms (N, 2, 128, 128) uint16."""
        return np.stack([self._light(feature) for feature in features])

    def _light(self, feature: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        bin_width, first_chroma = self.grid
        (histograms,) = fold(feature[None], is_wide=bool(bin_width > _FINE_WIDTH))
        response = np.fft.irfft2((np.fft.rfft2(histograms) * self.filters).sum(axis=0), s=(BINS, BINS)) + self.bias
        probabilities = np.exp(response - response.max())
        bin_position = moments((probabilities / probabilities.sum())[None]).mean[0]
        turns = np.rint((bin_position * bin_width + first_chroma - self.centre) / (BINS * bin_width))
        u, v = bin_position * bin_width + first_chroma - turns * BINS * bin_width
        light = np.exp([-u, 0, -v])
        return light / light.sum()


def fold(features: Features, is_wide: bool) -> npt.NDArray[np.float64]:
    """Return histograms (N, 2, 64, 64) float64 with sum 1, or 0 if empty, from counts (N, 2, 128, 128) uint16."""
    shape = (len(features), _CHANNELS, BINS, 2, BINS, 2) if is_wide else (len(features), _CHANNELS, 2, BINS, 2, BINS)
    counts = features.reshape(shape).sum(axis=(3, 5) if is_wide else (2, 4), dtype=np.float64)
    return counts / np.maximum(counts.sum(axis=(2, 3), keepdims=True), 1)


def _histogram(pixels: npt.NDArray[np.float32], least: float) -> npt.NDArray[np.uint16]:
    # Only pixels (M, 3) with at least the value `least` in every channel are counted.
    logs = np.log(pixels[(pixels >= least).all(axis=1)].astype(np.float64))
    bin_indices = np.rint((logs[:, 1:2] - logs[:, [0, 2]]) / _FINE_WIDTH).astype(np.int64) % _FINE_BINS
    counts = np.bincount(bin_indices @ np.array([_FINE_BINS, 1]), minlength=_FINE_BINS**2)
    return counts.reshape(_FINE_BINS, _FINE_BINS).astype(np.uint16)


def _deviations(image: npt.NDArray[np.float32], used: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    # Mean absolute difference between each pixel and its usable neighbours, at most eight.
    height, width = used.shape
    values = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    usable = np.pad(used, 1).astype(np.float32)
    total, count = np.zeros_like(image), np.zeros(used.shape, np.float32)
    for down, right in ((d, r) for d in range(3) for r in range(3) if (d, r) != (1, 1)):
        window = (slice(down, down + height), slice(right, right + width))
        total += usable[window][..., None] * np.abs(values[window] - image)
        count += usable[window]
    return (total / np.maximum(count, 1)[..., None]).astype(np.float32)
