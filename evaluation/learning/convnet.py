"""A small convolutional network that weighs local estimates by its confidence in them; needs PyTorch.

After Y. Hu, B. Wang, S. Lin, "FC4: fully convolutional color constancy with confidence-weighted pooling", CVPR 2017: a
fully convolutional network gives four channels, three of a local light and one of confidence; their product, summed
over the image and scaled to length 1, is the light (equations 4 to 6), and the angular error is the loss (equation 7).

*What is ours.* Three convolutions on thumbnails take the place of AlexNet or SqueezeNet pretrained on ImageNet, so that
it trains on a processor in a minute; the network sees the square root of the image over its mean value, and a channel
that tells usable pixels; a local light is the exponential of three channels. Each image is flipped and lit anew at
random in every epoch, as in the paper's section 5.1, but by a tenth at most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel, require_installed
from evaluation.learning.working_size import reduce
from evaluation.scene import Image
from foundation.errors import InputError

_KERNEL = 5  # Side of the first convolution, px; the others have 3
_BATCH = 16  # Images a step of the optimiser, as in the paper
# Range of the gain on each channel of an image that is lit anew. The paper's 0.6 to 1.4 hides which lights are
# likely, which a few hundred images cannot do without.
_GAINS = (0.9, 1.1)
_TUNED = 4  # Tuning has this many times fewer epochs and smaller steps than training: not chosen by results
_DECAY = 1e-4  # Decay of the weights, which are more than the images


@dataclass(frozen=True)
class ConvNet(FeatureLearner):
    """The method with its settings.

    - `working_size`: side of the square that an image is brought to, px.
    - `width`: channels of the first convolution; the others have twice as many.
    - `epochs`: times that each image is seen.
    - `rate`: learning rate of Adam, which falls to zero along a cosine.
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
        """Return the image at working size, (64, 64, 4) float16: red, green, blue, and 1 where a pixel is usable.

        What is wider or higher than the image is black and not usable. See `FeatureLearner.features`: the image is
        (H, W, 3), the mask (H, W) bool.
        """
        small, used = reduce(image, saturation, mask, self.working_size)
        if not small[used].any():
            return None
        height, width = used.shape
        framed = np.zeros((self.working_size, self.working_size, 4), np.float16)
        framed[:height, :width, :3], framed[:height, :width, 3] = small, used
        return framed

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> ConvNetModel:
        """Return the network fitted to images (N, 64, 64, 4) float16 and lights (N, 3) float64."""
        require_installed(self)
        torch = _torch()
        generator = torch.Generator().manual_seed(seed)
        return self._trained(
            _initial(torch, self.width, generator), features, truths, self.epochs, self.rate, generator
        )

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> ConvNetModel:
        """Return the network trained on, in smaller steps and fewer epochs, so that it stays near what it was.

        `features`: images (N, 64, 64, 4) float16. `truths`: lights (N, 3) float64.
        """
        del worth
        if not isinstance(model, ConvNetModel):
            raise TypeError(f"{type(model).__name__} is no model of {self.key}")
        require_installed(self)
        torch = _torch()
        weights = {name: torch.from_numpy(array.copy()).requires_grad_() for name, array in model.weights.items()}
        epochs, rate = max(1, self.epochs // _TUNED), self.rate / _TUNED
        return self._trained(weights, features, truths, epochs, rate, torch.Generator().manual_seed(seed))

    def _trained(
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
        # Sums of several threads depend on their number; the network is too small to gain by them.
        torch.set_num_threads(1)
        try:
            images = torch.from_numpy(np.moveaxis(features, 3, 1).astype(np.float32))
            lights = torch.from_numpy(truths.astype(np.float32))
            optimiser = torch.optim.Adam(list(weights.values()), lr=rate, weight_decay=_DECAY)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(1, epochs))
            for _ in range(epochs):
                for chosen in torch.randperm(len(images), generator=generator).split(_BATCH):
                    shown, wanted = _lit_anew(torch, images[chosen], lights[chosen], generator)
                    loss = _angle(torch, _forward(torch, weights, shown), wanted).mean()
                    optimiser.zero_grad()
                    loss.backward()
                    optimiser.step()
                schedule.step()
        finally:
            torch.set_num_threads(threads)
        return ConvNetModel({name: weight.detach().numpy().copy() for name, weight in weights.items()})

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> ConvNetModel:
        """Return the model whose arrays are given: weights (O, I, K, K) and biases (O,), float32."""
        expected = _shapes(self.width)
        found: dict[str, Any] = {name: arrays[name] for name in expected}
        for name, shape in expected.items():
            if found[name].shape != shape or found[name].dtype != np.float32 or not np.isfinite(found[name]).all():
                raise ValueError(f"{name} of the shape {found[name].shape}; expected {shape}, float32, all finite")
        return ConvNetModel(found)


@dataclass(frozen=True, eq=False)
class ConvNetModel:
    """What was learned.

    `weights`: weights (O, I, K, K) and biases (O,) of the convolutions, float32, by their names.
    """

    weights: Mapping[str, npt.NDArray[np.float32]]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the weights (O, I, K, K) and biases (O,), float32, by their names."""
        return dict(self.weights)

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of images (N, 64, 64, 4) float16; needs PyTorch."""
        torch = _torch()
        weights = {name: torch.from_numpy(np.asarray(array)) for name, array in self.weights.items()}
        images = torch.from_numpy(np.moveaxis(features, 3, 1).astype(np.float32))
        with torch.no_grad():
            found = np.concatenate([_forward(torch, weights, one[None]).numpy() for one in images])
        lights = found.astype(np.float64)
        return lights / lights.sum(axis=1, keepdims=True)


def _torch() -> ModuleType:
    try:
        import torch
    except ImportError as error:
        raise InputError("the method convnet needs PyTorch: pip install torch") from error
    return torch


def _shapes(width: int) -> dict[str, tuple[int, ...]]:
    return {
        "weight1": (width, 4, _KERNEL, _KERNEL),
        "bias1": (width,),
        "weight2": (2 * width, width, 3, 3),
        "bias2": (2 * width,),
        "weight3": (2 * width, 2 * width, 3, 3),
        "bias3": (2 * width,),
        "weight4": (4, 2 * width, 1, 1),
        "bias4": (4,),
    }


def _initial(torch: Any, width: int, generator: Any) -> dict[str, Any]:
    """Return weights as K. He et al. (ICCV 2015) draw them; those of the last layer begin at a tenth."""
    weights: dict[str, Any] = {}
    for name, shape in _shapes(width).items():
        inputs = int(np.prod(shape[1:]))
        drawn = torch.randn(shape, generator=generator) * (2 / inputs) ** 0.5
        begin = 0.0 if name.startswith("bias") else drawn * (0.1 if name == "weight4" else 1.0)
        weights[name] = (torch.zeros(shape) + begin).requires_grad_()
    return weights


def _lit_anew(torch: Any, images: Any, lights: Any, generator: Any) -> tuple[Any, Any]:
    low, high = _GAINS
    gains = low + (high - low) * torch.rand((len(images), 3), generator=generator)
    if torch.rand((), generator=generator) < 1 / 2:
        images = images.flip(3)
    return images * torch.cat([gains, torch.ones(len(images), 1)], 1)[:, :, None, None], lights * gains


def _forward(torch: Any, weights: Mapping[str, Any], images: Any) -> Any:
    """Return lights (N, 3) of images (N, 4, H, W), each of length 1."""
    convolve = torch.nn.functional.conv2d
    colours, used = images[:, :3], images[:, 3:]
    mean = colours.sum((1, 2, 3)) / (3 * used.sum((1, 2, 3)).clamp(min=1))
    seen = torch.cat([(colours / mean.clamp(min=1e-6)[:, None, None, None]).sqrt(), used], 1)
    layer = convolve(seen, weights["weight1"], weights["bias1"], stride=2, padding=_KERNEL // 2).relu()
    layer = convolve(layer, weights["weight2"], weights["bias2"], stride=2, padding=1).relu()
    layer = convolve(layer, weights["weight3"], weights["bias3"], padding=1).relu()
    local = convolve(layer, weights["weight4"], weights["bias4"])
    share = torch.nn.functional.avg_pool2d(used, 4, ceil_mode=True)
    confidence = torch.nn.functional.softplus(local[:, 3:]) * share
    lights = local[:, :3].clamp(-3, 3).exp() * confidence
    return torch.nn.functional.normalize(lights.sum((2, 3)), dim=1)


def _angle(torch: Any, found: Any, wanted: Any) -> Any:
    """Return the angles (N,) radians between lights (N, 3); by the sine near zero, where the cosine has no slope."""
    true = torch.nn.functional.normalize(wanted, dim=1)
    return torch.atan2(torch.linalg.cross(found, true).norm(dim=1).clamp(min=1e-6), (found * true).sum(1))
