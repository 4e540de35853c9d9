"""Plain methods against published and recomputed figures of real thumbnails."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from evaluation.experiments import evaluate
from evaluation.methods import GrayEdge

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evaluation.datasets import Scene


PLAIN = [
    # Recovery errors of plain methods on the 259 thumbnails, computed apart from this code when the data were gathered.
    (GrayEdge("Gray-world", 0, 1, 0, 0), (5.21, 4.18, 4.40, 1.11, 11.01)),
    (GrayEdge("Shades-of-Gray", 0, 2, 0, 0), (4.51, 3.37, 3.66, 1.00, 9.88)),
    (GrayEdge("White-Patch", 0, np.inf, 0, 0), (5.78, 3.75, 4.25, 0.90, 14.45)),
]


@pytest.mark.parametrize(("method", "figures"), PLAIN, ids=lambda value: getattr(value, "name", ""))
def test_plain_methods_on_real_thumbnails(
    thumbnails: Sequence[Scene], method: GrayEdge, figures: tuple[float, ...]
) -> None:
    (result,) = evaluate(thumbnails, [method])
    assert result.summary("recovery").as_tuple()[:5] == pytest.approx(figures, abs=0.00501)


def test_gray_world_is_near_the_published_figure(thumbnails: Sequence[Scene]) -> None:
    published = Path(__file__).parents[2].parent / "shared" / "data" / "tables" / "published_nus8.csv"
    with published.open() as stream:
        row = next(row for row in csv.DictReader(stream) if (row["camera"], row["method"]) == ("Canon1DsMkIII", "GW"))
    (result,) = evaluate(thumbnails, [GrayEdge("Gray-world", 0, 1, 0)])
    assert result.summary("recovery").mean == pytest.approx(float(row["mean"]), rel=0.03)
