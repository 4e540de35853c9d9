"""Gray-Edge framework, compared with manual calculation, NumPy and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from evaluation.methods import GrayEdge, gaussian
from evaluation.methods.gaussian import gaussian_kernel
from evaluation.methods.prepared import PreparedImage
from evaluation.metrics import recovery_error

pytestmark = pytest.mark.slow


def derivative(image: npt.NDArray[Any], order: int, sigma: float) -> npt.NDArray[np.float32]:
    """Return the size of the derivative (H, W, 3) float32, in the image's unit."""
    prepared = PreparedImage(image)
    return np.asarray(prepared.derivative(order, sigma) / np.float32(prepared.scale))


def test_minkowski_means_of_two_pixels() -> None:
    image = np.array([[[3, 4, 0], [4, 3, 1]]], dtype=np.float64)
    assert recovery_error(GrayEdge("", 0, 1, 0, 0).estimate(image), [7, 7, 1]) < 1e-5
    assert recovery_error(GrayEdge("", 0, 2, 0, 0).estimate(image), [5, 5, 1]) < 1e-5
    assert recovery_error(GrayEdge("", 0, np.inf, 0, 0).estimate(image), [4, 4, 1]) < 1e-5


def test_derivatives_of_polynomials_are_exact() -> None:
    y, x = np.mgrid[0:60, 0:60].astype(np.float32)
    inside = (slice(25, 35), slice(25, 35))
    ramp = np.stack([3 * x + 4 * y, x, 0 * x + 7], axis=-1).astype(np.float32)
    np.testing.assert_allclose(derivative(ramp, 1, 2.0)[inside][0, 0], [5, 1, 0], atol=1e-3)
    np.testing.assert_allclose(derivative(ramp, 0, 2.0)[inside][0, 0], ramp[25, 25], rtol=1e-5)
    curve = np.stack([x * x / 2, x * y, ramp[..., 0]], axis=-1).astype(np.float32)
    np.testing.assert_allclose(derivative(curve, 2, 2.0)[inside][0, 0], [1, 2, 0], atol=2e-2)


@pytest.mark.parametrize("sigma", [1.0, 2.5, 6.0, 9.0])
def test_kernels_have_authors_size_and_norms(sigma: float) -> None:
    x = np.arange(-int(3 * sigma + 0.5), int(3 * sigma + 0.5) + 1)
    kernels = [gaussian_kernel(sigma, order) for order in range(3)]
    assert {len(kernel) for kernel in kernels} == {len(x)}
    assert [kernels[0].sum(), (x * kernels[1]).sum(), (x**2 / 2 * kernels[2]).sum()] == pytest.approx([1, 1, 1])
    assert [kernels[1].sum(), kernels[2].sum()] == pytest.approx([0, 0], abs=1e-12)


def photograph(height: int, width: int) -> npt.NDArray[np.uint16]:
    """Return smooth colours, edges and noise (height, width, 3) uint16, none saturated below 16000."""
    random = np.random.default_rng(height + width)
    y, x = np.mgrid[:height, :width]
    waves = [2 + np.sin(x / (17 + 5 * channel)) + np.cos(y / (23 - 4 * channel)) for channel in range(3)]
    edges = 1 + 2.0 * ((x // 61 + y // 47) % 3 == 0)
    image = np.stack(waves, axis=-1) * edges[..., None] * np.array([400.0, 1000.0, 600.0])
    noise = np.asarray(np.clip(random.normal(0, 12, (height, width, 3)), -50, 50), dtype=np.float64)
    return np.asarray(image + noise + 60, dtype=np.uint16)


def numpy_norm(values: npt.NDArray[Any], p: float) -> npt.NDArray[np.float64]:
    """Return the p-norms of the channels of (..., 3), of length 1."""
    flat = values.reshape(-1, 3).astype(np.float64)
    light = flat.max(axis=0) if np.isinf(p) else ((flat / flat.max()) ** p).mean(axis=0) ** (1 / p)
    return light / np.linalg.norm(light)


@pytest.mark.parametrize("p", [1, 2, 4, 6.5, 20, np.inf])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_agrees_with_numpy_without_filter(p: float, dtype: Any) -> None:
    image = (photograph(301, 419) * (1 if dtype is np.uint16 else 1.37e-5)).astype(dtype)
    np.testing.assert_allclose(GrayEdge("", 0, p, 0).estimate(image), numpy_norm(image, p), rtol=1e-9)
    mask = np.random.default_rng(1).uniform(size=image.shape[:2]) < 0.02
    np.testing.assert_allclose(GrayEdge("", 0, p, 0).estimate(image, mask=mask), numpy_norm(image[~mask], p), rtol=1e-9)
    inner = image[3:-3, 3:-3]
    np.testing.assert_allclose(GrayEdge("", 0, p, 0, border=3).estimate(image), numpy_norm(inner, p), rtol=1e-9)


def test_sums_of_the_largest_values_do_not_overflow() -> None:
    image = np.full((1100, 4200, 3), 65535, np.uint16)
    image[..., 1] = 0
    np.testing.assert_allclose(PreparedImage(image).moments()[0], [65535.0 * 4620000, 0, 65535.0 * 4620000], rtol=0)
    np.testing.assert_allclose(PreparedImage(image).moments()[1, 0], 65535.0**2 * 4620000, rtol=0)


def scipy_kernel(order: int, sigma: float) -> npt.NDArray[np.float64]:
    """Return the correlation kernel of scipy, cut at 3σ, with the gain of the authors' kernel."""
    radius = int(3 * sigma + 0.5)
    impulse = np.zeros(2 * radius + 1)
    impulse[radius] = 1
    kernel = ndimage.gaussian_filter1d(impulse, sigma, order=order, mode="constant", radius=radius)[::-1]
    x = np.arange(-radius, radius + 1)
    if order == 2:
        kernel = kernel - kernel.mean()
    return kernel / (kernel.sum(), (x * kernel).sum(), (x**2 / 2 * kernel).sum())[order]


def scipy_derivative(image: npt.NDArray[Any], order: int, sigma: float) -> npt.NDArray[np.float64]:
    """Return the size of the derivative (H, W, 3) in float64."""

    def filtered(down: int, across: int) -> npt.NDArray[np.float64]:
        values = ndimage.correlate1d(image.astype(np.float64), scipy_kernel(down, sigma), axis=0, mode="nearest")
        return ndimage.correlate1d(values, scipy_kernel(across, sigma), axis=1, mode="nearest")

    if order == 0:
        return filtered(0, 0)
    if order == 1:
        return np.hypot(filtered(0, 1), filtered(1, 0))
    return np.sqrt(filtered(0, 2) ** 2 + 4 * filtered(1, 1) ** 2 + filtered(2, 0) ** 2)


CASES = [(0, 9, 9), (1, 1, 6), (1, 5, 2), (2, 1, 1), (2, 3, 4), (1, np.inf, 1.3), (0, 1, 2)]


@pytest.mark.parametrize(("order", "p", "sigma"), CASES)
def test_agrees_with_derivatives_of_scipy(order: int, p: float, sigma: float) -> None:
    image = photograph(310, 420)
    border = int(sigma) + 1
    expected = numpy_norm(scipy_derivative(image, order, sigma)[border:-border, border:-border], p)
    np.testing.assert_allclose(GrayEdge("", order, p, sigma).estimate(image), expected, rtol=1e-6)


@pytest.mark.parametrize(("order", "sigma"), [(0, 9.0), (1, 6.0), (2, 1.0), (1, 0.4)])
@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (400, 2), (37, 41), (600, 131)])
def test_differentiates_images_of_any_shape(order: int, sigma: float, shape: tuple[int, int]) -> None:
    image = photograph(*shape)
    np.testing.assert_allclose(
        derivative(image, order, sigma), scipy_derivative(image, order, sigma), rtol=2e-5, atol=2e-3
    )


@pytest.mark.parametrize("order", [0, 1, 2])
def test_derivative_does_not_depend_on_tiles(order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image = photograph(500, 300)
    monkeypatch.setattr(gaussian, "TILE_WIDTH", 304)
    monkeypatch.setattr(gaussian, "TILE_ROWS", 512)
    assert len(list(gaussian.differentiated_tiles(image, order, 3.0, 1.0))) == 1
    expected = derivative(image, order, 3.0)
    monkeypatch.setattr(gaussian, "TILE_WIDTH", 64)
    monkeypatch.setattr(gaussian, "TILE_ROWS", 16)
    assert len(list(gaussian.differentiated_tiles(image, order, 3.0, 1.0))) == 32 * 5
    np.testing.assert_array_equal(derivative(image, order, 3.0), expected)


@pytest.mark.parametrize("p", [1, 3, 6.5, 20, np.inf])
def test_excludes_mask_and_border_across_tiles(p: float) -> None:
    image = photograph(150, 600)
    mask = np.random.default_rng(2).uniform(size=image.shape[:2]) < 0.001
    mask[40:80, 250:262] = True  # across the edges of tiles
    image[60, 255] = 65535  # masked, but used by the filter next to it
    for border in (0, 5, 70):
        inner = np.s_[border : 150 - border, border : 600 - border]
        expected = numpy_norm(scipy_derivative(image, 1, 2.0)[inner][~mask[inner]], p)
        method = GrayEdge("", 1, p, 2.0, border)
        np.testing.assert_allclose(method.estimate(image, mask=mask), expected, rtol=1e-6)
