"""Methods against images whose answer is known, and against figures of real photographs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments import evaluate
from evaluation.methods import BrightDark, GrayEdge, standard_methods
from evaluation.methods.gray_edge import differentiate, gaussian_kernel
from evaluation.methods.pixels import GREY, usable
from evaluation.metrics import recovery_error

if TYPE_CHECKING:
    from tests.evaluation.real_images import Collection

LIGHT = np.array([0.5, 1.0, 0.7])


def grey_scene(seed: int = 0) -> npt.NDArray[np.float64]:
    """Return a grey noise image (64, 80, 3) under LIGHT: every method must find it."""
    grey = np.random.default_rng(seed).uniform(100, 3000, (64, 80, 1))
    return grey * LIGHT


@pytest.mark.parametrize("name", standard_methods())
def test_every_method_finds_the_light_on_grey_things(name: str) -> None:
    estimate = standard_methods()[name].estimate(grey_scene())
    assert recovery_error(estimate, LIGHT) < 1e-3
    assert np.linalg.norm(estimate) == pytest.approx(1)


@pytest.mark.parametrize("name", standard_methods())
def test_masked_and_saturated_pixels_do_not_matter(name: str) -> None:
    image = grey_scene()
    image[20:30, 30:50] = (9000, 100, 100)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[20:30, 30:50] = True
    method = standard_methods()[name]
    assert np.isfinite(method.estimate(image)).all()
    if name in ("white-patch", "gray-world", "shades-of-gray", "pca"):
        # The others look at neighbours of what is left out too, as their authors' program does.
        assert recovery_error(method.estimate(image, mask=mask), LIGHT) < 1e-3
        assert recovery_error(method.estimate(image, saturation=8000), LIGHT) < 1e-3
        assert recovery_error(method.estimate(image), LIGHT) > 1


@pytest.mark.parametrize("name", standard_methods())
def test_an_image_without_a_usable_pixel_is_grey(name: str) -> None:
    method = standard_methods()[name]
    assert method.estimate(np.full((40, 40, 3), 500, np.uint16), saturation=500) is GREY
    assert method.estimate(np.zeros((40, 40, 3), np.uint16)) is GREY
    assert method.estimate(np.ones((1, 1, 3)), mask=np.ones((1, 1), bool)) is GREY
    np.testing.assert_allclose(GREY, 3**-0.5)


def test_minkowski_means_by_hand() -> None:
    image = np.array([[[3, 4, 0], [4, 3, 1]]], dtype=np.float64)
    assert recovery_error(GrayEdge("", 0, 1, 0, 0).estimate(image), [7, 7, 1]) < 1e-5
    assert recovery_error(GrayEdge("", 0, 2, 0, 0).estimate(image), [5, 5, 1]) < 1e-5
    assert recovery_error(GrayEdge("", 0, np.inf, 0, 0).estimate(image), [4, 4, 1]) < 1e-5


def test_derivatives_of_polynomials() -> None:
    y, x = np.mgrid[0:60, 0:60].astype(np.float32)
    inside = (slice(25, 35), slice(25, 35))
    ramp = np.stack([3 * x + 4 * y, x, 0 * x + 7], axis=-1).astype(np.float32)
    np.testing.assert_allclose(differentiate(ramp, 1, 2.0)[inside][0, 0], [5, 1, 0], atol=1e-3)
    np.testing.assert_allclose(differentiate(ramp, 0, 2.0)[inside][0, 0], ramp[25, 25], rtol=1e-5)
    bend = np.stack([x * x / 2, x * y, ramp[..., 0]], axis=-1).astype(np.float32)
    np.testing.assert_allclose(differentiate(bend, 2, 2.0)[inside][0, 0], [1, 2, 0], atol=2e-2)


@pytest.mark.parametrize("sigma", [1.0, 2.5, 6.0, 9.0])
def test_kernels_have_the_authors_size_and_norms(sigma: float) -> None:
    x = np.arange(-int(3 * sigma + 0.5), int(3 * sigma + 0.5) + 1)
    kernels = [gaussian_kernel(sigma, order) for order in range(3)]
    assert {len(kernel) for kernel in kernels} == {len(x)}
    assert [kernels[0].sum(), (x * kernels[1]).sum(), (x**2 / 2 * kernels[2]).sum()] == pytest.approx([1, 1, 1])
    assert [kernels[1].sum(), kernels[2].sum()] == pytest.approx([0, 0], abs=1e-12)


def test_which_pixels_are_used() -> None:
    image = np.ones((7, 9, 3))
    image[3, 4, 1] = 10
    mask = np.zeros((7, 9), dtype=bool)
    mask[1, 1] = True
    used = usable(image, 10, mask, 1)
    expected = np.zeros((7, 9), dtype=bool)
    expected[1:6, 1:8] = True
    expected[2:5, 3:6] = False
    expected[1, 1] = False
    np.testing.assert_array_equal(used, expected)


def test_bright_and_dark_pixels_alone_decide() -> None:
    image = np.random.default_rng(1).uniform(400, 600, (50, 50, 3))
    image[:2] = 2000 * LIGHT
    image[-2:] = 20 * LIGHT
    assert recovery_error(BrightDark().estimate(image), LIGHT) < 1e-6


@pytest.mark.parametrize(("order", "p", "sigma"), [(3, 1, 1), (0, 0.5, 0), (0, 1, -1), (1, 1, 0)])
def test_constants_that_make_no_method_are_refused(order: int, p: float, sigma: float) -> None:
    with pytest.raises(ValueError, match="make no method"):
        GrayEdge("", order, p, sigma)


PLAIN = [
    # Recovery errors, computed apart from this code: mean, median, trimean, best and worst quarter. The figures of the
    # photographs are those of dcraw's counts and 20 lines of NumPy, those of NUS came with the data.
    (
        GrayEdge("Gray-world", 0, 1, 0, 0),
        {"photographs": (9.75, 6.82, 8.19, 1.74, 22.11), "NUS": (5.21, 4.18, 4.40, 1.11, 11.01)},
    ),
    (
        GrayEdge("Shades-of-Gray", 0, 2, 0, 0),
        {"photographs": (9.83, 6.01, 7.38, 1.51, 22.48), "NUS": (4.51, 3.37, 3.66, 1.00, 9.88)},
    ),
    (
        GrayEdge("White-Patch", 0, np.inf, 0, 0),
        {"photographs": (11.84, 13.84, 12.10, 1.97, 22.94), "NUS": (5.78, 3.75, 4.25, 0.90, 14.45)},
    ),
]
PUBLISHED_MEAN = {"NUS": 5.16}
"""Mean error of Gray-world at full resolution: Canon1DsMkIII in Cheng et al., CVPR 2015, as google/ffcc collects it."""


@pytest.mark.parametrize(("method", "figures"), PLAIN, ids=lambda value: getattr(value, "name", ""))
def test_plain_methods_on_real_images(
    collection: Collection, method: GrayEdge, figures: dict[str, tuple[float, ...]]
) -> None:
    (result,) = evaluate(collection.scenes, [method])
    summary = result.summary("recovery")
    assert summary.as_tuple()[:5] == pytest.approx(figures[collection.name], abs=0.00501)
    if method.name == "Gray-world" and collection.name in PUBLISHED_MEAN:
        assert summary.mean == pytest.approx(PUBLISHED_MEAN[collection.name], rel=0.03)
