"""Convolutional network, compared with a NumPy implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import correlate

from evaluation.learning import convnet
from evaluation.learning.convnet import ConvNet, ConvNetModel

pytestmark = pytest.mark.slow

torch: Any = pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")


def convolve(
    layer: npt.NDArray[np.float64], weights: npt.NDArray[Any], bias: npt.NDArray[Any], step: int
) -> npt.NDArray[np.float64]:
    """Return the correlation (O, h, w) of an image (I, H, W), padded with zeros, with weights (O, I, K, K)."""
    radius = weights.shape[2] // 2
    padded = np.pad(layer, ((0, 0), (radius, radius), (radius, radius)))
    estimates: Any = [
        correlate(padded, kernel, mode="valid")[0, ::step, ::step] for kernel in weights.astype(np.float64)
    ]
    return np.asarray(estimates + bias[:, None, None].astype(np.float64))


def numpy_estimate(weights: dict[str, npt.NDArray[Any]], image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the estimate for an image (H, W, 4): R, G, B, usable; H and W are multiples of four."""
    colours, used = np.moveaxis(image[..., :3], 2, 0), image[..., 3]
    mean = colours.sum() / (3 * used.sum())
    layer = np.concatenate([np.sqrt(colours / mean), used[None]])
    for number, step in ((1, 2), (2, 2), (3, 1)):
        layer = np.maximum(convolve(layer, weights[f"weight{number}"], weights[f"bias{number}"], step), 0)
    local = convolve(layer, weights["weight4"], weights["bias4"], 1)
    height, width = used.shape
    share = used.reshape(height // 4, 4, width // 4, 4).mean(axis=(1, 3))
    # FC4, equations 4 to 6: sum of local illuminants times confidence; confidence > 0, illuminants e^-3 to e^3.
    confidence = np.logaddexp(0, local[3]) * share
    light = (np.exp(np.clip(local[:3], -3, 3)) * confidence).sum(axis=(1, 2))
    return light / light.sum()


def random_weights(size: float) -> dict[str, npt.NDArray[np.float32]]:
    random = np.random.default_rng(3)
    shapes = convnet._weight_shapes(3)
    return {name: random.normal(0, size, shape).astype(np.float32) for name, shape in shapes.items()}


@pytest.mark.parametrize("size", [0.15, 0.4])
def test_weights_local_estimates_by_confidence(size: float) -> None:
    weights = random_weights(size)
    image = np.random.default_rng(4).uniform(0.05, 1, (16, 12, 4)).astype(np.float16)
    image[..., 3] = 1
    image[3:9, 5:] = 0
    (estimates,) = ConvNetModel(weights).lights(image[None])
    np.testing.assert_allclose(estimates, numpy_estimate(dict(weights), image.astype(np.float64)), rtol=1e-4)
    assert ConvNet(width=3).restore(dict(weights)).arrays().keys() == weights.keys()
    for damage in (weights["bias4"][:3], weights["bias4"].astype(np.float64), np.full(4, np.nan, np.float32)):
        with pytest.raises(ValueError, match="bias4"):
            ConvNet(width=3).restore({**weights, "bias4": damage})


def test_pads_small_images_with_unusable_pixels() -> None:
    image = np.full((20, 40, 3), 0.5, np.float32)
    framed = ConvNet(working_size=64).features(image)
    assert framed is not None
    assert framed.shape == (64, 64, 4)
    assert framed[:20, :40].min() == framed.max() == 1
    assert not framed[20:].any()
    assert not framed[:, 40:].any()


def test_loss_is_angle() -> None:
    estimates = torch.tensor([[1.0, 0, 0], [2**-0.5, 2**-0.5, 0], [0, 0, 1]])
    truths = torch.tensor([[0, 3.0, 0], [5, 0, 0], [0, 0, 2]])
    angles = convnet._angle(torch, estimates, truths).numpy()
    np.testing.assert_allclose(angles, [np.pi / 2, np.pi / 4, 0], atol=1e-5)
