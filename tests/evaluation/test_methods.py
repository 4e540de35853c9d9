"""Plain methods against figures of real photographs that were computed apart from this code."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from evaluation.experiments import evaluate
from evaluation.methods import GrayEdge, standard_methods
from evaluation.metrics import recovery_error
from tests.data_files import available

if TYPE_CHECKING:
    from tests.evaluation.real_images import Collection


PLAIN = [
    # Recovery errors, computed apart from this code: mean, median, trimean, best and worst quarter. The figures of the
    # photographs are those of dcraw's counts and 20 lines of NumPy, those of NUS came with the data.
    (
        GrayEdge("Gray-world", 0, 1, 0),
        {"photographs": (9.75, 6.82, 8.19, 1.74, 22.11), "NUS": (5.21, 4.18, 4.40, 1.11, 11.01)},
    ),
    (
        GrayEdge("Shades-of-Gray", 0, 2, 0),
        {"photographs": (9.83, 6.01, 7.38, 1.51, 22.48), "NUS": (4.51, 3.37, 3.66, 1.00, 9.88)},
    ),
    (
        GrayEdge("White-Patch", 0, np.inf, 0),
        {"photographs": (11.84, 13.84, 12.10, 1.97, 22.94), "NUS": (5.78, 3.75, 4.25, 0.90, 14.45)},
    ),
]
PUBLISHED = {"NUS": (5.16, 4.15, 4.46, 0.95, 11.00)}
"""Gray-world at full resolution: Canon1DsMkIII in Cheng et al., CVPR 2015, as google/ffcc collects it."""


@pytest.mark.slow
@pytest.mark.parametrize(("method", "figures"), PLAIN, ids=lambda value: getattr(value, "name", ""))
def test_plain_methods_on_real_images(
    collection: Collection, method: GrayEdge, figures: dict[str, tuple[float, ...]]
) -> None:
    (result,) = evaluate(collection.scenes, [method])
    summary = result.summary("recovery")
    assert summary.as_tuple()[:5] == pytest.approx(figures[collection.name], abs=0.00501)
    if method.name == "Gray-world" and collection.name in PUBLISHED:
        assert summary.as_tuple()[:5] == pytest.approx(PUBLISHED[collection.name], abs=0.2)


INTEL = {
    "lab_printouts": {"gray-world": (5.13, 4.27), "shades-of-gray": (4.99, 3.98)},
    "field": {"gray-world": (4.65, 3.51), "shades-of-gray": (4.76, 3.56)},
}
"""Mean and median recovery error on thumbnails of the 5DSR, zeros included as they are; they came with the data."""


@pytest.mark.parametrize("path", available("benchmark/intel_tau_5dsr_64x64.npz"))
def test_plain_methods_on_photographs_of_prints(path: Path) -> None:
    with np.load(path) as data:
        images, truths, names = data["images"], data["gt"], data["names"]
    for part, figures in INTEL.items():
        chosen = np.char.find(names.astype(str), part) >= 0
        for name, expected in figures.items():
            method = standard_methods()[name]
            lights = np.stack([method.estimate(image) for image in images[chosen]])
            errors = recovery_error(lights, truths[chosen])
            assert (errors.mean(), np.median(errors)) == pytest.approx(expected, abs=0.00501)
