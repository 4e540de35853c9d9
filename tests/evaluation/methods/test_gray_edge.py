"""The Gray-Edge framework by hand: Minkowski means, derivatives and kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from evaluation.methods import GrayEdge
from evaluation.methods.gaussian import differentiate, gaussian_kernel
from evaluation.metrics import recovery_error

if TYPE_CHECKING:
    pass


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


@pytest.mark.parametrize(("order", "p", "sigma"), [(3, 1, 1), (0, 0.5, 0), (0, 1, -1), (1, 1, 0)])
def test_constants_that_make_no_method_are_refused(order: int, p: float, sigma: float) -> None:
    with pytest.raises(ValueError, match="make no method"):
        GrayEdge("", order, p, sigma)
