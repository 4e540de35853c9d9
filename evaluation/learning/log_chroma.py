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
over more than three quarters of the paper's torus of two natural logarithms get bins of twice the width. Training is
described in `log_chroma_training.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.learning.log_chroma_training import BINS, Penalties, moments, train
from evaluation.learning.working_size import reduce
from evaluation.scene import Image
from foundation.errors import InputError

_FINE_BINS = 128
"""Bins of the histogram that is extracted, along each axis: four natural logarithms. It is folded to 64 bins of 1/32,
the paper's, or of 1/16 when the training lights are known."""
_FINE_SIZE = 1 / 32
"""Width of a bin, natural logarithm (section 5 of the paper)."""
_CHANNELS = 2
"""Histograms: of pixels and of edges."""
_SPREAD = 0.75
"""Share of the torus that the lights may span: the rest tells one turn of it from the next."""
_LARGEST = 255
"""Working size up to which the counts of a histogram fit in 16 bits."""


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

    @property
    def key(self) -> str:
        """Its name on the command line and in model files."""
        return "log-chroma"

    @property
    def name(self) -> str:
        """Its name in tables."""
        return "Log-chroma (FFCC family)"

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
            penalties,
            ((self.pretraining, self.crossentropy, 0.0), (self.training, 0.0, self.likelihood)),
        )
        # Half-way between the outermost lights: their median lies so near one end where tungsten is rare that the torus
        # would be cut through the other.
        centre = (chromas.min(axis=0) + chromas.max(axis=0)) / 2
        return LogChromaModel(filters, bias, centre, np.array(grid))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LogChromaModel:
        """Return the model whose arrays are given: filters (2, 64, 33) complex128 and the others float64."""
        shapes = {"filters": (_CHANNELS, BINS, BINS // 2 + 1), "bias": (BINS, BINS), "centre": (2,), "grid": (2,)}
        found: dict[str, Any] = {name: arrays[name] for name in shapes}
        for name, shape in shapes.items():
            if found[name].shape != shape or not np.isfinite(found[name]).all():
                raise ValueError(f"{name} of the shape {found[name].shape}; expected {shape}, all finite")
        if tuple(found["grid"]) not in ((_FINE_SIZE, 0.0), (2 * _FINE_SIZE, _FINE_SIZE / 2)):
            raise ValueError(f"bins of {found['grid']}")
        return LogChromaModel(**found)


@dataclass(frozen=True, eq=False)
class LogChromaModel:
    """What was learned.

    - `filters`: (2, 64, 33) complex128, Fourier transforms of the two filters, as `numpy.fft.rfft2` has them.
    - `bias`: (64, 64) float64.
    - `centre`: (2,) float64, u and v about which the torus is cut: the middle of the training lights' range.
    - `grid`: (2,) float64, the width of a bin and the chroma of the first one's centre.
    """

    filters: npt.NDArray[np.complex128]
    bias: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    grid: npt.NDArray[np.float64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by their names, filters (2, 64, 33) complex128 and the others float64."""
        return {"filters": self.filters, "bias": self.bias, "centre": self.centre, "grid": self.grid}

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
