"""Plain methods against figures of real photographs that were computed apart from this code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from evaluation.experiments import evaluate
from evaluation.methods import GrayEdge

if TYPE_CHECKING:
    from tests.evaluation.real_images import Collection


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
