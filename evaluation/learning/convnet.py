"""Small convolutional network that weights local estimates by confidence; requires PyTorch.

After Y. Hu, B. Wang, S. Lin, "FC4: fully convolutional color constancy with confidence-weighted pooling", CVPR 2017. A
fully convolutional network returns four channels: a local illuminant and its confidence. The sum of their products
over the image, scaled to length 1, is the estimate (equations 4 to 6). The angular error is the loss (equation 7).

*Differences to the paper.* Three convolutions on thumbnails replace AlexNet or SqueezeNet pretrained on ImageNet, so
that training takes a minute on a processor. The image is divided by its mean. The input is the square root of this
quotient, and a mask of usable pixels. Local illuminants are exponentials of three channels. Images are flipped and get
random gains as in section 5.1, but gains change a channel by at most 10 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel, require_installed
from evaluation.learning.working_size import reduce_image
from evaluation.scene import Image
from foundation.errors import InputError

_FIRST_KERNEL = 5  # side of the kernel of the first convolution, px
_BATCH_SIZE = 16  # images per step of the optimiser, as in the paper
# Range of the random gain of each channel. The range 0.6 to 1.4 of the paper hides the distribution of illuminants,
# which is important with a few hundred images.
_GAIN_RANGE = (0.9, 1.1)
_TUNING_FACTOR = 4  # tuning has fewer epochs and a smaller learning rate by this factor; our choice
_WEIGHT_DECAY = 1e-4  # weight decay, because the network has more weights than there are images


@dataclass(frozen=True)
class ConvNet(FeatureLearner):
    """Settings of the method.

    - `working_size`: side of the square input, px.
    - `width`: channels of the first convolution; the next two convolutions have twice as many.
    - `epochs`: number of epochs.
    - `rate`: learning rate of Adam, which decreases to zero along a cosine.
    """

    key: ClassVar[str] = "convnet"
    title: ClassVar[str] = "Convolutional network"
    needs: ClassVar[tuple[str, str] | None] = "torch", "pip install torch"

    working_size: int = 64
    width: int = 16
    epochs: int = 60
    rate: float = 3e-3

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float16] | None:
        """Return the image at working size, (64, 64, 4) float16: red, green, blue, and 1 for usable pixels.

        Smaller images are padded with unusable black pixels. See `FeatureLearner.features`.
        """
        small, used = reduce_image(image, saturation, mask, self.working_size)
        if not small[used].any():
            return None
        height, width = used.shape
        framed = np.zeros((self.working_size, self.working_size, 4), np.float16)
        framed[:height, :width, :3], framed[:height, :width, 3] = small, used
        return framed

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> ConvNetModel:
        """Return the network fitted to images (N, 64, 64, 4) float16 and ground truths (N, 3) float64."""
        require_installed(self)
        torch = _torch()
        generator = torch.Generator().manual_seed(seed)
        return self._train(
            _initial_weights(torch, self.width, generator), features, truths, self.epochs, self.rate, generator
        )

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> ConvNetModel:
        """Return the network after further training with smaller steps and fewer epochs.

        See `FeatureLearner.tune`; `worth` is not used.
        """
        del worth
        if not isinstance(model, ConvNetModel):
            raise TypeError(f"the model is {type(model).__name__}, expected ConvNetModel")
        require_installed(self)
        torch = _torch()
        weights = {name: torch.from_numpy(array.copy()).requires_grad_() for name, array in model.weights.items()}
        epochs, rate = max(1, self.epochs // _TUNING_FACTOR), self.rate / _TUNING_FACTOR
        return self._train(weights, features, truths, epochs, rate, torch.Generator().manual_seed(seed))

    def _train(
        self,
        weights: dict[str, Any],
        features: Features,
        truths: npt.NDArray[np.float64],
        epochs: int,
        rate: float,
        generator: Any,
    ) -> ConvNetModel:
        torch = _torch()
        threads = torch.get_num_threads()
        # Rounding depends on the number of threads, and the network is too small to benefit from several threads.
        torch.set_num_threads(1)
        try:
            images = torch.from_numpy(np.moveaxis(features, 3, 1).astype(np.float32))
            lights = torch.from_numpy(truths.astype(np.float32))
            optimiser = torch.optim.Adam(list(weights.values()), lr=rate, weight_decay=_WEIGHT_DECAY)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, epochs))
            for _ in range(epochs):
                for batch in torch.randperm(len(images), generator=generator).split(_BATCH_SIZE):
                    batch_images, batch_lights = _augment(torch, images[batch], lights[batch], generator)
                    loss = _angle(torch, _forward(torch, weights, batch_images), batch_lights).mean()
                    optimiser.zero_grad()
                    loss.backward()
                    optimiser.step()
                schedule.step()
        finally:
            torch.set_num_threads(threads)
        return ConvNetModel({name: weight.detach().numpy().copy() for name, weight in weights.items()})

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> ConvNetModel:
        """Return the model with these weights and biases; see `FeatureLearner.restore`."""
        expected = _weight_shapes(self.width)
        loaded: dict[str, Any] = {name: arrays[name] for name in expected}
        for name, shape in expected.items():
            if loaded[name].shape != shape or loaded[name].dtype != np.float32 or not np.isfinite(loaded[name]).all():
                raise ValueError(f"{name} has the shape {loaded[name].shape}, expected {shape}, finite float32")
        return ConvNetModel(loaded)


@dataclass(frozen=True, eq=False)
class ConvNetModel:
    """Fitted network: weights (O, I, K, K) and biases (O,) of the convolutions, float32, by name."""

    weights: Mapping[str, npt.NDArray[np.float32]]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the weights and biases by name."""
        return dict(self.weights)

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for images (N, 64, 64, 4) float16; requires PyTorch."""
        torch = _torch()
        weights = {name: torch.from_numpy(np.asarray(array)) for name, array in self.weights.items()}
        images = torch.from_numpy(np.moveaxis(features, 3, 1).astype(np.float32))
        with torch.no_grad():
            estimates = np.concatenate([_forward(torch, weights, image[None]).numpy() for image in images])
        lights = estimates.astype(np.float64)
        return lights / lights.sum(axis=1, keepdims=True)


def _torch() -> ModuleType:
    try:
        import torch
    except ImportError as error:
        raise InputError("PyTorch is not installed, expected by the method convnet; pip install torch") from error
    return torch


def _weight_shapes(width: int) -> dict[str, tuple[int, ...]]:
    return {
        "weight1": (width, 4, _FIRST_KERNEL, _FIRST_KERNEL),
        "bias1": (width,),
        "weight2": (2 * width, width, 3, 3),
        "bias2": (2 * width,),
        "weight3": (2 * width, 2 * width, 3, 3),
        "bias3": (2 * width,),
        "weight4": (4, 2 * width, 1, 1),
        "bias4": (4,),
    }


def _initial_weights(torch: Any, width: int, generator: Any) -> dict[str, Any]:
    # Initialisation of K. He et al. (ICCV 2015), with ten times smaller weights in the last layer.
    weights: dict[str, Any] = {}
    for name, shape in _weight_shapes(width).items():
        inputs = int(np.prod(shape[1:]))
        drawn = torch.randn(shape, generator=generator) * (2 / inputs) ** 0.5
        values = 0.0 if name.startswith("bias") else drawn * (0.1 if name == "weight4" else 1.0)
        weights[name] = (torch.zeros(shape) + values).requires_grad_()
    return weights


def _augment(torch: Any, images: Any, lights: Any, generator: Any) -> tuple[Any, Any]:
    low, high = _GAIN_RANGE
    gains = low + (high - low) * torch.rand((len(images), 3), generator=generator)
    if torch.rand((), generator=generator) < 1 / 2:
        images = images.flip(3)
    return images * torch.cat([gains, torch.ones(len(images), 1)], 1)[:, :, None, None], lights * gains


def _forward(torch: Any, weights: Mapping[str, Any], images: Any) -> Any:
    # Estimates (N, 3) of length 1 for images (N, 4, H, W).
    convolve = torch.nn.functional.conv2d
    colours, used = images[:, :3], images[:, 3:]
    mean = colours.sum((1, 2, 3)) / (3 * used.sum((1, 2, 3)).clamp(min=1))
    inputs = torch.cat([(colours / mean.clamp(min=1e-6)[:, None, None, None]).sqrt(), used], 1)
    layer = convolve(inputs, weights["weight1"], weights["bias1"], stride=2, padding=_FIRST_KERNEL // 2).relu()
    layer = convolve(layer, weights["weight2"], weights["bias2"], stride=2, padding=1).relu()
    layer = convolve(layer, weights["weight3"], weights["bias3"], padding=1).relu()
    local = convolve(layer, weights["weight4"], weights["bias4"])
    share = torch.nn.functional.avg_pool2d(used, 4, ceil_mode=True)
    confidence = torch.nn.functional.softplus(local[:, 3:]) * share
    lights = local[:, :3].clamp(-3, 3).exp() * confidence
    return torch.nn.functional.normalize(lights.sum((2, 3)), dim=1)


def _angle(torch: Any, estimates: Any, truths: Any) -> Any:
    # Angles (N,) in radians. The sine is used, because the cosine has no gradient at an angle of zero.
    directions = torch.nn.functional.normalize(truths, dim=1)
    sine = torch.linalg.cross(estimates, directions).norm(dim=1).clamp(min=1e-6)
    return torch.atan2(sine, (estimates * directions).sum(1))
